"""Motions resolved by spans, against each frame resolved from the previous frame's correction.

The fields of a row:

motion : the name of the clip or path
method : "spans", the program over whole spans, or "frame by frame"
frames, free_before, free_after : all frames, and those free by the exact check
confirmed : of up to ten evenly spaced free frames, those free by all pairs of faces, without a tree
half_steps, seventh_steps : pairs of free neighbours with a colliding pose between them, of one and
    of seven poses between
mean_change, largest_change, acceleration_ratio, largest_jump, foot_slide : see `MotionReport`
seconds : wall time on this machine, with all cores
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from app.benchmarks.measures import Row, is_free_by_brute_force
from lcollision_core.bodies import Body
from lcollision_core.bodies.motions import read_motions
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.topology import evenly_spaced
from lcollision_core.motion import (
    NOMINAL_RATE,
    Motion,
    MotionReport,
    resolve_motion,
    screen_motion,
    standing_parts,
)

_FRAMES, _KNOTS = 40, 5
_PATH_SEED, _SPLINE_SEED = 5, 13
_CONFIRMED = 10


def motions_of(body: Body, data: Path | None) -> list[Motion]:
    """Return the motions of a file, a character's clips, or two smooth paths through a model."""
    if data is not None:
        return read_motions(body, data)
    source = getattr(getattr(body, "character", None), "source", None)
    return read_motions(body, Path(source)) if source is not None else _smooth_paths(body)


def _smooth_paths(body: Body) -> list[Motion]:
    """Return a path to a random pose and back, and a spline through the box, of 40 frames each."""
    times = np.arange(_FRAMES) / NOMINAL_RATE
    share = np.linspace(0.0, 1.0, _FRAMES)
    low, high = body.known_poses.min(axis=0), body.known_poses.max(axis=0)
    start, end = np.random.default_rng(_PATH_SEED).uniform(low, high, (2, len(low)))
    there_and_back = (0.5 - 0.5 * np.cos(2.0 * np.pi * share))[:, None]
    space = body.space
    knots = np.random.default_rng(_SPLINE_SEED).uniform(
        space.low, space.high, (_KNOTS, len(space.low))
    )
    knots[[0, -1]] *= 0.3
    spline = CubicSpline(np.linspace(0.0, 1.0, _KNOTS), knots)
    return [
        Motion("path", times, start + there_and_back * (end - start)),
        Motion("spline", times, 0.8 * spline(share)),
    ]


def score_motion(
    body: Body,
    motion: Motion,
    workers: int | None = None,
    job: Job = UNWATCHED,
) -> list[Row]:
    """Resolve one motion by both methods, and measure the results.

    Parameters
    ----------
    body : of the motion, with a resolver
    motion : to resolve
    workers, job : see `resolve_motion`
    """
    resolver, check = body.resolver, body.exact_check()
    up = np.eye(3)[body.up_axis]
    _ = check.space.metric
    # Compiling and loading are not timed.
    first = next((frame.frame for frame in screen_motion(motion, check, 0).colliding), 0)
    resolve_motion(resolver, motion.part(range(first, first + 1)), up)
    start = time.perf_counter()
    resolution = resolve_motion(resolver, motion, up, None, workers, job)
    seconds = time.perf_counter() - start
    rows = [{"method": "spans", **_measured(body, motion, resolution.motion), "seconds": seconds}]
    start = time.perf_counter()
    results = resolver.resolve_many(
        motion.codes, None, workers, job, placements=motion.placements, sequence=True
    )
    seconds = time.perf_counter() - start
    codes = np.stack([result.latent for result in results])
    alone = Motion(motion.name, motion.times, codes, motion.placements, motion.space_at)
    rows.append({"method": "frame by frame", **_measured(body, motion, alone), "seconds": seconds})
    return [{"motion": motion.name, "frames": len(motion), **row} for row in rows]


def _measured(body: Body, before: Motion, after: Motion) -> dict[str, Any]:
    check = body.exact_check()
    screened = [screen_motion(motion, check, 0) for motion in (before, after)]
    free_before, free = (len(before) - len(frame.colliding) for frame in screened)
    colliding = {frame.frame for frame in screened[1].colliding}
    free_frames = [int(n) for n in evenly_spaced(len(after), _CONFIRMED) if int(n) not in colliding]
    confirmed = [
        is_free_by_brute_force(body, after.vertices(n, check).astype(np.float32))
        for n in free_frames
    ]
    standing = standing_parts(before, check, np.eye(3)[body.up_axis])
    report = MotionReport.of(before, after, check, standing)
    return {
        "free_before": free_before,
        "free_after": free,
        "confirmed": f"{sum(confirmed)} of {len(free_frames)}",
        "half_steps": len(screen_motion(after, check, 1).in_between),
        "seventh_steps": len(screen_motion(after, check, 7).in_between),
        "mean_change": report.mean_change,
        "largest_change": report.largest_change,
        "acceleration_ratio": report.acceleration_ratio,
        "largest_jump": report.largest_jump,
        "foot_slide": report.foot_slide,
    }
