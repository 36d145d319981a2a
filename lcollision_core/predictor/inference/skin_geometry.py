"""The points that the default network uses of a body, and their map from latent codes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES
from lcollision_core.embedding import Embedding
from lcollision_core.predictor.inference.field_kernels import BLOCK, in_blocks
from lcollision_core.predictor.inference.points import (
    N_POINTS,
    body_points,
    neighbour_order,
    skin_distances,
    skin_graph,
    tangent_frames,
)

DISTANT = 0.10
"""Normalised length along the surface beyond which two points count in each other's field."""

Float32Array = npt.NDArray[np.float32]


class CodeGroup(NamedTuple):
    """The points that a group of codes moves.

    Attributes
    ----------
    codes : which of the D codes
    table : (codes, 9 n) float32 array, to the outputs of the n points that it moves
    """

    codes: slice
    table: Float32Array


@dataclass(frozen=True, eq=False)
class SkinGeometry:
    """The points of the body and the fold sites: a function of the embedding and the sites.

    Attributes
    ----------
    point_vertices : (P,) int64 array, ascending, the vertices that are points of the body
    members : (S, M) int32 array, each site's vertices as numbers of the skin
    geodesic_neighbours : (P, P) float32 array, added to squared distances: 1 for pairs so near
        along the surface that they do not count in each other's field, else 0
    order : (O,) int32 array, all points of the body, neighbours near each other, and the last
        again until O is a multiple of `BLOCK`
    neighbour_blocks : `geodesic_neighbours` in that order, see `in_blocks`
    rest_frame : (N, 3, 3) float32 array: of the first N points of the skin, on the reference, as
        columns, the outer normal first; the skin is the P points, then the sites' centres that are
        none, and last their other vertices, which need no frame
    groups : of codes; their outputs follow each other, nine for each point that they move
    target : (T,) int32 array, the point of the skin that nine outputs belong to
    offset : (Q, 9) float32 array, deformation features of codes 0
    scale : (9,) float32 array, of the outputs
    """

    point_vertices: npt.NDArray[np.int64]
    members: npt.NDArray[np.int32]
    geodesic_neighbours: Float32Array
    order: npt.NDArray[np.int32]
    neighbour_blocks: Float32Array
    rest_frame: Float32Array
    groups: list[CodeGroup]
    target: npt.NDArray[np.int32]
    offset: Float32Array
    scale: Float32Array

    @property
    def n_points(self) -> int:
        """P."""
        return len(self.point_vertices)

    @classmethod
    def of(
        cls, embedding: Embedding, sites: npt.NDArray[np.integer], n_points: int = N_POINTS
    ) -> SkinGeometry:
        """Choose the points of an embedding's body.

        Parameters
        ----------
        embedding : of the body
        sites : (S, M) vertices about each fold site, see `find_fold_sites`
        n_points : P, unless the mesh has fewer vertices

        Raises
        ------
        ValueError : the sites are not of this body.
        """
        n_vertices = len(embedding.rest_vertices)
        is_table = sites.ndim == 2 and sites.shape[1] > 0
        if not is_table or (sites.size and not 0 <= sites.min() <= sites.max() < n_vertices):
            raise ValueError("the fold sites are not of this body")
        vertex = body_points(embedding, n_points)
        framed = np.append(vertex, np.setdiff1d(sites[:, 0], vertex))
        skin = np.append(framed, np.setdiff1d(sites, framed))
        distance = skin_distances(skin_graph(embedding), vertex, limit=DISTANT)[:, vertex]
        neighbours = np.isfinite(distance).astype(np.float32)
        order = neighbour_order(embedding.rest_vertices[vertex], BLOCK)
        index = np.zeros(n_vertices, dtype=np.int32)
        index[skin] = np.arange(len(skin))
        groups, targets, code = [], [], 0
        for group in embedding.decoder.groups:
            n_codes = len(group.weights)
            _, moved, own = np.intersect1d(skin, group.support, return_indices=True)
            weights = group.weights.reshape(n_codes, -1, N_FEATURES)[:, own]
            table = np.ascontiguousarray(weights.reshape(n_codes, -1), dtype=np.float32)
            groups.append(CodeGroup(slice(code, code + n_codes), table))
            targets.append(moved)
            code += n_codes
        return cls(
            point_vertices=vertex,
            members=index[sites],
            geodesic_neighbours=neighbours,
            order=order,
            neighbour_blocks=in_blocks(neighbours, order),
            rest_frame=tangent_frames(embedding, framed).astype(np.float32),
            groups=groups,
            target=np.concatenate(targets).astype(np.int32),
            offset=embedding.decoder.offset[skin].astype(np.float32),
            scale=embedding.decoder.scale.astype(np.float32),
        )
