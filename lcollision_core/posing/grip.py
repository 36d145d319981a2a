"""What the user takes hold of: a smooth patch round a vertex, and pins that hold such patches."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph

from lcollision_core.errors import LCollisionError
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.pose_space import PoseSpace

GRIP_RADIUS = 0.03
"""The default radius of a patch, in normalised length along the surface."""

LEAST_RADIUS, LARGEST_RADIUS = 0.005, 0.25


@dataclass(frozen=True, eq=False)
class Grip:
    """A patch of the surface; its weighted mean is the point that follows the pointer.

    Attributes
    ----------
    vertex : its middle, an index from 0
    radius : normalised, along the surface
    vertices : (n,) int64 array, ascending
    weights : (n,) float64 array > 0 that sums to 1, falling off along the surface
    """

    vertex: int
    radius: float
    vertices: npt.NDArray[np.int64]
    weights: FloatArray

    @classmethod
    def at(cls, vertex: int) -> Grip:
        """Take one vertex alone."""
        return cls(vertex, 0.0, np.array([vertex]), np.ones(1))

    def position(self, vertices: npt.NDArray[np.floating]) -> FloatArray:
        """Return the (3,) weighted mean of the patch on (V, 3) vertices."""
        mean: FloatArray = self.weights @ vertices[self.vertices].astype(np.float64)
        return mean


@dataclass(frozen=True)
class Twist:
    """A body part that is turned about its long axis.

    Attributes
    ----------
    domain : index from 0
    """

    domain: int


Point = tuple[float, float, float]


@dataclass(frozen=True)
class Pin:
    """A patch that stays in its place while others are dragged.

    Attributes
    ----------
    vertex, radius : of the `Grip`
    position : x, y, z of the patch's mean in the data's unit, in the model's frame
    frame : further vertices of the same body part and their positions, of a pin that keeps the
        orientation too
    """

    vertex: int
    radius: float
    position: Point
    frame: tuple[tuple[int, Point], ...] = ()

    @classmethod
    def of(cls, grip: Grip, vertices: npt.NDArray[np.floating], frame: Iterable[int] = ()) -> Pin:
        """Pin a patch, and further vertices, where (V, 3) vertices, in the data's unit, are."""

        def point(place: FloatArray) -> Point:
            x, y, z = place.tolist()
            return x, y, z

        places = vertices.astype(np.float64)
        others = tuple((int(vertex), point(places[vertex])) for vertex in frame)
        return cls(grip.vertex, grip.radius, point(grip.position(vertices)), others)

    def moved(self, grip: Grip, vertices: npt.NDArray[np.floating]) -> Pin:
        """Return the same pin where (V, 3) vertices have its patch."""
        return Pin.of(grip, vertices, (vertex for vertex, _ in self.frame))

    @property
    def patches(self) -> list[tuple[int, float, Point]]:
        """The vertex, radius and position of all that stays."""
        return [
            (self.vertex, self.radius, self.position),
            *((vertex, LEAST_RADIUS, place) for vertex, place in self.frame),
        ]


def make_grip(space: PoseSpace, vertex: int, radius: float = GRIP_RADIUS) -> Grip:
    """Take the patch round a vertex.

    Parameters
    ----------
    space : of the poses; the patch is the same in all of them, measured on the reference
    vertex : index from 0
    radius : put between `LEAST_RADIUS` and `LARGEST_RADIUS`

    Raises
    ------
    LCollisionError : there is no such vertex.

    Notes
    -----
    A vertex at distance s along the edges weighs (1 - (s / r)^2)^2, the biweight kernel.
    """
    n_vertices = space.topology.n_vertices
    if not 0 <= vertex < n_vertices:
        raise LCollisionError.must_be(
            "the vertex to take hold of", f"0 to {n_vertices - 1}", vertex
        )
    radius = float(np.clip(radius, LEAST_RADIUS, LARGEST_RADIUS))
    along = csgraph.dijkstra(space.surface_graph, directed=False, indices=vertex, limit=radius)
    # A vertex at the rim weighs nothing.
    weights = np.clip(1.0 - (along / radius) ** 2, 0.0, None) ** 2
    inside = np.flatnonzero(weights > 0.0)
    return Grip(vertex, radius, inside, weights[inside] / weights[inside].sum())
