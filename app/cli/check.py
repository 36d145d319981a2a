"""``lcollision check``: the exact self-collisions of mesh files."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from app.cli.console import ExitStatus, JsonOption, note, print_json, progress_bar, tell
from app.cli.contact_options import (
    IgnoreOption,
    NearExclusionOption,
    RestExclusionOption,
    RestOption,
    RuleOptions,
    ToleratedDepthOption,
)
from app.cli.inputs import MeshesArgument, expanded
from app.wording import counted
from lcollision_core.errors import LCollisionError

if TYPE_CHECKING:
    from lcollision_core.meshes import Mesh

_NO_OPTIONS = RuleOptions()

_DEEPEST = 100
"""Most pairs of faces that are listed one by one."""


def check(
    meshes: MeshesArgument,
    as_json: JsonOption = False,
    near_exclusion: NearExclusionOption = None,
    rest: RestOption = None,
    rest_exclusion: RestExclusionOption = None,
    ignore: IgnoreOption = None,
    tolerated_depth: ToleratedDepthOption = None,
) -> None:
    """Find the exact self-collisions of any triangle mesh.

    Exits with 0 when all meshes are free of them, with 1 when one is not.
    """
    from lcollision_core.meshes import read_mesh
    from lcollision_core.meshes.contact_rules import CHARACTER_REST_EXCLUSION

    if rest_exclusion is not None and rest is None:
        raise LCollisionError("--rest-exclusion needs a rest pose", "name it with --rest MESH")
    rest_mesh = None if rest is None else read_mesh(rest)
    if rest is not None and rest_exclusion is None:
        rest_exclusion = CHARACTER_REST_EXCLUSION
    options = RuleOptions(near_exclusion, rest_exclusion, ignore, tolerated_depth)
    reports: list[dict[str, Any]] = []
    failed = False
    for path in expanded(meshes):
        try:
            report = check_mesh(path, options, rest_mesh)
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


def check_mesh(
    path: Path, options: RuleOptions = _NO_OPTIONS, rest: Mesh | None = None
) -> dict[str, Any]:
    """Check one file; the keys are those of ``lcollision check --json``."""
    from lcollision_core.contact import STRICT, CollisionDetector
    from lcollision_core.errors import MeshFileError, ShapeError
    from lcollision_core.meshes import audit_mesh, read_mesh

    start = time.perf_counter()
    mesh = read_mesh(path)
    if rest is not None and rest.topology != mesh.topology:
        raise MeshFileError(
            "has other faces than the rest pose", "name a rest pose of this mesh", where=path
        )
    for remark in (*mesh.notes, *audit_mesh(mesh.topology, mesh.vertices)):
        note(f"{path}: {remark}")
    try:
        rules, groups = options.applied(STRICT, (), mesh.topology)
        reference = mesh.vertices if rest is None else rest.vertices
        detector = CollisionDetector(mesh.topology, reference, rules, groups)
        with progress_bar("Finding self-collisions") as progress:
            found = detector.summarise(mesh.vertices, n_deepest=_DEEPEST, progress=progress)
    except ShapeError as error:
        raise MeshFileError.because(path, "cannot be checked", error) from error
    if found.n_coincident_pairs:
        pairs = counted(found.n_coincident_pairs, "pair of faces lies", "pairs of faces lie")
        note(f"{path}: {pairs} exactly on each other; touching is no collision")
    return {
        "file": str(path),
        "vertices": mesh.topology.n_vertices,
        "faces": mesh.topology.n_faces,
        "watertight": mesh.topology.is_watertight,
        "pairs": found.n_pairs,
        "near_pairs": found.excluded.near,
        "excluded_pairs": found.excluded.to_json(),
        "rules": rules.to_json(),
        "coincident_pairs": found.n_coincident_pairs,
        "deepest": [
            {"faces": faces, "depth": depth}
            for faces, depth in zip(
                found.deepest_pairs.tolist(), found.deepest_depth.tolist(), strict=True
            )
        ],
        "energy": found.energy,
        "colliding": found.colliding,
        "seconds": time.perf_counter() - start,
    }


def _sentence(report: dict[str, Any]) -> str:
    from lcollision_core.meshes import ContactRules

    if report["colliding"]:
        verdict = (
            f"colliding, {counted(report['pairs'], 'pair of faces', 'pairs of faces')}, "
            f"normalised energy {report['energy']:.3g}"
        )
    else:
        verdict = "no collisions"
    if not_counted := ContactRules.from_json(report["rules"]).sentence(report["excluded_pairs"]):
        verdict += f"; {not_counted}"
    return (
        f"{report['file']}: {verdict} "
        f"({counted(report['vertices'], 'vertex', 'vertices')}, "
        f"{counted(report['faces'], 'face')}, {report['seconds']:.2f} s)"
    )
