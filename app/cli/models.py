"""``lcollision models``, ``info``, ``domains`` and ``upright``: models and their content."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import ExitStatus, JsonOption, note, print_json, tell
from app.cli.contacts import rules_json, rules_sentence
from app.cli.options import Axis, ModelArgument
from lcollision_core.errors import LCollisionError
from lcollision_core.tasks.words import counted, left_text, scores_text

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, LearnedBody

_ERRORS = ("level1_mean", "mean", "max", "held_out_mean", "held_out_max", "pca_held_out_mean")
_MASKS = ("connected_share", "domains_per_vertex")


def models(
    as_json: JsonOption = False,
) -> None:
    """List the bundled models and your own, with their metrics."""
    from lcollision_core.bodies import LearnedBody, list_models, user_models_folder

    reports, damaged = [], []
    for listed in list_models():
        try:
            report = describe(LearnedBody.load(listed.path))
        except LCollisionError as error:
            note(str(error))
            damaged.append(listed)
            continue
        reports.append(report | {"bundled": listed.bundled, "file": str(listed.path)})
    if as_json:
        print_json(reports)
    else:
        for report in reports:
            origin = _origin(report["bundled"])
            tell(f"{report['name']}: {_size_sentence(report)} ({origin})")
            tell(f"  {error_sentence(report)}")
            tell(f"  {_predictor_sentence(report)}")
        for listed in damaged:
            tell(f"{listed.name}: damaged ({_origin(listed.bundled)})")
        if not reports and not damaged:
            tell(
                f"there are no models yet; `lcollision new` makes one, and models in "
                f"{user_models_folder()} are listed here"
            )
    if damaged:
        raise typer.Exit(ExitStatus.BAD_INPUT)


def _origin(bundled: bool) -> str:
    return "bundled" if bundled else "your own"


def info(
    model_name: ModelArgument,
    as_json: JsonOption = False,
    figure: Annotated[
        Path | None,
        typer.Option(
            metavar="MASKS.png",
            help="Save a picture of the domains, darker where their weight is higher.",
        ),
    ] = None,
) -> None:
    """Show what a model, a character, a scene or a label store contains, and how exact a model is.

    Lengths are normalised.
    """
    from lcollision_core.tasks.opening import open_any

    if figure is not None:
        from lcollision_core.tasks.exporting import require_output

        require_output(figure, ".png")
    for describe_other, sentence in (
        (_being_learned, _learning_sentence),
        (_label_store, _label_store_sentence),
    ):
        other = None if figure is not None else describe_other(model_name)
        if other is not None:
            if as_json:
                print_json(other)
            else:
                tell(sentence(other))
            return
    model = open_any(model_name)
    report = describe(model)
    if figure is not None:
        from app.view.figures import draw_masks

        draw_masks(model, figure)
        note(f"saved a picture of the domains of {model.name} to {figure}")
    if as_json:
        print_json(report)
        return
    tell(f"{report['name']}: {_size_sentence(report)}")
    if model.is_trained:
        tell(f"  trained on {report['source']}, licence {report['licence']}")
        tell(f"  {error_sentence(report)}")
        tell(f"  {_predictor_sentence(report)}")
    else:
        tell(f"  posed by the joints of {report['source']}, without training")
    for remark in model.notes:
        tell(f"  {remark}")
    if not model.rules.exclude_nothing:
        tell(f"  {rules_sentence(model.rules, report['excluded_at_rest'])}")
    _print_domains(report)


def _being_learned(name_or_path: str) -> dict[str, Any] | None:
    """Return the progress of a model that `lcollision new` has begun, else None."""
    from lcollision_core.bodies.learned_body import user_models_folder, work_path
    from lcollision_core.files.formats import MODEL_SUFFIX

    path = Path(name_or_path)
    if len(path.parts) <= 1 and path.suffix != MODEL_SUFFIX:
        path = user_models_folder() / f"{path}{MODEL_SUFFIX}"
    try:
        if path.exists() or not work_path(path).is_dir():
            return None
    except OSError:  # In a folder that cannot be read, nothing is being learned.
        return None
    from lcollision_core.tasks.work_folder import WorkFolder

    work = WorkFolder(path)
    status, running = asdict(work.status), work.is_locked
    return {"name": work.name, "learning": {**status, "running": running}}


def _learning_sentence(report: dict[str, Any]) -> str:
    """Describe the progress of learning a model."""
    status = report["learning"]
    stage = f"{status['stage']} {100.0 * status['stage_done']:.0f} %"
    share = f"{100.0 * status['done']:.0f} % of all stages"
    if status["running"]:
        left = status["seconds_left"]
        more = "" if left is None else f", {left_text(left)}"
        return f"{report['name']}: is being learned: {stage}, {share}{more}"
    why = f": {status['sentence']}" if status["sentence"] else ""
    again = "run its command again to continue"
    return f"{report['name']}: its learning stopped at {stage}, {share}{why}; {again}"


def _label_store(path: str) -> dict[str, Any] | None:
    """Return the content of a label store; None if the path is not that of one."""
    if not Path(path).is_dir():
        return None
    import numpy as np

    from lcollision_core.bodies.learned_body import find_latent_space
    from lcollision_core.labels.labeller import measures
    from lcollision_core.labels.store import MANIFEST, LabelStore

    if not (Path(path) / MANIFEST).is_file():
        return None
    store = LabelStore.open(path)
    identity, n_rows = store.identity, store.n_rows
    model = find_latent_space(identity.model)
    return {
        "store": path,
        "model": None if model is None else model.name,
        "fingerprint": identity.model,
        "rows": n_rows,
        "held_out": int(measures(np.arange(n_rows), identity.draws).sum()),
        "seed": identity.seed,
        "draws": identity.draws.value,
        "rules": identity.rules.to_json(),
    }


def _label_store_sentence(report: dict[str, Any]) -> str:
    """Describe the content of a label store."""
    rows, held_out = report["rows"], report["held_out"]
    model = report["model"] or f"a model that is not listed ({report['fingerprint']})"
    return (
        f"{report['store']}: a label store that `lcollision label` made, "
        f"{counted(rows, 'row', 'rows')} of {model} ({report['draws']}, seed {report['seed']}), "
        f"{held_out} of them ({100.0 * held_out / max(rows, 1):.0f} %) held out to measure a "
        "predictor"
    )


def domains(
    model_name: ModelArgument,
    names: Annotated[
        list[str] | None,
        typer.Option("--name", metavar="K=NAME", help="Rename domain K (from 1) to NAME."),
    ] = None,
    roles: Annotated[
        list[str] | None,
        typer.Option(
            "--role",
            metavar="JOINT=ROLE",
            help="Set the role of a character's joint, such as knee-left; auto resets it.",
        ),
    ] = None,
) -> None:
    """List the domains of a model or a character, rename them, or set the roles of its joints."""
    from lcollision_core.bodies import open_body
    from lcollision_core.bodies.anatomy import role_name
    from lcollision_core.tasks.changing import change_body, set_joint_roles

    renamings: dict[int, str] = {}
    for request in names or []:
        number, _, name = request.partition("=")
        if not number.strip().isdecimal() or not name:
            raise LCollisionError(
                "does not name a domain", "write K=NAME, such as 3=tail", where=f"{request!r}"
            )
        renamings[int(number) - 1] = name
    body = open_body(model_name)
    role_of_joint: dict[str, str | None] = {}
    for request in roles or []:
        joint, equals, role = request.rpartition("=")
        if not equals:
            raise LCollisionError(
                "does not set a role",
                "write JOINT=ROLE, such as LeftLeg=knee-left",
                where=f"{request!r}",
            )
        role_of_joint[joint] = None if role == "auto" else role
    if role_of_joint:
        set_joint_roles(body, role_of_joint)
        body = open_body(model_name)
    if renamings:
        body = change_body(body, model_name, lambda kept: kept.edit_domains(renamings))
    _print_domains(describe(body))
    if body.joints is not None:
        tell("Joints:")
        space = body.joints
        for joint, joint_role, side in zip(
            space.rig.joint_names, space.roles, space.sides, strict=True
        ):
            tell(f"  {joint}: {role_name(joint_role, side)}")
    for remark in body.notes:
        note(f"{body.name}: {remark}")


def upright(
    model_name: ModelArgument,
    up: Annotated[
        Axis | None,
        typer.Option(
            help="The up axis; stored in a model's file or, for a character, in your data folder."
        ),
    ] = None,
) -> None:
    """Show which axis of a model or a character is up, or change it."""
    from lcollision_core.bodies import open_body
    from lcollision_core.tasks.changing import set_up_axis

    body = open_body(model_name)
    if up is not None:
        body = set_up_axis(body, model_name, "xyz".index(up))
    typer.echo(f"{body.name}: {'xyz'[body.up_axis]} is up")


def describe(model: Body) -> dict[str, Any]:
    """Return the fields of ``lcollision info --json``; lengths are normalised.

    A domain's vertices are those where its weight is the largest. Fields that only trained models
    have are None for a character.
    """
    import numpy as np

    from lcollision_core.model_file import FORMAT_VERSION

    trained = model.embedding
    metrics = None if trained is None else trained.metrics
    groups = model.latent_space.groups[1 : 1 + len(model.domain_names)]
    owned = np.bincount(model.attention_mask.argmax(axis=0), minlength=len(groups))
    return {
        "name": model.name,
        "version": None if trained is None else FORMAT_VERSION,
        "fingerprint": model.fingerprint,
        "vertices": model.n_vertices,
        "faces": len(model.faces),
        "poses": len(model.card.pose_names),
        "domains": [
            {
                "name": group.name,
                "vertices": int(n_vertices),
                "codes": len(group.code_names),
                "colour": group.colour,
            }
            for group, n_vertices in zip(groups, owned, strict=True)
        ],
        "latent_size": model.latent_size,
        "shapes": list(model.shape_names),
        "reconstruction": metrics and {name: getattr(metrics, name) for name in _ERRORS},
        "acap": metrics and {"mean": metrics.acap_mean, "max": metrics.acap_max},
        "masks": metrics and {name: getattr(metrics, name) for name in _MASKS},
        "predictor": _describe_predictor(model),
        "near_exclusion": model.rules.near_exclusion,
        **rules_json(model),
        "up_axis": "xyz"[model.up_axis],
        "height": model.body_size,
        "licence": model.card.licence,
        "source": model.card.source,
        "provenance": dict(model.card.provenance),
    }


def measured_model(model: LearnedBody) -> dict[str, Any]:
    """Return the JSON fields that identify the model to which a predictor's figures apply."""
    first, *others = model.embedding.group_sizes
    return {
        "model": model.name,
        "level1_codes": first,
        "domain_codes": others,
        "near_exclusion": model.rules.near_exclusion,
    }


