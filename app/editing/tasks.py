"""All work that takes longer than a frame: started, cancelled and answered in one place."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import Enum, auto
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QEventLoop, QObject, QTimer, Signal, Slot

from app.editing.history import Source, named_after, read_only
from app.work.preparing import open_pose_file_to_show, open_to_show, prepare, ready
from app.work.threads import Failure, LongWork, Task, as_task
from lcollision_core.errors import LCollisionError, ModelFileError, WrongScaleError
from lcollision_core.tasks import changing
from lcollision_core.tasks.editing import mirror_poses, resolve_pose, save_poses
from lcollision_core.tasks.opening import (
    MemberPose,
    OpenedModel,
    ReadPoses,
    examine,
    import_mesh,
)
from lcollision_core.tasks.words import (
    counted,
    fit_error,
    height_text,
    mirrored_name,
    mirrored_text,
    say,
    with_capital,
)

if TYPE_CHECKING:
    from app.editing.history import PoseHistory
    from app.editing.library import Library
    from app.editing.live_pose import PoseMotion
    from lcollision_core.bodies import Body, MirroredPose, NamedPose, OtherModelError, ProposedRules
    from lcollision_core.contact import ContactRules, SelfCollisions
    from lcollision_core.files import Character, FileStamp
    from lcollision_core.files.scene_files import SceneDocument
    from lcollision_core.jobs import Job
    from lcollision_core.resolve import ResolveOptions, ResolveResult
    from lcollision_core.tasks.opening import FileContent


_SAVE_SECONDS = 30.0
"""How long a closing window waits for its files, as on a slow network disk."""


_EXPORT = "export"
"""Kind of the jobs that write files: each has a snapshot, and outlives its model."""


class Work(Enum):
    """The kinds of long work for the present model: a new job replaces the previous one."""

    RESOLVE = auto()
    EASE = auto()
    RESOLVE_MOTION = auto()
    MIRROR = auto()
    MIRROR_POSES = auto()
    IMPORT_POSES = auto()
    INCOMING = auto()
    PREPARE = auto()
    COUNT_CONTACTS = auto()
    PROPOSE_PAIRS = auto()
    PROPOSE_RULES = auto()
    CHANGE_MODEL = auto()


class Tasks(QObject):
    """Runs long work on snapshots of the document, and applies the results.

    One thread runs the jobs in turn; files that `saving` writes do not wait for them.

    Parameters
    ----------
    history, motion, library : read and changed
    saving : writes files

    Attributes
    ----------
    proposed_rules : rules that exclude pairs that touch in nearly every pose; None if none
    offers_rules : whether there are proposed rules not yet declined for this character
    may_replace : asked before a model or file replaces edits that were made while it was read
    may_leave_pose : asked before a frame of a motion replaces an edited pose

    Signals
    -------
    model_opened : OpenedModel, for the document to load
    model_exchanged : OpenedModel, a changed version of the same model
    message : str, one sentence for the status bar
    failed : Failure
    busy_changed : str, the label of the long work, or "" if there is none
    progressed : the kind of the long work, its steps done, and their total
    solve_started, solve_finished(object) : around a Resolve; the latter carries its ResolveResult,
        or None if it was cancelled or failed
    opened : Path, the file of poses or of a model that is now open
    imported : Path, the mesh that has become the pose
    of_other_model : OtherModelError, if a poses file needs another known model
    of_member : MemberPose, if a poses file is of one of the scene's bodies
    wrong_scale : Path and WrongScaleError, if a mesh to import is in another unit
    contacts_counted : SelfCollisions of the rest pose
    pairs_proposed : dict of tuples of ProposedPair, by kind of group
    rules_proposed : `proposed_rules` is new
    """

    model_opened = Signal(object)
    model_exchanged = Signal(object)
    message = Signal(str)
    failed = Signal(object)
    busy_changed = Signal(str)
    progressed = Signal(object, int, int)
    solve_started = Signal()
    solve_finished = Signal(object)
    opened = Signal(object)
    imported = Signal(object)
    of_other_model = Signal(object)
    of_member = Signal(object)
    wrong_scale = Signal(object, object)
    contacts_counted = Signal(object)
    pairs_proposed = Signal(object)
    rules_proposed = Signal()

    def __init__(
        self, history: PoseHistory, motion: PoseMotion, library: Library, saving: LongWork
    ) -> None:
        super().__init__(history)
        self._history, self._motion = history, motion
        self._library, self._saving = library, saving
        self._solve_began = 0.0
        self._prepared = self._is_closed = False
        self.proposed_rules: ProposedRules | None = None
        self.offers_rules = False
        self.may_replace: Callable[[], bool] = lambda: True
        self.may_leave_pose: Callable[[], bool] = lambda: True
        self._long = LongWork(self)
        self._long.busy_changed.connect(self.busy_changed)
        self._long.progressed.connect(self.progressed)
        self._long.failed.connect(self.failed)
        self._history.latent_changed.connect(self._on_latent_changed)
        self._motion.locks_changed.connect(self.cancel_resolve)

    # The kinds of work.

    def start(
        self,
        work: Work,
        label: str,
        job: Task,
        done: Callable[[Any], None],
        failed: Callable[[Failure], None] | None = None,
    ) -> None:
        """Start work in the long worker, replacing the job of its kind; see `LongWork`."""
        self._long.cancel(work)
        self._long.start(label, job, done, failed, work)

    def cancel(self, work: Work) -> None:
        """Stop the job of a kind."""
        self._long.cancel(work)

    @property
    def busy(self) -> str:
        """The label of the long work, or "" if there is none."""
        return self._long.busy

    @property
    def solving(self) -> bool:
        """Whether a Resolve of the pose runs."""
        return bool(self._long.labels(Work.RESOLVE))

    @property
    def solving_motion(self) -> bool:
        """Whether a Resolve of a motion runs."""
        return bool(self._long.labels(Work.RESOLVE_MOTION))

    @property
    def preparing(self) -> bool:
        """Whether predictions and drags are not ready yet."""
        return bool(self._long.labels(Work.PREPARE))

    @property
    def incoming(self) -> str:
        """The label of the work that loads another pose or model, or ""."""
        return "".join(self._long.labels(Work.INCOMING))

    @property
    def changing_model(self) -> bool:
        """Whether a change of body parts or contact rules is pending: one at a time."""
        return bool(self._long.labels(Work.CHANGE_MODEL))

    @property
    def n_exports(self) -> int:
        """The number of files waiting to be written."""
        return len(self._long.labels(_EXPORT))

    def forget_model(self) -> None:
        """Stop all work for the present model, except exports, which have their snapshots."""
        self.cancel_resolve()
        self._long.cancel(*Work)
        self.proposed_rules, self.offers_rules = None, False
        self._prepared = False

    def cancel_all(self) -> None:
        """Stop all long work except preparing the model; `message` names what was cancelled."""
        self.cancel_resolve()
        self._cancel_with_message(_EXPORT, Work.INCOMING, Work.CHANGE_MODEL, Work.RESOLVE_MOTION)
        self._long.cancel_all(but=Work.PREPARE)

    @Slot()
    def cancel_exports(self) -> None:
        """Stop all exports; `message` names them."""
        self._cancel_with_message(_EXPORT)

    def _cancel_with_message(self, *kinds: object) -> None:
        labels = self._long.labels(*kinds)
        self._long.cancel(*kinds)
        for label in labels:
            self.message.emit(f"{label} was cancelled")

    def close(self, deadline: float) -> bool:
        """Stop all long work and end its thread; see `LongWork.close`."""
        self._is_closed = True
        return self._long.close(deadline)

    # Mirroring.

    def mirror(self) -> None:
        """Exchange left and right of the whole pose, in the long worker.

        Locked domains are mirrored too. If the mirror image of a free pose collides, it is
        resolved, which leaves the mirrored locked domains as they are. Mirroring an unchanged
        mirror image restores the original pose exactly.

        Raises
        ------
        LCollisionError : the model has no two sides.
        """
        from lcollision_core.resolve import ResolveOptions

        _ = self._model.pose_mirror
        self._history.close_gesture()
        pose = self._history.pose
        options = ResolveOptions(locked_domains=self._motion.locked_domains)
        job = partial(self._model.mirror, pose.latent, pose.placement, pose.mirror_of, options)
        self.start(Work.MIRROR, "Mirroring", job, self._on_mirrored)

    def mirror_part(self, domain: int) -> None:
        """Pose the opposite body part as the mirror image of a domain, in the long worker.

        Raises
        ------
        LCollisionError : the model has no two sides.
        """
        mirror = self._model.pose_mirror
        self._history.close_gesture()
        name = self._model.domain_names[domain]
        job = partial(mirror.mirror_part, self._history.latent, domain)
        done = partial(self._motion.edit, f"Mirror {name}")
        self.start(Work.MIRROR, f"Mirroring {name}", job, done)

    def mirror_poses(self, poses: Sequence[NamedPose]) -> None:
        """Add the mirror images of poses to the library, in the long worker, as one step.

        "Left" and "right" in a name are exchanged; other names get "mirrored". An image that is
        already in the library, as that of an image would be, is left out.

        Raises
        ------
        LCollisionError : the model has no two sides.
        """
        _ = self._model.pose_mirror
        job = partial(mirror_poses, self._model, tuple(poses))
        label = f"Mirroring {counted(len(poses), 'pose', 'poses')}"
        self.start(Work.MIRROR_POSES, label, job, self._on_poses_mirrored)

    # Models and files.

    def open_model(
        self, name_or_path: str | Path, read: SceneDocument | Character | None = None
    ) -> None:
        """Read a model or a rigged character in the long worker and load it.

        Parameters
        ----------
        read : the file's contents if it was already read
        """
        work = partial(open_to_show, name_or_path, read=read)
        self.start_loading(f"Opening {Path(name_or_path).name}", work, self._on_model)

    def turn_upright(self) -> None:
        """Make the next axis the up axis, stored in a model's own file, and reopen the body."""
        body, file = self._model, self._history.model_file
        axis = (body.up_axis + 1) % 3

        def turn(job: Job) -> OpenedModel:
            return ready(OpenedModel(changing.set_up_axis(body, file, axis), file), job)

        self.start_loading(f"Turning {body.name}", turn, self._on_model)

    def set_joint_role(self, joint: str, role: str | None) -> None:
        """Set the role of a character's joint, None for that of its rig, and reopen it."""
        body, file = self._model, self._history.model_file

        def set_role(job: Job) -> OpenedModel:
            changing.set_joint_roles(body, {joint: role})
            return open_to_show(file, job, body.character)

        self.start_loading(f"Opening {body.name}", set_role, self._on_model)

    @property
    def _model(self) -> Body:
        return self._history.model

    def examine(
        self,
        path: Path,
        done: Callable[[FileContent], None],
        failed: Callable[[Failure], None] | None = None,
        beside: Body | None = None,
    ) -> None:
        """Find out in the long worker what a file contains; `done` gets the FileContent.

        Parameters
        ----------
        path : of any file
        done, failed : called in this thread, see `LongWork.start`
        beside : a body that a mesh may be a prop of
        """
        label, job = f"Opening {path.name}", partial(examine, path, beside=beside)
        if self.incoming and not self._history.has_model:
            # Keep loading the first body: the file may need it.
            self._long.start(label, job, done, failed)
        else:
            self.start(Work.INCOMING, label, job, done, failed)

    def edit_parts(self, edits: changing.PartEdits) -> None:
        """Rename, recolour or reorder body parts in the model's file, in the long worker.

        The pose, its history and the locks stay; the edits cannot be undone. Not allowed while
        `changing_model`.

        Parameters
        ----------
        edits : the changes, and the name of the copy if the model's own file stays unchanged
        """
        job = as_task(changing.edit_parts, self._model, self._history.model_file, edits)
        self.start(Work.CHANGE_MODEL, "Saving the body parts", job, self._on_parts)

    def count_contacts(self) -> None:
        """Count the pairs of the rest pose by contact rule, for `contacts_counted`."""
        body, done = self._model, self.contacts_counted.emit

        def count(_: Job) -> SelfCollisions:
            return body.detector.detect(body.reference)

        self.start(Work.COUNT_CONTACTS, "Counting pairs at rest", count, done)

    def propose_pairs(self) -> None:
        """Find groups that touch in nearly every pose of the body, for `pairs_proposed`."""
        job = partial(changing.propose_pairs, self._model)
        done = self.pairs_proposed.emit
        self.start(Work.PROPOSE_PAIRS, "Looking for pairs in contact", job, done)

    def set_rules(self, rules: ContactRules, sentence: str = "The new contact rules apply") -> None:
        """Apply other contact rules in the long worker, and store them in the model's own file.

        The pose, its history and the locks stay; the change cannot be undone. `sentence` is the
        message once the rules apply.
        """
        job = as_task(changing.set_rules, self._model, self._history.model_file, rules)
        done = partial(self._on_rules, sentence)
        self.start(Work.CHANGE_MODEL, "Applying the contact rules", job, done)

    def open_poses(self, path: str | Path, model_file: str | Path | None = None) -> None:
        """Read a poses file in the long worker and edit its working pose, or else its first.

        The library does not change: the file's poses become `file_poses`. If the file needs
        another known model, `of_other_model` is emitted; if it is of one of the bodies of a scene,
        `of_member`.

        Parameters
        ----------
        model_file : a model to load too; if None, the poses are those of the present model
        """
        body = None if model_file else self._model
        work = partial(open_pose_file_to_show, body, model_file or "", Path(path))
        self.start_loading(f"Opening {Path(path).name}", work, self._on_poses)

    def save(self, path: str | Path | None = None) -> None:
        """Write the working pose and the file's other poses, and mark the pose as saved.

        Saving does not wait for other long work. An unnamed pose is named after its file.

        Parameters
        ----------
        path : a .json file; by default the one that was last opened or saved

        Raises
        ------
        ModelFileError : there is no file yet.
        """
        history = self._history
        history.close_gesture()
        target = Path(path) if path is not None else history.file
        if target is None:
            raise ModelFileError("the pose has no file yet", "save it under a name")
        asked_pose, document_token = history.pose, history.document_token

        def done(stamp: FileStamp | None) -> str:
            if history.document_token is document_token:
                history.file_stamp = stamp
                history.mark_saved_as(asked_pose, pose, target)
            return f"Saved {target.name}"

        pose = named_after(asked_pose, target)
        job = as_task(save_poses, target, self._model, history.file_poses, pose)
        self.save_file(target, job, done)

    def save_file(self, path: Path, job: Task, done: Callable[[Any], str]) -> None:
        """Write a small file without waiting for other long work.

        Parameters
        ----------
        done : called with the job's value; returns the message for the status bar
        """
        tell = self.message.emit
        self._saving.start(f"Saving {path.name}", job, lambda value: tell(done(value)))

    def wait_for_saves(self, seconds: float = _SAVE_SECONDS) -> None:
        """Wait until all saving has finished or failed, at most `seconds`."""
        if not self._saving.busy:
            return
        loop = QEventLoop(self)
        self._saving.idle.connect(loop.quit)
        QTimer.singleShot(int(1000 * seconds), loop, loop.quit)
        loop.exec(QEventLoop.ProcessEventsFlag.ExcludeUserInputEvents)
        loop.deleteLater()

    def import_mesh(
        self, path: str | Path, scale: float = 1.0, is_asked_as_mesh: bool = True
    ) -> None:
        """Encode a mesh of the model's topology in the long worker and make it the pose.

        If the mesh is in another unit, `wrong_scale` is emitted.

        Parameters
        ----------
        scale : converts the mesh to the model's unit
        is_asked_as_mesh : the user chose it as a mesh of this model; else it may be any file
        """
        work = partial(import_mesh, self._model, Path(path), scale, is_asked_as_mesh)
        self.start_loading(
            f"Importing {Path(path).name}", work, partial(self._on_encoded, Path(path)), ask=False
        )

    def write(self, label: str, work: Task, done: Callable[[Any], None] | None = None) -> None:
        """Write a file in the long worker; until it ends it counts in `n_exports`.

        Parameters
        ----------
        label : as in "Exporting body.obj"
        work : returns the message for the status bar, unless there is `done`
        done : called in this thread with the work's value instead
        """
        self._long.start(label, work, done or self.message.emit, kind=_EXPORT)

    # Resolve.

    def resolve(self, options: ResolveOptions | None = None) -> None:
        """Find the nearest free pose in the long worker; locked domains stay.

        Parameters
        ----------
        options : locks, pins, ground and clearance are taken from the document instead

        Raises
        ------
        ModelFileError : the model has no predictor.
        """
        model, history = self._model, self._history
        resolve_options = self.resolve_options(options)
        history.close_gesture()
        self.cancel_resolve()
        pose, space = history.pose, history.state.space
        job = partial(resolve_pose, model, pose.latent, pose.placement, resolve_options, own=space)
        self._solve_began = time.monotonic()
        self.start(Work.RESOLVE, "Resolving", job, self._on_resolved, self._on_unresolved)
        self.solve_started.emit()

    def resolve_options(self, options: ResolveOptions | None = None) -> ResolveOptions:
        """Return options with the document's locks, pins, ground and clearance; see `resolve`."""
        from lcollision_core.resolve import ResolveOptions

        if not self._model.can_resolve:
            raise ModelFileError(
                "has no predictor, which Resolve needs", "train one for it", where=self._model.name
            )
        return replace(
            options or ResolveOptions(),
            locked_domains=self._motion.locked_domains,
            still_domains=self._motion.pinned_domains,
            standing=self._model.up if self._motion.standing else None,
            clearance=self._motion.clearance,
        )

    def cancel_resolve(self) -> None:
        """Stop a running Resolve; the pose stays as it is."""
        if self.solving:
            self.cancel(Work.RESOLVE)
            self.solve_finished.emit(None)

    # The results of the workers.

    def _on_model(self, opened: OpenedModel) -> None:
        self.model_opened.emit(opened)
        self.message.emit("; ".join((f"Opened {opened.model.name}", *opened.model.notes)))
        self.opened.emit(Path(opened.file))

    def _on_poses(self, read: ReadPoses | MemberPose | OtherModelError) -> None:
        if isinstance(read, LCollisionError):
            self.of_other_model.emit(read)
            return
        if isinstance(read, MemberPose):
            self.of_member.emit(read)
            return
        if read.opened is not None:
            self.model_opened.emit(read.opened)
        content = read.content
        edited = content.working or content.poses[0]
        self._history.begin_with(edited, Source.FILE, read.path, content.poses)
        self._history.file_stamp = read.stamp
        notes = () if read.opened is None else read.opened.model.notes
        text = f"Opened {read.path.name}: {counted(len(content.all_poses), 'pose', 'poses')}"
        self.message.emit("; ".join((text, *notes)))
        self.opened.emit(read.path)

    def _on_parts(self, changed: OpenedModel) -> None:
        if changed.model.fingerprint != self._model.fingerprint:
            return
        # The dragged slider disappears with its old name.
        self._history.close_gesture()
        self.model_exchanged.emit(changed)
        self.message.emit(f"Saved the body parts in {changed.model.name}")

    def _on_rules(self, sentence: str, changed: OpenedModel) -> None:
        history = self._history
        if changed.model.fingerprint != self._model.fingerprint:
            return
        history.close_gesture()
        # That check used the old rules.
        self._motion.exact = None
        self.proposed_rules, self.offers_rules = None, False
        history.amend(replace(history.state, outcome=None))
        self.model_exchanged.emit(changed)
        self.message.emit(sentence)

    def _on_encoded(self, path: Path, pose: NamedPose | WrongScaleError) -> None:
        if isinstance(pose, WrongScaleError):
            self.wrong_scale.emit(path, pose)
            return
        self._history.load(f"Import {pose.name}", pose, Source.MESH)
        error = fit_error(pose.fit_error_mean, pose.fit_error_max)
        self.message.emit(f"Imported {pose.name}: {error}")
        self.imported.emit(path)

    def _on_mirrored(self, image: MirroredPose) -> None:
        history = self._history
        history.close_gesture()
        pose = history.pose.mirrored(image, self._model.pose_mirror.symmetry)
        pose = replace(pose, latent=read_only(np.array(pose.latent, dtype=np.float64)))
        after = replace(history.state, pose=pose, ghost=None, outcome=image.resolution)
        if image.resolution is not None:
            after = replace(after, outcome_seconds=image.resolution.seconds)
        history.push("Mirror", after)
        sentences = [with_capital(mirrored_text(image))]
        if image.collides_newly and image.resolution is not None and image.resolution.note:
            sentences.append(image.resolution.note)
        if self._motion.locked_domains and not image.restored:
            sentences.append("locked parts were mirrored too")
        self.message.emit("; ".join(sentences))

    def _on_poses_mirrored(self, images: list[tuple[NamedPose, MirroredPose]]) -> None:
        from lcollision_core.bodies import MAX_POSE_NAME_LENGTH

        poses = [
            replace(pose, name=mirrored_name(pose.name)[:MAX_POSE_NAME_LENGTH])
            for pose, _ in images
        ]
        added = self._library.add_poses(poses)
        if not added:
            self.message.emit("These mirrored poses are already in your library")
            return
        sentences = [f"Added {counted(added, 'mirrored pose', 'mirrored poses')} to your library"]
        if len(images) == 1:
            sentences.append(mirrored_text(images[0][1]))
        else:
            worst = max(image.fit_error_max for _, image in images)
            sentences.append(f"off by at most {height_text(worst)} of the body size")
            if n := sum(i.pairs_after == 0 < i.pairs_mirrored for _, i in images):
                sentences.append(say("{n} resolved", n=n))
            if n := sum(i.collides_newly for _, i in images):
                sentences.append(say("{n} colliding, though free before", n=n))
        self.message.emit("; ".join(sentences))

    def _on_resolved(self, solution: tuple[ResolveResult, npt.NDArray[np.float32]]) -> None:
        result, ghost = solution
        history, seconds = self._history, time.monotonic() - self._solve_began
        history.close_gesture()
        outcome: dict[str, Any] = {"outcome": result, "outcome_seconds": seconds}
        if np.array_equal(result.latent, history.latent):
            # There is nothing to undo, but the outcome is worth showing.
            history.amend(replace(history.state, ghost=None, **outcome))
        else:
            after = history.with_latent(read_only(np.array(result.latent, dtype=np.float64)))
            history.push("Resolve", replace(after, ghost=ghost, **outcome))
        self.solve_finished.emit(result)

    def _on_unresolved(self, failure: Failure) -> None:
        self.solve_finished.emit(None)
        self.failed.emit(failure)

    def prepare(self) -> None:
        """Load the predictor and compile drags in the background; editing goes on meanwhile."""
        if self._history.has_model and not (self._prepared or self._is_closed):
            label = "Loading predictions" if self._model.has_predictor else "Preparing drags"
            job = partial(prepare, self._model)
            self.start(Work.PREPARE, label, job, self._on_prepared, self._on_unprepared)

    def _on_unprepared(self, failure: Failure) -> None:
        self._motion.set_ready(False)
        self.failed.emit(failure)

    def _on_prepared(self, model: Body) -> None:
        if model is self._model:
            self._prepared = True
            self._motion.set_ready(model.has_predictor)
            if not (model.is_trained or model.rules_are_chosen):
                label, job = "Looking for pairs in contact", partial(changing.offered_rules, model)
                self.start(Work.PROPOSE_RULES, label, job, self._on_rules_proposed)

    def _on_rules_proposed(self, answer: tuple[ProposedRules | None, bool]) -> None:
        self.proposed_rules, self.offers_rules = answer
        self.rules_proposed.emit()

    def decline_offer(self) -> None:
        """Don't offer the proposed rules again for this character."""
        self.offers_rules = False
        from lcollision_core.bodies.remembered import remember_offer_declined

        job = as_task(remember_offer_declined, self._model)
        self.start(Work.PROPOSE_RULES, "Keeping the answer", job, lambda _: None)

    def start_loading(
        self, label: str, work: Task, done: Callable[[Any], None], ask: bool = True
    ) -> None:
        """Start work that replaces the pose; it cancels earlier requests and a Resolve.

        With `ask`, ask before it replaces later edits, which undo could not restore.
        """
        self.cancel_resolve()
        history = self._history
        known = history.state if self._history.has_model else None

        def arrive(value: Any) -> None:
            history.close_gesture()
            if not ask or known is None or history.state.same_as(known) or self.may_replace():
                done(value)

        self.start(Work.INCOMING, label, work, arrive)

    @Slot()
    def _on_latent_changed(self) -> None:
        self.cancel_resolve()
        self.cancel(Work.MIRROR)
