"""``lcollision resolve``: the nearest poses that are free of self-collisions by the exact check."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import ExitStatus, JsonOption, note, print_json, progress_bar, tell
from app.cli.contact_options import TouchOption, excluded_at_rest, note_rules
from app.cli.inputs import ScaleOption, ThreadsOption, cannot_encode, expanded
from app.cli.interrupt import cancel_on_interrupt
from app.cli.models import ModelArgument
from app.cli.motion import motion_sentence, resolve_motions
from app.cli.motion_folder import Remote, motion_files, motion_outputs, resolve_folder
from app.cli.options import Without, refuse_given, takes_options
from app.cli.partial_output import UnfinishedPoses, depends_on, unfinished_poses
from app.cli.results import (
    FormOutput,
    InPlaceOption,
    Output,
    files_of,
    output_named,
    refuse_to_replace,
    require_one_mesh,
    require_request,
    source_files,
    write_result,
)
from app.wording import counted, fit_error, least_distance_words, share_text
from lcollision_core.errors import LCollisionError, ModelFileError
from lcollision_core.options import (
    ExportRequest,
    MotionChoice,
    MotionOptions,
    ResolveOptions,
    RuleOptions,
)

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from lcollision_core.bodies import Body, NamedPose, WrittenPose
    from lcollision_core.resolve import ResolveResult


_CLOTH_METRES = 0.003
"""Clearance between parts of a body that cloth is to lie between."""

_OF_MOTIONS = (
    *("clip", "substeps", "continuous", "easing"),
    *("for_cloth", "foot", "scheduler"),
)
"""Options of --motion alone."""

_OF_POSES = (
    *("like", "form", "keep_clips", "mesh_format"),
    *("sequence", "keep_detail", "scale"),
)
"""Options that --motion has no use of."""


@dataclass(frozen=True, eq=False)
class _Request:
    """One pose to resolve: where it came from, and the mesh that it was encoded from or None."""

    source: str
    pose: NamedPose
    mesh: npt.NDArray[np.float64] | None = None


@takes_options
def resolve(
    context: typer.Context,
    model_name: ModelArgument,
    output: FormOutput,
    options: ResolveOptions,
    request: Annotated[ExportRequest, Without({"axes", "scale", "fps"})],
    choice: MotionChoice,
    of_motion: MotionOptions,
    rules: RuleOptions,
    inputs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="POSES|MESH|MOTION...",
            readable=False,
            help="Files of poses, or meshes to encode, or folders of meshes. With --motion, files "
            "of motions; by default the clips of the character M.",
        ),
    ] = None,
    lock: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DOMAIN", help="A domain, by name or number, whose codes stay as they are."
        ),
    ] = None,
    pin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DOMAIN",
            help="A domain whose vertices stay in place as far as possible; its codes may change.",
        ),
    ] = None,
    touch: TouchOption = None,
    weight: Annotated[
        list[str] | None,
        typer.Option(metavar="DOMAIN=W", help="Make moving this domain cost W times as much."),
    ] = None,
    motion: Annotated[
        bool,
        typer.Option("--motion", help="Resolve whole motions, as smooth as they are."),
    ] = False,
    for_cloth: Annotated[
        bool,
        typer.Option(
            "--for-cloth",
            help="With --motion, what cloth solvers need: --continuous, and a clearance of 3 mm "
            "unless --clearance is given.",
        ),
    ] = False,
    foot: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DOMAIN",
            help="A domain that stands in all of a motion. Default: what rests near the ground.",
        ),
    ] = None,
    sequence: Annotated[
        bool, typer.Option("--sequence", help="The poses are frames of a motion, in order.")
    ] = False,
    keep_detail: Annotated[
        bool,
        typer.Option("--keep-detail", help="Restore the detail that encoding lost, if still free."),
    ] = False,
    scale: ScaleOption = 1.0,
    in_place: InPlaceOption = False,
    workers: ThreadsOption = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Resolve a folder of motions on the workers of this Dask scheduler, which read M "
            "and write OUT at the same paths.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Move poses to the nearest ones that are free of self-collisions.

    Exits with 0 if every pose ends free by the exact check (with --no-verify: by the prediction),
    else with 1. A pose that is already free is not changed. A mesh is written as the nearest
    model pose; --keep-detail adds what that lacks. You can stop it at any time: finished poses are
    kept beside the output, and the same command continues.

    The step that resolved a pose is one of: solver, the paper's problem; margin, the same with more
    distance from collision; polish, for shallow contacts; start, a restart elsewhere; towards, from
    a free pose as near to the target as contacts allow (for characters, which have no predictor);
    walk-back, along the way to a pose known to be free; neighbour, the correction of the previous
    frame (--sequence); soft, the least overlap within --soft.

    With --motion, colliding spans of whole motions are resolved, and all else stays as it is. Where
    OUT is a .glb or .vrm file, that is the character's own file with all its clips, and new keys in
    those spans only (an FBX comes back as a GLB with its rig); a .bvh file, or a .npz file of SMPL,
    SMPL-H or SMPL-X (as of AMASS; M is the .npz file of that model), is the one that was read with
    other turns there; else a .bvh or .vrma file holds how a character's joints move, without its
    mesh. Or OUT is a .pc2 or .mdd file, a folder or a .json file. The motions of a folder and its
    subfolders, or several files, come to a folder, each to its own file, with a table of all,
    motions.csv. A frame that still collides is named, the rest is written, and the command exits
    with 1.

    With --continuous, nothing touches on the linear path of the vertices from frame to frame
    either. Where joints turn, what a player shows between frames differs a little from that:
    --substeps of its poses are looked at as well.
    """
    import numpy as np

    from lcollision_core.bodies import open_body
    from lcollision_core.resolve import largest_correction_change

    if scheduler is not None and workers is not None:
        raise LCollisionError(
            "--workers and --scheduler can't be used together", "the cluster has its own workers"
        )
    if motion:
        refuse_given(
            context, _OF_POSES, "is for poses, not for motions", "leave it or --motion out"
        )
    else:
        refuse_given(context, _OF_MOTIONS, "needs --motion", "add that, or leave it out")
    model = open_body(model_name).with_options(rules).with_touching(touch or ())
    options = replace(
        options,
        locked_domains=frozenset(_domain(model, name) for name in lock or ()),
        still_domains=frozenset(_domain(model, name) for name in pin or ()),
        group_weights=_group_weights(model, weight or ()),
    )
    target = output_named(output, request.form, of_motions=motion)
    if motion:
        feet = frozenset(_domain(model, name) for name in foot or ())
        if for_cloth:
            choice = replace(choice, continuous=True)
            clearance = options.clearance or _cloth_clearance(model)
            options = replace(options, clearance=clearance)
        of_motion = replace(
            of_motion,
            frame=options,
            substeps=choice.substeps,
            continuous=choice.continuous,
            feet=feet,
        )
        remote = Remote(scheduler, model_name, tuple(touch or ())) if scheduler else None
        found = _motions_of(inputs or (), target)
        _refuse_to_replace_motions(model, found, target, in_place=in_place)
        motions = _resolve_motions(model, found, target, of_motion, choice, workers, remote)
        _report_motions(motions, as_json=as_json)
        return
    if not inputs:
        raise LCollisionError("names no pose to resolve", "name files of poses or meshes")
    if model.is_trained:
        refuse_given(context, ("keep_feet",), "is for characters and motions", "leave it out")
    elif of_motion.keep_feet:
        options = replace(options, standing=model.up)
    request = replace(request, fps=choice.fps or request.fps)
    if keep_detail and target.form == "poses":
        raise LCollisionError(
            "would contain codes; --keep-detail applies only to meshes",
            "name a mesh or a folder, or leave out --keep-detail",
            where=output,
        )
    files = expanded(inputs)
    if len(files) > 1:
        require_one_mesh(target, len(files))
    requests, failed = _read(model, files, scale)
    if not requests:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    require_one_mesh(target, len(requests))
    poses = [held.pose for held in requests]
    source = require_request(target, model, poses, request)
    read = [*files, *source_files(model, request)]
    refuse_to_replace(files_of(target, model, poses, request), read, in_place=in_place)
    with (
        unfinished_poses(
            target.path, model, *_depends_on(model, requests, options, sequence), len(requests)
        ) as unfinished,
        cancel_on_interrupt() as job,
    ):
        finished = _results(model, unfinished)

        def keep(index: int, result: ResolveResult) -> None:
            pose = replace(requests[index].pose, latent=result.latent)
            unfinished.keep(index, pose, _facts(result))

        with progress_bar("Resolving poses", job) as job:
            results = model.resolver.resolve_many(
                np.array([held.pose.latent for held in requests]),
                options,
                workers,
                job,
                placements=[held.pose.placement for held in requests],
                sequence=sequence,
                done=finished,
                keep=keep,
            )
        detailed: list[npt.NDArray[np.float64] | None] = [None] * len(requests)
        if keep_detail:
            detailed = _detailed(model, requests, results, options.clearance)
        written = write_result(
            target,
            model,
            [replace(r.pose, latent=f.latent) for r, f in zip(requests, results, strict=True)],
            request,
            [
                result.vertices if mesh is None else mesh
                for result, mesh in zip(results, detailed, strict=True)
            ],
            source,
        )
    rows: list[dict[str, Any]] = []
    at_rest = excluded_at_rest(model)
    for held, result, file, mesh in zip(requests, results, written, detailed, strict=True):
        if result.note:
            note(f"{held.source}: {result.note}")
        row = {"source": held.source, "output": str(file.path), **_facts(result)}
        del row["converged"], row["note"]
        rows.append(
            row | {"near_exclusion": model.rules.near_exclusion, "excluded_at_rest": at_rest}
        )
        if not as_json:
            told = _sentence(held, result, mesh is not None, options.clearance)
            tell(f"{held.source}: {told}")
    if as_json:
        print_json(rows)
    else:
        note_rules(model)
    if sequence:
        before = np.array([held.pose.latent for held in requests])
        change = largest_correction_change(model.space.decode, before, results)
        note(
            f"from frame to frame the correction changes by at most {100.0 * change:.3f} % of "
            f"the body size, averaged over the vertices"
        )
    if failed:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    ends = (r.predicted_free if r.exactly_free is None else r.exactly_free for r in results)
    is_kept = source is None or _stay_free(model, requests, results, written)
    if not all(ends) or not is_kept:
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


