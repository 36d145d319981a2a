"""``lcollision resolve``: the nearest poses that are free of self-collisions, proved exactly."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import ExitStatus, note, print_json, progress_bar, tell
from app.cli.inputs import ScaleOption, cannot_encode, expanded
from app.cli.interrupt import cancel_on_interrupt
from app.cli.models import ModelArgument
from app.cli.results import (
    MeshFormat,
    Output,
    OutputForm,
    WrittenPoses,
    note_near_exclusion,
    output_named,
    require_format_holds,
    require_one_mesh,
    write_result,
)
from app.cli.unfinished import UnfinishedPoses, unfinished_poses
from app.wording import counted, fit_error
from lcollision_core.errors import LCollisionError, ModelFileError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from lcollision_core.model import NamedPose, PoseModel
    from lcollision_core.resolve import ResolveOptions, ResolveResult

_Detailed = Mapping[int, "npt.NDArray[np.float64]"]
"""Meshes with what encoding lost of them, (V, 3), by the place of their request."""

_FIELDS = (
    "solver_status",
    "predicted_free",
    "exactly_free",
    "step",
    "energy_before",
    "energy_after",
    "pairs_before",
    "pairs_after",
    "latent_distance",
    "vertex_distance_mean",
    "vertex_distance_max",
    "iterations",
    "evaluations",
    "seconds",
)


@dataclass(frozen=True, eq=False)
class _Request:
    """One pose to resolve: where it came from, and the mesh that it was encoded from or None."""

    source: str
    pose: NamedPose
    mesh: npt.NDArray[np.float64] | None = None


def resolve(
    model_name: ModelArgument,
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="POSES|MESH...",
            readable=False,
            help="Files of poses, or meshes to encode, or folders of meshes.",
        ),
    ],
    output: Annotated[
        str,
        typer.Option(
            "--output",
            "-o",
            metavar="OUT",
            help="A .json file, a mesh file for one pose, a folder for several.",
        ),
    ],
    solver: Annotated[
        str, typer.Option(metavar="NAME", help="sqp, auglag (the paper's), slsqp or ccsaq.")
    ] = "sqp",
    metric: Annotated[
        str, typer.Option(metavar="eye|latent", help="What is kept small: moves seen, or codes.")
    ] = "eye",
    threshold: Annotated[
        float,
        typer.Option(metavar="P", help="Probability up to which a pose is predicted free."),
    ] = 0.5,
    margin: Annotated[
        float | None,
        typer.Option(metavar="X", help="How far below the threshold's logit to go at first."),
    ] = None,
    lock: Annotated[
        list[str] | None,
        typer.Option(metavar="DOMAIN", help="A domain, by name or number, that keeps its codes."),
    ] = None,
    weight: Annotated[
        list[str] | None,
        typer.Option(metavar="DOMAIN=W", help="Let a move of this domain cost W times as much."),
    ] = None,
    sequence: Annotated[
        bool, typer.Option("--sequence", help="The poses are frames of a motion, in order.")
    ] = False,
    keep_detail: Annotated[
        bool,
        typer.Option("--keep-detail", help="Give meshes back what encoding lost, if still free."),
    ] = False,
    scale: ScaleOption = 1.0,
    no_verify: Annotated[
        bool, typer.Option("--no-verify", help="Stop at the solver's answer, unchecked.")
    ] = False,
    time_budget: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="For each pose, then straight to the last step."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=1024, metavar="N", help="Threads. Default: one for each core."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="S", help="Of the solver's starts.")] = 0,
    mesh_format: Annotated[
        MeshFormat, typer.Option("--format", help="Of the meshes in a folder.")
    ] = MeshFormat.OBJ,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list.")] = False,
) -> None:
    """Move poses to the nearest ones that are free of self-collisions.

    Exits with 0 when every pose ends free by the exact check (with --no-verify: by the
    prediction), with 1 when one does not. A pose that is free already comes back unchanged. Of a
    mesh, what comes back is its nearest pose; --keep-detail adds what that lacks. What is done
    when it is stopped is kept in a file beside the output, and the same command goes on from there.

    What freed a pose is told as a step: solver, the paper's problem; margin, the same with more
    distance from collision; polish, of shallow contacts; start, from elsewhere; walk-back, towards
    a pose known to be free; neighbour, the correction of the frame before (--sequence).
    """
    import numpy as np

    from lcollision_core.model import PoseModel
    from lcollision_core.resolve import ResolveOptions, largest_correction_change

    model = PoseModel.load(model_name)
    options = ResolveOptions(
        solver=solver,
        metric=metric,
        threshold=threshold,
        margin=margin,
        locked_domains=frozenset(_domain(model, name) for name in lock or ()),
        group_weights=_group_weights(model, weight or ()),
        time_budget=time_budget,
        verify=not no_verify,
        seed=seed,
    )
    resolver = model.resolver
    target = output_named(output)
    if keep_detail and target.form is OutputForm.POSES:
        raise LCollisionError(
            f"{output} would hold codes, which have no room for --keep-detail; name a mesh or a "
            f"folder"
        )
    files = expanded(inputs)
    if len(files) > 1:
        require_one_mesh(target, len(files))
    requests, failed = _read(model, files, scale)
    if not requests:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    require_one_mesh(target, len(requests))
    require_format_holds(target, model, [request.pose for request in requests], mesh_format)
    with (
        unfinished_poses(
            target.path, model, *_depends_on(model, requests, options, sequence), len(requests)
        ) as unfinished,
        cancel_on_interrupt() as cancel,
    ):
        finished = _results(unfinished)

        def keep(place: int, result: ResolveResult) -> None:
            finished[place] = result
            pose = replace(requests[place].pose, latent=result.latent)
            unfinished.keep(place, pose, _facts(result))

        with progress_bar("Resolving poses") as progress:
            resolver.resolve_many(
                np.array([request.pose.latent for request in requests]),
                options,
                workers,
                progress,
                cancel,
                placements=[request.pose.placement for request in requests],
                sequence=sequence,
                done=dict(finished),
                keep=keep,
            )
        results = [finished[place] for place in range(len(requests))]
        detailed = _detailed(model, requests, results) if keep_detail else {}
        written = _write(target, model, requests, results, mesh_format, detailed)
    written.note()
    _report(model, requests, results, written.files, detailed, as_json)
    if sequence:
        before = np.array([request.pose.latent for request in requests])
        change = largest_correction_change(model.embedding, before, results)
        note(
            f"from frame to frame the correction changes by at most {100.0 * change:.3f} % of "
            f"the height, in the mean over vertices"
        )
    if failed:
        raise typer.Exit(ExitStatus.BAD_INPUT)
    if not all(_ended_free(result) for result in results):
        raise typer.Exit(ExitStatus.ANSWER_IS_NO)


def _ended_free(result: ResolveResult) -> bool:
    return result.predicted_free if result.exactly_free is None else result.exactly_free


def _domain(model: PoseModel, name: str) -> int:
    """Find a domain by its name, or by its number from 1."""
    names = [known.casefold() for known in model.domain_names]
    if name.casefold() in names:
        return names.index(name.casefold())
    if name.isdecimal() and 1 <= int(name) <= len(names):
        return int(name) - 1
    raise LCollisionError(
        f"{model.name} has no domain {name!r}; its domains are {', '.join(model.domain_names)}, "
        f"or 1 to {len(names)}"
    )


def _group_weights(model: PoseModel, wanted: Sequence[str]) -> tuple[float, ...] | None:
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
                f"--weight {entry!r} is not DOMAIN=W with a number W above 0, as in 'left arm=5'"
            )
        weights[1 + _domain(model, name)] = value
    return tuple(weights)


def _read(model: PoseModel, inputs: Sequence[Path], scale: float) -> tuple[list[_Request], bool]:
    """Read and encode what can be; say of each other input in a sentence why it cannot."""
    from lcollision_core.model import unique_names

    requests: list[_Request] = []
    failed = False
    with progress_bar("Reading poses") as progress:
        for done, path in enumerate(inputs):
            try:
                requests += _requests_of(model, path, scale)
            except LCollisionError as error:
                note(str(error))
                failed = True
            progress(done + 1, len(inputs))
    names = unique_names(request.pose.name for request in requests)
    named = [
        replace(request, pose=replace(request.pose, name=name))
        for request, name in zip(requests, names, strict=True)
    ]
    return named, failed


def _requests_of(model: PoseModel, path: Path, scale: float) -> Iterator[_Request]:
    from lcollision_core.meshes import read_mesh
    from lcollision_core.model import NamedPose, name_of_file, read_poses

    if path.suffix.lower() == ".json":
        poses = read_poses(path, model)
        if not poses:
            raise ModelFileError(f"{path} has no poses in it; name a file that has some")
        for pose in poses:
            yield _Request(f"{path}: {pose.name}", pose)
        return
    mesh = read_mesh(path, topology=model.topology)
    if mesh.coarseness:
        note(f"{path}: {mesh.coarseness}")
    model.require_topology(mesh.topology, str(path))
    try:
        encoded = model.encode(mesh.vertices, scale=scale)
    except LCollisionError as error:
        raise cannot_encode(path, error) from error
    pose = NamedPose.of_mesh(name_of_file(path), encoded)
    fit = fit_error(encoded.fit_error_mean, encoded.fit_error_max)
    note(f"{path} is encoded with a {fit}")
    yield _Request(str(path), pose, mesh.vertices)


def _depends_on(
    model: PoseModel, requests: Sequence[_Request], options: ResolveOptions, sequence: bool
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Return what the results follow from: arrays, and JSON values."""
    import numpy as np

    predictor = model.require_predictor().to_section()
    placed = [request.pose.placement for request in requests]
    frames = [
        [*p.rotation.ravel(), *p.translation, p.scale] if p else [np.nan] * 13 for p in placed
    ]
    arrays = {
        **{f"predictor/{name}": array for name, array in predictor.arrays.items()},
        "free": model.free_latent,
        "latent": np.array([request.pose.latent for request in requests]),
        "placement": np.array(frames),
    }
    locked = sorted(options.locked_domains)
    values = {
        "command": "resolve",
        **asdict(replace(options, locked_domains=frozenset())),
        "locked_domains": locked,
        "predictor": dict(predictor.metadata),
        "height": model.height,
        "near_exclusion": model.near_exclusion,
        "sequence": sequence,
    }
    return arrays, values


