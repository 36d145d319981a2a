"""The exact check of a motion, frame by frame, for the timeline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from lcollision_core.bodies import Body
    from lcollision_core.jobs import Job
    from lcollision_core.meshes.contact_rules import ExcludedPairs
    from lcollision_core.motion import Motion

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MotionChecks:
    """The check results of a motion's frames; a worker fills them while the window reads.

    Attributes
    ----------
    deepest : (T,) float64 array, the deepest penetration of each frame, normalised; 0 if free,
        NaN until checked
    parts : (T, K) float32 array, the same for each body part
    between : (T,) bool array, whether the pose halfway to the next frame collides, though both
        frames are free
    checked_between : (T,) bool array
    estimate : (T,) float64 array, the estimated probability of a collision; NaN until predicted
    excluded : (T, R) int64 array, pairs that each contact rule leaves out, see `RuleCounts`, in
        every n-th frame: see `ExcludedPairs.step_for`
    excluded_deepest : (T,) float64 array, the deepest of these, normalised
    """

    deepest: FloatArray
    parts: npt.NDArray[np.float32]
    between: npt.NDArray[np.bool_]
    checked_between: npt.NDArray[np.bool_]
    estimate: FloatArray
    excluded: npt.NDArray[np.int64]
    excluded_deepest: FloatArray

    @classmethod
    def of(cls, n_frames: int, n_parts: int) -> MotionChecks:
        """Return the checks of a motion before any frame is checked."""
        from lcollision_core.meshes.contact_rules import N_RULES

        none = np.zeros(n_frames, dtype=np.bool_)
        unknown = np.full(n_frames, np.nan)
        parts = np.zeros((n_frames, n_parts), dtype=np.float32)
        excluded, depth = np.zeros((n_frames, N_RULES), dtype=np.int64), np.zeros(n_frames)
        return cls(unknown, parts, none, none.copy(), unknown.copy(), excluded, depth)

    def of_changed(self, same: npt.NDArray[np.bool_]) -> MotionChecks:
        """Return the checks that stay valid after an edit; `same` marks the (T,) equal frames."""
        # The pose between two frames depends on both.
        both = same & np.append(same[1:], True)
        valid = MotionChecks.of(*self.parts.shape)
        for name, before in vars(self).items():
            frames = both if name in ("between", "checked_between") else same
            getattr(valid, name)[frames] = before[frames]
        return valid

    @property
    def left_out(self) -> ExcludedPairs:
        """Pairs that the contact rules leave out of the checked frames."""
        from lcollision_core.meshes.contact_rules import ExcludedPairs, RuleCounts

        n = len(self.deepest)
        left_out = ExcludedPairs(step=ExcludedPairs.step_for(n))
        for frame in range(0, n, left_out.step):
            if np.isnan(self.deepest[frame]):
                continue
            counts = RuleCounts(*self.excluded[frame].tolist())
            left_out = left_out.with_frame(frame, counts, float(self.excluded_deepest[frame]))
        return left_out

    @property
    def n_checked(self) -> int:
        """The number of checked frames."""
        return int((~np.isnan(self.deepest)).sum())


def coarse_to_fine(n_frames: int) -> list[int]:
    """Return all frame numbers, coarsely spaced ones first and then those between."""
    order: dict[int, None] = {}
    step = 1 << max(0, (n_frames - 1).bit_length() - 3)
    while step:
        order.update(dict.fromkeys(range(0, n_frames, step)))
        step //= 2
    return list(order)


def path_of_vertex(body: Body, motion: Motion, frames: range, vertex: int, job: Job) -> FloatArray:
    """Return the (N, 3) drawn positions of a vertex in frames of a motion, in the data's unit."""
    vertices, places = np.array([vertex]), np.empty((len(frames), 3))
    for row, frame in enumerate(frames):
        job.check()
        space = motion.space(frame, body.space)
        places[row] = space.decode_some(motion.codes[frame][None], vertices)[0, 0] * body.body_size
        job.report(row, len(frames))
    return places


def check_motion(
    model: Body,
    motion: Motion,
    checks: MotionChecks,
    job: Job,
) -> None:
    """Check the unchecked frames of a motion, and write the results into `checks`."""
    from lcollision_core.jobs import available_cores, for_blocks
    from lcollision_core.meshes.contact_rules import ExcludedPairs

    check, n = model.exact_check(), len(motion)
    step = ExcludedPairs.step_for(n)
    owners = check.space.vertex_domain[model.faces[:, 0]]
    if model.has_predictor:
        for start in range(0, n, 256):
            job.check()
            rows = slice(start, start + 256)
            if np.isnan(checks.estimate[rows]).any():
                checks.estimate[rows] = model.predict(motion.codes[rows]).collision_probability
    unchecked = [number for number in coarse_to_fine(n) if np.isnan(checks.deepest[number])]

    def check_frame(at: int, _: int) -> None:
        number = unchecked[at]
        collisions = check.find(motion.vertices(number, check), counted_only=number % step != 0)
        depths = collisions.penetration_depth
        for side in (0, 1) if collisions.colliding else ():
            np.maximum.at(checks.parts[number], owners[collisions.pairs[:, side]], depths)
        checks.excluded[number] = tuple(collisions.excluded.to_json().values())
        checks.excluded_deepest[number] = collisions.excluded_depth.max(initial=0.0)
        # Written last: from here on the frame counts as checked.
        checks.deepest[number] = float(depths.max()) if collisions.colliding else 0.0

    between = np.flatnonzero(~checks.checked_between[: n - 1]).tolist()

    def check_after(at: int, _: int) -> None:
        number = between[at]
        if checks.deepest[number] == checks.deepest[number + 1] == 0.0:
            collisions = check.find(motion.vertices(number, check, 0.5))
            checks.between[number] = collisions.colliding
        checks.checked_between[number] = True

    # One core is left to the window.
    n_threads = max(1, available_cores() - 1)
    checking = job.part(lambda *_: job.report(checks.n_checked, n))
    for_blocks(check_frame, len(unchecked), 1, n_threads, checking)
    for_blocks(check_after, len(between), 1, n_threads, checking)
