"""``lcollision benchmark resolve``: how near, how surely and how fast poses are resolved."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.console import note, print_json, print_table, progress_bar
from app.cli.interrupt import cancel_on_interrupt
from app.cli.results import note_near_exclusion
from lcollision_core.errors import LCollisionError

if TYPE_CHECKING:
    from app.benchmarks.resolve import ResolveScore, SolverRuns

_PAPER = (
    "the paper, on other data and machines: SCAPE 85.6 % feasible, energy down by 80.9 %, 250 ms; "
    "Swing 85.1 %, 94.3 %, 1290 ms"
)


def resolve(
    model_name: Annotated[
        str, typer.Option("--model", metavar="M", help="A model with a predictor.")
    ] = "body",
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            readable=False,
            help="Resolve the self-intersecting poses of this set, not samples.",
        ),
    ] = None,
    n_poses: Annotated[
        int, typer.Option("-n", min=1, max=100_000, metavar="N", help="Colliding poses.")
    ] = 100,
    metric: Annotated[str, typer.Option(metavar="eye|latent", help="What is kept small.")] = "eye",
    solvers: Annotated[
        list[str] | None,
        typer.Option("--solver", metavar="NAME", help="Only this; may be repeated."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="S", help="Of the samples.")] = 0,
    figure: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Draw the paper's histograms into this folder."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list.")] = False,
) -> None:
    """Compare the solvers and the bisection that has learnt nothing, on colliding poses."""
    from app.benchmarks.resolve import real_poses, sampled_poses, score_baseline, score_solver
    from lcollision_core.meshes import read_pose_set
    from lcollision_core.model import PoseModel
    from lcollision_core.resolve import ResolveOptions, Solver

    chosen = [Solver(ResolveOptions(solver=name).solver) for name in solvers or list(Solver)]
    ResolveOptions(metric=metric)
    if figure is not None:
        _require_folder(figure)
    model = PoseModel.load(model_name)
    _ = model.resolver
    rows, drawn = [], []
    with cancel_on_interrupt() as cancel:
        with progress_bar("Choosing poses") as progress:
            poses = (
                sampled_poses(model, n_poses, seed, progress)
                if data is None
                else real_poses(model, read_pose_set(data), n_poses, progress)
            )
        rows.append(score_baseline(model, poses))
        for solver in chosen:
            with progress_bar(f"Resolving with {solver}") as progress:
                score, runs = score_solver(model, poses, solver, metric, progress, cancel)
            rows.append(score)
            drawn.append(runs)
    if figure is not None:
        _draw(figure, drawn)
    if as_json:
        near = {"near_exclusion": model.near_exclusion}
        print_json([asdict(row) | near for row in rows])
        return
    _print(rows)
    note_near_exclusion(model)
    note(_PAPER)


def _require_folder(folder: Path) -> None:
    from lcollision_core.meshes import require_writable

    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise LCollisionError.because(
            f"the folder {folder}", "cannot be made", error, "name another"
        ) from error
    require_writable(folder / "convergence.png")


def _draw(folder: Path, drawn: list[SolverRuns]) -> None:
    from app.benchmarks.histograms import draw_convergence, draw_energy_change

    for runs in drawn:
        draw_convergence(runs, folder / f"convergence-{runs.solver}.png")
        draw_energy_change(runs, folder / f"energy-{runs.solver}.png")
    note(f"drew {2 * len(drawn)} histograms into {folder}")


def _print(rows: list[ResolveScore]) -> None:
    headings = ("solver", "median ms", "p95 ms", "feasible", "energy gone", "collision-free")
    lines = (
        (
            row.solver,
            f"{row.median_ms:.0f}",
            f"{row.p95_ms:.0f}",
            _percent(row.feasible_rate),
            _percent(row.energy_decrease),
            _percent(row.exactly_free_rate),
            _percent(row.free_before_walk_back),
            f"{row.latent_distance:.4f}",
            f"{100.0 * row.vertex_distance:.3f} %",
        )
        for row in rows
    )
    others = ("before falling back", "latent distance", "vertices moved")
    print_table((*headings, *others), lines, {"solver"})


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100.0 * share:.1f} %"