@dataclass(frozen=True)
class _Motions:
    """The files of motions that a command names.

    Attributes
    ----------
    files : none for the clips of the character itself
    folder : that they are in, where one is named
    each : whether each comes to a file of its own
    """

    files: Sequence[Path]
    folder: Path | None
    each: bool


def _motions_of(inputs: Sequence[Path], target: Output) -> _Motions:
    """Find the files of motions; several, as a shell's pattern names them, are as a folder is."""
    if len(inputs) == 1 and inputs[0].is_dir():
        files = motion_files(inputs[0], besides=target.path)
        if files and target.form != "folder":
            what = f"cannot contain {counted(len(files), 'motion')}"
            raise LCollisionError(what, "name a folder", where=target.path)
        return _Motions(files or inputs, inputs[0] if files else None, bool(files))
    return _Motions(inputs, None, len(inputs) > 1 and target.form == "folder")


def _refuse_to_replace_motions(
    model: Body, motions: _Motions, target: Output, *, in_place: bool
) -> None:
    """Refuse outputs of motions that are inputs."""
    if motions.each:
        outputs = list(motion_outputs(model, motions.files, target.path, motions.folder).values())
    elif target.form == "folder":
        outputs = [target.path / path.name for path in motions.files]
    else:
        outputs = [target.path]
    refuse_to_replace(outputs, [*motions.files, *source_files(model)], in_place=in_place)


