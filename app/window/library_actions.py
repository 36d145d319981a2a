"""What can be done with the poses of the browser: the library's, a file's, the training set's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QObject, QPoint, Qt, Slot
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QDialog, QMenu, QWidget

from app.editing.commands import Source
from app.editing.library import retagged
from app.window.actions import ACTIONS, NO_BODY, allow_action
from app.window.dialogs.export import MotionDialog
from app.window.dialogs.names import ask_for_name
from app.window.dialogs.questions import ask_to_replace, ask_to_replace_files
from app.window.menus import MENUS, SEPARATOR
from app.wording import counted, menu_text
from app.work import jobs

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.window.file_actions import FileActions
    from app.window.panels.library import LibraryPanel
    from lcollision_core.model import NamedPose

LIBRARY_MENU = "&Library"


class LibraryActions(QObject):
    """The actions of the menu Library, which is also the browser's context menu.

    Parameters
    ----------
    window : that dialogs belong to
    document : changed
    panel : with the chosen poses
    files : asks for files
    actions : by key; their texts and whether they can be chosen follow the panel

    Attributes
    ----------
    acts : callables by the actions' keys; each may raise `LCollisionError`
    """

    def __init__(
        self,
        window: QWidget,
        document: PoseDocument,
        panel: LibraryPanel,
        files: FileActions,
        actions: Mapping[str, QAction],
    ) -> None:
        super().__init__(window)
        self._window, self._document, self._panel = window, document, panel
        self._files, self._actions = files, actions
        self.acts: dict[str, Callable[[], object]] = {
            "keep": self._keep,
            "update": document.library.update_pose,
            "load": panel.load_chosen,
            "blend": lambda: panel.blend.setFocus(Qt.FocusReason.ShortcutFocusReason),
            "rename": self._rename,
            "tags": self._tag,
            "duplicate": lambda: document.library.duplicate_poses(panel.chosen_poses),
            "mirror_poses": self._mirror,
            "remove": lambda: document.library.remove_poses(
                [pose.name for pose in panel.chosen_poses]
            ),
            "add": lambda: self._tell_added(document.library.add_poses(self._addable())),
            "import_poses": self._import,
            "export_poses": lambda: self._export(panel.chosen_poses, "Export poses"),
            "export_motion": self._export_motion,
            "export_library": lambda: self._export(document.library.poses, "Export library"),
            "find_pose": panel.find_pose,
        }
        panel.menu_wanted.connect(self._show_menu)
        for changed in (
            panel.chosen_changed,
            document.library.changed,
            document.history.file_poses_changed,
            document.history.file_changed,
            document.model_changed,
        ):
            changed.connect(self._update_actions)
        self._update_actions()

    @Slot()
    def _update_actions(self) -> None:
        document, panel = self._document, self._panel
        has_model = document.has_model
        chosen = panel.chosen_poses
        own = bool(chosen) and panel.source is Source.LIBRARY
        one = panel.chosen is not None and len(chosen) == 1
        addable = self._addable()
        select = "" if chosen else "Select poses in the Poses panel first"
        select_one = "" if one else "Select one pose in the Poses panel first"
        select_own = "" if own else "Select poses of your library first"
        update_first = "Load a pose from your library first"
        if has_model and document.history.library_pose is not None:
            update_first = "The pose is the same as in your library"
        why_not = {
            "update": "" if has_model and document.library.can_update else update_first,
            "load": select_one,
            "blend": select_one,
            "rename": select_own or select_one,
            "tags": select_own,
            "duplicate": select_own,
            "mirror_poses": select or (document.model.why_not_mirrored if has_model else ""),
            "remove": select_own,
            "add": "" if addable else "Select poses of the model or of a file first",
            "export_poses": select,
            "export_motion": select,
            "export_library": ""
            if has_model and document.library.poses
            else "Your library has no poses",
        }
        for key in self.acts:
            reason = why_not.get(key, "") if has_model else NO_BODY
            allow_action(self._actions[key], ACTIONS[key].tip, reason)
        kept = document.history.library_pose if has_model else None
        update, add = self._actions["update"], self._actions["add"]
        update.setText("&Update pose" if kept is None else f"&Update “{menu_text(kept.name)}”")
        what = "selected" if chosen or not addable else f"all {len(addable)}"
        add.setText(f"Add &{what} to library")

    def _keep(self) -> None:
        document = self._document
        replaced = ""

        def refuse(name: str) -> object:
            nonlocal replaced
            replaced = document.library.name_taken_by(name)
            reason = document.library.why_not_called(name, replaced)
            if reason or not replaced or ask_to_replace(self._window, replaced):
                return reason
            return f"your library already has a pose “{replaced}”; choose another name"

        proposed = document.library.free_name(document.history.pose.name)
        label = "Name in your library:"
        name = ask_for_name(self._window, "Add to library", label, proposed, refuse)
        if name is None:
            return
        if replaced:
            document.library.replace_pose(replaced)
        else:
            document.library.add_pose(name)
        self._panel.choose_own(document.history.pose.name)

    @Slot(QPoint)
    def _show_menu(self, position: QPoint) -> None:
        menu = QMenu(self._window)
        menu.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        for key in MENUS[LIBRARY_MENU]:
            if key == SEPARATOR:
                menu.addSeparator()
            elif self._actions[key].isEnabled():
                menu.addAction(self._actions[key])
        menu.popup(position)

    def _rename(self) -> None:
        chosen, document = self._panel.chosen_own, self._document
        if chosen is None:
            return
        old = chosen.name
        label = f"New name of “{old}”:"
        why_not = partial(document.library.why_not_called, old=old)
        name = ask_for_name(self._window, "Rename a pose", label, old, why_not)
        if name is not None:
            document.library.rename_pose(old, name)
            self._panel.choose_own(name)

    def _tag(self) -> None:
        chosen = self._panel.chosen_poses
        shared = [tag for tag in chosen[0].tags if all(tag in pose.tags for pose in chosen)]
        which = "Tags of" if len(chosen) == 1 else "Tags that are shared by"
        label = f"{which} {_called(chosen)}, with commas between them:"

        def refuse(text: str) -> str:
            return _why_no_tags(max((retagged(p, _split(text), shared) for p in chosen), key=len))

        text = ask_for_name(self._window, "Tags", label, ", ".join(shared), refuse)
        if text is not None:
            self._document.library.tag_poses([pose.name for pose in chosen], _split(text), shared)

    def _mirror(self) -> None:
        self._document.tasks.mirror_poses(self._panel.chosen_poses)
        # Where they will be.
        self._panel.own.setChecked(True)

    def _addable(self) -> tuple[NamedPose, ...]:
        """Return what Add would add: the chosen poses, or of a file all if none is chosen."""
        panel = self._panel
        if panel.source is Source.LIBRARY or not self._document.has_model:
            return ()
        everything = self._document.history.file_poses if panel.source is Source.FILE else ()
        return panel.chosen_poses or everything

    def _import(self) -> None:
        from lcollision_core.model import read_poses

        path = self._files.ask_open("Import into library", "poses")
        if path is not None:
            self._tell_added(
                self._document.library.add_poses(read_poses(path, self._document.model))
            )
            self._panel.own.setChecked(True)

    def _tell_added(self, added: int) -> None:
        self._document.message.emit(
            f"Added {counted(added, 'pose')} to your library"
            if added
            else "These poses are already in your library"
        )

    def _export_motion(self) -> None:
        model, poses = self._document.model, self._panel.chosen_poses
        of_clips = set(model.card.pose_names[1:])
        rate = model.frame_rate if any(pose.name in of_clips for pose in poses) else None
        form = MotionDialog(self._files.settings, self._window, model, rate)
        accepted = form.exec() == QDialog.DialogCode.Accepted
        kinds, style = form.kinds, form.export_request
        form.deleteLater()
        path = self._files.ask_save("Export motion", poses[0].name, kinds) if accepted else None
        if path is None:
            return
        label, write = f"Exporting {path.name}", self._document.tasks.write

        def ask_and_write(files: list[Path]) -> None:
            # The file dialog has asked about the path itself.
            there = [file for file in files if file != path and file.exists()]
            if not there or ask_to_replace_files(self._window, there):
                write(label, partial(jobs.export_motion, model, poses, path, style))

        write(label, partial(jobs.motion_files, model, path, style), ask_and_write)

    def _export(self, poses: tuple[NamedPose, ...], title: str) -> None:
        from lcollision_core.model import write_poses

        model = self._document.model
        name = poses[0].name if len(poses) == 1 else f"{model.name} poses"
        path: Path | None = self._files.ask_save(title, name, {"Poses": ".json"})
        if path is not None:
            write_poses(path, model, poses)
            self._document.message.emit(f"Exported {counted(len(poses), 'pose')} to {path.name}")


def _split(text: str) -> list[str]:
    return list(dict.fromkeys(tag for tag in map(str.strip, text.split(",")) if tag))


def _why_no_tags(tags: Sequence[str]) -> str:
    from lcollision_core.model import MAX_POSE_NAME_LENGTH, MAX_TAGS

    if len(tags) > MAX_TAGS or any(len(tag) > MAX_POSE_NAME_LENGTH for tag in tags):
        return (
            f"a pose has at most {MAX_TAGS} tags of {MAX_POSE_NAME_LENGTH} characters; shorten them"
        )
    return ""


def _called(poses: tuple[NamedPose, ...]) -> str:
    return f"“{poses[0].name}”" if len(poses) == 1 else counted(len(poses), "pose")
