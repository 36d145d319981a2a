"""``lcollision encode``, ``decode``, ``sample`` and ``mirror``: make and convert latent poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import (
    ExitStatus,
    JsonOption,
    cancellable_bar,
    note,
    print_json,
    progress_bar,
    tell,
)
from app.cli.contacts import note_rules
from app.cli.options import (
    ClearanceOption,
    DeviceOption,
    ErrorBoundOption,
    FormOutput,
    InPlaceOption,
    MeshesArgument,
    ModelArgument,
    PosesArgument,
    PosesOutput,
    ScaleOption,
    TouchOption,
    takes_options,
    touch_entries,
)
from lcollision_core.devices import Device, choose_device
from lcollision_core.jobs import Job
from lcollision_core.options import NO_SCENE, ExportRequest, RuleOptions, SceneOptions
from lcollision_core.tasks.words import counted, fit_error, mirrored_text

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, MirroredPose


def encode(
    model_name: ModelArgument,
    meshes: MeshesArgument,
    output: PosesOutput,
    scale: ScaleOption = 1.0,
) -> None:
    """Turn meshes of the model's topology into latent poses, and report how well each fits.

    You can stop it at any time: finished poses are kept beside the output, and the same command
    continues.
    """
    from lcollision_core.bodies import open_body
    from lcollision_core.tasks.exporting import require_output
    from lcollision_core.tasks.inputs import encode_meshes, mesh_files_of

    destination = require_output(output, ".json")
    model, files = open_body(model_name), mesh_files_of(meshes)
    with cancellable_bar("Encoding meshes") as job:
        poses = encode_meshes(model, files, destination, scale, job)
    for pose in poses:
        tell(f"{pose.name}: {fit_error(pose.fit_error_mean, pose.fit_error_max)}")


@takes_options
def decode(
    model_name: ModelArgument,
    poses: PosesArgument,
    output: FormOutput,
    request: ExportRequest,
    rules: RuleOptions,
    in_place: InPlaceOption = False,
    scene: SceneOptions = NO_SCENE,
) -> None:
    """Turn latent poses into meshes; an imported pose returns to its placement.

    With --axes, meshes import upright and facing the front with the program's default settings:
    y-up; blender; maya and unreal, in centimetres. A GLB file is always y up and in the model's
    unit, as its standard requires.

    With --like FILE, the output is your own file in the new pose: an OBJ file with its UVs,
    groups, materials and quads; a GLB with its textures, UVs and vertex order, without the clips
    that would hide the pose unless you give --keep-clips. FBX files can't be written: an FBX
    character comes back as a GLB with its rig. With --with, the poses are those of a scene, and
    the output is a folder with a file of each body.
    """
    from lcollision_core.tasks.exporting import (
        files_of,
        output_named,
        refuse_to_replace,
        require_request,
        source_files,
        write_result,
    )
    from lcollision_core.tasks.inputs import read_some_poses
    from lcollision_core.tasks.scenes import open_scene

    destination = output_named(output, request.form)
    model = open_scene(model_name, scene).with_options(rules)
    named = read_some_poses(poses, model)
    source = require_request(destination, model, named, request)
    read = [poses, *source_files(model, request)]
    refuse_to_replace(files_of(destination, model, named, request), read, in_place=in_place)
    write_result(destination, model, named, request, source=source, job=Job(note=note))


@takes_options
def sample(
    model_name: ModelArgument,
    count: Annotated[int, typer.Option("-n", min=1, max=1_000_000, help="Number of poses.")],
    output: PosesOutput,
    colliding: Annotated[
        bool | None,
        typer.Option(
            "--colliding/--free",
            help="Keep only such poses, by the exact check unless --error-bound is given.",
        ),
    ] = None,
    clearance: ClearanceOption = 0.0,
    touch: TouchOption = None,
    scene: SceneOptions = NO_SCENE,
    *,
    rules: RuleOptions,
    error_bound: ErrorBoundOption = 0.0,
    seed: Annotated[
        int, typer.Option(min=0, metavar="S", help="The same seed gives the same poses.")
    ] = 0,
    device: DeviceOption = Device.AUTO,
) -> None:
    """Draw random poses: of a model from its latent box, of a character within human limits.

    With --with, they are poses of a scene; fixed bodies don't move, and the others only turn their
    joints.
    """
    from app.work.compile_ahead import begin_compiling_check, wait_for_compiled_check
    from lcollision_core.bodies import NamedPose, sample_poses
    from lcollision_core.tasks.exporting import require_output, write_result
    from lcollision_core.tasks.scenes import open_scene

    choose_device(device, note)
    destination = require_output(output, ".json")
    may_touch = touch_entries(touch, clearance)
    model = open_scene(model_name, scene).with_options(rules).with_touching(may_touch)
    for remark in model.notes:
        note(f"{model.name}: {remark}")
    if error_bound and not model.has_predictor:
        note(f"{model.name} has no predictor, so --error-bound has no effect")
    if model.is_trained and colliding is not None and not (error_bound and model.has_predictor):
        begin_compiling_check()
        wait_for_compiled_check(model)
    with progress_bar("Drawing poses") as job:
        latent = sample_poses(model, count, seed, colliding, job, clearance, error_bound)
    width = len(str(count))
    poses = [NamedPose(f"sample {index + 1:0{width}d}", row) for index, row in enumerate(latent)]
    write_result(destination, model, poses, job=Job(note=note))


@takes_options
def mirror(
    model_name: ModelArgument,
    poses: PosesArgument,
    output: PosesOutput,
    rules: RuleOptions,
    in_place: InPlaceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Exchange left and right of poses, and mirror their placement.

    Writes the pose nearest to each mirror image, with its fit error, under the same name.
    Mirroring a pose twice restores it exactly. If a pose is free of collisions by the exact check
    and its image is not, the image is resolved; exits with 1 if that fails.
    """
    from lcollision_core.bodies import open_body
    from lcollision_core.tasks.editing import mirror_poses
    from lcollision_core.tasks.exporting import refuse_to_replace, require_output, write_result
    from lcollision_core.tasks.inputs import read_some_poses

    destination = require_output(output, ".json")
    refuse_to_replace([output], [poses], in_place=in_place)
    model = open_body(model_name).with_options(rules)
    named = read_some_poses(poses, model)
    with cancellable_bar("Mirroring poses") as job:
        images = mirror_poses(model, named, job)
    written, *_ = write_result(destination, model, [pose for pose, _ in images], job=job)
    mirrored_of = {f"{poses}: {pose.name}": mirrored for pose, mirrored in images}
    if as_json:
        rows = mirrored_of.items()
        print_json([_row(model, source, written.path, mirrored) for source, mirrored in rows])
    else:
        for source, mirrored in mirrored_of.items():
            tell(f"{source}: {mirrored_text(mirrored)}")
        note_rules(model)
    colliding = [source for source, mirrored in mirrored_of.items() if mirrored.collides_newly]
    if colliding:
        offer = (
            f"run `lcollision resolve {model_name} {output}` or change them"
            if model.has_predictor
            else "the model has no predictor to resolve them with; run `lcollision label` and "
            "`lcollision train predictor`"
        )
        count = counted(len(colliding), "free pose collides", "free poses collide")
        note(f"{count} when mirrored, such as {colliding[0]}; {offer}")
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


def _row(model: Body, source: str, output: Path, mirrored: MirroredPose) -> dict[str, Any]:
    names = ("restored", "fit_error_mean", "fit_error_max")
    pairs = ("pairs_before", "pairs_mirrored", "pairs_after")
    return {
        "source": source,
        "output": str(output),
        **{name: getattr(mirrored, name) for name in (*names, *pairs)},
        "exactly_free": mirrored.pairs_after == 0,
        "resolved": mirrored.pairs_after == 0 < mirrored.pairs_mirrored,
        "near_exclusion": model.rules.near_exclusion,
    }