def _resolve_motions(
    model: Body,
    motions: _Motions,
    target: Output,
    options: MotionOptions,
    choice: MotionChoice,
    workers: int | None,
    remote: Remote | None,
) -> list[dict[str, Any]]:
    """Resolve the motions of files into one output, or each to a file of a folder."""
    if remote is not None and not motions.each:
        raise LCollisionError("--scheduler needs a folder of motions", "name one")
    if motions.each:
        return resolve_folder(
            model, motions.files, target.path, options, choice, workers, remote, motions.folder
        )
    return resolve_motions(model, motions.files, target, options, choice, workers)


def _report_motions(motions: Sequence[dict[str, Any]], *, as_json: bool) -> None:
    """Say what became of motions, and exit as of that."""
    resolved = [one for one in motions if "error" not in one]
    if as_json:
        print_json(motions)
    else:
        for one in resolved:
            tell(motion_sentence(one))
    if len(resolved) < len(motions):
        raise typer.Exit(ExitStatus.BAD_INPUT)
    if any(
        one["free_after"] < one["frames"] or one["collides_between"] or one["kept_spans"]
        for one in resolved
    ):
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


def _domain(model: Body, name: str) -> int:
    """Find a domain by its name, or by its number from 1."""
    names = [known.casefold() for known in model.domain_names]
    if name.casefold() in names:
        return names.index(name.casefold())
    if name.isdecimal() and 1 <= int(name) <= len(names):
        return int(name) - 1
    raise LCollisionError(
        f"{model.name} has no domain {name!r}",
        f"its domains are {', '.join(model.domain_names)}, or 1 to {len(names)}",
    )


