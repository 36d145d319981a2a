"""Learn a model from files in one resumable run."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core import __version__
from lcollision_core.bodies import LearnedBody, save_trained
from lcollision_core.bodies.proposed_rules import places_of, propose_rules
from lcollision_core.bodies.scoring import CARD_POSES, score_kinds
from lcollision_core.embedding import ROWS_PER_BLOCK, LatentBox, train_embedding
from lcollision_core.embedding.bilevel import BOX_SCALE
from lcollision_core.embedding.training import require_several
from lcollision_core.embedding.training_run import EmbeddingConfig, TrainingStatus
from lcollision_core.errors import CancelledError, LCollisionError, MeshFileError
from lcollision_core.files import PoseSet, read_pose_set, write_pose_set
from lcollision_core.files.formats import SCENE_SUFFIXES
from lcollision_core.jobs import UNWATCHED, Job, available_cores
from lcollision_core.json_values import from_json, to_json
from lcollision_core.labels import LabelStatus, LabelStore, label_poses
from lcollision_core.labels.labeller import BOX_ROWS, MIXED_COST
from lcollision_core.learning_state import STAGES, LearningStatus, RunState, Stage
from lcollision_core.options import LearningRequest, Quality, SampleDistribution
from lcollision_core.predictor import (
    PRESETS,
    CollisionPredictor,
    KindScores,
    PredictorConfig,
    PredictorStatus,
    train_predictor,
)
from lcollision_core.resolve import find_free_poses
from lcollision_core.sentences import say
from lcollision_core.tasks.sources import gather_poses, with_proposed_rules
from lcollision_core.tasks.work_folder import WorkFolder


@dataclass(frozen=True)
class Effort:
    """Training effort of a quality setting.

    Attributes
    ----------
    n_poses : number of poses for a rig, including the frames of its clips
    embedding : training of the latent space
    n_samples : number of mixed samples to label
    predictor : training of the predictor
    n_judged : number of poses of each kind for scoring it
    """

    n_poses: int
    embedding: EmbeddingConfig
    n_samples: int
    predictor: PredictorConfig
    n_judged: int = CARD_POSES


EFFORTS = {
    # Level 2 stays at the principal components of level 1's residual; nothing is held out.
    Quality.QUICK: Effort(
        100, EmbeddingConfig(level2_epochs=0, held_out_stride=0), 20_000, PRESETS["default"], 200
    ),
    Quality.GOOD: Effort(150, EmbeddingConfig(), 50_000, PRESETS["default"]),
    # Enough for the held-out rows to determine the decision threshold.
    Quality.BEST: Effort(300, EmbeddingConfig(level2_epochs=60), 340_000, PRESETS["large"]),
}

_PASS_SECONDS, _LARGE = 7e-4, 2.5
"""Seconds to train a predictor with a row once, and the factor of the preset `large`."""


_TRAINING_SHARE = 1.0 - 0.3 * BOX_ROWS / ROWS_PER_BLOCK
"""Share of the labelled samples that train the predictor."""


_FOLDED = 3000
"""Number of colliding samples that are searched for folds."""


def estimated_seconds(
    n_vertices: int,
    n_poses: int,
    quality: Quality,
    n_cores: int | None = None,
    *,
    row_seconds: float | None = None,
    colliding_share: float = 0.5,
) -> dict[Stage, float]:
    """Estimate the time of each stage from measurements on two cores.

    Parameters
    ----------
    n_vertices, n_poses : of the training poses
    quality : of the model
    n_cores : number of cores, by default all available
    row_seconds : measured seconds to decode and check a sample, on all cores; layers of clothes
        multiply it. By default it is estimated by the vertices.
    colliding_share : share of colliding samples; only these are checked again for the predictor

    Returns
    -------
    seconds : by stage

    Notes
    -----
    Measured: 2161 and 14 442 vertices, 71 and 100 poses, 20 000 samples, see docs/results.md; stage
    1 in docs/experiments.md.
    """
    effort = EFFORTS[quality]
    share = 2.0 / (available_cores() if n_cores is None else n_cores)
    rows = int(_TRAINING_SHARE * effort.n_samples)
    n_passes = rows * effort.predictor.passes(rows)
    row = 3.5e-7 * n_vertices * share if row_seconds is None else row_seconds
    colliding = colliding_share * rows
    again = (colliding + min(colliding, _FOLDED)) * row
    judged = 6e-6 * effort.n_judged * n_vertices * share
    passes = _PASS_SECONDS * n_passes * share
    if effort.predictor.preset == "large":
        passes *= _LARGE
    return {
        Stage.POSES: 5.0 + 1e-5 * n_vertices * n_poses * share,
        Stage.LATENT_SPACE: 3.0 + _latent_space(effort, share) * n_vertices * n_poses,
        Stage.LABELS: effort.n_samples * MIXED_COST * row,
        Stage.PREDICTOR: 10.0 + again + passes + judged,
    }


def _latent_space(effort: Effort, share: float) -> float:
    """Return the seconds of stage 1 per vertex and pose; codes are fitted on threads."""
    config = effort.embedding
    n_codes = config.n_domains * (1 + config.n_domain_codes)
    micros = 9.0 + 0.45 * config.level1_epochs + 2.3 * config.level2_epochs
    micros += 0.25 * share * n_codes
    if config.held_out_stride:
        micros += 5.0 + 0.4 * config.level1_epochs + 2.1 * config.level2_epochs
        micros += 0.05 * share * n_codes
    return 1e-6 * micros


_TRUSTED_SECONDS = 30.0
"""Weight of the estimate against the run's measured pace, in seconds of work."""

