"""Actions of the File menu: the file dialogs, opening, saving, importing and exporting."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from PySide6.QtCore import QObject, Qt, QTimer, Signal, Slot
from PySide6.QtWidgets import QDialog, QFileDialog, QInputDialog, QWidget

from app.editing.history import Source, named_after, read_only
from app.window.dialogs.forms import (
    ExportDialog,
    MotionDialog,
    SceneExportDialog,
    print_form,
    print_options,
    run_form,
    screenshot_form,
    video_form,
)
from app.window.dialogs.questions import (
    Choice,
    ask_about_changed_file,
    ask_about_changes,
    ask_about_library,
    ask_about_motions,
    ask_about_scale,
    ask_to_join,
    ask_to_replace_files,
    ask_to_switch,
    ask_to_turn,
    wait_for_exports,
)
from app.window.widgets import ListMenu, plain_tip
from app.work.threads import as_task
from lcollision_core.errors import LCollisionError
from lcollision_core.files.formats import (
    CHARACTER_SUFFIXES,
    FILES,
    LEARNED_FROM,
    MODEL_SUFFIX,
    MOTION_SUFFIXES,
    POSES_SUFFIX,
    PRINT_SUFFIXES,
    READABLE_SUFFIXES,
    SKELETON_SUFFIXES,
)
from lcollision_core.tasks.editing import save_poses
from lcollision_core.tasks.opening import Unposable
from lcollision_core.tasks.words import counted, menu_text, say

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.editing.settings import Settings
    from app.view.offscreen import VideoStyle
    from app.view.viewport import Viewport
    from lcollision_core.bodies import Body, NamedPose, OtherModelError, SceneBody, SourceFile
    from lcollision_core.errors import WrongScaleError
    from lcollision_core.motion import Motion
    from lcollision_core.options import ExportRequest
    from lcollision_core.tasks.opening import FileContent, MemberPose

_VIDEOS = {"GIF": ".gif", "WebP": ".webp", "PNG sequence in a new folder": ".png"}


def _kinds(*wanted: str) -> str:
    """Return the name filter of a file dialog for kinds of files, keys of `suffixes`."""
    suffixes = {
        "poses": (POSES_SUFFIX,),
        "characters": CHARACTER_SUFFIXES,
        "meshes": READABLE_SUFFIXES,
        "models": (MODEL_SUFFIX,),
        "motion": (*MOTION_SUFFIXES, POSES_SUFFIX),
    }
    masks = {
        kind: " ".join(f"*{suffix}" for suffix in of_kind) for kind, of_kind in suffixes.items()
    }
    filters = [f"{kind.capitalize()} ({masks[kind]})" for kind in wanted]
    if len(wanted) > 1:
        patterns = dict.fromkeys(" ".join(masks[kind] for kind in wanted).split())
        filters.insert(0, f"All supported files ({' '.join(patterns)})")
    return ";;".join(filters)


def _kind(path: Path) -> str:
    """Return the name of a file's format, taken from its extension, such as "FBX"."""
    return path.suffix.removeprefix(".").upper() or "A file without an extension"


class _Carried(NamedTuple):
    """What a body or a scene keeps when it is opened again with more or fewer bodies."""

    body: Body
    pose: NamedPose | None
    locked_domains: frozenset[int]
    removed: str