def _facts(result: ResolveResult) -> dict[str, Any]:
    """Return all of a result but its latent, as JSON values."""
    return {
        field.name: getattr(result, field.name)
        for field in fields(result)
        if field.name != "latent"
    }


def _results(unfinished: UnfinishedPoses) -> dict[int, ResolveResult]:
    """Return the results of an earlier run, by place."""
    from lcollision_core.resolve import ResolveResult, Step

    try:
        return {
            place: ResolveResult(pose.latent, **{**facts, "step": Step(facts["step"])})
            for place, (pose, facts) in unfinished.finished.items()
        }
    except (KeyError, TypeError, ValueError) as error:
        raise unfinished.damaged() from error


def _write(
    output: Output,
    model: PoseModel,
    requests: Sequence[_Request],
    results: Sequence[ResolveResult],
    mesh_format: MeshFormat,
    detailed: _Detailed,
) -> WrittenPoses:
    poses = [
        replace(request.pose, latent=result.latent)
        for request, result in zip(requests, results, strict=True)
    ]
    meshes = [detailed.get(place) for place in range(len(requests))]
    return write_result(output, model, poses, mesh_format, meshes)


def _detailed(
    model: PoseModel, requests: Sequence[_Request], results: Sequence[ResolveResult]
) -> _Detailed:
    """Return the fixed meshes that are free with what encoding lost of them, by place."""
    pairs = enumerate(zip(requests, results, strict=True))
    made = {place: _with_detail(model, request, result) for place, (request, result) in pairs}
    return {place: mesh for place, mesh in made.items() if mesh is not None}