_TELLING = 0.05
"""Share of a stage after which its own pace is used."""

_FIRST = 2
"""Number of first reports of a stage that determine its start, not its pace."""


class Pace:
    """Combines the progress of stages into that of the run, and measures its pace.

    Parameters
    ----------
    report : called with each status
    expected : estimated seconds of each stage
    """

    def __init__(
        self, report: Callable[[LearningStatus], None], expected: Mapping[Stage, float]
    ) -> None:
        self._report, self._expected = report, expected
        self._began = time.monotonic()
        self._stage, self._n_told = Stage.POSES, 0
        self._behind = self._skipped = self._shown = 0.0
        self._entered, self._entered_at = self._began, 0.0

    def expect(self, seconds: Mapping[Stage, float]) -> None:
        """Replace the estimates once the poses are known, and restart the pace."""
        self._expected = seconds
        self._began = time.monotonic()
        self._behind = self._skipped = self._seconds_behind(self._stage, 1.0)

    def report(self, stage: Stage, stage_done: float, facts: Sequence[str] = ()) -> None:
        """Report progress within a stage.

        Progress in the first reports of a stage was made by an earlier process.
        """
        if stage is not self._stage:
            self._stage, self._n_told = stage, 0
        behind, total = self._seconds_behind(stage, stage_done), sum(self._expected.values())
        now = time.monotonic()
        if self._n_told < _FIRST:
            self._skipped += behind - self._behind
            self._entered, self._entered_at = now, stage_done
        self._n_told += 1
        self._behind = behind
        seconds, worked = now - self._began, behind - self._skipped
        pace = (_TRUSTED_SECONDS + seconds) / (_TRUSTED_SECONDS + max(worked, 0.0))
        done_here = stage_done - self._entered_at
        if done_here > _TELLING:
            # The stage's own pace predicts it better than that of earlier stages.
            here = (now - self._entered) * (1.0 - stage_done) / done_here
        else:
            here = (1.0 - stage_done) * self._expected[stage] * pace
        left = here + (total - self._seconds_behind(stage, 1.0)) * pace
        # The displayed progress never goes back.
        self._shown = max(self._shown, behind / total)
        status = LearningStatus(
            RunState.RUNNING, stage, stage_done, self._shown, left, tuple(facts)
        )
        self._report(status)

    def _seconds_behind(self, stage: Stage, stage_done: float) -> float:
        """Return the estimated seconds of finished work."""
        before = sum(self._expected[earlier] for earlier in STAGES[: STAGES.index(stage)])
        return before + stage_done * self._expected[stage]


