"""The default network's inputs on a GPU: the counterpart of `CompiledSkin.forward`.

Torch alone launches a hundred kernels, several of which pass over an array of (B, P, P). Here three
kernels pose the skin and read its contact features and folds, by the arithmetic of the CPU's loops.
Torch multiplies the matrices and holds all memory.
"""
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

import math

import numpy as np
import torch

from lcollision_core.on_gpu import (
    GPU_LOCK,
    SIMULATED,
    THREADS,
    DeviceArray,
    blocks_for,
    cuda,
    device_function,
    rows_for,
)
from lcollision_core.predictor import kernels
from lcollision_core.predictor.kernels import RADII, SMALLEST_SQUARED_ANGLE, UNITS

_pair_weights = device_function(kernels.pair_weights)
_take_means = device_function(kernels.take_means)
_deform_point = device_function(kernels.deform_point)
_view_site = device_function(kernels.view_site)

_REACH = np.float32(max(RADII) ** 2)
_PER_INNER, _PER_OUTER = (np.float32(1.0 / radius) for radius in RADII)
_HALF, _ONE, _TWO = np.float32(0.5), np.float32(1.0), np.float32(2.0)
_SMALLEST = np.float32(SMALLEST_SQUARED_ANGLE)


@cuda.jit
def pose_skin(products, output_index, offset, scale, rest_frame, frame, rows):
    """Write frames and gradients as `kernels.deform`: a thread per point, a block row per pose.

    Parameters
    ----------
    products, output_index : (B, T, 9) float32 and (G, Q) int32, see `ReducedBody`
    """
    features, turn = cuda.local.array(9, np.float32), cuda.local.array(3, np.float32)
    first = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    for b in range(cuda.blockIdx.y, rows.shape[0], cuda.gridDim.y):
        for q in range(first, rows.shape[2], cuda.gridDim.x * cuda.blockDim.x):
            for c in range(9):
                features[c] = offset[q, c]
            for group in range(output_index.shape[0]):
                n = output_index[group, q]
                if n >= 0:
                    for c in range(9):
                        features[c] += math.tanh(products[b, n, c]) * scale[c]
            # s, v and c of `kernels.rodrigues`.
            x, y, z = features[0], features[1], features[2]
            half = _HALF * math.sqrt(x * x + y * y + z * z + _SMALLEST)
            sine = math.sin(half)
            quotient = sine / half
            turn[0] = quotient * math.cos(half)
            turn[1] = _HALF * quotient * quotient
            turn[2] = _ONE - _TWO * sine * sine
            _deform_point(features, turn, rest_frame, q, frame[b], rows[b])


@cuda.jit
def fill_field(frame, positions, neighbours, field):
    """Write contact features (P, B, 2, 8): a thread per point, a block row per pose.

    Parameters
    ----------
    frame, positions : (B, N, 3, 3) and (B, 3, P)
    neighbours : (P, P) `SkinGeometry.geodesic_neighbours`
    """
    inner, outer = cuda.local.array(8, np.float32), cuda.local.array(8, np.float32)
    first = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    for b in range(cuda.blockIdx.y, positions.shape[0], cuda.gridDim.y):
        for p in range(first, positions.shape[2], cuda.gridDim.x * cuda.blockDim.x):
            for c in range(8):
                inner[c] = outer[c] = np.float32(0.0)
            x, y, z = positions[b, 0, p], positions[b, 1, p], positions[b, 2, p]
            nx, ny, nz = frame[b, p, 0, 0], frame[b, p, 1, 0], frame[b, p, 2, 0]
            for q in range(positions.shape[2]):
                dx, dy, dz = positions[b, 0, q] - x, positions[b, 1, q] - y, positions[b, 2, q] - z
                squared = dx * dx + dy * dy + dz * dz
                if squared < _REACH:
                    ahead = dx * nx + dy * ny + dz * nz
                    weight, outer_weight = _pair_weights(
                        squared + neighbours[q, p], ahead, np.float32
                    )
                    normal = frame[b, q, 0, 0], frame[b, q, 1, 0], frame[b, q, 2, 0]
                    _add_pair(inner, weight, dx, dy, dz, normal)
                    _add_pair(outer, outer_weight, dx, dy, dz, normal)
            _take_means(inner, frame[b, p], _PER_INNER, field[p, b, 0])
            _take_means(outer, frame[b, p], _PER_OUTER, field[p, b, 1])


@cuda.jit(device=True)
def _add_pair(sums, weight, dx, dy, dz, normal):
    nx, ny, nz = normal
    sums[0] += weight
    sums[1] -= weight * (dx * nx + dy * ny + dz * nz)
    sums[2] += weight * dx
    sums[3] += weight * dy
    sums[4] += weight * dz
    sums[5] += weight * nx
    sums[6] += weight * ny
    sums[7] += weight * nz


@cuda.jit
def fill_folds(frame, rows, members, folds):
    """Write the folds (S, B, 9 M): a thread per site, a block row per pose."""
    first = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    for b in range(cuda.blockIdx.y, rows.shape[0], cuda.gridDim.y):
        for s in range(first, members.shape[0], cuda.gridDim.x * cuda.blockDim.x):
            _view_site(frame[b], rows[b], members[s], folds[s, b])


def posed_skin(
    products: torch.Tensor,
    output_index: torch.Tensor,
    offset: torch.Tensor,
    scale: torch.Tensor,
    rest_frame: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the frames and gradients of `ReducedBody`, whose products and buffers are given."""
    n_rows, n_skin = len(products), len(offset)
    frame = products.new_empty((n_rows, *rest_frame.shape))
    rows = products.new_empty((n_rows, 3, n_skin, 3))
    fixed = output_index, offset, scale, rest_frame
    launch(pose_skin, (n_skin, n_rows), products, *fixed, frame, rows)
    return frame, rows


def contact_field(
    frame: torch.Tensor, positions: torch.Tensor, neighbours: torch.Tensor
) -> torch.Tensor:
    """Return the features of `ContactField`, whose `geodesic_neighbours` are given."""
    n_rows, _, n_points = positions.shape
    field = positions.new_empty((n_points, n_rows, *UNITS.shape))
    launch(fill_field, (n_points, n_rows), frame, positions, neighbours, field)
    return field


def fold_view(frame: torch.Tensor, rows: torch.Tensor, members: torch.Tensor) -> torch.Tensor:
    """Return the folds of `ReducedBody.fold_view`, whose members are given."""
    (n_sites, n_members), n_rows = members.shape, len(rows)
    folds = rows.new_empty((n_sites, n_rows, 9 * n_members))
    launch(fill_folds, (n_sites, n_rows), frame, rows, members, folds)
    return folds


def launch(kernel: DeviceArray, size: tuple[int, int], *tensors: torch.Tensor) -> None:
    """Launch a kernel with so many threads and rows of blocks on torch's current stream.

    A CUDA graph can record it there.
    """
    if min(size) > 0:
        # On the CPU, for Numba's simulator, there are no streams.
        number = 0 if SIMULATED else torch.cuda.current_stream().cuda_stream
        stream = cuda.external_stream(number) if number else 0
        arrays = [
            values.numpy() if SIMULATED else cuda.as_cuda_array(values, sync=False)
            for values in tensors
        ]
        with GPU_LOCK:
            kernel[(blocks_for(size[0]), rows_for(size[1])), THREADS, stream](*arrays)
