"""``lcollision resolve M FOLDER --motion``: every motion of a folder, each to a file of its own."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.cli.console import note, progress_bar
from app.cli.interrupt import cancel_on_interrupt
from app.cli.motion import resolve_files
from app.cli.results import Output
from app.wording import counted
from lcollision_core.errors import CancelledError, LCollisionError, MeshFileError
from lcollision_core.options import MotionChoice, MotionOptions

if TYPE_CHECKING:
    from lcollision_core.bodies import Body
    from lcollision_core.jobs import Job
    from lcollision_core.labels.labelling_run import FromWorker
    from lcollision_core.meshes import ContactRules

_TABLE, _PARTIAL = "motions.csv", "motions.partial.json"
_FIELDS = (
    "source",
    "clip",
    "frames",
    "free_before",
    "free_after",
    "deepest_before",
    "deepest_after",
    "in_between_before",
    "in_between_after",
    "collides_between",
    "mean_change",
    "largest_change",
    "largest_jump",
    "acceleration_ratio",
    "foot_slide",
    "excluded_frames",
    "excluded_deepest",
    "not_counted",
    "seconds",
    "output",
    "kept",
    "error",
)
_Rows = list[dict[str, Any]]
_Files = Sequence[tuple[Path, Path]]
"""Files of motions, and where each is written to."""
_Results = Generator[tuple[Path, _Rows], None, None]


def motion_files(folder: Path, besides: Path | None = None) -> list[Path]:
    """Return the files of motions in a folder and its subfolders, in natural order.

    None where it holds meshes. Scenes count where they have clips; body models, and what generators
    of motions write beside them, do not, which is said.

    Parameters
    ----------
    besides : a folder within that is left out, as its files are results
    """
    from lcollision_core.bodies.retargeting import SKELETON_SUFFIXES
    from lcollision_core.files.motion.caches import POINT_CACHE_SUFFIXES
    from lcollision_core.files.pose_set import natural_key

    kept = _inside(folder, besides)
    inside = (path for path in folder.rglob("*") if path.is_file() and kept(path))
    files: list[Path] = []
    others: list[Path] = []
    for path in sorted(inside, key=lambda path: [natural_key(Path(part)) for part in path.parts]):
        suffix = path.suffix.lower()
        if suffix in (*SKELETON_SUFFIXES, *POINT_CACHE_SUFFIXES):
            files.append(path)
        elif suffix in (".npz", ".json", ".npy"):
            (files if _may_hold_motion(path) else others).append(path)
        elif _has_clips(path):
            files.append(path)
    if files and others:
        named = ", ".join(path.relative_to(folder).as_posix() for path in others[:3])
        more = f" and {len(others) - 3} more" if len(others) > 3 else ""
        were = "was left out, which holds" if len(others) == 1 else "were left out, which hold"
        arrays = any(path.suffix.lower() == ".npy" for path in others)
        note(
            f"{folder}: {named}{more} {were} no motion"
            + (" that is read; save arrays by name in an .npz file" if arrays else "")
        )
    return files


def _inside(folder: Path, besides: Path | None) -> Callable[[Path], bool]:
    """Return what tells the files of a folder from results within it."""
    results = None if besides is None else besides.resolve()
    if results is not None and folder.resolve() not in results.parents:
        results = None

    def kept(path: Path) -> bool:
        return path.name != _PARTIAL and (results is None or results not in path.resolve().parents)

    return kept


def _may_hold_motion(path: Path) -> bool:
    """Whether a file is one of poses or of turns; what is wrong with it is said in its row."""
    from lcollision_core.files.motion.smpl_motion import is_smpl_motion
    from lcollision_core.files.scene.smpl import array_names

    suffix = path.suffix.lower()
    if suffix == ".json":
        try:
            content = json.loads(path.read_bytes())
        except (OSError, ValueError):
            return True
        return isinstance(content, dict) and "poses" in content
    if suffix == ".npz":
        names = array_names(path)
        return not names or is_smpl_motion(path) or bool({"vertices", "V"} & set(names))
    return False


def _has_clips(path: Path) -> bool:
    """Whether a file is a scene with clips, or a damaged one."""
    from lcollision_core.files.scene_files import SCENE_SUFFIXES, read_scene

    if path.suffix.lower() not in SCENE_SUFFIXES:
        return False
    try:
        return bool(read_scene(path).clips)
    except MeshFileError:
        # What is wrong with it is said in its row.
        return True


@dataclass(frozen=True)
class Remote:
    """A cluster that resolves the motions, and the body as its workers open it.

    The workers read and write the same paths as this process.

    Attributes
    ----------
    scheduler : the address of a Dask scheduler
    body : M, a file's path or the name of a bundled or user model
    touch : see `Body.with_touching`
    """

    scheduler: str
    body: str
    touch: tuple[str, ...] = ()


def resolve_folder(
    model: Body,
    files: Sequence[Path],
    folder: Path,
    options: MotionOptions,
    choice: MotionChoice,
    workers: int | None = None,
    remote: Remote | None = None,
    root: Path | None = None,
) -> _Rows:
    """Resolve the motions of several files, several at a time, each to its own file of a folder.

    A table of all, `motions.csv`, is written beside them. A file that cannot be read is a row with
    its sentence. A stopped run continues: files that are done are not resolved again.

    Parameters
    ----------
    workers : threads in all, one for each available core by default; unused with `remote`
    remote : where they are resolved, one file a task; here if None
    root : a folder that they are in; its subfolders are kept

    Returns
    -------
    rows : as of `resolve_motions`, and "error" of what failed

    Raises
    ------
    LCollisionError : the folder cannot be written, or as of `run_on_cluster`.
    CancelledError : the command was interrupted.
    """
    from lcollision_core.files import locked
    from lcollision_core.files.safe import atomic_write

    folder.mkdir(parents=True, exist_ok=True)
    outputs = motion_outputs(model, files, folder, root)
    names = {path: _name(path, root) for path in files}
    partial = folder / _PARTIAL
    with (
        locked(partial, wait=0.0),
        cancel_on_interrupt() as job,
        progress_bar("Resolving motions", job) as job,
    ):
        key = _key(model, options, choice)
        finished = _finished(partial, key, names, outputs)
        if finished:
            note(f"continuing from {partial}, which has {counted(len(finished), 'file')}")
        left = [(path, outputs[path]) for path in files if path not in finished]
        results = (
            _resolved_here(model, left, options, choice, workers, job)
            if remote is None
            else _resolved_there(model, left, options, choice, remote, job)
        )
        with closing(results):
            for path, rows in results:
                for row in rows:
                    row["source"] = names[path]
                    if "error" in row:
                        note(row["error"])
                finished[path] = rows
                done = {names[p]: {"stamp": _stamp(p), "rows": r} for p, r in finished.items()}
                with atomic_write(partial) as file:
                    file.write(json.dumps({"key": key, "done": done}).encode())
                job.report(len(finished), len(files))
        rows = [row for path in files for row in finished[path]]
        with atomic_write(folder / _TABLE) as file:
            file.write(_csv(rows).encode())
        partial.unlink(missing_ok=True)
    note(f"wrote {folder / _TABLE}")
    return rows


def _resolved_here(
    model: Body,
    files: _Files,
    options: MotionOptions,
    choice: MotionChoice,
    workers: int | None,
    job: Job,
) -> _Results:
    """Resolve files on threads of this process."""
    from lcollision_core.jobs import available_cores

    n_cores = workers or available_cores()
    n_at_once = max(1, min(len(files), n_cores))
    n_threads = max(1, n_cores // n_at_once)
    with ThreadPoolExecutor(n_at_once, "motion files") as pool:
        tasks = {
            pool.submit(_resolve, model, path, output, options, choice, n_threads, job): path
            for path, output in files
        }
        try:
            for task in as_completed(tasks):
                yield tasks[task], task.result()
        except BaseException:
            job.cancel()
            pool.shutdown(cancel_futures=True)
            raise


def _resolved_there(
    model: Body,
    files: _Files,
    options: MotionOptions,
    choice: MotionChoice,
    remote: Remote,
    job: Job,
) -> _Results:
    """Resolve files on the workers of a cluster."""
    from lcollision_core.labels.labelling_run import run_on_cluster

    body = Path(remote.body)
    shared = _OnWorker(
        os.fspath(body.resolve()) if body.exists() else remote.body,
        remote.touch,
        model.rules,
        model.fingerprint,
        options,
        choice,
    )
    items = [(path.resolve(), output.resolve()) for path, output in files]
    named = dict(zip(items, files, strict=True))
    done = run_on_cluster(resolve_on_worker, shared, items, remote.scheduler, job)
    with closing(done):
        for item, rows in done:
            path, output = named[item]
            for row in rows:
                if "output" in row:
                    row["output"] = str(output.with_name(Path(row["output"]).name))
            yield path, rows


@dataclass(frozen=True)
class _OnWorker:
    """What a worker needs to resolve motions as this process would."""

    body: str
    touch: tuple[str, ...]
    rules: ContactRules
    fingerprint: str
    options: MotionOptions
    choice: MotionChoice


def resolve_on_worker(shared: _OnWorker, item: tuple[Path, Path]) -> FromWorker[_Rows]:
    """Resolve the motions of one file on a worker of a cluster."""
    from distributed import get_worker

    from lcollision_core.bodies import open_body
    from lcollision_core.jobs import Job, available_cores
    from lcollision_core.labels.labelling_run import from_worker

    worker = get_worker()
    model = open_body(shared.body)
    if model.fingerprint != shared.fingerprint:
        raise LCollisionError(
            f"is another body on the worker {worker.address}",
            "give the workers the same file and the same joint roles",
            where=shared.body,
        )
    if model.rules != shared.rules:
        model = model.with_rules(shared.rules)
    model = model.with_touching(shared.touch)
    threads = max(1, available_cores() // worker.state.nthreads)
    rows = _resolve(model, *item, shared.options, shared.choice, threads, Job())
    return from_worker(rows)


def _resolve(
    model: Body,
    path: Path,
    output: Path,
    options: MotionOptions,
    choice: MotionChoice,
    n_threads: int,
    job: Job,
) -> _Rows:
    """Resolve the motions of one file; a row with a sentence where that fails."""
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        target = _target(output)
        return resolve_files(model, [path], target, options, choice, n_threads, job.part())
    except CancelledError:
        raise
    except LCollisionError as error:
        return [{"source": path.name, "error": str(error)}]


def motion_outputs(
    model: Body, files: Sequence[Path], folder: Path, root: Path | None = None
) -> dict[Path, Path]:
    """Return where each file's motions go: the own kind of file, else a point cache.

    Parameters
    ----------
    files : of motions
    folder : that the results come to
    root : a folder that the files are in; its subfolders are kept
    """
    from lcollision_core.bodies import RigBody, unique_names
    from lcollision_core.bodies.motions import OWN_SUFFIXES, is_of_skeleton
    from lcollision_core.files.scene_files import SCENE_SUFFIXES

    by_folder: dict[Path, list[tuple[Path, str]]] = {}
    for path in files:
        suffix = path.suffix.lower()
        if suffix in SCENE_SUFFIXES and isinstance(model, RigBody):
            suffix = suffix if suffix == ".vrm" else ".glb"
        elif suffix not in (".json", ".mdd") and not (
            suffix in OWN_SUFFIXES and is_of_skeleton(path)
        ):
            suffix = ".pc2"
        inside = folder if root is None else folder / path.parent.relative_to(root)
        by_folder.setdefault(inside, []).append((path, suffix))
    return {
        path: inside / f"{stem}{suffix}"
        for inside, named in by_folder.items()
        for (path, suffix), stem in zip(
            named, unique_names(path.stem for path, _ in named), strict=True
        )
    }


def _name(path: Path, root: Path | None) -> str:
    """Return what a file is called in the table: with its subfolders."""
    return path.name if root is None else path.relative_to(root).as_posix()


def _target(path: Path) -> Output:
    from app.cli.results import output_named

    return output_named(os.fspath(path), of_motions=True)


def _key(model: Body, options: MotionOptions, choice: MotionChoice) -> str:
    from importlib.metadata import version

    from app.cli.partial_output import depends_on
    from lcollision_core.embedding.training_run import run_key

    arrays, values = depends_on(model, options.frame)
    chosen = {"easing": options.easing, "keep_feet": options.keep_feet, **asdict(choice)}
    facts = {"model": model.fingerprint, "version": version("lcollision")}
    return run_key(arrays, {**values, **chosen, **facts, "feet": sorted(options.feet)})


def _finished(
    partial: Path, key: str, names: dict[Path, str], outputs: dict[Path, Path]
) -> dict[Path, _Rows]:
    """Return the rows of files that an earlier run has done, and that are as they were then."""
    if not partial.exists():
        return {}
    try:
        record = json.loads(partial.read_bytes())
        if record["key"] != key:
            raise LCollisionError(
                "is of another run (model, options or program differ)",
                "move or delete it, or name another output",
                where=partial,
            )
        return {
            path: record["done"][name]["rows"]
            for path, name in names.items()
            if name in record["done"]
            and record["done"][name]["stamp"] == _stamp(path)
            and outputs[path].exists()
        }
    except (ValueError, TypeError, KeyError) as error:
        raise LCollisionError("is damaged", "delete it to start again", where=partial) from error


def _stamp(path: Path) -> list[int]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _csv(rows: _Rows) -> str:
    table = io.StringIO()
    writer = csv.DictWriter(table, _FIELDS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        kept = "; ".join(one["sentence"] for one in row.get("kept_spans", ()))
        writer.writerow({**row, "kept": kept})
    return table.getvalue()