def measured_model_sentence(model: LearnedBody) -> str:
    """Describe the code sizes and the contact rules of a measured model."""
    from lcollision_core.meshes import STRICT

    first, *others = model.embedding.group_sizes
    least, most = min(others), max(others)
    each = f"{least}" if least == most else f"{least} to {most}"
    near = model.rules.near_exclusion
    rule = f"near exclusion {near:g}" if near else "no near exclusion"
    if model.rules != replace(STRICT, near_exclusion=near):
        rule = f"not counted: {model.rules.described()}"
    return (
        f"|Z_0| = {first}, |Z_k| = {each} for {counted(len(others), 'domain', 'domains')}, {rule}"
    )


def note_where_written(written: Path, destination: Path) -> None:
    """Explain that a trained model has another path than asked for, or hides a bundled model."""
    if written != destination:
        note(
            f"{destination} was replaced by another model during training and was left alone; the "
            f"trained model is {written}"
        )
    note_if_hiding(written)


def note_if_hiding(path: Path) -> None:
    """Explain that a new model hides the bundled model of its name, if it does."""
    from lcollision_core.bodies import user_models_folder
    from lcollision_core.bundled import bundled_folder

    is_bundled = (bundled_folder("models") / path.name).is_file()
    if path.parent == user_models_folder() and is_bundled:
        note(f"{path.stem!r} now names this model; remove it to see the bundled one again")


