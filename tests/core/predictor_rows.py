"""Rows whose energies are known functions of the latent, and configurations that train fast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lcollision_core.bodies import LearnedBody
from lcollision_core.embedding import Embedding
from lcollision_core.labels import LabelRows
from lcollision_core.predictor import PRESETS, PredictorConfig

N_ROWS = 1500

PAPER = PRESETS["paper"]
QUICK = replace(PAPER, batch_rows=64, epochs=4, average_passes=0.0)


def made_up_rows(embedding: Embedding, n_rows: int = N_ROWS, seed: int = 1) -> LabelRows:
    """Draw latents; those whose first code exceeds a third of a unit count as colliding."""
    rng = np.random.default_rng(seed)
    latent = rng.uniform(-1.0, 1.0, (n_rows, embedding.latent_size)).astype(np.float32)
    depth = np.maximum(latent[:, 0] - 1.0 / 3.0, 0.0).astype(np.float64)
    share = 0.5 + 0.4 * np.sign(latent[:, 1])
    domain_energy = np.zeros((n_rows, embedding.n_domains))
    domain_energy[:, 0], domain_energy[:, 1] = 1e-4 * depth * share, 1e-4 * depth * (1.0 - share)
    return LabelRows(
        latent=latent,
        domain_energy=domain_energy,
        energy=domain_energy.sum(axis=1),
        n_pairs=(depth > 0.0).astype(np.int32),
    )


def colliding_latent(model: LearnedBody, n_poses: int = 60) -> np.ndarray:
    """Draw poses far outside the latent box, where a tube folds onto itself."""
    latent = model.latent_space.sample(n_poses, np.random.default_rng(3))
    return (2.5 * latent).astype(np.float32)


def weights_of(section_arrays: dict[str, np.ndarray]) -> bytes:
    """Return all weights' bytes, to compare predictors exactly."""
    return b"".join(section_arrays[name].tobytes() for name in sorted(section_arrays))


def config(**changes: object) -> PredictorConfig:
    return replace(QUICK, **changes)  # type: ignore[arg-type]
