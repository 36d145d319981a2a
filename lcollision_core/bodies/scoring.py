"""Random poses, their collision verdicts, and a predictor's scores on poses of each kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.codec import BLOCK_POSES
from lcollision_core.bodies.body import Body
from lcollision_core.bodies.learned_body import LearnedBody
from lcollision_core.contact import CollisionDetector
from lcollision_core.devices import block_size, uses_gpu
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import UNWATCHED, Job, for_blocks
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.options import ResolveOptions
from lcollision_core.posing.exact import colliding_on_gpu
from lcollision_core.predictor import KindScores

if TYPE_CHECKING:
    from lcollision_core.motion import Motion


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Collision verdicts of B poses.

    Attributes
    ----------
    colliding : (B,) bool array
    exact : (B,) bool array, whether the verdict is exact; else it is an estimate
    """

    colliding: npt.NDArray[np.bool_]
    exact: npt.NDArray[np.bool_]


def check_poses(
    model: Body,
    latent: npt.ArrayLike,
    error_bound: float = 0.0,
    detector: CollisionDetector | None = None,
) -> Verdicts:
    """Return which poses collide, by the exact check or, within an error bound, by the estimate.

    Parameters
    ----------
    model : of the poses
    latent : (B, D) finite array
    error_bound : largest share of wrong verdicts, measured on samples of the latent box; with 0,
        without a predictor or on a GPU, every pose is checked exactly
    detector : by default the model's; with a clearance, no pose is estimated to be free

    Raises
    ------
    ShapeError : wrong shape, or a number that is not finite.
    """
    codes = np.atleast_2d(np.asarray(latent, dtype=np.float64))
    judging_detector = detector or model.detector
    free, colliding = _sure_verdicts(model, codes, error_bound, judging_detector.clearance)
    exact = ~(free | colliding)
    verdict = colliding.copy()
    if exact.any():
        rows, collides = codes[exact], np.empty(int(exact.sum()), dtype=np.bool_)
        decode = model.block_decoder

        def look(start: int, stop: int) -> None:
            some = colliding_on_gpu(
                judging_detector, model.space, model.card.height, rows[start:stop]
            )
            if some is None:
                vertices = decode(rows[start:stop]).astype(np.float32)
                some = judging_detector.are_colliding(vertices, workers=1)
            collides[start:stop] = some

        block = block_size(len(rows), model.topology.n_faces, BLOCK_POSES)
        for_blocks(look, len(rows), block)
        verdict[exact] = collides
    return Verdicts(verdict, exact)


def estimated_free(
    model: Body, motion: Motion, error_bound: float, clearance: float = 0.0
) -> npt.NDArray[np.bool_]:
    """Return which frames of a motion are free by the estimate: (T,) bool.

    No frame counts as free if the body's own shape varies.

    Parameters
    ----------
    error_bound : see `check_poses`
    clearance : normalised; if above 0, no frame is estimated to be free
    """
    bound = error_bound if motion.space_at is None else 0.0
    return _sure_verdicts(model, motion.codes, bound, clearance)[0]


