"""Contact rules and clearances applied to one mesh: what the search looks up.

A rule is a field of `meshes.contact_rules.ContactRules`; `kernels.rule_of` decides which applies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.contact.arrays import ClearanceRule, Exclusions, Lists
from lcollision_core.contact.kernels import find_rules
from lcollision_core.contact.reach import (
    Creases,
    faces_near_touching,
    faces_within,
    lists_of,
    no_lists,
    surface_of,
    vertices_after,
    with_pairs,
)
from lcollision_core.errors import ShapeError
from lcollision_core.meshes.contact_rules import TOUCHING_RADIUS, ContactRules
from lcollision_core.meshes.face_groups import FaceGroup, require_groups, without_joints
from lcollision_core.meshes.topology import FloatArray, Topology

Pairs = npt.NDArray[np.integer]

MAX_EXCLUDED = 250_000_000
"""The most pairs of vertices or faces that are listed: 1 GB. 20 000 items have 200 million."""

CREASE = 2.0
"""Distance at rest up to which skin folds onto itself, in limb thicknesses at the joint."""

_MAX_REGIONS = 4096

_SAMPLED = 200
"""Number of faces whose neighbourhoods are measured for the estimate."""

_NEAR, _REST, _TOUCHING = "near exclusion", "rest exclusion", "touching radius"


def exclusions_of(
    rules: ContactRules,
    topology: Topology,
    reference: FloatArray,
    body_size: float,
    touching: Pairs,
    groups: Sequence[FaceGroup] = (),
) -> Exclusions:
    """List the pairs of faces that the rules exclude, before any pose is searched.

    Parameters
    ----------
    reference : (V, 3) float64 array, the rest pose
    body_size : in its unit
    touching : (n, 2) pairs of faces that touch at rest, used if there is a rest exclusion
    groups : the groups that the rules name, those of one name joined, and the faces about each
        joint

    Raises
    ------
    ShapeError : the rules name an unknown group, a group has faces that the mesh lacks, or too
        many pairs are excluded.
    """
    near = rest = no_lists()
    if rules.near_exclusion > 0.0:
        surface, distance = surface_of(topology, reference), rules.near_exclusion * body_size
        creases = _creases(topology, reference, groups) if rules.near_by_limb else None
        near = vertices_after(surface, distance, partial(require_listable, rule=_NEAR), creases)
    if rules.rest_exclusion is not None:
        distance = rules.rest_exclusion * body_size
        rest = _about(topology, reference, touching, distance, _REST)
    return listed_exclusions(near, rest, rules, topology, reference, body_size, groups)


def _creases(
    topology: Topology, reference: FloatArray, groups: Sequence[FaceGroup]
) -> Creases | None:
    """Return the distances over which skin may fold, in the unit of the rest pose.

    The distance is `CREASE` times a limb's thickness at a joint. A vertex of the faces about joints
    gets the least, any other vertex that of the nearest such vertex. Places where limbs branch, as
    between knuckles, are not listed as joints, as no limb bends there. None without joints.
    """
    length = np.full(topology.n_vertices, np.inf)
    middles = reference[topology.faces].mean(axis=1)
    about_joints = [group for group in groups if group.about_joint]
    names = {group.name for group in about_joints}
    # The name of a branch of two limbs joins the names of both joints.
    branches = {name for name in names if ", " in name and names.issuperset(name.split(", ", 1))}
    joints, of_joints = [], []
    for group in about_joints:
        # The faces about a joint lie within the limb's thickness of it.
        about = middles[group.faces]
        middle = about.mean(axis=0)
        length_there = CREASE * float(np.linalg.norm(about - middle, axis=1).max())
        corners = topology.faces[group.faces].ravel()
        length[corners] = np.minimum(length[corners], length_there)
        if group.name not in branches:
            joints.append(middle)
            of_joints.append(length_there)
    reached = np.flatnonzero(np.isfinite(length))
    if not len(reached):
        return None
    _, nearest = scipy.spatial.cKDTree(reference[reached]).query(reference)
    places = np.array(joints).reshape(-1, 3)
    return Creases(reference, length[reached[nearest]], places, np.array(of_joints))


def listed_exclusions(
    near: Lists,
    rest: Lists,
    rules: ContactRules,
    topology: Topology,
    reference: FloatArray,
    body_size: float,
    groups: Sequence[FaceGroup],
) -> Exclusions:
    """Return exclusions with the given lists of near vertices and of faces near contacts at rest.

    Parameters and errors are those of `exclusions_of`.
    """
    n_faces = topology.n_faces
    require_groups(rules, groups, n_faces)
    region, ignored, squared_tolerance = _regions(rules, without_joints(groups), n_faces)
    joints = [group.faces for group in groups if group.about_joint and rules.joint_exclusion]
    touching, shape = (
        _about(topology, reference, _faces_of(patches, n_faces), radius * body_size, _TOUCHING)
        for patches, radius in (
            (rules.touching, rules.touching_radius),
            (rules.shape_touching, TOUCHING_RADIUS),
        )
    )
    return Exclusions(
        topology.faces,
        near,
        rest,
        touching,
        shape,
        lists_of(joints, n_faces) if joints else no_lists(),
        region,
        ignored,
        squared_tolerance,
    )


def _faces_of(patches: Sequence[tuple[int, int]], n_faces: int) -> Pairs:
    """Return (n, 2) faces in the middle of pairs of patches."""
    pairs = np.array(patches, dtype=np.int64).reshape(-1, 2)
    if pairs.max(initial=-1) >= n_faces:
        whose = "of faces of this mesh"
        raise ShapeError.must_be("the pairs of patches that touch", whose, int(pairs.max()))
    return pairs


def _about(
    topology: Topology, reference: FloatArray, pairs: Pairs, distance: float, rule: str
) -> Lists:
    """List for each face the later ones near a partner of a touching face near it."""
    if not len(pairs):
        return no_lists()
    require = partial(require_listable, rule=rule)
    return faces_near_touching(surface_of(topology, reference), pairs, distance, require)


def rules_of(
    exclusions: Exclusions, pairs: Pairs, penetration_depth: FloatArray
) -> npt.NDArray[np.uint8]:
    """Return (n,) the first rule that excludes each pair, `kernels.COUNTED` if none does.

    Parameters
    ----------
    pairs : (n, 2) face indices
    penetration_depth : (n,) normalised
    """
    rule = np.empty(len(pairs), dtype=np.uint8)
    # Faces as the search has them, or the rules would be compiled once more.
    pairs = np.ascontiguousarray(pairs, dtype=np.int32)
    find_rules(pairs, np.asarray(penetration_depth, dtype=np.float64) ** 2, exclusions, rule)
    return rule


def near_pairs_estimate(topology: Topology, reference: FloatArray, distance: float) -> float:
    """Estimate how many pairs of vertices a near exclusion lists, from a sample of faces.

    Parameters
    ----------
    reference : (V, 3) float64 array, the rest pose
    distance : > 0, in its unit
    """
    some = np.linspace(0, topology.n_faces - 1, min(topology.n_faces, _SAMPLED)).astype(np.int32)
    listed = faces_within(
        surface_of(topology, reference), some, distance, partial(require_listable, rule=_NEAR)
    )
    # A closed surface has about half as many vertices as faces.
    n_near = 0.5 * len(listed.entry) / len(some)
    return 0.5 * topology.n_vertices * min(n_near, topology.n_vertices)


def require_listable(n_excluded: int, rule: str) -> None:
    """Raise `ShapeError` if the lists of a rule have more than `MAX_EXCLUDED` pairs."""
    if n_excluded > MAX_EXCLUDED:
        raise ShapeError(
            f"excludes more than {MAX_EXCLUDED} pairs",
            "make it smaller or leave it out",
            where=f"the {rule}",
        )


def _regions(
    rules: ContactRules, groups: Sequence[FaceGroup], n_faces: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.bool_], FloatArray]:
    """Return (F,) regions of faces of the same groups, and the rules of pairs of regions.

    These are (R, R) whether a pair is ignored, and (R, R) the squared depth that it tolerates.
    """
    names, of_all = rules.named_groups, rules.tolerated_depth**2
    if not names:
        nothing = np.zeros((0, 0), dtype=np.bool_)
        return np.empty(0, dtype=np.int32), nothing, np.full((1, 1), of_all)
    is_of = np.zeros((len(names), n_faces), dtype=np.bool_)
    for group in groups:
        if group.name in names:
            is_of[names.index(group.name), group.faces] = True
    region, of_region = regions_of(is_of, "the groups that the rules name")
    table = np.zeros(2 * (of_region.shape[1],), dtype=np.bool_)
    squared = np.full(table.shape, np.inf)

    def both_ways(a: str, b: str) -> npt.NDArray[np.bool_]:
        one_way = np.outer(of_region[names.index(a)], of_region[names.index(b)])
        return np.logical_or(one_way, one_way.T)

    for name in rules.left_out:
        is_left_out = of_region[names.index(name)]
        table[is_left_out] = table[:, is_left_out] = True
    for a, b in rules.ignored:
        table |= both_ways(a, b)
    for a, b, depth in rules.tolerated_pairs:
        np.minimum(squared, depth**2, out=squared, where=both_ways(a, b))
    squared[squared == np.inf] = of_all
    return region, table, squared


def regions_of(
    is_of: npt.NDArray[np.bool_], where: str
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.bool_]]:
    """Return (F,) regions of faces of the same groups, and (N, R) the regions of each group.

    Parameters
    ----------
    is_of : (N, F) whether a face is in a group
    where : names the groups in the error message

    Raises
    ------
    ShapeError : the groups overlap in too many combinations.
    """
    packed, region = np.unique(np.packbits(is_of, axis=0), axis=1, return_inverse=True)
    if packed.shape[1] > _MAX_REGIONS:
        raise ShapeError(
            f"overlap in more than {_MAX_REGIONS} combinations", "name fewer groups", where=where
        )
    of_region = np.unpackbits(packed, axis=0, count=len(is_of)).astype(np.bool_)
    return region.ravel().astype(np.int32), of_region


DISTANCE_BOUND = 0.002
"""Normalised length up to which a verdict looks for the least distance of a pose, or the clearance
if that is larger: a larger bound takes longer, and finds a pair in every pose."""

_ROUNDING = 8.0 * float(np.finfo(np.float32).eps)
"""Share of the largest coordinate at rest: export in float32 moves vertices, so surfaces nearer at
rest than twice that shift of two vertices may touch in the exported rest pose. The body may lie
twice as far out in a pose."""

TouchingGroups = Sequence[tuple[npt.NDArray[np.integer], npt.NDArray[np.integer]]]
"""Pairs of groups of faces, by their numbers."""

JOINED_WITHIN = 4.0
"""Distance along the surface, in clearances, within which skin joins two faces if no rest pose is
known."""


@dataclass(frozen=True, eq=False)
class NearestPair:
    """The two faces of one pose that are nearest to each other.

    Attributes
    ----------
    distance : in normalised length; minus the penetration depth where they penetrate
    faces : (2,) int32
    points : (2, 3) float64, the nearest point on each face, in the unit of the pose; if they
        penetrate, a common point
    """

    distance: float
    faces: npt.NDArray[np.int32]
    points: FloatArray


def require_clearance(clearance: float) -> None:
    """Raise `ShapeError` if a clearance is out of range."""
    if not 0.0 <= clearance < 1.0:
        raise ShapeError.must_be("the clearance", "0 or more and below 1 body size", clearance)


def nearness_of(
    clearance: float,
    topology: Topology,
    reference: FloatArray,
    body_size: float,
    touching: TouchingGroups = (),
    *,
    rest_is_known: bool,
) -> ClearanceRule:
    """Return the distances that a clearance requires of the faces of a mesh.

    Parameters
    ----------
    clearance : > 0, normalised
    reference : (V, 3) float64 array, the rest pose if that is known
    body_size : in its unit
    touching : pairs of groups that may come to distance 0
    """
    rest, joined_start, joined = np.empty((0, 3)), np.zeros(1, np.int64), np.empty(0, np.int32)
    touching_below = 0.0
    if rest_is_known:
        used = reference[topology.faces]
        middle = 0.5 * (used.min(axis=(0, 1)) + used.max(axis=(0, 1)))
        rest = (reference - middle) / body_size
        touching_below = _ROUNDING * float(np.abs(used).max()) / body_size
    else:
        require = partial(require_listable, rule="clearance")
        distance = JOINED_WITHIN * clearance * body_size
        near = vertices_after(surface_of(topology, reference), distance, require)
        joined_start, joined = with_pairs(near, topology.edges)
    region, may_touch = _touching_regions(touching, topology.n_faces)
    return ClearanceRule(
        clearance, topology.faces, rest, touching_below, joined_start, joined, region, may_touch
    )


def _touching_regions(
    touching: TouchingGroups, n_faces: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.bool_]]:
    """Return (F,) regions of faces of the same groups, and (R, R) whether two may touch."""
    if not touching:
        return np.empty(0, dtype=np.int32), np.zeros((0, 0), dtype=np.bool_)
    is_of = np.zeros((2 * len(touching), n_faces), dtype=np.bool_)
    for row, faces in enumerate(side for pair in touching for side in pair):
        is_of[row, faces] = True
    region, of_region = regions_of(is_of, "the groups that may touch")
    one_way = (of_region[::2, :, None] & of_region[1::2, None]).any(axis=0)
    may_touch: npt.NDArray[np.bool_] = np.logical_or(one_way, one_way.T)
    return region, may_touch
