"""Contact rules of a model: in its file, in its checks, and in its predictor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody
from lcollision_core.bodies.card import ModelCard
from lcollision_core.bundled import bundled_file
from lcollision_core.errors import ModelFileError, ShapeError
from lcollision_core.meshes import ContactRules, FaceGroup
from lcollision_core.options import RuleOptions
from tests.core.predictor_rows import colliding_latent


def test_rules_and_groups_come_back(tube_model: LearnedBody, tmp_path: Path) -> None:
    n_faces = tube_model.topology.n_faces
    groups = (
        FaceGroup("low", np.arange(n_faces // 2)),
        FaceGroup("odd", np.arange(1, n_faces, 2)),
    )
    rules = ContactRules(0.01, 0.0, (("low", "odd"),), 1e-4)
    card = replace(tube_model.card, rules=rules, groups=groups)
    model = tube_model.with_card(card)
    model.save(tmp_path / "m.safetensors")
    again = LearnedBody.load(tmp_path / "m.safetensors")
    assert again.rules == again.detector.rules == rules
    assert again.rules.near_exclusion == 0.01
    for group, stored in zip(groups, again.groups, strict=True):
        assert group.name == stored.name
        assert np.array_equal(group.faces, stored.faces)


def test_rules_change_what_is_found_and_nothing_that_is_kept(tube_model: LearnedBody) -> None:
    model = LearnedBody(tube_model.name, tube_model.embedding, tube_model.card)
    latent = colliding_latent(tube_model)[:1]
    vertices = model.decode(latent)[0]
    found = model.detector.detect(vertices)
    tolerant = model.with_rules(ContactRules(tolerated_depth=1.0))
    assert found.colliding
    assert not tolerant.detector.detect(vertices).colliding
    assert tolerant.detector.detect(vertices).excluded.tolerated == len(found.pairs)
    first, second = model.domain_names
    of_parts = ((first, first, 1.0), (first, second, 1.0), (second, second, 1.0))
    by_parts = model.with_rules(ContactRules(tolerated_pairs=of_parts))
    assert by_parts.labeller().label(latent).n_pairs.tolist() == [0]
    assert (
        by_parts.detector.detect(vertices).excluded == tolerant.detector.detect(vertices).excluded
    )
    assert model.detector.detect(vertices).colliding
    assert tolerant.labeller().label(latent).n_pairs.tolist() == [0]
    assert tolerant.exact_check().is_free(latent[0])
    assert not model.exact_check().is_free(latent[0])
    with pytest.raises(ShapeError, match="the group 'hair' is unknown"):
        model.with_rules(ContactRules(ignored=(("hair", "hair"),)))


def test_rules_that_a_predictor_depends_on_stay() -> None:
    body = LearnedBody.load(bundled_file("models", "body.safetensors"))
    with pytest.raises(ModelFileError, match="trained by the contact rules that it has"):
        body.with_rules(ContactRules(rest_exclusion=0.02))
    assert body.with_rules(body.rules).has_predictor
    with pytest.raises(ModelFileError, match="trained by the contact rules that it has"):
        body.with_options(RuleOptions(rest_exclusion=0.02, tolerated_depth=0.01))
    # Tolerated depths affect only the exact check, and are not stored.
    tolerant = body.with_options(
        RuleOptions(tolerated_depth=0.01, tolerated_pairs=("head:head=0",))
    )
    assert tolerant.rules == ContactRules(
        tolerated_depth=0.01, tolerated_pairs=(("head", "head", 0.0),)
    )
    with pytest.raises(ModelFileError, match="trained by the contact rules that it has"):
        body.with_rules(tolerant.rules)


@pytest.mark.parametrize(
    "change",
    [
        {"rules": []},
        {"rules": {"tolerated_depth": -1.0}},
        {"rules": {"ignored": [["hair", "body"]]}},
        {"groups": [{"name": "hair"}]},
        {"groups": [{"name": "hair", "runs": [0, 10**9]}]},
        {"groups": [{"name": "hair", "runs": [5, 2]}]},
    ],
)
def test_a_card_with_damaged_rules_is_refused(
    tube_model: LearnedBody, change: dict[str, Any]
) -> None:
    metadata = tube_model.card.to_metadata()
    assert ModelCard.from_metadata(metadata, tube_model.topology.n_faces) == tube_model.card
    with pytest.raises(ModelFileError, match="the model's card is damaged"):
        ModelCard.from_metadata({**metadata, **change}, tube_model.topology.n_faces)
