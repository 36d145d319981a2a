"""What a resolution may not do to a motion: leave more overlap, or move a vertex too far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import SelfCollisions
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.frames import Frames
from lcollision_core.motion.motion import Motion
from lcollision_core.motion.screening import colliding_domains
from lcollision_core.posing import ExactCheck

_LITTLE = 0.25
"""Depth that joints take from a contact, at a mean displacement of the body of 1. A limb that moves
alone takes several times as much as the whole body moves on average; where it is less than this,
what overlaps goes along."""


_ROUNDED = 1.0 + 1e-4
"""Of the largest change: files hold single precision."""


class Reason(StrEnum):
    """Why frames were not freed."""

    NO_JOINT = "no joint moves them apart"
    TOO_FAR = "what frees them moves a vertex farther than the largest change"
    NOT_FOUND = "no way was found that moves them apart"
    BETWEEN = "what frees them makes a pose between two frames collide"
    AS_WRITTEN = "the form of the file cannot hold what frees them"
    STOPPED = "it was stopped before"


@dataclass(frozen=True)
class KeptSpan:
    """Successive frames of a motion that its resolution did not free.

    Attributes
    ----------
    frames : the first and the last of them; in a cycle the last may come before the first
    reason : why
    parts : pairs of domains that overlap in the deepest frame, as they are now, the most pairs
        first; none where that was not looked at
    deepest : depth of their deepest overlap now, normalised
    is_original : whether they are equal to the bit to what they were; else they have the least
        overlap that was found
    """

    frames: tuple[int, int]
    reason: Reason
    parts: tuple[tuple[int, int], ...] = ()
    deepest: float = 0.0
    is_original: bool = True

    def to_json(self, part_names: Sequence[str]) -> dict[str, object]:
        """Return what reports hold of it, body parts by their names."""
        return {
            "frames": list(self.frames),
            "reason": str(self.reason),
            "parts": [[part_names[a], part_names[b]] for a, b in self.parts],
            "deepest": self.deepest,
            "unchanged": self.is_original,
            "sentence": self.sentence(part_names),
        }

    def sentence(self, part_names: Sequence[str]) -> str:
        """Say which frames, what overlaps in them, and why."""
        first, last = self.frames
        frames = f"frame {first}" if first == last else f"frames {first} to {last}"
        verb = "stays as it was" if first == last else "stay as they were"
        if not self.is_original:
            verb = "overlaps as little as was found" if first == last else "overlap as little as "
            verb += "" if first == last else "was found"
        if not self.parts:
            return f"{frames} {verb}: {self.reason}"
        named = " and ".join(dict.fromkeys(part_names[part] for part in self.parts[0]))
        return f"{frames} {verb}: {named}, {100.0 * self.deepest:.2f} % deep; {self.reason}"


@dataclass(frozen=True, eq=False)
class Guard:
    """Judges the corrected frames of a motion by the motion as it was.

    Attributes
    ----------
    frames : of the motion, a cycle gone through twice
    n : how many of them there are
    was_free : (n,) bool
    was_clear : (n,) bool, frames that were free, and so was the next, with no pose between that
        collides
    """

    frames: Frames
    n: int
    was_free: npt.NDArray[np.bool_]
    was_clear: npt.NDArray[np.bool_]

    def faults(
        self,
        span: range,
        codes: FloatArray,
        free: npt.NDArray[np.bool_],
        fractions: Sequence[FloatArray],
    ) -> dict[int, Reason]:
        """Return the frames of a span that are worse than they were, and why.

        Parameters
        ----------
        codes : (n, D) corrected
        free : (n,) bool, which is set for the frames of the span
        fractions : of each frame, of the way to the next, of poses that are looked at
        """
        own = [at % self.n for at in span]
        found: dict[int, Reason] = {}
        judged = self.frames.pool.map(lambda at: self._judge(at, codes[at]), own)
        for at, (is_free, reason) in zip(own, judged, strict=True):
            free[at] = is_free
            if reason is not None:
                found[at] = reason
        last = len(self.frames.motion) - 1
        pairs = [at % self.n for at in range(span.start - 1, span.stop)]
        asked = [
            at
            for at in pairs
            if at < last and self.was_clear[at] and free[at] and free[(at + 1) % self.n]
        ]

        def collides(at: int) -> bool:
            both = codes[at], codes[(at + 1) % self.n]
            return any(
                self.frames.contacts_between(at, share, *both) is not None
                for share in fractions[at].tolist()
            )

        for at, hit in zip(asked, self.frames.pool.map(collides, asked), strict=True):
            if hit:
                found.setdefault(at, Reason.BETWEEN)
        return found

    def _judge(self, at: int, codes: FloatArray) -> tuple[bool, Reason | None]:
        was = self.frames.motion.codes[at]
        if np.array_equal(was, codes):
            return bool(self.was_free[at]), None
        overlap = self._overlap(at, codes)
        if not self.frames.is_near_enough(at, codes):
            return not overlap.colliding, Reason.TOO_FAR
        is_worse = overlap.colliding and (
            self.was_free[at] or overlap.exceeds(self._overlap(at, was))
        )
        return not overlap.colliding, Reason.NOT_FOUND if is_worse else None

    def _overlap(self, at: int, codes: FloatArray) -> SelfCollisions:
        check = self.frames.check(at)
        return check.find(check.exported(check.decode(codes)[0]))

    def kept(self, run: range, codes: FloatArray, reasons: Mapping[int, Reason]) -> KeptSpan | None:
        """Describe a run of frames that collide, or did; None where it is free and was changed.

        Parameters
        ----------
        run : frames
        codes : (n, D) as they are now
        reasons : by frame, where one is known
        """
        own = [at % self.n for at in run]
        was = self.frames.motion.codes
        is_original = all(np.array_equal(codes[at], was[at]) for at in own)
        deepest = self.frames.pool.map(lambda at: self._overlap(at, codes[at]).deepest, own)
        depth, worst = max(zip(deepest, own, strict=True))
        if depth == 0.0 and not is_original:
            return None
        overlap = self._overlap(worst, codes[worst])
        space = self.frames.resolver.check.space
        reason = next((reasons[at] for at in own if at in reasons), Reason.NOT_FOUND)
        if overlap.colliding and self._is_carried(worst, codes[worst]):
            reason = Reason.NO_JOINT
        parts = colliding_domains(overlap, space.vertex_domain, space.topology.faces)
        return KeptSpan((own[0], own[-1]), reason, parts, overlap.deepest, is_original)

    def _is_carried(self, at: int, codes: FloatArray) -> bool:
        """Whether the deepest contact of a pose hardly opens however the joints turn."""
        contacts = self.frames.contacts(at, codes)
        if contacts is None:
            return False
        normals, _ = contacts
        squared = np.einsum("d,de,e->", normals[0], self.frames.inverse_metric, normals[0])
        return bool(squared < _LITTLE**2)


def is_worse(
    check: ExactCheck,
    old: npt.NDArray[np.floating],
    new: npt.NDArray[np.floating],
    largest_change: float | None,
) -> bool:
    """Whether a vertex of a frame moves too far, or more overlaps, or anything deeper.

    Parameters
    ----------
    check : of the frame
    old, new : (V, 3) vertices where they are exported to
    largest_change : of a vertex, normalised; None for any
    """
    if largest_change is not None:
        size = check.body_size * (1.0 if check.placement is None else check.placement.scale)
        if np.linalg.norm(new - old, axis=1).max() > largest_change * size * _ROUNDED:
            return True
    overlap = check.find(new)
    return overlap.colliding and overlap.exceeds(check.find(old))


def worse_spans(
    before: Motion,
    after: Motion,
    spans: Sequence[range],
    check: ExactCheck,
    largest_change: float | None,
) -> list[range]:
    """Return the spans of a motion of which a frame is worse than it was.

    Parameters
    ----------
    before, after : of as many frames
    spans : that are looked at
    check : of the body's poses
    largest_change : see `is_worse`
    """

    def is_frame_worse(frame: int) -> bool:
        old, new = (motion.vertices(frame, check) for motion in (before, after))
        return is_worse(before.check(frame, check), old, new, largest_change)

    return [span for span in spans if any(map(is_frame_worse, span))]
