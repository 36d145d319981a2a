"""Resolve on colliding poses, by solver, against bisection without learning.

For a character, which has no predictor, the steps of Resolve run once on each pose, and the
results are checked by all pairs of faces, without a tree. For poses made by people, or like theirs,
the ends of solid drags to the same poses stand beside them, the nearest of those from all starter
poses.

Each solver runs twice on each pose, on one core: alone, for the paper's figures of merit (whether
its point is feasible for the classifier, and how much of the exact energy it removes), and with
the whole ladder, for time, distances and the exact check.

The fields of a row, means over the poses:

solver : the name of a `Solver`, "bisection", or "drags" and "steps" for a character
poses : colliding poses that were resolved
median_ms, p95_ms : of a whole resolve, on one core
feasible_rate : of the poses that the predictor calls colliding, the share that the solver alone
    brings to a point that it calls free; None for the baseline
exactly_free_rate : at the end, by the exact check
free_before_walk_back : exactly free without the ladder's last step; None for the baseline
energy_decrease : mean fraction of the exact energy removed at the solver's feasible points
latent_distance : mean ||Z - Z*|| / ||Z*||
vertex_distance : mean displacement of the vertices, in normalised lengths
largest_change : largest displacement of any vertex of any pose, in normalised lengths
overlap_left : mean fraction of the exact energy that remains at the end
least_distance, least_by_brute_force : with a clearance, the least distance of all poses, by the
    detector and by all pairs of faces, without a tree; None if nothing is near enough
confirmed_free_rate : of a character's poses, the share that is free by all pairs of faces
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from app.benchmarks.measures import Row, is_free_by_brute_force, least_by_brute_force
from lcollision_core.bodies import Body, read_poses, sample_poses
from lcollision_core.contact import DISTANCE_BOUND
from lcollision_core.errors import LCollisionError
from lcollision_core.files import PoseSet
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.joint_kinds import Role
from lcollision_core.posing import DragOptions
from lcollision_core.resolve import ResolveOptions, ResolveResult, Step

FloatArray = npt.NDArray[np.float64]

BASELINE = "bisection"
"""Bisection of the segment to the first pose stored as free: no learning."""

HALVINGS = 12

_EVENTS, _MOST_EVENTS = 20, 60
"""Events in which a drag's target goes from the start to the end, and most events of a drag."""

_COLOUR = (18, 64, 133)
_MARKER_PIXELS = 30
_TIME_BINS, _ITERATION_BINS, _CHANGE_BINS = 24, 16, 40
_MOST_SHOWN = 0.98

_END = ("largest_change", "overlap_left", "least_distance", "least_by_brute_force")


@dataclass(frozen=True, eq=False)
class SolverRuns:
    """The data of the paper's histograms: one solver alone.

    Attributes
    ----------
    solver : name
    iterations, seconds : (n,) of the poses that the predictor calls colliding, or of all if there
        are none
    energy_change : (m,) relative change of the exact energy of the feasible ones; -1 removes all
    """

    solver: str
    iterations: npt.NDArray[np.int64]
    seconds: FloatArray
    energy_change: FloatArray


@dataclass(frozen=True, eq=False)
class CollidingPoses:
    """The poses to resolve: (n, D) latents, and the placements of encoded meshes."""

    latents: FloatArray
    placements: Sequence[RigidTransform | None]


def sampled_poses(model: Body, n_poses: int, seed: int, job: Job = UNWATCHED) -> CollidingPoses:
    """Draw colliding poses by the model's own sampling."""
    latents = sample_poses(model, n_poses, seed, colliding=True, job=job)
    return CollidingPoses(latents, [None] * n_poses)


_MADE = ("Stand", "Arms crossed", "Hands on hips")
_TURNED, _CROSSED = 0.2, (0.1, 0.5)
"""Radians: standard deviation of the limbs' random turns, and range of crossing the thighs."""

