"""What a drag wants of a pose, as a quadratic model of its cost about where the pose is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from scipy.sparse import csr_matrix

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.grip import Grip
from lcollision_core.posing.parts import long_axis
from lcollision_core.posing.pose_space import MeanSlopes, PoseSpace
from lcollision_core.posing.stretch import excess_stretch

PIN_WEIGHT = 100.0
"""Of the squared drift of a pin, against the squared miss of the grip."""

STRETCH_WEIGHT = 0.01
"""Of the sum of squares by which edges are longer than in any plausible pose, likewise."""

STANDING_WEIGHT = 10.0
"""Likewise of each point of what stands on the ground."""


class Held(NamedTuple):
    """A patch that stays.

    Attributes
    ----------
    grip : the patch
    place : (3,) float64 array, normalised, of its mean
    weight : of the squared drift
    """

    grip: Grip
    place: FloatArray
    weight: float = PIN_WEIGHT


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
    price : factor of the price of what moves, see `PoseSpace.price`
    """

    reach: float
    longest_step: float
    price: float

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

    Attributes
    ----------
    grip : the patch
    """

    reach, longest_step, price = 0.012, 0.01, 1.0

    def __init__(self, space: PoseSpace, grip: Grip, pins: Sequence[Held], strength: float) -> None:
        self._space, self._pins, self.grip, self._strength = space, pins, grip, strength
        self._means = _mean_slopes(space, [grip, *(pin.grip for pin in pins)])
        self._weights = np.repeat([1.0, *(pin.weight for pin in pins)], 3)

    def miss(self, pose: Decoded, target: FloatArray) -> float:
        """Measure the distance to the target."""
        return float(np.linalg.norm(target - self.grip.position(pose.vertices)))

    def cost(self, pose: Decoded, target: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Goal.cost`."""
        way = _shortened(target - self.grip.position(pose.vertices), self.reach)
        ways = np.concatenate([way, *_drifts(self._pins, pose)])
        return _squares(self._space, pose, self._means, ways, self._weights, self._strength)


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

    reach, longest_step, price = 0.25, 0.01, 0.01

    def __init__(
        self,
        space: PoseSpace,
        domain: int,
        pins: Sequence[Held],
        strength: float,
        decoded: FloatArray,
    ) -> None:
        inside = np.flatnonzero(space.vertex_domain == domain)
        self._part = Grip(int(inside[0]), 0.0, inside, np.full(len(inside), 1.0 / len(inside)))
        self._space, self._strength = space, strength
        self._pins = [Held(self._part, self._part.position(decoded)), *pins]
        self._means = _mean_slopes(space, [pin.grip for pin in self._pins])
        self._weights = np.append(np.repeat([pin.weight for pin in self._pins], 3), 1.0)
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
        turn = np.zeros_like(pose.vertices)
        turn[self._part.vertices] = across / (radius * len(arms))
        way = np.array([radius * np.clip(left, -self.reach, self.reach)])
        ways = np.concatenate([*_drifts(self._pins, pose), way])
        return _squares(self._space, pose, self._means, ways, self._weights, self._strength, turn)


class CodesGoal:
    """The codes go to others; those that the target leaves as they were at the start stay.

    Parameters
    ----------
    space : of the poses
    """

    reach = longest_step = 0.02
    price = 0.0

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


def _mean_slopes(space: PoseSpace, patches: Sequence[Grip]) -> MeanSlopes:
    """Solve once for the means of all patches that a drag moves or holds."""
    weights = np.concatenate([patch.weights for patch in patches])
    vertices = np.concatenate([patch.vertices for patch in patches])
    ends = np.cumsum([0, *(len(patch.vertices) for patch in patches)])
    shape = (len(patches), space.topology.n_vertices)
    return space.mean_slopes(csr_matrix((weights, vertices, ends), shape=shape))


def _drifts(pins: Sequence[Held], pose: Decoded) -> list[FloatArray]:
    return [
        _shortened(pin.place - pin.grip.position(pose.vertices), PatchGoal.reach) for pin in pins
    ]


def _shortened(way: FloatArray, most: float) -> FloatArray:
    length = float(np.linalg.norm(way))
    return way if length <= most else way * (most / length)


def _squares(
    space: PoseSpace,
    pose: Decoded,
    means: MeanSlopes,
    ways: FloatArray,
    weights: FloatArray,
    strength: float,
    *others: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton of half the weighted squares of the (r,) ways that are left.

    They are of the means, then of what has the (V, 3) derivatives `others`. The excess stretch of
    the edges is one more of them.
    """
    slope = np.empty_like(pose.vertices)
    excess = excess_stretch(pose.vertices, space.topology.edges, space.longest_edges, slope)
    if strength * excess > 0.0:
        others = (*others, slope)
        ways = np.append(ways, -excess)
        weights = np.append(weights, STRETCH_WEIGHT * strength)
    rows = means(pose.codes, np.array(others).reshape(-1, *pose.vertices.shape))
    weighted = rows * weights[:, None]
    return weighted.T @ rows, -(ways @ weighted)
