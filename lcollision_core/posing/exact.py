"""The exact check of a pose, and its contacts as linear constraints on the codes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from itertools import chain
from typing import Any

import daqp
import numpy as np
import numpy.typing as npt

from lcollision_core.contact import (
    DEPTH_TOLERANCE,
    DISTANCE_BOUND,
    CollisionDetector,
    NearestPair,
    SelfCollisions,
    depth_slopes,
    distance_slopes,
)
from lcollision_core.contact.kernels import COUNTED
from lcollision_core.devices import uses_gpu
from lcollision_core.files import can_hold
from lcollision_core.meshes import FaceGroup, RigidTransform, Topology
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.pose_space import PosesOnGpu, PoseSpace


def exported_vertices(
    vertices: npt.NDArray[Any], placement: RigidTransform | None = None
) -> npt.NDArray[np.floating]:
    """Return the vertices with which a pose is exported.

    Parameters
    ----------
    vertices : (..., V, 3) array, in the data's unit
    placement : applied to the pose; None for the model's own coordinates

    Returns
    -------
    exported : (..., V, 3) array, float32 as drawn; with a placement, which may be far from the
        origin, moved there in float64
    """
    drawn: npt.NDArray[np.float32] = vertices.astype(np.float32)
    return drawn if placement is None else placement.apply(drawn)


def in_each_format(
    exported: npt.NDArray[np.floating], topology: Topology
) -> list[npt.NDArray[np.floating]]:
    """Return one pose's exported (V, 3) vertices as each format holds them.

    A placed pose is written in float64 and, by formats that hold no more, in float32, if that
    preserves its shape: see `lcollision_core.files.mesh_file`.
    """
    if exported.dtype == np.float32 or not can_hold(exported, topology, np.float32):
        return [exported]
    return [exported, exported.astype(np.float32)]


@lru_cache(maxsize=2)
def _decoder_of(space: Any, body_size: float) -> PosesOnGpu | None:
    """Return a space's decoder; only a few are kept, as each holds tables on the GPU."""
    decoder: PosesOnGpu | None = space.gpu_decoder(body_size)
    return decoder


def colliding_on_gpu(
    detector: CollisionDetector, space: PoseSpace, body_size: float, codes: FloatArray
) -> npt.NDArray[np.bool_] | None:
    """Decode and check (B, D) codes on a GPU, and return which poses collide.

    Parameters
    ----------
    detector : in the data's unit
    space, body_size : decode to float32 vertices in that unit

    Returns
    -------
    colliding : (B,) bool; None if the check is left to the CPU
    """
    if detector.clearance > 0.0 or not uses_gpu(len(codes), space.topology.n_faces):
        return None
    if codes[:, codes.shape[1] - space.n_shapes :].any():
        return None
    posed_space: Any = space
    decoder = _decoder_of(posed_space, body_size)
    if decoder is None:
        return None
    from lcollision_core.on_gpu import GPU_LOCK

    colliding, start = np.zeros(len(codes), dtype=np.bool_), 0
    search = detector.gpu_search()
    while start < len(codes):
        part = slice(start, start + min(decoder.at_once, search.at_once))
        with GPU_LOCK:
            collisions = search.search(
                decoder.decode(codes[part]), first_only=True, uncounted=detector.uncounted_nodes()
            )
            colliding[part] = collisions.n_by_rule.copy_to_host()[:, COUNTED] > 0
        for number in collisions.left:
            vertices = body_size * space.decode(codes[start + number][None])
            colliding[start + number] = detector.are_colliding(vertices.astype(np.float32))[0]
        start = part.stop
    return colliding


