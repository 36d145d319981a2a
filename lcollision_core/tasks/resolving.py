"""Resolve poses and meshes, the motions of a file, and those of a folder; all can be resumed."""

from __future__ import annotations

import os
import time
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, closing
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import working_seconds
from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.files import file_stamp, mesh_files
from lcollision_core.files.safe import write_table
from lcollision_core.jobs import UNWATCHED, Job, available_cores
from lcollision_core.options import ExportRequest, MotionChoice, MotionOptions, ResolveOptions
from lcollision_core.tasks.exporting import (
    Output,
    as_frames,
    motion_outputs,
    output_named,
    refuse_to_replace,
    require_motions,
    require_request,
    source_files,
    write_motions,
    write_result,
)
from lcollision_core.tasks.inputs import PARTIAL, InputPose, body_of_motion, motion_files
from lcollision_core.tasks.progress import Run, depends_on, key_of, run_of_poses, run_of_rows
from lcollision_core.tasks.verdicts import FailedFile, ResolvedClip
from lcollision_core.tasks.words import counted, say, say_number

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, NamedPose, WrittenPose
    from lcollision_core.bodies.motions import MotionChange
    from lcollision_core.labels.labelling_run import FromWorker
    from lcollision_core.meshes import ContactRules
    from lcollision_core.motion import Motion, MotionReport, ScreenedMotion, Solved
    from lcollision_core.resolve import ResolveResult
    from lcollision_core.tasks.progress import Arrays, KeptPose

_TABLE = "motions.csv"


# Poses and meshes.


@dataclass(frozen=True, eq=False)
class ResolvePosesRequest:
    """Poses of a body to resolve, and their output.

    Attributes
    ----------
    body : of the poses
    given : the poses
    output : where to write them
    options : of Resolve
    export : how to write them
    keep_detail : whether to restore detail of meshes that encoding lost, where they stay free
    workers : number of threads, by default one per available core
    """

    body: Body
    given: Sequence[InputPose]
    output: Output
    options: ResolveOptions
    export: ExportRequest
    keep_detail: bool = False
    workers: int | None = None


@dataclass(frozen=True, eq=False)
class ResolvedPose:
    """The outcome for one pose.

    Attributes
    ----------
    given : the input
    result : of Resolve
    file : the output
    has_detail : whether the output includes the detail of the mesh that encoding lost
    stays_free : whether a free pose is still free as stored in the source file's form
    """

    given: InputPose
    result: ResolveResult
    file: Path
    has_detail: bool
    stays_free: bool

    @property
    def is_free(self) -> bool:
        """Whether the pose ends free, by the prediction where it was not checked."""
        result = self.result
        ends_free = result.predicted_free if result.exactly_free is None else result.exactly_free
        return bool(ends_free) and self.stays_free

    @property
    def fit(self) -> float | None:
        """Mean error of the encoding, normalised; None for a pose of codes."""
        return None if self.given.mesh is None else self.given.pose.fit_error_mean or 0.0

    def to_json(self) -> dict[str, Any]:
        """Return the values for a report."""
        row = {"source": self.given.source, "output": str(self.file), **_facts(self.result)}
        del row["converged"], row["note"]
        return row


