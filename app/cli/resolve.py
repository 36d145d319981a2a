"""``lcollision resolve``: the nearest poses without self-collisions by the exact check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.console import (
    BarContent,
    ExitStatus,
    JsonOption,
    cancel_on_interrupt,
    cancellable_bar,
    note,
    print_json,
    progress_bar,
    status_bar,
    tell,
)
from app.cli.contacts import excluded_at_rest, note_rules
from app.cli.options import (
    DeviceOption,
    Excluding,
    FormOutput,
    InPlaceOption,
    JointsOption,
    ModelArgument,
    ScaleOption,
    ThreadsOption,
    TouchOption,
    refuse_given,
    require_one_workplace,
    takes_options,
    touch_entries,
)
from lcollision_core.devices import Device, choose_device
from lcollision_core.errors import LCollisionError, listed
from lcollision_core.jobs import Job
from lcollision_core.options import (
    ExportRequest,
    MotionChoice,
    MotionOptions,
    ResolveOptions,
    RuleOptions,
    SceneOptions,
)
from lcollision_core.tasks.verdicts import FailedFile
from lcollision_core.tasks.words import left_text, resolved_clip_text, resolved_pose_text

if TYPE_CHECKING:
    from lcollision_core.bodies import Body
    from lcollision_core.tasks.resolving import ResolveMotionsRequest, ResolvePosesRequest


_CLOTH_METRES = 0.003
"""Clearance between body parts that leaves room for cloth."""

_OF_MOTIONS = (
    *("clip", "substeps", "continuous", "easing"),
    *("for_cloth", "foot", "scheduler", "budget", "only_check", "joints", "device"),
)
"""Options for --motion only."""

_OF_POSES = (
    *("like", "form", "keep_clips", "mesh_format"),
    *("keep_detail", "scale"),
)
"""Options that do not apply to --motion."""


@takes_options
def resolve(
    context: typer.Context,
    model_name: ModelArgument,
    output: FormOutput,
    options: ResolveOptions,
    request: Annotated[ExportRequest, Excluding({"axes", "scale", "fps"})],
    choice: MotionChoice,
    of_motion: MotionOptions,
    rules: RuleOptions,
    scene: SceneOptions,
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
        typer.Option(
            "--motion",
            help="Resolve whole motions, as smooth as they are. Implied by files that hold nothing "
            "but motion.",
        ),
    ] = False,
    for_cloth: Annotated[
        bool,
        typer.Option(
            "--for-cloth",
            help="With --motion, what cloth solvers need: --continuous, and a clearance of 3 mm "
            "unless --clearance is given.",
        ),
    ] = False,
    joints: JointsOption = None,
    foot: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DOMAIN",
            help="A domain that stands in all of a motion. Default: what rests near the ground.",
        ),
    ] = None,
    only_check: Annotated[
        bool,
        typer.Option(
            "--only-check",
            help="With --motion: check the motions of a folder, or of several files, and write "
            "only the table, motions.csv.",
        ),
    ] = False,
    sequence: Annotated[
        bool, typer.Option("--sequence", help="Deprecated: the old name of --motion.")
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
    device: DeviceOption = Device.AUTO,
    as_json: JsonOption = False,
) -> None:
    """Move poses to the nearest ones that are free of self-collisions.

    Exits with 0 if every pose ends free by the exact check (with --no-verify: by the prediction),
    else with 1. A pose that is already free is not changed. A mesh is written as the nearest
    model pose; --keep-detail adds what that lacks. You can stop it at any time: finished poses are
    kept beside the output, and the same command continues.

    The step that resolved a pose is one of: solver, the paper's problem; margin, the same with a
    larger margin; polish, for shallow contacts; start, a restart elsewhere; towards, from a free
    pose as near to the target as contacts allow (for characters, which have no predictor);
    push-out, moved out of contact by the joints, if that is nearer; walk-back, along the way to a
    pose known to be free; soft, the least overlap within --soft. A free pose of a character is then
    drawn nearer: small random changes that stay free and move it less are kept.

    With --motion, colliding spans of whole motions are resolved, and everything else is unchanged.
    Where OUT is a .glb or .vrm file, that is the character's own file with all its clips, and new
    keys in those spans only (an FBX comes back as a GLB with its rig); clips without a mesh, or of
    another character, become new clips of it. What touches on another character's body, or the
    ground, touches on this one too, unless --no-keep-contacts is given. A .bvh file, or a .npz file
    of SMPL, SMPL-H or SMPL-X (as of AMASS; M is the .npz file of that model), is the one that was
    read with other turns there; else a .bvh or .vrma file holds how a character's joints move,
    without its mesh. Or OUT is a .pc2 or .mdd file, a folder or a .json file. The motions of a
    folder and its subfolders, or several files, come to a folder, each to its own file, with a
    table of all, motions.csv. A frame that still collides is named, the rest is written, and the
    command exits with 1.

    With --with or --ground, the poses are those of a scene of several bodies, one file for each, or
    none where they stand as their files say; with --motion their clips play together: see --play.
    OUT is a folder, in which each body comes to its own file, or a .json file.

    With --continuous, nothing touches on the linear path of the vertices from frame to frame
    either. Where joints turn, what a player shows between frames differs a little from that:
    --substeps of its poses are looked at as well.
    """
    from lcollision_core.bodies.partners import with_joint_map
    from lcollision_core.tasks.exporting import output_named
    from lcollision_core.tasks.inputs import holds_motion
    from lcollision_core.tasks.resolving import Remote, ResolveMotionsRequest, ResolvePosesRequest
    from lcollision_core.tasks.scenes import open_scene

    if sequence:
        note("--sequence is deprecated and means --motion; use that")
    motion = motion or sequence or (bool(inputs) and all(map(holds_motion, inputs or ())))
    require_one_workplace(workers, scheduler)
    if motion:
        refuse_given(
            context, _OF_POSES, "is for poses, not for motions", "leave it or --motion out"
        )
    else:
        refuse_given(context, _OF_MOTIONS, "needs --motion", "add that, or leave it out")
    if for_cloth and options.clearance == 0.0:
        what = "0 leaves no room for cloth"
        refuse_given(context, ("clearance",), what, "leave it out for 3 mm, or --for-cloth out")
    may_touch = touch_entries(touch, options.clearance or float(for_cloth))
    choose_device(device, note)
    model = open_scene(model_name, scene)
    if joints is not None:
        if scheduler:
            refuse_given(context, ("joints",), "is for motions resolved here", "leave it out")
        model = with_joint_map(model, joints)
    model = model.with_options(rules).with_touching(may_touch)
    if model.is_trained and not only_check:
        model.require_predictor()
    options = replace(
        options,
        locked_domains=frozenset(_domain(model, name) for name in lock or ()) | model.fixed_domains,
        still_domains=frozenset(_domain(model, name) for name in pin or ()),
        group_weights=_group_weights(model, weight or ()),
    )
    target = output_named(output, request.form, of_motions=motion)
    if motion:
        if only_check:
            refuse_given(context, ("budget",), "is for resolving", "leave it or --only-check out")
        if for_cloth:
            choice = replace(choice, continuous=True)
            clearance = options.clearance or _cloth_clearance(model)
            options = replace(options, clearance=clearance)
        of_motion = replace(
            of_motion,
            frame=options,
            substeps=choice.substeps,
            continuous=choice.continuous,
            feet=frozenset(_domain(model, name) for name in foot or ()),
        )
        remote = Remote(scheduler, model_name, may_touch) if scheduler else None
        of_motions = ResolveMotionsRequest(
            model, inputs or (), target, of_motion, choice, workers, remote, only_check=only_check
        )
        _resolve_motions(of_motions, scene.played, in_place=in_place, as_json=as_json)
        return
    if model.is_trained:
        refuse_given(context, ("keep_feet",), "is for characters and motions", "leave it out")
    elif of_motion.keep_feet:
        options = replace(options, standing=model.up)
    request = replace(request, fps=choice.fps or request.fps)
    of_poses = ResolvePosesRequest(model, (), target, options, request, keep_detail, workers)
    _resolve_poses(of_poses, inputs or (), scale, in_place=in_place, as_json=as_json)


def _resolve_poses(
    request: ResolvePosesRequest,
    inputs: Sequence[Path],
    scale: float,
    *,
    in_place: bool,
    as_json: bool,
) -> None:
    """Resolve the poses and meshes of files, print the results and exit with their status."""
    from app.work.compile_ahead import begin_compiling_check, wait_for_compiled_check
    from lcollision_core.bodies import as_scene
    from lcollision_core.tasks.exporting import (
        files_of,
        refuse_to_replace,
        require_one_mesh,
        source_files,
    )
    from lcollision_core.tasks.inputs import mesh_files_of, read_input_poses
    from lcollision_core.tasks.resolving import resolve_poses
    from lcollision_core.tasks.scenes import parts_text, read_scene_poses

    body, output, export = request.body, request.output, request.export
    scene = as_scene(body)
    if not inputs and scene is None:
        add = "name files of poses or meshes, or add --motion for its clips"
        raise LCollisionError("names no pose to resolve", add)
    if request.keep_detail and output.form == "poses":
        raise LCollisionError(
            "would contain codes; --keep-detail applies only to meshes",
            "name a mesh or a folder, or leave out --keep-detail",
            where=output.path,
        )
    files, failed = mesh_files_of(inputs), False
    if len(files) > 1 and scene is None:
        require_one_mesh(output, len(files))
    compiles_ahead = body.is_trained and request.options.verify
    if compiles_ahead:
        begin_compiling_check()
    with progress_bar("Reading poses") as job:
        if scene is not None:
            given = read_scene_poses(scene, files, scale, job)
        else:
            given, failed = read_input_poses(body, files, scale, job)
    if not given:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    poses = [given_pose.pose for given_pose in given]
    read = [*files, *source_files(body, export)]
    refuse_to_replace(files_of(output, body, poses, export), read, in_place=in_place)
    if compiles_ahead:
        wait_for_compiled_check(body)
    with cancellable_bar("Resolving poses") as job:
        resolved = resolve_poses(replace(request, given=given), job)
    for resolved_pose in resolved:
        if resolved_pose.result.note:
            note(f"{resolved_pose.given.source}: {resolved_pose.result.note}")
        if not as_json:
            result, colliding_parts = resolved_pose.result, []
            if result.exactly_free is False:
                check = body.exact_check(resolved_pose.given.pose.placement)
                colliding_parts = parts_text(body, check.find(result.vertices).pairs)
            text = resolved_pose_text(
                result,
                request.options.clearance,
                has_detail=resolved_pose.has_detail,
                fit=resolved_pose.fit,
                colliding_parts=colliding_parts,
            )
            tell(f"{resolved_pose.given.source}: {text}")
    if as_json:
        by_rules = {
            "near_exclusion": body.rules.near_exclusion,
            "excluded_at_rest": excluded_at_rest(body),
        }
        print_json([resolved_pose.to_json() | by_rules for resolved_pose in resolved])
    else:
        note_rules(body)
    if failed:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    if not all(resolved_pose.is_free for resolved_pose in resolved):
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


def _resolve_motions(
    request: ResolveMotionsRequest, played: Sequence[str], *, in_place: bool, as_json: bool
) -> None:
    """Resolve motions into one output, or each to a file of a folder; exit with their status.

    Parameters
    ----------
    played : what the bodies of a scene do: see `SceneOptions`
    """
    from lcollision_core.bodies import as_scene
    from lcollision_core.tasks.resolving import FolderStatus, Row, resolve_folder, resolve_motions
    from lcollision_core.tasks.scenes import resolve_scene_motion

    scene = as_scene(request.body)
    if scene is None:
        request = request.with_files_of_folder(Job(note=note))
    elif request.files:
        file, name = request.files[0], scene.members[0].name
        raise LCollisionError(
            "is a motion, not a body of the scene",
            f"assign it with --play '{name}={file}'",
            where=file,
        )
    each = scene is None and request.has_output_each
    if request.only_check and not each:
        raise LCollisionError(
            "--only-check needs a folder of motions", "name one, or use check --clips"
        )
    if request.remote is not None and not each:
        raise LCollisionError("--scheduler needs a folder of motions", "name one")
    if scene is None and not request.only_check:
        request.refuse_to_replace(in_place=in_place)

    def tell_rows(rows: Sequence[Row]) -> None:
        for row in rows:
            if not isinstance(row, FailedFile):
                (note if as_json else tell)(resolved_clip_text(row))

    def bar_content(status: FolderStatus) -> BarContent:
        tell_rows(status.rows)
        left = status.seconds_left
        facts = [left_text(left)] if left else []
        return status.n_done, status.n_files, task, facts

    task = "Checking motions" if request.only_check else "Resolving motions"
    rows = list[Row]()
    with cancel_on_interrupt() as job:
        if each:
            with status_bar(task, bar_content, job, rows=True, seconds=0.0) as job:
                rows = resolve_folder(request, job)
        else:
            with progress_bar(task, job) as job:
                if scene is None:
                    rows += resolve_motions(request, job)
                else:
                    rows += [resolve_scene_motion(scene, request, played, job, in_place=in_place)]
            tell_rows(() if as_json else rows)
    if as_json:
        print_json([row.to_json() for row in rows])
    if any(isinstance(row, FailedFile) for row in rows):
        raise typer.Exit(ExitStatus.BAD_INPUT)
    if not all(isinstance(row, FailedFile) or row.is_free for row in rows):
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
        f"its domains are {listed(model.domain_names)}, or 1 to {len(names)}",
    )


def _cloth_clearance(model: Body) -> float:
    """Return the normalised clearance for cloth."""
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
