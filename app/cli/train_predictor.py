"""``lcollision train predictor``: learn to predict collisions from labelled samples."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from app.cli.console import note, status_bar
from app.cli.evaluate import require_store_of, scores_sentence
from app.cli.interrupt import cancel_on_interrupt
from app.cli.models import ModelArgument, measured_model_sentence, note_if_beside
from lcollision_core.errors import CancelledError

if TYPE_CHECKING:
    from lcollision_core.predictor import PredictorStatus, StatusCallback


def predictor(
    model_name: ModelArgument,
    store_path: Annotated[
        Path, typer.Argument(metavar="STORE", help="The model's store, by `lcollision label`.")
    ],
    output: Annotated[
        str,
        typer.Option(
            "--output",
            "-o",
            metavar="M2",
            help="The .safetensors file to write; a name alone stores it with your models.",
        ),
    ],
    preset: Annotated[
        Literal["default", "paper"],
        typer.Option(help="What measures best, or the paper's network and training."),
    ] = "default",
    loss: Annotated[
        Literal["full", "no-rank", "no-depth", "entropy"],
        typer.Option(help="Of the paper's losses, leave out ranking, depth, or both."),
    ] = "full",
    no_domains: Annotated[
        bool, typer.Option("--no-domains", help="Predict the whole body's energy alone (ND).")
    ] = False,
    n_rows: Annotated[
        int | None,
        typer.Option("--rows", min=1, metavar="N", help="Use the first N rows. Default: all."),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, metavar="S", help="Equal seeds, equal predictors.")
    ] = 0,
    device: Annotated[
        Literal["auto", "cpu", "cuda"],
        typer.Option(help="Where to train; auto takes a GPU when there is one."),
    ] = "auto",
) -> None:
    """Learn to predict collisions from labelled samples.

    Three tenths of the rows are held out to measure the predictor; from 170 000 rows on, a tenth of
    these sets the decision threshold of the preset default. A checkpoint beside
    the output lets a run that was stopped or killed go on when it is started again; it is removed
    at the end. To use several devices or machines, start it with `torchrun -m app train predictor
    ...`.
    """
    from lcollision_core.labels import LabelStore
    from lcollision_core.meshes import file_stamp, locked, require_writable
    from lcollision_core.model import PoseModel, checkpoint_path, model_destination, save_trained
    from lcollision_core.predictor import PRESETS, has_begun, patches_path, train_predictor
    from lcollision_core.resolve import find_free_poses

    destination = model_destination(output)
    require_writable(destination)
    checkpoint = checkpoint_path(destination)
    require_writable(patches_path(checkpoint))
    before = file_stamp(destination)
    model = PoseModel.load(model_name)
    store = LabelStore.open(store_path)
    require_store_of(store, model)
    config = PRESETS[preset].with_loss(loss)
    # torchrun starts this command many times; the first process writes for all.
    leads = os.environ.get("RANK", "0") == "0"
    if leads and has_begun(checkpoint):
        note(f"going on from {checkpoint}")
    try:
        with (
            locked(checkpoint, wait=0.0) if leads else nullcontext(),
            cancel_on_interrupt() as cancel,
            _training_bar(leads) as progress,
        ):
            trained = train_predictor(
                store.load(n_rows),
                model.embedding,
                replace(config, by_domain=not no_domains),
                store=store.identity,
                device=device,
                checkpoint=checkpoint,
                progress=progress,
                cancel=cancel,
                seed=seed,
            )
    except CancelledError:
        if leads and has_begun(checkpoint):
            note(f"stopped; run the same command again to go on from {checkpoint}")
        raise
    if leads:
        free_latent = find_free_poses(model.embedding, model.detector, model.height)
        if not len(free_latent):
            note(
                "no pose of this body that was tried is free of collision; Resolve has nowhere "
                "to fall back to and may leave poses colliding"
            )
        written = save_trained(
            destination,
            before,
            model,
            lambda base: base.with_predictor(trained).with_free_poses(free_latent),
        )
        note_if_beside(written, destination)
        checkpoint.unlink(missing_ok=True)
        if trained.metrics is not None:
            note(f"wrote {written}: {scores_sentence(trained.metrics)}")
            share = 100.0 * trained.facts.colliding_share
            note(f"{measured_model_sentence(model)}; {share:.1f} % of its box collides")


@contextmanager
def _training_bar(leads: bool) -> Iterator[StatusCallback]:
    """Give a callback that draws steps, loss and held-out accuracy on a terminal."""
    from lcollision_core.predictor import no_status

    if not leads:
        yield no_status
        return
    with status_bar("reading rows") as draw:

        def show(status: PredictorStatus) -> None:
            if status.preparing is not None:
                draw(status.preparing, 1.0, description="labelling patches")
                return
            facts = [] if status.loss is None else [f"loss {status.loss:.3f}"]
            if status.held_out_accuracy is not None:
                facts.append(f"{100.0 * status.held_out_accuracy:.1f} % accuracy")
            epoch = f"epoch {min(status.epoch + 1, status.epochs)} of {status.epochs}"
            draw(status.done, status.total, facts, epoch)

        yield show