def resolve_poses(request: ResolvePosesRequest, job: Job) -> list[ResolvedPose]:
    """Resolve poses and write them; a stopped run continues when called again.

    Raises
    ------
    LCollisionError : the output cannot be written, or holds results of other poses.
    CancelledError : the job was cancelled; finished poses are kept beside the output.
    """
    body, given, options = request.body, request.given, request.options
    poses = [given_pose.pose for given_pose in given]
    source = require_request(request.output, body, poses, request.export)
    inputs = _inputs_of_poses(body, poses, options)
    with run_of_poses(request.output.path, body, inputs, len(given), job) as run:
        known_results = _known_results(body, run)

        def keep(index: int, result: ResolveResult) -> None:
            run.keep(str(index), (replace(poses[index], latent=result.latent), _facts(result)))

        results = body.resolver.resolve_many(
            np.array([pose.latent for pose in poses]),
            options,
            request.workers,
            job,
            placements=[pose.placement for pose in poses],
            done=known_results,
            keep=keep,
        )
        detailed: list[npt.NDArray[np.float64] | None] = [None] * len(given)
        if request.keep_detail:
            detailed = _detailed(body, given, results, options.clearance, job)
        written = write_result(
            request.output,
            body,
            [replace(p, latent=result.latent) for p, result in zip(poses, results, strict=True)],
            request.export,
            [
                result.vertices if mesh is None else mesh
                for result, mesh in zip(results, detailed, strict=True)
            ],
            source,
            job=job,
        )
    return [
        ResolvedPose(
            given_pose,
            result,
            file.path,
            mesh is not None,
            source is None or _stays_free(body, given_pose, result, file, job),
        )
        for given_pose, result, file, mesh in zip(given, results, written, detailed, strict=True)
    ]


def _inputs_of_poses(
    body: Body, poses: Sequence[NamedPose], options: ResolveOptions
) -> tuple[Arrays, dict[str, Any]]:
    from lcollision_core.bodies import fingerprint_of_pose

    arrays, values = depends_on(body, options)
    prints = [fingerprint_of_pose(pose.latent, pose.placement) for pose in poses]
    return arrays, values | {"command": "resolve", "poses": prints}


def _facts(result: ResolveResult) -> dict[str, Any]:
    """Return a result without its arrays, as JSON values."""
    names = (field.name for field in fields(result))
    return {name: getattr(result, name) for name in names if name not in ("latent", "vertices")}


def _known_results(body: Body, run: Run[KeptPose]) -> dict[int, ResolveResult]:
    """Return the results of an earlier run, by index."""
    from lcollision_core.resolve import ResolveResult, Step

    try:
        return {
            int(index): ResolveResult(
                latent=pose.latent,
                vertices=body.exported_vertices(pose.latent, pose.placement),
                **{**facts, "step": Step(facts["step"])},
            )
            for index, (pose, facts) in run.done.items()
        }
    except (KeyError, TypeError, ValueError) as error:
        raise run.damaged() from error


def _detailed(
    body: Body,
    given: Sequence[InputPose],
    results: Sequence[ResolveResult],
    clearance: float,
    job: Job,
) -> list[npt.NDArray[np.float64] | None]:
    """Return resolved meshes with the detail that encoding lost; None if they would collide."""
    from lcollision_core.bodies import with_detail

    detailed: list[npt.NDArray[np.float64] | None] = []
    for given_pose, result in zip(given, results, strict=True):
        mesh = given_pose.mesh
        detailed.append(
            None if mesh is None else with_detail(body, mesh, given_pose.pose, result, clearance)
        )
        if mesh is not None and detailed[-1] is None:
            left_out = say(
                "{source}: its detail was left out, because with it the mesh would collide",
                source=given_pose.source,
            )
            job.note(left_out)
    return detailed


def _stays_free(
    body: Body, given: InputPose, result: ResolveResult, file: WrittenPose, job: Job
) -> bool:
    """Check a free pose as stored in the source file's form, and note collisions by rounding."""
    if not result.exactly_free or file.vertices is None:
        return True
    n_pairs = len(file.checked(body).pairs)
    if n_pairs:
        job.note(
            say_number(
                n_pairs,
                "{source}: in {file}, {n} pair of faces collides after rounding; --form mesh "
                "writes the vertices that were checked",
                "{source}: in {file}, {n} pairs of faces collide after rounding; --form mesh "
                "writes the vertices that were checked",
                source=given.source,
                file=file.path,
            )
        )
    return n_pairs == 0


# Motions.


