"""Poses of one reference mesh to deformation features and back.

A vertex's deformation gradient averages over its one-ring, so a round trip blurs. Features are
therefore computed from the pose plus the difference that its round trip would leave; poses that are
exact already (rigid, uniformly scaled, flat) are not changed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from lcollision_core.acap.components import (
    BRIDGE_WEIGHT,
    OLDER_BRIDGE_WEIGHT,
    component_bridges,
)
from lcollision_core.acap.consistency import component_roots, consistent_logarithms
from lcollision_core.acap.features import (
    N_FEATURES,
    N_ROTATION,
    gradients_from_features,
    pull_back,
    pull_back_means,
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
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology, length_graph

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
    bridges : (n, 2) edges between components, see `component_bridges`; None for those of models
        that were trained before layers were joined to what they cover
    """

    def __init__(
        self,
        topology: Topology,
        rest_vertices: npt.NDArray[Any],
        anchor_weights: npt.NDArray[Any],
        bridges: IntArray | None = None,
    ) -> None:
        rest = topology.gathered(np.array(rest_vertices, dtype=np.float64))
        rest.flags.writeable = False
        self.topology = topology
        self.rest_vertices: FloatArray = rest
        self.anchor_weights: FloatArray = np.asarray(anchor_weights, dtype=np.float64)
        weights = cotangent_weights(topology, rest, WEIGHT_FLOOR)
        tied, bridge_weight = topology.edges, OLDER_BRIDGE_WEIGHT
        if bridges is None:
            bridges = component_bridges(topology, rest, layers=False)
        else:
            tied, bridge_weight = np.concatenate([tied, bridges]), BRIDGE_WEIGHT
        self.bridges = bridges
        # Layers turn as what they cover does, also by more than half a turn.
        graph = length_graph(tied, rest)
        self._around = graph.indptr, graph.indices
        self._roots = component_roots(graph)
        self._fit = fit_rings(topology, rest, weights, NORMAL_WEIGHT)
        self._poisson, self._rest_mean = factor_poisson(
            rest,
            np.concatenate([topology.edges, bridges]),
            np.concatenate([weights, np.full(len(bridges), bridge_weight)]),
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
                    *self._around,
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
        features : (B, V, 9) array, where; or (1, V, 9) for losses of one pose
        grad_vertices : (B, V, 3) array, derivative of each loss by the vertices
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
        if len(at) not in (1, len(given)):
            raise ShapeError.must_be("features", f"of 1 or {len(given)} poses", len(at))
        grad_features = np.empty((*given.shape[:2], N_FEATURES))

        def pull_block(start: int, stop: int) -> None:
            for row, grad_gradients in enumerate(self._by_gradients(given[start:stop]), start):
                pull_back(at[row if len(at) > 1 else 0], grad_gradients, grad_features[row])

        for_blocks(pull_block, len(given), BLOCK_POSES, n_threads)
        return grad_features

    def means_by_gradients(self, weights: csr_matrix) -> FloatArray:
        """Differentiate patches' means by the deformation gradients, for `means_vjp`.

        These are the same in every pose, as vertices are linear in deformation gradients.

        Parameters
        ----------
        weights : (m, V) sparse matrix; each patch's mean is its row times a pose's vertices

        Returns
        -------
        by_gradients : (m, V, 3) float64 array: coordinate a of patch k's mean, whichever a is,
            changes by by_gradients[k, i] with row a of vertex i's deformation gradient

        Raises
        ------
        ShapeError : another number of columns.
        """
        n_patches, n_vertices = weights.shape[0], self.topology.n_vertices
        if weights.shape[1] != n_vertices:
            raise ShapeError.must_be("weights", f"of shape (m, {n_vertices})", weights.shape)
        # All coordinates need the same solve, so that of x, y and z serves three patches.
        padded = np.zeros((n_patches + -n_patches % 3, n_vertices))
        padded[:n_patches] = weights.toarray()
        triples = np.ascontiguousarray(padded.reshape(-1, 3, n_vertices).transpose(0, 2, 1))
        by_gradients = np.empty((len(triples), 3, n_vertices, 3))
        for start in range(0, len(triples), BLOCK_POSES):
            solved = self._by_gradients(triples[start : start + BLOCK_POSES])
            for triple, grad_gradients in enumerate(solved, start):
                by_gradients[triple] = grad_gradients.transpose(1, 0, 2)
        return by_gradients.reshape(-1, n_vertices, 3)[:n_patches]

    def means_vjp(
        self,
        features: npt.NDArray[Any],
        by_gradients: FloatArray,
        grad_vertices: npt.NDArray[Any],
    ) -> FloatArray:
        """Differentiate patches' means, and losses by vertices, by one pose's features.

        The means need no solve; the losses need one, as in `decode_vjp`.

        Parameters
        ----------
        features : (V, 9) array, where
        by_gradients : (m, V, 3) float64 array of `means_by_gradients`
        grad_vertices : (n, V, 3) array, the losses' derivatives by the vertices

        Returns
        -------
        grad_features : (3 m + n, V, 9) float64 array: x, y and z of each mean, then the losses

        Raises
        ------
        ShapeError : another shape.
        """
        at = self._checked(np.asarray(features)[None], N_FEATURES, "features")[0]
        given = self._checked(grad_vertices, 3, "grad_vertices")
        n_means = 3 * len(by_gradients)
        grad_features = np.empty((n_means + len(given), *at.shape))
        pull_back_means(at, by_gradients, grad_features[:n_means].reshape(-1, 3, *at.shape))
        for row, grad_gradients in enumerate(self._by_gradients(given), n_means):
            pull_back(at, grad_gradients, grad_features[row])
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

    def _by_gradients(self, grad_vertices: FloatArray) -> Iterator[FloatArray]:
        """Turn n derivatives by (V, 3) vertices into those by (V, 3, 3) deformation gradients.

        The transpose of `_integrate`. All are yielded in the same memory.
        """
        n_vertices = self.topology.n_vertices
        sides = np.empty((n_vertices, 3 * len(grad_vertices)))
        for slot, one in enumerate(grad_vertices):
            unload_vertices_transposed(self._poisson, one, slot, sides)
        substitute(self._poisson, sides)
        grad_gradients = np.empty((n_vertices, 3, 3))
        for slot in range(len(grad_vertices)):
            load_gradients_transposed(self._poisson, sides, slot, grad_gradients)
            yield grad_gradients

    def _checked(self, array: npt.NDArray[Any], width: int, name: str) -> FloatArray:
        shape = np.shape(array)
        if len(shape) != 3 or shape[1:] != (self.topology.n_vertices, width):
            needed = f"of shape (B, {self.topology.n_vertices}, {width})"
            raise ShapeError.must_be(name, needed, shape)
        return np.ascontiguousarray(array, dtype=np.float64)
