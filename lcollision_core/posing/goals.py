"""What a drag wants of a pose, as a quadratic model of its cost about where the pose is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.grip import Grip
from lcollision_core.posing.parts import long_axis
from lcollision_core.posing.pose_space import PoseSpace

PIN_WEIGHT = 100.0
"""Of the squared drift of a pin, against the squared miss of the grip."""

STRETCH_WEIGHT = 0.01
"""Of the sum of squares by which edges are longer than in any plausible pose, likewise."""

Held = Sequence[tuple[Grip, FloatArray]]
"""Patches that stay, each with the (3,) normalised place of its mean."""


class Decoded(NamedTuple):
    """A pose and its mesh.

    Attributes
    ----------
    codes : (D,) float64 array
    vertices : (V, 3) float64 array, in normalised length
    """

    codes: FloatArray
    vertices: FloatArray


class Goal(Protocol):
    """A goal of the poses of one drag; lengths are normalised.

    Attributes
    ----------
    reach : the most of the miss that one step aims at
    longest_step : of one step the most of the root of the mean squared vertex displacement, as one
        quadratic models the cost only so far
    """

    reach: float
    longest_step: float

    def miss(self, pose: Decoded, target: FloatArray) -> float:
        """Measure what is left to a target."""

    def cost(self, pose: Decoded, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the (D, D) hessian and (D,) gradient of half the squared miss by the codes."""