@dataclass(frozen=True)
class Remote:
    """A cluster that resolves motions, and the body as its workers open it.

    Workers read and write the same paths as this process.

    Attributes
    ----------
    scheduler : the address of a Dask scheduler
    body : path of its file, or the name of a bundled or user model
    touch : see `Body.with_touching`
    """

    scheduler: str
    body: str
    touch: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ResolveMotionsRequest:
    """Motions of a body to resolve, and their output.

    Attributes
    ----------
    body : the body that moves
    files : of motions; none for the clips of the character itself
    output : a mesh output is the character's own file; others are frames or poses
    options : of Resolve
    choice : which clip of a file, and which frames
    workers : number of threads in all, by default one per available core; unused with `remote`
    remote : cluster that resolves the files of a folder; None to do it here
    root : input folder; its subfolders are kept
    only_check : for a folder, whether to check its motions and write only the table
    """

    body: Body
    files: Sequence[Path]
    output: Output
    options: MotionOptions
    choice: MotionChoice
    workers: int | None = None
    remote: Remote | None = None
    root: Path | None = None
    only_check: bool = False

    @classmethod
    def of_folder(
        cls,
        body: Body,
        folder: str | Path,
        output: str | Path,
        options: MotionOptions | None = None,
        job: Job = UNWATCHED,
    ) -> ResolveMotionsRequest:
        """Return the request for all motions of a folder, each with its own output file.

        Raises
        ------
        LCollisionError : the folder has no motion, or the output cannot be written or would replace
            one of its files.
        """
        root, target = Path(folder), output_named(f"{os.fspath(output)}{os.sep}", of_motions=True)
        options = options or MotionOptions()
        choice = MotionChoice(substeps=options.substeps, continuous=options.continuous)
        request = cls(body, [root], target, options, choice).with_files_of_folder(job)
        if request.root is None:
            what = "contains no motion" if root.is_dir() else "is not a folder"
            raise LCollisionError(what, "name a folder of motions", where=root)
        request.refuse_to_replace()
        return request

    @property
    def has_output_each(self) -> bool:
        """Whether each file has its own output."""
        return self.root is not None or (len(self.files) > 1 and self.output.form == "folder")

    def with_files_of_folder(self, job: Job) -> ResolveMotionsRequest:
        """Return the request with a folder replaced by its motion files, if it has any.

        Raises
        ------
        LCollisionError : the folder has neither motions nor meshes, or the output cannot contain
            them.
        """
        if len(self.files) != 1 or not self.files[0].is_dir():
            return self
        (root,) = self.files
        files = motion_files(root, job, besides=self.output.path)
        if not files and not mesh_files(root)[0]:
            advice = "name a folder of clips, or of the meshes of successive frames"
            raise LCollisionError("contains neither a motion nor a mesh", advice, where=root)
        if not files:
            return self
        if self.output.form != "folder":
            what = f"cannot contain {counted(len(files), 'motion', 'motions')}"
            raise LCollisionError(what, "name a folder", where=self.output.path)
        return replace(self, files=files, root=root)

    def refuse_to_replace(self, *, in_place: bool = False) -> None:
        """Raise if an output would replace an input, unless the user allows it.

        Raises
        ------
        LCollisionError : names the first such file.
        """
        path, outputs = self.output.path, [self.output.path]
        if self.has_output_each:
            outputs = list(motion_outputs(self.body, self.files, path, self.root).values())
        elif self.output.form == "folder":
            outputs = [path / file.name for file in self.files]
        refuse_to_replace(outputs, [*self.files, *source_files(self.body)], in_place=in_place)


Row = ResolvedClip | FailedFile


@dataclass(frozen=True)
class FolderStatus:
    """Progress on the motions of a folder.

    Attributes
    ----------
    n_done, n_files : numbers of finished files and of all files
    rows : of the files finished since the last report
    seconds_left : estimated by file size; None until the first file of this run is finished
    """

    n_done: int
    n_files: int
    rows: Sequence[Row]
    seconds_left: float | None = None


