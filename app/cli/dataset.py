"""``lcollision dataset``: check a pose set, or make one of the built-in body."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from app.cli.console import ExitStatus, JsonOption, note, print_json, progress_bar, tell
from app.cli.inputs import NearExclusionOption, PoseSetArgument, up_sentence
from app.wording import counted

app = typer.Typer(help="Check a pose set, or make one of the built-in body.", no_args_is_help=True)


@app.command("check")
def check(
    path: PoseSetArgument,
    as_json: JsonOption = False,
    near_exclusion: NearExclusionOption = None,
) -> None:
    """Report the topology, size, defects and self-collisions of a pose set.

    Exits with 1 when the set cannot be trained on as it is: a pose is unusable, or a face of
    the first has no area.
    """
    from lcollision_core.contact import CollisionDetector, ContactRules
    from lcollision_core.errors import MeshFileError, ShapeError
    from lcollision_core.meshes import degenerate_faces, inspect_pose_set

    with progress_bar("Reading poses") as progress:
        inspection = inspect_pose_set(path, progress)
    poses = inspection.pose_set
    if poses is None:
        raise inspection.defects[0]
    for remark in poses.notes:
        note(f"{path}: {remark}")
    exclusion = poses.near_exclusion if near_exclusion is None else near_exclusion
    try:
        detector = CollisionDetector(poses.topology, poses.vertices[0], ContactRules(exclusion))
        with progress_bar("Finding self-collisions") as progress:
            found = detector.detect_batch(poses.vertices, progress=progress)
    except ShapeError as error:
        raise MeshFileError.because(path, "cannot be checked", error) from error
    guess = poses.up
    report: dict[str, Any] = {
        "poses": inspection.n_found,
        "vertices": poses.topology.n_vertices,
        "faces": poses.topology.n_faces,
        "same_topology": inspection.same_topology,
        "watertight": poses.topology.is_watertight,
        "colliding_poses": int(found.colliding.sum()),
        "problems": list(inspection.problems),
        "near_exclusion": exclusion,
        "up_axis": "xyz"[guess.axis],
        "up_is_sure": guess.is_sure,
        "colliding": [
            {
                "pose": poses.names[pose],
                "pairs": int(found.n_pairs[pose]),
                "near_pairs": int(found.n_near_pairs[pose]),
                "energy": float(found.vertex_energy[pose].sum()),
            }
            for pose in found.colliding.nonzero()[0]
        ],
    }
    if as_json:
        print_json(report)
    else:
        _print(path, report, up_sentence(guess))
        if not guess.is_sure:
            note("`train embedding` takes that, unless --up x|y|z says otherwise")
    flat = degenerate_faces(poses.topology, poses.vertices[0])
    if len(poses) < inspection.n_found or len(flat):
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


def _print(path: Path, report: dict[str, Any], up: str) -> None:
    surface = "watertight" if report["watertight"] else "not watertight"
    tell(
        f"{path}: {counted(report['poses'], 'pose')} of {report['vertices']} vertices and "
        f"{report['faces']} faces, {surface}"
    )
    typer.echo(f"  {up}")
    for problem in report["problems"]:
        tell(f"  problem: {problem}")
    n_colliding = report["colliding_poses"]
    tell(f"  {counted(n_colliding, 'pose intersects itself', 'poses intersect themselves')}")
    for pose in report["colliding"]:
        tell(
            f"    {pose['pose']}: {counted(pose['pairs'], 'pair')}, "
            f"normalised energy {pose['energy']:.3g}"
        )


@app.command("make")
def make(
    kind: Annotated[
        Literal["body", "body-swing", "body-jump"],
        typer.Argument(metavar="KIND", help="Which pose set to make."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT.npz", help="The file to write.")
    ],
    n_vertices: Annotated[
        int | None,
        typer.Option("--vertices", min=500, max=12000, metavar="N", help="Vertices of the mesh."),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, metavar="S", help="0 gives the authored poses, others vary them.")
    ] = 0,
) -> None:
    """Make a pose set of the built-in body: 71 poses, a swing dance, or a jump."""
    from lcollision_core.errors import MeshFileError
    from lcollision_core.meshes import require_writable, write_pose_set
    from lcollision_core.meshes.body import make_body

    if output.suffix.lower() != ".npz":
        raise MeshFileError.unwritable(output, "a pose set is an .npz file", "rename it")
    require_writable(output)
    with progress_bar("Posing the body") as progress:
        poses = make_body(kind, n_vertices=n_vertices, seed=seed, progress=progress)
    write_pose_set(output, poses)
    note(f"wrote {len(poses)} poses of {poses.topology.n_vertices} vertices to {output}")
