"""First-order displacement of the vertices of each body part by changes of codes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray

_STIFFENING = 1e-3
"""Added to the diagonal, relative to its mean, so that codes that move no vertex have a cost."""


@dataclass(frozen=True, eq=False)
class DisplacementMetrics:
    """The mean squared vertex displacement by a small change of D codes, part by part.

    Attributes
    ----------
    size : D
    codes : for each of K parts, the (n,) codes that move its vertices
    blocks : for each part, an (n, n) float64 array J_k^T J_k / V, where J_k is the Jacobian of its
        vertices by these codes; V counts the vertices of all parts
    """

    size: int
    codes: Sequence[npt.NDArray[np.intp]]
    blocks: Sequence[FloatArray]

    def squared(self, moved: FloatArray) -> FloatArray:
        """Return the (K,) contributions of the parts to the mean squared displacement."""
        return np.array(
            [
                moved[codes] @ block @ moved[codes]
                for codes, block in zip(self.codes, self.blocks, strict=True)
            ]
        )

    def weighted(self, weights: FloatArray) -> FloatArray:
        """Return the (D, D) sum of the parts' metrics with (K,) weights."""
        total = np.zeros((self.size, self.size))
        for weight, codes, block in zip(weights, self.codes, self.blocks, strict=True):
            if len(codes) == self.size:
                total += weight * block
            else:
                total[codes[:, None], codes] += weight * block
        return total

    @cached_property
    def definite(self) -> FloatArray:
        """The (D, D) sum of all metrics, made positive definite by a small diagonal term."""
        total = self.weighted(np.ones(len(self.blocks)))
        total[np.diag_indices_from(total)] += _STIFFENING * np.trace(total) / len(total)
        return total
