"""The code whose decoded mesh lies nearest to a given one: Gauss-Newton on the vertex error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.meshes.alignment import fit_rigid
from lcollision_core.meshes.topology import FloatArray

MAX_STEPS = 20
PRIOR_SHARE = 2.5e-3
"""Of the mean squared vertex distance reached so far: what a code at one training deviation costs.
It settles what the vertices do not, and vanishes for a mesh that the decoder can reach, whose
code thus comes back."""

_SETTLED = 0.02
_HALVINGS = 5


class Decoder(Protocol):
    """Latent codes to unscaled features, with derivatives: see `FeatureDecoder`."""

    @property
    def latent_size(self) -> int:
        """D, the number of codes."""

    def features(self, latent: npt.NDArray[Any]) -> FloatArray:
        """(B, D) to (B, V, 9)."""

    def tangents(self, latent: npt.NDArray[Any]) -> FloatArray:
        """(D,) to (D, V, 9)."""


@dataclass(frozen=True)
class LatentFit:
    """Codes fitted to meshes.

    Attributes
    ----------
    latent : (B, D) float32 array
    rotations : (B, 3, 3) float64 array
    translations : (B, 3) float64 array, normalised: the decoded mesh lies nearest to the aligned
        one, `vertices @ rotation.T + translation`
    mean_error, max_error : (B,) float64 arrays, distance of the decoded vertices from the aligned
        ones, normalised
    """

    latent: npt.NDArray[np.float32]
    rotations: FloatArray
    translations: FloatArray
    mean_error: FloatArray
    max_error: FloatArray


@dataclass(frozen=True)
class _Candidate:
    latent: npt.NDArray[np.float32]
    rotation: FloatArray
    translation: FloatArray
    decoded: FloatArray
    aligned: FloatArray
    misfit: float


def fit_latent(
    decoder: Decoder,
    codec: AcapCodec,
    vertices: npt.NDArray[Any],
    guess: npt.NDArray[Any],
    deviation: npt.NDArray[Any],
    max_steps: int = MAX_STEPS,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
    *,
    in_place: bool = False,
) -> LatentFit:
    """Fit code and rigid motion together to each mesh.

    Minimises the mean squared vertex distance over all rigid motions of the mesh, by damped
    Gauss-Newton from a guess, where each step weighs the distance d² that it starts from against
    `PRIOR_SHARE` d² Σ (z / deviation)².

    Parameters
    ----------
    decoder : latent codes to features
    codec : features to vertices
    vertices : (B, V, 3) array, normalised, in any rigid position; only vertices that a face uses
        count
    guess : (B, D) array, where to start
    deviation : (D,) array > 0, of the training codes
    max_steps : at most so many steps a mesh; it stops earlier when a step gains under 2 %
    progress : called with (meshes done, meshes in all)
    cancel : polled before each mesh
    in_place : the mesh stays where it is, and the codes alone are fitted

    Returns
    -------
    fit : LatentFit

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    targets = np.asarray(vertices, dtype=np.float64)
    n_poses = len(targets)
    latent = np.empty((n_poses, decoder.latent_size), dtype=np.float32)
    rotations, translations = np.empty((n_poses, 3, 3)), np.empty((n_poses, 3))
    mean_error, max_error = np.empty(n_poses), np.empty(n_poses)
    for pose, target in enumerate(targets):
        if cancel is not None:
            cancel.raise_if_cancelled()
        best = _fit_one(
            decoder, codec, target, guess[pose], np.asarray(deviation), max_steps, in_place
        )
        latent[pose] = best.latent
        rotations[pose], translations[pose] = best.rotation, best.translation
        distances = np.linalg.norm(best.decoded - best.aligned, axis=1)
        mean_error[pose], max_error[pose] = distances.mean(), distances.max()
        progress(pose + 1, n_poses)
    return LatentFit(latent, rotations, translations, mean_error, max_error)


def _fit_one(
    decoder: Decoder,
    codec: AcapCodec,
    target: FloatArray,
    guess: npt.NDArray[Any],
    deviation: FloatArray,
    max_steps: int,
    in_place: bool,
) -> _Candidate:
    inverse_variance = deviation.astype(np.float64) ** -2.0
    picked = codec.topology.picked
    target = target[picked]
    n_vertices = len(target)

    def at(latent: npt.NDArray[Any]) -> _Candidate:
        code = latent.astype(np.float32)
        decoded = codec.decode(decoder.features(code[None]), n_threads=1)[0, picked]
        rotation, translation = np.eye(3), np.zeros(3)
        if not in_place:
            rotation, translation = fit_rigid(target, decoded)
        aligned = target @ rotation.T + translation
        misfit = float(((decoded - aligned) ** 2).sum() / n_vertices)
        return _Candidate(code, rotation, translation, decoded, aligned, misfit)

    def cost(candidate: _Candidate, stiffness: FloatArray) -> float:
        prior = float((stiffness * candidate.latent.astype(np.float64) ** 2).sum())
        return candidate.misfit + prior

    best = at(np.asarray(guess))
    for _ in range(max_steps):
        stiffness = PRIOR_SHARE * best.misfit * inverse_variance
        start_cost = cost(best, stiffness)
        features = decoder.features(best.latent[None])[0]
        moved = codec.decode_jvp(features, decoder.tangents(best.latent))[:, picked]
        jacobian = moved.reshape(len(moved), -1).T
        if not in_place:
            # The mesh is free to turn and shift after the pose, so only what no small rigid
            # motion could undo counts.
            rigid = np.empty((n_vertices, 3, 6))
            rigid[:, :, :3] = np.eye(3)
            centred = best.decoded - best.decoded.mean(axis=0)
            for axis in range(3):
                rigid[:, :, 3 + axis] = np.cross(np.eye(3)[axis], centred)
            jacobian = np.concatenate([jacobian, rigid.reshape(3 * n_vertices, 6)], axis=1)
        normal = jacobian.T @ jacobian / n_vertices
        slope = jacobian.T @ (best.decoded - best.aligned).ravel() / n_vertices
        n_codes = len(stiffness)
        slope[:n_codes] += stiffness * best.latent
        normal[np.arange(n_codes), np.arange(n_codes)] += stiffness
        # A mesh on a line leaves a turn open.
        normal[np.arange(len(normal)), np.arange(len(normal))] += 1e-12 * np.trace(normal)
        step = np.linalg.solve(normal, slope)[:n_codes]
        length = 1.0
        for _ in range(_HALVINGS):
            candidate = at(best.latent - length * step)
            if cost(candidate, stiffness) < start_cost:
                break
            length *= 0.5
        else:
            break
        gain = 1.0 - cost(candidate, stiffness) / start_cost
        best = candidate
        if gain < _SETTLED:
            break
    return best
