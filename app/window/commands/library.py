"""The Library menu, also the context menu of poses of the library, a file or the model."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import Qt

from app.editing.history import Source
from app.editing.library import retagged
from app.editing.tasks import Work
from app.window.command import EditorWindow, Menu, at_each_step, called, greyed, unless
from app.window.dialogs.forms import MotionDialog, run_form
from app.window.dialogs.questions import ask_for_name, ask_to_replace
from app.work.threads import as_task
from lcollision_core.tasks.editing import save_poses
from lcollision_core.tasks.words import counted, menu_text, say

if TYPE_CHECKING:
    from lcollision_core.bodies import NamedPose
    from lcollision_core.jobs import Job

LIBRARY = Menu("&Library")


def _addable(window: EditorWindow) -> tuple[NamedPose, ...]:
    """Return the poses that Add adds: the selected ones, or all of a file if none is selected."""
    panel = window.library
    if panel.source is Source.LIBRARY or not window.document.has_model:
        return ()
    everything = window.document.history.file_poses if panel.source is Source.FILE else ()
    return panel.chosen_poses or everything


def _tell_added(window: EditorWindow, added: int) -> None:
    window.document.message.emit(
        f"Added {counted(added, 'pose', 'poses')} to your library"
        if added
        else "These poses are already in your library"
    )


def _export(window: EditorWindow, poses: tuple[NamedPose, ...], title: str) -> None:
    document, model = window.document, window.document.model
    name = poses[0].name if len(poses) == 1 else f"{model.name} poses"
    path: Path | None = window.files.ask_save(title, name, {"Poses": ".json"})
    if path is not None:
        text = f"Exported {counted(len(poses), 'pose', 'poses')} to {path.name}"
        job = as_task(save_poses, path, model, poses)
        document.tasks.save_file(path, job, lambda _: text)


def _split(text: str) -> list[str]:
    return list(dict.fromkeys(tag for tag in map(str.strip, text.split(",")) if tag))


def _why_no_tags(tags: Sequence[str]) -> str:
    from lcollision_core.bodies import MAX_POSE_NAME_LENGTH, MAX_TAGS

    if len(tags) > MAX_TAGS or any(len(tag) > MAX_POSE_NAME_LENGTH for tag in tags):
        return (
            f"a pose has at most {MAX_TAGS} tags of {MAX_POSE_NAME_LENGTH} characters; shorten them"
        )
    return ""


def _called(poses: tuple[NamedPose, ...]) -> str:
    return f"“{poses[0].name}”" if len(poses) == 1 else counted(len(poses), "pose", "poses")


def _why_not_any(window: EditorWindow) -> str:
    return "" if window.library.chosen_poses else "Select poses in the Poses panel first"


def _why_not_one(window: EditorWindow) -> str:
    panel = window.library
    one = panel.chosen is not None and len(panel.chosen_poses) == 1
    return "" if one else "Select one pose in the Poses panel first"


def _why_not_own(window: EditorWindow) -> str:
    panel = window.library
    is_own_pose = panel.chosen_poses and panel.source is Source.LIBRARY
    return "" if is_own_pose else "Select poses of your library first"


def _why_not_updated(window: EditorWindow) -> str:
    document = window.document
    if document.library.can_update:
        return ""
    if document.history.library_pose is None:
        return "Load a pose from your library first"
    return "The pose is the same as in your library"


def _update_text(window: EditorWindow) -> str:
    library_pose = window.document.history.library_pose
    return "&Update pose" if library_pose is None else f"&Update “{menu_text(library_pose.name)}”"


def _add_text(window: EditorWindow) -> str:
    addable = _addable(window)
    if window.library.chosen_poses or not addable:
        return "Add &selected to library"
    return say("Add &all {n} to library", n=len(addable))


@LIBRARY.command("load", "&Load selected pose", "Ctrl+Return", "Edit the selected pose")
@greyed(_why_not_one)
def _load(window: EditorWindow) -> None:
    window.library.load_chosen()


@LIBRARY.command(
    "blend", "&Blend towards selected pose", "Ctrl+B", "Go to the slider that blends towards it"
)
@greyed(_why_not_one)
def _blend(window: EditorWindow) -> None:
    window.library.blend.setFocus(Qt.FocusReason.ShortcutFocusReason)


LIBRARY.line()


@LIBRARY.command("rename", "Re&name…", "F2", "Rename the selected pose of your library")
@greyed(lambda window: _why_not_own(window) or _why_not_one(window))
def _rename(window: EditorWindow) -> None:
    pose, document = window.library.chosen_own, window.document
    if pose is None:
        return
    old = pose.name
    label = f"New name of “{old}”:"
    why_not = partial(document.library.why_not_called, old=old)
    name = ask_for_name(window, "Rename a pose", label, old, why_not)
    if name is not None:
        document.library.rename_pose(old, name)
        window.library.choose_own(name)


@LIBRARY.command("tags", "Ta&gs…", "Ctrl+Shift+T", "Edit the tags of the selected poses")
@greyed(_why_not_own)
def _tag(window: EditorWindow) -> None:
    poses = window.library.chosen_poses
    shared = [tag for tag in poses[0].tags if all(tag in pose.tags for pose in poses)]
    label = say("Tags of {poses}, with commas between them:", poses=_called(poses))
    if len(poses) > 1:
        named = _called(poses)
        label = say("Tags that are shared by {poses}, with commas between them:", poses=named)

    def refuse(text: str) -> str:
        return _why_no_tags(max((retagged(p, _split(text), shared) for p in poses), key=len))

    text = ask_for_name(window, "Tags", label, ", ".join(shared), refuse)
    if text is not None:
        window.document.library.tag_poses([pose.name for pose in poses], _split(text), shared)


@LIBRARY.command(
    "duplicate", "&Duplicate", "Ctrl+Shift+D", "Copy the selected poses in the library"
)
@greyed(_why_not_own)
def _duplicate(window: EditorWindow) -> None:
    window.document.library.duplicate_poses(window.library.chosen_poses)


@LIBRARY.command(
    "mirror_poses",
    "&Mirror into library",
    "Ctrl+Shift+M",
    "Add the selected poses, mirrored, to your library",
)
@greyed(lambda window: _why_not_any(window) or window.document.model.why_not_mirrored)
def _mirror(window: EditorWindow) -> None:
    window.document.tasks.mirror_poses(window.library.chosen_poses)
    # Show the library, where the mirrored poses will be.
    window.library.own.setChecked(True)


@LIBRARY.command(
    "remove", "R&emove", "Ctrl+Delete", "Remove the selected poses from your library", "remove"
)
@greyed(_why_not_own)
def _remove(window: EditorWindow) -> None:
    window.document.library.remove_poses([p.name for p in window.library.chosen_poses])


@LIBRARY.command(
    "add", "Add &selected to library", "Ctrl+Shift+K", "Copy poses from here into your library"
)
@unless(_addable, "Select poses of the model or of a file first")
@called(_add_text)
def _add(window: EditorWindow) -> None:
    _tell_added(window, window.document.library.add_poses(_addable(window)))


LIBRARY.line()


@LIBRARY.command("keep", "Add &to library…", "Ctrl+K", "Add this pose to your library", "add")
def _keep(window: EditorWindow) -> None:
    document = window.document
    replaced = ""

    def refuse(name: str) -> object:
        nonlocal replaced
        replaced = document.library.name_taken_by(name)
        reason = document.library.why_not_called(name, replaced)
        if reason or not replaced or ask_to_replace(window, replaced):
            return reason
        return f"your library already has a pose “{replaced}”; choose another name"

    proposed = document.library.free_name(document.history.pose.name)
    label = "Name in your library:"
    name = ask_for_name(window, "Add to library", label, proposed, refuse)
    if name is None:
        return
    if replaced:
        document.library.replace_pose(replaced)
    else:
        document.library.add_pose(name)
    window.library.choose_own(document.history.pose.name)


@LIBRARY.command("update", "&Update pose", "Ctrl+U", "Replace the library's pose with this one")
@greyed(_why_not_updated)
@at_each_step
@called(_update_text)
def _update(window: EditorWindow) -> None:
    window.document.library.update_pose()


LIBRARY.line()


@LIBRARY.command(
    "import_poses",
    "&Import into library…",
    "Ctrl+Shift+I",
    "Add the poses of a file to your library",
)
def _import(window: EditorWindow) -> None:
    from lcollision_core.bodies import read_poses

    path = window.files.ask_open("Import into library", "poses")
    if path is None:
        return
    document, model = window.document, window.document.model

    def add(poses: Sequence[NamedPose]) -> None:
        _tell_added(window, document.library.add_poses(poses))
        window.library.own.setChecked(True)

    def read(_: Job) -> Sequence[NamedPose]:
        return read_poses(path, model)

    document.tasks.start(Work.IMPORT_POSES, f"Importing {path.name}", read, add)


@LIBRARY.command(
    "export_poses", "E&xport selected poses…", "Ctrl+Shift+E", "Save the selected poses to a file"
)
@greyed(_why_not_any)
def _export_poses(window: EditorWindow) -> None:
    _export(window, window.library.chosen_poses, "Export poses")


@LIBRARY.command(
    "export_motion",
    "Export moti&on…",
    "Ctrl+Alt+M",
    "Save the selected poses as the frames of a point cache",
)
@greyed(_why_not_any)
def _export_motion(window: EditorWindow) -> None:
    from lcollision_core.motion import Motion

    model, poses = window.document.model, window.library.chosen_poses
    form = MotionDialog(window.settings, window, model)
    accepted = run_form(form)
    kinds, style = form.kinds, form.export_request
    path = window.files.ask_save("Export motion", poses[0].name, kinds) if accepted else None
    if path is not None:
        codes = np.array([pose.latent for pose in poses])
        motion = Motion(path.stem, np.arange(len(codes)) / style.fps, codes)
        window.files.write_frames(model, motion, path, style)


@LIBRARY.command(
    "export_library", "Export libr&ary…", "Ctrl+Alt+E", "Save your whole library to a file"
)
@unless(lambda window: window.document.library.poses, "Your library has no poses")
def _export_library(window: EditorWindow) -> None:
    _export(window, window.document.library.poses, "Export library")


LIBRARY.line()


@LIBRARY.command("find_pose", "&Find a pose", "Ctrl+Shift+F", "Search the poses by name or tag")
def _find_pose(window: EditorWindow) -> None:
    window.library.find_pose()
