"""Decode latent codes to vertices on a GPU: the counterpart of `Embedding.decode`.

The arithmetic of a vertex is the CPU's. Arrays have the poses last, so that neighbouring threads,
one per pose, read neighbouring numbers. The features' sums are rounded as on the CPU, product by
product; the double-precision steps that follow may fuse a product with a sum, which hardly ever
shows in float32 vertices.
"""
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.acap import codec, features
from lcollision_core.embedding import decoder
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.on_gpu import (
    THREADS,
    Buffers,
    DeviceArray,
    blocks_for,
    copied,
    cuda,
    device_function,
    rounded_product,
    rows_for,
)

_BYTES_AT_ONCE = 1 << 29

_take_tanh = device_function(decoder.take_tanh, _times=rounded_product)
_exponential = device_function(features.exponential)
_stretch_product = device_function(features.stretch_product)
_load_gradient = device_function(codec.load_gradient)


@cuda.jit
def fill_gradients(latent, weights, first_weight, first_code, place, offset, scale, gradients):
    """Write the deformation gradients (V, 3, 3, B) of (D, B) codes, a row of blocks per vertex.

    Parameters
    ----------
    weights, first_weight : (n,) weights of all groups in a row, and (G + 1,) where each begins
    first_code : (G + 1,) the first code of each group in the latent
    place : (G, V) int32, index of a vertex in each group's support, -1 outside
    offset, scale : as in `FeatureDecoder`
    """
    total = cuda.local.array(9, np.float32)
    feature = cuda.local.array(9, np.float64)
    rotation = cuda.local.array((3, 3), np.float64)
    first = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    for v in range(cuda.blockIdx.y, offset.shape[0], cuda.gridDim.y):
        for pose in range(first, latent.shape[1], cuda.gridDim.x * cuda.blockDim.x):
            for j in range(9):
                feature[j] = offset[v, j]
            for group in range(place.shape[0]):
                if place[group, v] < 0:
                    continue
                start, stop = first_code[group], first_code[group + 1]
                width = (first_weight[group + 1] - first_weight[group]) // (stop - start)
                at = first_weight[group] + 9 * place[group, v]
                for j in range(9):
                    total[j] = rounded_product(latent[start, pose], weights[at + j])
                for code in range(start + 1, stop):
                    at += width
                    for j in range(9):
                        total[j] += rounded_product(latent[code, pose], weights[at + j])
                _take_tanh(total)
                for j in range(9):
                    feature[j] += scale[j] * total[j]
            _exponential(feature[0], feature[1], feature[2], rotation)
            _stretch_product(rotation, feature[3:], gradients[v, :, :, pose])


@cuda.jit
def load_sides(poisson, gradients, sides):
    """Write the right-hand sides (V, 3, B), one row of blocks per vertex, by `load_gradient`."""
    first = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    for v in range(cuda.blockIdx.y, sides.shape[0], cuda.gridDim.y):
        for pose in range(first, sides.shape[2], cuda.gridDim.x * cuda.blockDim.x):
            _load_gradient(poisson, gradients[:, :, :, pose], v, 0, sides[:, :, pose])


@cuda.jit
def solve(poisson, row_start, column, by_row, sides, mean):
    """Solve for the right-hand sides (V, 3, B) in place, a thread per coordinate of a pose.

    Numbers are subtracted in the order of `codec.substitute`, gathered instead of scattered.

    Parameters
    ----------
    row_start, column, by_row : the triangle of `Poisson` by rows
    mean : (components, 3, B), 0 at first; the weighted mean vertices are added to it
    """
    first = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    n_free, n_poses = poisson.inverse_pivot.shape[0], sides.shape[2]
    for one in range(first, 3 * n_poses, cuda.gridDim.x * cuda.blockDim.x):
        a, pose = one // n_poses, one % n_poses
        for i in range(n_free):
            x = sides[i, a, pose]
            for p in range(row_start[i], row_start[i + 1]):
                x -= by_row[p] * sides[column[p], a, pose]
            sides[i, a, pose] = x
        for j in range(n_free - 1, -1, -1):
            x = sides[j, a, pose] * poisson.inverse_pivot[j]
            for p in range(poisson.column_start[j], poisson.column_start[j + 1]):
                x -= poisson.lower[p] * sides[poisson.row[p], a, pose]
            sides[j, a, pose] = x
        for i in range(n_free, sides.shape[0]):
            sides[i, a, pose] = 0.0
        for v in range(sides.shape[0]):
            component = poisson.component[v]
            mean[component, a, pose] += poisson.anchor[v] * sides[poisson.position[v], a, pose]


