"""The code whose decoded mesh lies nearest to a given one: Gauss-Newton on the vertex error."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.jobs import CancelToken
from lcollision_core.meshes.alignment import fit_rigid
from lcollision_core.meshes.topology import FloatArray

MAX_STEPS = 20
"""Jacobians computed at most; the fit ends earlier when a step with a new one gains under 2 %."""

PRIOR_SHARE = 2.5e-3
"""Cost of a code at one training deviation, relative to the mean squared vertex distance so far.
It determines what the vertices do not, and vanishes for a mesh that the decoder can represent,
whose code is thus recovered."""

_SETTLED = 0.02
_WORTH_REUSE = 0.1
"""Decoding costs far less than a Jacobian, so steps go on with the same one while they gain this
share of the cost."""
_HALVINGS = 5


class Decoder(Protocol):
    """Latent codes to unscaled features, with derivatives: see `FeatureDecoder`."""

    @property
    def latent_size(self) -> int:
        """D, the number of codes."""

    def features(self, latent: npt.NDArray[Any]) -> FloatArray:
        """(B, D) to (B, V, 9)."""

    def tangent_groups(self, latent: npt.NDArray[Any]) -> Iterator[FloatArray]:
        """(D,) to arrays of (m, V, 9), D rows in all."""


@dataclass(frozen=True)
class LatentFit:
    """A code fitted to a mesh.

    Attributes
    ----------
    latent : (D,) array
    rotation, translation : (3, 3) and (3,) float64 arrays, in normalised lengths: the decoded mesh
        lies nearest to the aligned one, `vertices @ rotation.T + translation`
    mean_error, max_error : distance of the decoded vertices from the aligned ones, in normalised
        lengths
    """

    latent: npt.NDArray[np.floating]
    rotation: FloatArray
    translation: FloatArray
    mean_error: float
    max_error: float


@dataclass(frozen=True)
class _Candidate:
    latent: npt.NDArray[np.float32]
    rotation: FloatArray
    translation: FloatArray
    decoded: FloatArray
    residual: FloatArray
    misfit: float

    def cost(self, stiffness: FloatArray) -> float:
        return self.misfit + float((stiffness * self.latent.astype(np.float64) ** 2).sum())


def fit_latent(
    decoder: Decoder,
    codec: AcapCodec,
    vertices: npt.NDArray[Any],
    guess: npt.NDArray[Any],
    deviation: npt.NDArray[Any],
    cancel: CancelToken | None = None,
    *,
    in_place: bool = False,
    n_threads: int | None = None,
) -> LatentFit:
    """Fit code and rigid motion together to a mesh.

    Minimises the mean squared vertex distance over all rigid motions of the mesh, by damped
    Gauss-Newton from a guess, several steps with one Jacobian, where each step weighs the distance
    d² that it starts from against `PRIOR_SHARE` d² Σ (z / deviation)².

    Parameters
    ----------
    decoder : latent codes to features
    codec : features to vertices
    vertices : (V, 3) array, in normalised lengths, in any rigid position; only vertices that a face
        uses count
    guess : (D,) array, where to start
    deviation : (D,) array > 0, of the training codes
    cancel : polled before each Jacobian
    in_place : the mesh stays where it is, and the codes alone are fitted
    n_threads : threads to compute a Jacobian on, one for each core by default

    Returns
    -------
    fit : LatentFit

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    inverse_variance = np.asarray(deviation, dtype=np.float64) ** -2.0
    picked = codec.topology.picked
    target = np.asarray(vertices, dtype=np.float64)[picked]
    n_vertices, n_codes = len(target), len(inverse_variance)

    def at(latent: npt.NDArray[Any]) -> _Candidate:
        code = latent.astype(np.float32)
        decoded = codec.decode(decoder.features(code[None]), n_threads=1)[0, picked]
        rotation, translation = np.eye(3), np.zeros(3)
        if not in_place:
            rotation, translation = fit_rigid(target, decoded)
        residual = decoded - (target @ rotation.T + translation)
        misfit = float((residual**2).sum() / n_vertices)
        return _Candidate(code, rotation, translation, decoded, residual, misfit)

    def jacobian_at(one: _Candidate) -> FloatArray:
        features = decoder.features(one.latent[None])[0]
        jacobian = np.empty((n_codes + (0 if in_place else 6), n_vertices, 3))
        start = 0
        for tangents in decoder.tangent_groups(one.latent):
            moved = codec.decode_jvp(features, tangents, n_threads)
            jacobian[start : start + len(moved)] = moved[:, picked]
            start += len(moved)
        if not in_place:
            # The mesh is free to turn and shift after the pose, so only what no small rigid
            # motion could undo counts.
            jacobian[n_codes : n_codes + 3] = np.eye(3)[:, None]
            centred = one.decoded - one.decoded.mean(axis=0)
            jacobian[n_codes + 3 :] = np.cross(np.eye(3)[:, None], centred)
        return jacobian.reshape(len(jacobian), -1)

    best = at(np.asarray(guess))
    for _ in range(MAX_STEPS):
        if cancel is not None:
            cancel.raise_if_cancelled()
        jacobian = jacobian_at(best)
        gram = jacobian @ jacobian.T / n_vertices
        gains: list[float] = []
        while not gains or gains[-1] > _WORTH_REUSE:
            stiffness = PRIOR_SHARE * best.misfit * inverse_variance
            slope = jacobian @ best.residual.ravel() / n_vertices
            slope[:n_codes] += stiffness * best.latent
            normal = gram.copy()
            normal[np.arange(n_codes), np.arange(n_codes)] += stiffness
            # A mesh on a line leaves a turn open.
            normal[np.diag_indices_from(normal)] += 1e-12 * np.trace(normal)
            step = np.linalg.solve(normal, slope)[:n_codes]
            halved = (at(best.latent - 0.5**power * step) for power in range(_HALVINGS))
            start_cost = best.cost(stiffness)
            better = next((one for one in halved if one.cost(stiffness) < start_cost), None)
            if better is None:
                gains.append(0.0)
            else:
                gains.append(1.0 - better.cost(stiffness) / start_cost)
                best = better
        if gains[0] < _SETTLED:
            break
    distances = np.linalg.norm(best.residual, axis=1)
    mean_error, max_error = float(distances.mean()), float(distances.max())
    return LatentFit(best.latent, best.rotation, best.translation, mean_error, max_error)
