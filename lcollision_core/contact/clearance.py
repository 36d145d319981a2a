"""The distance that a clearance requires of two faces of one mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from lcollision_core.contact.arrays import ClearanceRule
from lcollision_core.contact.exclusions import regions_of, require_listable
from lcollision_core.contact.reach import surface_of, vertices_after, with_pairs
from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import FloatArray, Topology

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
