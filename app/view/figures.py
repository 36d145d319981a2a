"""Figures of a model: its attention masks and its evaluation."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyvista as pv
from PIL import Image, ImageDraw, ImageFont

from app.view.camera import preset_view
from app.view.offscreen import PoseRenderer, save_chart, save_png
from app.view.shading import LIGHT, mask_colours
from lcollision_core.errors import MeshFileError
from lcollision_core.predictor.metrics import roc_curve, sure_ranges

if TYPE_CHECKING:
    from lcollision_core.bodies import Body
    from lcollision_core.predictor import ScoredRows


_VIEW_WIDTH, _VIEW_HEIGHT = 900, 1300
_LEGEND_COLUMN, _LEGEND_ROW = 425, 52
_MARGIN = 50


def parts_image(model: Body, width: int, height: int) -> Image.Image:
    """Draw the same two sides as `draw_masks`, without names, on a transparent background.

    Parameters
    ----------
    width, height : of the whole picture, in pixels
    """
    picture = Image.new("RGBA", (width, height))
    renderer = PoseRenderer(model, width // 2, height, LIGHT, transparent=True)
    _paste_sides(picture, renderer, model, width // 2, height)
    return picture


def draw_masks(model: Body, path: str | os.PathLike[str]) -> None:
    """Draw the rest pose from two sides, each domain in its colour, stronger with larger weight.

    Parameters
    ----------
    model : of the attention masks
    path : the .png file to write, atomically

    Raises
    ------
    MeshFileError : the file cannot be written.

    Notes
    -----
    After figure 2 of Tan et al. 2021.
    """
    names, colours = model.domain_names, model.card.domain_colours
    n_columns = min((2 * _VIEW_WIDTH - 2 * _MARGIN) // _LEGEND_COLUMN, len(names))
    n_rows = -(-len(names) // n_columns)
    height = _VIEW_HEIGHT + n_rows * _LEGEND_ROW + 2 * _MARGIN
    picture = Image.new("RGB", (2 * _VIEW_WIDTH, height), "white")

    renderer = PoseRenderer(model, _VIEW_WIDTH, _VIEW_HEIGHT, LIGHT)
    renderer.scene.show_floor(False)
    renderer.scene.set_plain_background("#ffffff")
    _paste_sides(picture, renderer, model, _VIEW_WIDTH, _VIEW_HEIGHT)

    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(size=26)
    left = (2 * _VIEW_WIDTH - n_columns * _LEGEND_COLUMN) // 2
    for domain, (name, colour) in enumerate(zip(names, colours, strict=True)):
        column, row = divmod(domain, n_rows)
        x = left + column * _LEGEND_COLUMN
        y = _VIEW_HEIGHT + _MARGIN + row * _LEGEND_ROW
        shades = mask_colours(np.linspace(0.0, 1.0, 60)[None], (colour,))
        picture.paste(Image.fromarray(np.tile(shades, (30, 1, 1))), (x, y))
        draw.rectangle((x, y, x + 60, y + 30), outline="#c8c8cd")
        draw.text((x + 76, y + 15), name, fill="#282c34", font=font, anchor="lm")
    save_png(picture, path)


def _paste_sides(
    picture: Image.Image, renderer: PoseRenderer, model: Body, width: int, height: int
) -> None:
    """Draw the front and the back of the rest pose side by side, and close the renderer."""
    from lcollision_core.meshes.normals import vertex_normals

    scene, vertices = renderer.scene, model.reference.astype(np.float32)
    normals = vertex_normals(vertices, model.faces)
    scene.show(vertices, normals, mask_colours(model.attention_mask, model.card.domain_colours))
    for index, side in enumerate(("Front", "Back")):
        scene.view = preset_view(side, vertices, model.up, model.front, width / height)
        picture.paste(renderer.drawn(), (index * width, 0))
    renderer.close()


_COLOUR, _REFERENCE = (18, 64, 133), (150, 150, 150)
_BOUNDS = np.geomspace(1e-5, 0.5, 400)
_PERCENT = (0.0, 100.0)
_CURVE_POINTS = 1000
"""Largest number of points drawn of a ROC curve, which has as many steps as samples."""


def save_figures(scored: ScoredRows, path: Path) -> None:
    """Save the risk-coverage curve as a .png, or all figures into a folder.

    Parameters
    ----------
    scored : at least one sample, none of them used to train the predictor
    path : of the picture, or of a folder, made if it does not exist

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
    """Draw the risk of the predictor by its coverage, the share of poses that it is sure of."""
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
    """Draw the ROC curve: true positive rate by false positive rate, at each threshold."""
    auc, colliding = scored.auc, scored.rows.colliding
    area_text = "one class is missing" if auc is None else f"area {auc:.4f}"
    chart = _chart(
        f"ROC of {len(colliding)} held-out samples: {area_text}",
        "false positive rate: free poses called colliding (%)",
        "true positive rate: colliding poses called colliding (%)",
    )
    chart.line([0.0, 100.0], [0.0, 100.0], color=_REFERENCE, style="--")
    if auc is not None:
        by, of = roc_curve(scored.logit, colliding)
        curve_points = np.unique(np.linspace(0, len(by) - 1, _CURVE_POINTS).astype(int))
        _add_line(chart, (100.0 * by[curve_points]).tolist(), (100.0 * of[curve_points]).tolist())
    chart.y_range = _PERCENT
    save_chart(chart, path)


def _draw_calibration(scored: ScoredRows, path: Path) -> None:
    """Draw the share of colliding samples by the predicted probability."""
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
