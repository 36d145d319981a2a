"""``lcollision check``: the exact self-collisions of mesh files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.console import (
    ExitStatus,
    JsonOption,
    cancel_on_interrupt,
    note,
    print_json,
    progress_bar,
    tell,
)
from app.cli.options import (
    ClearanceOption,
    DeviceOption,
    ErrorBoundOption,
    JointsOption,
    MeshesArgument,
    NoRulesOption,
    RestOption,
    TouchOption,
    refuse_given,
    takes_options,
    touch_entries,
)
from lcollision_core.devices import Device, choose_device
from lcollision_core.errors import LCollisionError
from lcollision_core.options import NO_SCENE, MotionChoice, RuleOptions, SceneOptions
from lcollision_core.tasks.verdicts import CheckedClip, CheckedMesh
from lcollision_core.tasks.words import checked_clip_table, checked_clip_text, checked_mesh_text

_ALL_MOTIONS, _TASK = MotionChoice(), "Finding self-collisions"

_OF_CLIPS = (
    *("clip", "played", "fps", "substeps", "continuous", "body", "joints", "table", "error_bound"),
    "device",
)
"""Options for motions only."""


@takes_options
def check(
    context: typer.Context,
    meshes: MeshesArgument,
    options: RuleOptions,
    rest: RestOption = None,
    no_rules: NoRulesOption = False,
    clearance: ClearanceOption = 0.0,
    touch: TouchOption = None,
    clips: Annotated[
        bool,
        typer.Option(
            "--clips",
            help="Check every frame of the files' clips, and poses between frames. Implied by "
            "files that hold nothing but motion.",
        ),
    ] = False,
    choice: MotionChoice = _ALL_MOTIONS,
    scene: SceneOptions = NO_SCENE,
    body: Annotated[
        str | None,
        typer.Option(
            metavar="M",
            help="Character or model to animate; needed for .bvh, .vrma and .json files, clips "
            "without a mesh, generated and SMPL motions.",
        ),
    ] = None,
    joints: JointsOption = None,
    table: Annotated[
        Path | None,
        typer.Option(
            "--csv",
            metavar="FILE",
            help="Also write a row for each frame that collides or has pairs that are not counted.",
        ),
    ] = None,
    error_bound: ErrorBoundOption = 0.0,
    device: DeviceOption = Device.AUTO,
    as_json: JsonOption = False,
) -> None:
    """Find the exact self-collisions of any triangle mesh.

    A file that was exported from here, or that has the faces of a character that was opened before,
    is checked by that character's contact rules; the character's own file only by rules that were
    chosen for it, so that what touches in its stored pose counts.

    With --clips, motions are checked: the clips of characters and other animated files, point
    caches with their mesh beside them, and, with --body, BVH and VRMA files, point caches alone,
    poses, pose sets, and .npz files of SMPL, SMPL-H and SMPL-X (as of AMASS), whose body is the
    .npz file of that model. Exits with 0 if no mesh has collisions, with 1 if any has.

    With --clearance, faces collide as soon as they are nearer than that. Without a rest pose, faces
    joined by an edge, or by at most four clearances along the surface, count only if they
    penetrate.

    With --with or --ground, the meshes or clips are those of a scene: pairs between bodies all
    count. A scene file saved by the editor counts as a scene.

    For several meshes, the number of colliding ones follows; for several clips, a table, deepest
    first. With --clips, --error-bound and the --body of a learned model, frames that its predictor
    is sure are free are not checked.
    """
    choose_device(device, note)
    from lcollision_core.files import require_writable
    from lcollision_core.tasks.checking import (
        CheckRequest,
        check_clips,
        check_mesh,
        write_clips_table,
    )
    from lcollision_core.tasks.inputs import holds_motion, mesh_files_of, motion_files_of

    as_clips = [clips or holds_motion(path) for path in meshes]
    if not any(as_clips):
        refuse_given(context, _OF_CLIPS, "is for motions", "add --clips, or leave it out")
    request = CheckRequest(
        options,
        rest,
        no_rules,
        clearance,
        touch_entries(touch, clearance),
        choice,
        body,
        error_bound,
        scene,
        joints,
    )
    if table is not None:
        require_writable(table)
    if not all(as_clips):
        # Raise its errors before any file is read.
        _ = request.rest_mesh
    verdicts: list[CheckedMesh | CheckedClip] = []
    failed = False
    with cancel_on_interrupt() as job:
        files = [
            (file, of_clips)
            for path, of_clips in zip(meshes, as_clips, strict=True)
            for file in (motion_files_of if of_clips else mesh_files_of)([path], job)
        ]
        for path, of_clips in files:
            try:
                with progress_bar("Checking frames" if of_clips else _TASK, job) as part:
                    of_file = (
                        check_clips(path, request, part)
                        if of_clips
                        else [check_mesh(path, request, part)]
                    )
            except LCollisionError as error:
                note(str(error))
                failed = True
                continue
            verdicts += of_file
            for verdict in () if as_json else of_file:
                tell(
                    checked_clip_text(verdict)
                    if isinstance(verdict, CheckedClip)
                    else checked_mesh_text(verdict)
                )
    checked_clips = [verdict for verdict in verdicts if isinstance(verdict, CheckedClip)]
    meshes_collide = [v.colliding for v in verdicts if not isinstance(v, CheckedClip)]
    if as_json:
        print_json([verdict.to_json() for verdict in verdicts])
    else:
        if len(meshes_collide) > 1:
            tell(f"{sum(meshes_collide)} of {len(meshes_collide)} meshes collide")
        if len(checked_clips) > 1:
            for line in checked_clip_table(checked_clips):
                tell(line)
    if table is not None:
        write_clips_table(table, checked_clips)
    if failed:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    if any(verdict.colliding for verdict in verdicts):
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)
