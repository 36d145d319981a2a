"""Small problems with known solutions, for the tests of Resolve."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.problem import CollisionModel, Deadline, ResolveProblem


@dataclass(eq=False)
class HalfSpace:
    """Calls a pose free if normal . Z <= offset; counts the batches."""

    normal: FloatArray
    offset: float
    n_calls: int = field(default=0)

    def logit_and_gradient(self, latent: npt.NDArray) -> tuple[FloatArray, FloatArray]:
        self.n_calls += 1
        return latent @ self.normal - self.offset, np.tile(self.normal, (len(latent), 1))


@dataclass(eq=False)
class Ball:
    """Calls a pose free outside a ball (sign 1) or inside it (sign -1).

    The logit is smooth except at the centre; beyond the distance `plateau` from it, if given, it is
    numerically flat.
    """

    centre: FloatArray
    radius: float
    sign: float = 1.0
    steepness: float = 10.0
    plateau: float = np.inf

    def logit_and_gradient(self, latent: npt.NDArray) -> tuple[FloatArray, FloatArray]:
        offset = latent - self.centre
        distance = np.linalg.norm(offset, axis=1)
        logit = self.sign * self.steepness * (self.radius - distance)
        away = offset / np.maximum(distance, 1e-12)[:, None]
        gradient = -self.sign * self.steepness * away
        gradient[distance > self.plateau] = 0.0
        return logit, gradient


def toy_problem(
    model: CollisionModel,
    target: FloatArray,
    bound: float = 10.0,
    deadline: Deadline | None = None,
    code_weights: FloatArray | None = None,
) -> ResolveProblem:
    """Make the problem with the Euclidean distance, within `bound` of 0."""
    size = len(target)
    return ResolveProblem(
        target=target,
        metric=np.eye(size),
        code_weights=np.ones(size) if code_weights is None else code_weights,
        low=np.full(size, -bound),
        high=np.full(size, bound),
        limit=0.0,
        model=model,
        deadline=deadline or Deadline(),
    )
