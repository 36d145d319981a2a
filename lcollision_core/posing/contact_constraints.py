"""Contacts of a pose as linear constraints on its codes, and the quadratic programs over them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import daqp
import numpy as np
import numpy.typing as npt

from lcollision_core.contact import SelfCollisions
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.depth_slopes import add_slopes
from lcollision_core.posing.exact import ExactCheck
from lcollision_core.posing.pose_space import PoseSpace

MAX_REGIONS = 6
"""Most contacts of a pose, one for each of the deepest pairs of domains."""

CLEARANCE = 2e-4
"""In normalised length: gap that touching surfaces are moved to, as the model is linear."""

_OPTIMAL = 1
_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class ContactRegions:
    """The colliding pairs of one pose, grouped by the two body parts that they are of.

    Attributes
    ----------
    names : (C,) int64 array, ascending: K a + b for parts a <= b
    of_pair : (P,) int64 array, each pair's index into `names`
    depth : (C,) float64 array > 0: the mean of a region's depths weighted by their squares, so that
        it is the depth of the deepest where one stands out; normalised
    squared_depth : (C,) float64 array > 0, the sum over a region, normalised
    """

    names: npt.NDArray[np.int64]
    of_pair: npt.NDArray[np.int64]
    depth: FloatArray
    squared_depth: FloatArray

    @classmethod
    def of(cls, space: PoseSpace, found: SelfCollisions) -> ContactRegions:
        """Group the pairs of a pose."""
        owner = space.vertex_domain[space.topology.faces[found.pairs][:, :, 0]]
        keys = np.sort(owner, axis=1) @ np.array([space.n_domains, 1])
        names, of_pair = np.unique(keys, return_inverse=True)
        depths = found.penetration_depth
        squared: FloatArray = np.bincount(of_pair, depths**2, minlength=len(names)).astype(
            np.float64
        )
        depth = np.bincount(of_pair, depths**3, minlength=len(names)) / squared
        return cls(names, of_pair, depth, squared)

    def by_name(self) -> dict[int, tuple[float, float]]:
        """Return each region's depth and squared depth."""
        values = zip(self.depth.tolist(), self.squared_depth.tolist(), strict=True)
        return dict(zip(self.names.tolist(), values, strict=True))


