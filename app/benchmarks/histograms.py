"""The paper's two figures on collision response."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyvista as pv

from app.benchmarks.resolve import SolverRuns
from app.view.offscreen import save_chart

_COLOUR = (18, 64, 133)
_MARKER_PIXELS = 30
_TIME_BINS, _ITERATION_BINS, _CHANGE_BINS = 24, 16, 40
_MOST_SHOWN = 0.98


def draw_histograms(runs: SolverRuns, folder: Path) -> None:
    """Draw ``convergence-SOLVER.png`` and ``energy-SOLVER.png``, each atomically.

    Parameters
    ----------
    runs : of one solver, at least one pose
    folder : an existing folder

    Notes
    -----
    After the figures of Tan et al. 2021 on convergence (iterations and time, as a density) and on
    response (relative change of the exact energy of the feasible poses). The axes of the first end
    at the 98th percentiles, that of the second at +1; values beyond count in the last bins.
    """
    milliseconds = 1e3 * runs.seconds
    longest = max(float(np.quantile(milliseconds, _MOST_SHOWN)), 1e-3)
    per_bin = max(1, round(float(np.quantile(runs.iterations, _MOST_SHOWN)) / _ITERATION_BINS))
    time_edges = np.linspace(0.0, longest, _TIME_BINS + 1)
    iteration_edges = per_bin * np.arange(_ITERATION_BINS + 1) - 0.5
    counts, _, _ = np.histogram2d(
        np.minimum(milliseconds, longest),
        np.minimum(runs.iterations, iteration_edges[-1]),
        bins=(time_edges, iteration_edges),
    )
    density = pv.Chart2D(x_label="time (ms)", y_label="iterations")
    density.title = (
        f"{runs.solver}: {len(milliseconds)} poses, mean {runs.iterations.mean():.2f} iterations, "
        f"{milliseconds.mean():.1f} ms"
    )
    columns, rows = np.nonzero(counts)
    x, y = (0.5 * (edges[:-1] + edges[1:]) for edges in (time_edges, iteration_edges))
    for column, row in zip(columns, rows, strict=True):
        opacity = round(255 * np.sqrt(counts[column, row] / counts.max()))
        density.scatter(
            x[[column]], y[[row]], color=(*_COLOUR, opacity), size=_MARKER_PIXELS, style="s"
        )
    density.x_range, density.y_range = time_edges[[0, -1]], iteration_edges[[0, -1]]
    save_chart(density, folder / f"convergence-{runs.solver}.png")

    change = np.minimum(runs.energy_change, 1.0)
    counts, edges = np.histogram(change, bins=_CHANGE_BINS, range=(-1.0, 1.0))
    mean = f"mean {100.0 * runs.energy_change.mean():.1f} %" if len(change) else "none"
    response = pv.Chart2D(x_label="relative energy change", y_label="poses")
    response.title = f"{runs.solver}: {len(change)} feasible poses, energy change {mean}"
    response.bar(0.5 * (edges[:-1] + edges[1:]), counts, color=_COLOUR)
    save_chart(response, folder / f"energy-{runs.solver}.png")
