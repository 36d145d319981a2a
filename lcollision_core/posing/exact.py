"""The exact check of poses: the vertices that a file would hold."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import (
    DISTANCE_BOUND,
    CollisionDetector,
    NearestPair,
    SelfCollisions,
)
from lcollision_core.meshes import RigidTransform, Topology, can_hold
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.pose_space import PoseSpace


def exported_vertices(
    vertices: npt.NDArray[Any], placement: RigidTransform | None = None
) -> npt.NDArray[np.floating]:
    """Return the vertices that a pose is exported with.

    Parameters
    ----------
    vertices : (..., V, 3) array, in the data's unit
    placement : where a decoded pose is exported to; None leaves it where it is

    Returns
    -------
    exported : (..., V, 3) array: as they are drawn, float32; with a placement, which may
        be far from the origin, moved there in float64
    """
    drawn: npt.NDArray[np.float32] = vertices.astype(np.float32)
    return drawn if placement is None else placement.apply(drawn)


def in_each_format(
    exported: npt.NDArray[np.floating], topology: Topology
) -> list[npt.NDArray[np.floating]]:
    """Return one pose's exported (V, 3) vertices as each of the formats holds them.

    A placed pose is written in float64 and, by formats that hold no more, in float32, if that
    preserves its shape: see `lcollision_core.meshes.precision`.
    """
    if exported.dtype == np.float32 or not can_hold(exported, topology, np.float32):
        return [exported]
    return [exported, exported.astype(np.float32)]


@dataclass(frozen=True, eq=False)
class ExactCheck:
    """Decodes poses and tests them as they are exported; safe to share between threads.

    A pose is free when it is in each format that can hold it; with a clearance, when no pair that
    counts is nearer than that.

    Attributes
    ----------
    space : decodes
    detector : in the data's unit
    body_size : in the data's unit
    placement : where a pose is exported to, None for the model's own coordinates
    displacement : (V, 3) or (1, 3) array that is added where it is exported to, in the unit there:
        what the codes of a mesh do not hold of it
    hidden : faces that count in no pair, as they are scaled to nothing
    """

    space: PoseSpace
    detector: CollisionDetector
    body_size: float
    placement: RigidTransform | None = None
    displacement: npt.NDArray[np.floating] | None = None
    hidden: npt.NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=np.intp))

    @property
    def clearance(self) -> float:
        """That of the detector, normalised; 0 where a pose may touch itself."""
        return self.detector.clearance

    def with_clearance(self, clearance: float) -> ExactCheck:
        """Return the check with a clearance in [0, 1), normalised: see `CollisionDetector`."""
        if clearance == self.clearance:
            return self
        return replace(self, detector=self.detector.with_clearance(clearance))

    @cached_property
    def _seeing(self) -> CollisionDetector:
        return self.detector.without(self.hidden) if len(self.hidden) else self.detector

    def decode(self, latent: npt.ArrayLike) -> FloatArray:
        """Decode (B, D) latent poses to (B, V, 3) vertices, normalised, in the model's frame."""
        return self.space.decode(np.atleast_2d(np.asarray(latent)))

    def exported(self, decoded: FloatArray) -> npt.NDArray[np.floating]:
        """Return decoded (..., V, 3) vertices, normalised, as they are exported."""
        placed = exported_vertices(decoded * self.body_size, self.placement)
        return (
            placed if self.displacement is None else placed + self.displacement.astype(placed.dtype)
        )

    @cached_property
    def drawn_displacement(self) -> FloatArray:
        """(V, 3) float64 array: the displacement in the data's unit, in the model's frame."""
        moved, place = self.displacement, self.placement
        shape = self.space.rest_vertices.shape
        if moved is None:
            return np.broadcast_to(0.0, shape)
        turned = moved if place is None else moved @ place.rotation / place.scale
        return np.broadcast_to(turned.astype(np.float64), shape)

    def drawn(self, decoded: FloatArray) -> npt.NDArray[np.float32]:
        """Return decoded (V, 3) vertices, normalised, as they are drawn: in the model's frame."""
        drawn: npt.NDArray[np.float32] = (decoded * self.body_size).astype(np.float32)
        if self.displacement is not None:
            drawn = (drawn + self.drawn_displacement).astype(np.float32)
        return drawn

    def are_free(self, latent: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Tell which of (B, D) latent poses are collision-free: (B,) bool."""
        exported = self.exported(self.decode(latent))
        if self.placement is None:
            return ~self._seeing.are_colliding(exported, workers=1)
        return np.array([self.is_free_mesh(one) for one in exported], dtype=np.bool_)

    def is_free(self, latent: npt.ArrayLike) -> bool:
        """Tell whether one (D,) latent pose is collision-free."""
        return bool(self.are_free(latent)[0])

    def is_free_mesh(self, exported: npt.NDArray[np.floating]) -> bool:
        """Tell whether (V, 3) vertices are free where they are exported to."""
        forms = in_each_format(exported, self.detector.topology)
        return not any(
            self._seeing.are_colliding(form[None], workers=1, unit=self._unit)[0] for form in forms
        )

    def find(
        self, exported: npt.NDArray[np.floating], *, counted_only: bool = True
    ) -> SelfCollisions:
        """Find the colliding pairs of (V, 3) vertices where they are exported to.

        Those in float64 where it collides in that, else those in float32.

        Parameters
        ----------
        counted_only : whether to leave out those that a contact rule excludes, which is faster
        """
        for form in in_each_format(exported, self.detector.topology):
            found = self._seeing.detect(form, unit=self._unit, counted_only=counted_only)
            if found.colliding:
                break
        return found

    def collide_between(
        self, start: npt.NDArray[np.floating], end: npt.NDArray[np.floating]
    ) -> bool:
        """Tell whether vertices touch on the linear path from where they are exported to another.

        Both are (V, 3); `start` is free. See `CollisionDetector.collide_between`.
        """
        return self._seeing.collide_between(start, end, unit=self._unit)

    def least_distance(self, exported: npt.NDArray[np.floating]) -> NearestPair | None:
        """Find where (V, 3) vertices come nearest to each other, where they are exported to.

        In the format in which that is nearest; None where nothing is nearer than `DISTANCE_BOUND`,
        nor than the clearance.
        """
        bound = max(DISTANCE_BOUND, self.clearance)
        found = (
            self._seeing.least_distance(form, bound, unit=self._unit)
            for form in in_each_format(exported, self.detector.topology)
        )
        return min(filter(None, found), key=lambda one: one.distance, default=None)

    @property
    def _unit(self) -> float:
        return 1.0 if self.placement is None else 1.0 / self.placement.scale
