"""How long learning takes."""

from __future__ import annotations

from lcollision_core.embedding import ROWS_PER_BLOCK
from lcollision_core.jobs import available_cores
from lcollision_core.labels.labeller import BOX_ROWS, MIXED_COST
from lcollision_core.learning.effort import EFFORTS, Effort
from lcollision_core.learning_state import Stage
from lcollision_core.options import Quality

_TRAINED = 1.0 - 0.3 * BOX_ROWS / ROWS_PER_BLOCK
"""Fraction of the labelled samples that train the predictor."""


_FOLDED = 3000
"""Colliding samples in which folds are searched for."""


def estimated_seconds(
    n_vertices: int,
    n_poses: int,
    quality: Quality,
    n_cores: int | None = None,
    *,
    row_seconds: float | None = None,
    colliding_share: float = 0.5,
) -> dict[Stage, float]:
    """Estimate the time of each stage from measurements on two cores.

    Parameters
    ----------
    n_vertices, n_poses : of the poses to learn from
    quality : of the model
    n_cores : that are used, by default those that there are
    row_seconds : what a sample has taken to decode and check, on all cores, which layers of clothes
        make several times as much; None estimates it by the vertices
    colliding_share : of the samples, which alone are checked again for the predictor

    Returns
    -------
    seconds : by stage

    Notes
    -----
    Measured: 2161 and 14 442 vertices, 71 and 100 poses, 20 000 samples, see docs/results.md; stage
    1 in docs/experiments.md.
    """
    effort = EFFORTS[quality]
    share = 2.0 / (available_cores() if n_cores is None else n_cores)
    rows = int(_TRAINED * effort.n_samples)
    shown = rows * effort.predictor.passes(rows)
    row = 3.5e-7 * n_vertices * share if row_seconds is None else row_seconds
    colliding = colliding_share * rows
    again = (colliding + min(colliding, _FOLDED)) * row
    judged = 6e-6 * effort.n_judged * n_vertices * share
    return {
        Stage.POSES: 5.0 + 1e-5 * n_vertices * n_poses * share,
        Stage.LATENT_SPACE: 3.0 + _latent_space(effort, share) * n_vertices * n_poses,
        Stage.LABELS: effort.n_samples * MIXED_COST * row,
        Stage.PREDICTOR: 10.0 + again + 7e-4 * shown * share + judged,
    }


def _latent_space(effort: Effort, share: float) -> float:
    """Return the seconds of stage 1 for each vertex of each pose; codes are fitted on threads."""
    config = effort.embedding
    n_codes = config.n_domains * (1 + config.n_domain_codes)
    micros = 9.0 + 0.45 * config.level1_epochs + 2.3 * config.level2_epochs
    micros += 0.25 * share * n_codes
    if config.held_out_stride:
        micros += 5.0 + 0.4 * config.level1_epochs + 2.1 * config.level2_epochs
        micros += 0.05 * share * n_codes
    return 1e-6 * micros