_LIMBS = {Role.SHOULDER, Role.UPPER_ARM, Role.FOREARM, Role.HAND, Role.THIGH, Role.SHIN}


def made_poses(model: Body, n_poses: int, seed: int, job: Job = UNWATCHED) -> CollidingPoses:
    """Draw colliding poses of a character as a person would make them.

    Arms hang or are crossed, or hands are on hips; legs stand or are crossed; all limbs are turned
    a little.

    Raises
    ------
    LCollisionError : the character's joints are not known.
    """
    starters = {pose.name: pose.codes for pose in model.starter_poses}
    space = model.joints
    if space is None or not starters.keys() >= set(_MADE):
        raise LCollisionError(f"the joints of {model.name!r} are not known", "leave out --made")
    joints, axes = space.joint_of_code.tolist(), space.axis_of_code.tolist()
    roles = [Role.OTHER if joint < 0 else space.roles[joint] for joint in joints]
    turned = [code for code, role in enumerate(roles) if role in _LIMBS]
    thighs = [code for code, role in enumerate(roles) if role == Role.THIGH and axes[code] == 2]
    # For each code, the sign that moves its thigh inwards.
    across = np.cross(space.up, space.front)
    side = space.origins[space.joint_of_code[thighs]] @ across
    moved = space.decode(0.1 * np.eye(len(space.low))[thighs]) - space.rest_vertices
    inwards = -np.sign(side - side.mean()) * np.sign((moved @ across).sum(axis=1))
    generator, poses = np.random.default_rng(seed), list[FloatArray]()
    check = model.exact_check()
    while len(poses) < n_poses:
        job.report(len(poses), n_poses)
        codes = starters[_MADE[generator.integers(len(_MADE))]].copy()
        codes[turned] += _TURNED * generator.normal(size=len(turned))
        codes[thighs] += generator.integers(2) * generator.uniform(*_CROSSED) * inwards
        codes = np.clip(codes, check.space.low, check.space.high)
        if not check.is_free(codes):
            poses.append(codes)
    return CollidingPoses(np.stack(poses), [None] * n_poses)


def real_poses(
    model: Body, pose_set: PoseSet, n_poses: int, job: Job = UNWATCHED
) -> CollidingPoses:
    """Encode the first `n_poses` self-intersecting poses of a set.

    Raises
    ------
    LCollisionError : the topology differs, or no pose collides.
    """
    model.require_topology(pose_set.topology, "the pose set")
    colliding = model.detector.are_colliding(pose_set.vertices.astype(np.float32))
    pose_numbers = np.flatnonzero(colliding)[:n_poses]
    if len(pose_numbers) == 0:
        raise LCollisionError("no pose of the set intersects itself", "name another set")
    encoded = []
    for pose in pose_numbers:
        encoded.append(model.encode(pose_set.vertices[pose]))
        job.report(len(encoded), len(pose_numbers))
    return CollidingPoses(
        np.stack([pose.latent for pose in encoded]), [pose.placement for pose in encoded]
    )


def poses_of_file(model: Body, path: Path, n_poses: int) -> CollidingPoses:
    """Read the first `n_poses` poses of a file that intersect themselves.

    Raises
    ------
    LCollisionError : the file is not of this body, or no pose collides.
    """
    latents = np.stack([pose.latent for pose in read_poses(path, model)])
    colliding = latents[~model.exact_check().are_free(latents)][:n_poses]
    if len(colliding) == 0:
        raise LCollisionError(f"no pose of {path} intersects itself", "name another file")
    return CollidingPoses(colliding, [None] * len(colliding))


