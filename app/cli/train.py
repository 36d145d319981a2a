"""``lcollision train``: learn a model from data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import note, status_bar
from app.cli.inputs import Axis, up_sentence
from app.cli.interrupt import cancel_on_interrupt
from app.cli.models import describe, error_sentence, note_if_beside
from app.cli.train_predictor import predictor
from lcollision_core.errors import CancelledError

if TYPE_CHECKING:
    from lcollision_core.embedding.training import StatusCallback, TrainingStatus

app = typer.Typer(help="Learn a model from data.", no_args_is_help=True)
app.command("predictor")(predictor)


@app.command("embedding")
def embedding(
    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET", readable=False, help="A folder of meshes or an .npz file."
        ),
    ],
    output: Annotated[
        str,
        typer.Option(
            "--output",
            "-o",
            metavar="M",
            help="The .safetensors file to write; a name alone stores it with your models.",
        ),
    ],
    n_domains: Annotated[
        int, typer.Option("--domains", min=1, max=64, metavar="K", help="Domains of the body.")
    ] = 10,
    n_codes: Annotated[
        int,
        typer.Option("--domain-codes", min=1, max=64, metavar="k", help="Codes of each domain."),
    ] = 10,
    near_exclusion: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=0.99,
            metavar="X",
            help="Count pairs within X body sizes along the surface apart. "
            "Default: what the set says.",
        ),
    ] = None,
    up: Annotated[
        Axis | None,
        typer.Option(help="The axis that is up. Default: what the set says, else a guess."),
    ] = None,
    scale: Annotated[
        float,
        typer.Option(metavar="S", help="Brings the poses into the unit that the model is to have."),
    ] = 1.0,
    seed: Annotated[int, typer.Option(min=0, metavar="S", help="Equal seeds, equal models.")] = 0,
    source: Annotated[
        str | None, typer.Option(help="What the poses are. Default: the dataset's name.")
    ] = None,
    licence: Annotated[str, typer.Option(help="Under which the model may be used.")] = "unknown",
) -> None:
    """Learn the latent space of a pose set.

    A checkpoint beside the output lets a run that was stopped or killed go on where it was when it
    is started again; it is removed at the end.
    """
    from dataclasses import replace

    from lcollision_core.embedding.config import EmbeddingConfig
    from lcollision_core.embedding.training import train_embedding
    from lcollision_core.meshes import file_stamp, locked, read_pose_set, require_writable
    from lcollision_core.model import PoseModel, checkpoint_path, model_destination, save_trained

    destination = model_destination(output)
    require_writable(destination)
    before = file_stamp(destination)
    poses = read_pose_set(dataset)
    if scale != 1.0:
        poses = poses.scaled(scale)
    if up is not None:
        poses = replace(poses, up_axis="xyz".index(up))
    else:
        guess = poses.up
        if not guess.is_sure:
            note(f"{up_sentence(guess)}; --up x|y|z says otherwise, now or by `lcollision upright`")
        poses = replace(poses, up_axis=guess.axis)
    for remark in poses.notes:
        note(f"{dataset}: {remark}")
    if near_exclusion is not None:
        poses = replace(poses, near_exclusion=near_exclusion)
    config = EmbeddingConfig(n_domains=n_domains, n_domain_codes=n_codes)
    checkpoint = checkpoint_path(destination)
    require_writable(checkpoint)
    if checkpoint.exists():
        note(f"going on from {checkpoint}")
    try:
        with (
            locked(checkpoint, wait=0.0),
            cancel_on_interrupt() as cancel,
            _training_bar() as progress,
        ):
            trained = train_embedding(
                poses, config, checkpoint=checkpoint, progress=progress, cancel=cancel, seed=seed
            )
    except CancelledError:
        if checkpoint.exists():
            note(f"stopped; run the same command again to go on from {checkpoint}")
        raise
    model = PoseModel.from_training(
        destination.stem, trained, poses, source, licence, _provenance(poses.vertices, seed)
    )
    written = save_trained(destination, before, model)
    note_if_beside(written, destination)
    checkpoint.unlink(missing_ok=True)
    note(f"wrote {written}: {error_sentence(describe(model))}")


def _provenance(vertices: Any, seed: int) -> dict[str, Any]:
    import hashlib
    from importlib.metadata import version

    import numpy as np

    digest = hashlib.sha256(np.ascontiguousarray(vertices).tobytes()).hexdigest()
    return {
        "program": f"lcollision {version('lcollision')}",
        "command": "train embedding",
        "seed": seed,
        "poses_sha256": digest,
    }


@contextmanager
def _training_bar() -> Iterator[StatusCallback]:
    """Give a callback that draws the stage and both levels' errors on a terminal."""
    with status_bar("reading features") as draw:

        def show(status: TrainingStatus) -> None:
            errors = [
                f"{levels} {100.0 * error:.2f} %"
                for levels, error in (
                    ("level 1", status.level1_error),
                    ("both levels", status.both_error),
                )
                if error is not None
            ]
            facts = [f"error {', '.join(errors)}"] if errors else []
            draw(status.done, status.total, facts, f"{status.model}: learning {status.stage}")

        yield show