def _cloth_clearance(model: Body) -> float:
    """Return the clearance that cloth needs, normalised."""
    if model.known_metres is None:
        raise LCollisionError(
            "has no known unit, so 3 mm cannot be converted",
            "give the distance in body sizes with --clearance",
            where=model.name,
        )
    return _CLOTH_METRES / (model.known_metres * model.body_size)


def _group_weights(model: Body, wanted: Sequence[str]) -> tuple[float, ...] | None:
    """Read DOMAIN=W options; the whole body's codes keep the weight 1."""
    if not wanted:
        return None
    weights = [1.0] * (1 + len(model.domain_names))
    for entry in wanted:
        name, equals, number = entry.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        if not equals or not 0.0 < value < float("inf"):
            raise LCollisionError(
                "is not DOMAIN=W with a number W above 0, as in 'left arm=5'",
                where=f"--weight {entry!r}",
            )
        weights[1 + _domain(model, name)] = value
    return tuple(weights)


def _read(model: Body, inputs: Sequence[Path], scale: float) -> tuple[list[_Request], bool]:
    """Read and encode what can be; say of each other input in a sentence why it cannot."""
    from lcollision_core.bodies import unique_names

    requests: list[_Request] = []
    failed = False
    with progress_bar("Reading poses") as job:
        for done, path in enumerate(inputs):
            try:
                requests += _requests_of(model, path, scale)
            except LCollisionError as error:
                note(str(error))
                failed = True
            job.report(done + 1, len(inputs))
    names = unique_names(request.pose.name for request in requests)
    named = [
        replace(request, pose=replace(request.pose, name=name))
        for request, name in zip(requests, names, strict=True)
    ]
    return named, failed


def _requests_of(model: Body, path: Path, scale: float) -> Iterator[_Request]:
    from lcollision_core.bodies import encode_mesh, read_model_mesh, read_poses
    from lcollision_core.files.mesh_file import KEEP_PRECISION

    if path.suffix.lower() == ".json":
        poses = read_poses(path, model)
        if not poses:
            raise ModelFileError("contains no poses", "name a file with poses", where=path)
        for pose in poses:
            yield _Request(f"{path}: {pose.name}", pose)
        return
    mesh = read_model_mesh(path, model)
    if mesh.coarseness:
        note(f"{path}: {mesh.coarseness}; {KEEP_PRECISION}")
    try:
        pose = encode_mesh(mesh, model, scale)
    except LCollisionError as error:
        raise cannot_encode(path, error) from error
    note(f"{path} is encoded with a {fit_error(pose.fit_error_mean, pose.fit_error_max)}")
    yield _Request(str(path), pose, mesh.vertices)


