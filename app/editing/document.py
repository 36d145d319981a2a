"""The pose that is being edited, without any widget: what panels and viewport look at."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Signal, Slot

from app.editing.commands import DocumentState, Source
from app.editing.history import UNNAMED, named_after, read_only
from app.editing.live_editing import LiveEditing
from app.wording import counted, fit_error, heading, height_text, mirrored_text
from app.work import jobs
from app.work.long_work import Job, LongWork
from app.work.threads import Failure
from lcollision_core.errors import LCollisionError, ModelFileError, WrongScaleError

if TYPE_CHECKING:
    from lcollision_core.contact import ContactRules
    from lcollision_core.meshes import FileStamp
    from lcollision_core.meshes.scene_files import SceneDocument
    from lcollision_core.model import (
        MirroredPose,
        NamedPose,
        OtherModelError,
        PosableBody,
        ProposedRules,
    )
    from lcollision_core.resolve import ResolveOptions, ResolveResult

FloatArray = npt.NDArray[np.float64]


class PoseDocument(LiveEditing):
    """One model, one working pose of it, the user's library, and their history.

    Lives in the thread of the window and computes nothing there: each change asks two workers,
    and the newest request wins. Until the first model is in, `has_model` is False and only
    `open_model`, `set_model` and `close` may be called.

    Every change of the pose or of the library is one step of `undo_stack`. Between
    `begin_gesture` and `end_gesture` changes show at once but make one step together, and none
    where they end as they began. A step on a slider outside a gesture, as from the keyboard,
    merges with the one before when it is the same slider within a second. With Solid on the worker
    moves the pose, which becomes what that has reached; the step is made when it has settled.

    Parameters
    ----------
    model : may come later
    library_folder : of the users' pose libraries; the user's own by default

    Attributes
    ----------
    model_file : that the model was read from, or the name of one that was not
    file_stamp : of `file` as it was opened or saved here
    proposed_rules : by which more poses of the character would be free, None if there are none
    may_replace : asked before a model or a file comes in over edits made while it was read

    Signals
    -------
    model_changed : another model is in; latent, library, locks and history are new too
    latent_changed, locks_changed, ghost_changed, library_changed, file_changed : look again;
        `library_changed` covers `poses` and `file_poses`, `file_changed` covers `file`,
        `pose_name` and `changed`
    frame_changed, exact_changed : `frame`, `exact` are new, or None as they are not yet known
    solid_changed, grip_radius_changed, pins_changed : look again
    pose_loaded : the pose has come in whole, from the library or a file, not by sliders
    modified_changed : bool
    outcome_changed : `outcome` is new, or None as the pose has been changed since
    solve_started, solve_progressed(object), solve_finished(object) : around a Resolve; the last
        carries its ResolveResult, or None if it was cancelled or failed
    busy_changed : str, what the long work is, or "" if there is none
    work_progressed : int and int, how many steps of the long work are done, and of how many
    message : str, one sentence for the status bar
    failed : Failure, one sentence and its details, for a dialog
    opened : Path, the file of poses or of a model that is in now
    wrong_scale : Path and WrongScaleError, where a mesh to import is in another unit
    imported : Path, the mesh that has become the pose
    of_other_model : OtherModelError, where a file of poses needs another model that is known
    recovered : Path, the poses file that `recover` has put in
    contacts_counted : ContactsAtRest
    pairs_proposed : dict of tuples of ProposedPair, by kind of group
    rules_proposed : `proposed_rules` is new
    """

    model_changed = Signal()
    solve_started = Signal()
    solve_progressed = Signal(object)
    solve_finished = Signal(object)
    busy_changed = Signal(str)
    work_progressed = Signal(int, int)
    opened = Signal(object)
    imported = Signal(object)
    of_other_model = Signal(object)
    wrong_scale = Signal(object, object)
    recovered = Signal(object)
    contacts_counted = Signal(object)
    pairs_proposed = Signal(object)
    rules_proposed = Signal()

    def __init__(
        self,
        model: PosableBody | None = None,
        parent: QObject | None = None,
        library_folder: Path | None = None,
    ) -> None:
        super().__init__(parent)
        self._library_folder = library_folder
        self.model_file = ""
        self.file_stamp: FileStamp | None = None
        self._solve: int | None = None
        self._solve_began = 0.0
        self._mirroring = self._mirroring_poses = self._incoming = self._loading = 0
        self._counting = self._proposing = self._changing = 0
        self._prepared = False
        self.proposed_rules: ProposedRules | None = None
        self._exports: list[int] = []
        self._closed = False
        self.may_replace: Callable[[], bool] = lambda: True
        self._long = LongWork(self)
        self._long.busy_changed.connect(self.busy_changed)
        self._long.progressed.connect(self._on_progressed)
        self._long.failed.connect(self.failed)
        if model is not None:
            self.set_model(model)

    # What there is to look at.

    @property
    def solving(self) -> bool:
        """Whether a Resolve runs."""
        return self._solve is not None

    @property
    def busy(self) -> str:
        """What the long work is, or "" if there is none."""
        return self._long.busy

    @property
    def n_exports(self) -> int:
        """How many files wait to be written."""
        return sum(bool(self._long.label_of(number)) for number in self._exports)

    @property
    def incoming(self) -> str:
        """What brings another pose or model, or "" if nothing does."""
        return self._long.label_of(self._incoming)

    @property
    def can_resolve(self) -> bool:
        """Whether Resolve can be asked for."""
        return self._model is not None and self._model.can_resolve

    @property
    def has_predictor(self) -> bool:
        """Whether poses are, or will be once it is loaded, predicted."""
        return self._model is not None and self._model.has_predictor

    @property
    def why_not_mirrored(self) -> str:
        """Why the model's poses cannot be mirrored; "" if they can."""
        return "" if self._model is None else self._model.why_not_mirrored

    # Mirroring.

    def mirror(self) -> None:
        """Exchange left and right of the whole pose, in the long worker.

        Locked domains are mirrored too, as their other side is; where a free pose collides in the
        mirror, it is resolved, and that leaves them as mirrored. A mirror image that was not
        changed goes back to the pose that it was made from, to the bit.

        Raises
        ------
        LCollisionError : the model has no two sides.
        """
        from lcollision_core.resolve import ResolveOptions

        _ = self.model.pose_mirror
        self._close_gesture()
        self._long.cancel(self._mirroring)
        pose, options = self.pose, ResolveOptions(locked_domains=self.locked_domains)
        work = partial(self.model.mirror, pose.latent, pose.placement, pose.mirror_of, options)
        self._mirroring = self._long.start("Mirroring", work, self._on_mirrored)

    def mirror_part(self, domain: int) -> None:
        """Pose the body part on the other side as the mirror image of one, in the long worker.

        Raises
        ------
        LCollisionError : the model has no two sides.
        """
        mirror = self.model.pose_mirror
        self._close_gesture()
        self._long.cancel(self._mirroring)
        name = self.model.domain_names[domain]
        work = partial(mirror.mirror_part, self.latent, domain)
        self._mirroring = self._long.start(
            f"Mirroring {name}", work, lambda latent: self._edit(f"Mirror {name}", latent)
        )

    def mirror_poses(self, poses: Sequence[NamedPose]) -> None:
        """Add the mirror images of poses to the library, in the long worker, as one step.

        "Left" and "right" in a name change places; other names get "mirrored". An image that is
        there already, as that of an image is, is left out.

        Raises
        ------
        LCollisionError : the model has no two sides.
        """
        _ = self.model.pose_mirror
        self._long.cancel(self._mirroring_poses)
        work = partial(jobs.mirror_poses, self.model, tuple(poses))
        label = f"Mirroring {counted(len(poses), 'pose')}"
        self._mirroring_poses = self._long.start(label, work, self._on_poses_mirrored)

    # Models and files.

    def set_model(self, model: PosableBody) -> None:
        """Load another model, with a new pose and the user's library of it.

        Parameters
        ----------
        model : may lack a predictor; prefer `open_model`, which compiles and loads in the long
            worker what the first frames need
        """
        self._put_in(jobs.OpenedModel(model, model.name))

    def _put_in(self, opened: jobs.OpenedModel) -> None:
        from lcollision_core.model import PoseLibrary, user_poses_folder

        self.retry_library()
        self._model = opened.model
        self.model_file = opened.file
        self.locked_domains = frozenset()
        self.cancel_resolve()
        # What is being exported is a snapshot, and goes on.
        for number in (
            *(self._mirroring, self._mirroring_poses, self._incoming),
            *(self._loading, self._counting, self._proposing, self._changing),
        ):
            self._long.cancel(number)
        self.frame = self.exact = self.file = self.proposed_rules = None
        self._gesture = self._drag = self._last_grip = None
        self.file_poses = ()
        folder = self._library_folder or user_poses_folder()
        self._library = PoseLibrary(opened.model, folder, self._tell_of_library)
        self._held = self._blank()
        self._saved = self._held.pose
        self._predicts = self._prepared = False
        self._live.follow(self.model, self.latent, self._predicts)
        self._prepare()
        self.undo_stack.clear()
        # All of it is in place before any signal: a slot sees poses of this model only, and may
        # edit at once.
        self._tell_all()

    def _tell_all(self) -> None:
        for changed in (
            self.model_changed,
            self.latent_changed,
            self.frame_changed,
            self.exact_changed,
            self.ghost_changed,
            self.outcome_changed,
            self.locks_changed,
            self.pins_changed,
            self.library_changed,
            self.file_changed,
        ):
            changed.emit()
        self._tell_modified()

    def open_model(self, name_or_path: str | Path, read: SceneDocument | None = None) -> None:
        """Read a model or a rigged character in the long worker and load it.

        `read` is what is read already of the file.
        """
        work = partial(jobs.open_model, name_or_path, read=read)
        self._bring(f"Opening {Path(name_or_path).name}", work, self._on_model)

    def turn_upright(self) -> None:
        """Turn the body by the next axis, a model in its own file, and open it again."""
        work = partial(jobs.turn_upright, self.model, self.model_file)
        self._bring(f"Turning {self.model.name}", work, self._on_model)

    def say_role(self, joint: str, role: str | None) -> None:
        """Say what a character's joint is, None for what its rig tells, and open it again."""
        work = partial(jobs.say_role, self.model, self.model_file, joint, role)
        self._bring(f"Opening {self.model.name}", work, self._on_model)

    def look_into(
        self,
        path: Path,
        done: Callable[[SceneDocument | None], None],
        failed: Callable[[Failure], None] | None = None,
    ) -> None:
        """Read in the long worker a file that may be a rigged character's.

        `done` is called with what was read of it, None for another.

        Parameters
        ----------
        path : of any file
        done, failed : called in this thread, see `LongWork.start`
        """
        work = partial(jobs.read_if_rigged, path)
        start = partial(self._long.start, f"Opening {path.name}", work, done, failed)
        if self.incoming and not self.has_model:
            # The first body stays wanted: what becomes of the file may need it.
            start()
            return
        self._long.cancel(self._incoming)
        self._incoming = start()
        self.busy_changed.emit(self.busy)

    def edit_parts(self, edits: jobs.PartEdits) -> None:
        """Rename, recolour or reorder body parts in the model's file, in the long worker.

        The pose, its history and the locks stay; nothing of it can be undone. Not while
        `changing_model`, as of the rules.

        Parameters
        ----------
        edits : what changes, and the name of the copy where the model's own file is not to
        """
        work = partial(jobs.edit_parts, self.model, self.model_file, edits)
        self._change("Saving the body parts", work, self._on_parts)

    def count_contacts(self) -> None:
        """Count the pairs of the rest pose by contact rule; `contacts_counted` tells."""
        self._long.cancel(self._counting)
        work = partial(jobs.contacts_at_rest, self.model)
        self._counting = self._long.start(
            "Counting pairs at rest", work, self.contacts_counted.emit
        )

    def propose_pairs(self) -> None:
        """Find groups that touch in nearly every pose that the body came with, in the long worker.

        `pairs_proposed` tells.
        """
        self._long.cancel(self._proposing)
        work = partial(jobs.propose_pairs, self.model)
        self._proposing = self._long.start(
            "Looking for pairs in contact", work, self.pairs_proposed.emit
        )

    @property
    def changing_model(self) -> bool:
        """Whether other body parts or contact rules are on their way: one change at a time."""
        return bool(self._long.label_of(self._changing))

    def set_rules(self, rules: ContactRules) -> None:
        """Apply other contact rules in the long worker, and keep them in the model's own file.

        The pose, its history and the locks stay; nothing of it can be undone.
        """
        work = partial(jobs.change_rules, self.model, self.model_file, rules)
        self._change("Applying the contact rules", work, self._on_rules)

    def _change(self, label: str, work: Job, done: Callable[[Any], None]) -> None:
        self._changing = self._long.start(label, work, done)
        self.busy_changed.emit(self.busy)

    def new_pose(self) -> None:
        """Start again from the reference pose: unnamed, no file, no history; the library stays."""
        self._long.cancel(self._incoming)
        self._begin(self._blank(), None)

    def open_poses(self, path: str | Path, model_file: str | Path | None = None) -> None:
        """Read a poses file in the long worker; its working or first pose is edited.

        The library stays as it is: the file's poses are `file_poses`.

        Parameters
        ----------
        model_file : the model that comes in too; the poses are the present one's where None. Of
            a file of another model that is known, `of_other_model` tells.
        """
        work = partial(
            jobs.read_poses, None if model_file else self.model, model_file or "", Path(path)
        )
        self._bring(f"Opening {Path(path).name}", work, self._on_poses)

    def recover(self, poses_file: Path, model_file: str, name: str, file: Path | None) -> None:
        """Restore what a crash left, see `LostPose`, as the unsaved pose."""
        model = self.model if model_file == self.model_file else None

        work = partial(jobs.read_poses, model, model_file, poses_file)
        self._bring(f"Recovering {name}", work, partial(self._on_recovered, name, file))

    @property
    def file_is_another_s(self) -> bool:
        """Whether another program has written the file since it was opened or saved here."""
        from lcollision_core.meshes import file_stamp

        return self.file is not None and file_stamp(self.file) not in (None, self.file_stamp)

    def save(self, path: str | Path | None = None) -> None:
        """Write the working pose and the file's other poses, and clear the modified mark.

        A pose without a name is called as its file from then on.

        Parameters
        ----------
        path : a .json file; the one that was opened or saved last where None

        Raises
        ------
        ModelFileError : there is no file yet, or it cannot be written.
        """
        from lcollision_core.meshes import file_stamp
        from lcollision_core.model import write_poses

        self._close_gesture()
        target = Path(path) if path is not None else self.file
        if target is None:
            raise ModelFileError("the pose has no file yet", "save it under a name")
        pose = named_after(self.pose, target)
        write_poses(target, self.model, self.file_poses, pose)
        self.file_stamp = file_stamp(target)
        self._keep_saved(pose, target)
        self.message.emit(f"Saved {target.name}")

    def import_mesh(self, path: str | Path, scale: float = 1.0) -> None:
        """Encode a mesh of the model's topology in the long worker and make it the pose.

        `scale` brings it into the model's unit; `wrong_scale` tells where it is another.
        """
        work = partial(jobs.encode, self.model, Path(path), scale)
        self._bring(
            f"Importing {Path(path).name}", work, partial(self._on_encoded, Path(path)), ask=False
        )

    def write(self, label: str, work: Job, done: Callable[[Any], None] | None = None) -> None:
        """Write a file in the long worker; it is one of `n_exports` until then.

        Parameters
        ----------
        label : as in "Exporting body.obj"
        work : returns what the status bar is to say of it
        done : called in this thread with the work's value instead
        """
        self._exports.append(self._long.start(label, work, done or self.message.emit))

    # Resolve.

    def resolve(self, options: ResolveOptions | None = None) -> None:
        """Find the nearest free pose in the long worker; locked domains stay.

        Parameters
        ----------
        options : `locked_domains` is set to the document's

        Raises
        ------
        ModelFileError : the model has no predictor.
        """
        from lcollision_core.resolve import ResolveOptions

        if not self.can_resolve:
            raise ModelFileError(
                "has no predictor, which Resolve needs", "train one for it", where=self.model.name
            )
        self._close_gesture()
        self.cancel_resolve()
        chosen = replace(options or ResolveOptions(), locked_domains=self.locked_domains)
        work = partial(jobs.resolve, self.model, self.latent, self.placement, chosen)
        self._solve_began = time.monotonic()
        self._solve = self._long.start("Resolving", work, self._on_resolved, self._on_unresolved)
        self.solve_started.emit()

    def cancel_resolve(self) -> None:
        """Stop a running Resolve; the pose stays as it is."""
        if self._solve is not None:
            self._long.cancel(self._solve)
            self._solve = None
            self.solve_finished.emit(None)

    def cancel_all(self) -> None:
        """Stop all long work except preparing the model; `message` tells what it was."""
        self.cancel_resolve()
        stopped = (*self._exports, self._incoming, self._changing)
        labels = [label for number in stopped if (label := self._long.label_of(number))]
        self._exports.clear()
        self._long.cancel_all()
        self._prepare()
        for label in labels:
            self.message.emit(f"{label} was cancelled")

    def close(self, timeout: float = 5.0) -> bool:
        """Stop all work and end the threads, before any window closes.

        Returns
        -------
        ended : whether all threads have ended within `timeout` seconds
        """
        if self._closed:
            return True
        self._closed = True
        self.retry_library()
        self.cancel_all()
        # Deleting it would signal widgets that look at deleted objects.
        self.undo_stack.blockSignals(True)
        deadline = time.monotonic() + timeout
        ended = [self._live.close(deadline), self._long.close(deadline)]
        return all(ended)

    # The results of the workers.

    @Slot(int, object)
    def _on_progressed(self, number: int, status: tuple[int, int]) -> None:
        self.work_progressed.emit(*status)
        if number == self._solve:
            self.solve_progressed.emit(status)

    def _on_model(self, opened: jobs.OpenedModel) -> None:
        self._put_in(opened)
        self.message.emit("; ".join((f"Opened {opened.model.name}", *opened.model.notes)))
        self.opened.emit(Path(opened.file))

    def _on_poses(self, read: jobs.ReadPoses | OtherModelError) -> None:
        if isinstance(read, LCollisionError):
            self.of_other_model.emit(read)
            return
        if read.opened is not None:
            self._put_in(read.opened)
        held = read.held
        edited = held.working or held.poses[0]
        self.begin_with(edited, Source.FILE, read.path, held.poses)
        self.file_stamp = read.stamp
        notes = () if read.opened is None else read.opened.model.notes
        told = f"Opened {read.path.name}: {counted(len(held.all_poses), 'pose')}"
        self.message.emit("; ".join((told, *notes)))
        self.opened.emit(read.path)

    def _on_parts(self, changed: jobs.OpenedModel) -> None:
        if changed.model.fingerprint != self.model.fingerprint:
            return
        # The slider that is being dragged goes with its old name.
        self._close_gesture()
        self._exchange(changed)
        self.message.emit(f"Saved the body parts in {self.model.name}")

    def _on_rules(self, changed: jobs.OpenedModel) -> None:
        if changed.model.fingerprint != self.model.fingerprint:
            return
        self._close_gesture()
        # What was found by other rules.
        self.exact = None
        self.proposed_rules = None
        self._amend(replace(self._state, outcome=None))
        self._exchange(changed)
        self.message.emit("The new contact rules apply")

    def _exchange(self, changed: jobs.OpenedModel) -> None:
        """Put in the same model with something else changed; the pose stays."""
        self._model, self.model_file = changed.model, changed.file
        self._live.follow(self.model, self.latent, self._predicts)
        self._prepare()
        self._tell_all()

    def _on_recovered(
        self, name: str, file: Path | None, read: jobs.ReadPoses | OtherModelError
    ) -> None:
        if isinstance(read, LCollisionError):
            self.failed.emit(Failure.of(read))
            return
        if read.opened is not None:
            self._put_in(read.opened)
        poses = read.held.poses
        edited = read.held.working or next((p for p in poses if p.name == name), poses[0])
        self.begin_with(edited, Source.FILE, file, poses)
        # Unknown, so that Save asks, until it is said by the session.
        self.file_stamp = None
        self._saved = None
        self._tell_modified()
        self.message.emit(f"Recovered {edited.name}")
        self.recovered.emit(read.path)

    def _tell_of_library(self, error: LCollisionError) -> None:
        # It was reported before; by now no window can show it.
        if not self._closed:
            self.failed.emit(Failure.of(error))

    def _on_encoded(self, path: Path, pose: NamedPose | WrongScaleError) -> None:
        if isinstance(pose, WrongScaleError):
            self.wrong_scale.emit(path, pose)
            return
        self._load(f"Import {pose.name}", pose, Source.MESH)
        error = fit_error(pose.fit_error_mean, pose.fit_error_max)
        self.message.emit(f"Imported {pose.name}: {error}")
        self.imported.emit(path)

    def _on_mirrored(self, image: MirroredPose) -> None:
        self._close_gesture()
        pose = self.pose.mirrored(image, self.model.pose_mirror.symmetry)
        pose = replace(pose, latent=read_only(np.array(pose.latent, dtype=np.float64)))
        after = replace(self._state, pose=pose, ghost=None, outcome=image.resolution)
        if image.resolution is not None:
            after = replace(after, outcome_seconds=image.resolution.seconds)
        self._push("Mirror", after)
        said = [heading(mirrored_text(image))]
        if image.lost_freedom and image.resolution is not None and image.resolution.note:
            said.append(image.resolution.note)
        if self.locked_domains and not image.restored:
            said.append("locked parts were mirrored too")
        self.message.emit("; ".join(said))

    def _on_poses_mirrored(self, images: list[tuple[NamedPose, MirroredPose]]) -> None:
        added = self.add_to_library([pose for pose, _ in images])
        if not added:
            self.message.emit("These mirrored poses are already in your library")
            return
        said = [f"Added {counted(added, 'mirrored pose')} to your library"]
        if len(images) == 1:
            said.append(mirrored_text(images[0][1]))
        else:
            worst = max(image.fit_error_max for _, image in images)
            said.append(f"off by at most {height_text(worst)} of the body size")
            for count, words in (
                (sum(i.pairs_after == 0 < i.pairs_mirrored for _, i in images), "resolved"),
                (sum(i.lost_freedom for _, i in images), "colliding, though free before"),
            ):
                if count:
                    said.append(f"{count} {words}")
        self.message.emit("; ".join(said))

    def _on_resolved(self, found: tuple[ResolveResult, npt.NDArray[np.float32]]) -> None:
        result, ghost = found
        self._solve = None
        seconds = time.monotonic() - self._solve_began
        self._close_gesture()
        if np.array_equal(result.latent, self.latent):
            # Nothing to undo, but the reasons are worth seeing.
            self._amend(replace(self._state, ghost=None, outcome=result, outcome_seconds=seconds))
        else:
            latent = read_only(np.array(result.latent, dtype=np.float64))
            pose = replace(self.pose, latent=latent, fit_error_mean=None, fit_error_max=None)
            after = replace(self._state, pose=pose, ghost=ghost, outcome=result)
            self._push("Resolve", replace(after, outcome_seconds=seconds))
        self.solve_finished.emit(result)

    def _on_unresolved(self, failure: Failure) -> None:
        self.cancel_resolve()
        self.failed.emit(failure)

    def _prepare(self) -> None:
        """Load the predictor and compile drags in the background; the pose can be edited."""
        if self._model is not None and not (self._prepared or self._closed):
            label = "Loading predictions" if self.has_predictor else "Preparing drags"
            work = partial(jobs.prepare, self.model)
            self._loading = self._long.start(label, work, self._on_prepared)

    def _on_prepared(self, model: PosableBody) -> None:
        if model is self._model:
            self._prepared = True
            self._predicts = model.has_predictor
            if self._predicts and self._drag is None:
                self._live.follow(self.model, self.latent, self._predicts)
            if not (model.is_trained or model.rules_are_chosen):
                label, work = "Looking for pairs in contact", partial(jobs.propose_rules, model)
                self._proposing = self._long.start(label, work, self._on_rules_proposed)

    def _on_rules_proposed(self, proposed: ProposedRules | None) -> None:
        self.proposed_rules = proposed
        self.rules_proposed.emit()

    def _bring(self, label: str, work: Job, done: Callable[[Any], None], ask: bool = True) -> None:
        """Start work that replaces the pose; the newest request wins, also over Resolve.

        What undo cannot restore must `ask` before it replaces later edits.
        """
        self.cancel_resolve()
        self._long.cancel(self._incoming)
        known = self._held

        def arrive(value: Any) -> None:
            self._close_gesture()
            if not ask or known is None or self._state.same_as(known) or self.may_replace():
                done(value)

        self._incoming = self._long.start(label, work, arrive)
        self.busy_changed.emit(self.busy)

    def _blank(self) -> DocumentState:
        from lcollision_core.model import NamedPose

        return DocumentState(NamedPose(UNNAMED, read_only(self.model.training_latent[0])))

    def _follow_locks(self) -> None:
        self.cancel_resolve()

    def _follow_latent(self) -> None:
        self.cancel_resolve()
        self._long.cancel(self._mirroring)
        super()._follow_latent()
