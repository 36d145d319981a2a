"""Skinning of rig poses on a GPU: joints move on the CPU, vertices on the GPU."""
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lcollision_core.bodies import rig_kernels
from lcollision_core.bodies.rig_kernels import Influences, JointFrames
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.on_gpu import (
    THREADS,
    Buffers,
    DeviceArray,
    blocks_for,
    cuda,
    device_function,
    rows_for,
)

_skinned_vertex = device_function(rig_kernels.skinned_vertex)


@cuda.jit
def skin_poses(linear, translations, first, joints, weights, points, body_size, vertices):
    """Write (B, V, 3) vertices in the data's unit, a thread per vertex, a block row per pose.

    Parameters
    ----------
    linear, translations : (B, J, 3, 3) and (B, J, 3)
    first to points : `rig_kernels.Influences`
    """
    start = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    for pose in range(cuda.blockIdx.y, vertices.shape[0], cuda.gridDim.y):
        for vertex in range(start, vertices.shape[1], cuda.gridDim.x * cuda.blockDim.x):
            x, y, z = _skinned_vertex(
                linear[pose], translations[pose], first, joints, weights, points, vertex
            )
            vertices[pose, vertex, 0] = x * body_size
            vertices[pose, vertex, 1] = y * body_size
            vertices[pose, vertex, 2] = z * body_size


class GpuSkin:
    """Skins poses of one rig; a `PosesOnGpu`.

    Parameters
    ----------
    turns_of_poses : maps (B, D) codes to the turns and shifts of `rig_kernels`
    joint_frames, influences : see `rig_kernels`
    body_size : in the data's unit
    """

    at_once = 2048

    def __init__(
        self,
        turns_of_poses: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
        joint_frames: JointFrames,
        influences: Influences,
        body_size: float,
    ) -> None:
        self._turns_of_poses, self._joint_frames = turns_of_poses, joint_frames
        self._body_size, self._buffers = body_size, Buffers()
        self._n_vertices = len(influences[0]) - 1
        self._influences = tuple(map(cuda.to_device, influences))

    def decode(self, codes: FloatArray) -> DeviceArray:
        """Decode (B, D) codes to (B, V, 3) float32 GPU vertices, valid until the next call."""
        turns, shifts = self._turns_of_poses(codes)
        linear, translations = np.empty((*turns.shape, 3)), np.empty(turns.shape)
        rig_kernels.move_joints(turns, shifts, self._joint_frames, linear, translations)
        moved = map(cuda.to_device, (linear, translations))
        vertices = self._buffers.take("vertices", (len(codes), self._n_vertices, 3), np.float32)
        skin_poses[(blocks_for(self._n_vertices), rows_for(len(codes))), THREADS](
            *moved, *self._influences, self._body_size, vertices
        )
        return vertices