def _sure_verdicts(
    model: Body, codes: npt.NDArray[np.float64], error_bound: float, clearance: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return which poses are surely free, and which surely collide, by the estimate."""
    nothing = np.zeros(len(codes), dtype=np.bool_)
    if error_bound <= 0.0 or not model.has_predictor:
        return nothing, nothing
    # A GPU decodes and checks a pose in less time than an estimate takes.
    if clearance == 0.0 and uses_gpu(len(codes), model.topology.n_faces):
        return nothing, nothing
    predictor = model.require_predictor()
    store = predictor.facts.store
    # Under other contact rules, such as a tolerated depth, no estimate is sure.
    if store is not None and store.rules != model.rules:
        return nothing, nothing
    free, colliding = predictor.sure_verdicts(codes, error_bound)
    return (nothing if clearance > 0.0 else free), colliding


_DRAWN_AT_ONCE = 64
_MOST_MISSES = 10_000


def sample_poses(
    model: Body,
    n_poses: int,
    seed: int,
    colliding: bool | None = None,
    job: Job = UNWATCHED,
    clearance: float = 0.0,
    error_bound: float = 0.0,
) -> npt.NDArray[np.float64]:
    """Draw latent poses, as `Body.sample` does.

    Parameters
    ----------
    model : of the poses
    n_poses : number of poses to return
    seed : equal seeds give equal poses, on any number of cores
    colliding : True or False keeps only colliding or free poses, by the exact check of the
        vertices rounded to float32 as for export, or within the error bound; None keeps all
    job : reports (poses found, n_poses)
    clearance : in [0, 1), normalised; above 0, poses with parts nearer than that collide
    error_bound : largest share of all drawn poses that may be misjudged, by estimates in place of
        the exact check where a trained model is sure; the share among the returned poses may be
        larger if most poses are of the other kind; 0 uses no estimates

    Returns
    -------
    latent : (n_poses, D) float64 array

    Raises
    ------
    ShapeError : the clearance is out of range.
    LCollisionError : 10 000 poses in a row were of the other kind.
    """
    generator = np.random.default_rng(seed)
    detector = model.detector.with_clearance(clearance)
    if colliding is None:
        return model.sample(n_poses, generator)
    samples = np.empty((n_poses, model.latent_size))
    n_kept = n_misses = 0
    while n_kept < n_poses:
        drawn = model.sample(_DRAWN_AT_ONCE, generator)
        verdicts = check_poses(model, drawn, error_bound, detector)
        matching = drawn[verdicts.colliding == colliding][: n_poses - n_kept]
        samples[n_kept : n_kept + len(matching)] = matching
        n_kept += len(matching)
        n_misses = 0 if len(matching) else n_misses + _DRAWN_AT_ONCE
        if n_misses >= _MOST_MISSES:
            kind = "colliding" if colliding else "collision-free"
            raise LCollisionError(
                f"found no {kind} pose in {n_misses} samples in a row",
                "change the contact rules or the clearance",
            )
        job.report(n_kept, n_poses)
    return samples


CLEARANCE = 1e-3
"""Clearance of resolved poses: the default of the window."""

CARD_POSES = 500
"""Number of poses of each kind for the scores stored in a model."""

_DRAG_EVENTS, _RESOLVED_SHARE = 20, 0.1
"""Events of a scripted drag; share of resolved poses, which are slow to make."""


class PoseKind(StrEnum):
    """Origin of poses."""

    BOX = "latent box"
    BLENDS = "blends"
    NOISY_BLENDS = "blends with noise"
    MIXED_PARTS = "mixed parts"
    MOTION_FRAMES = "frames of motions"
    DRAGS = "drags"
    RESOLVED = "resolved"


def score_kinds(
    model: LearnedBody,
    n_poses: int,
    seed: int = 0,
    job: Job = UNWATCHED,
    threshold: float = 0.5,
) -> tuple[KindScores, ...]:
    """Compare a model's predictor with the exact check on poses of each kind.

    Box poses are uniform in the latent box; blends are of three training poses, also with normal
    noise of up to a tenth of the box; mixed parts take each body part from another training pose;
    frames lie on splines through training poses; drags pull random patches of training poses to
    points of the body, without Solid; resolved poses, a tenth as many, are colliding box samples
    or noisy blends, resolved with a clearance of 0.1 % of the body size.

    Parameters
    ----------
    model : one with a predictor
    n_poses : of each kind, >= 1
    seed : of the poses
    job : reports (kinds done, kinds); polled often
    threshold : probability above which a pose counts as colliding

    Raises
    ------
    ModelFileError : the model has no predictor.
    CancelledError : the job was cancelled.
    """
    predictor = model.require_predictor()
    generator = np.random.default_rng(seed)
    draws, numbers = model.embedding.draws, generator.random
    part = job.part()
    kinds: dict[PoseKind, Callable[[], FloatArray]] = {
        PoseKind.BOX: lambda: model.sample(n_poses, generator),
        PoseKind.BLENDS: lambda: draws.blends(n_poses, numbers),
        PoseKind.NOISY_BLENDS: lambda: draws.noisy_blends(n_poses, numbers),
        PoseKind.MIXED_PARTS: lambda: draws.mixed_parts(n_poses, numbers),
        PoseKind.MOTION_FRAMES: lambda: draws.between(n_poses, numbers),
        PoseKind.DRAGS: lambda: _dragged(model, n_poses, generator, part),
        PoseKind.RESOLVED: lambda: _resolved(model, n_poses, generator, part),
    }
    scores = []
    for done, (kind, drawn) in enumerate(kinds.items(), 1):
        latent = drawn()
        job.check()
        if len(latent):
            called = predictor.predict(latent).collision_probability > threshold
            scores.append(KindScores.of(kind.value, called, check_poses(model, latent).colliding))
        job.report(done, len(kinds))
    return tuple(scores)


def _dragged(
    model: LearnedBody, n_poses: int, generator: np.random.Generator, job: Job
) -> FloatArray:
    """Drag random patches of training poses to random places on the body."""
    from lcollision_core.posing import DragOptions, make_grip

    known_poses, used = model.known_poses, model.topology.used_vertices
    drawn = [
        (
            known_poses[generator.integers(len(known_poses))],
            *(int(generator.choice(used)) for _ in range(2)),
        )
        for _ in range(-(-n_poses // _DRAG_EVENTS))
    ]
    poses = np.empty((len(drawn), _DRAG_EVENTS, model.latent_size))
    # Build these once, before several threads do.
    space = model.space
    _ = space.metric, space.precision, space.longest_edges, space.limbs, space.surface_graph

    def drag(first: int, last: int) -> None:
        for number in range(first, last):
            start, vertex, aim = drawn[number]
            dragger, grip = model.dragger(), make_grip(model.space, vertex)
            vertices = model.decode(start, n_threads=1)
            begin, end = grip.position(vertices), vertices[aim]
            dragger.begin(start, grip, (), DragOptions(solid=False))
            for event in range(_DRAG_EVENTS):
                target = begin + (event + 1) / _DRAG_EVENTS * (end - begin)
                poses[number, event] = dragger.move(target).latent

    for_blocks(drag, len(drawn), 1, job=job)
    return poses.reshape(-1, model.latent_size)[:n_poses]


def _resolved(
    model: LearnedBody, n_poses: int, generator: np.random.Generator, job: Job
) -> FloatArray:
    """Resolve colliding samples, drawn in equal numbers from the box and as noisy blends."""
    n_wanted = max(1, round(_RESOLVED_SHARE * n_poses))
    drawn = np.concatenate(
        [
            model.sample(n_poses, generator),
            model.embedding.draws.noisy_blends(n_poses, generator.random),
        ]
    )
    colliding = np.flatnonzero(check_poses(model, drawn).colliding)
    sample_numbers = generator.permutation(colliding)[:n_wanted]
    # Samples have no largest change.
    options = ResolveOptions(clearance=CLEARANCE, largest_change=None)
    results = model.resolver.resolve_many(drawn[sample_numbers], options, job=job)
    free = [result.latent for result in results if result.exactly_free]
    return np.stack(free) if free else np.empty((0, model.latent_size))
