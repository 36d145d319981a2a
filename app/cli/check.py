"""``lcollision check``: the exact self-collisions of mesh files."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import ExitStatus, JsonOption, note, print_json, progress_bar, tell
from app.cli.contact_options import (
    ClearanceOption,
    NoRulesOption,
    RestOption,
    TouchOption,
    with_rest,
    with_touching,
)
from app.cli.inputs import ErrorBoundOption, MeshesArgument, expanded
from app.cli.motion import check_clips, clip_sentence, csv_of
from app.cli.motion_folder import motion_files
from app.cli.options import refuse_given, takes_options
from app.wording import counted, least_distance_words, share_text
from lcollision_core.errors import LCollisionError
from lcollision_core.options import MotionChoice, RuleOptions

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from lcollision_core.bodies import RigBody
    from lcollision_core.files import Mesh
    from lcollision_core.meshes import FaceGroup, Topology

_NO_OPTIONS, _ALL_MOTIONS = RuleOptions(), MotionChoice()

_DEEPEST = 100
"""Most pairs of faces that are listed one by one."""

_OF_CLIPS = ("clip", "fps", "substeps", "continuous", "body", "table", "error_bound")
"""Options of motions alone."""


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
            "--clips", help="Check every frame of the files' motions, and poses between frames."
        ),
    ] = False,
    choice: MotionChoice = _ALL_MOTIONS,
    body: Annotated[
        str | None,
        typer.Option(
            metavar="M",
            help="Character or model to animate; needed for .bvh, .vrma and .json files and "
            "SMPL motions.",
        ),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option("--csv", metavar="FILE", help="Also write a row for each colliding frame."),
    ] = None,
    error_bound: ErrorBoundOption = 0.0,
    as_json: JsonOption = False,
) -> None:
    """Find the exact self-collisions of any triangle mesh.

    A pose of a character that was exported from here, or that was opened before, is checked by
    that character's contact rules. With --clips, motions are checked: the clips of characters and
    other animated files, point caches with their mesh beside them, and, with --body, BVH and VRMA
    files, poses, and .npz files of SMPL, SMPL-H and SMPL-X (as of AMASS), whose body is the .npz
    file of that model. Exits with 0 if no mesh has collisions, with 1 if any has.

    With --clearance, faces collide as soon as they are nearer than that. Without a rest pose, faces
    joined by an edge, or by at most four clearances along the surface, count only if they
    penetrate.

    With --clips, --error-bound and the --body of a learned model, frames that its predictor is
    sure are free are not checked.
    """
    if clips:
        screen = partial(
            check_clips,
            choice=choice,
            rules=options,
            body=body,
            clearance=clearance,
            touch=touch or (),
            error_bound=error_bound,
            rest=rest,
            no_rules=no_rules,
        )
        _check_clips(meshes, screen, table, as_json=as_json)
        return
    refuse_given(context, _OF_CLIPS, "is for motions", "add --clips, or leave it out")
    from lcollision_core.files import read_mesh

    if options.rest_exclusion is not None and rest is None:
        raise LCollisionError("--rest-exclusion needs a rest pose", "give one with --rest MESH")
    rest_mesh = None if rest is None else read_mesh(rest)
    if rest is not None:
        options = with_rest(options)
    reports: list[dict[str, Any]] = []
    failed = False
    for path in expanded(meshes):
        try:
            report = check_mesh(path, options, rest_mesh, clearance, touch or (), no_rules=no_rules)
        except LCollisionError as error:
            note(str(error))
            failed = True
            continue
        reports.append(report)
        if not as_json:
            tell(_sentence(report))
    if as_json:
        print_json(reports)
    if failed:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    if any(report["colliding"] for report in reports):
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


def _check_clips(
    files: Sequence[Path],
    screen: Callable[[Path], list[dict[str, Any]]],
    table: Path | None,
    *,
    as_json: bool,
) -> None:
    from lcollision_core.files import require_writable
    from lcollision_core.files.safe import atomic_write

    if table is not None:
        require_writable(table)
    reports: list[dict[str, Any]] = []
    failed = False
    for path in _motions_of(files):
        try:
            of_file = screen(path)
        except LCollisionError as error:
            note(str(error))
            failed = True
            continue
        reports += of_file
        if not as_json:
            for report in of_file:
                tell(clip_sentence(report))
    if as_json:
        print_json(reports)
    if table is not None:
        with atomic_write(table) as file:
            file.write(csv_of(reports).encode())
    if failed:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    if any(report["colliding"] for report in reports):
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


def _motions_of(files: Sequence[Path]) -> list[Path]:
    """Replace each folder by its files of motions."""
    found: list[Path] = []
    for path in files:
        listed = motion_files(path) if path.is_dir() else [path]
        if not listed:
            raise LCollisionError(
                "contains no motion", "leave out --clips, or name files", where=path
            )
        found += listed
    return found


def check_mesh(
    path: Path,
    options: RuleOptions = _NO_OPTIONS,
    rest: Mesh | None = None,
    clearance: float = 0.0,
    touch: Sequence[str] = (),
    *,
    no_rules: bool = False,
) -> dict[str, Any]:
    """Check one file; the keys are those of ``lcollision check --json``."""
    from lcollision_core.contact import DISTANCE_BOUND, STRICT, CollisionDetector
    from lcollision_core.errors import MeshFileError, ShapeError
    from lcollision_core.files import audit_mesh, read_mesh

    start = time.perf_counter()
    mesh = read_mesh(path, topology=None if rest is None else rest.topology)
    if rest is not None and rest.topology != mesh.topology:
        raise MeshFileError(
            "does not have the faces of the rest pose", "name a rest pose of this mesh", where=path
        )
    for remark in (*mesh.notes, *audit_mesh(mesh.topology, mesh.vertices)):
        note(f"{path}: {remark}")
    known = None if no_rules or rest is not None else _known(path, mesh)
    try:
        if known is not None:
            body, vertices = known[0].with_options(options).with_touching(touch), known[1]
            rules, detector, topology = body.rules, body.detector, body.topology
        else:
            vertices, topology = mesh.vertices, mesh.topology
            named = _groups(path, topology) if options.name_groups or touch else ()
            groups = named if options.name_groups else ()
            rules, groups = options.applied(STRICT, groups, topology)
            reference = vertices if rest is None else rest.vertices
            detector = CollisionDetector(topology, reference, rules, groups)
            detector = with_touching(detector, touch, named)
        rest_is_known = known is not None or rest is not None
        detector = detector.with_clearance(clearance, rest_is_known=rest_is_known)
        nearest = None
        with progress_bar("Finding self-collisions") as job:
            if clearance > 0.0:
                bound = max(DISTANCE_BOUND, clearance)
                nearest = detector.least_distance(vertices, bound, rest_is_known=rest_is_known)
            found = detector.summarise(vertices, n_deepest=_DEEPEST, job=job)
    except ShapeError as error:
        raise MeshFileError.because(path, "cannot be checked", error) from error
    if found.n_coincident_pairs:
        pairs = counted(
            found.n_coincident_pairs, "pair of faces coincides", "pairs of faces coincide"
        )
        note(f"{path}: {pairs}; touching is not a collision")
    return {
        "file": str(path),
        "vertices": topology.n_vertices,
        "faces": topology.n_faces,
        "watertight": topology.is_watertight,
        "pairs": found.n_pairs,
        "near_pairs": found.excluded.near,
        "excluded_pairs": found.excluded.to_json(),
        "rules": rules.to_json(),
        "rules_of": None if known is None else known[0].name,
        "coincident_pairs": found.n_coincident_pairs,
        "deepest": [
            {"faces": faces, "depth": depth}
            for faces, depth in zip(
                found.pairs.tolist(), found.penetration_depth.tolist(), strict=True
            )
        ],
        "clearance": clearance,
        "least_distance": nearest and nearest.distance,
        "least_at": nearest
        and {"faces": nearest.faces.tolist(), "points": nearest.points.tolist()},
        "energy": found.energy,
        "colliding": found.colliding,
        "seconds": time.perf_counter() - start,
    }


def _groups(path: Path, topology: Topology) -> tuple[FaceGroup, ...]:
    """Return the meshes and materials that a file of a scene names, if its faces are these."""
    from lcollision_core.files.scene.joined import join_parts
    from lcollision_core.files.scene_files import SCENE_SUFFIXES, read_scene

    if path.suffix.lower() not in SCENE_SUFFIXES:
        return ()
    joined = join_parts(read_scene(path))
    return joined.groups if joined.topology == topology else ()


def _known(path: Path, mesh: Mesh) -> tuple[RigBody, npt.NDArray[np.float64]] | None:
    """Return the character of a mesh file, with its rules, and the pose; None for none."""
    from lcollision_core.bodies import character_of_mesh

    try:
        return character_of_mesh(path, mesh)
    except LCollisionError as error:
        note(f"{error}; all pairs are counted")
        return None


def _sentence(report: dict[str, Any]) -> str:
    from lcollision_core.meshes import ContactRules

    if report["clearance"] > 0.0:
        pairs = counted(report["pairs"], "pair of faces", "pairs of faces")
        verdict = (
            f"{pairs if report['colliding'] else 'no faces'} nearer than "
            f"{share_text(report['clearance'])}, "
            f"{least_distance_words(report['least_distance'], report['clearance'])}"
        )
    elif report["colliding"]:
        verdict = (
            f"colliding, {counted(report['pairs'], 'pair of faces', 'pairs of faces')}, "
            f"normalised energy {report['energy']:.3g}"
        )
    else:
        verdict = "no collisions"
    if not_counted := ContactRules.from_json(report["rules"]).sentence(report["excluded_pairs"]):
        verdict += f"; {not_counted}"
    if report["rules_of"] is not None:
        verdict += f", by the contact rules of {report['rules_of']} (--no-rules counts all pairs)"
    return (
        f"{report['file']}: {verdict} "
        f"({counted(report['vertices'], 'vertex', 'vertices')}, "
        f"{counted(report['faces'], 'face')}, {report['seconds']:.2f} s)"
    )
