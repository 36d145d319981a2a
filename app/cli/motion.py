"""Whole motions on the command line: which frames collide, and the same motions resolved."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.cli.console import note, progress_bar
from app.cli.contact_options import with_rest, with_touching
from app.cli.interrupt import cancel_on_interrupt
from app.cli.partial_output import depends_on, unfinished_poses
from app.wording import counted, least_distance_words, share_text
from lcollision_core.errors import LCollisionError, MeshFileError
from lcollision_core.options import MotionChoice, MotionOptions, RuleOptions

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from app.cli.partial_output import UnfinishedPoses
    from app.cli.results import Output
    from lcollision_core.bodies import Body
    from lcollision_core.bodies.motions import MotionChange
    from lcollision_core.jobs import Job
    from lcollision_core.meshes import ContactRules
    from lcollision_core.motion import Motion, ScreenedMotion, Solved

_CSV_FIELDS = (
    *("file", "clip", "frame", "seconds", "pairs", "deepest", "parts"),
    *("excluded_pairs", "excluded_deepest"),
)


def check_clips(
    path: Path,
    choice: MotionChoice,
    rules: RuleOptions,
    body: str | None = None,
    clearance: float = 0.0,
    touch: Sequence[str] = (),
    error_bound: float = 0.0,
    rest: Path | None = None,
    no_rules: bool = False,
) -> list[dict[str, Any]]:
    """Screen the clips of one file; the keys are those of ``lcollision check --clips --json``.

    Parameters
    ----------
    body : a character's file or a model's name, whose poses the motion's are; None where the file
        has a body of its own
    error_bound : share of wrong verdicts, measured on samples of a learned body's latent box, up to
        which its estimate may stand for the check of free frames
    rest : a file with the rest pose of a motion of meshes; None for the motion's own
    no_rules : whether all pairs count but those of `rules`

    Raises
    ------
    LCollisionError : the file cannot be read, has no clip, or has a body with a rest pose.
    """
    from lcollision_core.bodies import estimated_free, open_body
    from lcollision_core.bodies.motions import read_motions
    from lcollision_core.files.scene_files import SCENE_SUFFIXES, open_rigged
    from lcollision_core.meshes import STRICT
    from lcollision_core.motion import screen_motion

    if body is not None:
        model = _body_of_motion(open_body(body), path)
    else:
        document = open_rigged(path) if path.suffix.lower() in SCENE_SUFFIXES else None
        if document is None:
            return _check_meshes(path, choice, rules, clearance, touch, rest, no_rules)
        model = open_body(document)
        for sentence in model.notes:
            note(f"{path}: {sentence}")
    if rest is not None:
        what = f"--rest is for motions of meshes, and {model.name} has a rest pose of its own"
        raise MeshFileError(what, "leave it out", where=path)
    model = model.with_rules(STRICT) if no_rules else model
    model = model.with_options(rules).with_touching(touch)
    check, names = model.exact_check(clearance=clearance), model.domain_names
    reports = []
    with cancel_on_interrupt() as job, progress_bar("Checking frames", job) as job:
        for motion in read_motions(model, path, choice.clip, choice.fps, job=job):
            estimated = estimated_free(model, motion, error_bound, clearance)
            screened = screen_motion(
                motion,
                check,
                choice.substeps,
                None,
                job,
                continuous=choice.continuous,
                estimated_free=estimated,
                counted_only=False,
            )
            report = _report(
                path, motion.name, motion.times, motion.rate, screened, names, model.rules
            )
            reports.append(
                report | {"clearance": clearance, "estimated_frames": int(estimated.sum())}
            )
    return reports


def _body_of_motion(model: Body, path: Path) -> Body:
    """Return the body in the shape that a motion says, and note what of the motion is left out."""
    from lcollision_core.bodies.motions import body_of_motion

    shaped, notes = body_of_motion(model, path)
    for sentence in notes:
        note(f"{path}: {sentence}")
    return shaped


def _check_meshes(
    path: Path,
    choice: MotionChoice,
    rules: RuleOptions,
    clearance: float,
    touch: Sequence[str],
    rest: Path | None,
    no_rules: bool,
) -> list[dict[str, Any]]:
    """Screen a file whose frames are meshes: without a rig, by components."""
    import numpy as np

    from lcollision_core.bodies.motions import is_of_skeleton
    from lcollision_core.contact import DISTANCE_BOUND, CollisionDetector
    from lcollision_core.files import read_mesh, read_pose_set
    from lcollision_core.files.animated import ANIMATED_SUFFIXES, frame_rate
    from lcollision_core.files.scene_files import SCENE_SUFFIXES, read_scene
    from lcollision_core.meshes import STRICT
    from lcollision_core.meshes.face_groups import component_labels
    from lcollision_core.motion import NOMINAL_RATE, screen_frames

    suffix = path.suffix.lower()
    if is_of_skeleton(path):
        raise MeshFileError(
            "is the motion of a skeleton, without a body", "name one with --body", where=path
        )
    if suffix not in ANIMATED_SUFFIXES:
        raise MeshFileError(
            "is not a motion file", f"use one of {', '.join(ANIMATED_SUFFIXES)}", where=path
        )
    clips: list[str | None] = [choice.clip]
    if suffix in SCENE_SUFFIXES and choice.clip is None:
        clips = [clip.name for clip in read_scene(path).clips] or [None]
    rules = rules if rest is None else with_rest(rules)
    reports = []
    with cancel_on_interrupt() as job, progress_bar("Checking frames", job) as job:
        for clip in clips:
            rate = choice.fps or frame_rate(path, clip) or NOMINAL_RATE
            fps = rate if suffix in SCENE_SUFFIXES else choice.fps
            poses = read_pose_set(path, clip=clip, fps=fps, job=job)
            held = STRICT if no_rules else poses.rules
            changed, groups = rules.applied(held, poses.groups, poses.topology)
            reference, frames = poses.vertices[0], poses.vertices[1:]
            if rest is not None:
                mesh_at_rest = read_mesh(rest, topology=poses.topology)
                if mesh_at_rest.topology != poses.topology:
                    what, next_step = "does not have the faces of the motion", "name its rest pose"
                    raise MeshFileError(what, next_step, where=rest)
                reference = mesh_at_rest.vertices
            labels = poses.vertex_labels
            plain = CollisionDetector(poses.topology, reference, changed, groups)
            plain = with_touching(plain, touch, poses.groups, labels)
            detector = plain.with_clearance(clearance)
            measure = partial(detector.least_distance, bound=max(DISTANCE_BOUND, clearance))
            names, owner = np.unique(
                component_labels(poses.topology) if labels is None else labels, return_inverse=True
            )
            times = np.arange(len(frames)) / rate

            def mesh(frame: int, share: float, frames: Any = frames) -> npt.NDArray[np.floating]:
                after = frames[min(frame + 1, len(frames) - 1)]
                between: npt.NDArray[np.floating] = (1.0 - share) * frames[frame] + share * after
                return between

            screened = screen_frames(
                mesh,
                times,
                detector.detect,
                owner,
                poses.topology.faces,
                choice.substeps,
                None,
                job,
                measure if clearance > 0.0 else None,
                detector.collide_between if choice.continuous else None,
                counted_only=False,
            )
            report = _report(
                path, clip or path.stem, times, rate, screened, names.tolist(), detector.rules
            )
            reports.append(report | {"clearance": clearance, "estimated_frames": 0})
    return reports


def _report(
    path: Path,
    clip: str,
    times: npt.NDArray[np.float64],
    fps: float,
    screened: ScreenedMotion,
    names: Sequence[str],
    rules: ContactRules,
) -> dict[str, Any]:
    return {
        "file": str(path),
        "clip": clip,
        "frames": len(times),
        "fps": fps,
        "colliding_frames": [
            {
                "frame": one.frame,
                "seconds": one.seconds,
                "pairs": one.n_pairs,
                "deepest": one.deepest,
                "parts": [[str(names[a]), str(names[b])] for a, b in one.domains],
                "excluded_pairs": one.n_excluded,
                "excluded_deepest": one.excluded_deepest,
            }
            for one in screened.colliding
        ],
        "in_between": list(screened.in_between),
        "collides_between": screened.collides_between,
        "least_distance": screened.least_distance,
        "least_frame": screened.least_frame,
        "colliding": bool(screened.colliding or screened.in_between or screened.collides_between),
        **screened.left_out.to_json(),
        "not_counted": screened.left_out.sentence(rules),
    }


def clip_sentence(report: dict[str, Any]) -> str:
    """Say what was found of one clip."""
    frames, between = report["colliding_frames"], report["in_between"]
    touching = report["collides_between"]
    head = f"{report['file']}: {report['clip']}: "
    clearance, n_frames = report["clearance"], counted(report["frames"], "frame")
    besides = []
    if report["estimated_frames"]:
        besides.append(f"{counted(report['estimated_frames'], 'frame')} free by the estimate")
    if clearance > 0.0:
        at = "" if report["least_frame"] is None else f" in frame {report['least_frame']}"
        besides.append(least_distance_words(report["least_distance"], clearance) + at)
    if report["not_counted"]:
        besides.append(report["not_counted"])
    if not report["colliding"]:
        what = (
            f"no faces nearer than {share_text(clearance)}" if clearance > 0.0 else "no collisions"
        )
        between = "" if touching is None else ", and no contact between them"
        return "; ".join([f"{head}{what} in {n_frames}{between}", *besides])
    told = []
    if frames and clearance > 0.0:
        told.append(f"{len(frames)} of {n_frames} have faces nearer than {share_text(clearance)}")
    elif frames:
        worst = max(frames, key=lambda one: one["deepest"])
        parts = " and ".join(dict.fromkeys(worst["parts"][0]))
        told.append(
            f"{len(frames)} of {n_frames} collide, deepest frame "
            f"{worst['frame']} by {100.0 * worst['deepest']:.2f} % of the body size ({parts})"
        )
    if between:
        told.append(f"{counted(len(between), 'pose')} between free frames collide")
    if touching:
        told.append(f"contact between {_after(touching)}")
    return head + "; ".join(told + besides)


def _after(frames: Sequence[int]) -> str:
    """Name some frames and the next of each."""
    listed = ", ".join(f"{at} and {at + 1}" for at in frames[:10])
    return f"frames {listed}{' ...' if len(frames) > 10 else ''}"


def csv_of(reports: Sequence[dict[str, Any]]) -> str:
    """Return a table with a row for each colliding frame; depths are in body sizes."""
    table = io.StringIO()
    writer = csv.DictWriter(table, _CSV_FIELDS, lineterminator="\n")
    writer.writeheader()
    for report in reports:
        for one in report["colliding_frames"]:
            parts = " ".join(f"{a}:{b}" for a, b in one["parts"])
            writer.writerow({"file": report["file"], "clip": report["clip"], **one, "parts": parts})
    return table.getvalue()


def resolve_motions(
    model: Body,
    inputs: Sequence[Path],
    target: Output,
    options: MotionOptions,
    choice: MotionChoice,
    workers: int | None = None,
) -> list[dict[str, Any]]:
    """Resolve motions and write them; the keys are those of ``lcollision resolve --motion --json``.

    Parameters
    ----------
    inputs : files of motions; none for the clips of the character that the model is
    target : the character's own file again where its form is a mesh, else frames or poses

    Raises
    ------
    LCollisionError : an input cannot be read, or the output cannot hold the motions.
    """
    from lcollision_core.bodies import RigBody

    if not inputs and (not isinstance(model, RigBody) or model.character.smpl is not None):
        raise LCollisionError("names no motion", "name a motion file", where=model.name)
    files = inputs or [model.character.source]  # type: ignore[attr-defined]
    for sentence in () if inputs else model.notes:
        note(sentence)
    with cancel_on_interrupt() as job, progress_bar("Resolving motions", job) as job:
        return resolve_files(model, files, target, options, choice, workers, job)


def resolve_files(
    model: Body,
    files: Sequence[Path],
    target: Output,
    options: MotionOptions,
    choice: MotionChoice,
    workers: int | None,
    job: Job,
) -> list[dict[str, Any]]:
    """Resolve the motions of some files into one output, as `resolve_motions` does.

    Raises
    ------
    LCollisionError : as of `resolve_motions`.
    CancelledError : the job was cancelled; what is done is kept beside the output.
    """
    import numpy as np

    from lcollision_core.bodies.motions import MotionChange, read_motions
    from lcollision_core.motion import MotionReport, resolve_motion, screen_motion

    target = _as_frames(target, files)
    changes: list[MotionChange] = []
    rows: list[dict[str, Any]] = []
    for path in files:
        model = _body_of_motion(model, path)
    motions = [
        motion
        for path in files
        for motion in read_motions(model, path, choice.clip, choice.fps, job)
    ]
    _require_target(target, model, files, motions)
    total = sum(map(len, motions))
    clearance = options.frame.clearance
    check, up = model.exact_check(clearance=clearance), np.eye(3)[model.up_axis]
    inputs = _depends_on(model, motions, options)
    with unfinished_poses(target.path, model, *inputs, total) as kept:
        first = 0
        for motion in motions:
            start = time.perf_counter()
            known = {
                at - first: (pose.latent, bool(facts["free"]))
                for at, (pose, facts) in kept.finished.items()
                if first <= at < first + len(motion)
            }
            keep = _keeper(kept, motion, first)
            found = resolve_motion(
                model.resolver,
                motion,
                up,
                options,
                workers,
                job,
                done=known,
                keep=keep,
            )
            first += len(motion)
            before = screen_motion(motion, check, choice.substeps, workers, job=job.part())
            after = screen_motion(
                found.motion, check, choice.substeps, workers, job=job.part(), counted_only=False
            )
            most = options.frame.largest_change
            changes.append(MotionChange(motion, found.motion, found.spans, most))
            rows.append(
                {
                    "source": motion.source,
                    "output": str(target.path),
                    "clip": motion.name,
                    "frames": len(motion),
                    "free_before": len(motion) - len(before.colliding),
                    "free_after": len(motion) - len(after.colliding),
                    "deepest_before": before.deepest,
                    "deepest_after": after.deepest,
                    "in_between_before": len(before.in_between),
                    "in_between_after": len(after.in_between),
                    "collides_between": found.touching,
                    "kept_spans": [one.to_json(model.domain_names) for one in found.kept],
                    **asdict(MotionReport.of(motion, found.motion, check, found.standing)),
                    "colliding_frames": [one.frame for one in after.colliding],
                    **after.left_out.to_json(),
                    "not_counted": after.left_out.sentence(model.rules),
                    "clearance": clearance,
                    "least_distance": after.least_distance,
                    "least_frame": after.least_frame,
                    "seconds": time.perf_counter() - start,
                }
            )
        _write(target, model, files[0], changes, rows)
    return rows


def motion_sentence(row: dict[str, Any]) -> str:
    """Say what became of one motion."""
    n, after = row["frames"], row["free_after"]
    told = f"{row['source']}: {row['clip']}: {row['free_before']} of {n} frames free before"
    told += f", {'all' if after == n else after} after"
    if row["colliding_frames"]:
        listed = ", ".join(map(str, row["colliding_frames"][:10]))
        told += f" (frames {listed}{' ...' if len(row['colliding_frames']) > 10 else ''} collide)"
    if row["in_between_before"] or row["in_between_after"]:
        told += (
            f"; collisions in between: {row['in_between_before']} before, "
            f"{row['in_between_after']} after"
        )
    if row["collides_between"]:
        told += f"; contact between {_after(row['collides_between'])}"
    elif row["collides_between"] is not None and after == n:
        told += "; no contact between them"
    told += "".join(f"; {span['sentence']}" for span in row["kept_spans"])
    if row["largest_change"]:
        told += (
            f"; moved by {100.0 * row['mean_change']:.2f} % of the body size on average, "
            f"{100.0 * row['largest_change']:.1f} % at most; acceleration ratio "
            f"{row['acceleration_ratio']:.2f}"
        )
    if row["clearance"] > 0.0:
        told += f"; {least_distance_words(row['least_distance'], row['clearance'])}"
    # Of a table that an earlier version has begun, it is not known.
    if not_counted := row.get("not_counted"):
        told += f"; {not_counted}"
    return f"{told} ({row['seconds']:.1f} s)"


def _keeper(kept: UnfinishedPoses, motion: Motion, first: int) -> Callable[[int, Solved], None]:
    from lcollision_core.bodies import NamedPose

    def keep(frame: int, solved: Solved) -> None:
        codes, is_free = solved
        pose = NamedPose(f"{first + frame}", codes, motion.placement(frame))
        kept.keep(first + frame, pose, {"free": is_free})

    return keep


def _depends_on(
    model: Body, motions: Sequence[Motion], options: MotionOptions
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Return the inputs that determine the results: arrays, and JSON values."""
    arrays, values = depends_on(model, options.frame)
    for number, motion in enumerate(motions):
        arrays |= {f"codes {number}": motion.codes, f"times {number}": motion.times}
    chosen = {
        "easing": options.easing,
        "substeps": options.substeps,
        "continuous": options.continuous,
    }
    feet = {"keep_feet": options.keep_feet, "feet": sorted(options.feet)}
    return arrays, {**values, **chosen, **feet, "command": "resolve --motion"}