def _describe_predictor(model: Body) -> dict[str, Any] | None:
    record = model.predictor_record
    if record is None:
        return None
    facts = record.facts
    metrics = None if record.metrics is None else asdict(record.metrics)
    return {
        "preset": record.config.preset,
        "described": record.config.described,
        "training": asdict(record.config),
        "rows": facts.rows,
        "colliding_share": facts.colliding_share,
        "seed": facts.seed,
        "metrics": metrics,
        "kinds": [asdict(kind) for kind in record.kinds],
        "free_poses": len(model.free_latent),
    }


def _predictor_sentence(report: dict[str, Any]) -> str:
    """Describe the predictor in a report of `describe`."""
    predictor = report["predictor"]
    if predictor is None:
        return "no predictor yet; `lcollision label` and `lcollision train predictor` add one"
    metrics, described = predictor["metrics"], predictor["described"]
    if metrics is None:
        return f"predictor {described}, not measured"
    scores, n_rows = scores_text(metrics), predictor["rows"]
    return f"predictor {described}, of {n_rows} labelled samples: {scores}"


def _size_sentence(report: dict[str, Any]) -> str:
    n_shapes = len(report["shapes"])
    sliders = "a slider of a morph target" if n_shapes == 1 else "sliders of morph targets"
    shapes = f", {n_shapes} of them {sliders}" if n_shapes else ""
    return (
        f"{counted(report['vertices'], 'vertex', 'vertices')}, "
        f"{counted(report['faces'], 'face', 'faces')}, "
        f"{counted(report['poses'], 'pose', 'poses')}, "
        f"{counted(len(report['domains']), 'domain', 'domains')}, "
        f"{counted(report['latent_size'], 'code', 'codes')} a pose{shapes}"
    )


def error_sentence(report: dict[str, Any]) -> str:
    """Describe the reconstruction errors in a report of `describe`."""
    errors = report["reconstruction"]
    if errors is None:
        return "not measured"
    sentence = (
        f"vertex error {_percent(errors['mean'])} of the body size, at most "
        f"{_percent(errors['max'])}; level 1 alone {_percent(errors['level1_mean'])}"
    )
    if errors["held_out_mean"] is not None:
        sentence += (
            f"; held-out poses {_percent(errors['held_out_mean'])}, with principal components "
            f"{_percent(errors['pca_held_out_mean'])}"
        )
    return sentence


def _percent(fraction: float) -> str:
    return f"{100.0 * fraction:.2f} %"


def _print_domains(report: dict[str, Any]) -> None:
    for number, domain in enumerate(report["domains"], start=1):
        tell(
            f"  {number:2d}  {domain['name']}  "
            f"({counted(domain['vertices'], 'vertex', 'vertices')}, "
            f"{counted(domain['codes'], 'code', 'codes')})"
        )
