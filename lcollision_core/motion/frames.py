"""The frames of one motion as its resolution asks for them: contacts, and single frames freed."""

from __future__ import annotations

import math
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.motion import Motion
from lcollision_core.posing import ExactCheck
from lcollision_core.posing.contact_constraints import Contacts
from lcollision_core.resolve import PoseResolver, ResolveOptions
from lcollision_core.resolve.polish import polish
from lcollision_core.resolve.problem import ResolveProblem
from lcollision_core.resolve.pull_back import pull_back
from lcollision_core.resolve.soft import LeastOverlap

HalfSpacesOfPose = tuple[FloatArray, FloatArray]
"""(C, D) normals and (C,) offsets that separate the contacts of one pose."""


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a motion; may be shared between threads.

    Attributes
    ----------
    motion : as it was
    resolver : of the body's poses
    options : of single frames
    pool : runs what is of one frame
    cancel : polled for each frame
    continuous : whether poses between frames also count with their vertices half-way between those
        of both frames, not only with their codes
    spare : >= 0, normalised: how much farther poses between frames are to stay apart
    largest_change : of a vertex of a frame that is freed, normalised; None for any
    """

    motion: Motion
    resolver: PoseResolver
    options: ResolveOptions
    pool: Executor
    cancel: CancelToken | None = None
    continuous: bool = False
    spare: float = 0.0
    largest_change: float | None = None

    @cached_property
    def _check(self) -> ExactCheck:
        return self.resolver.check.with_clearance(self.options.clearance)

    @cached_property
    def _check_between(self) -> ExactCheck:
        return self.resolver.check.with_clearance(self.options.clearance + self.spare)

    def check(self, frame: int) -> ExactCheck:
        """Return the exact check of one frame, with the clearance of the options."""
        return self.motion.check(frame, self._check)

    def problem(self, frame: int) -> ResolveProblem:
        """Return the problem of one frame, whose target is the frame as it was."""
        return self.resolver.problem(self.motion.codes[frame], self.options, self.cancel)

    @cached_property
    def metric(self) -> FloatArray:
        """(D, D) what a change of the codes costs."""
        return self.problem(0).metric

    @cached_property
    def inverse_metric(self) -> FloatArray:
        """(D, D) its inverse; 0 in the rows and columns of locked codes."""
        movable = np.flatnonzero(self.problem(0).movable)
        inverse = np.zeros_like(self.metric)
        inverse[np.ix_(movable, movable)] = np.linalg.inv(self.metric[np.ix_(movable, movable)])
        return inverse

    def limits(self, frame: int) -> tuple[FloatArray, FloatArray]:
        """Return the (D,) bounds of one frame's codes, which the frame as it was lies within."""
        problem = self.problem(frame)
        return problem.low, problem.high

    def distance(self, one: FloatArray, other: FloatArray) -> float:
        """Return how far two (D,) poses are apart, the root of the metric's square."""
        moved = one - other
        return math.sqrt(max(float(moved @ self.metric @ moved), 0.0))

    def contacts(self, frame: int, codes: FloatArray) -> HalfSpacesOfPose | None:
        """Return what separates the contacts of (D,) codes at a frame; None if they are free."""
        return self._separated(self.check(frame), codes)

    def _separated(self, check: ExactCheck, codes: FloatArray) -> HalfSpacesOfPose | None:
        if self.cancel is not None:
            self.cancel.raise_if_cancelled()
        contacts = Contacts(check)
        return (contacts.normals, contacts.offsets) if contacts.add(codes) else None

    def contacts_between(
        self, frame: int, share: float, start: FloatArray, end: FloatArray
    ) -> HalfSpacesOfPose | None:
        """Return what separates the contacts of a pose between (D,) codes of a frame and the next.

        Parameters
        ----------
        share : of the way, in (0, 1)
        """
        codes = (1.0 - share) * start + share * end
        motion = self.motion
        check, after = (motion.check(at, self._check_between) for at in (frame, frame + 1))
        if motion.placements is None and motion.displacement is None:
            found = self._separated(check, codes)
            if found is not None or not self.continuous:
                return found
        # Each frame lies where it was placed by itself: half-way is between their vertices.
        meshes = (one.exported(one.decode(row)[0]) for one, row in ((check, start), (after, end)))
        first, second = meshes
        plain = replace(check, displacement=None)
        own = plain.exported(plain.decode(codes)[0])
        check = self.motion.seen(check, range(frame, frame + 2))
        return self._separated(
            replace(check, displacement=(1.0 - share) * first + share * second - own), codes
        )

    def are_free(self, frames: range, progress: Progress = no_progress) -> npt.NDArray[np.bool_]:
        """Return which frames of the motion, as it was, are free."""
        codes, free = self.motion.codes, np.empty(len(frames), dtype=np.bool_)

        def is_free(frame: int) -> bool:
            if self.cancel is not None:
                self.cancel.raise_if_cancelled()
            return self.check(frame).is_free(codes[frame])

        for number, one in enumerate(self.pool.map(is_free, frames)):
            free[number] = one
            progress(number + 1, len(frames))
        return free

    def collide_between(
        self, frames: npt.NDArray[np.intp], fractions: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return after which of (n,) frames of the motion, as it was, a pose between collides.

        Parameters
        ----------
        fractions : of the way to the next frame, of the poses between
        """
        codes = self.motion.codes

        def collides(frame: int) -> bool:
            return any(
                self.contacts_between(frame, share, codes[frame], codes[frame + 1]) is not None
                for share in fractions.tolist()
            )

        return np.fromiter(self.pool.map(collides, frames.tolist()), np.bool_, len(frames))

    def touch_between(
        self, frames: npt.NDArray[np.intp], codes: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return after which of (n,) frames something touches on the linear path of the vertices.

        Parameters
        ----------
        codes : (T, D) of all frames, which are free there and in the next
        """

        def touches(frame: int) -> bool:
            if self.cancel is not None:
                self.cancel.raise_if_cancelled()
            checks = [self.check(frame), self.check(frame + 1)]
            rows = codes[frame : frame + 2]
            ends = (one.exported(one.decode(row)[0]) for one, row in zip(checks, rows, strict=True))
            both = self.motion.seen(checks[0], range(frame, frame + 2))
            return both.collide_between(*ends)

        return np.fromiter(self.pool.map(touches, frames.tolist()), np.bool_, len(frames))

    def resolved(self, frame: int, correction: FloatArray | None = None) -> FloatArray | None:
        """Return (D,) codes that are free near a frame, from a correction if there is one.

        Returns
        -------
        codes : (D,) as near to the frame as it was as they stay free; None if none are found
        """
        check, problem, target = self.check(frame), self.problem(frame), self.motion.codes[frame]
        start = target if correction is None else target + correction
        start = np.clip(start, problem.low, problem.high)
        found = polish(check, problem, start)
        for begin in (start, target) if correction is not None else (target,):
            if found is None:
                found = self.near(frame, begin)
        if found is None:
            return None
        freed = pull_back(check, problem, found)
        return freed if self.is_near_enough(frame, freed) else None

    def near(self, frame: int, codes: FloatArray) -> FloatArray | None:
        """Return the free codes nearest to (D,) codes at a frame, None if none are near enough."""
        check, resolver = self.check(frame), self.resolver
        # What the codes do not hold of a frame may make a known free pose collide.
        if len(check.hidden) or (check.displacement is not None and check.displacement.any()):
            resolver = resolver.with_check(check)
        result = resolver.resolve(
            codes, self.options, cancel=self.cancel, placement=self.motion.placement(frame)
        )
        is_kept = result.exactly_free and self.is_near_enough(frame, result.latent)
        return result.latent if is_kept else None

    def softened(self, frame: int) -> FloatArray:
        """Return (D,) codes of less overlap within the largest change; a frame's own if none."""
        check, problem = self.check(frame), self.problem(frame)
        most = math.inf if self.largest_change is None else self.largest_change
        return LeastOverlap(check, problem, most).find(())

    def is_near_enough(self, frame: int, codes: FloatArray) -> bool:
        """Whether (D,) codes move no vertex of a frame farther than the largest change."""
        if self.largest_change is None:
            return True
        old, new = self.resolver.check.decode(np.stack([self.motion.codes[frame], codes]))
        return float(np.linalg.norm(new - old, axis=1).max()) <= self.largest_change
