"""``lcollision benchmark editor``: what a user of the editor waits for."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from app.cli.console import print_json, progress_bar, tell


def editor(
    model_names: Annotated[
        list[str] | None,
        typer.Option("--model", metavar="M", help="A model; may be repeated. Default: body."),
    ] = None,
    n_actions: Annotated[
        int,
        typer.Option("-n", min=0, metavar="N", help="Random actions to do after the timing."),
    ] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list.")] = False,
) -> None:
    """Open the editor in a window and time its sliders, its start and its memory."""
    from app.benchmarks.editor import time_editor

    with progress_bar("Using the editor") as progress:
        rows = time_editor(model_names or ["body"], n_actions, progress)
    if as_json:
        print_json([asdict(row) for row in rows])
        return
    for row in rows:
        predict = "-" if row.predict_ms is None else f"{row.predict_ms:.2f} ms"
        tell(
            f"{row.model}, {row.vertices} vertices: decode {row.decode_ms:.2f} ms, predict "
            f"{predict}, update {row.update_ms:.1f} ms, render {row.render_ms:.1f} ms; a slider's "
            f"move is seen after {row.event_p50_ms:.0f} ms (95 %: {row.event_p95_ms:.0f}), the "
            f"last of a fast drag after {row.burst_lag_seconds:.2f} s; idle "
            f"{100.0 * row.idle_cpu:.1f} % of a core; start {row.start_seconds:.1f} s; "
            f"{row.memory_mb:.0f} MB"
        )
        if row.actions:
            right = "right" if row.mesh_is_right else "WRONG"
            tell(
                f"{row.actions} random actions: {row.exceptions} exceptions, "
                f"{row.leak_mb:+.0f} MB, the mesh at the end is {right}"
            )
            for error in row.errors:
                tell(f"  {error}")
