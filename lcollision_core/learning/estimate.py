"""How long learning takes."""

from __future__ import annotations

from lcollision_core.jobs import available_cores
from lcollision_core.learning.effort import EFFORTS, Quality
from lcollision_core.learning.status import Stage


def estimated_seconds(
    n_vertices: int, n_poses: int, quality: Quality, n_cores: int | None = None
) -> dict[Stage, float]:
    """Estimate the time of each stage from measurements on two cores.

    Parameters
    ----------
    n_vertices, n_poses : of the poses to learn from
    quality : of the model
    n_cores : that are used, by default those that there are

    Returns
    -------
    seconds : by stage
    """
    effort = EFFORTS[quality]
    share = 2.0 / (available_cores() if n_cores is None else n_cores)
    return {
        Stage.POSES: 5.0 + 2e-5 * n_vertices * n_poses * share,
        Stage.LATENT_SPACE: 10.0 + 3e-4 * n_vertices * n_poses,
        Stage.LABELS: effort.n_samples * 1.2e-6 * n_vertices * share,
        Stage.PREDICTOR: 30.0 + 3e-3 * effort.n_samples * share,
    }
