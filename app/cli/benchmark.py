"""``lcollision benchmark``: the measurements of docs/results.md."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import (
    JsonOption,
    cancel_on_interrupt,
    cancellable_bar,
    note,
    print_json,
    progress_bar,
    tell,
)
from app.cli.contacts import note_rules
from app.cli.models import measured_model, measured_model_sentence
from app.cli.options import ClearanceOption, ThreadsOption
from lcollision_core.devices import Device, choose_device
from lcollision_core.errors import LCollisionError

if TYPE_CHECKING:
    from app.benchmarks.measures import Row
    from lcollision_core.bodies import Body

app = typer.Typer(help="Measure what docs/results.md quotes.", no_args_is_help=True)

ModelOption = Annotated[str, typer.Option("--model", metavar="M", help="A model with a predictor.")]
BodyOption = Annotated[
    str, typer.Option("--model", metavar="M|FILE", help="A model, or a rigged character.")
]
BatchOption = Annotated[int, typer.Option("-n", min=1, metavar="N", help="Poses of a batch.")]

_MISSING = "is not installed, so it is skipped; pip install 'lcollision[bench]' installs it"
_PREDICTOR_IN_PAPER = (
    "the paper, on other machines: SCAPE 83 s by FCL on 15 threads, 3.99 s predicted on 4 cores, "
    "1.02 s on a GTX 1080 Ti; jumping 319 s, 4.23 s and 1.13 s"
)
_RESOLVE_IN_PAPER = (
    "the paper, on other data and machines: SCAPE 85.6 % feasible, energy down by 80.9 %, 250 ms; "
    "Swing 85.1 %, 94.3 %, 1290 ms"
)


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
    as_json: JsonOption = False,
) -> None:
    """Time exact self-collision against python-fcl and coal (extra `bench`)."""
    from app.benchmarks.detection import missing_peers, time_detection
    from lcollision_core.bundled import bundled_file
    from lcollision_core.files import read_pose_set
    from lcollision_core.jobs import available_cores

    for peer in missing_peers():
        note(f"{peer} {_MISSING}")
    rows: list[Row] = []
    ratios: list[float] = []
    for path in data or [bundled_file("poses", "body.npz")]:
        poses = read_pose_set(path)
        with progress_bar(f"Timing {path.name}") as job:
            timings = time_detection(poses, n_poses, available_cores(), job)
        rows += timings
        # The first row of each set is ours on one thread.
        ratios += [row["ms_per_pose"] / timings[0]["ms_per_pose"] for row in timings]
    if not as_json:
        rows = [row | {"x ours": ratio} for row, ratio in zip(rows, ratios, strict=True)]
    _print_rows(rows, as_json)


@app.command("predictor")
def predictor(
    model_name: ModelOption = "body",
    n_poses: Annotated[
        int,
        typer.Option(
            "-n", min=1, max=15_000, metavar="N", help="Poses to time the exact check on."
        ),
    ] = 2000,
    as_json: JsonOption = False,
) -> None:
    """Time predictions against exact checks, for the 15 000 poses of the paper's Table 3."""
    from app.benchmarks.predictor import time_predictor
    from lcollision_core.bodies import LearnedBody

    model = LearnedBody.load(model_name)
    trained = model.require_predictor()
    with cancellable_bar("Timing exact checks") as job:
        rows = time_predictor(model, trained, n_poses, job)
    if as_json:
        print_json([measured_model(model) | row for row in rows])
        return
    tell(f"{model.name}: {measured_model_sentence(model)}")
    print_table(rows)
    if rows[0]["fcl_seconds"] is None:
        note(f"python-fcl {_MISSING}")
    note(_PREDICTOR_IN_PAPER)


