"""Figures of a predictor on held-out samples: risk and coverage, ROC, calibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyvista as pv

from app.view.offscreen import save_chart
from lcollision_core.errors import MeshFileError
from lcollision_core.predictor.metrics import roc_curve, sure_ranges

if TYPE_CHECKING:
    from lcollision_core.predictor import ScoredRows

_COLOUR, _REFERENCE = (18, 64, 133), (150, 150, 150)
_BOUNDS = np.geomspace(1e-5, 0.5, 400)
_PERCENT = (0.0, 100.0)
_CURVE_POINTS = 1000
"""Of a ROC curve, which has as many steps as there are samples."""


def save_figures(scored: ScoredRows, path: Path) -> None:
    """Save the risk-coverage curve as a .png, or all figures into a folder.

    Parameters
    ----------
    scored : at least one sample, none of which trained the predictor
    path : of the picture, or of a folder, made if there is none

    Raises
    ------
    MeshFileError : a picture cannot be written.
    """
    if path.suffix:
        _draw_risk(scored, path)
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MeshFileError.unwritable(path, error, "name another folder") from error
    _draw_risk(scored, path / "risk.png")
    _draw_roc(scored, path / "roc.png")
    _draw_calibration(scored, path / "calibration.png")


def _draw_risk(scored: ScoredRows, path: Path) -> None:
    """Draw how often the predictor errs among the poses that it is sure of."""
    ranges = sure_ranges(scored.logit, scored.rows.colliding, _BOUNDS.tolist())
    partial = [sure for sure in ranges if sure.coverage < 1.0]
    risk = [100.0 * sure.error_bound for sure in partial]
    chart = _chart(
        f"{len(scored.rows)} held-out samples, with a confidence of 95 %",
        "coverage: share of the samples that are judged (%)",
        "risk: wrong verdicts among all samples, at most (%)",
    )
    _add_line(chart, [100.0 * sure.coverage for sure in partial], risk)
    chart.y_range = (0.0, 1.1 * max(risk, default=1.0))
    save_chart(chart, path)


def _draw_roc(scored: ScoredRows, path: Path) -> None:
    """Draw the colliding poses that are called so by the free ones that are, at each threshold."""
    auc, colliding = scored.auc, scored.rows.colliding
    said = "one class is missing" if auc is None else f"area {auc:.4f}"
    chart = _chart(
        f"ROC of {len(colliding)} held-out samples: {said}",
        "false positive rate: free poses called colliding (%)",
        "true positive rate: colliding poses called colliding (%)",
    )
    chart.line([0.0, 100.0], [0.0, 100.0], color=_REFERENCE, style="--")
    if auc is not None:
        by, of = roc_curve(scored.logit, colliding)
        kept = np.unique(np.linspace(0, len(by) - 1, _CURVE_POINTS).astype(int))
        _add_line(chart, (100.0 * by[kept]).tolist(), (100.0 * of[kept]).tolist())
    chart.y_range = _PERCENT
    save_chart(chart, path)


def _draw_calibration(scored: ScoredRows, path: Path) -> None:
    """Draw the share of samples that collide by the predicted probability."""
    metrics = scored.metrics()
    bins = [entry for entry in metrics.calibration if entry.probability is not None]
    chart = _chart(
        f"Calibration on {metrics.samples} held-out samples: expected error "
        f"{100.0 * metrics.calibration_error:.1f} %",
        "predicted probability of a collision (%)",
        "samples that collide (%)",
    )
    chart.line([0.0, 100.0], [0.0, 100.0], color=_REFERENCE, style="--")
    predicted = [100.0 * (entry.probability or 0.0) for entry in bins]
    colliding = [100.0 * (entry.colliding_share or 0.0) for entry in bins]
    _add_line(chart, predicted, colliding)
    if predicted:
        chart.scatter(predicted, colliding, color=_COLOUR, size=12)
    chart.y_range = _PERCENT
    save_chart(chart, path)


def _chart(title: str, x_label: str, y_label: str) -> pv.Chart2D:
    chart = pv.Chart2D(x_label=x_label)
    chart.y_label, chart.title, chart.x_range = y_label, title, _PERCENT
    return chart


def _add_line(chart: pv.Chart2D, x: Sequence[float], y: Sequence[float]) -> None:
    if x:
        chart.line(x, y, color=_COLOUR, width=3.0)
