"""The contact rules that a body's own poses propose, before anybody has chosen any."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from lcollision_core.bodies.posable_body import PosableBody
from lcollision_core.contact import touching_patches
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import GROUP_KINDS, ContactRules
from lcollision_core.meshes.contact_rules import MAX_TOUCHING, TOUCHING_RADIUS
from lcollision_core.meshes.evenly_spaced import evenly_spaced

_MOST_POSES, _FEWEST_POSES = 40, 8
"""Of a body's poses, evenly spaced, that are looked at, and how many say enough."""

_MOSTLY = 0.5
"""Share of the poses from which a body collides by how it is made."""

_LEAST_GAIN = 0.25
"""Share of the poses that a proposal must free to apply unasked: what collides by its pose does so
without it."""

FacePair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class ProposedRules:
    """Rules by which more of a body's poses are free.

    Attributes
    ----------
    rules : those that apply, with further patches that touch in nearly every pose
    new : the pairs of faces in their middles
    faces : (n,) int32, all faces at these patches
    places : how many of these there are by names of what touches, the most first
    n_poses : poses that were looked at
    n_colliding, n_colliding_then : of these, by the rules that apply and by the proposed ones
    """

    rules: ContactRules
    new: tuple[FacePair, ...]
    faces: npt.NDArray[np.int32]
    places: dict[tuple[str, str], int]
    n_poses: int
    n_colliding: int
    n_colliding_then: int


def typical_poses(body: PosableBody) -> npt.NDArray[np.float64]:
    """Return (n, V, 3) poses of a body: some that it came with, or random ones of a bare rig.

    A rig's rest pose is none of them: what touches there does not count by the rules that it starts
    with, so that of a short clip no place would seem to touch always.
    """
    latent = body.known_poses[0 if body.is_trained else 1 :]
    if len(latent):
        latent = latent[evenly_spaced(len(latent), _MOST_POSES)].astype(np.float64)
    if len(latent) < _FEWEST_POSES and not body.is_trained:
        drawn = body.sample(_MOST_POSES, np.random.default_rng(0))
        latent = np.concatenate([latent, drawn])
    return body.decode(latent)


def propose_rules(
    body: PosableBody,
    job: Job = UNWATCHED,
    poses: npt.NDArray[np.float64] | None = None,
    *,
    unasked: bool = False,
) -> ProposedRules | None:
    """Propose patches not to count where most poses of a body collide.

    They touch in nearly every pose, or are where two pieces do, as an arm and the shield on it.
    What touches so on one side does not count on the other either.

    Parameters
    ----------
    body : not one with a predictor, which depends on its rules
    job : reports (poses looked at, poses in all); polled between poses
    poses : (n, V, 3) that are looked at, by default `typical_poses`
    unasked : whether the rules will apply without anybody's choice: then only those by which a
        quarter of the poses become free, of patches that themselves touch in nearly every pose

    Returns
    -------
    proposed : None where most poses are free, or nothing touches in nearly all of them

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    poses, rules = typical_poses(body) if poses is None else poses, body.rules
    before = int(body.detector.are_colliding(poses, job=job.part()).sum())
    if before <= _MOSTLY * len(poses):
        return None
    # What applies already has a radius of its own.
    radius = rules.touching_radius if rules.touching else TOUCHING_RADIUS
    found = touching_patches(body.detector, poses, radius, job, of_pieces=not unasked)
    new = tuple(dict.fromkeys((*found, *mirrored(body, found))))[
        : MAX_TOUCHING - len(rules.touching)
    ]
    if not new:
        return None
    proposed = replace(rules, touching=(*rules.touching, *new), touching_radius=radius)
    other = body.with_rules(proposed)
    after = int(other.detector.are_colliding(poses, job=job.part()).sum())
    if unasked and before - after < _LEAST_GAIN * len(poses):
        return None
    faces, places = other.detector.touching_faces(), places_of(body, new)
    return ProposedRules(proposed, new, faces, places, len(poses), before, after)


def mirrored(body: PosableBody, pairs: Iterable[FacePair]) -> list[FacePair]:
    """Return the mirror images of pairs of faces, where the body has two sides that are alike.

    A face's image is the one whose middle is nearest to its mirrored own, within a patch's radius.
    """
    symmetry = body.symmetry
    if symmetry is None:
        return []
    middles = body.reference[body.faces].mean(axis=1)
    away, partner = cKDTree(middles).query(symmetry.reflect(middles))
    is_there = away <= TOUCHING_RADIUS * body.body_size
    return [
        (int(min(partner[a], partner[b])), int(max(partner[a], partner[b])))
        for a, b in pairs
        if is_there[a] and is_there[b]
    ]


def places_of(body: PosableBody, pairs: Iterable[FacePair]) -> dict[tuple[str, str], int]:
    """Count pairs of faces by the body parts that they are of, or else by meshes or components.

    The first of these kinds by which the two differ names a pair, as of an arm and its bracer.
    """
    own, parts, components = (body.groups_by_kind[kind] for kind in GROUP_KINDS)
    names = []
    for groups in (parts, own, components):
        name = np.full(body.topology.n_faces, "", dtype=object)
        for group in groups:
            name[group.faces] = group.name
        names.append(name)
    counts: Counter[tuple[str, str]] = Counter()
    for a, b in pairs:
        known = [(name[a], name[b]) for name in names if name[a] and name[b]]
        first, second = next((pair for pair in known if pair[0] != pair[1]), known[0])
        counts[min(first, second), max(first, second)] += 1
    return dict(counts.most_common())