class PatchGoal:
    """A patch's mean goes to a point; other patches stay.

    Parameters
    ----------
    space : of the poses
    grip : the patch
    pins : that stay
    strength : of the price of stretched edges
    """

    reach, longest_step = 0.012, 0.01

    def __init__(self, space: PoseSpace, grip: Grip, pins: Held, strength: float) -> None:
        self._space, self._pins, self._grip, self._strength = space, pins, grip, strength
        self._rows = _rows(space, [grip, *(pin for pin, _ in pins)])

    def miss(self, pose: Decoded, target: FloatArray) -> float:
        """Measure the distance to the target."""
        return float(np.linalg.norm(target - self._grip.position(pose.vertices)))

    def cost(self, pose: Decoded, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Goal.cost`."""
        way = _shortened(target - self._grip.position(pose.vertices), self.reach)
        return _squares(
            self._space, pose, self._rows, [way, *_drifts(self._pins, pose)], self._strength
        )


class TwistGoal:
    """A body part turns about its long axis by an angle; its middle and pinned patches stay.

    Parameters
    ----------
    space : of the poses
    domain : the body part
    pins : that stay
    strength : of the price of stretched edges
    decoded : (V, 3) float64 array, the vertices at the drag's start
    """

    reach, longest_step = 0.25, 0.01

    def __init__(
        self, space: PoseSpace, domain: int, pins: Held, strength: float, decoded: FloatArray
    ) -> None:
        inside = np.flatnonzero(space.vertex_domain == domain)
        self._part = Grip(int(inside[0]), 0.0, inside, np.full(len(inside), 1.0 / len(inside)))
        self._space, self._strength = space, strength
        self._pins = [(self._part, self._part.position(decoded)), *pins]
        self._rows = _rows(space, [pin for pin, _ in self._pins])
        self._arms = self._arms_of(decoded)
        self.axis = long_axis(self._arms)

    def _arms_of(self, decoded: FloatArray) -> FloatArray:
        arms: FloatArray = decoded[self._part.vertices] - self._part.position(decoded)
        return arms

    def _angle(self, arms: FloatArray) -> float:
        """Return by which angle the part has turned about the axis since the start."""
        before, now = (np.cross(self.axis, one) for one in (self._arms, arms))
        return float(
            np.arctan2((np.cross(self._arms, arms) @ self.axis).sum(), (before * now).sum())
        )

    def miss(self, pose: Decoded, target: FloatArray) -> float:
        """Measure the angle that is left, in radians."""
        return abs(float(target[0]) - self._angle(self._arms_of(pose.vertices)))

    def cost(self, pose: Decoded, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Goal.cost`; the miss is the way of a vertex at the part's mean distance."""
        arms = self._arms_of(pose.vertices)
        across = np.cross(self.axis, arms)
        radius = np.sqrt((across**2).sum() / len(arms))
        left = float(target[0]) - self._angle(arms)
        # The turn: the mean of the motions across the axis.
        turn = np.zeros((1, *pose.vertices.shape))
        turn[0, self._part.vertices] = across / (radius * len(arms))
        way = np.array([radius * np.clip(left, -self.reach, self.reach)])
        rows = np.concatenate([turn, self._rows])
        return _squares(self._space, pose, rows, [way, *_drifts(self._pins, pose)], self._strength)


class CodesGoal:
    """The codes go to others; those that the target leaves as they were at the start stay.

    Parameters
    ----------
    space : of the poses
    """

    reach = longest_step = 0.02

    def __init__(self, space: PoseSpace) -> None:
        self._space = space

    def miss(self, pose: Decoded, target: FloatArray) -> float:
        """Measure the root of the mean squared vertex displacement that is left, roughly."""
        way = target - pose.codes
        return float(np.sqrt(way @ self._space.metric @ way))

    def cost(self, pose: Decoded, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Goal.cost`."""
        miss = self.miss(pose, target)
        way = (target - pose.codes) * min(1.0, self.reach / max(miss, self.reach))
        return self._space.metric, -(self._space.metric @ way)


def _rows(space: PoseSpace, patches: Sequence[Grip]) -> FloatArray:
    """Return the (3 n, V, 3) derivatives of n patches' means by the vertices."""
    rows = np.zeros((len(patches), 3, space.topology.n_vertices, 3))
    for row, patch in zip(rows, patches, strict=True):
        for axis in range(3):
            row[axis, patch.vertices, axis] = patch.weights
    return rows.reshape(-1, *rows.shape[2:])


def _drifts(pins: Held, pose: Decoded) -> list[FloatArray]:
    return [_shortened(place - pin.position(pose.vertices), PatchGoal.reach) for pin, place in pins]


def _shortened(way: FloatArray, most: float) -> FloatArray:
    length = float(np.linalg.norm(way))
    return way if length <= most else way * (most / length)


def _squares(
    space: PoseSpace,
    pose: Decoded,
    by_vertices: FloatArray,
    ways: Sequence[FloatArray],
    strength: float,
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton of half the squared ways that are left, the grip's and then the pins'.

    The excess stretch of the edges is one more of them.
    """
    excess, slope = _excess_stretch(space, pose.vertices)
    rows = space.pull_back(pose.codes, np.concatenate([by_vertices, slope[None]]))
    weights = np.full(len(rows), PIN_WEIGHT)
    weights[: len(ways[0])] = 1.0
    weights[-1] = STRETCH_WEIGHT * strength
    weighted = rows * weights[:, None]
    return weighted.T @ rows, -(np.concatenate([*ways, [-excess]]) @ weighted)


def largest_stretch(space: PoseSpace, vertices: FloatArray) -> float:
    """Return the largest ratio of an edge to its longest length in plausible poses."""
    lengths = space.topology.edge_lengths(vertices)
    return float((lengths / space.longest_edges).max())


def _excess_stretch(space: PoseSpace, vertices: FloatArray) -> tuple[float, FloatArray]:
    """Return the root of the sum of squares of what edges are stretched beyond 1, and its slope.

    Returns
    -------
    excess : 0 or more
    slope : (V, 3) float64 array, by the vertices
    """
    start, end = space.topology.edges.T
    along = vertices[end] - vertices[start]
    longest = space.longest_edges
    lengths = np.linalg.norm(along, axis=1)
    over = np.flatnonzero(lengths > longest)
    beyond = lengths[over] / longest[over] - 1.0
    excess = float(np.linalg.norm(beyond))
    slope = np.zeros_like(vertices)
    if excess > 0.0:
        by_end = along[over] * (beyond / (excess * lengths[over] * longest[over]))[:, None]
        np.add.at(slope, end[over], by_end)
        np.subtract.at(slope, start[over], by_end)
    return excess, slope
