"""Warms up a body in another thread before it is shown, posed and dragged.

Loops are compiled for this computer at their first use; the core logs it, `Preparing` signals it.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QObject, Signal

from app.work import compile_ahead
from app.work.frames import FrameEvaluator, keep_torch_to_one_thread
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.tasks.opening import (
    MemberPose,
    OpenedModel,
    OpenedMotions,
    ReadPoses,
    open_model,
    open_motions,
    open_poses,
    pose_of_member,
)

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, OtherModelError
    from lcollision_core.files import Character
    from lcollision_core.files.scene_files import SceneDocument

REASON = "First use: preparing, which takes a few seconds"


def open_to_show(
    name_or_path: str | Path, job: Job, read: SceneDocument | Character | None = None
) -> OpenedModel:
    """Read a model and warm it up, so that nothing is left to compile before the first frame.

    `read` is the file's contents if it was already read.
    """
    return ready(open_model(name_or_path, job, read=read), job)


def open_poses_to_show(
    body: Body | None, model_file: str | Path, path: Path, job: Job
) -> ReadPoses | OtherModelError:
    """Read a poses file, and warm up its body if that is opened with it; see `open_poses`."""
    read = open_poses(body, model_file, path, job)
    if isinstance(read, ReadPoses) and read.opened is not None:
        return replace(read, opened=ready(read.opened, job))
    return read


def open_pose_file_to_show(
    body: Body | None, model_file: str | Path, path: Path, job: Job
) -> ReadPoses | MemberPose | OtherModelError:
    """Read the pose of a body of the open scene, or else a poses file as `open_poses_to_show`."""
    of_member = None if body is None else pose_of_member(body, path)
    return of_member or open_poses_to_show(body, model_file, path, job)


def open_motions_to_show(body: Body, path: Path, job: Job) -> OpenedMotions:
    """Read the motions of a file, and warm up their body if it is a new one."""
    opened = open_motions(body, path, job)
    if opened.body is not body:
        warm_up(opened.body, job)
    return opened


def ready(opened: OpenedModel, job: Job) -> OpenedModel:
    """Warm up an opened model; return it with notes on the parts of its look that are not drawn."""
    body = opened.model
    warm_up(body, job)
    if body.character is None or body.appearance is None:
        return opened
    for note in body.appearance.notes:
        body = body.noted(note)
    return OpenedModel(body, opened.file)


def warm_up(body: Body, job: Job = UNWATCHED) -> None:
    """Compute once everything that the first frames need, except predictions."""
    evaluator = FrameEvaluator(body)
    latent = np.zeros(body.latent_size)
    latent.flags.writeable = False
    frame = evaluator.frame(latent)
    compile_ahead.AHEAD.wait_for_check(job)
    evaluator.checked(frame)
    _ = body.fingerprint, body.latent_space, body.symmetry, body.code_names
    _ = body.groups_by_kind, body.appearance, body.starter_poses


def prepare(body: Body, job: Job) -> Body:
    """Warm up predictions, drags and measuring: compiling and importing take seconds."""
    from lcollision_core.posing import make_grip

    if body.has_predictor:
        keep_torch_to_one_thread(body)
        body.predict(np.zeros(body.latent_size))
    # The metric of a drag takes seconds for a large mesh.
    dragger = body.dragger()
    dragger.begin(np.zeros(body.latent_size), make_grip(body.space, 0))
    dragger.move(body.reference[0])
    compile_ahead.AHEAD.wait_for_all(job)
    compile_ahead.measure(compile_ahead.triangle())
    return body


class Preparing(QObject):
    """Signals in the window's thread when any thread compiles a loop, until it is closed.

    Signals
    -------
    begun : str, `REASON`
    """

    begun = Signal(str)

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self._log = logging.getLogger("lcollision_core.compiled")
        self._log.addFilter(self._on_record)

    def close(self) -> None:
        """Stop listening."""
        self._log.removeFilter(self._on_record)

    def _on_record(self, _: logging.LogRecord) -> bool:
        """Signal that a loop is compiled, in the thread that does; keep the record."""
        self.begun.emit(REASON)
        return True