def _with_detail(
    model: PoseModel, request: _Request, result: ResolveResult
) -> npt.NDArray[np.float64] | None:
    """Return the fixed mesh with what encoding lost of it, or None where that would collide."""
    import numpy as np

    from lcollision_core.resolve import ExactCheck

    placement = request.pose.placement
    if request.mesh is None or placement is None:
        return None
    before, after = model.decode(np.stack([request.pose.latent, result.latent]))
    # Where the pose did not move, only rounded.
    moved: npt.NDArray[np.float64] = request.mesh + (
        placement.apply(after) - placement.apply(before)
    )
    check = ExactCheck(model.embedding, model.detector, model.height, placement)
    if not check.is_free_mesh(moved):
        note(f"{request.source}: with its detail the fixed mesh would collide, so it has none")
        return None
    return moved


def _report(
    model: PoseModel,
    requests: Sequence[_Request],
    results: Sequence[ResolveResult],
    files: Sequence[Path],
    detailed: _Detailed,
    as_json: bool,
) -> None:
    rows: list[dict[str, Any]] = []
    for place, (request, result) in enumerate(zip(requests, results, strict=True)):
        if result.note:
            note(f"{request.source}: {result.note}")
        facts = {name: getattr(result, name) for name in _FIELDS}
        named = {"source": request.source, "output": str(files[place])}
        rows.append(named | facts | {"near_exclusion": model.near_exclusion})
        if not as_json:
            tell(f"{request.source}: {_sentence(request, result, place in detailed)}")
    if as_json:
        print_json(rows)
    else:
        note_near_exclusion(model)


def _sentence(request: _Request, result: ResolveResult, has_detail: bool) -> str:
    """Say what became of one pose; figures of a mesh are those of the pose nearest to it."""
    from lcollision_core.resolve import Step

    moved = (
        f"moved by {100.0 * result.vertex_distance_mean:.2f} % of the height, at most "
        f"{100.0 * result.vertex_distance_max:.1f} %"
    )
    pairs = result.pairs_before if result.exactly_free else result.pairs_after
    counted_pairs = counted(pairs or 0, "pair of faces", "pairs of faces")
    if result.exactly_free is None:
        verdict = "predicted free" if result.predicted_free else "still predicted to collide"
        said = [verdict, "not checked", moved]
    elif not result.exactly_free:
        said = ["still colliding", counted_pairs]
    elif result.step == Step.UNCHANGED:
        said = ["free as it is"]
    else:
        said = [f"freed of {counted_pairs}", f"exactly free, by the step {result.step!s}", moved]
    if has_detail:
        said.append("with its detail")
    elif request.mesh is not None:
        fit = f"{100.0 * (request.pose.fit_error_mean or 0.0):.2f} % of the height off"
        said.append(f"given back as its fit, {fit}")
    elif result.step == Step.UNCHANGED:
        said.append("unchanged")
    return f"{', '.join(said)} ({result.seconds:.2f} s)"
