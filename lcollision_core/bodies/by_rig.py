"""Poses to learn from that a character's rig makes, where there is no or little animation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lcollision_core.bodies.rig_model import REST, RigModel
from lcollision_core.characters import joint_parts
from lcollision_core.characters.random_poses import HumanDraws
from lcollision_core.errors import PoseSetError, ShapeError
from lcollision_core.files import Character, PoseSet
from lcollision_core.files.pose_set import require_usable_reference
from lcollision_core.files.safe import MAX_ITEMS
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import ContactRules
from lcollision_core.meshes.contact_rules import CHARACTER_REST_EXCLUSION

_DRAWS = (1.0, 1.0, 0.75, 0.5)
"""How often a pose that collides is drawn, and by what its turns are scaled then."""

_FULL = 2
"""Of these draws, those that are not scaled down; of a pose that is never free, one of them is
kept, as else the poses of a character that nearly always collides would all be near to rest."""

_AT_ONCE = 64
"""Poses that are decoded and checked together."""


def poses_by_rig(
    body: RigModel,
    n_poses: int,
    seed: int = 0,
    job: Job = UNWATCHED,
) -> PoseSet:
    """Pose a character at random by its joints, within limits of a person.

    Each pose turns from one limb to all of them, a little or far; the body stays in its place. A
    pose that collides, by the rules of the body, is drawn again, at last with smaller turns; where
    all of its draws collide, it is the one of the least energy.

    Parameters
    ----------
    body : the character
    n_poses : how many poses to draw
    seed : equal seeds give equal poses, on any number of threads
    job : reports (poses that need no further draw, n_poses); polled between poses

    Returns
    -------
    poses : n_poses + 1 of them in the character's unit, the first its rest pose; rules, groups,
        labels and axis as of a set that is read from the character's file. Its provenance,
        `by_rig`, holds the seed, the poses drawn, how many are free, and the limits.

    Raises
    ------
    ShapeError : n_poses is below 1.
    PoseSetError : a face of the rest pose has no area, or the poses are too many.
    CancelledError : the job was cancelled.
    """
    if n_poses < 1:
        raise ShapeError.must_be("the number of poses by the rig", "1 or more", n_poses)
    n_items = n_poses * body.n_vertices * 3
    if n_items > MAX_ITEMS:
        raise PoseSetError(
            f"would have {n_items} coordinates, at most {MAX_ITEMS} can be read",
            "ask for fewer poses",
            where=body.character.source,
        )
    rest, draws = rest_pose_set(body.character), HumanDraws(body.space)
    generator = np.random.default_rng(seed)
    extents = draws.extents(n_poses, generator)
    tried = np.zeros((len(_DRAWS), n_poses, body.latent_size))
    chosen = np.zeros(n_poses, dtype=np.int64)
    waiting = np.arange(n_poses)
    for number, size in enumerate(_DRAWS):
        tried[number, waiting] = size * extents[waiting] * draws.codes(len(waiting), generator)
        colliding = np.ones(len(waiting), dtype=np.bool_)
        for start in range(0, len(waiting), _AT_ONCE):
            some = slice(start, start + _AT_ONCE)
            vertices = body.decode(tried[number, waiting[some]]).astype(np.float32)
            colliding[some] = body.detector.are_colliding(vertices, job=job.part())
            n_free = int((~colliding).sum())
            job.report(n_poses - len(waiting) + n_free, n_poses)
        chosen[waiting] = number
        waiting = waiting[colliding]
    for start in range(0, len(waiting), _AT_ONCE // _FULL):
        group = waiting[start : start + _AT_ONCE // _FULL]
        vertices = body.decode(tried[:_FULL, group].reshape(-1, body.latent_size)).astype(
            np.float32
        )
        found = body.detector.detect_batch(vertices, counted_only=True, job=job.part())
        energy = found.vertex_energy.sum(axis=1)
        chosen[group] = energy.reshape(_FULL, -1).argmin(axis=0)
        job.report(n_poses - len(waiting) + start + len(group), n_poses)
    codes = tried[chosen, np.arange(n_poses)]
    provenance = {
        "seed": seed,
        "drawn": n_poses,
        "free": n_poses - len(waiting),
        "limits_degrees": draws.limits_in_degrees,
    }
    return replace(
        rest,
        vertices=np.concatenate([rest.vertices, body.decode(codes)]),
        notes=(*rest.notes, *body.space.anatomy.notes),
        names=(*rest.names, *(f"rig {number}" for number in range(1, n_poses + 1))),
        provenance={"by_rig": provenance},
    )


def rest_pose_set(character: Character) -> PoseSet:
    """Return the rest pose of a rigged character, as a set that is read from its file has it.

    Raises
    ------
    LCollisionError : the character has no rig.
    PoseSetError : a face has no area.
    """
    labels = joint_parts(character)
    poses = PoseSet(
        character.rest_vertices[None],
        character.topology,
        (REST,),
        character.source,
        character.notes,
        ContactRules(rest_exclusion=CHARACTER_REST_EXCLUSION),
        character.groups,
        int(np.abs(character.up).argmax()) if character.up_is_sure else None,
        labels,
        metres=character.metres,
    )
    require_usable_reference(poses)
    return poses