_Files = Sequence[tuple[Path, Path]]
"""Files of motions, and their outputs."""
_Results = Generator[tuple[Path, list[Row]], None, None]


def resolve_motions(request: ResolveMotionsRequest, job: Job) -> list[ResolvedClip]:
    """Resolve the motions of some files, and write them to one output.

    Raises
    ------
    LCollisionError : an input cannot be read, or the output cannot hold the motions.
    CancelledError : the job was cancelled; finished frames are kept beside the output.
    """
    from lcollision_core.bodies.motions import read_motions

    body, files = request.body, list(request.files)
    if not files:
        files = [own_file(body)]
        for sentence in body.notes:
            job.note(f"{body.name}: {sentence}")
    output = as_frames(request.output, files)
    for path in files:
        body = body_of_motion(body, path, job)
    choice = request.choice
    motions = [
        motion
        for path in files
        for motion in read_motions(body, path, choice.clip, choice.fps, job)
    ]
    request = replace(request, body=body, files=files, output=output)
    if request.only_check:
        return [_check_motion(request, motion, job) for motion in motions]
    require_motions(output, body, files, motions)
    changes: list[MotionChange] = []
    rows: list[ResolvedClip] = []
    with run_of_motions(request, motions, job) as run:
        first = 0
        for motion in motions:
            change, row = resolve_one(request, motion, run, first, job)
            changes.append(change)
            rows.append(row)
            first += len(motion)
        write_motions(output, body, files[0], changes, rows, job)
    return rows


def own_file(body: Body) -> Path:
    """Return the file of a character with clips.

    Raises
    ------
    LCollisionError : the body has no clips.
    """
    if body.character is None or body.character.smpl is not None:
        raise LCollisionError(
            "has no clips", "name a clip, or a file such as .bvh or .pc2", where=body.name
        )
    return body.character.source


def resolve_one(
    request: ResolveMotionsRequest, motion: Motion, run: Run[KeptPose], first: int, job: Job
) -> tuple[MotionChange, ResolvedClip]:
    """Resolve one motion; its frames are named from `first` on in the run."""
    from lcollision_core.bodies import NamedPose
    from lcollision_core.bodies.motions import MotionChange, contact_facts, ground_facts
    from lcollision_core.motion import MotionReport, resolve_motion, screen_motion

    start, body, options = working_seconds(), request.body, request.options
    substeps, workers = request.choice.substeps, request.workers
    check = body.exact_check(clearance=options.frame.clearance)
    stop = None if options.budget is None else _Budget(options.budget, job)
    known_frames = {
        int(at) - first: (pose.latent, bool(facts["free"]))
        for at, (pose, facts) in run.done.items()
        if first <= int(at) < first + len(motion)
    }

    def keep(frame: int, solved: Solved) -> None:
        codes, is_free = solved
        pose = NamedPose(f"{first + frame}", codes, motion.placement(frame))
        run.keep(f"{first + frame}", (pose, {"free": is_free}))

    if options.keep_contacts and motion.contacts is not None and motion.contacts() is None:
        no_skin = say(
            "{source} shows no body, so of its contacts only standing feet are kept",
            source=motion.source,
        )
        job.note(no_skin)
    up = np.array(body.up)
    resolution = resolve_motion(
        body.resolver,
        motion,
        up,
        options,
        workers,
        job if stop is None else stop.watched,
        done=known_frames,
        keep=keep,
        stop=stop,
    )
    quiet = job.part()
    before = screen_motion(motion, check, substeps, workers, quiet)
    after = screen_motion(resolution.motion, check, substeps, workers, quiet, counted_only=False)
    report = MotionReport.of(motion, resolution.motion, check, resolution.standing)
    kept_spans = [span.to_json(body.domain_names) for span in resolution.kept]
    row = _row(request, motion, before, after, report, kept_spans, start)
    row.output, row.collides_between = str(request.output.path), resolution.touching
    row.rough_spans = [[span.start, span.stop - 1] for span in resolution.rough]
    row.contacts = contact_facts(resolution.motion, check)
    row.ground = ground_facts(body, resolution.motion)
    return MotionChange(
        motion, resolution.motion, resolution.spans, options.frame.largest_change
    ), row


