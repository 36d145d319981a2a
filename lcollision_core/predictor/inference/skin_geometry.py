"""Where the default network looks at a body, and how that skin follows from latent codes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.features import N_FEATURES
from lcollision_core.embedding import Embedding
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.predictor.inference.field_kernels import BLOCK
from lcollision_core.predictor.inference.points import (
    N_POINTS,
    body_points,
    neighbour_order,
    skin_distances,
    skin_graph,
    tangent_frames,
    with_tighter_blocks,
)

DISTANT = 0.10
"""Heights along the surface beyond which two points feel each other."""

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SkinGeometry:
    """The points of the body and the fold sites: a function of the embedding and the sites.

    Attributes
    ----------
    point_vertices : (P,) int64 array, ascending, the vertices that are points of the body
    members : (S, M) int32 array, each site's vertices as numbers of the skin
    order : (O,) int32 array, all points of the body, neighbours near each other, and the last
        again until O is a multiple of `BLOCK`
    apart : (P, O) float32 array, added to squared distances to the points in that order: 1 for
        pairs so near along the surface that they do not feel each other and for those that are
        there again, else 0
    rest_frame : (N, 3, 3) array: of the first N points of the skin, on the reference, as columns,
        the outer normal first; the skin is the P points, then the sites' centres that are none,
        and last their other vertices, which need no frame
    blocks : (G, 4) int64 array: of each group of codes its first and past its last, and likewise
        of the outputs that they make, nine for each point that they move
    tables : the groups' (codes, outputs) matrices one after the other, flat float32
    target : (T,) int32 array, the point of the skin that nine outputs belong to
    offset : (Q, 9) float32 array, deformation features of codes 0
    scale : (9,) float32 array, of the outputs
    """

    point_vertices: npt.NDArray[np.int64]
    members: npt.NDArray[np.int32]
    order: npt.NDArray[np.int32]
    apart: Float32Array
    rest_frame: FloatArray
    blocks: npt.NDArray[np.int64]
    tables: Float32Array
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
        """Look at an embedding's body.

        Parameters
        ----------
        embedding : of the body
        sites : (S, M) vertices about each place where the skin folds, see `find_fold_sites`
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
        between = skin_distances(skin_graph(embedding), vertex, limit=DISTANT)[:, vertex]
        order = neighbour_order(embedding.rest_vertices[vertex], BLOCK)
        order = with_tighter_blocks(order, between, BLOCK)
        apart = np.isfinite(between)[:, order]
        apart[:, len(vertex) :] = True
        place = np.zeros(n_vertices, dtype=np.int32)
        place[skin] = np.arange(len(skin))
        decoder = embedding.decoder
        blocks, tables, targets = [], [], []
        code = output = 0
        for group in decoder.groups:
            n_codes = len(group.weights)
            _, moved, own = np.intersect1d(skin, group.support, return_indices=True)
            weights = group.weights.reshape(n_codes, -1, N_FEATURES)[:, own]
            n_outputs = N_FEATURES * len(own)
            blocks.append((code, code + n_codes, output, output + n_outputs))
            tables.append(weights.reshape(-1))
            targets.append(moved)
            code, output = code + n_codes, output + n_outputs
        return cls(
            point_vertices=vertex,
            members=place[sites],
            order=order,
            apart=np.ascontiguousarray(apart, dtype=np.float32),
            rest_frame=tangent_frames(embedding, framed),
            blocks=np.array(blocks),
            tables=np.concatenate(tables),
            target=np.concatenate(targets).astype(np.int32),
            offset=decoder.offset[skin].astype(np.float32),
            scale=decoder.scale.astype(np.float32),
        )
