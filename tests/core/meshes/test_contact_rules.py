"""Contact rules as values: refusals, file contents and wording."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from lcollision_core.errors import ShapeError
from lcollision_core.meshes import ContactRules, RuleCounts

ALL = ContactRules(
    0.05,
    0.0,
    (("Hair", "Body"), ("Belt", "Belt")),
    1e-4,
    True,
    ((3, 0), (5, 9)),
    0.02,
    shape_touching=((2, 7),),
)
TOLERANT = ContactRules(tolerated_pairs=(("Belly", "Arm", 0.01), ("Belly", "Belly", 0.02)))


@pytest.mark.parametrize("rules", [ContactRules(), ALL, TOLERANT])
def test_rules_come_back_from_json(rules: ContactRules) -> None:
    assert ContactRules.from_json(json.loads(json.dumps(rules.to_json()))) == rules


def test_what_a_file_lacks_is_off() -> None:
    assert ContactRules.from_json({}) == ContactRules()
    assert ContactRules().exclude_nothing
    assert not ContactRules(rest_exclusion=0.0).exclude_nothing


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"near_exclusion": -0.1}, "the near exclusion must be 0 or more, and finite, got -0.1"),
        ({"rest_exclusion": float("nan")}, "the rest exclusion must be 0 or more"),
        ({"tolerated_depth": float("inf")}, "the tolerated depth must be 0 or more"),
        ({"ignored": (("Hair",),)}, "an ignored pair must be two names of groups"),
        ({"touching": ((3, -1),)}, "a touching pair must be two faces by number"),
        ({"shape_touching": ((3,),)}, "a touching pair must be two faces by number"),
        ({"touching_radius": -1.0}, "the touching radius must be 0 or more"),
        ({"tolerated_pairs": (("Hair", "Body"),)}, "a tolerated pair must be two names of groups"),
        ({"tolerated_pairs": (("Hair", "Body", -0.1),)}, "and a depth of 0 or more, got"),
        ({"tolerated_pairs": (("Hair", "Body", float("nan")),)}, "and a depth of 0 or more"),
        ({"tolerated_pairs": ((" ", "Body", 0.1),)}, "a tolerated pair must be two names"),
        ({"tolerated_pairs": (("Hair", "Body", 0.1),) * 1001}, "tolerated pairs must be at most"),
        ({"ignored": (("Hair", " "),)}, "an ignored pair must be two names of groups"),
    ],
)
def test_rules_that_mean_nothing_are_refused(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        ContactRules(**values)


@pytest.mark.parametrize(
    "values",
    [
        [],
        {"near_exclusion": "far"},
        {"ignored": [["a", 1]]},
        {"ignored": [["a"]]},
        {"tolerated_pairs": [["a", "b", "deep"]]},
    ],
)
def test_damaged_json_is_refused_in_a_sentence(values: Any) -> None:
    with pytest.raises(ShapeError, match=r"rules|ignored pair"):
        ContactRules.from_json(values)


@pytest.mark.parametrize(
    ("counts", "sentence"),
    [
        (RuleCounts(), ""),
        (RuleCounts(rest=434), "434 pairs that touch at rest are not counted"),
        (RuleCounts(rest=1), "1 pair that touches at rest is not counted"),
        (
            RuleCounts(2, 3, 4, 5, 6, 7, 8),
            "2 pairs within 0.05 along the surface, 3 pairs that touch at rest, 4 pairs of Hair "
            "and Body or Belt with itself, 5 pairs not deeper than 0.0001, 6 pairs at joints, 7 "
            "pairs at places that nearly always touch and 8 pairs at places that a shape brings "
            "into contact are not counted",
        ),
    ],
)
def test_sentences_name_the_rules(counts: RuleCounts, sentence: str) -> None:
    assert ALL.sentence(counts) == sentence
    assert ALL.sentence(counts.to_json()) == sentence


def test_what_is_not_looked_at_is_said_in_short() -> None:
    assert RuleCounts().described() == ContactRules().summary() == ""
    assert RuleCounts(rest=3, joint=40).described() == "3 touching at rest, 40 at joints"
    assert ContactRules(0.1, 0.02, joint_exclusion=True).summary() == (
        "near along the surface, touching at rest, at joints"
    )
    assert ALL.summary().count(", ") == 6


def test_depths_of_pairs_are_said_with_their_groups() -> None:
    said = "not deeper than 0.01 between Belly and Arm or 0.02 within Belly"
    assert TOLERANT.described() == f"pairs {said}"
    assert TOLERANT.sentence(RuleCounts(tolerated=3)) == f"3 pairs {said} are not counted"
    assert TOLERANT.summary() == "not deeper than tolerated"
    assert TOLERANT.named_groups == ("Belly", "Arm")
    five = ContactRules(tolerated_depth=0.1, tolerated_pairs=(("a", "b", 0.2),) * 5)
    assert five.described().endswith("0.2 between a and b or as set for 2 more pairs of groups")
    assert ContactRules(tolerated_pairs=(("a", "b", 0.0),)).described() == ""


def test_many_ignored_pairs_are_said_in_short() -> None:
    rules = ContactRules(ignored=tuple(("Hair", str(n)) for n in range(9)))
    said = rules.sentence(RuleCounts(ignored=7))
    assert said == "7 pairs of 9 ignored pairs of groups are not counted"


def test_rules_are_counted_in_their_order() -> None:
    counts = RuleCounts.of(np.array([0, 1, 4, 4, 2, 0, 3, 3, 3], dtype=np.uint8))
    assert counts == RuleCounts(near=1, rest=1, ignored=3, tolerated=2)
    assert counts.total == 7