def _check_motion(request: ResolveMotionsRequest, motion: Motion, job: Job) -> ResolvedClip:
    """Check one motion without changing it."""
    from lcollision_core.bodies.motions import contact_facts
    from lcollision_core.motion import MotionReport, screen_motion

    start, choice = working_seconds(), request.choice
    screened = screen_motion(
        motion,
        request.body.exact_check(clearance=request.options.frame.clearance),
        choice.substeps,
        request.workers,
        job.part(),
        continuous=choice.continuous,
        counted_only=False,
    )
    row = _row(request, motion, screened, screened, MotionReport(), [], start)
    row.collides_between = screened.collides_between
    row.contacts = contact_facts(motion, request.body.exact_check())
    return row


def _row(
    request: ResolveMotionsRequest,
    motion: Motion,
    before: ScreenedMotion,
    after: ScreenedMotion,
    report: MotionReport,
    kept_spans: list[dict[str, Any]],
    start: float,
) -> ResolvedClip:
    return ResolvedClip(
        source=str(motion.source),
        output="",
        clip=motion.name,
        frames=len(motion),
        free_before=len(motion) - len(before.colliding),
        free_after=len(motion) - len(after.colliding),
        deepest_before=before.deepest,
        deepest_after=after.deepest,
        in_between_before=len(before.in_between),
        in_between_after=len(after.in_between),
        collides_between=None,
        kept_spans=kept_spans,
        **asdict(report),
        colliding_frames=[frame.frame for frame in after.colliding],
        left_out=after.left_out.to_json(),
        not_counted=after.left_out.sentence(request.body.rules),
        clearance=request.options.frame.clearance,
        least_distance=after.least_distance,
        least_frame=after.least_frame,
        seconds=working_seconds() - start,
    )


class _Budget(Job):
    """A job that is cancelled when its time is up, but not before all frames are checked.

    Attributes
    ----------
    watched : job for the search; its first report means that all frames are checked
    """

    def __init__(self, seconds: float, job: Job) -> None:
        super().__init__()
        self._end, self._is_checked = time.monotonic() + seconds, False

        def report(*status: Any) -> None:
            self._is_checked = True
            job.report(*status)

        self.watched = job.part(report)

    @property
    def cancelled(self) -> bool:
        """Whether the time is up."""
        return self._is_checked and time.monotonic() > self._end


def run_of_motions(
    request: ResolveMotionsRequest, motions: Sequence[Motion], job: Job
) -> AbstractContextManager[Run[KeptPose]]:
    """Return the run of some motions, with consecutive frame numbers."""
    body, options = request.body, request.options
    arrays, values = depends_on(body, options.frame)
    # The file stamps stand for shapes of frames, which codes do not include.
    values |= {"files": [_stamp(path) for path in request.files], **_settings(options)}
    for number, motion in enumerate(motions):
        arrays |= {f"codes {number}": motion.codes, f"times {number}": motion.times}
    inputs = arrays, values | {"command": "resolve --motion"}
    return run_of_poses(request.output.path, body, inputs, sum(map(len, motions)), job)


def _settings(options: MotionOptions) -> dict[str, Any]:
    """Return options that the result of a motion depends on, as JSON values."""
    names = ("easing", "substeps", "continuous", "keep_feet", "keep_contacts")
    return {name: getattr(options, name) for name in names} | {"feet": sorted(options.feet)}


# Folders of motions.


