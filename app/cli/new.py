"""``lcollision new``: make a model from files of a character or of a body's poses."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli.console import JsonOption, cancel_on_interrupt, note, print_json, status_bar, tell
from app.cli.contacts import note_rules
from app.cli.evaluate import kind_lines
from app.cli.models import note_if_hiding
from app.cli.options import DeviceOption, ModelOutput, takes_options
from lcollision_core.devices import Device, choose_device
from lcollision_core.errors import CancelledError, LCollisionError, listed
from lcollision_core.options import LearningRequest
from lcollision_core.tasks.words import left_text, say, scores_text, spent_text

if TYPE_CHECKING:
    from app.cli.console import BarContent
    from lcollision_core.learning_state import LearningStatus
    from lcollision_core.tasks.learning import LearnedCard


@takes_options
def new(
    request: LearningRequest,
    output: ModelOutput,
    device: DeviceOption = Device.AUTO,
    as_json: JsonOption = False,
) -> None:
    """Make a model of a character or of a body's poses: poses, latent space, labels, predictor.

    The contact rules are proposed from the poses unless options give them. You can stop it at any
    time; the same command resumes.
    """
    from app.work.learner import STOP, cancel_on_stop_file
    from lcollision_core.bodies import LearnedBody, model_destination
    from lcollision_core.files import unused_name
    from lcollision_core.tasks.learning import MostlyCollidingError, learn_model
    from lcollision_core.tasks.work_folder import WorkFolder

    choose_device(device, note)
    sources = tuple(str(Path(source).absolute()) for source in request.sources)
    request = replace(request, sources=sources)
    work = WorkFolder(model_destination(output))
    work.prepare(request)
    # A stop request may remain from an earlier process.
    (work.path / STOP).unlink(missing_ok=True)
    try:
        with (
            cancel_on_interrupt() as job,
            cancel_on_stop_file(work, job),
            status_bar("reading files", bar_content_of_learning, job, estimates=False) as job,
        ):
            card = learn_model(work, job)
    except CancelledError:
        if work.path.is_dir():
            note(f"stopped; run the same command again to continue from {work.path}")
        raise
    except LCollisionError as error:
        if isinstance(error, MostlyCollidingError):
            rig = work.status.model
            note(
                (f"`lcollision edit {rig}` poses it by its joints; " if rig else "")
                + "the same command with --regardless trains the predictor anyway; with "
                "--leave-out or --ignore, fewer contacts count"
            )
        if not work.poses.exists() and not work.is_locked:
            work.remove()
        raise
    work.remove()
    model = LearnedBody.load(card.model)
    note_if_hiding(Path(card.model))
    picture = Path(card.model).with_name(f"{card.name}-parts.png")
    if picture.exists():
        picture = unused_name(picture)
    from app.view.figures import draw_masks

    draw_masks(model, picture)
    for remark in card.notes:
        note(remark)
    note_rules(model)
    if as_json:
        print_json(asdict(card) | {"picture": str(picture), "rules": model.rules.to_json()})
        return
    _print(card)
    tell(f"  picture of its parts: {picture}")
    tell(f"  `lcollision edit --model {card.name}` opens it")


def _print(card: LearnedCard) -> None:
    """Print the card of a model."""
    tell(
        f"{card.name}: {card.vertices} vertices, {card.parts} body parts, learned from "
        f"{card.poses} poses in {spent_text(sum(card.seconds.values()))}"
    )
    tell(
        f"  reconstruction error {100.0 * card.error_mean:.2f} % of the body size, at most "
        f"{100.0 * card.error_max:.2f} %"
    )
    tell(f"  {scores_text(asdict(card))}")
    for line in kind_lines(card.kinds):
        tell(f"    {line}")
    tell(
        say(
            "  {share:.1f} % of random poses collide; {samples} samples were labelled; {times}",
            share=100.0 * card.colliding_share,
            samples=card.samples,
            times=listed(f"{stage} {spent_text(spent)}" for stage, spent in card.seconds.items()),
        )
    )


def bar_content_of_learning(status: LearningStatus) -> BarContent:
    """Describe the stage, its progress and the time left."""
    stage = say("{stage} {share:.0f} %", stage=status.stage, share=100.0 * status.stage_done)
    left = left_text(status.seconds_left or 0.0)
    return status.done, 1.0, say("learning"), [stage, left, *status.facts]