def score_baseline(model: Body, poses: CollidingPoses, clearance: float = 0.0) -> Row:
    """Bisect towards the first known free pose, with or without a clearance.

    Raises
    ------
    LCollisionError : the model stores no free pose.
    """
    if len(model.free_latent) == 0:
        raise LCollisionError(
            f"the model {model.name!r} knows no free pose to bisect to", "train its predictor again"
        )
    seconds, latents = [], []
    for target in poses.latents:
        start = time.perf_counter()
        free, colliding = model.free_latent[0], target
        for _ in range(HALVINGS):
            middle = 0.5 * (free + colliding)
            if _are_colliding(model, middle[None], clearance)[0]:
                colliding = middle
            else:
                free = middle
        seconds.append(time.perf_counter() - start)
        latents.append(free)
    return _reached_row(BASELINE, model, poses, seconds, latents, clearance)


def score_drags(
    model: Body, poses: CollidingPoses, options: ResolveOptions, job: Job = UNWATCHED
) -> Row:
    """Drag a character's codes to all poses without passing through itself, as by sliders.

    Each drag starts from every free starter pose and the rest pose; the nearest end counts.

    Parameters
    ----------
    options : with the clearance to keep
    job : reports poses

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    check, dragger = model.exact_check(clearance=options.clearance), model.dragger()
    starts = [np.zeros(model.latent_size), *(pose.codes for pose in model.starter_poses)]
    starts = [start for start in starts if check.is_free(start)]
    kept = DragOptions(clearance=options.clearance)
    seconds, ends = [], []
    for target in poses.latents:
        began = time.perf_counter()
        reached = []
        for start in starts:
            step = dragger.begin(start, None, options=kept)
            for event in range(_MOST_EVENTS):
                share = min(1.0, (event + 1) / _EVENTS)
                step = dragger.move(start + share * (target - start))
                if share == 1.0 and step.settled:
                    break
            reached.append(step.latent)
        seconds.append(time.perf_counter() - began)
        moved = model.decode(np.stack(reached), 1) - model.decode(target, 1)
        ends.append(reached[int(np.linalg.norm(moved, axis=2).mean(axis=1).argmin())])
        job.report(len(ends), len(poses.latents))
    row = _reached_row("drags", model, poses, seconds, ends, options.clearance)
    return row | {"confirmed_free_rate": None}


def _reached_row(
    name: str,
    model: Body,
    poses: CollidingPoses,
    seconds: Sequence[float],
    ends: Sequence[FloatArray],
    clearance: float,
) -> Row:
    """Return the row of a method that goes from free poses towards those to resolve."""
    moved = np.stack(ends) - poses.latents
    lengths = [
        np.linalg.norm(model.decode(end, 1) - model.decode(target, 1), axis=1) / model.body_size
        for end, target in zip(ends, poses.latents, strict=True)
    ]
    return {
        "solver": name,
        "poses": len(ends),
        "median_ms": _milliseconds(seconds, 0.5),
        "p95_ms": _milliseconds(seconds, 0.95),
        "feasible_rate": None,
        "exactly_free_rate": 1.0 - float(_are_colliding(model, np.stack(ends), clearance).mean()),
        "free_before_walk_back": None,
        "energy_decrease": None,
        "latent_distance": float(
            (np.linalg.norm(moved, axis=1) / np.linalg.norm(poses.latents, axis=1)).mean()
        ),
        "vertex_distance": float(np.mean(lengths)),
        **dict.fromkeys(_END),
        "largest_change": float(np.max(lengths)),
    }


def score_solver(
    model: Body,
    poses: CollidingPoses,
    options: ResolveOptions,
    job: Job = UNWATCHED,
) -> tuple[Row, SolverRuns]:
    """Run one solver alone and with its ladder on all poses, on the calling thread.

    Parameters
    ----------
    model : with a predictor
    poses : colliding
    options : with the exact check
    job : reports poses, and is polled at every evaluation

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    resolver = model.resolver
    # What is built once for all poses is not timed.
    resolver.resolve(poses.latents[0], options)
    unchecked = replace(options, verify=False, clearance=0.0, largest_change=None)
    alone, whole = [], []
    for target, placement in zip(poses.latents, poses.placements, strict=True):
        alone.append(resolver.resolve(target, unchecked, job=job, placement=placement))
        whole.append(resolver.resolve(target, options, job=job, placement=placement))
        job.report(len(whole), len(poses.latents))
    called = model.predict(poses.latents).collision_logit > 0.0
    feasible = np.array([result.predicted_free for result in alone]) & called
    change = _energy_change(model, poses, alone, feasible)
    seconds = [result.seconds for result in whole]
    before_fall_back = [
        bool(result.exactly_free) and result.step != Step.FALL_BACK for result in whole
    ]
    score = {
        "solver": str(options.solver),
        "poses": len(whole),
        "median_ms": _milliseconds(seconds, 0.5),
        "p95_ms": _milliseconds(seconds, 0.95),
        "feasible_rate": float(feasible.sum() / called.sum()) if called.any() else None,
        "exactly_free_rate": float(np.mean([bool(result.exactly_free) for result in whole])),
        "free_before_walk_back": float(np.mean(before_fall_back)),
        "energy_decrease": -float(change.mean()) if len(change) else None,
        "latent_distance": float(np.mean([result.latent_distance for result in whole])),
        "vertex_distance": float(np.mean([result.vertex_distance_mean for result in whole])),
        **_how_they_end(model, whole, options.clearance),
    }
    counted_poses = called if called.any() else ~called
    runs = SolverRuns(
        solver=str(options.solver),
        iterations=np.array([result.iterations for result in alone])[counted_poses],
        seconds=np.array([result.seconds for result in alone])[counted_poses],
        energy_change=change,
    )
    return score, runs


