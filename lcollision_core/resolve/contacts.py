"""Contacts of a pose as linear constraints on its latent codes, and the way out of shallow ones."""

from __future__ import annotations

import daqp
import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled
from lcollision_core.contact import SelfCollisions
from lcollision_core.embedding import Embedding
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.depth_slopes import depth_slopes
from lcollision_core.resolve.exact import ExactCheck
from lcollision_core.resolve.problem import ResolveProblem

MAX_REGIONS = 6
"""Most contacts of a pose, one for each of the deepest pairs of domains."""

CLEARANCE = 2e-4
"""In normalised length: gap that touching surfaces are moved to, as the model is linear."""

POLISH_ROUNDS = 6
_OPTIMAL = 1
_TOLERANCE = 1e-9


class Contacts:
    """Half-spaces of latent poses that separate the contacts seen so far.

    Parameters
    ----------
    check, problem : of the pose
    """

    def __init__(self, check: ExactCheck, problem: ResolveProblem) -> None:
        self._check, self._problem = check, problem
        self._normals = np.empty((0, len(problem.target)))
        self._offsets = np.empty(0)

    def add(self, latent: FloatArray) -> bool:
        """Add the contacts of a (D,) pose; False if it is free and has none."""
        decoded = self._check.decode(latent)[0]
        found = self._check.find(self._check.exported(decoded))
        if not found.colliding:
            return False
        depth, slopes = contact_slopes(self._check.embedding, latent, decoded, found)
        self._normals = np.concatenate([self._normals, slopes])
        self._offsets = np.concatenate([self._offsets, slopes @ latent - depth - CLEARANCE])
        return True

    def drop_refuted(self, free: FloatArray) -> None:
        """Forget half-spaces that a free pose lies outside: they were extrapolated too far."""
        kept = self._normals @ free <= self._offsets + CLEARANCE
        self._normals, self._offsets = self._normals[kept], self._offsets[kept]

    def nearest(self, centre: FloatArray) -> FloatArray | None:
        """Return the pose nearest to a (D,) pose in all half-spaces, None if there is none."""
        return nearest_within(self._problem, centre, self._normals, self._offsets)


def nearest_within(
    problem: ResolveProblem, centre: FloatArray, normals: FloatArray, offsets: FloatArray
) -> FloatArray | None:
    """Minimise d(Z, centre) subject to normals Z <= offsets and the bounds.

    Parameters
    ----------
    problem : gives d and the bounds
    centre : (D,) float64 array within the bounds
    normals : (C, D) float64 array
    offsets : (C,) float64 array

    Returns
    -------
    latent : (D,) float64 array, or None if the half-spaces have no point in common

    Notes
    -----
    Dual active sets: Arnström, Bemporad and Axehill, "A dual active-set solver for embedded
    quadratic programming using recursive LDL^T updates", 2022.
    """
    movable = np.flatnonzero(problem.movable)
    metric = problem.metric[np.ix_(movable, movable)]
    # The bounds of the moves come first, then the half-spaces.
    most = np.concatenate([(problem.high - centre)[movable], offsets - normals @ centre])
    least = np.concatenate([(problem.low - centre)[movable], np.full(len(normals), -np.inf)])
    moved, _, status, _ = daqp.solve(
        metric * (len(metric) / np.trace(metric)),
        np.zeros(len(movable)),
        np.ascontiguousarray(normals[:, movable]),
        most,
        least,
        primal_tol=_TOLERANCE,
    )
    if status != _OPTIMAL:
        return None
    latent = centre.copy()
    latent[movable] += moved
    return np.clip(latent, problem.low, problem.high)


def polish(check: ExactCheck, problem: ResolveProblem, start: FloatArray) -> FloatArray | None:
    """Leave shallow contact by a small move.

    Newton's method on the depths of the contacts: each round takes the smallest move that separates
    all contacts seen so far. Depths of pairs of faces saturate where bodies are deep within each
    other, and then give no direction: such poses fail.

    Parameters
    ----------
    check, problem : of the pose
    start : (D,) float64 array

    Returns
    -------
    latent : (D,) float64 array, collision-free, or None

    Raises
    ------
    CancelledError : the problem's token was set.
    """
    contacts = Contacts(check, problem)
    latent = start
    for _ in range(POLISH_ROUNDS):
        problem.deadline.poll()
        if not contacts.add(latent):
            return latent
        goal = contacts.nearest(start)
        if goal is None or problem.deadline.expired:
            return None
        latent = goal
    return latent if check.is_free(latent) else None


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
    decoded : (V, 3) float64 array, its vertices in normalised length
    found : its colliding pairs, at least one

    Returns
    -------
    depth : (C,) float64 array > 0, normalised, the deepest first, at most `MAX_REGIONS`
    slopes : (C, D) float64 array

    Notes
    -----
    A pair's depth is at most the size of its triangles, so this leads out of shallow contact only.
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
    at = np.repeat(decoder.features(codes[None]), len(by_vertices), axis=0)
    by_features = codec.decode_vjp(at, by_vertices, n_threads=1)
    scaled = (by_features * decoder.scale).astype(np.float32)
    slopes = np.zeros((len(by_vertices), len(latent)))
    start = 0
    for group in decoder.groups:
        stop = start + len(group.weights)
        _pull_group(codes[start:stop], group.blocks, group.support, scaled, slopes[:, start:stop])
        start = stop
    return slopes


@compiled
def _pull_group(
    codes: npt.NDArray[np.float32],
    blocks: npt.NDArray[np.float32],
    support: npt.NDArray[np.int32],
    by_output: npt.NDArray[np.float32],
    by_codes: FloatArray,
) -> None:
    """Add the derivative by one group's codes, given the one by its scaled output.

    Parameters
    ----------
    codes : (m,) float32 array
    blocks, support : of a `DecoderGroup`
    by_output : (n, V, 9) float32 array
    by_codes : (n, m) float64 array, added to
    """
    width = blocks.shape[2]
    weighted = np.zeros((len(by_output), width), dtype=np.float32)
    for block in range(len(blocks)):
        slope = np.zeros(width, dtype=np.float32)
        for k in range(len(codes)):
            slope += codes[k] * blocks[block, k]
        slope = np.tanh(slope)
        slope = np.float32(1.0) - slope * slope
        first = block * width // 9
        last = min(first + width // 9, len(support))
        for row in range(len(by_output)):
            out = weighted[row]
            for n in range(last - first):
                given = by_output[row, support[first + n]]
                for j in range(9):
                    out[9 * n + j] = given[j] * slope[9 * n + j]
            out[9 * (last - first) :] = np.float32(0.0)
        # A product for each block, small enough for the library to keep to this thread.
        by_codes += np.dot(weighted, blocks[block].T)