def resolve_folder(request: ResolveMotionsRequest, job: Job) -> list[Row]:
    """Resolve the motions of several files in parallel, each to its own file of a folder.

    A table of all, `motions.csv`, is written beside them. A file that cannot be read has a row
    with the error. A stopped run continues without its finished files. The job reports a
    `FolderStatus` at the start and after each file.

    Raises
    ------
    LCollisionError : the folder cannot be written; also see `run_on_cluster`.
    CancelledError : the job was cancelled.
    """
    from lcollision_core.bodies import unique_names

    files, folder = list(dict.fromkeys(request.files)), request.output.path
    folder.mkdir(parents=True, exist_ok=True)
    outputs = motion_outputs(request.body, files, folder, request.root)
    paths = dict(zip(unique_names(_name(path, request.root) for path in files), files, strict=True))
    names = {path: name for name, path in paths.items()}
    # Taken at the start, so that a file saved during the run is resolved again.
    stamps = {path: _stamp(path) for path in files}

    def is_current(name: str, item: Any) -> bool:
        path = paths.get(name)
        if path is None or item["stamp"] != stamps[path]:
            return False
        if any("error" in row for row in item["rows"]):
            return False
        return request.only_check or outputs[path].exists()

    key = _key_of_folder(request)
    with run_of_rows(folder / PARTIAL, key, len(files), is_current, job) as run:
        left = [(path, outputs[path]) for name, path in paths.items() if name not in run.done]
        known_rows = [_row_of(values) for item in run.done.values() for values in item["rows"]]
        job.report(FolderStatus(len(run.done), len(files), known_rows))
        start, n_bytes = time.perf_counter(), sum(stamps[path][0] for path, _ in left)
        n_bytes_done = 0
        work = _resolved_here if request.remote is None else _resolved_there
        with closing(work(request, left, job)) as results:
            for path, rows in results:
                name = names[path]
                for row in rows:
                    row.source = _name(path, request.root)
                    if row.error:
                        job.note(row.error)
                run.keep(name, {"stamp": stamps[path], "rows": [row.to_json() for row in rows]})
                if any(row.error for row in rows):  # it took no time
                    n_bytes -= stamps[path][0]
                else:
                    n_bytes_done += stamps[path][0]
                spent, seconds_left = time.perf_counter() - start, None
                if n_bytes_done:
                    seconds_left = spent * (n_bytes - n_bytes_done) / n_bytes_done
                job.report(FolderStatus(len(run.done), len(files), rows, seconds_left))
        row_values = [values for name in paths for values in run.done[name]["rows"]]
        write_table(folder / _TABLE, _COLUMNS, map(_row_of_table, row_values))
    job.note(say("wrote {file}", file=folder / _TABLE))
    return [_row_of(values) for values in row_values]


def _row_of(values: dict[str, Any]) -> Row:
    """Return a row from its values in a report."""
    if "error" in values:
        return FailedFile(values["source"], values["error"])
    names = {field.name for field in fields(ResolvedClip)}
    row_values = {name: value for name, value in values.items() if name in names}
    others = {name: value for name, value in values.items() if name not in names}
    return ResolvedClip(**row_values, left_out=others)


