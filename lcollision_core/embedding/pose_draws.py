"""Poses like those that people make, drawn from poses that are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from lcollision_core.meshes.topology import FloatArray

Uniform = Callable[[tuple[int, int]], FloatArray]
"""Returns so many rows and columns of numbers in [0, 1)."""

_BLENDED = 3
"""Known poses in a blend."""

_NOISE = 0.1
"""Largest standard deviation of the noise that is added to a blend, as a share of the box."""


@dataclass(frozen=True, eq=False)
class PoseDraws:
    """Draws latent poses from N known ones, with random numbers of the caller's.

    Attributes
    ----------
    known : (N, D) float64 array, N > 0
    part_of_code : (D,) integers, the body part that each code belongs to
    low, high : (D,) float64 arrays, the latent box
    """

    known: FloatArray
    part_of_code: npt.NDArray[np.intp]
    low: FloatArray
    high: FloatArray

    def blends(self, n_poses: int, uniform: Uniform) -> FloatArray:
        """Blend three known poses each: (n_poses, D), weights uniform on the simplex."""
        chosen = self._chosen(uniform((n_poses, _BLENDED)))
        weights = -np.log1p(-uniform((n_poses, _BLENDED)))
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        blended: FloatArray = np.einsum("ni,nid->nd", weights, self.known[chosen])
        return blended

    def noisy_blends(self, n_poses: int, uniform: Uniform) -> FloatArray:
        """Blend known poses and add normal noise of a random size: (n_poses, D), in the box."""
        blended = self.blends(n_poses, uniform)
        # The middle of one of 2**53 intervals: a 0 would become minus infinity.
        noise = ndtri(uniform(blended.shape) + 2.0**-54)
        size = _NOISE * uniform((n_poses, 1)) * (self.high - self.low)
        noisy: FloatArray = np.clip(blended + size * noise, self.low, self.high)
        return noisy

    def mixed_parts(self, n_poses: int, uniform: Uniform) -> FloatArray:
        """Take each body part from another known pose: (n_poses, D)."""
        n_parts = int(self.part_of_code.max()) + 1
        chosen = self._chosen(uniform((n_poses, n_parts)))
        return self.known[chosen[:, self.part_of_code], np.arange(len(self.low))]

    def between(self, n_poses: int, uniform: Uniform) -> FloatArray:
        """Take a moment each of motions through four known poses: (n_poses, D), in the box.

        Between the second and the third of a Catmull-Rom spline.
        """
        before, start, end, after = self.known[self._chosen(uniform((n_poses, 4)))].swapaxes(0, 1)
        t = uniform((n_poses, 1))
        bent = (2 * before - 5 * start + 4 * end - after) * t**2
        bent += (3 * (start - end) - before + after) * t**3
        moment: FloatArray = np.clip(start + 0.5 * ((end - before) * t + bent), self.low, self.high)
        return moment

    def _chosen(self, uniform: FloatArray) -> npt.NDArray[np.intp]:
        return (uniform * len(self.known)).astype(np.intp)
