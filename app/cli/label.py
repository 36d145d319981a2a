"""``lcollision label``: exact labels of samples of a model's latent box."""

from __future__ import annotations

import time
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import (
    ExitStatus,
    JsonOption,
    cancel_on_interrupt,
    cancellable_bar,
    note,
    print_json,
    status_bar,
    tell,
)
from app.cli.contacts import excluded_at_rest, note_rules
from app.cli.evaluate import open_store
from app.cli.models import measured_model, measured_model_sentence
from app.cli.options import (
    DeviceOption,
    ModelArgument,
    ThreadsOption,
    require_one_workplace,
)
from lcollision_core.devices import Device, choose_device
from lcollision_core.errors import CancelledError, LabelStoreError, LCollisionError, listed
from lcollision_core.options import SampleDistribution
from lcollision_core.tasks.words import counted, say

if TYPE_CHECKING:
    from app.cli.console import BarContent
    from lcollision_core.bodies import LearnedBody
    from lcollision_core.labels import LabelStatus

_TASK = "Labelling"
_LISTED = 5
"""Maximum number of ranges of damaged rows that are listed."""


def label(
    model_name: ModelArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="STORE", help="The folder of labels to create or continue."
        ),
    ],
    count: Annotated[
        int | None,
        typer.Option(
            "-n", min=1, max=1_000_000_000, help="Number of samples in the finished store."
        ),
    ] = None,
    check: Annotated[
        bool,
        typer.Option("--check", help="Label nothing; only verify the store and report damage."),
    ] = False,
    workers: ThreadsOption = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Label on the workers of this Dask scheduler."),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, metavar="S", help="The same seed gives the same rows.")
    ] = 0,
    draws: Annotated[
        SampleDistribution | None,
        typer.Option(
            help="What to sample: only the latent box, as in the paper, or mixed: half from it, "
            "half blends, mixed parts and poses near the collision boundary. Default: as in "
            "the store, else the box."
        ),
    ] = None,
    device: DeviceOption = Device.AUTO,
    as_json: JsonOption = False,
) -> None:
    """Draw poses from the model's latent box and find their exact collisions.

    You can stop it at any time: the store keeps the finished chunks, and the same command continues
    from there. The rows don't depend on the machine, except for rounding on a GPU. Damaged rows are
    labelled again.
    """
    from lcollision_core.bodies import LearnedBody
    from lcollision_core.labels import LabelStore, label_poses

    require_one_workplace(workers, scheduler)
    if device is Device.CUDA and scheduler is not None:
        raise LCollisionError(
            "--device cuda and --scheduler can't be used together", "the cluster has its own"
        )
    choose_device(device, note)
    if check == (count is not None):
        raise LCollisionError("give either -n N, the number of samples in the store, or --check")
    model = LearnedBody.load(model_name)
    if count is None:
        _check(model, output, as_json)
        return
    wanted_draws = draws or LabelStore.draws_of(output, SampleDistribution.BOX)
    labeller = model.labeller(wanted_draws)
    started = time.monotonic()
    try:
        with cancel_on_interrupt() as job, status_bar(_TASK, bar_content, job, rows=True) as job:
            status = label_poses(
                labeller,
                output,
                count,
                seed=seed,
                workers=workers,
                scheduler=scheduler,
                job=job,
            )
    except CancelledError:
        with suppress(LabelStoreError):
            rows_text = counted(LabelStore.open(output).n_rows, "row", "rows")
            note(f"stopped; {output} has {rows_text}; run the same command again to continue")
        raise
    seconds = time.monotonic() - started
    report: dict[str, Any] = {
        "store": str(output),
        **measured_model(model),
        "seed": seed,
        "draws": wanted_draws.value,
        "rows": status.done,
        "labelled": status.labelled,
        "colliding_share": status.colliding_share,
        "excluded_at_rest": excluded_at_rest(model),
        "seconds": seconds,
    }
    if status.done > count:
        note(f"{output} already has more than {count} rows; kept")
    if as_json:
        print_json(report)
        return
    tell(
        f"{output}: {counted(status.done, 'row', 'rows')} of {model.name}, "
        f"{100.0 * report['colliding_share']:.1f} % collide "
        f"({status.labelled} labelled now, {status.labelled / seconds:.0f}/s)"
    )
    tell(f"  {measured_model_sentence(model)}")
    note_rules(model)


def _check(model: LearnedBody, path: Path, as_json: bool) -> None:
    """Verify that the rows of a store read back as labelled, and report damage."""
    store = open_store(path, model)
    with cancellable_bar("Reading") as job:
        damaged = store.check(job)
    n_sound = store.end - sum(map(len, damaged))
    if as_json:
        print_json(
            {
                "store": str(path),
                "rows": n_sound,
                "damaged": [[rows[0], rows[-1]] for rows in damaged],
                "description_verified": True,  # or it would not have opened
            }
        )
    elif damaged:
        rows_text = listed((f"{rows[0]} to {rows[-1]}" for rows in damaged), _LISTED)
        tell(f"{path}: damaged, rows {rows_text}; {store.repair_advice}")
    else:
        tell(f"{path}: intact, {counted(n_sound, 'row', 'rows')} of {model.name}")
    if damaged:
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


def bar_content(status: LabelStatus) -> BarContent:
    """Describe the rows, the rate, the time left and the colliding fraction."""
    facts = []
    if status.rows_per_second is not None and status.seconds_left is not None:
        left = timedelta(seconds=round(status.seconds_left))
        rate = say("{rows:.0f}/s", rows=status.rows_per_second)
        facts += [rate, say("{left} left", left=left)]
    if status.colliding_share is not None:
        facts.append(say("{share:.1f} % collide", share=100.0 * status.colliding_share))
    return status.done, status.total, _TASK, facts