@app.command("resolve")
def resolve(
    model_name: ModelOption = "body",
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            readable=False,
            help="Resolve the self-intersecting poses of this set or pose file, not samples.",
        ),
    ] = None,
    made: Annotated[
        bool, typer.Option("--made", help="Resolve realistic poses of a character.")
    ] = False,
    n_poses: Annotated[
        int, typer.Option("-n", min=1, max=100_000, metavar="N", help="Colliding poses.")
    ] = 100,
    metric: Annotated[
        str, typer.Option(metavar="vertices|latent", help="Distance to minimise.")
    ] = "vertices",
    solvers: Annotated[
        list[str] | None,
        typer.Option("--solver", metavar="NAME", help="Use only this solver; may be repeated."),
    ] = None,
    clearance: ClearanceOption = 0.0,
    soft: Annotated[
        float | None,
        typer.Option(metavar="MAX", help="Move no vertex farther than this, in body sizes."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="S", help="Seed of the samples.")] = 0,
    figure: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Draw the paper's histograms into this folder."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare the solvers, and a bisection that uses nothing learned, on colliding poses."""
    from app.benchmarks.resolve import (
        draw_histograms,
        made_poses,
        poses_of_file,
        real_poses,
        sampled_poses,
        score_baseline,
        score_drags,
        score_solver,
        score_steps,
    )
    from lcollision_core.bodies import open_body
    from lcollision_core.files import read_pose_set
    from lcollision_core.resolve import ResolveOptions, Solver

    compared_solvers = [
        Solver(ResolveOptions(solver=name).solver) for name in solvers or list(Solver)
    ]
    options = ResolveOptions(metric=metric, clearance=clearance, largest_change=soft)
    if figure is not None:
        _require_folder(figure)
    model = open_body(model_name)
    _ = model.resolver
    rows: list[Row] = []
    runs = []
    with cancel_on_interrupt() as job:
        with progress_bar("Choosing poses", job) as bar:
            if data is not None and data.suffix.lower() == ".json":
                poses = poses_of_file(model, data, n_poses)
            elif data is not None:
                poses = real_poses(model, read_pose_set(data), n_poses, bar)
            else:
                draw = made_poses if made else sampled_poses
                poses = draw(model, n_poses, seed, bar)
        rows.append(score_baseline(model, poses, clearance))
        if not model.has_predictor:
            rows[0]["confirmed_free_rate"] = None
            if made or data is not None:
                with progress_bar("Dragging", job) as bar:
                    rows.append(score_drags(model, poses, options, bar))
            with progress_bar("Resolving", job) as bar:
                rows.append(score_steps(model, poses, options, bar))
        else:
            for solver in compared_solvers:
                with progress_bar(f"Resolving with {solver}", job) as bar:
                    chosen_one = replace(options, solver=solver)
                    score, run = score_solver(model, poses, chosen_one, bar)
                rows.append(score)
                runs.append(run)
    if figure is not None:
        for run in runs:
            draw_histograms(run, figure)
        note(f"saved {2 * len(runs)} histograms to {figure}")
    _print_rows(rows, as_json, model)
    if runs and not as_json:
        note(_RESOLVE_IN_PAPER)


@app.command("drag")
def drag(
    model_name: BodyOption = "body",
    n_targets: Annotated[
        int, typer.Option("-n", min=1, max=10_000, metavar="N", help="Targets of each grip.")
    ] = 40,
    as_json: JsonOption = False,
) -> None:
    """Drag hands, feet, head and elbows to scripted targets, plain and solid."""
    from app.benchmarks.drag import time_drags
    from lcollision_core.bodies import open_body

    model = open_body(model_name)
    with cancellable_bar("Dragging") as job:
        rows = time_drags(model, n_targets, job=job)
    _print_rows(rows, as_json, model)