class FileActions(QObject):
    """Open, save, import and export, asking for files where needed.

    Errors that the user can fix are raised as `LCollisionError`, for the window to show.

    Signals
    -------
    learning_wanted : tuple of Path, folders of meshes and other files to learn a model from

    Parameters
    ----------
    window : parent of the dialogs
    document : opened into and saved from
    settings : remembers the last folder, the recent files and the model
    viewport : the source of pictures
    attempt : calls a function and shows an error that the user can fix

    Attributes
    ----------
    settings : as given
    recent_menu, models_menu : of files and models that a click opens
    """

    learning_wanted = Signal(object)

    def __init__(
        self,
        window: QWidget,
        document: PoseDocument,
        settings: Settings,
        viewport: Viewport,
        attempt: Callable[[Callable[[], object]], object],
    ) -> None:
        super().__init__(window)
        self._attempt = attempt
        self._window = window
        self._document = document
        self.settings = settings
        self._viewport = viewport
        self.recent_menu = ListMenu("Open &recent", window, attempt, self._fill_recent)
        self._fill_recent()
        self.models_menu = ListMenu("Mode&ls", window, attempt, self._fill_models)
        document.tasks.may_replace = lambda: bool(attempt(self.confirm_losing_changes))
        document.tasks.may_leave_pose = lambda: bool(attempt(self.confirm_losing_pose))
        document.history.file_changed.connect(self._on_file)
        document.model_changed.connect(self._on_model)
        document.tasks.imported.connect(self._on_arrived)
        document.tasks.opened.connect(self._on_arrived)
        document.message.connect(self._on_message)
        # Queued: the task must have ended, and the window must show so, before the question.
        document.tasks.of_other_model.connect(
            self._on_other_model, Qt.ConnectionType.QueuedConnection
        )
        document.tasks.of_member.connect(self._on_member, Qt.ConnectionType.QueuedConnection)
        document.tasks.wrong_scale.connect(self._offer_scale, Qt.ConnectionType.QueuedConnection)
        self._dropped: tuple[Path, int] | None = None
        self._last_message = ""
        self._carried: _Carried | None = None

    def ask_and_open(self, title: str, *kinds: str) -> None:
        """Ask for a file of some kinds and open it; see `_kinds`."""
        path = self.ask_open(title, *kinds)
        if path is not None:
            self.open_path(path)

    def import_mesh(self) -> None:
        """Ask for a file and import it as a mesh, even if it has a rig."""
        path = self.ask_open("Import mesh", "meshes")
        if path is not None:
            self._import_mesh(path)

    def _import_mesh(self, path: Path, is_asked: bool = True) -> None:
        self._require_model(path)
        self._carried = None
        self._document.tasks.import_mesh(path, is_asked_as_mesh=is_asked)
        self._remember_folder(path)

    def why_not_upright(self) -> str:
        """Return why the body cannot be turned, "" if it can."""
        from lcollision_core.bodies import is_bundled

        if is_bundled(self._document.history.model_file):
            return (
                "This model is bundled with the program: copy its file, open the copy and turn that"
            )
        return ""

    def turn_upright(self) -> None:
        """Make the next axis the up axis and reopen the body; a model's file is changed."""
        model = self._document.model
        if model.is_trained and not ask_to_turn(self._window, model.name):
            return
        if self.confirm_losing_changes():
            self._document.tasks.turn_upright()

    def set_joint_role(self, joint: str, role: str | None) -> None:
        """Set the role of a character's joint and reopen the character with other sliders."""
        if self.confirm_losing_changes():
            self._document.tasks.set_joint_role(joint, role)

    def open_path(
        self, path: Path, body_is_chosen: bool = True, beside: Body | None = None
    ) -> None:
        """Open a file by its extension: poses, a model, a character, a mesh or a motion.

        A file without a rig is a mesh. Folders and sets of poses lead to a new model.

        Parameters
        ----------
        body_is_chosen : whether the user chose the open body, into which a mesh is imported
        beside : a body that the file may join; the user is asked whether it does

        Raises
        ------
        LCollisionError : the extension is not supported, or the file does not exist.
        """
        from lcollision_core.bodies.scene_file import is_scene_file
        from lcollision_core.files.motion.generated import is_generated
        from lcollision_core.files.motion.smpl import is_smpl_motion

        self._dropped = self._carried = None
        suffix = path.suffix.lower()
        if is_learned_from(path):
            self.learning_wanted.emit((path,))
            return
        if not path.is_file():
            self.settings.forget_file(str(path.resolve()))
            raise LCollisionError(
                f"Couldn't open {path}: there is no such file",
                "choose a file of poses, a character, a mesh or a model",
            )
        tasks, meshes = self._document.tasks, (*READABLE_SUFFIXES, *CHARACTER_SUFFIXES)
        if suffix in SKELETON_SUFFIXES or is_smpl_motion(path) or is_generated(path):
            self.open_motion(path)
        elif suffix in CHARACTER_SUFFIXES or (beside is not None and suffix in READABLE_SUFFIXES):
            tasks.examine(path, partial(self._open_examined, path, beside), beside=beside)
        elif suffix in READABLE_SUFFIXES:
            # No question about changes: the import can be undone.
            self._import_mesh(path, body_is_chosen)
        elif suffix == MODEL_SUFFIX:
            if self.confirm_losing_changes():
                tasks.open_model(path)
                self._remember_folder(path)
        elif is_scene_file(path):
            if self.confirm_losing_changes():
                tasks.open_model(path)
        elif suffix == POSES_SUFFIX:
            if self.confirm_losing_changes(with_library=False):
                self._require_model(path)
                tasks.open_poses(path)
                self._remember_folder(path)
        else:
            raise LCollisionError(
                f"isn't supported ({path.name})",
                f"open poses ({POSES_SUFFIX}), a character or a mesh "
                f"({', '.join(dict.fromkeys(meshes))}), a motion ({', '.join(SKELETON_SUFFIXES)}) "
                f"or a model ({MODEL_SUFFIX})",
                where=_kind(path),
            )

    def _require_model(self, path: Path) -> None:
        if not self._document.has_model:
            raise LCollisionError(
                "can only be opened once a body is open",
                "open a model or a character first",
                where=path.name,
            )

    def open_motion(self, path: Path) -> None:
        """Open a motion of the open body on the timeline, after asking about unsaved changes."""
        self._require_model(path)
        if self.confirm_losing_changes(with_library=False):
            self._document.timeline.open(path)

    def _open_examined(self, path: Path, beside: Body | None, read: FileContent) -> None:
        """Open an examined file, or ask whether it joins the open body."""
        is_body = read is not None and read is not Unposable.CLIPS
        if is_body and beside is not None and not beside.is_of_file(path):
            # The task must have ended, and the window must show so, before the question.
            QTimer.singleShot(0, self, partial(self._ask_to_join, path, beside, read))
        else:
            self._open_read(path, read)

    def _ask_to_join(self, path: Path, beside: Body, read: FileContent) -> None:
        is_prop = read is Unposable.OTHER_MESH
        answer = ask_to_join(self._window, path.name, beside.name, is_prop)
        if answer is Choice.SAVE:
            self._attempt(partial(self.add_to_scene, path))
        elif answer is Choice.DISCARD:
            self._open_read(path, read)

    def _open_read(self, path: Path, read: FileContent) -> None:
        """Open a file that was read: a body if rigged, else a motion or mesh of the open one."""
        if read is Unposable.CLIPS:
            self._attempt(partial(self.open_motion, path))
        elif read is None or isinstance(read, Unposable):
            is_asked = path.suffix.lower() not in CHARACTER_SUFFIXES
            self._attempt(partial(self._import_mesh, path, is_asked=is_asked))
        elif self._attempt(self.confirm_losing_changes):
            self._document.tasks.open_model(path, read)
            self._remember_folder(path)

    def open_dropped(self, paths: Sequence[Path]) -> None:
        """Open the first supported file of several, and report the others afterwards.

        Raises
        ------
        LCollisionError : as for `open_path`.
        """
        if all(map(is_learned_from, paths)):
            self.learning_wanted.emit(tuple(paths))
            return
        suffixes = (POSES_SUFFIX, MODEL_SUFFIX, *READABLE_SUFFIXES, *CHARACTER_SUFFIXES)
        path = next((dropped for dropped in paths if dropped.suffix.lower() in suffixes), paths[0])
        document = self._document
        may_join = document.has_model and not document.model.is_trained
        self.open_path(path, beside=document.model if may_join else None)
        if len(paths) > 1:
            self._dropped = (path, len(paths))

    def add_to_scene(self, path: Path) -> None:
        """Open the current body, in its pose, and one more beside it as a scene."""
        from lcollision_core.tasks.scenes import with_body

        self._open_in_pose(partial(with_body, path=path))

    def remove_from_scene(self, name: str) -> None:
        """Open the scene without one of its bodies; the others keep their pose."""
        from lcollision_core.tasks.scenes import without_body

        scene = self._document.scene
        assert scene is not None
        self._open_in_pose(lambda *_: without_body(scene, name), removed=name)

    def _open_in_pose(self, changed: Callable[[Body, str], str], removed: str = "") -> None:
        """Open the file made from the current body and its file, with bodies as they are posed."""
        history = self._document.history
        if self._confirm_losing_motions() and self._may_lose_library():
            file = changed(history.model, str(history.model.own_file or history.model_file))
            is_posed = history.state.moment is None and history.latent.any()
            self._carry(history.pose if is_posed else None, removed)
            self._document.tasks.open_model(file)

    def _carry(self, pose: NamedPose | None, removed: str = "") -> None:
        document = self._document
        self._carried = _Carried(document.model, pose, document.motion.locked_domains, removed)

    def play_clip(self, name: str, clip: str, start: float) -> None:
        """Let a body of the scene play a clip that starts after `start` seconds."""
        from lcollision_core.tasks.scenes import kept_scene, playing

        scene = self._document.scene
        assert scene is not None
        assert scene.file is not None
        if self.confirm_losing_changes(with_library=False):
            number = [member.name for member in scene.members].index(name)
            file = playing(scene.file, number, clip, start)
            scene_path = str(kept_scene(file))
            self._document.replay(scene.with_file(replace(file, path=scene_path)), scene_path)

    def toggle_ground(self) -> None:
        """Add or remove a level ground in the check; the body is reopened in its pose."""
        from lcollision_core.tasks.scenes import with_ground

        history = self._document.history
        if self._confirm_losing_motions() and self._may_lose_library():
            file = str(history.model.own_file or history.model_file)
            self._carry(history.pose)
            self._document.tasks.open_model(with_ground(history.model, file))

    def save_scene(self) -> None:
        """Ask for a file and write the scene's composition to it."""
        from lcollision_core.bodies.scene_file import write_scene_file

        scene = self._document.scene
        if scene is None or scene.file is None:
            return
        path = self.ask_save("Save scene", scene.name, {"Scene": POSES_SUFFIX})
        if path is not None:
            write_scene_file(path, scene.file)
            self._remember(path)
            self._document.message.emit(f"Saved the scene to {path.name}")

    def new_pose(self) -> None:
        """Start again from the first pose, unless the user wants to keep the changes."""
        if self.confirm_losing_changes(with_library=False):
            self._document.new_pose()

    def save(self) -> bool:
        """Save the pose; if it is a frame of an edited motion, export the motion instead.

        Asks for a file if there is none yet.

        Returns
        -------
        begun : whether saving has begun; False if the user cancelled
        """
        document = self._document
        document.tasks.wait_for_saves()
        # An unfinished gesture counts as an edit.
        document.history.close_gesture()
        if document.timeline.frame is not None and not document.timeline.are_saved():
            tip = "Save exports the edited motion; Save as saves the frame as a pose"
            document.message.emit(tip)
            return self.export_motion()
        if document.history.file is None or document.timeline.frame is not None:
            # Do not overwrite the file's pose with a frame without asking.
            return self.save_as()
        if document.history.file_changed_elsewhere:
            answer = ask_about_changed_file(self._window, document.history.file.name)
            if answer is not Choice.DISCARD:
                return answer is Choice.SAVE and self.save_as()
        document.tasks.save()
        return True

    def save_as(self) -> bool:
        """Ask for a file and save; see `save`."""
        document = self._document
        document.motion.end_gesture()
        model, history = document.model, document.history
        poses, asked_pose = history.file_poses, history.pose
        path = self.ask_save("Save poses", self._name, {"Poses": POSES_SUFFIX}, history.file)
        if path is None:
            return False
        if history.pose is asked_pose:
            document.tasks.save(path)
        else:
            # Another pose was opened while the dialog was shown.
            pose = named_after(asked_pose, path)
            text = f"Saved “{pose.name}” to {path.name}; the pose opened since is unsaved"
            job = as_task(save_poses, path, model, poses, pose)
            document.tasks.save_file(path, job, lambda _: text)
        return True

    def export(self) -> None:
        """Ask how and where, and write the pose as a mesh; of a scene, one file per body."""
        from lcollision_core.tasks import exporting, scenes

        document, scene = self._document, self._document.scene
        if scene is not None:
            pose = document.history.pose
            bodies = SceneExportDialog(self.settings, self._window, scene)
            accepted, request = run_form(bodies), bodies.export_request
            folder = self._ask_folder_of_bodies(scene, request.mesh_format) if accepted else None
            if folder is not None:
                work = partial(scenes.export_scene_pose, folder, scene, pose, request)
                document.tasks.write(f"Exporting {folder.name}", work)
            return
        # Capture the model and pose now: others may be opened while the dialogs are shown.
        state = document.history.state
        export = partial(
            exporting.export, document.model, state.pose, state.outcome, own=state.space
        )
        form = ExportDialog(self.settings, self._window, document.model)
        accepted = run_form(form)
        kinds, style = form.kinds, form.export_request
        path = self.ask_save("Export mesh", self._name, kinds) if accepted else None
        if path is not None:
            document.tasks.write(f"Exporting {path.name}", as_task(export, path, style))

    def export_print(self) -> None:
        """Ask how and where, and write the pose as one solid for a 3D printer."""
        from lcollision_core.tasks import printing

        document = self._document
        model, state = document.model, document.history.state
        resolve = document.tasks.resolve_options() if model.can_resolve else None
        form = print_form(self.settings, self._window)
        accepted = run_form(form)
        kinds = {FILES[suffix].label: suffix for suffix in PRINT_SUFFIXES}
        path = self.ask_save("Export for 3D printing", self._name, kinds) if accepted else None
        if path is not None:
            work = partial(
                printing.export_print,
                model,
                state.pose,
                path,
                print_options(self.settings, model.rules.left_out),
                resolve=resolve,
                own=state.space,
            )
            document.tasks.write(f"Exporting {path.name}", work)

    def export_motion(self) -> bool:
        """Ask how and where, and write the motion: as a clip in its source file, or its frames.

        Returns
        -------
        begun : whether writing has begun; False if the user cancelled
        """
        from lcollision_core.files.motion.smpl import is_smpl_motion

        document, timeline = self._document, self._document.timeline
        model, motion, file = document.model, timeline.motion, timeline.file
        changes = timeline.changes
        if motion is None or file is None:
            raise LCollisionError("there is no motion", "open one first")
        if document.scene is not None:
            return self._export_scene_motion(document.scene, motion)
        form = MotionDialog(self.settings, self._window, model, motion.rate, timeline)
        accepted = run_form(form)
        kinds, request, frames = form.kinds, form.export_request, form.frames
        is_clip = form.is_clip
        own_suffix = file.suffix.lower()
        is_own_smpl = is_smpl_motion(file) and timeline.joints is None
        if is_own_smpl:
            kinds = {_kind(file): own_suffix, **kinds}
        name = f"{Path(motion.source).stem or motion.name}, resolved"
        path = self.ask_save("Export motion", name, kinds) if accepted else None
        if path is None:
            return False
        is_clip = is_clip or (is_own_smpl and path.suffix.lower() == own_suffix)
        exported = [now for _, now in changes] if is_clip else [motion]
        done = partial(self._on_motions_exported, exported)
        if is_clip:
            from lcollision_core.tasks import exporting

            job = as_task(exporting.export_clips, model, file, changes, path)
            document.tasks.write(f"Exporting {path.name}", job, done)
        else:
            part = motion.part(frames).at_rate(request.fps)
            self.write_frames(model, part, path, request, done)
        return True

    def _export_scene_motion(self, scene: SceneBody, motion: Motion) -> bool:
        from lcollision_core.tasks import scenes

        original = self._document.timeline.original
        folder = self._ask_folder_of_bodies(scene, of_motion=True)
        if folder is None or original is None:
            return False
        work = partial(scenes.export_scene_motion, folder, scene, original, motion)
        done = partial(self._on_motions_exported, [motion])
        self._document.tasks.write(f"Exporting {folder.name}", work, done)
        return True

    def _on_motions_exported(self, exported: Sequence[Motion], sentence: str) -> None:
        self._document.timeline.mark_saved(exported)
        self._document.message.emit(sentence)

    def _ask_folder_of_bodies(
        self, scene: SceneBody, mesh_format: str | None = None, *, of_motion: bool = False
    ) -> Path | None:
        """Ask for a folder to write each body of a scene to; None if the user cancels.

        Raises
        ------
        LCollisionError : a source file of the scene would be replaced.
        """
        from lcollision_core.tasks.exporting import refuse_to_replace, source_files
        from lcollision_core.tasks.scenes import files_of_members

        title, start = "Export each body to a folder", str(self._folder())
        folder = QFileDialog.getExistingDirectory(self._window, title, start)
        if not folder:
            return None
        files = files_of_members(Path(folder), scene, mesh_format, of_motion=of_motion)
        refuse_to_replace(files, source_files(scene))
        there = [file for file in files if file.exists()]
        if there and not ask_to_replace_files(self._window, there):
            return None
        return Path(folder)

    def write_frames(
        self,
        model: Body,
        motion: Motion,
        path: Path,
        request: ExportRequest,
        done: Callable[[str], None] | None = None,
    ) -> None:
        """Write a motion as frames; first ask before replacing files other than `path`.

        Parameters
        ----------
        done : called with the message for the status bar; None shows the message
        """
        from lcollision_core.tasks import exporting

        label, write = f"Exporting {path.name}", self._document.tasks.write

        def ask_and_write(of_export: tuple[list[Path], SourceFile | None]) -> None:
            files, source = of_export
            export = partial(exporting.export_frames, model, motion, path, request, source=source)
            # The file dialog has already asked about the path itself.
            there = [file for file in files if file != path and file.exists()]
            if not there or ask_to_replace_files(self._window, there):
                write(label, export, done)

        write(label, as_task(exporting.frame_files, model, path, request), ask_and_write)

    def screenshot(self) -> None:
        """Ask how and where, and write a screenshot of the view."""
        form = screenshot_form(self.settings, self._window)
        path = self._ask_save_after(form, "Save screenshot", {"PNG": ".png"})
        if path is not None:
            names = ("width", "height", "transparent")
            values = (self.settings[f"screenshot_{name}"] for name in names)
            self._viewport.pictures.screenshot(path, *values)

    def turntable(self) -> None:
        """Ask how and where, and write a turntable video."""
        form = video_form(self.settings, self._window)
        path = self._ask_save_after(form, "Save turntable", _VIDEOS)
        if path is not None:
            self._viewport.pictures.film(path, self._video_style())

    def video(self) -> None:
        """Ask how and where, and write a video of the motion between the in and out points."""
        timeline = self._document.timeline
        motion = timeline.motion
        if motion is None:
            raise LCollisionError("there is no motion", "open one first")
        form = video_form(self.settings, self._window, of_motion=True)
        path = self._ask_save_after(form, "Save video", _VIDEOS)
        if path is not None:
            style = self._video_style()
            shown_motion = motion.part(range(timeline.first, timeline.last + 1)).at_rate(style.rate)
            style = replace(style, seconds=len(shown_motion) / style.rate)
            self._viewport.pictures.film(path, style, shown_motion, self._viewport.follows)

    def _video_style(self) -> VideoStyle:
        from app.view.offscreen import VideoStyle

        names = ("seconds", "width", "height", "rate", "background", "colour")
        return VideoStyle(*(self.settings[f"turntable_{name}"] for name in names))

    def _ask_save_after(self, form: QDialog, title: str, kinds: dict[str, str]) -> Path | None:
        """Show a form, then ask for a file to write; a turntable's format is listed first."""
        accepted = run_form(form)
        first = f".{self.settings['turntable_format']}"
        kinds = dict(sorted(kinds.items(), key=lambda kind: kind[1] != first))
        return self.ask_save(title, self._name, kinds) if accepted else None

    def confirm_losing_changes(self, with_library: bool = True) -> bool:
        """Ask about unsaved changes; return False if the user wants to go on editing.

        Parameters
        ----------
        with_library : whether to ask about an unwritten pose library too
        """
        may_go = self._confirm_losing_motions() and self.confirm_losing_pose()
        return may_go and (not with_library or self._may_lose_library())

    def _confirm_losing_motions(self) -> bool:
        """Ask about edited motions; see `confirm_losing_changes`."""
        document = self._document
        document.tasks.wait_for_saves()
        # An export of frames is of one motion; others are asked about again.
        while document.has_model and not document.timeline.are_saved():
            changed = [now.name for _, now in document.timeline.changes]
            answer = ask_about_motions(self._window, changed)
            if answer is Choice.DISCARD:
                return True
            if answer is Choice.CANCEL or not self.export_motion():
                return False
            written = wait_for_exports(
                self._window,
                document,
                self._viewport.pictures,
                "Exporting",
                "Your command continues once that is done.",
            )
            if not written:
                return False
        return True

    def confirm_losing_pose(self) -> bool:
        """Ask about an unsaved pose that is not a motion's frame; see `confirm_losing_changes`."""
        document = self._document
        history = document.history
        if not document.has_model or history.state.moment is not None or not history.modified:
            return True
        file = history.file
        answer = ask_about_changes(
            self._window, self._name, document.model.name, file.name if file else ""
        )
        if answer is Choice.SAVE and self.save():
            document.tasks.wait_for_saves()
            return not history.modified
        return answer is Choice.DISCARD

    def _may_lose_library(self) -> bool:
        document = self._document
        document.tasks.wait_for_saves()
        if document.library.is_written:
            return True
        answer = ask_about_library(self._window, document.model.name)
        if answer is Choice.SAVE:
            document.library.write()
            document.tasks.wait_for_saves()
        elif answer is Choice.DISCARD:
            document.library.discard_changes()
        return document.library.is_written

    def _fill_recent(self) -> None:
        for index, name in enumerate(self.settings["recent_files"], start=1):
            path = Path(name)
            text = f"&{index}  {menu_text(path.name)}"
            self.recent_menu.entry(text, self.open_path, path, tip=plain_tip(str(path)))
        if self.recent_menu.isEmpty():
            self.recent_menu.addAction("No files yet").setEnabled(False)

    def _fill_models(self) -> None:
        from lcollision_core.bodies import list_models

        for model in list_models():
            self.models_menu.entry(
                menu_text(model.name),
                self.open_path,
                model.path,
                tip=plain_tip(str(model.path)),
                ticked=model.path.absolute() == Path(self._document.history.model_file),
            )

    @Slot()
    def _on_file(self) -> None:
        if self._document.history.file is not None:
            self._remember(self._document.history.file)

    @Slot(object)
    def _on_arrived(self, path: Path) -> None:
        """Remember a file that has been opened, and report those dropped with it."""
        if path.suffix.lower() in (*READABLE_SUFFIXES, *CHARACTER_SUFFIXES):
            self._remember(path)
        carried, self._carried = self._carried, None
        if carried is not None:
            self._restore(carried)
        dropped, self._dropped = self._dropped, None
        if dropped is not None and dropped[0].absolute() == path.absolute():
            others = counted(dropped[1] - 1, "other file was", "other files were")
            self._document.message.emit(f"{self._last_message}; {others} not opened")

    def _restore(self, carried: _Carried) -> None:
        """Give the bodies that are still there their pose and their locks back."""
        from lcollision_core.tasks.scenes import carried_domains, carried_pose

        document, before, removed = self._document, carried.body, carried.removed
        pose = carried.pose and carried_pose(carried.pose, before, document.model, removed)
        if pose is not None:
            document.history.load(f"Load {pose.name}", pose, Source.TRAINING)
        for domain in carried_domains(carried.locked_domains, before, document.model, removed):
            document.motion.set_locked(domain, locked=True)

    @Slot(str)
    def _on_message(self, sentence: str) -> None:
        self._last_message = sentence

    @Slot(object)
    def _on_other_model(self, error: OtherModelError) -> None:
        assert error.model is not None
        name = error.model.name
        # If both models have the same name, the question says what differs.
        differs = error.what if name == self._document.model.name else ""
        may_switch = ask_to_switch(self._window, Path(error.where).name, name, differs)
        if may_switch and self._may_lose_library():
            self._document.tasks.open_poses(error.where, error.model.path)

    @Slot(object)
    def _on_member(self, read: MemberPose) -> None:
        """Give one body of the scene the pose of its file; the others keep theirs."""
        document, pose, name = self._document, read.pose, read.members[0]
        scene = document.scene
        if len(read.members) > 1:
            title, text = "Open poses", f"Which body takes the pose “{pose.name}”?"
            name, is_chosen = QInputDialog.getItem(
                self._window, title, text, read.members, 0, editable=False
            )
            scene = scene if is_chosen else None
        if scene is None or name not in {member.name for member in scene.standing}:
            return
        history = document.history
        latent = scene.with_codes_of_member(name, history.latent, pose.latent)
        history.push(f"Load {pose.name}", history.with_latent(read_only(latent)))
        self._remember(read.path)
        text = say(
            "Loaded the pose {pose} of {file} onto {body}",
            pose=pose.name,
            file=read.path.name,
            body=name,
        )
        document.message.emit(text)

    @Slot()
    def _on_model(self) -> None:
        from lcollision_core.bodies import is_bundled

        file = Path(self._document.history.model_file)
        # Store a bundled model by name, so that it is found after the program has moved.
        self.settings["model"] = file.stem if is_bundled(file) else str(file)
        if not is_bundled(file):
            self._remember(file)

    @Slot(object)
    def _remember(self, path: Path) -> None:
        self.settings.remember_file(str(path.resolve()))

    @Slot(object, object)
    def _offer_scale(self, path: Path, error: WrongScaleError) -> None:
        """Ask whether to scale a mesh in another unit; if so, import it."""
        if ask_about_scale(self._window, path.name, error):
            self._document.tasks.import_mesh(path, error.factor)

    def _remember_folder(self, path: Path) -> None:
        self.settings["last_folder"] = str(path.resolve().parent)

    def _folder(self) -> Path:
        folder = Path(self.settings["last_folder"] or Path.home())
        return folder if folder.is_dir() else Path.home()

    @property
    def _name(self) -> str:
        """Name of the pose on the screen, with "changed" if it has been edited."""
        document = self._document
        name = document.history.pose.name
        return f"{name} changed" if document.history.changed else name

    def ask_open(self, title: str, *kinds: str) -> Path | None:
        """Ask for a file of some kinds (see `_kinds`); None if the user cancels."""
        name, _ = QFileDialog.getOpenFileName(
            self._window, title, str(self._folder()), _kinds(*kinds)
        )
        return Path(name) if name else None

    def ask_save(
        self, title: str, name: str, kinds: dict[str, str], file: Path | None = None
    ) -> Path | None:
        """Ask for a file to write; a name without an extension gets that of the chosen kind.

        If there are several kinds, another known extension is kept, for the writer to refuse.

        Parameters
        ----------
        title : of the dialog
        name : of the pose or motion; an unused file name is made from it
        kinds : extensions by the names of the kinds
        file : proposed instead of an unused name

        Returns
        -------
        path : None if the user cancels
        """
        from lcollision_core.files import has_known_suffix

        proposed = file or _unused(self._folder(), name, next(iter(kinds.values())))
        filters = {f"{kind} (*{suffix})": suffix for kind, suffix in kinds.items()}
        dialog = QFileDialog(self._window, title, str(proposed))
        dialog.setAcceptMode(QFileDialog.AcceptMode.AcceptSave)
        dialog.setNameFilters(list(filters))
        dialog.setDefaultSuffix(next(iter(kinds.values())))
        dialog.filterSelected.connect(lambda chosen: dialog.setDefaultSuffix(filters[chosen]))
        path = None
        while path is None and dialog.exec() == QDialog.DialogCode.Accepted:
            path = Path(dialog.selectedFiles()[0])
            chooses = len(kinds) > 1 and has_known_suffix(path)
            if path.suffix.lower() not in kinds.values() and not chooses:
                # Qt adds no extension to a name with a dot, so it has asked about another file.
                path = path.with_name(f"{path.name}.{dialog.defaultSuffix()}")
                if os.path.exists(path):  # noqa: PTH110 - a name that is too long is none, no error
                    dialog.selectFile(str(path))
                    path = None
        dialog.deleteLater()
        if path is not None:
            self._remember_folder(path)
        return path


def is_learned_from(path: Path) -> bool:
    """Whether a model is learned from a path: a folder, or a file of poses of one body."""
    from lcollision_core.files.motion.generated import is_generated
    from lcollision_core.files.motion.smpl import is_smpl_model, is_smpl_motion

    if is_smpl_model(path) or is_smpl_motion(path) or is_generated(path):
        return False
    return path.is_dir() or (path.suffix.lower() in LEARNED_FROM and path.is_file())


def _unused(folder: Path, name: str, suffix: str) -> Path:
    """Return an unused path in a folder, named after a pose."""
    from lcollision_core.files import file_stem, unused_name

    path = folder / f"{file_stem(name)}{suffix}"
    return unused_name(path) if path.exists() else path
