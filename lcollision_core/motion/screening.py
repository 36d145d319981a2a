"""Which frames of a motion collide, where and how deeply."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import NearestPair, SelfCollisions
from lcollision_core.jobs import CancelToken, Progress, available_cores, no_progress
from lcollision_core.meshes.contact_rules import LeftOut, RuleCounts
from lcollision_core.motion.motion import Motion
from lcollision_core.posing import ExactCheck


@dataclass(frozen=True)
class FrameCollisions:
    """What collides in one frame.

    Attributes
    ----------
    frame : its number, from 0
    seconds : its time
    n_pairs : pairs of faces that count
    deepest : penetration depth of the deepest, or the most that a pair lacks of a clearance,
        normalised
    domains : pairs of domains, the first no larger than the second, with the most pairs first
    n_excluded, excluded_deepest : pairs that the contact rules leave out, and the depth of the
        deepest, where that was asked for
    """

    frame: int
    seconds: float
    n_pairs: int
    deepest: float
    domains: tuple[tuple[int, int], ...]
    n_excluded: int = 0
    excluded_deepest: float = 0.0


@dataclass(frozen=True, eq=False)
class ScreenedMotion:
    """The exact check of a motion.

    Attributes
    ----------
    colliding : frames that collide, in order
    in_between : numbers of frames that are free, and so is the next, with a pose between that is
        not
    collides_between : numbers of frames that are free, and so is the next, with contact on the
        linear path of the vertices between; None where that was not asked for
    least_distance, least_frame : where a clearance was asked for, the least signed distance of all
        frames, and in which; None where nothing is as near as was looked for
    left_out : what the contact rules leave out of the frames, where that was asked for
    """

    colliding: tuple[FrameCollisions, ...]
    in_between: tuple[int, ...]
    collides_between: tuple[int, ...] | None = None
    least_distance: float | None = None
    least_frame: int | None = None
    left_out: LeftOut = field(default_factory=LeftOut)

    @property
    def deepest(self) -> float:
        """Penetration depth of the deepest collision of all frames, normalised; 0 for none."""
        return max((one.deepest for one in self.colliding), default=0.0)


def colliding_domains(
    found: SelfCollisions, vertex_domain: npt.NDArray[np.intp], faces: npt.NDArray[np.int32]
) -> tuple[tuple[int, int], ...]:
    """Return which domains collide: pairs, the first no larger than the second, the most first.

    Parameters
    ----------
    found : of the mesh
    vertex_domain, faces : see `screen_frames`
    """
    owners = np.sort(vertex_domain[faces[found.pairs][:, :, 0]], axis=1)
    domains, counts = np.unique(owners, axis=0, return_counts=True)
    return tuple((int(a), int(b)) for a, b in domains[np.argsort(-counts, kind="stable")])


def screen_frames(
    mesh: Callable[[int, float], npt.NDArray[np.floating]],
    times: npt.NDArray[np.float64],
    find: Callable[..., SelfCollisions],
    vertex_domain: npt.NDArray[np.intp],
    faces: npt.NDArray[np.int32],
    substeps: int = 1,
    workers: int | None = None,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
    measure: Callable[[npt.NDArray[np.floating]], NearestPair | None] | None = None,
    touches: Callable[[npt.NDArray[np.floating], npt.NDArray[np.floating]], bool] | None = None,
    estimated_free: npt.NDArray[np.bool_] | None = None,
    seen: Callable[[range], ExactCheck] | None = None,
    *,
    counted_only: bool = True,
) -> ScreenedMotion:
    """Check frames exactly, and poses between them.

    Parameters
    ----------
    mesh : (V, 3) vertices of a frame, or a share of the way from it to the next
    times : (T,) of the frames, in seconds
    find : the exact check of vertices, and maybe of `counted_only`; safe between threads
    vertex_domain : (V,) the part that each vertex belongs to
    faces : (F, 3) of the mesh
    substeps : >= 0, poses between two free frames, evenly spaced
    workers : threads, one for each available core by default
    progress : called with (frames done, T)
    cancel : polled for each frame
    measure : where a frame comes nearest to itself; safe between threads
    touches : whether a free frame touches itself on the linear path to the next
    estimated_free : (T,) frames that are taken to be free without a check; None for none
    seen : the check of one frame, or of two and what is between, in place of `find`, `measure` and
        `touches`, where frames hide faces
    counted_only : whether not to look for what the contact rules leave out, which is faster

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    nearest: dict[int, float] = {}
    excluded: dict[int, tuple[RuleCounts, float]] = {}
    shares = (np.arange(1, substeps + 1) / (substeps + 1)).tolist()

    def screened(frame: int) -> FrameCollisions | None:
        if cancel is not None:
            cancel.raise_if_cancelled()
        if estimated_free is not None and estimated_free[frame]:
            return None
        vertices = mesh(frame, 0.0)
        own = None if seen is None else seen(range(frame, frame + 1))
        found = (find if own is None else own.find)(vertices, counted_only=counted_only)
        excluded[frame] = found.excluded, float(found.excluded_depth.max(initial=0.0))
        nearest_of = measure if own is None or measure is None else own.least_distance
        if nearest_of is not None and (pair := nearest_of(vertices)) is not None:
            nearest[frame] = pair.distance
        if not found.colliding:
            return None
        return FrameCollisions(
            frame,
            float(times[frame]),
            len(found.pairs),
            float(found.penetration_depth.max()),
            colliding_domains(found, vertex_domain, faces),
            excluded[frame][0].total,
            excluded[frame][1],
        )

    def collides_after(frame: int) -> bool:
        if cancel is not None:
            cancel.raise_if_cancelled()
        of_both = find if seen is None else seen(range(frame, frame + 2)).find
        between = (of_both(mesh(frame, share), counted_only=True) for share in shares)
        return any(one.colliding for one in between)

    def touches_after(frame: int) -> bool:
        if cancel is not None:
            cancel.raise_if_cancelled()
        if touches is None:
            return False
        of_both = touches if seen is None else seen(range(frame, frame + 2)).collide_between
        return of_both(mesh(frame, 0.0), mesh(frame + 1, 0.0))

    n = len(times)
    found: list[FrameCollisions | None] = []
    with ThreadPoolExecutor(workers or available_cores(), "screening") as pool:
        for one in pool.map(screened, range(n)):
            found.append(one)
            progress(len(found), n)
        free = [at for at in range(n - 1) if found[at] is None and found[at + 1] is None]
        between, on_path = (
            tuple(at for at, collides in zip(free, pool.map(of, free), strict=True) if collides)
            for of in (collides_after, touches_after)
        )
    left_out = LeftOut()
    for frame in sorted(excluded):
        left_out = left_out.with_frame(frame, *excluded[frame])
    least = min(nearest, key=lambda frame: (nearest[frame], frame), default=None)
    return ScreenedMotion(
        tuple(one for one in found if one is not None),
        between,
        None if touches is None else on_path,
        None if least is None else nearest[least],
        least,
        left_out,
    )


def screen_motion(
    motion: Motion,
    check: ExactCheck,
    substeps: int = 1,
    workers: int | None = None,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
    *,
    continuous: bool = False,
    estimated_free: npt.NDArray[np.bool_] | None = None,
    counted_only: bool = True,
) -> ScreenedMotion:
    """Check all frames of a body's motion, and poses between them: see `screen_frames`.

    Parameters
    ----------
    continuous : whether the linear paths between frames are asked about
    estimated_free, counted_only : see `screen_frames`

    Raises
    ------
    MissingExtraError : ipctk is not installed, which `continuous` needs.
    """
    space = check.space
    return screen_frames(
        lambda frame, share: motion.vertices(frame, check, share),
        motion.times,
        check.find,
        space.vertex_domain,
        space.topology.faces,
        substeps,
        workers,
        progress,
        cancel,
        check.least_distance if check.clearance > 0.0 else None,
        check.collide_between if continuous else None,
        estimated_free,
        None if motion.hidden is None else partial(motion.seen, check),
        counted_only=counted_only,
    )