@dataclass(frozen=True, eq=False)
class ExactCheck:
    """Decode poses and test them as they are exported; safe to share between threads.

    A pose is free if it is so in each format that can hold it; with a clearance, if no pair that
    counts is nearer than that.

    Attributes
    ----------
    space : decodes the poses; for a frame of a motion, with the body's shape in that frame
    detector : in the data's unit
    body_size : in the data's unit
    placement : applied to exported poses; None for the model's own coordinates
    hidden : faces scaled to nothing, which count in no pair
    """

    space: PoseSpace
    detector: CollisionDetector
    body_size: float
    placement: RigidTransform | None = None
    hidden: npt.NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=np.intp))

    @property
    def clearance(self) -> float:
        """The detector's clearance, normalised; 0 if a pose may touch itself."""
        return self.detector.clearance

    def with_clearance(self, clearance: float) -> ExactCheck:
        """Return the check with a clearance in [0, 1), normalised: see `CollisionDetector`."""
        if clearance == self.clearance:
            return self
        return replace(self, detector=self.detector.with_clearance(clearance))

    def without_pairs(self, domain_pairs: Collection[tuple[int, int]]) -> ExactCheck:
        """Return the check in which pairs of one face from each of two domains do not count."""
        detector, topology = self.detector, self.detector.topology
        domain_of = self.space.vertex_domain[topology.faces[:, 0]]
        name = "domain {} of the check".format
        groups = [
            FaceGroup(name(domain), np.flatnonzero(domain_of == domain))
            for domain in sorted(set(chain(*domain_pairs)))
        ]
        ignored = tuple((name(one), name(other)) for one, other in domain_pairs)
        rules = replace(detector.rules, ignored=detector.rules.ignored + ignored)
        return replace(self, detector=detector.with_rules(rules, (*detector.groups, *groups)))

    @cached_property
    def _seeing(self) -> CollisionDetector:
        return self.detector.without(self.hidden) if len(self.hidden) else self.detector

    def decode(self, latent: npt.ArrayLike) -> FloatArray:
        """Decode (B, D) latent poses to normalised (B, V, 3) vertices, in model coordinates."""
        return self.space.decode(np.atleast_2d(np.asarray(latent)))

    def exported(self, decoded: FloatArray) -> npt.NDArray[np.floating]:
        """Return decoded, normalised (..., V, 3) vertices as they are exported."""
        return exported_vertices(decoded * self.body_size, self.placement)

    def drawn(self, decoded: FloatArray) -> npt.NDArray[np.float32]:
        """Return decoded, normalised (V, 3) vertices as they are drawn, in model coordinates."""
        drawn: npt.NDArray[np.float32] = (decoded * self.body_size).astype(np.float32)
        return drawn

    def are_free(self, latent: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return (B,) whether each of (B, D) latent poses is collision-free."""
        codes = np.atleast_2d(np.asarray(latent))
        free = None
        if self.placement is None and not len(self.hidden):
            free = colliding_on_gpu(self.detector, self.space, self.body_size, codes)
        return self.are_free_meshes(self.exported(self.decode(codes))) if free is None else ~free

    def is_free(self, latent: npt.ArrayLike) -> bool:
        """Return whether one (D,) latent pose is collision-free."""
        return bool(self.are_free(latent)[0])

    def is_free_mesh(self, exported: npt.NDArray[np.floating]) -> bool:
        """Return whether exported (V, 3) vertices are collision-free."""
        return bool(self.are_free_meshes(exported[None])[0])

    def are_free_meshes(self, exported: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
        """Return (B,) whether each pose of exported (B, V, 3) vertices is collision-free."""
        find = partial(self._seeing.are_colliding, workers=1, unit=self._unit)
        free: npt.NDArray[np.bool_] = ~find(exported)
        if exported.dtype != np.float32:
            rounded = [
                number
                for number in np.flatnonzero(free)
                if len(in_each_format(exported[number], self.detector.topology)) > 1
            ]
            free[rounded] = ~find(exported[rounded].astype(np.float32))
        return free

    def find(
        self, exported: npt.NDArray[np.floating], *, counted_only: bool = True
    ) -> SelfCollisions:
        """Find the colliding pairs of exported (V, 3) vertices.

        They are the pairs in float64 if the pose collides there, else those in float32.

        Parameters
        ----------
        counted_only : whether to leave out pairs that a contact rule excludes, which is faster
        """
        for form in in_each_format(exported, self.detector.topology):
            collisions = self._seeing.detect(form, unit=self._unit, counted_only=counted_only)
            if collisions.colliding:
                break
        return collisions

    def collisions(self, latent: FloatArray) -> SelfCollisions:
        """Find the colliding pairs of a (D,) latent pose as it is exported."""
        return self.find(self.exported(self.decode(latent)[0]))

    def collide_between(
        self, start: npt.NDArray[np.floating], end: npt.NDArray[np.floating]
    ) -> bool:
        """Return whether vertices touch on the linear path between two exported poses.

        Both are (V, 3); `start` is free. See `CollisionDetector.collide_between`.
        """
        return self._seeing.collide_between(start, end, unit=self._unit)

    def least_distance(self, exported: npt.NDArray[np.floating]) -> NearestPair | None:
        """Find where exported (V, 3) vertices come nearest to each other.

        Of all formats the nearest pair is returned; None if no pair is nearer than `DISTANCE_BOUND`
        or the clearance, whichever is larger.
        """
        bound = max(DISTANCE_BOUND, self.clearance)
        nearest_pairs = (
            self._seeing.least_distance(form, bound, unit=self._unit)
            for form in in_each_format(exported, self.detector.topology)
        )
        return min(filter(None, nearest_pairs), key=lambda pair: pair.distance, default=None)

    @property
    def _unit(self) -> float:
        return 1.0 if self.placement is None else 1.0 / self.placement.scale


def clearance_slopes(triangles_a: FloatArray, triangles_b: FloatArray) -> FloatArray:
    """Differentiate the distance that pairs of triangles lack of a clearance by their corners.

    Parameters
    ----------
    triangles_a, triangles_b : (P, 3, 3) float64 arrays of corners, normalised

    Returns
    -------
    slopes : (P, 6, 3) float64 array: minus the derivative of the distance where a pair is apart,
        else that of the penetration depth
    """
    _, slopes = depth_slopes(triangles_a, triangles_b)
    distance, by_distance = distance_slopes(triangles_a, triangles_b)
    return np.where((distance > DEPTH_TOLERANCE)[:, None, None], -by_distance, slopes)


def add_slopes(
    by_vertices: FloatArray,
    row_of_pair: npt.NDArray[np.int64],
    faces: npt.NDArray[np.integer],
    decoded: FloatArray,
    weights: FloatArray,
    *,
    has_clearance: bool,
) -> None:
    """Add the slopes of colliding pairs to rows of derivatives by a pose's vertices.

    Parameters
    ----------
    by_vertices : (R, V, 3) float64 array, added to in place
    row_of_pair : (P,) the row of each pair
    faces : (P, 2, 3) vertices of each pair
    decoded : (V, 3) float64 array, normalised
    weights : (P,) factors of the slopes
    has_clearance : whether pairs were found with a clearance, so that slopes are those of the
        distances that they lack
    """
    triangles = decoded[faces[:, 0]], decoded[faces[:, 1]]
    slopes = clearance_slopes(*triangles) if has_clearance else depth_slopes(*triangles)[1]
    places = row_of_pair[:, None], faces.reshape(len(faces), 6)
    np.add.at(by_vertices, places, slopes * weights[:, None, None])


MAX_REGIONS = 6
"""Most contacts of a pose, one for each of the deepest pairs of domains."""

CLEARANCE = 2e-4
"""Gap to which touching surfaces are moved, in normalised length, as the model is linear."""

_OPTIMAL = 1
_TOLERANCE = 1e-9

_STILL = 1e-9
"""Slope by a code, of half a squared normalised distance, up to which the distance is fixed."""


@dataclass(frozen=True, eq=False)
class ContactRegions:
    """The colliding pairs of one pose, grouped by their two body parts.

    Attributes
    ----------
    names : (C,) int64 array, ascending: K a + b for parts a <= b
    of_pair : (P,) int64 array, each pair's index into `names`
    depth : (C,) float64 array > 0, normalised: the mean of a region's depths weighted by their
        squares, which is near the largest depth if one stands out
    squared_depth : (C,) float64 array > 0, the sum of a region's squared depths, normalised
    """

    names: npt.NDArray[np.int64]
    of_pair: npt.NDArray[np.int64]
    depth: FloatArray
    squared_depth: FloatArray

    @classmethod
    def of(cls, space: PoseSpace, collisions: SelfCollisions) -> ContactRegions:
        """Group the pairs of a pose."""
        owner = space.vertex_domain[space.topology.faces[collisions.pairs][:, :, 0]]
        keys = np.sort(owner, axis=1) @ np.array([space.n_domains, 1])
        names, of_pair = np.unique(keys, return_inverse=True)
        depths = collisions.penetration_depth
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
    collisions: SelfCollisions,
    regions: ContactRegions,
    *,
    has_clearance: bool = False,
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Differentiate the depths of a colliding pose's contacts by its codes.

    The slope of a region's depth is the mean of its pairs' slopes, weighted by their squared
    depths.

    Parameters
    ----------
    codes : (D,) float64 array
    decoded : (V, 3) float64 array, the pose's vertices in normalised length
    collisions : the pose's colliding pairs, at least one
    regions : of `collisions`
    has_clearance : whether pairs were found with a clearance, so that some do not penetrate

    Returns
    -------
    deepest : (C,) indices of the deepest regions, at most `MAX_REGIONS`, the deepest first
    slopes : (C, D) float64 array

    Notes
    -----
    A pair's depth is at most the size of its triangles, so this resolves only shallow contact.
    """
    share = collisions.penetration_depth**2 / regions.squared_depth[regions.of_pair]
    deepest = np.argsort(-regions.depth, kind="stable")[:MAX_REGIONS]
    row = np.full(len(regions.names), -1)
    row[deepest] = np.arange(len(deepest))
    of_pair = row[regions.of_pair]
    kept = of_pair >= 0
    by_vertices = np.zeros((len(deepest), *decoded.shape))
    faces = space.topology.faces[collisions.pairs[kept]]
    add_slopes(by_vertices, of_pair[kept], faces, decoded, share[kept], has_clearance=has_clearance)
    return deepest, space.pull_back(codes, by_vertices)


def move_together(
    space: PoseSpace,
    codes: FloatArray,
    decoded: FloatArray,
    faces: npt.NDArray[np.integer],
    movable: npt.NDArray[np.bool_],
) -> bool:
    """Whether none of the movable codes changes the distances between two faces' corners.

    Parameters
    ----------
    codes, decoded : see `contact_slopes`
    faces : (2, 3) vertices of the faces, which share none
    movable : (D,)
    """
    ends = np.array([(a, b) for a in faces[0] for b in faces[1]])
    apart = decoded[ends[:, 0]] - decoded[ends[:, 1]]
    by_vertices = np.zeros((len(ends), *decoded.shape))
    by_vertices[np.arange(len(ends))[:, None], ends] = np.stack([apart, -apart], axis=1)
    slopes = space.pull_back(codes, by_vertices)[:, movable]
    return bool(np.abs(slopes).max(initial=0.0) <= _STILL)


class Contacts:
    """Half-spaces of codes that separate the contacts found so far.

    Parameters
    ----------
    check : decodes poses and finds their contacts

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
        """Add the contacts of (D,) codes; return False if the pose is free."""
        decoded = self._check.decode(codes)[0]
        collisions = self._check.find(self._check.exported(decoded))
        if collisions.colliding:
            self.separate(
                codes, decoded, collisions, ContactRegions.of(self._check.space, collisions)
            )
        return collisions.colliding

    def separate(
        self,
        codes: FloatArray,
        decoded: FloatArray,
        collisions: SelfCollisions,
        regions: ContactRegions,
        allowed: Mapping[int, float] | None = None,
    ) -> None:
        """Add half-spaces in which the deepest contacts of a pose vanish to first order.

        Parameters
        ----------
        codes, decoded, collisions, regions : see `contact_slopes`
        allowed : normalised depths that regions may keep, by their names
        """
        apart = self._check.clearance > 0.0
        deepest, slopes = contact_slopes(
            self._check.space, codes, decoded, collisions, regions, has_clearance=apart
        )
        tolerated = np.full(len(regions.names), np.inf)
        np.minimum.at(
            tolerated, regions.of_pair, self._check.detector.tolerated_depths(collisions.pairs)
        )
        may_keep = np.array(
            [
                (allowed or {}).get(int(regions.names[region]), tolerated[region] - CLEARANCE)
                for region in deepest
            ]
        )
        first_pair = [int((regions.of_pair == region).argmax()) for region in deepest]
        corner = self._check.space.topology.faces[collisions.pairs[first_pair, 0], 0]
        self.normals = np.concatenate([self.normals, slopes])
        offsets = slopes @ codes - regions.depth[deepest] + may_keep
        self.offsets = np.concatenate([self.offsets, offsets])
        self.vertices = np.concatenate([self.vertices, corner])

    def touching(self, codes: FloatArray) -> npt.NDArray[np.int64]:
        """Return the vertices of the contacts that (D,) codes have reached."""
        return self.vertices[self.normals @ codes >= self.offsets - CLEARANCE]

    def drop_violated(self, free: FloatArray) -> None:
        """Drop half-spaces that do not hold a free pose: they were extrapolated too far."""
        self._keep(np.flatnonzero(self.normals @ free <= self.offsets + CLEARANCE))

    def keep_latest(self, most: int) -> None:
        """Drop all but the `most` latest half-spaces."""
        self._keep(np.arange(len(self.offsets))[-most:])

    def _keep(self, kept: npt.NDArray[np.intp]) -> None:
        self.normals, self.offsets = self.normals[kept], self.offsets[kept]
        self.vertices = self.vertices[kept]


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

    Parameters
    ----------
    hessian : (D, D) positive definite float64 array
    gradient : (D,) float64 array
    start : (D,) float64 array between `low` and `high`, which are equal for a locked code
    normals, offsets : (C, D) and (C,) float64 arrays: normals Z <= offsets

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
    # Bounds of the steps come first, then the half-spaces.
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
