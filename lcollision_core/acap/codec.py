"""Poses of one reference mesh to deformation features and back.

A vertex's deformation gradient averages over its one-ring, so a round trip blurs. Features are
therefore computed from the pose plus the difference that its round trip would leave; poses that are
exact already (rigid, uniformly scaled, flat) are not changed.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.components import component_bridges
from lcollision_core.acap.consistency import component_roots, consistent_logarithms
from lcollision_core.acap.features import (
    N_FEATURES,
    N_ROTATION,
    gradients_from_features,
    pull_back,
    push_forward,
)
from lcollision_core.acap.gradients import deformation_gradients, fit_rings
from lcollision_core.acap.reconstruct import (
    BLOCK_POSES,
    factor_poisson,
    load_gradients,
    load_gradients_transposed,
    substitute,
    unload_vertices,
    unload_vertices_transposed,
)
from lcollision_core.acap.rotations import split_gradients
from lcollision_core.acap.weights import cotangent_weights
from lcollision_core.errors import ShapeError
from lcollision_core.jobs import for_blocks
from lcollision_core.meshes.topology import FloatArray, Topology

WEIGHT_FLOOR = 0.05
NORMAL_WEIGHT = 1.0


class AcapCodec:
    """The map between poses and ACAP features for one reference mesh; immutable, thread-safe.

    Parameters
    ----------
    topology : the connectivity of all poses
    rest_vertices : (V, 3) finite array, the reference, in normalised lengths; vertices that no face
        uses are put at the mean of the others
    anchor_weights : (V,) finite array >= 0; a decoded pose is put where its weighted mean vertex is
        the reference's. With the weights of the poses' rigid alignment a decoded pose lies where
        the aligned one lay.
    """

    def __init__(
        self,
        topology: Topology,
        rest_vertices: npt.NDArray[Any],
        anchor_weights: npt.NDArray[Any],
    ) -> None:
        rest = topology.gathered(np.array(rest_vertices, dtype=np.float64))
        rest.flags.writeable = False
        self.topology = topology
        self.rest_vertices: FloatArray = rest
        self.anchor_weights: FloatArray = np.asarray(anchor_weights, dtype=np.float64)
        weights = cotangent_weights(topology, rest, WEIGHT_FLOOR)
        bridges = component_bridges(topology, rest)
        self._roots = component_roots(topology, rest)
        self._fit = fit_rings(topology, rest, weights, NORMAL_WEIGHT)
        self._poisson, self._rest_mean = factor_poisson(
            rest,
            np.concatenate([topology.edges, bridges]),
            np.concatenate([weights, np.ones(len(bridges))]),
            self.anchor_weights,
        )

    def encode(self, vertices: npt.NDArray[Any], n_threads: int | None = None) -> FloatArray:
        """Compute the deformation features of poses that are aligned to the reference.

        Parameters
        ----------
        vertices : (B, V, 3) finite array, in normalised lengths; translation does not
            matter, rotation does
        n_threads : threads to spread the poses over, one for each core by default

        Returns
        -------
        features : (B, V, 9) float64 array, unscaled

        Raises
        ------
        ShapeError : another shape.
        """
        poses = self._checked(vertices, 3, "vertices")
        features = np.empty((len(poses), self.topology.n_vertices, N_FEATURES))

        def encode_block(start: int, stop: int) -> None:
            gradients = np.empty((self.topology.n_vertices, 3, 3))
            quaternions = np.empty((self.topology.n_vertices, 4))
            for pose, sharpened in enumerate(self._sharpened(poses[start:stop]), start):
                deformation_gradients(sharpened, self._fit, gradients)
                split_gradients(gradients, quaternions, features[pose, :, N_ROTATION:])
                consistent_logarithms(
                    quaternions,
                    self._fit.ring_start,
                    self._fit.ring,
                    self._roots,
                    features[pose, :, :N_ROTATION],
                )

        for_blocks(encode_block, len(poses), BLOCK_POSES, n_threads)
        return features

    def decode(self, features: npt.NDArray[Any], n_threads: int | None = None) -> FloatArray:
        """Rebuild the poses of deformation features.

        Parameters
        ----------
        features : (B, V, 9) array, unscaled
        n_threads : threads to spread the poses over, one for each core by default

        Returns
        -------
        vertices : (B, V, 3) float64 array, in normalised lengths, placed as the reference: features
            do not hold the position, so its mean vertex (weighted by the codec's
            `anchor_weights`) is put where the reference has it. Every pose gets the same bits
            however many are decoded together.

        Raises
        ------
        ShapeError : another shape.
        """
        fields = self._checked(features, N_FEATURES, "features")
        vertices = np.empty((len(fields), self.topology.n_vertices, 3))

        def decode_block(start: int, stop: int) -> None:
            buffer = np.empty((self.topology.n_vertices, 3, 3))
            gradients = (gradients_from_features(one, buffer) for one in fields[start:stop])
            self._integrate(gradients, vertices[start:stop])
            vertices[start:stop] += self._rest_mean

        for_blocks(decode_block, len(fields), BLOCK_POSES, n_threads)
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
        n_threads : threads to spread the changes over, one for each core by default

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
            self._integrate(gradients, moved[start:stop])

        for_blocks(push_block, len(along), BLOCK_POSES, n_threads)
        return moved

    def decode_vjp(
        self,
        features: npt.NDArray[Any],
        grad_vertices: npt.NDArray[Any],
        n_threads: int | None = None,
    ) -> FloatArray:
        """Turn a loss's derivative by decoded vertices into the one by the features.

        Parameters
        ----------
        features : (B, V, 9) array, where
        grad_vertices : (B, V, 3) array, derivative of each pose's loss by its vertices
        n_threads : threads to spread the poses over, one for each core by default

        Returns
        -------
        grad_features : (B, V, 9) float64 array

        Raises
        ------
        ShapeError : another shape.
        """
        at = self._checked(features, N_FEATURES, "features")
        given = self._checked(grad_vertices, 3, "grad_vertices")
        grad_features = np.empty(at.shape)

        def pull_block(start: int, stop: int) -> None:
            sides = np.empty((self.topology.n_vertices, 3 * (stop - start)))
            for slot, one in enumerate(given[start:stop]):
                unload_vertices_transposed(self._poisson, one, slot, sides)
            substitute(self._poisson, sides)
            grad_gradients = np.empty((self.topology.n_vertices, 3, 3))
            for slot, pose in enumerate(range(start, stop)):
                load_gradients_transposed(self._poisson, sides, slot, grad_gradients)
                pull_back(at[pose], grad_gradients, grad_features[pose])

        for_blocks(pull_block, len(at), BLOCK_POSES, n_threads)
        return grad_features

    def _sharpened(self, poses: FloatArray) -> FloatArray:
        """Add to up to `BLOCK_POSES` poses what their round trips would otherwise lose."""
        buffer = np.empty((self.topology.n_vertices, 3, 3))
        rebuilt = np.empty_like(poses)
        self._integrate((deformation_gradients(one, self._fit, buffer) for one in poses), rebuilt)
        return 2.0 * poses - rebuilt

    def _integrate(self, gradients: Iterable[FloatArray], vertices: FloatArray) -> None:
        """Write the (n, V, 3) vertices of n poses' (V, 3, 3) deformation gradients."""
        sides = np.empty((self.topology.n_vertices, 3 * len(vertices)))
        for slot, one in enumerate(gradients):
            load_gradients(self._poisson, one, slot, sides)
        substitute(self._poisson, sides)
        for slot, out in enumerate(vertices):
            unload_vertices(self._poisson, sides, slot, out)

    def _checked(self, array: npt.NDArray[Any], width: int, name: str) -> FloatArray:
        shape = np.shape(array)
        if len(shape) != 3 or shape[1:] != (self.topology.n_vertices, width):
            needed = f"of shape (B, {self.topology.n_vertices}, {width})"
            raise ShapeError.must_be(name, needed, shape)
        return np.ascontiguousarray(array, dtype=np.float64)
