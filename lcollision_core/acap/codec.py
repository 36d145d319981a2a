"""Poses of one reference mesh to deformation features and back.

A vertex's deformation gradient averages over its one-ring, so a round trip blurs. Features are
therefore computed from the pose plus the difference that its round trip would leave; poses that are
exact already (rigid, uniformly scaled, flat) are not changed. What else was tried, with its
figures, is in docs/experiments.md.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import numpy.typing as npt

from lcollision_core.acap.bridges import component_bridges
from lcollision_core.acap.consistency import component_roots, consistent_logarithms
from lcollision_core.acap.features import (
    N_FEATURES,
    N_ROTATION,
    gradients_from_features,
    pull_back,
    push_forward,
)
from lcollision_core.acap.gradients import deformation_gradients, fit_rings
from lcollision_core.acap.reconstruct import BLOCK_POSES, factor_poisson
from lcollision_core.acap.rotations import split_gradients
from lcollision_core.acap.weights import cotangent_weights
from lcollision_core.errors import ShapeError
from lcollision_core.meshes.topology import FloatArray, Topology

if TYPE_CHECKING:
    import torch

WEIGHT_FLOOR = 0.05
NORMAL_WEIGHT = 1.0


@dataclass(frozen=True)
class EncodedPoses:
    """Deformation features of some poses, and how consistent their rotations are.

    Attributes
    ----------
    features : (B, V, 9) float64 array, unscaled
    n_jumps : (B,) int64 array, edges whose two angles differ by more than pi, their
        axes pointing the same way
    """

    features: FloatArray
    n_jumps: npt.NDArray[np.int64]


class AcapCodec:
    """The map between poses and ACAP features for one reference mesh; immutable, thread-safe.

    Parameters
    ----------
    topology : the connectivity of all poses
    rest_vertices : (V, 3) array, the reference, in heights; vertices that no face uses are put
        amid the others
    anchor_weights : (V,) array >= 0 or None for equal weights; a decoded pose is put where its
        weighted mean vertex is the reference's. With the weights of the poses' rigid alignment
        a decoded pose lies where the aligned one lay.

    Raises
    ------
    ShapeError : an array has another shape, is not finite, or a weight is negative.
    """

    def __init__(
        self,
        topology: Topology,
        rest_vertices: npt.NDArray[Any],
        anchor_weights: npt.NDArray[Any] | None = None,
    ) -> None:
        n_vertices = topology.n_vertices
        if np.shape(rest_vertices) != (n_vertices, 3):
            shape = np.shape(rest_vertices)
            raise ShapeError.must_be("the reference", f"of shape ({n_vertices}, 3)", shape)
        rest = np.array(rest_vertices, dtype=np.float64)
        if not np.isfinite(rest).all():
            raise ShapeError("the reference has a vertex that is not finite")
        rest = topology.gathered(rest)
        rest.flags.writeable = False
        given = np.ones(n_vertices) if anchor_weights is None else anchor_weights
        anchor = np.asarray(given, dtype=np.float64)
        if anchor.shape != (n_vertices,) or not (np.isfinite(anchor) & (anchor >= 0.0)).all():
            needed = f"({n_vertices},) numbers of at least 0"
            raise ShapeError.must_be("anchor_weights", needed, f"shape {anchor.shape}")
        self.topology = topology
        self.rest_vertices: FloatArray = rest
        weights = cotangent_weights(topology, rest, WEIGHT_FLOOR)
        bridges = component_bridges(topology, rest)
        self._roots = component_roots(topology, rest)
        self._fit = fit_rings(topology, rest, weights, NORMAL_WEIGHT)
        self._poisson = factor_poisson(
            rest,
            np.concatenate([topology.edges, bridges]),
            np.concatenate([weights, np.ones(len(bridges))]),
            anchor,
        )
        self._rest_offset = self._poisson.rest_mean[self._poisson.component]

    def encode(self, vertices: npt.NDArray[Any], n_threads: int | None = None) -> EncodedPoses:
        """Compute the deformation features of poses that are aligned to the reference.

        Parameters
        ----------
        vertices : (B, V, 3) array, in heights; where a pose lies does not matter, how it is
            turned does
        n_threads : threads to spread the poses over, numba's own number by default

        Returns
        -------
        encoded : EncodedPoses

        Raises
        ------
        ShapeError : another shape, or a vertex is not finite.
        """
        poses = self._checked(vertices, 3, "vertices")
        broken = np.argwhere(~np.isfinite(poses).all(axis=2))
        if len(broken):
            pose, vertex = broken[0]
            raise ShapeError(
                f"is not finite: {poses[pose, vertex].tolist()}",
                where=f"vertex {vertex} of pose {pose}",
            )
        features = np.empty((len(poses), self.topology.n_vertices, N_FEATURES))
        n_jumps = np.zeros(len(poses), dtype=np.int64)

        def encode_block(start: int, stop: int) -> None:
            gradients = np.empty((self.topology.n_vertices, 3, 3))
            quaternions = np.empty((self.topology.n_vertices, 4))
            for pose, sharpened in enumerate(self._sharpened(poses[start:stop]), start):
                deformation_gradients(sharpened, self.topology.faces, *self._fit.arrays, gradients)
                split_gradients(gradients, quaternions, features[pose, :, N_ROTATION:])
                n_jumps[pose] = consistent_logarithms(
                    quaternions,
                    self._fit.ring_start,
                    self._fit.ring,
                    self._roots,
                    features[pose, :, :N_ROTATION],
                )

        _spread(encode_block, len(poses), BLOCK_POSES, n_threads)
        return EncodedPoses(features, n_jumps)

    def decode(self, features: npt.NDArray[Any], n_threads: int | None = None) -> FloatArray:
        """Rebuild the poses of deformation features.

        Parameters
        ----------
        features : (B, V, 9) array, unscaled
        n_threads : threads to spread the poses over, numba's own number by default

        Returns
        -------
        vertices : (B, V, 3) float64 array, in heights, in the reference's frame: features do not
            know where a pose lies, so its mean vertex (weighted by the codec's `anchor_weights`)
            is put where the reference has it. Every pose gets the same bits however many are
            decoded together.

        Raises
        ------
        ShapeError : another shape.
        """
        fields = self._checked(features, N_FEATURES, "features")
        vertices = np.empty((len(fields), self.topology.n_vertices, 3))

        def decode_block(start: int, stop: int) -> None:
            right_sides = self._poisson.right_sides(stop - start)
            gradients = np.empty((self.topology.n_vertices, 3, 3))
            for pose in range(start, stop):
                gradients_from_features(fields[pose], gradients)
                self._poisson.load(gradients, right_sides, pose - start)
            self._poisson.solve(right_sides, vertices[start:stop])
            vertices[start:stop] += self._rest_offset

        _spread(decode_block, len(fields), BLOCK_POSES, n_threads)
        return vertices

    def decode_jvp(
        self,
        features: npt.NDArray[Any],
        tangents: npt.NDArray[Any],
        n_threads: int | None = None,
    ) -> FloatArray:
        """Differentiate one decoded pose along several changes of its features.

        Parameters
        ----------
        features : (V, 9) array, where
        tangents : (m, V, 9) array, the changes
        n_threads : threads to spread the changes over, numba's own number by default

        Returns
        -------
        moved : (m, V, 3) float64 array, the vertices' derivatives

        Raises
        ------
        ShapeError : another shape.
        """
        at = self._checked(np.asarray(features)[None], N_FEATURES, "features")[0]
        along = self._checked(tangents, N_FEATURES, "tangents")
        moved = np.empty((len(along), self.topology.n_vertices, 3))

        def push_block(start: int, stop: int) -> None:
            gradients = np.empty((stop - start, self.topology.n_vertices, 3, 3))
            push_forward(at, along[start:stop], gradients)
            right_sides = self._poisson.right_sides(stop - start)
            for slot, field in enumerate(gradients):
                self._poisson.load(field, right_sides, slot)
            self._poisson.solve(right_sides, moved[start:stop])

        _spread(push_block, len(along), BLOCK_POSES, n_threads)
        return moved

    def decode_vjp(
        self,
        features: npt.NDArray[Any],
        by_vertices: npt.NDArray[Any],
        n_threads: int | None = None,
    ) -> FloatArray:
        """Turn a loss's derivative by decoded vertices into the one by the features.

        Parameters
        ----------
        features : (B, V, 9) array, where
        by_vertices : (B, V, 3) array, derivative of each pose's loss by its vertices
        n_threads : threads to spread the poses over, numba's own number by default

        Returns
        -------
        by_features : (B, V, 9) float64 array

        Raises
        ------
        ShapeError : another shape, or differing numbers of poses.
        """
        at = self._checked(features, N_FEATURES, "features")
        given = self._checked(by_vertices, 3, "by_vertices")
        if len(at) != len(given):
            raise ShapeError(f"features hold {len(at)} poses but by_vertices {len(given)}")
        by_features = np.empty(at.shape)

        def pull_block(start: int, stop: int) -> None:
            solution = self._poisson.solve_transposed(given[start:stop])
            by_gradients = np.empty((self.topology.n_vertices, 3, 3))
            for pose in range(start, stop):
                self._poisson.load_transposed(solution, pose - start, by_gradients)
                pull_back(at[pose], by_gradients, by_features[pose])

        _spread(pull_block, len(at), BLOCK_POSES, n_threads)
        return by_features

    def decode_torch(self, features: torch.Tensor) -> torch.Tensor:
        """Decode a (..., V, 9) tensor differentiably: see `torch_decode.decode_torch`."""
        from lcollision_core.acap.torch_decode import decode_torch

        return decode_torch(self, features)

    def _sharpened(self, poses: FloatArray) -> FloatArray:
        """Add to up to `BLOCK_POSES` poses what their round trips would otherwise lose."""
        right_sides = self._poisson.right_sides(len(poses))
        gradients = np.empty((self.topology.n_vertices, 3, 3))
        for slot, pose in enumerate(poses):
            deformation_gradients(pose, self.topology.faces, *self._fit.arrays, gradients)
            self._poisson.load(gradients, right_sides, slot)
        rebuilt = np.empty_like(poses)
        self._poisson.solve(right_sides, rebuilt)
        return 2.0 * poses - rebuilt

    def _checked(self, array: npt.NDArray[Any], width: int, name: str) -> FloatArray:
        shape = np.shape(array)
        if len(shape) != 3 or shape[1:] != (self.topology.n_vertices, width):
            needed = f"of shape (B, {self.topology.n_vertices}, {width})"
            raise ShapeError.must_be(name, needed, shape)
        return np.ascontiguousarray(array, dtype=np.float64)


def _spread(
    work: Callable[[int, int], None], n_items: int, block: int, n_threads: int | None
) -> None:
    """Call `work(start, stop)` for fixed blocks of the items, on threads where there are several.

    The blocks do not depend on the number of threads, so neither do the results.
    """
    blocks = [(start, min(start + block, n_items)) for start in range(0, n_items, block)]
    wanted = numba.config.NUMBA_NUM_THREADS if n_threads is None else n_threads
    if min(wanted, len(blocks)) <= 1:
        for start, stop in blocks:
            work(start, stop)
        return
    with ThreadPoolExecutor(min(wanted, len(blocks))) as pool:
        for future in [pool.submit(work, start, stop) for start, stop in blocks]:
            future.result()
