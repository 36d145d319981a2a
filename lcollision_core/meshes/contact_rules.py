"""Contact rules: which pairs of colliding faces do not count.

`contact` applies them. They are defined here because a pose set stores them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ShapeError, listed
from lcollision_core.json_values import from_json, to_json
from lcollision_core.sentences import counted, say, say_number

CHARACTER_REST_EXCLUSION = 0.02
"""Normalised length: the rest exclusion of characters, found by measurements on several."""

TOUCHING_RADIUS = 0.02
"""Normalised length: the radius of patches that a proposal, or contact in shapes, leaves out."""

MAX_TOUCHING = 4000
"""Most pairs of patches that touch in nearly every pose."""

MAX_IGNORED = 1000
"""Most ignored pairs of groups, and most pairs with a tolerated depth of their own."""

MAX_GROUP_NAME_LENGTH = 500

_MOST_SEARCHED = 64
"""Most frames of a motion that are searched for pairs that do not count."""


@dataclass(frozen=True)
class RuleCounts:
    """Number of colliding pairs that each rule excludes; a pair goes to the first that applies.

    Attributes
    ----------
    near : pairs within the near exclusion along the surface
    rest : pairs at places that touch at rest
    ignored : pairs of ignored groups
    tolerated : pairs no deeper than the tolerated depth, in general or of their groups
    joint : pairs about a joint that links their parts
    touching : pairs at patches that touch in nearly every pose
    shape : pairs at patches that a morph target alone brings into contact
    """

    near: int = 0
    rest: int = 0
    ignored: int = 0
    tolerated: int = 0
    joint: int = 0
    touching: int = 0
    shape: int = 0

    @classmethod
    def of(cls, rule: npt.NDArray[np.integer]) -> RuleCounts:
        """Count rules by number, (n,): 0 for a pair that counts, 1 for near and so on."""
        return cls(*np.bincount(rule, minlength=N_RULES + 1)[1 : N_RULES + 1].tolist())

    @property
    def total(self) -> int:
        """Number of colliding pairs that do not count."""
        return sum(self.to_json().values())

    def to_json(self) -> dict[str, int]:
        """Return the numbers by name of the rule."""
        return asdict(self)

    def __add__(self, other: RuleCounts) -> RuleCounts:
        """Return the sums of both."""
        mine, others = self.to_json(), other.to_json()
        return RuleCounts(**{name: n + others[name] for name, n in mine.items()})

    def described(self) -> str:
        """Describe the excluded pairs, as in "3 touching at rest, 40 at joints"."""
        return ", ".join(f"{n} {_SHORTLY[name]}" for name, n in self.to_json().items() if n)


N_RULES = len(fields(RuleCounts))


@dataclass(frozen=True)
class ExcludedPairs:
    """Pairs that contact rules exclude in the frames of a motion, or in every n-th of a long one.

    Attributes
    ----------
    counts : excluded pairs in the searched frames, by rule
    frames : number of searched frames with such pairs
    deepest : penetration depth of the deepest pair, normalised
    frame : number of the frame of that pair, None if there is none
    searched : number of searched frames
    step : every `step`-th frame was searched
    """

    counts: RuleCounts = RuleCounts()
    frames: int = 0
    deepest: float = 0.0
    frame: int | None = None
    searched: int = 0
    step: int = 1

    @staticmethod
    def step_for(n_frames: int) -> int:
        """Return the step between the frames of a motion that are searched for excluded pairs.

        A search for the pairs that count skips most faces. A search for all pairs takes 2 to 10
        times as long, and successive frames have similar pairs.
        """
        return max(1, -(-n_frames // _MOST_SEARCHED))

    def with_frame(self, frame: int, counts: RuleCounts, deepest: float) -> ExcludedPairs:
        """Return a copy with a further searched frame."""
        more = replace(self, searched=self.searched + 1)
        if not counts.total:
            return more
        more = replace(more, counts=self.counts + counts, frames=self.frames + 1)
        is_deeper = self.frame is None or deepest > self.deepest
        return replace(more, deepest=deepest, frame=frame) if is_deeper else more

    def to_json(self) -> dict[str, Any]:
        """Return the fields for reports of motions."""
        return {
            "excluded_pairs": self.counts.to_json(),
            "excluded_frames": self.frames,
            "excluded_deepest": self.deepest,
            "excluded_deepest_frame": self.frame,
            "excluded_searched": self.searched,
        }

    def sentence(self, rules: ContactRules) -> str:
        """Describe the excluded pairs, their depth and the rules; empty if there are none."""
        sentence = rules.sentence(self.counts)
        if not self.frames:
            return sentence
        frames = counted(self.frames, "frame", "frames")
        if self.step > 1:
            frames = say(
                "{n} of {all} frames that were searched for all pairs",
                n=self.frames,
                all=self.searched,
            )
        return say(
            "in {frames} {pairs}, up to {depth:.3g} % of the body size deep in frame {frame}",
            frames=frames,
            pairs=sentence,
            depth=100.0 * self.deepest,
            frame=self.frame,
        )


@dataclass(frozen=True)
class ContactRules:
    """Rules for the pairs of colliding faces that do not count, for any pose of one mesh.

    All lengths are normalised, and measured along edges of the rest pose between the nearest
    corners of two faces.

    Attributes
    ----------
    near_exclusion : pairs within this distance do not count; 0 excludes nothing
    near_by_limb : whether the near exclusion holds only for faces that are also near in space at
        rest: within twice the limb's thickness at the nearest joint, the thinner of the two, given
        by the groups about joints
    rest_exclusion : pairs that touch at rest do not count, nor do pairs with one face within this
        distance of each face of such a pair; 0 excludes touching pairs only, None none. Faces touch
        at rest if they collide or lie on each other.
    ignored : pairs of names of groups; a pair of one face from each group does not count
    tolerated_depth : pairs up to this penetration depth do not count; deeper ones count with all
        of it
    joint_exclusion : whether pairs do not count if both faces lie about one joint, as given by the
        groups of a rig: see `FaceGroup.about_joint`
    touching : pairs of faces at the centres of patches that touch in nearly every pose; pairs with
        one face within the touching radius of each of the two do not count
    touching_radius : radius of these patches
    left_out : names of groups whose pairs do not count; they are still posed, shown and exported
    tolerated_pairs : pairs of names of groups with a depth that replaces the tolerated depth for
        pairs of one face from each group; if several apply, the least
    shape_touching : pairs of faces at the centres of patches that a morph target alone brings into
        contact; pairs with one face within `TOUCHING_RADIUS` of each of the two do not count

    Raises
    ------
    ShapeError : a length is negative or not finite, a pair does not have two names or faces, a name
        is invalid, or there are too many pairs.
    """

    near_exclusion: float = 0.0
    rest_exclusion: float | None = None
    ignored: tuple[tuple[str, str], ...] = ()
    tolerated_depth: float = 0.0
    joint_exclusion: bool = False
    touching: tuple[tuple[int, int], ...] = ()
    touching_radius: float = 0.0
    left_out: tuple[str, ...] = ()
    tolerated_pairs: tuple[tuple[str, str, float], ...] = ()
    near_by_limb: bool = False
    shape_touching: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        for what, length in (
            ("the near exclusion", self.near_exclusion),
            ("the rest exclusion", self.rest_exclusion),
            ("the tolerated depth", self.tolerated_depth),
            ("the touching radius", self.touching_radius),
        ):
            if length is not None and not 0.0 <= length < math.inf:
                raise ShapeError.must_be(what, "0 or more, and finite", length)
        for what, pairs in (("ignored", self.ignored), ("tolerated", self.tolerated_pairs)):
            if len(pairs) > MAX_IGNORED:
                raise ShapeError.must_be(f"{what} pairs", f"at most {MAX_IGNORED}", len(pairs))
        for patches in (self.touching, self.shape_touching):
            if len(patches) > MAX_TOUCHING:
                raise ShapeError.must_be("touching pairs", f"at most {MAX_TOUCHING}", len(patches))
            if any(len(pair) != 2 or min(pair) < 0 for pair in patches):
                raise ShapeError("must be two faces by number", where="a touching pair")
        for pair in self.ignored:
            if len(pair) != 2 or not all(map(_is_name, pair)):
                raise ShapeError.must_be(
                    "an ignored pair", "two names of groups", repr(pair)[:MAX_GROUP_NAME_LENGTH]
                )
        for *names, depth in self.tolerated_pairs:
            if len(names) != 2 or not all(map(_is_name, names)) or not 0.0 <= depth < math.inf:
                raise ShapeError.must_be(
                    "a tolerated pair",
                    "two names of groups and a depth of 0 or more",
                    repr((*names, depth))[:MAX_GROUP_NAME_LENGTH],
                )
        for name in self.left_out:
            if not _is_name(name):
                quoted_name = repr(name)[:MAX_GROUP_NAME_LENGTH]
                raise ShapeError.must_be("what is left out", "the name of a group", quoted_name)

    @property
    def named_groups(self) -> tuple[str, ...]:
        """Names of the groups of faces that the rules mention, each once."""
        pairs = (*self.ignored, *(pair[:2] for pair in self.tolerated_pairs))
        return tuple(dict.fromkeys((*(name for pair in pairs for name in pair), *self.left_out)))

    @property
    def tolerate_something(self) -> bool:
        """Whether some pairs have a tolerated depth."""
        return self.tolerated_depth > 0.0 or any(depth for *_, depth in self.tolerated_pairs)

    @property
    def exclude_nothing(self) -> bool:
        """Whether all colliding pairs count."""
        return self == STRICT

    def to_json(self) -> dict[str, Any]:
        """Return the rules as JSON values for `from_json`."""
        return to_json(self)

    def leaving_out(self, name: str, left_out: bool) -> ContactRules:
        """Return these rules with a group of faces left out of the check, or checked."""
        others = tuple(other for other in self.left_out if other != name)
        return replace(self, left_out=(*others, name) if left_out else others)

    @classmethod
    def from_json(cls, values: Any) -> ContactRules:
        """Rebuild the rules from the values of `to_json`; missing rules are off.

        Raises
        ------
        ShapeError : a value is of the wrong type, or invalid.
        """
        try:
            return from_json(cls, values, "rules")
        except ValueError as error:
            raise ShapeError(str(error)) from error

    def described(self) -> str:
        """Describe the excluded pairs, as in "pairs that touch at rest"; empty if all count."""
        groups = listed(map(pair_in_words, self.ignored), _NAMED_PAIRS)
        around = f" or within {self.rest_exclusion:g} of such a pair" if self.rest_exclusion else ""
        left_out = listed(self.left_out, _NAMED_PAIRS)
        descriptions = (
            left_out and f"pairs of parts left out ({left_out})",
            self.near_exclusion and f"pairs {self._near_in_words()}",
            self.rest_exclusion is not None and f"pairs that touch at rest{around}",
            groups and f"pairs of {groups}",
            self.tolerate_something and f"pairs not deeper than {self._tolerated_in_words()}",
            self.joint_exclusion and "pairs at a joint that links their parts",
            self.touching
            and f"pairs at {len(self.touching)} places that touch in nearly every pose",
            self.shape_touching
            and f"pairs at {len(self.shape_touching)} places that a shape brings into contact",
        )
        return ", ".join(what for what in descriptions if what)

    def summary(self) -> str:
        """List the rules that apply in short, as in "touching at rest, at joints"."""
        applies = {
            "near": self.near_exclusion > 0.0,
            "rest": self.rest_exclusion is not None,
            "ignored": self.ignored,
            "tolerated": self.tolerate_something,
            "joint": self.joint_exclusion,
            "touching": self.touching,
            "shape": self.shape_touching,
        }
        short_names = (_SHORTLY[name] for name, does in applies.items() if does)
        return ", ".join(filter(None, (self.left_out_in_words(), *short_names)))

    def left_out_in_words(self) -> str:
        """List the groups left out, as in "without Axe, Cape"; empty if there are none."""
        return f"without {listed(self.left_out, _NAMED_PAIRS)}" if self.left_out else ""

    def _near_in_words(self) -> str:
        distance = self.near_exclusion
        if self.near_by_limb:
            return say(
                "within {distance:g} along the surface, less at thin limbs", distance=distance
            )
        return say("within {distance:g} along the surface", distance=distance)

    def _tolerated_in_words(self) -> str:
        """List the tolerated depths, as in "0.001 or 0.01 between Belly and Hand"."""
        named, more = self.tolerated_pairs[:_NAMED_PAIRS], len(self.tolerated_pairs) - _NAMED_PAIRS
        descriptions = [
            f"{depth:g} {f'within {first}' if first == other else f'between {first} and {other}'}"
            for first, other, depth in named
        ]
        if self.tolerated_depth or not named:
            descriptions.insert(0, f"{self.tolerated_depth:g}")
        return " or ".join(
            (*descriptions, *(f"as set for {more} more pairs of groups",) * (more > 0))
        )

    def sentence(self, counts: RuleCounts | Mapping[str, int]) -> str:
        """Describe how many pairs are excluded by which rules; empty if there are none."""
        counts = counts if isinstance(counts, RuleCounts) else RuleCounts(**counts)
        left_out = self.left_out_in_words()
        pairs = map(pair_in_words, self.ignored[:_NAMED_PAIRS])
        groups = " or ".join((*pairs, *("parts left out",) * bool(left_out)))
        if len(self.ignored) > _NAMED_PAIRS:
            groups = f"{len(self.ignored)} ignored pairs of groups"
        near, depth = self._near_in_words(), self._tolerated_in_words()
        # In the order of `RuleCounts`.
        texts = (
            say_number(counts.near, "{n} pair {near}", "{n} pairs {near}", near=near),
            say_number(
                counts.rest, "{n} pair that touches at rest", "{n} pairs that touch at rest"
            ),
            say_number(
                counts.ignored, "{n} pair of {groups}", "{n} pairs of {groups}", groups=groups
            ),
            say_number(
                counts.tolerated,
                "{n} pair not deeper than {depth}",
                "{n} pairs not deeper than {depth}",
                depth=depth,
            ),
            say_number(counts.joint, "{n} pair at a joint", "{n} pairs at joints"),
            say_number(
                counts.touching,
                "{n} pair at places that nearly always touch",
                "{n} pairs at places that nearly always touch",
            ),
            say_number(
                counts.shape,
                "{n} pair at places that a shape brings into contact",
                "{n} pairs at places that a shape brings into contact",
            ),
        )
        numbers = counts.to_json().values()
        *others, last = [text for n, text in zip(numbers, texts, strict=True) if n] or [""]
        if not last:
            return left_out
        pairs_text = say("{some} and {last}", some=", ".join(others), last=last) if others else last
        not_counted = say_number(
            counts.total, "{pairs} is not counted", "{pairs} are not counted", pairs=pairs_text
        )
        return ", ".join(filter(None, (left_out, not_counted)))


def pair_in_words(pair: tuple[str, str]) -> str:
    """Describe a pair of groups, as in "Head and Neck" or "Head with itself"."""
    first, second = pair
    return f"{first} with itself" if first == second else f"{first} and {second}"


STRICT = ContactRules()
"""All colliding pairs count."""

_SHORTLY = {
    "near": "near along the surface",
    "rest": "touching at rest",
    "ignored": "of ignored groups",
    "tolerated": "not deeper than tolerated",
    "joint": "at joints",
    "touching": "at places that nearly always touch",
    "shape": "at places that a shape brings into contact",
}

_NAMED_PAIRS = 3
"""Most pairs of groups that a sentence lists by name."""


def _is_name(name: object) -> bool:
    return isinstance(name, str) and name.strip() != "" and len(name) <= MAX_GROUP_NAME_LENGTH