@cuda.jit
def unload_vertices(poisson, sides, mean, rest_mean, body_size, vertices):
    """Write the vertices (B, V, 3) in the data's unit, a row of blocks per vertex."""
    first = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    for v in range(cuda.blockIdx.y, sides.shape[0], cuda.gridDim.y):
        component, position = poisson.component[v], poisson.position[v]
        for pose in range(first, sides.shape[2], cuda.gridDim.x * cuda.blockDim.x):
            for a in range(3):
                place = sides[position, a, pose] - mean[component, a, pose] + rest_mean[v, a]
                vertices[pose, v, a] = place * body_size


class GpuDecoder:
    """Decode latent codes of an embedding on a GPU.

    Parameters
    ----------
    embedding : of the codes
    body_size : in the data's unit
    """

    def __init__(self, embedding: Embedding, body_size: float) -> None:
        groups, codec, n = embedding.decoder.groups, embedding.codec, embedding.topology.n_vertices
        place = np.full((len(groups), n), -1, dtype=np.int32)
        for row, group in zip(place, groups, strict=True):
            row[group.support] = np.arange(len(group.support))
        self._body_size, self._n_vertices, self._buffers = body_size, n, Buffers()
        self._n_components = int(codec.poisson.component.max()) + 1
        self._tables = tuple(
            map(
                cuda.to_device,
                (
                    np.concatenate([group.weights.reshape(-1) for group in groups]),
                    np.cumsum([0, *(group.weights.size for group in groups)]),
                    np.cumsum([0, *(len(group.weights) for group in groups)]),
                    place,
                    embedding.decoder.offset,
                    embedding.decoder.scale,
                ),
            )
        )
        size = len(codec.poisson.inverse_pivot)
        by_column = (codec.poisson.lower, codec.poisson.row, codec.poisson.column_start)
        rows = scipy.sparse.csc_matrix(by_column, shape=(size, size)).tocsr()
        rows.sort_indices()
        self._poisson = copied(codec.poisson)
        self._rows = tuple(map(cuda.to_device, (rows.indptr, rows.indices, rows.data)))
        self._rest_mean = cuda.to_device(codec.rest_mean)
        self.at_once = max(1, min(4096, _BYTES_AT_ONCE // (108 * n)))

    def decode(self, codes: npt.NDArray[Any]) -> DeviceArray:
        """Decode (B, D) codes, at most `at_once`, to (B, V, 3) float32 vertices on the GPU.

        The next call overwrites them; see `Buffers`.
        """
        n_poses, n = len(codes), self._n_vertices
        latent = cuda.to_device(np.ascontiguousarray(codes.T, dtype=np.float32))
        grid = blocks_for(n_poses), rows_for(n)
        gradients = self._buffers.take("gradients", (n, 3, 3, n_poses), np.float64)
        sides = self._buffers.take("sides", (n, 3, n_poses), np.float64)
        vertices = self._buffers.take("vertices", (n_poses, n, 3), np.float32)
        mean = self._buffers.zeros("mean", (self._n_components, 3, n_poses), np.float64)
        fill_gradients[grid, THREADS](latent, *self._tables, gradients)
        load_sides[grid, THREADS](self._poisson, gradients, sides)
        solve[blocks_for(3 * n_poses), THREADS](self._poisson, *self._rows, sides, mean)
        unload_vertices[grid, THREADS](
            self._poisson, sides, mean, self._rest_mean, self._body_size, vertices
        )
        return vertices
