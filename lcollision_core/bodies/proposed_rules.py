"""Contact rules proposed because most of a body's typical poses collide."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.bodies.body import Body
from lcollision_core.contact import touching_patches
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import GROUP_KINDS, ContactRules
from lcollision_core.meshes.contact_rules import MAX_TOUCHING, TOUCHING_RADIUS
from lcollision_core.meshes.topology import evenly_spaced

_MOST_POSES, _FEWEST_POSES = 40, 8
"""Most poses of a body that are checked, evenly spaced; and how many of them suffice."""

_MOSTLY = 0.5
"""Share of colliding poses above which collisions are attributed to the body's construction."""

_LEAST_GAIN = 0.25
"""Share of the poses that a proposal must free to apply unasked: collisions that depend on the
pose do not count."""

FacePair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class ProposedRules:
    """Rules that free more of a body's poses.

    Attributes
    ----------
    rules : the present ones, with further patches that touch in nearly every pose
    new : the face pairs at the patches' centres
    faces : (n,) int32, all faces of these patches
    places : number of these pairs by the names of the touching parts, largest first
    n_poses : number of poses checked
    n_colliding, n_colliding_then : colliding ones by the present and by the proposed rules
    """

    rules: ContactRules
    new: tuple[FacePair, ...]
    faces: npt.NDArray[np.int32]
    places: dict[tuple[str, str], int]
    n_poses: int
    n_colliding: int
    n_colliding_then: int


def typical_poses(body: Body) -> npt.NDArray[np.float64]:
    """Return (n, V, 3) poses of a body: some that came with it, or random ones of a bare rig.

    A rig's rest pose is left out: its initial rules exclude contacts at rest, so that in a short
    clip no place would seem to touch always.
    """
    latent = body.known_poses[0 if body.is_trained else 1 :]
    if len(latent):
        latent = latent[evenly_spaced(len(latent), _MOST_POSES)].astype(np.float64)
    if len(latent) < _FEWEST_POSES and not body.is_trained:
        drawn = body.sample(_MOST_POSES, np.random.default_rng(0))
        latent = np.concatenate([latent, drawn])
    return body.decode(latent)


def propose_rules(
    body: Body,
    job: Job = UNWATCHED,
    poses: npt.NDArray[np.float64] | None = None,
    *,
    unasked: bool = False,
) -> ProposedRules | None:
    """Propose patches to exclude if most poses of a body collide.

    They touch in nearly every pose, or lie where two pieces do, such as an arm and its shield.
    Their mirror images are excluded too.

    Parameters
    ----------
    body : one without a predictor, as that depends on the rules
    job : reports (poses checked, all poses); polled between poses
    poses : (n, V, 3) poses to check, by default `typical_poses`
    unasked : whether the rules apply without the user's choice: then only patches that
        themselves touch in nearly every pose, and only if they free a quarter of the poses

    Returns
    -------
    proposed : None if most poses are free, or no patch touches in nearly all of them

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    poses, rules = typical_poses(body) if poses is None else poses, body.rules
    before = int(body.detector.are_colliding(poses, job=job.part()).sum())
    if before <= _MOSTLY * len(poses):
        return None
    # Existing patches already have a radius.
    radius = rules.touching_radius if rules.touching else TOUCHING_RADIUS
    patches = touching_patches(body.detector, poses, radius, job, of_pieces=not unasked)
    new = tuple(dict.fromkeys((*patches, *mirrored(body, patches))))[
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


def mirrored(body: Body, pairs: Iterable[FacePair]) -> list[FacePair]:
    """Return the mirror images of pairs of faces, if the body is symmetric.

    A face's image is the one whose centre is nearest to its mirrored centre, within a patch radius.
    """
    symmetry = body.symmetry
    if symmetry is None:
        return []
    middles = body.reference[body.faces].mean(axis=1)
    away, partner = scipy.spatial.cKDTree(middles).query(symmetry.reflect(middles))
    is_there = away <= TOUCHING_RADIUS * body.body_size
    return [
        (int(min(partner[a], partner[b])), int(max(partner[a], partner[b])))
        for a, b in pairs
        if is_there[a] and is_there[b]
    ]


def places_of(body: Body, pairs: Iterable[FacePair]) -> dict[tuple[str, str], int]:
    """Count pairs of faces by the names of their body parts, meshes or, without either, components.

    Meshes name two faces of one body part if they differ, such as an arm and its bracer.
    """
    file_groups, parts, components = (body.groups_by_kind[kind] for kind in GROUP_KINDS)
    names = []
    for groups in (parts, file_groups, components):
        name = np.full(body.topology.n_faces, "", dtype=object)
        for group in groups:
            name[group.faces] = group.name
        names.append(name)
    counts: Counter[tuple[str, str]] = Counter()
    for a, b in pairs:
        named_pairs = [(name[a], name[b]) for name in names if name[a] and name[b]]
        # Components have numbers for names, which say less than one body part does.
        distinct = (pair for pair in named_pairs[:-1] if pair[0] != pair[1])
        first, second = next(distinct, named_pairs[0])
        counts[min(first, second), max(first, second)] += 1
    return dict(counts.most_common())