def _as_frames(target: Output, files: Sequence[Path]) -> Output:
    """Return the output: frames where a skeleton is written that the input does not have."""
    from lcollision_core.bodies.motions import OWN_SUFFIXES
    from lcollision_core.bodies.retargeting import SKELETON_SUFFIXES

    suffix = target.path.suffix.lower()
    if target.form != "mesh" or suffix not in SKELETON_SUFFIXES:
        return target
    is_own = suffix in OWN_SUFFIXES and [path.suffix.lower() for path in files] == [suffix]
    return target if is_own else replace(target, form="frames")


def _require_target(
    target: Output, model: Body, files: Sequence[Path], motions: Sequence[Motion]
) -> None:
    """Refuse an output that cannot hold the motions, before the work for it is done."""
    from lcollision_core.bodies.motions import OWN_SUFFIXES, character_of_motion, is_of_skeleton
    from lcollision_core.bodies.retargeting import require_skeleton
    from lcollision_core.files.written import require_written

    suffix = target.path.suffix.lower()
    if target.form == "frames":
        require_skeleton(target.path, model)
    if suffix in OWN_SUFFIXES and target.form == "mesh":
        is_own = files[0].suffix.lower() == suffix and is_of_skeleton(files[0])
        if len(files) > 1 or not is_own:
            raise MeshFileError.unwritable(
                target.path,
                "the motion has no skeleton of that format",
                "name a .pc2 or .mdd file, a folder or a .json file",
            )
    elif target.form == "mesh":
        character = character_of_motion(model, files[0]) if len(files) == 1 else None
        if character is None:
            raise MeshFileError.unwritable(
                target.path,
                "clips can be written only to their own character's file",
                "name a .bvh, .vrma, .pc2 or .mdd file, a folder or a .json file",
            )
        require_written(target.path, character)
    elif target.form == "frames" and len(motions) > 1:
        known = ", ".join(repr(motion.name) for motion in motions[:8])
        raise LCollisionError(
            f"holds one motion, but there are {len(motions)}: {known}",
            "choose one with --clip, or name a folder",
            where=target.path,
        )


