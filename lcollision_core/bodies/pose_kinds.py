"""How well a model's predictor judges poses of the kinds that people make."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

import numpy as np

from lcollision_core.bodies.pose_model import PoseModel
from lcollision_core.bodies.verdicts import judge_poses
from lcollision_core.jobs import UNWATCHED, Job, for_blocks
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.options import ResolveOptions
from lcollision_core.predictor import KindScores

CLEARANCE = 1e-3
"""Of the poses that are resolved: the window's default."""

CARD_POSES = 500
"""Poses of each kind for the figures that a model keeps."""

_DRAG_EVENTS, _RESOLVED_SHARE = 20, 0.1
"""Events of a scripted drag; resolved poses for each pose of another kind, as one takes so long."""


class PoseKind(StrEnum):
    """How poses came about."""

    BOX = "latent box"
    BLENDS = "blends"
    NOISY_BLENDS = "blends with noise"
    MIXED_PARTS = "mixed parts"
    MOTION_FRAMES = "frames of motions"
    DRAGS = "drags"
    RESOLVED = "resolved"


def score_kinds(
    model: PoseModel,
    n_poses: int,
    seed: int = 0,
    job: Job = UNWATCHED,
    threshold: float = 0.5,
) -> tuple[KindScores, ...]:
    """Compare a model's predictor with the exact check on poses of each kind.

    Poses of the latent box are uniform in it; blends are of three training poses, also with normal
    noise of up to a tenth of the box; mixed parts take each body part from another training pose;
    frames lie on splines through training poses; drags pull random patches of training poses, not
    solid, to places on the body; resolved ones were samples of the box or blends with noise that
    collide, a tenth as many, resolved with a clearance of 0.1 % of the body size.

    Parameters
    ----------
    model : with a predictor
    n_poses : of each kind, >= 1
    seed : of the poses
    job : reports (kinds done, kinds); polled often
    threshold : probability above which a pose is called colliding

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
            scores.append(KindScores.of(kind.value, called, judge_poses(model, latent).colliding))
        job.report(done, len(kinds))
    return tuple(scores)


def _dragged(
    model: PoseModel, n_poses: int, generator: np.random.Generator, job: Job
) -> FloatArray:
    """Drag random patches of training poses to random places on the body."""
    from lcollision_core.posing import DragOptions, make_grip

    known, used = model.known_poses, model.topology.used_vertices
    drawn = [
        (known[generator.integers(len(known))], *(int(generator.choice(used)) for _ in range(2)))
        for _ in range(-(-n_poses // _DRAG_EVENTS))
    ]
    poses = np.empty((len(drawn), _DRAG_EVENTS, model.latent_size))
    # Built once, before several threads would each begin to.
    space = model.space
    _ = space.metric, space.precision, space.longest_edges, space.limbs, space.surface_graph

    def drag(first: int, last: int) -> None:
        for number in range(first, last):
            start, taken, aim = drawn[number]
            dragger, grip = model.dragger(), make_grip(model.space, taken)
            vertices = model.decode(start, n_threads=1)
            begin, end = grip.position(vertices), vertices[aim]
            dragger.begin(start, grip, (), DragOptions(solid=False))
            for event in range(_DRAG_EVENTS):
                target = begin + (event + 1) / _DRAG_EVENTS * (end - begin)
                poses[number, event] = dragger.move(target).latent

    for_blocks(drag, len(drawn), 1, job=job)
    return poses.reshape(-1, model.latent_size)[:n_poses]


def _resolved(
    model: PoseModel, n_poses: int, generator: np.random.Generator, job: Job
) -> FloatArray:
    """Resolve colliding samples, half of them of the box and half of them blends with noise."""
    wanted = max(1, round(_RESOLVED_SHARE * n_poses))
    drawn = np.concatenate(
        [
            model.sample(n_poses, generator),
            model.embedding.draws.noisy_blends(n_poses, generator.random),
        ]
    )
    colliding = np.flatnonzero(judge_poses(model, drawn).colliding)
    chosen = generator.permutation(colliding)[:wanted]
    # Samples may end anywhere.
    options = ResolveOptions(clearance=CLEARANCE, largest_change=None)
    found = model.resolver.resolve_many(drawn[chosen], options, job=job)
    free = [one.latent for one in found if one.exactly_free]
    return np.stack(free) if free else np.empty((0, model.latent_size))
