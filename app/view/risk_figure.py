"""The risk-coverage curve of a predictor: how often it errs among the poses it is sure of."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyvista as pv

from app.view.offscreen import save_chart
from lcollision_core.predictor.certainty import sure_ranges

if TYPE_CHECKING:
    from lcollision_core.labels import LabelRows
    from lcollision_core.predictor import CollisionPredictor

_COLOUR = (18, 64, 133)
_BOUNDS = np.geomspace(1e-5, 0.5, 400)


def draw_risk(predictor: CollisionPredictor, rows: LabelRows, path: Path) -> None:
    """Draw the curve of held-out rows as a PNG, whole or not at all.

    Parameters
    ----------
    predictor : of the model that the rows label
    rows : at least one, none of which trained the predictor
    path : of the picture

    Raises
    ------
    MeshFileError : it cannot be written.
    """
    logit = predictor.scaled_outputs(rows.latent)[1]
    found = sure_ranges(logit, rows.colliding, _BOUNDS.tolist())
    chart = pv.Chart2D(x_label="coverage: share of the samples that are judged (%)")
    chart.y_label = "risk: wrong verdicts among all samples, at most (%)"
    chart.title = f"{len(rows)} held-out samples, with a confidence of 95 %"
    coverage = [100.0 * one.coverage for one in found if one.coverage < 1.0]
    risk = [100.0 * one.error_bound for one in found if one.coverage < 1.0]
    if coverage:
        chart.line(coverage, risk, color=_COLOUR, width=3.0)
    chart.x_range, chart.y_range = (0.0, 100.0), (0.0, 1.1 * max(risk, default=1.0))
    save_chart(chart, path)