@dataclass(frozen=True)
class LearnedCard:
    """Key figures of a learned model.

    Attributes
    ----------
    model : path of its file
    name : of the model
    vertices, poses : numbers in the training data
    parts : number of body parts
    error_mean, error_max : of the training poses, normalised
    accuracy, false_positive_rate, false_negative_rate, majority_rate : of the predictor on
        held-out samples; a rate is None if no sample determines it
    samples : number of labelled samples
    colliding_share : of the latent box
    rules : description of the contact rules; "" if all pairs count
    seconds : by stage
    notes : sentences about changes made on reading the poses
    kinds : scores of the predictor on several kinds of poses
    """

    model: str
    name: str
    vertices: int
    poses: int
    parts: int
    error_mean: float
    error_max: float
    accuracy: float
    false_positive_rate: float | None
    false_negative_rate: float | None
    majority_rate: float
    samples: int
    colliding_share: float
    rules: str
    seconds: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    kinds: tuple[KindScores, ...] = ()


def card_of(model: LearnedBody, path: str) -> LearnedCard:
    """Return the key figures of a model made by `learn_model`.

    Raises
    ------
    ValueError : it has no predictor, or no scores.
    """
    record, metrics = model.predictor_record, model.embedding.metrics
    if record is None or record.metrics is None or metrics is None:
        raise ValueError(f"{path} was not trained to its end")
    scores = record.metrics
    spent = model.card.provenance.get("seconds", {})
    return LearnedCard(
        model=path,
        name=model.name,
        vertices=model.n_vertices,
        poses=len(model.card.pose_names),
        parts=len(model.domain_names),
        error_mean=metrics.mean,
        error_max=metrics.max,
        accuracy=scores.accuracy,
        false_positive_rate=scores.false_positive_rate,
        false_negative_rate=scores.false_negative_rate,
        majority_rate=scores.majority_rate,
        samples=record.facts.rows,
        colliding_share=record.facts.colliding_share,
        rules="" if model.rules.exclude_nothing else model.rules.described(),
        seconds={stage: float(spent.get(stage, 0.0)) for stage in STAGES},
        notes=tuple(map(str, model.card.provenance.get("notes", ()))),
        kinds=record.kinds,
    )


_N_SAMPLES, _MOST_COORDINATES = 1024, 40_000_000
"""Number of first samples, fewer for large meshes: 320 MB of coordinates."""

_BOX_SCALES = (1.2, 1.1, 1.0)
"""Scales of the latent box, as multiples of the range of the poses' codes; a smaller box would
exclude some of the poses."""

_MANY = 0.8
"""Share of colliding samples up to which the box is kept."""

NEARLY_ALL = 0.95
"""Share of colliding samples from which a predictor has almost nothing to learn."""

_NAMED_SAMPLES = 64
"""Number of samples that determine which parts collide most often."""

_LEAST_BOUND = 1e-5
"""Bounds nearer to 0 belong to codes that no pose uses, and stay."""


@dataclass(frozen=True)
class FirstSamples:
    """Statistics of the first samples of a latent box.

    Attributes
    ----------
    n_samples : number of samples
    colliding_share : share of colliding ones
    box_scale : the box, as a multiple of the range of the poses' codes
    n_places : number of pairs of patches that were excluded because of them
    parts : names of the two parts that collide most often; empty if few samples collide
    row_seconds : seconds to decode and check a sample, on all cores
    """

    n_samples: int
    colliding_share: float
    box_scale: float
    n_places: int
    parts: tuple[str, ...]
    row_seconds: float


