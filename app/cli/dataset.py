"""``lcollision dataset``: check a pose set, or make one of a character or the built-in body."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer

from app.cli.console import ExitStatus, JsonOption, note, print_json, progress_bar, tell
from app.cli.contacts import rules_sentence
from app.cli.options import Axis, PoseSetArgument, refuse_given, takes_options
from lcollision_core.errors import LCollisionError
from lcollision_core.options import NO_CHANGE, RuleOptions
from lcollision_core.tasks.words import counted, say_number, up_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lcollision_core.contact import ContactRules, ProposedPair
    from lcollision_core.files import PoseSet

_MOST_POSES_ASKED = 50
"""Maximum number of evenly spaced poses in which contacts between groups are looked for."""

_MOST_BY_RIG = 10_000

_LISTED = 5
"""Maximum number of proposed pairs of groups that are listed."""

_Body = Literal["body", "body-swing", "body-jump"]
_BODIES: dict[str, _Body] = {kind: kind for kind in get_args(_Body)}

app = typer.Typer(
    help="Check a pose set, or make one of a character or the built-in body.", no_args_is_help=True
)


@app.command("check")
@takes_options
def check(path: PoseSetArgument, options: RuleOptions, as_json: JsonOption = False) -> None:
    """Report the topology, size, defects and self-collisions of a pose set.

    Exits with 1 if the set cannot be trained on: a pose is unusable, or a face of the first has
    no area.
    """
    from lcollision_core.contact import CollisionDetector, RuleCounts, propose_by_kind
    from lcollision_core.errors import MeshFileError, ShapeError
    from lcollision_core.files import inspect_pose_set
    from lcollision_core.meshes import degenerate_faces, groups_by_kind
    from lcollision_core.tasks.inputs import with_rules

    with progress_bar("Reading poses") as job:
        inspection = inspect_pose_set(path, job)
    poses = inspection.pose_set
    if poses is None:
        raise inspection.defects[0]
    for remark in poses.notes:
        note(f"{path}: {remark}")
    poses = with_rules(poses, path, options)
    rules = poses.rules
    try:
        detector = CollisionDetector(poses.topology, poses.vertices[0], rules, poses.groups)
        with progress_bar("Finding self-collisions") as job:
            collisions = detector.detect_batch(poses.vertices, job=job)
    except ShapeError as error:
        raise MeshFileError.because(path, "cannot be checked", error) from error
    sampled_poses = poses.vertices[:: -(-len(poses) // _MOST_POSES_ASKED)]
    kinds = groups_by_kind(poses.groups, poses.topology, poses.vertex_labels)
    found_by_kind = propose_by_kind(detector, sampled_poses, kinds)
    proposed = [pair for kind in found_by_kind.values() for pair in kind]
    guess = poses.up
    report: dict[str, Any] = {
        "poses": inspection.n_found,
        "vertices": poses.topology.n_vertices,
        "faces": poses.topology.n_faces,
        "same_topology": inspection.same_topology,
        "watertight": poses.topology.is_watertight,
        "colliding_poses": int(collisions.colliding.sum()),
        "problems": list(inspection.problems),
        "near_exclusion": rules.near_exclusion,
        "rules": rules.to_json(),
        "excluded_at_rest": RuleCounts(*collisions.n_excluded[0].tolist()).to_json(),
        "proposed_ignored": [
            {"groups": list(pair.groups), "share": pair.share} for pair in proposed
        ],
        "up_axis": "xyz"[guess.axis],
        "up_is_sure": guess.is_sure,
        "colliding": [
            {
                "pose": poses.names[pose],
                "pairs": int(collisions.n_pairs[pose]),
                "near_pairs": int(collisions.n_near_pairs[pose]),
                "excluded_pairs": RuleCounts(*collisions.n_excluded[pose].tolist()).to_json(),
                "energy": float(collisions.vertex_energy[pose].sum()),
            }
            for pose in collisions.colliding.nonzero()[0]
        ],
    }
    if as_json:
        print_json(report)
    else:
        _print(path, report, up_text(guess))
        if not rules.exclude_nothing:
            tell(f"  {rules_sentence(rules, report['excluded_at_rest'])}")
        _print_proposed(proposed, rules)
        if not guess.is_sure:
            note("`train embedding` uses it unless --up x|y|z is given")
    flat = degenerate_faces(poses.topology, poses.vertices[0])
    if len(poses) < inspection.n_found or len(flat):
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


def _print_proposed(proposed: Sequence[ProposedPair], rules: ContactRules) -> None:
    """List groups that are nearly always in contact, and the option that ignores them."""
    ignored_pairs = {frozenset(pair) for pair in rules.ignored}
    new = [pair for pair in proposed if frozenset(pair.groups) not in ignored_pairs]
    for pair in new[:_LISTED]:
        first, second = pair.groups
        tell(
            f"  {first} and {second} are in contact in {100.0 * pair.share:.0f} % of the poses; "
            f'--ignore "{first}:{second}" leaves them out'
        )
    if len(new) > _LISTED:
        tell(f"  and {len(new) - _LISTED} more pairs of groups, see --json")


def _print(path: Path, report: dict[str, Any], up: str) -> None:
    surface = "watertight" if report["watertight"] else "not watertight"
    tell(
        f"{path}: {counted(report['poses'], 'pose', 'poses')} of {report['vertices']} vertices and "
        f"{report['faces']} faces, {surface}"
    )
    typer.echo(f"  {up}")
    for problem in report["problems"]:
        tell(f"  problem: {problem}")
    n_colliding = report["colliding_poses"]
    tell(f"  {counted(n_colliding, 'pose intersects itself', 'poses intersect themselves')}")
    for pose in report["colliding"]:
        tell(
            f"    {pose['pose']}: {counted(pose['pairs'], 'pair', 'pairs')}, "
            f"normalised energy {pose['energy']:.3g}"
        )


@app.command("make")
@takes_options
def make(
    context: typer.Context,
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="KIND|FILE...",
            help="body, body-swing or body-jump; or files of one character with animations (GLB, "
            "glTF, VRM, FBX), point caches (PC2, MDD) beside their mesh, folders of meshes, pose "
            "sets.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT.npz", help="The file to write.")
    ],
    n_vertices: Annotated[
        int | None,
        typer.Option(
            "--vertices", min=500, max=12000, metavar="N", help="Vertices of the built-in body."
        ),
    ] = None,
    by_rig: Annotated[
        int | None,
        typer.Option(
            "--by-rig",
            min=1,
            max=_MOST_BY_RIG,
            metavar="N",
            help="Add N random poses of a character's rig within human limits, free of "
            "collisions where possible; near-duplicates of the files' own poses are left "
            "out.",
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            metavar="S",
            help="For the built-in body, 0 gives the authored poses and other seeds vary them; "
            "for --by-rig, the same seed gives the same poses.",
        ),
    ] = 0,
    clip: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="The animation to read. Default: all."),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            max=1000.0,
            metavar="X",
            help="Frames per second. Default: the animation's keys, at most 30 a second.",
        ),
    ] = None,
    up: Annotated[
        Axis | None,
        typer.Option(help="The up axis. Default: what the files say, else a guess."),
    ] = None,
    *,
    rules: RuleOptions,
) -> None:
    """Make a pose set of the built-in body, or of a character's animations and its rig."""
    from lcollision_core.files import write_pose_set
    from lcollision_core.tasks.exporting import require_output

    require_output(output, ".npz")
    kind = _BODIES.get(sources[0])
    if kind is not None:
        if len(sources) > 1:
            raise LCollisionError(
                f"{kind} can't be combined with other sources",
                "name it alone",
                got=", ".join(sources),
            )
        why = f"applies to files, not to {kind}"
        refuse_given(context, ("clip", "fps", "up", "by_rig"), why, "leave it out")
        if rules != NO_CHANGE:
            raise LCollisionError("contact rules apply only to files", "leave their options out")
        from lcollision_core.built_in_body import make_body

        with progress_bar("Posing the body") as job:
            poses = make_body(kind, n_vertices=n_vertices, seed=seed, job=job)
    else:
        refuse_given(context, ("n_vertices",), "applies only to the built-in body", "leave it out")
        if by_rig is None:
            why = "applies only to the built-in body and to poses by the rig"
            refuse_given(context, ("seed",), why, "leave it out, or add --by-rig N")
        poses = _gathered(sources, clip, fps, up, by_rig, seed, rules)
    write_pose_set(output, poses)
    note(f"wrote {len(poses)} poses of {poses.topology.n_vertices} vertices to {output}")


def _gathered(
    sources: list[str],
    clip: str | None,
    fps: float | None,
    up: Axis | None,
    by_rig: int | None,
    seed: int,
    rules: RuleOptions,
) -> PoseSet:
    from lcollision_core.tasks.sources import gather_poses

    with progress_bar("Reading poses" if by_rig is None else "Posing the character") as job:
        poses = gather_poses(
            sources,
            by_rig=by_rig or 0,
            clip=clip,
            fps=fps,
            up=None if up is None else "xyz".index(up),
            seed=seed,
            thin=by_rig is not None,
            rules=rules,
            job=job,
        )
    for remark in poses.notes:
        note(f"{sources[0]}: {remark}")
    if by_rig is not None:
        drawn = poses.provenance["sources"][-1]["by_rig"]
        note(
            say_number(
                drawn["free"],
                "{n} of {poses} by the rig is free of collisions",
                "{n} of {poses} by the rig are free of collisions",
                poses=counted(drawn["drawn"], "pose", "poses"),
            )
        )
    if not (guess := poses.up).is_sure:
        note(f"{up_text(guess)}; --up x|y|z overrides it")
    return poses
