"""``lcollision benchmark``: the measurements of docs/results.md."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from app.cli.benchmark_editor import editor
from app.cli.benchmark_predictor import predictor
from app.cli.benchmark_resolve import resolve
from app.cli.console import note, print_json, print_table, progress_bar

app = typer.Typer(help="Measure what docs/results.md quotes.", no_args_is_help=True)
app.command("predictor")(predictor)
app.command("resolve")(resolve)
app.command("editor")(editor)


@app.command("detection")
def detection(
    data: Annotated[
        list[Path] | None,
        typer.Option(
            "--data",
            metavar="PATH",
            readable=False,
            help="A pose set; may be repeated. Default: the bundled one.",
        ),
    ] = None,
    n_poses: Annotated[
        int, typer.Option("-n", min=1, metavar="N", help="Poses of each set to time.")
    ] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list.")] = False,
) -> None:
    """Time exact self-collision against python-fcl and coal (extra `bench`)."""
    from app.benchmarks.detection import missing_peers, time_detection
    from lcollision_core.bundled import bundled_file
    from lcollision_core.jobs import available_cores
    from lcollision_core.meshes import read_pose_set

    for peer in missing_peers():
        note(f"{peer} is not installed and left out; pip install 'lcollision[bench]' brings it")
    rows: list[dict[str, Any]] = []
    for path in data or [bundled_file("poses", "body.npz")]:
        poses = read_pose_set(path)
        with progress_bar(f"Timing {path.name}") as progress:
            timings = time_detection(poses, n_poses, available_cores(), progress)
        rows += [asdict(timing) for timing in timings]
    if as_json:
        print_json(rows)
    else:
        _print(rows)


def _print(rows: list[dict[str, Any]]) -> None:
    lines, ours = [], 1.0
    for row in rows:
        # The row that each set begins with.
        if (row["tool"], row["threads"], row["mode"]) == ("lcollision", 1, "all"):
            ours = row["ms_per_pose"]
        time, agrees = row["ms_per_pose"], "yes" if row["agrees"] else "NO"
        names = (str(row[name]) for name in ("vertices", "tool", "threads", "mode"))
        lines.append((*names, f"{time:.2f}", f"{time / ours:.1f}", agrees))
    headings = ("vertices", "tool", "threads", "mode", "ms per pose", "x ours", "agrees")
    print_table(headings, lines, {"tool", "mode"})
