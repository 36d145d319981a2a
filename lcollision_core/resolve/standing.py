"""What stands on the ground in a pose stays there when its collisions are resolved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import DragOptions, ExactCheck, Grip, PoseDragger
from lcollision_core.resolve.problem import ResolveProblem

_DRAGS, _MOST_EVENTS = 6, 20
"""Drags of one vertex each, and events of one."""

_NEAR = 0.002
"""Normalised length: what is that near to its place is there."""


@dataclass(frozen=True, eq=False)
class Standing:
    """What stands on the ground in a pose.

    Attributes
    ----------
    up : (3,) unit vector
    points : (n,) int64 array, vertices that stand and are far apart, of each limb some
    decoded : (V, 3) float64 array, the pose's vertices in normalised length
    """

    up: FloatArray
    points: npt.NDArray[np.int64]
    decoded: FloatArray

    @classmethod
    def of(cls, check: ExactCheck, latent: FloatArray, up: FloatArray) -> Standing:
        """Find what stands in a (D,) pose: the ends of limbs at the height of the lowest point."""
        decoded, limbs = check.decode(latent)[0], check.space.limbs
        stands = limbs.standing(decoded, up, limbs.root).values()
        points = np.concatenate([*stands, np.empty(0)]).astype(np.int64)
        return cls(up, points, decoded)

    def domains(self, check: ExactCheck) -> frozenset[int]:
        """Return the body parts that stand."""
        return frozenset(check.space.vertex_domain[self.points].tolist())

    def put_back(
        self,
        check: ExactCheck,
        problem: ResolveProblem,
        free: FloatArray,
    ) -> FloatArray:
        """Bring what stood back to the ground, and what sank below it.

        The body is moved as a whole, then limbs are dragged; at last it is lifted by what is below
        the ground yet.

        Parameters
        ----------
        check, problem : of the pose that this is of; codes that the problem locks stay
        free : (D,) float64 array, collision-free

        Returns
        -------
        latent : (D,) float64 array, collision-free; the same where nothing stood, or the body has
            no place of its own

        Raises
        ------
        CancelledError : the problem's token was set.
        """
        if not check.space.limbs.is_relative or not len(self.points):
            return free
        away = (self.decoded - check.decode(free)[0])[self.points]
        latent = _shifted(check, problem, free, away.mean(axis=0))
        dragger = PoseDragger(check, self.up)
        locked = frozenset(np.flatnonzero(~problem.movable).tolist())
        options = DragOptions(locked_codes=locked, clearance=check.clearance, strength=0.0)
        for _ in range(_DRAGS):
            vertex, place = self._farthest(check.decode(latent)[0])
            if vertex < 0:
                break
            step = dragger.begin(latent, Grip.at(vertex), options=options)
            for _ in range(_MOST_EVENTS):
                problem.deadline.poll()
                step = dragger.move(place * check.body_size)
                if step.settled or problem.deadline.expired:
                    break
            latent = step.latent.copy()
        below = self._ground - float((check.decode(latent)[0] @ self.up).min())
        return _shifted(check, problem, latent, max(0.0, below) * self.up)

    @property
    def _ground(self) -> float:
        return float((self.decoded @ self.up).min())

    def _farthest(self, decoded: FloatArray) -> tuple[int, FloatArray]:
        """Return the vertex that is farthest from where it is to be, and that place; -1 for none.

        Of those that stood and of the lowest one, if that is below the ground.
        """
        heights = decoded @ self.up
        lowest = int(heights.argmin())
        chosen = np.append(self.points, lowest)
        raised = decoded[lowest] + max(0.0, self._ground - heights[lowest]) * self.up
        places = np.concatenate([self.decoded[self.points], raised[None]])
        away = np.linalg.norm(places - decoded[chosen], axis=1)
        first = int(away.argmax())
        return (int(chosen[first]) if away[first] > _NEAR else -1), places[first]


def _shifted(
    check: ExactCheck, problem: ResolveProblem, free: FloatArray, way: FloatArray
) -> FloatArray:
    """Move a free pose as a whole, unless rounding brings what touches into each other."""
    moved = np.clip(check.space.shifted(free, way), problem.low, problem.high)
    return moved if check.is_free(moved) else free