def _resolved_here(request: ResolveMotionsRequest, files: _Files, job: Job) -> _Results:
    """Resolve files on threads of this process."""
    n_cores = request.workers or available_cores()
    n_at_once = max(1, min(len(files), n_cores))
    n_threads = max(1, n_cores // n_at_once)
    with ThreadPoolExecutor(n_at_once, "motion files") as pool:
        tasks = {
            pool.submit(_resolve_file, request, path, output, n_threads, job.part()): path
            for path, output in files
        }
        try:
            for task in as_completed(tasks):
                yield tasks[task], task.result()
        except BaseException:
            job.cancel()
            pool.shutdown(cancel_futures=True)
            raise


def _resolved_there(request: ResolveMotionsRequest, files: _Files, job: Job) -> _Results:
    """Resolve files on the workers of a cluster."""
    from lcollision_core.labels.labelling_run import run_on_cluster

    remote = request.remote
    assert remote is not None
    body = Path(remote.body)
    shared = _OnWorker(
        os.fspath(body.resolve()) if body.exists() else remote.body,
        remote.touch,
        request.body.rules,
        request.body.fingerprint,
        request.options,
        request.choice,
        request.only_check,
    )
    items = [(path.resolve(), output.resolve()) for path, output in files]
    named = dict(zip(items, files, strict=True))
    done = run_on_cluster(resolve_on_worker, shared, items, remote.scheduler, job)
    with closing(done):
        for item, rows in done:
            path, output = named[item]
            for row in rows:
                if isinstance(row, ResolvedClip) and row.output:
                    row.output = str(output.with_name(Path(row.output).name))
            yield path, rows


@dataclass(frozen=True)
class _OnWorker:
    """Everything a worker needs to resolve motions."""

    body: str
    touch: tuple[str, ...]
    rules: ContactRules
    fingerprint: str
    options: MotionOptions
    choice: MotionChoice
    only_check: bool


def resolve_on_worker(shared: _OnWorker, item: tuple[Path, Path]) -> FromWorker[list[Row]]:
    """Resolve the motions of one file on a worker of a cluster."""
    from distributed import get_worker

    from lcollision_core.bodies import open_body
    from lcollision_core.labels.labelling_run import from_worker

    worker = get_worker()
    body = open_body(shared.body)
    if body.fingerprint != shared.fingerprint:
        raise LCollisionError(
            f"is another body on the worker {worker.address}",
            "give the workers the same file and the same joint roles",
            where=shared.body,
        )
    if body.rules != shared.rules:
        body = body.with_rules(shared.rules)
    body = body.with_touching(shared.touch)
    threads = max(1, available_cores() // worker.state.nthreads)
    output = Output(item[1], "mesh", None)
    request = ResolveMotionsRequest(
        body, (), output, shared.options, shared.choice, only_check=shared.only_check
    )
    return from_worker(_resolve_file(request, *item, threads, Job()))


def _resolve_file(
    request: ResolveMotionsRequest, path: Path, output: Path, n_threads: int, job: Job
) -> list[Row]:
    """Resolve the motions of one file; on failure return a row with the error."""
    try:
        if not request.only_check:
            output.parent.mkdir(parents=True, exist_ok=True)
        target = output_named(os.fspath(output), of_motions=True)
        request_of_file = replace(
            request, files=[path], output=target, workers=n_threads, remote=None
        )
        return list[Row](resolve_motions(request_of_file, job))
    except CancelledError:
        raise
    except LCollisionError as error:
        return [FailedFile(path.name, str(error))]


def _name(path: Path, root: Path | None) -> str:
    """Return a file's name in the table, with its subfolders."""
    return path.name if root is None else path.relative_to(root).as_posix()


def _key_of_folder(request: ResolveMotionsRequest) -> str:
    options = request.options
    arrays, values = depends_on(request.body, options.frame)
    values |= _settings(options) | {"choice": asdict(request.choice)}
    values |= {"budget": options.budget, "only_check": request.only_check}
    return key_of(request.body, arrays, values)


def _stamp(path: Path) -> list[int]:
    """Return the size and time of a file; zeros if it is missing."""
    return list((file_stamp(path) or (0, 0, 0, 0))[2:])


_COLUMNS = (
    *("source", "clip", "frames", "free_before", "free_after", "deepest_before", "deepest_after"),
    *("in_between_before", "in_between_after", "collides_between", "mean_change"),
    *("largest_change", "largest_jump", "acceleration_ratio", "foot_slide", "excluded_frames"),
    *("excluded_deepest", "not_counted", "seconds", "output", "kept", "error"),
    *("contacts_kept", "contacts_lost"),
)


def _row_of_table(row: dict[str, Any]) -> dict[str, Any]:
    kept_text = "; ".join(span["sentence"] for span in row.get("kept_spans", ()))
    contacts = row.get("contacts") or {}
    counts = {f"contacts_{name}": len(contacts.get(name, ())) for name in ("kept", "lost")}
    return {**row, "kept": kept_text, **counts}