def _depends_on(
    model: Body, requests: Sequence[_Request], options: ResolveOptions, sequence: bool
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Return the inputs that determine the results: arrays, and JSON values."""
    from lcollision_core.bodies import fingerprint_of_pose

    arrays, values = depends_on(model, options)
    poses = [request.pose for request in requests]
    return arrays, values | {
        "command": "resolve",
        "poses": [fingerprint_of_pose(pose.latent, pose.placement) for pose in poses],
        "sequence": sequence,
    }


def _facts(result: ResolveResult) -> dict[str, Any]:
    """Return a result without its arrays, as JSON values."""
    names = (field.name for field in fields(result))
    return {name: getattr(result, name) for name in names if name not in ("latent", "vertices")}


def _results(model: Body, unfinished: UnfinishedPoses) -> dict[int, ResolveResult]:
    """Return the results of an earlier run, by index."""
    from lcollision_core.resolve import ResolveResult, Step

    try:
        return {
            index: ResolveResult(
                latent=pose.latent,
                vertices=model.exported_vertices(pose.latent, pose.placement),
                **{**facts, "step": Step(facts["step"])},
            )
            for index, (pose, facts) in unfinished.finished.items()
        }
    except (KeyError, TypeError, ValueError) as error:
        raise unfinished.damaged() from error


def _detailed(
    model: Body,
    requests: Sequence[_Request],
    results: Sequence[ResolveResult],
    clearance: float,
) -> list[npt.NDArray[np.float64] | None]:
    """Return the resolved meshes with what encoding lost of them, None if that collides."""
    from lcollision_core.bodies import with_detail

    detailed: list[npt.NDArray[np.float64] | None] = []
    for request, result in zip(requests, results, strict=True):
        mesh = request.mesh
        detailed.append(
            None if mesh is None else with_detail(model, mesh, request.pose, result, clearance)
        )
        if mesh is not None and detailed[-1] is None:
            note(
                f"{request.source}: its detail was left out, because with it the mesh would collide"
            )
    return detailed


def _stay_free(
    model: Body,
    requests: Sequence[_Request],
    results: Sequence[ResolveResult],
    written: Sequence[WrittenPose],
) -> bool:
    """Check free poses as the user's own file holds them, and say where rounding made contact."""
    stay_free = True
    for request, result, file in zip(requests, results, written, strict=True):
        if result.exactly_free and file.vertices is not None:
            n_pairs = len(file.checked(model).pairs)
            if n_pairs:
                stay_free = False
                pairs = counted(n_pairs, "pair of faces collides", "pairs of faces collide")
                note(
                    f"{request.source}: in {file.path}, {pairs} after rounding; --form mesh "
                    f"writes the vertices that were checked"
                )
    return stay_free


def _sentence(request: _Request, result: ResolveResult, has_detail: bool, clearance: float) -> str:
    """Report the result of one pose; figures of a mesh are those of the pose nearest to it."""
    from lcollision_core.resolve import Step

    moved = (
        f"moved by {100.0 * result.vertex_distance_mean:.2f} % of the body size, at most "
        f"{100.0 * result.vertex_distance_max:.1f} %"
    )
    pairs = result.pairs_before if result.exactly_free else result.pairs_after
    counted_pairs = counted(pairs or 0, "pair of faces", "pairs of faces")
    if result.exactly_free is None:
        verdict = "predicted free" if result.predicted_free else "still predicted to collide"
        said = [verdict, "not checked", moved]
    elif not result.exactly_free:
        said = ["still colliding", counted_pairs]
        if result.step == Step.SOFT:
            left = (result.energy_after or 0.0) / (result.energy_before or 1.0)
            said[1] += f" of {result.pairs_before}"
            said += [f"up to {share_text(result.deepest_after or 0.0)} deep"]
            said += [f"overlap {100.0 * left:.0f} % of before", moved]
    elif result.step == Step.UNCHANGED:
        said = ["already free"]
    else:
        said = [f"resolved {counted_pairs} by the step {result.step!s}", "checked", moved]
    if has_detail:
        said.append("with its detail")
    elif request.mesh is not None:
        fit = f"{100.0 * (request.pose.fit_error_mean or 0.0):.2f} % of the body size off"
        said.append(f"written as the nearest model pose, {fit}")
    elif result.step == Step.UNCHANGED:
        said.append("unchanged")
    if clearance > 0.0 and result.exactly_free is not None:
        said.append(least_distance_words(result.least_distance, clearance))
    return f"{', '.join(said)} ({result.seconds:.2f} s)"
