"""Contacts of a pose as linear constraints on its latent codes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled
from lcollision_core.contact import SelfCollisions
from lcollision_core.embedding import Embedding
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.depth_slopes import depth_slopes
from lcollision_core.resolve.exact import ExactCheck
from lcollision_core.resolve.nearest import nearest_within
from lcollision_core.resolve.problem import ResolveProblem

MAX_REGIONS = 6
"""The deepest pairs of domains that a pose's contacts are told apart by."""

CLEARANCE = 2e-4
"""In heights: how far apart what touches is to be put, for what a linear model leaves out."""


class Contacts:
    """Half-spaces of latent poses in which the contacts seen so far are apart.

    Parameters
    ----------
    check, problem : of the pose
    """

    def __init__(self, check: ExactCheck, problem: ResolveProblem) -> None:
        self._check, self._problem = check, problem
        self._normals = np.empty((0, len(problem.target)))
        self._offsets = np.empty(0)

    def add(self, latent: FloatArray) -> bool:
        """Add the contacts of a (D,) pose; False where it is free and has none."""
        decoded = self._check.decode(latent)[0]
        found = self._check.find(decoded)
        if not found.colliding:
            return False
        depth, slopes = contact_slopes(self._check.embedding, latent, decoded, found)
        self._normals = np.concatenate([self._normals, slopes])
        self._offsets = np.concatenate([self._offsets, slopes @ latent - depth - CLEARANCE])
        return True

    def drop_refuted(self, free: FloatArray) -> None:
        """Forget half-spaces that a free pose lies outside of: they were extrapolated too far."""
        kept = self._normals @ free <= self._offsets + CLEARANCE
        self._normals, self._offsets = self._normals[kept], self._offsets[kept]

    def nearest(self, centre: FloatArray) -> FloatArray | None:
        """Return the pose nearest to a (D,) pose in all half-spaces, None where there is none."""
        return nearest_within(self._problem, centre, self._normals, self._offsets)


def contact_slopes(
    embedding: Embedding,
    latent: FloatArray,
    decoded: FloatArray,
    found: SelfCollisions,
) -> tuple[FloatArray, FloatArray]:
    """Measure how deep the contacts of a colliding pose are, and how that changes with its codes.

    The pairs between the same two domains count as one contact. Its depth is the mean of their
    depths weighted by their squares, so that it is the depth of the deepest where one stands out,
    and its slope that mean of theirs.

    Parameters
    ----------
    embedding : decodes
    latent : (D,) float64 array
    decoded : (V, 3) float64 array, its vertices in heights
    found : its colliding pairs, at least one

    Returns
    -------
    depth : (C,) float64 array > 0, in heights, the deepest first, at most `MAX_REGIONS`
    slopes : (C, D) float64 array

    Notes
    -----
    A pair's depth is at most the size of its triangles, so this tells the way out of shallow
    contact only.
    """
    faces = embedding.topology.faces[found.pairs]
    _, by_corners = depth_slopes(decoded[faces[:, 0]], decoded[faces[:, 1]])
    depths = found.penetration_depth
    owner = embedding.attention_mask.argmax(axis=0)[faces[:, :, 0]]
    region = np.sort(owner, axis=1) @ np.array([embedding.n_domains, 1])
    names, region = np.unique(region, return_inverse=True)
    squared = depths**2
    total = np.bincount(region, squared, minlength=len(names))
    depth = np.bincount(region, squared * depths, minlength=len(names)) / total
    deepest = np.argsort(-depth, kind="stable")[:MAX_REGIONS]
    by_vertices = np.zeros((len(names), *decoded.shape))
    weighted = by_corners * (squared / total[region])[:, None, None]
    corners = faces.reshape(len(faces), 6)
    np.add.at(by_vertices, (region[:, None], corners), weighted)
    return depth[deepest], pull_to_latent(embedding, latent, by_vertices[deepest])


def pull_to_latent(
    embedding: Embedding, latent: FloatArray, by_vertices: npt.NDArray[np.float64]
) -> FloatArray:
    """Turn derivatives by one pose's decoded vertices, (n, V, 3), into those by its codes, (n, D).

    The transpose of the decoder's Jacobian, by one more back-substitution.
    """
    decoder, codec = embedding.decoder, embedding.codec
    codes = latent.astype(np.float32)
    features = decoder.features(codes[None])
    at = np.repeat(features, len(by_vertices), axis=0)
    by_features = codec.decode_vjp(at, by_vertices, n_threads=1)
    by_features *= decoder.scale
    scaled = by_features.astype(np.float32)
    result = np.empty((len(by_vertices), len(latent)))
    start = 0
    for group in decoder.groups:
        stop = start + len(group.weights)
        total = np.empty((len(group.blocks), group.blocks.shape[2]), dtype=np.float32)
        _weigh(codes[start:stop], group.blocks, total)
        slope = np.float32(1.0) - np.tanh(total) ** 2
        part = np.zeros((len(scaled), stop - start))
        _pull_group(group.blocks, group.support, slope, scaled, part)
        result[:, start:stop] = part
        start = stop
    return result


@compiled
def _weigh(
    codes: npt.NDArray[np.float32],
    blocks: npt.NDArray[np.float32],
    total: npt.NDArray[np.float32],
) -> None:
    """Write codes @ weights, block by block."""
    for block in range(len(blocks)):
        weights, sums = blocks[block], total[block]
        sums[:] = np.float32(0.0)
        for k in range(len(codes)):
            code = codes[k]
            for i in range(len(sums)):
                sums[i] += code * weights[k, i]


@compiled
def _pull_group(
    blocks: npt.NDArray[np.float32],
    support: npt.NDArray[np.int32],
    slope: npt.NDArray[np.float32],
    by_output: npt.NDArray[np.float32],
    by_codes: FloatArray,
) -> None:
    """Add the derivative by one group's codes, given the one by its output and its slope there.

    Parameters
    ----------
    blocks, support : of a `DecoderGroup`
    slope : (n_blocks, 9 n) float32 array, of tanh
    by_output : (n, V, 9) float32 array
    by_codes : (n, m) float64 array, added to
    """
    width = slope.shape[1]
    # A product for each block, small enough for the library to keep to this thread.
    weighted = np.zeros((len(by_output), width), dtype=np.float32)
    for block in range(len(blocks)):
        first = block * width // 9
        last = min(first + width // 9, len(support))
        for row in range(len(by_output)):
            out = weighted[row]
            for n in range(last - first):
                given = by_output[row, support[first + n]]
                for j in range(9):
                    out[9 * n + j] = given[j] * slope[block, 9 * n + j]
            out[9 * (last - first) :] = np.float32(0.0)
        by_codes += np.dot(weighted, blocks[block].T)
