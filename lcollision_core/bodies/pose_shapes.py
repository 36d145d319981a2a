"""Pose blend shapes of a body model, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_sums
from lcollision_core.meshes.topology import FloatArray, IntArray

_Shapes = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PoseShapes:
    """Offsets of V vertices' points per entry of R_b - I, for the B bones of a pose space.

    Attributes
    ----------
    directions : (V, 3, B, 9) float32 array, zero for the first bone
    """

    directions: _Shapes

    def offsets(self, rotations: FloatArray, chosen: npt.NDArray[np.integer]) -> FloatArray:
        """Return the (n, 3) offsets of chosen vertices for (B, 3, 3) rotations."""
        flat = self.directions.reshape(len(self.directions), 3, -1)
        return _offsets(flat, (rotations - np.eye(3)).reshape(-1), chosen.astype(np.int64))

    def tangents(
        self,
        slopes: FloatArray,
        chosen: npt.NDArray[np.int64],
        first: IntArray,
        joints: IntArray,
        weights: FloatArray,
        linear: FloatArray,
    ) -> FloatArray:
        """Return derivatives of chosen vertices, via their points, by the turns: (B, 3, n, 3).

        Parameters
        ----------
        slopes : (B, 3, 3, 3) derivatives of the rotations by the turns
        chosen : (n,) indices from 0
        first, joints, weights : of the chosen vertices, see `rig_kernels.skin_poses`
        linear : of the bones' motions
        """
        blended = _blended(first, joints, weights, linear)
        return _moved(self.directions, slopes.reshape(len(slopes), 3, 9), chosen, blended)

    def pull_back(
        self,
        slopes: FloatArray,
        by_vertices: FloatArray,
        chosen: npt.NDArray[np.int64],
        first: IntArray,
        joints: IntArray,
        weights: FloatArray,
        linear: FloatArray,
    ) -> FloatArray:
        """Turn derivatives by the chosen vertices, (m, n, 3), into those by turns, (m, B, 3)."""
        blended = _blended(first, joints, weights, linear)
        by_points = np.einsum("mnx,nxa->mna", by_vertices, blended)
        flat = self.directions.reshape(len(self.directions), 3, -1)
        by_entries = _summed(flat, by_points, chosen)
        shape = len(by_entries), len(slopes), 9
        pulled: FloatArray = np.einsum(
            "mbi,bei->mbe", by_entries.reshape(shape), slopes.reshape(len(slopes), 3, 9)
        )
        return pulled


@compiled_sums
def _offsets(directions: _Shapes, entries: FloatArray, chosen: npt.NDArray[np.int64]) -> FloatArray:
    moved = np.empty((len(chosen), 3))
    for place in range(len(chosen)):
        for axis in range(3):
            row = directions[chosen[place], axis]
            total = 0.0
            for entry in range(len(entries)):
                total += row[entry] * entries[entry]
            moved[place, axis] = total
    return moved


@compiled
def _blended(
    first: IntArray, joints: IntArray, weights: FloatArray, linear: FloatArray
) -> FloatArray:
    """Return the weighted mean of each vertex's linear maps: (n, 3, 3)."""
    blended = np.zeros((len(first) - 1, 3, 3))
    for place in range(len(blended)):
        for influence in range(first[place], first[place + 1]):
            blended[place] += weights[influence] * linear[joints[influence]]
    return blended


@compiled
def _moved(
    directions: _Shapes,
    slopes: FloatArray,
    chosen: npt.NDArray[np.int64],
    blended: FloatArray,
) -> FloatArray:
    """Return the derivatives of chosen vertices by the turns: (B, 3, n, 3)."""
    moved = np.zeros((len(slopes), 3, len(chosen), 3))
    for place in range(len(chosen)):
        for bone in range(len(slopes)):
            for entry in range(3):
                for axis in range(3):
                    along = 0.0
                    for number in range(9):
                        along += (
                            directions[chosen[place], axis, bone, number]
                            * slopes[bone, entry, number]
                        )
                    for row in range(3):
                        moved[bone, entry, place, row] += blended[place, row, axis] * along
    return moved


@compiled
def _summed(
    directions: _Shapes, by_points: FloatArray, chosen: npt.NDArray[np.int64]
) -> FloatArray:
    """Turn (m, n, 3) derivatives by points into derivatives by rotations: (m, entries)."""
    summed = np.zeros((len(by_points), directions.shape[2]))
    for place in range(len(chosen)):
        for axis in range(3):
            row = directions[chosen[place], axis]
            for number in range(len(by_points)):
                factor = by_points[number, place, axis]
                if factor != 0.0:
                    for entry in range(len(row)):
                        summed[number, entry] += factor * row[entry]
    return summed
