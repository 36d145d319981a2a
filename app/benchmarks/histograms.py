"""The paper's two pictures of its collision response, drawn without a plotting library."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from app.benchmarks.resolve import SolverRuns
from lcollision_core.meshes import atomic_write

_WIDTH, _HEIGHT = 900, 620
_LEFT, _RIGHT, _TOP, _BOTTOM = 110, 40, 100, 90
_INK, _GRID = (40, 44, 52), (222, 224, 230)
_PALE, _FULL = np.array([236, 242, 250.0]), np.array([18, 64, 133.0])
_TIME_BINS, _ITERATION_BINS, _CHANGE_BINS = 24, 16, 40
_MOST_SHOWN = 0.98


def draw_convergence(runs: SolverRuns, path: str | os.PathLike[str]) -> None:
    """Draw the joint histogram of iterations and time.

    Parameters
    ----------
    runs : of one solver, one pose at least
    path : the .png file to write, whole or not at all

    Notes
    -----
    After the figure on convergence of Tan et al. 2021. Bins end at the 98th percentiles; what is
    beyond counts in the last ones.
    """
    milliseconds = 1e3 * runs.seconds
    most_time = max(float(np.quantile(milliseconds, _MOST_SHOWN)), 1e-3)
    per_bin = max(1, round(float(np.quantile(runs.iterations, _MOST_SHOWN)) / _ITERATION_BINS))
    most_steps = float(per_bin * _ITERATION_BINS)
    counts, _, _ = np.histogram2d(
        np.minimum(runs.iterations, most_steps - 1),
        np.minimum(milliseconds, most_time),
        bins=(_ITERATION_BINS, _TIME_BINS),
        range=((0.0, most_steps), (0.0, most_time)),
    )
    picture, draw = _canvas(
        f"{runs.solver}: {len(milliseconds)} poses, mean {runs.iterations.mean():.2f} iterations, "
        f"{milliseconds.mean():.1f} ms"
    )
    columns, rows = (
        _edges(_TIME_BINS, _LEFT, _WIDTH - _RIGHT),
        _edges(_ITERATION_BINS, _HEIGHT - _BOTTOM, _TOP),
    )
    for row, column in np.argwhere(counts > 0).tolist():
        share = np.sqrt(counts[row, column] / counts.max())
        colour = tuple(np.round(_PALE + share * (_FULL - _PALE)).astype(int).tolist())
        box = (columns[column], rows[row + 1], columns[column + 1] - 1, rows[row] - 1)
        draw.rectangle(box, fill=colour)
    _label_axes(draw, "time (ms)", (0.0, most_time), "iterations", (0.0, most_steps))
    _save(picture, path)


def draw_energy_change(runs: SolverRuns, path: str | os.PathLike[str]) -> None:
    """Draw the histogram of the relative change of the exact energy of the feasible poses.

    Parameters
    ----------
    runs : of one solver
    path : the .png file to write, whole or not at all

    Notes
    -----
    After the figure on response of Tan et al. 2021. Changes above +1 count in the last bin.
    """
    change = np.minimum(runs.energy_change, 1.0)
    counts, _ = np.histogram(change, bins=_CHANGE_BINS, range=(-1.0, 1.0))
    mean = f"mean {100.0 * runs.energy_change.mean():.1f} %" if len(change) else "none"
    picture, draw = _canvas(f"{runs.solver}: {len(change)} feasible poses, energy change {mean}")
    columns = _edges(_CHANGE_BINS, _LEFT, _WIDTH - _RIGHT)
    floor, most = _HEIGHT - _BOTTOM, max(int(counts.max()), 1)
    for place in np.flatnonzero(counts).tolist():
        top = floor - round((floor - _TOP) * int(counts[place]) / most)
        box = (columns[place], top, columns[place + 1] - 2, floor)
        draw.rectangle(box, fill=tuple(_FULL.astype(int).tolist()))
    _label_axes(draw, "relative energy change", (-1.0, 1.0), "poses", (0.0, float(most)))
    _save(picture, path)


def _canvas(title: str) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    picture = Image.new("RGB", (_WIDTH, _HEIGHT), "white")
    draw = ImageDraw.Draw(picture)
    draw.text((_LEFT, 20), title, fill=_INK, font=_font(20))
    return picture, draw


def _label_axes(
    draw: ImageDraw.ImageDraw,
    across: str,
    across_range: tuple[float, float],
    up: str,
    up_range: tuple[float, float],
) -> None:
    right, floor = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    draw.line((_LEFT, _TOP, _LEFT, floor), fill=_INK)
    draw.line((_LEFT, floor, right, floor), fill=_INK)
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        x = round(_LEFT + share * (right - _LEFT))
        y = round(floor - share * (floor - _TOP))
        draw.line((x, floor, x, floor + 6), fill=_INK)
        draw.line((_LEFT - 6, y, _LEFT, y), fill=_INK)
        if share:
            draw.line((_LEFT + 1, y, right, y), fill=_GRID, width=1)
        for place, (low, high), anchor in (
            ((x, floor + 12), across_range, "ma"),
            ((_LEFT - 12, y), up_range, "rm"),
        ):
            value = low + share * (high - low)
            draw.text(place, f"{value:.3g}", fill=_INK, font=_font(16), anchor=anchor)
    draw.text(((_LEFT + right) // 2, _HEIGHT - 34), across, fill=_INK, font=_font(18), anchor="mm")
    draw.text((_LEFT - 60, _TOP - 22), up, fill=_INK, font=_font(18), anchor="lm")


def _edges(n_bins: int, start: int, stop: int) -> Sequence[int]:
    edges: npt.NDArray[Any] = np.linspace(start, stop, n_bins + 1).round().astype(int)
    return [int(edge) for edge in edges]


def _font(size: int) -> Any:
    return ImageFont.load_default(size=size)


def _save(picture: Image.Image, path: str | os.PathLike[str]) -> None:
    with atomic_write(path) as file:
        picture.save(file, format="PNG", optimize=True)