def score_steps(
    model: Body,
    poses: CollidingPoses,
    options: ResolveOptions,
    job: Job = UNWATCHED,
) -> Row:
    """Resolve all poses of a character, on the calling thread, and confirm the results.

    Parameters
    ----------
    options : with the exact check
    job : reports poses, and is polled at every evaluation

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    # What is built once for all poses is not timed.
    model.resolver.resolve(poses.latents[0], options)
    results, confirmed = [], []
    for target, placement in zip(poses.latents, poses.placements, strict=True):
        result = model.resolver.resolve(target, options, job=job, placement=placement)
        results.append(result)
        confirmed.append(is_free_by_brute_force(model, result.vertices))
        job.report(len(results), len(poses.latents))
    seconds = [result.seconds for result in results]
    free = np.array([bool(result.exactly_free) for result in results])
    before = free & np.array([result.step != Step.FALL_BACK for result in results])
    return {
        "solver": "steps",
        "poses": len(results),
        "median_ms": _milliseconds(seconds, 0.5),
        "p95_ms": _milliseconds(seconds, 0.95),
        "feasible_rate": None,
        "exactly_free_rate": float(free.mean()),
        "free_before_walk_back": float(before.mean()),
        "energy_decrease": None,
        "latent_distance": float(np.mean([result.latent_distance for result in results])),
        "vertex_distance": float(np.mean([result.vertex_distance_mean for result in results])),
        **_how_they_end(model, results, options.clearance),
        "confirmed_free_rate": float(np.mean(confirmed)),
    }


def _how_they_end(model: Body, results: Sequence[ResolveResult], clearance: float) -> Row:
    """Return the fields of `_END`: the largest change, the remaining overlap, least distances."""
    left = [(r.energy_after or 0.0) / r.energy_before if r.energy_before else 0.0 for r in results]
    least: list[float | None] = [None, None]
    if clearance > 0.0:
        bound = max(DISTANCE_BOUND, clearance)
        distances = [np.inf if r.least_distance is None else r.least_distance for r in results]
        measured = [least_by_brute_force(model, result.vertices, bound) for result in results]
        least = [min(some) if np.isfinite(some).any() else None for some in (distances, measured)]
    change = max(result.vertex_distance_max for result in results)
    return dict(zip(_END, (change, float(np.mean(left)), *least), strict=True))


def _energy_change(
    model: Body,
    poses: CollidingPoses,
    alone: Sequence[ResolveResult],
    feasible: npt.NDArray[np.bool_],
) -> FloatArray:
    """Return the relative changes of the exact energy of the feasible poses."""
    changes = []
    for index in np.flatnonzero(feasible).tolist():
        before, after = (
            model.detector.detect(model.decode(latent, 1).astype(np.float32)).energy
            for latent in (poses.latents[index], alone[index].latent)
        )
        # An encoded mesh that collides may decode to one that does not.
        if before > 0.0:
            changes.append(after / before - 1.0)
    return np.array(changes)


def _are_colliding(model: Body, latents: FloatArray, clearance: float) -> npt.NDArray[np.bool_]:
    vertices = model.decode(latents, 1).astype(np.float32)
    return model.detector.with_clearance(clearance).are_colliding(vertices, workers=1)


def _milliseconds(seconds: Sequence[float], quantile: float) -> float:
    return 1e3 * float(np.quantile(seconds, quantile))


def draw_histograms(runs: SolverRuns, folder: Path) -> None:
    """Draw ``convergence-SOLVER.png`` and ``energy-SOLVER.png``, each atomically.

    Parameters
    ----------
    runs : of one solver, at least one pose
    folder : an existing folder

    Notes
    -----
    After the figures of Tan et al. 2021 on convergence (iterations and time, as a density) and on
    response (relative change of the exact energy of the feasible poses). The axes of the first end
    at the 98th percentiles, that of the second at +1; values beyond count in the last bins.
    """
    import pyvista as pv

    from app.view.offscreen import save_chart

    milliseconds = 1e3 * runs.seconds
    longest = max(float(np.quantile(milliseconds, _MOST_SHOWN)), 1e-3)
    per_bin = max(1, round(float(np.quantile(runs.iterations, _MOST_SHOWN)) / _ITERATION_BINS))
    time_edges = np.linspace(0.0, longest, _TIME_BINS + 1)
    iteration_edges = per_bin * np.arange(_ITERATION_BINS + 1) - 0.5
    counts, _, _ = np.histogram2d(
        np.minimum(milliseconds, longest),
        np.minimum(runs.iterations, iteration_edges[-1]),
        bins=(time_edges, iteration_edges),
    )
    density = pv.Chart2D(x_label="time (ms)", y_label="iterations")
    density.title = (
        f"{runs.solver}: {len(milliseconds)} poses, mean {runs.iterations.mean():.2f} iterations, "
        f"{milliseconds.mean():.1f} ms"
    )
    columns, rows = np.nonzero(counts)
    x, y = (0.5 * (edges[:-1] + edges[1:]) for edges in (time_edges, iteration_edges))
    for column, row in zip(columns, rows, strict=True):
        opacity = round(255 * np.sqrt(counts[column, row] / counts.max()))
        density.scatter(
            x[[column]], y[[row]], color=(*_COLOUR, opacity), size=_MARKER_PIXELS, style="s"
        )
    density.x_range, density.y_range = time_edges[[0, -1]], iteration_edges[[0, -1]]
    save_chart(density, folder / f"convergence-{runs.solver}.png")

    change = np.minimum(runs.energy_change, 1.0)
    counts, edges = np.histogram(change, bins=_CHANGE_BINS, range=(-1.0, 1.0))
    mean = f"mean {100.0 * runs.energy_change.mean():.1f} %" if len(change) else "none"
    response = pv.Chart2D(x_label="relative energy change", y_label="poses")
    response.title = f"{runs.solver}: {len(change)} feasible poses, energy change {mean}"
    response.bar(0.5 * (edges[:-1] + edges[1:]), counts, color=_COLOUR)
    save_chart(response, folder / f"energy-{runs.solver}.png")
