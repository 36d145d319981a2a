"""``lcollision print``: a pose as one closed solid for a 3D printer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.console import ExitStatus, JsonOption, cancellable_bar, print_json, tell
from app.cli.options import ModelArgument, ScaleOption, takes_options
from lcollision_core.errors import LCollisionError, listed
from lcollision_core.options import NO_SCENE, PrintOptions, RuleOptions
from lcollision_core.tasks.words import counted, printed_text, say


@takes_options
def print_figure(
    model_name: ModelArgument,
    pose: Annotated[
        Path,
        typer.Argument(
            metavar="POSE", readable=False, help="A .json file of poses, or a mesh of the body."
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="The .stl or .3mf file to write.")
    ],
    options: PrintOptions,
    rules: RuleOptions,
    name: Annotated[
        str | None,
        typer.Option(
            "--pose", metavar="NAME", help="Which pose of the file. Default: its only one."
        ),
    ] = None,
    scale: ScaleOption = 1.0,
    as_json: JsonOption = False,
) -> None:
    """Make one closed solid of a pose for a 3D printer, in millimetres, z up.

    The pose is resolved first. Then all its layers become one volume without inner walls: closed
    ones are joined; of open ones, the holes of hulls are closed, and sheets, as cloth and hair, are
    made as thick as --wall; parts that are slightly apart are joined by pins. What lies enclosed is
    filled. A pose that can't become one volume is refused, with the place.

    The wall is measured at about 4000 points spread evenly over the surface, along the normal
    inwards. Where closed parts are thinner than --wall is reported, and left as it is.

    Exits with 1 if the pose could not be resolved; the file is still written, with the colliding
    parts merged.
    """
    from lcollision_core.files.formats import PRINT_SUFFIXES
    from lcollision_core.tasks.exporting import refuse_to_replace, require_output, source_files
    from lcollision_core.tasks.inputs import read_input_poses
    from lcollision_core.tasks.printing import print_pose
    from lcollision_core.tasks.scenes import open_scene

    require_output(output, *PRINT_SUFFIXES)
    model = open_scene(model_name, NO_SCENE).with_options(rules)
    refuse_to_replace([output], [pose, *source_files(model)])
    with cancellable_bar("Making a solid") as job:
        given, _ = read_input_poses(model, [pose], scale, job.part())
        if not given:
            raise typer.Exit(ExitStatus.BAD_INPUT)
        matching = [given_pose.pose for given_pose in given if name in (None, given_pose.pose.name)]
        if len(matching) != 1:
            poses = counted(len(matching), "pose", "poses") if matching else say("no pose")
            raise LCollisionError(
                say("has {poses}", poses=poses)
                if name is None
                else say("has {poses} named {name!r}", poses=poses, name=name),
                f"name one by --pose: {listed(item.pose.name for item in given)}",
                where=pose,
            )
        figure = print_pose(model, matching[0], output, options, job)
    if as_json:
        print_json(figure.to_json())
    else:
        tell(printed_text(figure))
    if options.resolve and figure.pairs_after:
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)
