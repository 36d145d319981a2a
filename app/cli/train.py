"""``lcollision train``: learn a model from data."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from app.cli.console import cancel_on_interrupt, note, progress_bar, status_bar
from app.cli.evaluate import StoreArgument, kind_lines, open_store
from app.cli.models import describe, error_sentence, measured_model_sentence, note_where_written
from app.cli.options import (
    Axis,
    ModelArgument,
    ModelOutput,
    PoseSetArgument,
    RowsOption,
    takes_options,
)
from lcollision_core.errors import CancelledError, listed
from lcollision_core.jobs import Job
from lcollision_core.options import RuleOptions
from lcollision_core.tasks.words import error_rates_text, say, scores_text, up_text

if TYPE_CHECKING:
    from app.cli.console import BarContent
    from lcollision_core.embedding.training_run import TrainingStatus
    from lcollision_core.predictor import PredictorStatus

app = typer.Typer(help="Learn a model from data.", no_args_is_help=True)


@app.command("embedding")
@takes_options
def embedding(
    dataset: PoseSetArgument,
    output: ModelOutput,
    n_domains: Annotated[
        int, typer.Option("--domains", min=1, max=64, metavar="K", help="Number of domains.")
    ] = 10,
    n_codes: Annotated[
        int,
        typer.Option(
            "--domain-codes", min=1, max=64, metavar="k", help="Number of codes per domain."
        ),
    ] = 10,
    encoded_codes: Annotated[
        bool,
        typer.Option(
            "--encoded-codes",
            help="Keep the encoders' own codes of the poses, as the paper does; else codes are "
            "fitted to the vertices.",
        ),
    ] = False,
    *,
    options: RuleOptions,
    up: Annotated[
        Axis | None,
        typer.Option(help="The up axis. Default: what the set says, else a guess."),
    ] = None,
    scale: Annotated[
        float,
        typer.Option(metavar="S", help="Factor from the poses' unit to the model's."),
    ] = 1.0,
    seed: Annotated[
        int, typer.Option(min=0, metavar="S", help="The same seed gives the same models.")
    ] = 0,
    source: Annotated[
        str | None, typer.Option(help="Description of the poses. Default: the dataset's name.")
    ] = None,
    licence: Annotated[str, typer.Option(help="Licence of the model.")] = "unknown",
) -> None:
    """Learn the latent space of a pose set.

    You can stop it at any time; the same command resumes from a checkpoint beside the output, which
    is removed at the end.
    """
    from lcollision_core.bodies import checkpoint_path, model_destination, save_trained
    from lcollision_core.embedding.training_run import EmbeddingConfig
    from lcollision_core.files import file_stamp, read_pose_set, require_writable
    from lcollision_core.tasks.inputs import with_rules
    from lcollision_core.tasks.learning import learn_latent_space

    destination = model_destination(output)
    require_writable(destination)
    before = file_stamp(destination)
    poses = with_rules(read_pose_set(dataset), dataset, options)
    if scale != 1.0:
        poses = poses.scaled(scale)
    guess = poses.up
    if up is None and not guess.is_sure:
        note(f"{up_text(guess)}; --up x|y|z overrides it, now or by `lcollision upright`")
    poses = replace(poses, up_axis=guess.axis if up is None else "xyz".index(up))
    for remark in poses.notes:
        note(f"{dataset}: {remark}")
    config = EmbeddingConfig(
        n_domains=n_domains, n_domain_codes=n_codes, encoded_codes=encoded_codes
    )
    checkpoint = checkpoint_path(destination)
    require_writable(checkpoint)
    with (
        _resumable(checkpoint, Path.exists) as job,
        status_bar("reading features", bar_content_of_embedding, job) as job,
    ):
        model = learn_latent_space(
            destination.stem,
            poses,
            config,
            seed=seed,
            source=source,
            licence=licence,
            facts={"command": "train embedding", "seed": seed},
            checkpoint=checkpoint,
            job=job,
        )
    written = save_trained(destination, before, model)
    note_where_written(written, destination)
    checkpoint.unlink(missing_ok=True)
    note(f"wrote {written}: {error_sentence(describe(model))}")


@app.command("predictor")
def predictor(
    model_name: ModelArgument,
    store_path: StoreArgument,
    output: ModelOutput,
    preset: Annotated[
        Literal["default", "large", "paper"],
        typer.Option(
            help="The usual network; a larger one, for millions of rows, that takes three times as "
            "long; or the paper's network and training."
        ),
    ] = "default",
    loss: Annotated[
        Literal["full", "no-rank", "no-depth", "entropy"],
        typer.Option(help="Leave out the paper's ranking loss, depth loss, or both."),
    ] = "full",
    no_domains: Annotated[
        bool, typer.Option("--no-domains", help="Predict only the energy of the whole body (ND).")
    ] = False,
    n_rows: RowsOption = None,
    seed: Annotated[
        int, typer.Option(min=0, metavar="S", help="The same seed gives the same predictors.")
    ] = 0,
    device: Annotated[
        Literal["auto", "cpu", "cuda"],
        typer.Option(help="Device to train on; auto uses a GPU if there is one."),
    ] = "auto",
) -> None:
    """Learn to predict collisions from labelled samples.

    Three tenths of the rows of the latent box are held out to measure the predictor; from 170 000
    such rows on, a tenth of these sets the decision threshold, except with the preset paper. You
    can stop it at any time; the same command resumes from a checkpoint beside the output, which is
    removed at the end. To use several devices or machines, start it with `torchrun -m app train
    predictor ...`.
    """
    from lcollision_core.bodies import LearnedBody, checkpoint_path, model_destination, save_trained
    from lcollision_core.bodies.scoring import CARD_POSES
    from lcollision_core.files import file_stamp, require_writable
    from lcollision_core.predictor import PRESETS, has_begun, patches_path, train_predictor
    from lcollision_core.tasks.learning import LearnedPredictor

    destination = model_destination(output)
    require_writable(destination)
    checkpoint = checkpoint_path(destination)
    require_writable(patches_path(checkpoint))
    before = file_stamp(destination)
    model = LearnedBody.load(model_name)
    store = open_store(store_path, model)
    config = PRESETS[preset].with_loss(loss)
    # torchrun starts this command many times; the first process writes for all.
    leads = os.environ.get("RANK", "0") == "0"
    with (
        _resumable(checkpoint, has_begun, leads) as job,
        status_bar("reading rows", bar_content_of_predictor, job)
        if leads
        else nullcontext(job) as job,
    ):
        trained = train_predictor(
            store.load(n_rows),
            model.embedding,
            replace(config, by_domain=not no_domains),
            store=store.identity,
            groups=model.groups,
            checkpoint=checkpoint,
            seed=seed,
            device=device,
            job=job,
        )
    learned = LearnedPredictor(model, trained)
    if leads:
        if not len(learned.free_poses):
            note(
                "no tried pose of this body is free of collisions; Resolve has no pose to fall "
                "back to and may leave poses colliding"
            )
        with progress_bar("Judging kinds of poses") as job:
            learned = learned.with_scores(CARD_POSES, 0, job)
        written = save_trained(destination, before, model, learned.of)
        trained = learned.predictor
        note_where_written(written, destination)
        checkpoint.unlink(missing_ok=True)
        if trained.metrics is not None:
            scores = scores_text(asdict(trained.metrics), trained.metrics.samples)
            note(f"wrote {written}: {scores}")
            share = 100.0 * trained.facts.colliding_share
            note(f"{measured_model_sentence(model)}; {share:.1f} % of random poses collide")
            for line in kind_lines(trained.kinds):
                note(f"  {line}")


@contextmanager
def _resumable(
    checkpoint: Path, has_begun: Callable[[Path], bool], leads: bool = True
) -> Iterator[Job]:
    """Lock the checkpoint for the leading process, and report how to resume from it."""
    from lcollision_core.files import locked

    if leads and has_begun(checkpoint):
        note(f"continuing from {checkpoint}")
    try:
        with (
            locked(checkpoint, wait=0.0) if leads else nullcontext(),
            cancel_on_interrupt() as job,
        ):
            yield job
    except CancelledError:
        if leads and has_begun(checkpoint):
            note(f"stopped; run the same command again to continue from {checkpoint}")
        raise


def bar_content_of_embedding(status: TrainingStatus) -> BarContent:
    """Describe the stage and the errors of both levels."""
    levels = {"level 1": status.level1_error, "both levels": status.both_error}
    errors = [
        say("{levels} {share:.2f} %", levels=name, share=100.0 * error)
        for name, error in levels.items()
        if error is not None
    ]
    facts = [say("error {errors}", errors=listed(errors))] if errors else []
    task = say("{model}: learning {stage}", model=status.model, stage=status.stage)
    return status.done, status.total, task, facts


def bar_content_of_predictor(status: PredictorStatus) -> BarContent:
    """Describe the epoch, the loss and the held-out error rates."""
    if status.preparing is not None:
        return status.preparing, 1.0, say("labelling patches"), []
    facts = [] if status.loss is None else [say("loss {loss:.3f}", loss=status.loss)]
    if any(rate is not None for rate in status.held_out_errors):
        facts.append(error_rates_text(*status.held_out_errors))
    number = min(status.epoch + 1, status.epochs)
    epoch = say("epoch {number} of {epochs}", number=number, epochs=status.epochs)
    return status.done, status.total, epoch, facts
