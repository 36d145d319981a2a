"""One run from files to a trained model, which goes on however it was stopped."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import LearnedBody, save_trained
from lcollision_core.bodies.judging import score_kinds
from lcollision_core.errors import CancelledError, LCollisionError, MeshFileError
from lcollision_core.files import PoseSet, read_pose_set, write_pose_set
from lcollision_core.files.scene_files import SCENE_SUFFIXES
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.json_values import from_json, to_json
from lcollision_core.learning.card import LearnedCard, card_of
from lcollision_core.learning.effort import EFFORTS, Effort
from lcollision_core.learning.estimate import estimated_seconds
from lcollision_core.learning.first_samples import (
    NEARLY_ALL,
    FirstSamples,
    MostlyCollidingError,
    look_again,
    notes_of,
)
from lcollision_core.learning.pace import Pace
from lcollision_core.learning.rules_of_poses import with_proposed_rules
from lcollision_core.learning.sources import gather_poses
from lcollision_core.learning.work_folder import WorkFolder
from lcollision_core.learning_state import STAGES, LearningStatus, RunState, Stage
from lcollision_core.options import Quality

if TYPE_CHECKING:
    from lcollision_core.embedding.training_run import EmbeddingConfig, TrainingStatus
    from lcollision_core.labels import LabelRows, LabelStatus
    from lcollision_core.labels.labeller import StoreIdentity
    from lcollision_core.predictor import CollisionPredictor, PredictorConfig, PredictorStatus

_SECONDS_BETWEEN_NOTES = 0.5
"""Between two notes of the status in the work folder."""

_VERTICES, _POSES = 10_000, 100
"""Of a character, until its files are read."""

_PATCHES, _PASSES = 0.2, 0.8
"""Fraction of the predictor's stage after which its patches are labelled, and after which it is
trained; the rest judges kinds of poses."""

_GATHERED = 0.9
"""Fraction of the stage of the poses after which their contact rules are proposed."""

_TRAINED = 0.9
"""Fraction of the stage of the latent space after which its first samples are looked at."""


def learn_model(work: WorkFolder, job: Job = UNWATCHED) -> LearnedCard:
    """Do what the request of a work folder asks for, or what is left of it.

    The work folder says at any time how far the run is. At the end it keeps that alone.

    Parameters
    ----------
    work : prepared with a request
    job : reports each `LearningStatus`; polled often; what is done so far stays in the work folder

    Returns
    -------
    card : of the model, which is at `card.model`

    Raises
    ------
    ModelFileError : there is a model of that name that did not come of this request, or another
        process is at it.
    MostlyCollidingError : nearly all samples collide, and the request is not to go on regardless.
    LCollisionError : the files cannot be learned from, or the disk is full; the sentence says what
        is needed, and is kept as the status.
    CancelledError : the job was cancelled.
    """
    with work.held():
        return _Learner(work, job).run()


def learn_latent_space(
    name: str,
    poses: PoseSet,
    config: EmbeddingConfig,
    *,
    seed: int,
    source: str | None,
    licence: str,
    facts: Mapping[str, Any],
    checkpoint: Path,
    job: Job = UNWATCHED,
) -> LearnedBody:
    """Learn the latent space of poses, as a body without a predictor.

    Parameters
    ----------
    name, source, licence : of the body
    poses, config, seed, checkpoint, job : see `train_embedding`
    facts : more that its file is to say of where it comes from

    Raises
    ------
    CancelledError : the job was cancelled; the checkpoint holds the last epoch.
    """
    from lcollision_core.embedding.training import train_embedding

    trained = train_embedding(poses, config, checkpoint=checkpoint, seed=seed, job=job)
    digest = hashlib.sha256(np.ascontiguousarray(poses.vertices).tobytes()).hexdigest()
    provenance = {
        "program": f"lcollision {version('lcollision')}",
        "poses_sha256": digest,
        **({"poses": dict(poses.provenance)} if poses.provenance else {}),
        **facts,
    }
    return LearnedBody.from_training(name, trained, poses, source, licence, provenance)


def learn_predictor(
    body: LearnedBody,
    rows: LabelRows,
    config: PredictorConfig,
    *,
    store: StoreIdentity,
    checkpoint: Path,
    seed: int,
    device: str = "auto",
    job: Job = UNWATCHED,
) -> LearnedPredictor:
    """Learn a body's predictor from labelled rows.

    Parameters
    ----------
    body : without a predictor, or with another
    rows, config, store, checkpoint, seed, device, job : see `train_predictor`

    Raises
    ------
    CancelledError : the job was cancelled; the checkpoint holds the last step.
    """
    from lcollision_core.predictor import train_predictor

    trained = train_predictor(
        rows,
        body.embedding,
        config,
        store=store,
        groups=body.groups,
        device=device,
        checkpoint=checkpoint,
        job=job,
        seed=seed,
    )
    return LearnedPredictor(body, trained)


@dataclass(frozen=True, eq=False)
class LearnedPredictor:
    """A predictor that was learned for a body.

    Attributes
    ----------
    body : that it was learned for
    predictor : as it was trained
    """

    body: LearnedBody
    predictor: CollisionPredictor

    @cached_property
    def free_poses(self) -> npt.NDArray[np.floating]:
        """The (F, D) poses of the body that are found free, which Resolve falls back to."""
        from lcollision_core.resolve import find_free_poses

        return find_free_poses(self.body.embedding, self.body.exact_check())

    def of(self, body: LearnedBody) -> LearnedBody:
        """Return a body of the same latent space with the predictor and the free poses."""
        return body.with_predictor(self.predictor).with_free_poses(self.free_poses)

    def judged(self, n_poses: int, seed: int, job: Job = UNWATCHED) -> LearnedPredictor:
        """Return it with the scores of its predictor on kinds of poses: see `score_kinds`."""
        kinds = score_kinds(self.of(self.body), n_poses, seed, job)
        found = replace(self, predictor=replace(self.predictor, kinds=kinds))
        # Found once.
        found.__dict__["free_poses"] = self.free_poses
        return found


class _Learner:
    """One call of `learn_model`."""

    def __init__(self, work: WorkFolder, job: Job) -> None:
        self._work, self._job = work, job
        self._request = work.request
        self._quality = Quality(self._request.quality)
        self._effort: Effort = EFFORTS[self._quality]
        self._pace = Pace(self._tell, estimated_seconds(_VERTICES, _POSES, self._quality))
        spent = work.status.seconds
        self._before = {str(stage): float(spent.get(stage, 0.0)) for stage in STAGES}
        self._stage, self._began = Stage.POSES, time.monotonic()
        self._noted = -np.inf

    def run(self) -> LearnedCard:
        work = self._work
        # An earlier process may have come so far, and been killed then.
        path = work.destination
        if work.made(self._request) is None:
            try:
                path = self._make()
            except CancelledError:
                self._leave(RunState.STOPPED)
                raise
            except MostlyCollidingError as error:
                self._leave(RunState.FAILED, str(error), mostly_collides=True, model=self._rig)
                raise
            except LCollisionError as error:
                self._leave(RunState.FAILED, str(error))
                raise
        card = card_of(LearnedBody.load(path), str(path))
        work.tell(
            LearningStatus(
                RunState.DONE,
                Stage.PREDICTOR,
                1.0,
                1.0,
                0.0,
                seconds=card.seconds,
                model=str(path),
            )
        )
        work.keep_only_status()
        return card

    def _make(self) -> Path:
        """Go through the stages, each of which goes on where it was left."""
        poses = self._poses()
        self._pace.expect(estimated_seconds(poses.topology.n_vertices, len(poses), self._quality))
        model = self._embedding(poses)
        first = model.card.provenance.get("first_samples")
        if first is not None:
            self._go_on_by(from_json(FirstSamples, first, "first samples"), model)
        return self._predictor(model)

    def _go_on_by(self, first: FirstSamples, model: LearnedBody) -> None:
        """Correct the estimates by the first samples, and stop where nearly all of them collide."""
        seconds = estimated_seconds(
            model.n_vertices,
            len(model.known_poses),
            self._quality,
            row_seconds=first.row_seconds,
            colliding_share=first.colliding_share,
        )
        self._pace.expect(seconds)
        if first.colliding_share > NEARLY_ALL and not self._request.regardless:
            left = seconds[Stage.LABELS] + seconds[Stage.PREDICTOR]
            raise MostlyCollidingError.of(first, self._rig, left)

    @property
    def _rig(self) -> str:
        """The first file of a character among the sources; "" for none."""
        sources = self._request.sources
        return next((one for one in sources if Path(one).suffix.lower() in SCENE_SUFFIXES), "")

    def _poses(self) -> PoseSet:
        self._enter(Stage.POSES)
        path, request = self._work.poses, self._request
        if path.exists():
            return read_pose_set(path)
        gathered = gather_poses(
            [Path(source) for source in request.sources],
            by_rig=request.by_rig,
            n_wanted=self._effort.n_poses,
            clip=request.clip,
            fps=request.fps,
            up=request.up,
            seed=request.seed,
            job=self._part(0.0, _GATHERED),
        )
        if request.scale != 1.0:
            gathered = gathered.scaled(request.scale)
        poses = with_proposed_rules(gathered, request, self._part(_GATHERED))
        write_pose_set(path, poses)
        return poses

    def _embedding(self, poses: PoseSet) -> LearnedBody:
        self._enter(Stage.LATENT_SPACE)
        path, request = self._work.embedding, self._request
        if path.exists():
            return LearnedBody.load(path)
        checkpoint = self._work.checkpoint(Stage.LATENT_SPACE)

        def told(status: TrainingStatus) -> None:
            error = status.both_error or status.level1_error
            facts = [] if error is None else [f"error {100.0 * error:.2f} %"]
            self._at(_TRAINED * status.done / status.total, facts)

        model = learn_latent_space(
            self._work.name,
            poses,
            self._effort.embedding,
            seed=request.seed,
            source=", ".join(Path(source).name for source in request.sources),
            licence=request.licence,
            facts={"command": "new", "notes": list(poses.notes), "request": to_json(request)},
            checkpoint=checkpoint,
            job=self._job.part(told),
        )
        model, first = look_again(model, request, self._part(_TRAINED))
        provenance = {
            **model.card.provenance,
            "notes": [*poses.notes, *notes_of(first)],
            "first_samples": asdict(first),
        }
        model = model.with_card(replace(model.card, provenance=provenance))
        model.save(path)
        checkpoint.unlink(missing_ok=True)
        return model

    def _predictor(self, model: LearnedBody) -> Path:
        from lcollision_core.labels import LabelStore, label_poses
        from lcollision_core.options import Draws

        work, effort, seed = self._work, self._effort, self._request.seed
        self._enter(Stage.LABELS)

        def told_rows(status: LabelStatus) -> None:
            share = status.colliding_share
            facts = [] if share is None else [f"{100.0 * share:.0f} % of the samples collide"]
            self._at(status.done / status.total, facts)

        label_poses(
            model.labeller(Draws.MIXED),
            work.labels,
            effort.n_samples,
            seed=seed,
            job=self._job.part(told_rows),
        )
        self._enter(Stage.PREDICTOR)
        store = LabelStore.open(work.labels)

        def told_epochs(status: PredictorStatus) -> None:
            if status.preparing is not None:
                done = _PATCHES * status.preparing
            else:
                done = _PATCHES + (_PASSES - _PATCHES) * status.done / status.total
            self._at(done, [])

        learned = learn_predictor(
            model,
            store.load(effort.n_samples),
            effort.predictor,
            store=store.identity,
            checkpoint=work.checkpoint(Stage.PREDICTOR),
            seed=seed,
            job=self._job.part(told_epochs),
        )
        finished = learned.judged(effort.n_judged, seed, self._part(_PASSES)).of(model)
        provenance = {**finished.card.provenance, "seconds": self._seconds()}
        finished = finished.with_card(replace(finished.card, provenance=provenance))
        return save_trained(work.destination, None, finished)

    def _enter(self, stage: Stage) -> None:
        self._job.check()
        self._before = self._seconds()
        self._stage, self._began = stage, time.monotonic()
        self._at(0.0)

    def _seconds(self) -> dict[str, float]:
        """Return the seconds spent in each stage, by this process and those before."""
        now = time.monotonic() - self._began
        return self._before | {str(self._stage): self._before[self._stage] + now}

    def _part(self, begin: float, end: float = 1.0) -> Job:
        """Return the job of a part of a stage, from one fraction of the stage to another."""
        return self._job.part(
            lambda done, total: self._at(begin + (end - begin) * done / max(total, 1))
        )

    def _at(self, stage_done: float, facts: Sequence[str] = ()) -> None:
        self._pace.tell(self._stage, stage_done, facts)

    def _tell(self, status: LearningStatus) -> None:
        self._job.report(status)
        now = time.monotonic()
        if now - self._noted > _SECONDS_BETWEEN_NOTES:
            self._noted = now
            # A full disk stops what matters; a note that others read just now does not.
            with suppress(MeshFileError):
                self._work.tell(replace(status, seconds=self._seconds()))

    def _leave(self, state: RunState, sentence: str = "", **more: Any) -> None:
        """Say what has become of the run, unless the disk has no space even for that."""
        last = replace(self._work.status, seconds=self._seconds(), seconds_left=None)
        with suppress(MeshFileError):
            self._work.tell(replace(last, state=state, sentence=sentence, **more))
