"""``lcollision mirror``: poses with left and right exchanged."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from app.cli.console import ExitStatus, JsonOption, note, print_json, progress_bar, tell
from app.cli.contact_options import note_rules
from app.cli.inputs import InPlaceOption, PosesArgument, PosesOutput
from app.cli.interrupt import cancel_on_interrupt
from app.cli.models import ModelArgument
from app.cli.options import takes_options
from lcollision_core.options import RuleOptions
from lcollision_core.tasks.words import counted, mirrored_text

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, MirroredPose


@takes_options
def mirror(
    model_name: ModelArgument,
    poses: PosesArgument,
    output: PosesOutput,
    rules: RuleOptions,
    in_place: InPlaceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Exchange left and right of poses, and mirror their placement.

    Writes the pose nearest to each mirror image, with its fit error, under the same name.
    Mirroring a pose twice restores it exactly. If a pose is free of collisions by the exact check
    and its image is not, the image is resolved; exits with 1 if that fails.
    """
    from lcollision_core.bodies import open_body
    from lcollision_core.tasks.exporting import refuse_to_replace, require_output, write_result
    from lcollision_core.tasks.inputs import read_some_poses
    from lcollision_core.tasks.mirroring import mirror_poses

    destination = require_output(output, ".json")
    refuse_to_replace([output], [poses], in_place=in_place)
    model = open_body(model_name).with_options(rules)
    named = read_some_poses(poses, model)
    with cancel_on_interrupt() as job, progress_bar("Mirroring poses", job) as job:
        images = mirror_poses(model, named, job)
    written, *_ = write_result(destination, model, [pose for pose, _ in images], job=job)
    mirrored_of = {f"{poses}: {pose.name}": mirrored for pose, mirrored in images}
    if as_json:
        rows = mirrored_of.items()
        print_json([_row(model, source, written.path, mirrored) for source, mirrored in rows])
    else:
        for source, mirrored in mirrored_of.items():
            tell(f"{source}: {mirrored_text(mirrored)}")
        note_rules(model)
    colliding = [source for source, mirrored in mirrored_of.items() if mirrored.collides_newly]
    if colliding:
        offer = (
            f"run `lcollision resolve {model_name} {output}` or change them"
            if model.has_predictor
            else "the model has no predictor to resolve them with; run `lcollision label` and "
            "`lcollision train predictor`"
        )
        count = counted(len(colliding), "free pose collides", "free poses collide")
        note(f"{count} when mirrored, such as {colliding[0]}; {offer}")
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


def _row(model: Body, source: str, output: Path, mirrored: MirroredPose) -> dict[str, Any]:
    names = ("restored", "fit_error_mean", "fit_error_max")
    pairs = ("pairs_before", "pairs_mirrored", "pairs_after")
    return {
        "source": source,
        "output": str(output),
        **{name: getattr(mirrored, name) for name in (*names, *pairs)},
        "exactly_free": mirrored.pairs_after == 0,
        "resolved": mirrored.pairs_after == 0 < mirrored.pairs_mirrored,
        "near_exclusion": model.rules.near_exclusion,
    }
