"""``lcollision edit``, and ``lcollision`` alone: the editor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.contacts import keep_rules
from app.cli.options import takes_options
from lcollision_core.errors import LCollisionError
from lcollision_core.files.formats import POSES_SUFFIX
from lcollision_core.options import NO_CHANGE, RuleOptions


@takes_options
def edit(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[POSE|CHARACTER|MESH|FOLDER|SCENE]...",
            readable=False,
            help="A .json file of poses or of a scene, a rigged character, a mesh of the model's "
            "topology, a model, or a folder of meshes to learn one from. Several characters and "
            "props are a scene.",
        ),
    ] = None,
    model_name: Annotated[
        str | None,
        typer.Option("--model", metavar="M", help="A model or a character: its file, or a name."),
    ] = None,
    *,
    rules: RuleOptions,
) -> None:
    """Open the editor.

    Options of contact rules change those of the character, which keeps them: see `contacts`.
    """
    from app.window.editor import open_editor

    file = files[0] if files else None
    if files and len(files) > 1:
        from lcollision_core.tasks.scenes import kept_scene, scene_of_files

        file, model_name = None, str(kept_scene(scene_of_files(files)))
    elif file is not None and file.suffix.lower() == POSES_SUFFIX:
        from lcollision_core.bodies.scene_file import is_scene_file

        if is_scene_file(file):
            file, model_name = None, str(file)
    if file is not None and not file.is_file() and not file.is_dir():
        advice = "name a file of poses, a character, a mesh or a model, or none to start a new pose"
        raise LCollisionError("is not there", advice, where=file)
    if rules != NO_CHANGE:
        if model_name is None and file is None:
            raise LCollisionError("contact rules are those of a character", "name its file")
        from lcollision_core.bodies import open_body

        name = model_name or str(file)
        body = open_body(name)
        keep_rules(name, body, body.with_options(rules).rules)
    raise typer.Exit(open_editor(file, model_name))