class MostlyCollidingError(LCollisionError):
    """Nearly all samples collide, so a predictor would learn almost nothing."""

    @classmethod
    def of(cls, first: FirstSamples, rig: str, seconds: float) -> MostlyCollidingError:
        """Make the error from the first samples.

        Parameters
        ----------
        first : the samples
        rig : the file of a character that could be posed by its joints instead; "" for none
        seconds : estimated time to continue
        """
        where = f", most often {' and '.join(first.parts)}" if first.parts else ""
        instead = f"pose {rig} by its joints, or " if rig else ""
        return cls(
            f"{100.0 * first.colliding_share:.0f} % of the first {first.n_samples} samples of the "
            f"latent space collide{where}: a predictor would call nearly every pose "
            "colliding",
            f"{instead}leave parts out of the check; training it anyway takes about "
            f"{max(1, round(seconds / 60.0))} more minutes",
        )


def adapt_to_samples(
    model: LearnedBody,
    request: LearningRequest,
    job: Job = UNWATCHED,
) -> tuple[LearnedBody, FirstSamples]:
    """Adapt a new latent space's box and contact rules to its first samples.

    Layers that are apart in the poses may touch in nearly every sample: such patches are
    excluded, unless the request ignores nothing. If most samples still collide, the box is
    shrunk, down to the range of the poses' codes.

    Parameters
    ----------
    model : trained, without predictor
    request : source of rules and seed
    job : reports (boxes tried, all boxes); polled between samples

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    given = model
    for tried, scale in enumerate(_BOX_SCALES):
        model = _with_box(given, scale / BOX_SCALE)
        latent = first_samples(model, request.seed)
        began = time.monotonic()
        vertices = model.decode(latent)
        colliding = model.detector.are_colliding(vertices, job=job.part())
        row_seconds = (time.monotonic() - began) / len(latent)
        proposed = None
        if request.ignored != ():
            proposed = propose_rules(model, job=job.part(), poses=vertices, unasked=True)
        share = float(np.mean(colliding))
        if proposed is not None:
            model = model.with_rules(proposed.rules)
            share = proposed.n_colliding_then / len(latent)
        job.report(tried + 1, len(_BOX_SCALES))
        if share <= _MANY:
            break
    n_places = 0 if proposed is None else len(proposed.new)
    parts = _parts(model, vertices[:_NAMED_SAMPLES]) if share > _MANY else ()
    return model, FirstSamples(len(latent), share, scale, n_places, parts, row_seconds)


def first_samples(model: LearnedBody, seed: int) -> npt.NDArray[np.float32]:
    """Return the first (n, D) samples of a model's box."""
    n_samples = min(_N_SAMPLES, _MOST_COORDINATES // (3 * model.n_vertices))
    blocks = range(max(1, n_samples // ROWS_PER_BLOCK))
    return np.concatenate([model.embedding.box.draw(seed, block) for block in blocks])


def notes_of(first: FirstSamples) -> list[str]:
    """Describe the changes made because of the first samples."""
    notes = []
    if first.n_places:
        notes.append(
            f"{first.n_places} places that touch in nearly every one of the first "
            f"{first.n_samples} samples are not counted"
        )
    if first.box_scale != BOX_SCALE:
        notes.append(
            f"the latent box is {first.box_scale:g} times the range of the poses instead of "
            f"{BOX_SCALE:g}, because most samples of a larger box collide"
        )
    return notes


def _with_box(model: LearnedBody, share: float) -> LearnedBody:
    """Return a model with its box scaled."""
    box = model.embedding.box
    scaled = LatentBox(
        np.minimum(share * box.low, np.maximum(box.low, -_LEAST_BOUND)),
        np.maximum(share * box.high, np.minimum(box.high, _LEAST_BOUND)),
    )
    return LearnedBody(model.name, replace(model.embedding, box=scaled), model.card)


def _parts(model: LearnedBody, vertices: npt.NDArray[Any]) -> tuple[str, ...]:
    """Return the names of the two parts that collide most often."""
    collisions = [model.detector.detect(pose, counted_only=True) for pose in vertices]
    pairs = np.concatenate([collisions_of.pairs for collisions_of in collisions])
    return next(iter(places_of(model, map(tuple, pairs.tolist()))), ())


_SECONDS_BETWEEN_NOTES = 0.5
"""Least time between two status updates in the work folder."""

_VERTICES, _POSES = 10_000, 100
"""Assumed size of a character until its files are read."""

_PATCHES, _PASSES = 0.2, 0.8
"""Shares of the predictor's stage after which its patches are labelled and its training ends; the
rest scores kinds of poses."""

_GATHERED = 0.9
"""Share of the pose stage after which contact rules are proposed."""

_TRAINED = 0.9
"""Share of the latent space stage after which its first samples are checked."""


def learn_model(work: WorkFolder, job: Job = UNWATCHED) -> LearnedCard:
    """Run the request of a work folder, or the rest of it.

    The work folder always holds the current status. At the end it holds nothing else.

    Parameters
    ----------
    work : prepared with a request
    job : reports each `LearningStatus`; polled often; progress is kept in the work folder

    Returns
    -------
    card : of the model, whose file is `card.model`

    Raises
    ------
    ModelFileError : a model of that name exists but was made from another request, or another
        process is running it.
    MostlyCollidingError : nearly all samples collide, and the request stops in that case.
    LCollisionError : the files are unsuitable, or the disk is full; the message is kept in the
        status.
    CancelledError : the job was cancelled.
    """
    with work.lock():
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
    facts : further provenance for its file

    Raises
    ------
    CancelledError : the job was cancelled; the checkpoint holds the last epoch.
    """
    trained = train_embedding(poses, config, checkpoint=checkpoint, seed=seed, job=job)
    digest = hashlib.sha256(np.ascontiguousarray(poses.vertices).tobytes()).hexdigest()
    provenance = {
        "program": f"lcollision {__version__}",
        "poses_sha256": digest,
        "training": asdict(config),
        **({"poses": dict(poses.provenance)} if poses.provenance else {}),
        **facts,
    }
    return LearnedBody.from_training(name, trained, poses, source, licence, provenance)


@dataclass(frozen=True, eq=False)
class LearnedPredictor:
    """A predictor learned for a body.

    Attributes
    ----------
    body : the body
    predictor : the trained predictor
    """

    body: LearnedBody
    predictor: CollisionPredictor

    @cached_property
    def free_poses(self) -> npt.NDArray[np.floating]:
        """(F, D) collision-free poses of the body, which Resolve can fall back to."""
        return find_free_poses(self.body.embedding, self.body.exact_check())

    def of(self, body: LearnedBody) -> LearnedBody:
        """Return a body of the same latent space with this predictor and the free poses."""
        return body.with_predictor(self.predictor).with_free_poses(self.free_poses)

    def with_scores(self, n_poses: int, seed: int, job: Job = UNWATCHED) -> LearnedPredictor:
        """Return a copy with the predictor's scores on kinds of poses: see `score_kinds`."""
        kinds = score_kinds(self.of(self.body), n_poses, seed, job)
        scored = replace(self, predictor=replace(self.predictor, kinds=kinds))
        # Avoid finding them again.
        scored.__dict__["free_poses"] = self.free_poses
        return scored


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
        self._noted, self._newest = -np.inf, work.status

    def run(self) -> LearnedCard:
        work = self._work
        # An earlier process may have been killed after this.
        path = work.destination
        if work.finished_model(self._request) is None:
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
        work.write_status(
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
        """Run the stages; each continues where it was stopped."""
        poses = self._poses()
        self._pace.expect(estimated_seconds(poses.topology.n_vertices, len(poses), self._quality))
        model = self._embedding(poses)
        first = model.card.provenance.get("first_samples")
        if first is not None:
            self._go_on_by(from_json(FirstSamples, first, "first samples"), model)
        return self._predictor(model)

    def _go_on_by(self, first: FirstSamples, model: LearnedBody) -> None:
        """Update the estimates by the first samples, and stop if nearly all of them collide."""
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
        """The first character file among the sources; "" for none."""
        sources = self._request.sources
        return next(
            (source for source in sources if Path(source).suffix.lower() in SCENE_SUFFIXES), ""
        )

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
        require_several(gathered)
        poses = with_proposed_rules(gathered, request, self._part(_GATHERED))
        write_pose_set(path, poses)
        return poses

    def _embedding(self, poses: PoseSet) -> LearnedBody:
        self._enter(Stage.LATENT_SPACE)
        path, request = self._work.embedding, self._request
        if path.exists():
            return LearnedBody.load(path)
        checkpoint = self._work.checkpoint(Stage.LATENT_SPACE)

        def report(status: TrainingStatus) -> None:
            error = status.both_error or status.level1_error
            facts = [] if error is None else [say("error {share:.2f} %", share=100.0 * error)]
            self._report(_TRAINED * status.done / status.total, facts)

        model = learn_latent_space(
            self._work.name,
            poses,
            self._effort.embedding,
            seed=request.seed,
            source=", ".join(Path(source).name for source in request.sources),
            licence=request.licence,
            facts={"command": "new", "notes": list(poses.notes), "request": to_json(request)},
            checkpoint=checkpoint,
            job=self._job.part(report),
        )
        model, first = adapt_to_samples(model, request, self._part(_TRAINED))
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
        work, effort, seed = self._work, self._effort, self._request.seed
        self._enter(Stage.LABELS)

        def report_rows(status: LabelStatus) -> None:
            share = status.colliding_share
            facts = []
            if share is not None:
                facts = [say("{share:.0f} % of the samples collide", share=100.0 * share)]
            self._report(status.done / status.total, facts)

        label_poses(
            model.labeller(SampleDistribution.MIXED),
            work.labels,
            effort.n_samples,
            seed=seed,
            job=self._job.part(report_rows),
        )
        self._enter(Stage.PREDICTOR)
        store = LabelStore.open(work.labels)

        def report_epochs(status: PredictorStatus) -> None:
            if status.preparing is not None:
                done = _PATCHES * status.preparing
            else:
                done = _PATCHES + (_PASSES - _PATCHES) * status.done / status.total
            self._report(done, [])

        trained = train_predictor(
            store.load(effort.n_samples),
            model.embedding,
            effort.predictor,
            store=store.identity,
            groups=model.groups,
            checkpoint=work.checkpoint(Stage.PREDICTOR),
            seed=seed,
            job=self._job.part(report_epochs),
        )
        learned = LearnedPredictor(model, trained)
        finished = learned.with_scores(effort.n_judged, seed, self._part(_PASSES)).of(model)
        provenance = {**finished.card.provenance, "seconds": self._seconds()}
        finished = finished.with_card(replace(finished.card, provenance=provenance))
        return save_trained(work.destination, None, finished)

    def _enter(self, stage: Stage) -> None:
        self._job.check()
        self._before = self._seconds()
        self._stage, self._began = stage, time.monotonic()
        self._report(0.0)

    def _seconds(self) -> dict[str, float]:
        """Return the seconds spent in each stage, by this and earlier processes."""
        now = time.monotonic() - self._began
        return self._before | {str(self._stage): self._before[self._stage] + now}

    def _part(self, begin: float, end: float = 1.0) -> Job:
        """Return the job for a part of a stage, given by shares of the stage."""
        return self._job.part(
            lambda done, total: self._report(begin + (end - begin) * done / max(total, 1))
        )

    def _report(self, stage_done: float, facts: Sequence[str] = ()) -> None:
        self._pace.report(self._stage, stage_done, facts)

    def _tell(self, status: LearningStatus) -> None:
        self._newest = status
        self._job.report(status)
        now = time.monotonic()
        if now - self._noted > _SECONDS_BETWEEN_NOTES:
            self._noted = now
            # A full disk must stop real work, but not a status update.
            with suppress(MeshFileError):
                self._work.write_status(replace(status, seconds=self._seconds()))

    def _leave(self, state: RunState, sentence: str = "", **more: Any) -> None:
        """Write the final status, unless the disk is too full even for that."""
        last = replace(self._newest, seconds=self._seconds(), seconds_left=None)
        with suppress(MeshFileError):
            self._work.write_status(replace(last, state=state, sentence=sentence, **more))