def contact_slopes(
    space: PoseSpace,
    codes: FloatArray,
    decoded: FloatArray,
    found: SelfCollisions,
    regions: ContactRegions,
    *,
    may_be_apart: bool = False,
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Measure how the depths of a colliding pose's contacts change with its codes.

    The slope of a region's depth is the mean of its pairs' slopes with the weights of their depths.

    Parameters
    ----------
    codes : (D,) float64 array
    decoded : (V, 3) float64 array, its vertices in normalised length
    found : its colliding pairs, at least one
    regions : of `found`
    may_be_apart : whether pairs were found by a clearance, of which some do not penetrate

    Returns
    -------
    deepest : (C,) the regions that count, the deepest first, at most `MAX_REGIONS`
    slopes : (C, D) float64 array

    Notes
    -----
    A pair's depth is at most the size of its triangles, so this leads out of shallow contact only.
    """
    share = found.penetration_depth**2 / regions.squared_depth[regions.of_pair]
    deepest = np.argsort(-regions.depth, kind="stable")[:MAX_REGIONS]
    by_vertices = np.zeros((len(regions.names), *decoded.shape))
    faces = space.topology.faces[found.pairs]
    add_slopes(by_vertices, regions.of_pair, faces, decoded, share, may_be_apart=may_be_apart)
    return deepest, space.pull_back(codes, by_vertices[deepest])


class Contacts:
    """Half-spaces of codes that separate the contacts seen so far.

    Parameters
    ----------
    check : decodes and finds the contacts

    Attributes
    ----------
    normals, offsets : (C, D) and (C,) float64 arrays: normals Z <= offsets
    vertices : (C,) int64 array, a vertex of each contact
    """

    def __init__(self, check: ExactCheck) -> None:
        self._check = check
        self.normals = np.empty((0, len(check.space.low)))
        self.offsets = np.empty(0)
        self.vertices = np.empty(0, dtype=np.int64)

    def add(self, codes: FloatArray) -> bool:
        """Add the contacts of (D,) codes; False if the pose is free and has none."""
        decoded = self._check.decode(codes)[0]
        found = self._check.find(self._check.exported(decoded))
        if found.colliding:
            self.separate(codes, decoded, found, ContactRegions.of(self._check.space, found))
        return found.colliding

    def separate(
        self,
        codes: FloatArray,
        decoded: FloatArray,
        found: SelfCollisions,
        regions: ContactRegions,
        allowed: Mapping[int, float] | None = None,
    ) -> None:
        """Add half-spaces in which the deepest contacts of a pose are gone, to first order.

        Parameters
        ----------
        codes, decoded, found, regions : see `contact_slopes`
        allowed : depths that regions may keep, normalised, by their names
        """
        apart = self._check.clearance > 0.0
        deepest, slopes = contact_slopes(
            self._check.space, codes, decoded, found, regions, may_be_apart=apart
        )
        tolerated = np.full(len(regions.names), np.inf)
        np.minimum.at(
            tolerated, regions.of_pair, self._check.detector.tolerated_depths(found.pairs)
        )
        may_keep = np.array(
            [
                (allowed or {}).get(int(regions.names[region]), tolerated[region] - CLEARANCE)
                for region in deepest
            ]
        )
        first_pair = [int((regions.of_pair == region).argmax()) for region in deepest]
        corner = self._check.space.topology.faces[found.pairs[first_pair, 0], 0]
        self.normals = np.concatenate([self.normals, slopes])
        offsets = slopes @ codes - regions.depth[deepest] + may_keep
        self.offsets = np.concatenate([self.offsets, offsets])
        self.vertices = np.concatenate([self.vertices, corner])

    def touching(self, codes: FloatArray) -> npt.NDArray[np.int64]:
        """Return the vertices of the contacts that (D,) codes have reached."""
        return self.vertices[self.normals @ codes >= self.offsets - CLEARANCE]

    def drop_refuted(self, free: FloatArray) -> None:
        """Forget half-spaces that a free pose lies outside: they were extrapolated too far."""
        self._keep(np.flatnonzero(self.normals @ free <= self.offsets + CLEARANCE))

    def keep_latest(self, most: int) -> None:
        """Forget all half-spaces but so many, those that were added last."""
        self._keep(np.arange(len(self.offsets))[-most:])

    def _keep(self, kept: npt.NDArray[np.intp]) -> None:
        self.normals, self.offsets = self.normals[kept], self.offsets[kept]
        self.vertices = self.vertices[kept]


def nearest_within(
    metric: FloatArray,
    centre: FloatArray,
    low: FloatArray,
    high: FloatArray,
    normals: FloatArray,
    offsets: FloatArray,
) -> FloatArray | None:
    """Minimise (Z - centre)^T metric (Z - centre) in half-spaces and bounds.

    Parameters
    ----------
    metric : (D, D) positive definite float64 array
    centre : (D,) float64 array between `low` and `high`, which are equal where a code is locked
    normals, offsets : (C, D) and (C,) float64 arrays: normals Z <= offsets

    Returns
    -------
    codes : (D,) float64 array, or None if the half-spaces have no point in common
    """
    return least_step(metric, np.zeros_like(centre), centre, low, high, normals, offsets)


def least_step(
    hessian: FloatArray,
    gradient: FloatArray,
    start: FloatArray,
    low: FloatArray,
    high: FloatArray,
    normals: FloatArray,
    offsets: FloatArray,
) -> FloatArray | None:
    """Minimise d^T hessian d / 2 + gradient^T d for codes start + d in half-spaces and bounds.

    Parameters are those of `nearest_within`, and `gradient` (D,).

    Returns
    -------
    codes : (D,) float64 array start + d, or None if the half-spaces have no point in common

    Notes
    -----
    Dual active sets: Arnström, Bemporad and Axehill, "A dual active-set solver for embedded
    quadratic programming using recursive LDL^T updates", 2022.
    """
    movable = np.flatnonzero(high > low)
    if len(movable) == 0:
        return start.copy() if (normals @ start <= offsets).all() else None
    quadratic = hessian[np.ix_(movable, movable)]
    scale = len(quadratic) / np.trace(quadratic)
    # The bounds of the moves come first, then the half-spaces.
    most = np.concatenate([(high - start)[movable], offsets - normals @ start])
    least = np.concatenate([(low - start)[movable], np.full(len(normals), -np.inf)])
    moved, _, status, _ = daqp.solve(
        quadratic * scale,
        gradient[movable] * scale,
        np.ascontiguousarray(normals[:, movable]),
        most,
        least,
        primal_tol=_TOLERANCE,
    )
    if status != _OPTIMAL:
        return None
    codes = start.copy()
    codes[movable] += moved
    return np.clip(codes, low, high)
