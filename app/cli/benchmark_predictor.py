"""``lcollision benchmark predictor``: what a prediction costs beside the exact check."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.console import note, print_json, progress_bar, tell
from app.cli.interrupt import cancel_on_interrupt
from app.cli.models import measured_model, measured_model_sentence

if TYPE_CHECKING:
    from app.benchmarks.predictor import PredictorTiming

_PAPER = (
    "the paper, on other machines: SCAPE 83 s by FCL on 15 threads, 3.99 s predicted on 4 cores, "
    "1.02 s on a GTX 1080 Ti; jumping 319 s, 4.23 s and 1.13 s"
)


def predictor(
    model_name: Annotated[
        str, typer.Option("--model", metavar="M", help="A model with a predictor.")
    ] = "body",
    n_poses: Annotated[
        int,
        typer.Option(
            "-n", min=1, max=15_000, metavar="N", help="Poses to time the exact check on."
        ),
    ] = 2000,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list.")] = False,
) -> None:
    """Time predictions against exact verdicts, for the 15 000 poses of the paper's Table 3."""
    from app.benchmarks.predictor import time_predictor
    from lcollision_core.model import PoseModel

    model = PoseModel.load(model_name)
    trained = model.require_predictor()
    with cancel_on_interrupt() as cancel, progress_bar("Timing exact verdicts") as progress:
        rows = time_predictor(model, trained, n_poses, progress, cancel)
    if as_json:
        print_json([measured_model(model) | asdict(row) for row in rows])
        return
    tell(f"{model.name}: {measured_model_sentence(model)}")
    _print_exact(rows[0])
    for row in rows:
        tell(
            f"{row.device}, preset {row.preset}, batches of {row.batch}: {row.us_per_pose:.0f} us "
            f"per pose, {row.predicted_seconds:.2f} s for {row.table_poses}; "
            f"{row.speedup:.1f} times as fast as decode and exact; one pose with gradient "
            f"{row.gradient_ms:.2f} ms; {100.0 * row.gemm_fraction:.0f} % of a large matrix "
            f"product's rate"
        )
    note(_PAPER)


def _print_exact(row: PredictorTiming) -> None:
    tell(
        f"exact to the first hit on {row.cores} cores: {row.exact_ms_per_pose:.3f} ms per pose and "
        f"{row.decode_ms_per_pose:.3f} ms to decode it, {row.exact_seconds:.1f} s for "
        f"{row.table_poses} (scaled up from {row.exact_poses}, "
        f"{100.0 * row.colliding_share:.1f} % of which collide)"
    )
    if row.fcl_seconds is None:
        note("python-fcl is not installed and left out; pip install 'lcollision[bench]' brings it")
    else:
        tell(
            f"python-fcl, every contact: {row.fcl_seconds:.0f} s for {row.table_poses}, scaled up "
            f"from {row.fcl_poses} poses on one core as if it spread over {row.cores} without loss"
        )