@app.command("cores")
def cores(
    model_name: BodyOption = "body",
    data: Annotated[
        Path | None,
        typer.Option(metavar="FILE", readable=False, help="The motion that is screened."),
    ] = None,
    n_poses: BatchOption = 1024,
    workers: ThreadsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Time loops over poses and frames on one thread and on all cores; not on Windows."""
    from app.benchmarks.cores import loops_of, time_cores
    from lcollision_core.bodies import open_body
    from lcollision_core.jobs import available_cores

    loops = loops_of(open_body(model_name), n_poses, data)
    with cancellable_bar("Timing loops") as job:
        rows = time_cores(loops, workers or available_cores(), job)
    _print_rows(rows, as_json)


@app.command("gpu")
def gpu(
    model_name: BodyOption = "body",
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH", readable=False, help="Check the poses of this set, and blends, instead."
        ),
    ] = None,
    n_poses: BatchOption = 10_000,
    as_json: JsonOption = False,
) -> None:
    """Compare exact checks on GPU and CPU: results and speed."""
    from app.benchmarks.gpu import blended_poses, time_checks, time_gpu
    from lcollision_core.bodies import MeshBody, open_body
    from lcollision_core.files import read_pose_set

    choose_device(Device.CUDA)
    with cancellable_bar("Comparing devices") as job:
        if data is None:
            rows = time_gpu(open_body(model_name), n_poses, job)
        else:
            poses = read_pose_set(data)
            detector = MeshBody.of_poses(poses).detector
            rows = time_checks(detector, blended_poses(poses, n_poses), job)
    _print_rows(rows, as_json)


@app.command("motion")
def motion(
    model_name: BodyOption = "body",
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            readable=False,
            help="The motions. Default: a character's clips; for a model two smooth paths.",
        ),
    ] = None,
    workers: ThreadsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Resolve whole motions, by spans and frame by frame, and measure how they moved."""
    from app.benchmarks.motion import motions_of, score_motion
    from lcollision_core.bodies import open_body

    model = open_body(model_name)
    rows: list[Row] = []
    with cancellable_bar("Resolving frames") as job:
        for measured in motions_of(model, data):
            rows += score_motion(model, measured, workers, job)
    _print_rows(rows, as_json, model)


@app.command("contacts")
def contacts(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FILE...",
            readable=False,
            help="Rigged characters, which take the motions too, and whose clips are moved.",
        ),
    ] = None,
    workers: ThreadsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Retarget three motions of the built-in figure to a slim and a heavy one, keeping contacts.

    The figures are built first, which takes minutes and needs the extra 'body'.
    """
    from app.benchmarks.contacts import contact_rows

    with cancellable_bar("Resolving frames") as job:
        rows = contact_rows(files or [], workers, job)
    _print_rows(rows, as_json)


@app.command("scenes")
def scenes(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", readable=False, help="A rigged character.")
    ],
    as_json: JsonOption = False,
) -> None:
    """Resolve scenes of two copies of a character, or one and a prop; VTK checks the results."""
    from app.benchmarks.scenes import scene_rows

    with cancellable_bar("Resolving scenes") as job:
        rows = scene_rows(file, job)
    _print_rows(rows, as_json)


@app.command("printing")
def printing(
    model_names: Annotated[
        list[str], typer.Argument(metavar="M...", help="Models, or rigged characters.")
    ],
    n_poses: Annotated[int, typer.Option("-n", min=1, metavar="N", help="Poses of each.")] = 10,
    as_json: JsonOption = False,
) -> None:
    """Print random poses, and check the files with independent programs."""
    from app.benchmarks.printing import printed_rows

    with cancellable_bar("Printing poses") as job:
        rows = printed_rows(model_names, n_poses, job)
    _print_rows(rows, as_json)


@app.command("editor")
def editor(
    model_names: Annotated[
        list[str] | None,
        typer.Option("--model", metavar="M", help="A model; may be repeated. Default: body."),
    ] = None,
    n_actions: Annotated[
        int,
        typer.Option("-n", min=0, metavar="N", help="Random actions to do after the timing."),
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Open the editor in a window and time its sliders, its start and its memory."""
    from app.benchmarks.editor import time_editor

    with progress_bar("Using the editor") as job:
        rows = time_editor(model_names or ["body"], n_actions, job)
    _print_rows(rows, as_json)


def print_table(rows: list[Row]) -> None:
    """Print measurements with the same fields: one column each, one row per field."""
    from rich.console import Console
    from rich.table import Table

    table = Table("", *[""] * len(rows), box=None, show_header=False)
    for field in rows[0]:
        table.add_row(field, *(_cell(row[field]) for row in rows))
    # In a pipe, rich would fold the table to 80 columns.
    Console(width=max(80, 24 + 16 * len(rows)), soft_wrap=True).print(table)


def _cell(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "NO", None: "-"}[value]
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _require_folder(folder: Path) -> None:
    from lcollision_core.files import require_writable

    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise LCollisionError.because(
            f"the folder {folder}", "cannot be made", error, "name another"
        ) from error
    require_writable(folder / "convergence.png")


def _print_rows(rows: list[Row], as_json: bool, body: Body | None = None) -> None:
    """Print measurements, and the body that they are of, with its contact rules."""
    if as_json:
        model = {"model": body.name, "near_exclusion": body.rules.near_exclusion} if body else {}
        print_json([model | row for row in rows])
        return
    print_table(rows)
    if body is not None:
        note_rules(body)