def _write(
    target: Output,
    model: Body,
    file: Path,
    changes: Sequence[MotionChange],
    rows: Sequence[dict[str, Any]],
) -> None:
    import numpy as np

    from app.cli.results import require_request, write_result
    from lcollision_core.bodies import NamedPose, unique_names
    from lcollision_core.bodies.motions import write_clips
    from lcollision_core.bodies.retargeting import SKELETON_SUFFIXES
    from lcollision_core.files import file_stamp, locked, unused_name
    from lcollision_core.motion import KeptSpan, Reason
    from lcollision_core.motion.motion import runs
    from lcollision_core.options import ExportRequest

    check = model.exact_check()
    if target.form == "mesh":
        with locked(target.path):
            path = target.path
            if file_stamp(path) != target.before:
                path = unused_name(path)
            written = write_clips(path, model, file, changes)
        for sentence in written.notes:
            note(sentence)
        note(f"wrote {counted(len(changes), 'clip')} to {path}")
        for row, of_file, put_back in zip(rows, written.free, written.put_back, strict=True):
            row["output"] = str(path)
            # Rounding takes a little of the clearance; as written, frames are free of contact.
            stuck = set(row["colliding_frames"]) if row["clearance"] > 0.0 else set()
            stuck |= {int(frame) for frame in (~of_file).nonzero()[0]}
            row["free_after"] = row["frames"] - len(stuck)
            row["colliding_frames"] = sorted(stuck)
            named = np.zeros(row["frames"], dtype=np.bool_)
            for first, last in (one["frames"] for one in row["kept_spans"]):
                named[first : last + 1] = True
            of_form = [(span, True) for span in put_back]
            of_form += [(run, False) for run in runs(~(of_file | named))]
            for span, is_original in of_form:
                kept = KeptSpan(
                    (span.start, span.stop - 1), Reason.AS_WRITTEN, is_original=is_original
                )
                row["kept_spans"].append(kept.to_json(model.domain_names))
        return
    motions = [change.after for change in changes]
    names = unique_names(f"{motion.name} {n}" for motion in motions for n in range(len(motion)))
    frames = [(motion, n) for motion in motions for n in range(len(motion))]
    poses = [
        NamedPose(name, motion.codes[n], motion.placement(n))
        for name, (motion, n) in zip(names, frames, strict=True)
    ]
    request = ExportRequest(fps=motions[0].rate)
    source = require_request(target, model, poses, request)
    # One after the other: all of them may take more memory than there is.
    meshes = (motion.vertices(n, check) for motion, n in frames)
    is_skeleton = target.path.suffix.lower() in SKELETON_SUFFIXES
    posed = write_result(target, model, poses, request, meshes, source, keeps_meshes=is_skeleton)
    if is_skeleton:
        # Joints alone may not hold all of a frame.
        (row,) = rows
        stuck = {frame for frame, one in enumerate(posed) if one.checked(model).colliding}
        row["colliding_frames"] = sorted(stuck.union(row["colliding_frames"]))
        row["free_after"] = row["frames"] - len(row["colliding_frames"])
