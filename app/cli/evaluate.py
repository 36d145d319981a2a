"""``lcollision evaluate``: scores of a model's predictor on labelled samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import JsonOption, cancellable_bar, note, print_json, tell
from app.cli.models import measured_model, measured_model_sentence
from app.cli.options import DeviceOption, ModelArgument, RowsOption
from lcollision_core.devices import Device, choose_device
from lcollision_core.errors import LabelStoreError, LCollisionError, ModelFileError
from lcollision_core.tasks.words import counted, scores_text

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from lcollision_core.bodies import LearnedBody
    from lcollision_core.labels import LabelRows, LabelStore
    from lcollision_core.predictor import CollisionPredictor, KindScores, ScoredRows

StoreArgument = Annotated[
    Path, typer.Argument(metavar="STORE", help="Samples of the model, from `lcollision label`.")
]


def evaluate(
    model_name: ModelArgument,
    store_path: Annotated[
        Path,
        typer.Argument(
            metavar="STORE|POSES",
            help="Samples of the model, from `lcollision label`, or a .json file of poses.",
        ),
    ],
    n_rows: RowsOption = None,
    threshold: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1.0,
            metavar="P",
            help="Decision threshold, the probability above which a pose is called colliding: a "
            "higher one gives fewer false positives and more false negatives.",
        ),
    ] = 0.5,
    n_of_kind: Annotated[
        int,
        typer.Option(
            "--kinds",
            min=0,
            max=100_000,
            metavar="N",
            help="Also score N poses of each realistic kind: blends, mixed parts, motion "
            "frames, drags, resolved poses; 0 for none.",
        ),
    ] = 1000,
    figure: Annotated[
        Path | None,
        typer.Option(
            metavar="PNG|DIR",
            help="A .png: save the risk-coverage curve, errors among the poses that the predictor "
            "is sure of. A folder: save risk.png, roc.png and calibration.png.",
        ),
    ] = None,
    samples_csv: Annotated[
        Path | None,
        typer.Option(
            "--csv",
            metavar="FILE",
            help="Also write a row for each sample: labels, estimates and verdict.",
        ),
    ] = None,
    keep: Annotated[
        bool,
        typer.Option("--keep", help="Also write these figures into the model, as its own."),
    ] = False,
    device: DeviceOption = Device.AUTO,
    as_json: JsonOption = False,
) -> None:
    """Score a model's predictor against exact labels.

    On the store that it was trained on, only held-out rows count, also when the store has grown,
    so that predictors of fewer and of more rows are measured by the same; on any other store of the
    model, every row does. Poses of your own are listed with their estimate and the exact check,
    without kinds of poses. MSE and RANK are in energies divided by the mean of
    the colliding training samples.
    """
    import numpy as np

    from lcollision_core.bodies import LearnedBody, score_kinds
    from lcollision_core.files.safe import write_table
    from lcollision_core.predictor import score_rows
    from lcollision_core.tasks.changing import change_body, require_changeable
    from lcollision_core.tasks.exporting import require_output
    from lcollision_core.tasks.inputs import read_some_poses

    choose_device(device, note)
    if keep and (n_rows is not None or threshold != 0.5):
        what = "--keep is for figures of all rows at the decision threshold 0.5"
        raise LCollisionError(what, "leave out --rows and --threshold, or --keep")
    if figure is not None and figure.suffix:
        require_output(figure, ".png")
    if samples_csv is not None:
        require_output(samples_csv, ".csv")
    model = LearnedBody.load(model_name)
    trained = model.require_predictor()
    of_poses = store_path.suffix.lower() == ".json"
    numbers: Sequence[str] | npt.NDArray[np.int64]
    if of_poses:
        if keep or n_rows is not None:
            what = "--keep and --rows are for label stores"
            raise LCollisionError(what, "leave them out", where=store_path)
        n_of_kind, poses = 0, read_some_poses(store_path, model)
        numbers = [pose.name for pose in poses]
        rows = model.labeller().label(np.stack([pose.latent for pose in poses]))
    else:
        store = open_store(store_path, model)
        if keep:
            require_changeable(model_name)
        rows, numbers = _unseen(store, store.load(n_rows), trained)
    with cancellable_bar("Evaluating") as job:
        scored = score_rows(trained, rows, job=job)
    metrics = scored.metrics(threshold)
    kinds: tuple[KindScores, ...] = ()
    if n_of_kind:
        with cancellable_bar("Judging kinds of poses") as job:
            kinds = score_kinds(model, n_of_kind, job=job, threshold=threshold)
    if keep:
        measured_predictor = replace(trained, metrics=metrics, kinds=kinds or trained.kinds)
        change_body(model, model_name, lambda kept: _with_figures(kept, model, measured_predictor))
    if figure is not None:
        from app.view.figures import save_figures

        save_figures(scored, figure)
        note(f"saved the figures of {model.name} to {figure}")
    samples = []
    if of_poses or samples_csv is not None:
        samples = _samples(scored, "pose" if of_poses else "sample", numbers, threshold)
    if samples_csv is not None:
        write_table(samples_csv, samples[0], samples)
        note(f"wrote {counted(len(rows), 'sample', 'samples')} to {samples_csv}")
    report = _report(scored, threshold, model.domain_names)
    if as_json:
        measured = {"colliding_share": float(rows.colliding.mean()), "threshold": threshold}
        by_kind = {"kinds": [asdict(scores) for scores in kinds]}
        if of_poses:
            by_kind["poses"] = samples
        print_json(measured_model(model) | measured | asdict(metrics) | by_kind | report)
        return
    if of_poses:
        for line in [*_pose_lines(samples), _verdict_lines(report)[0]]:
            tell(line)
        return
    called = "" if threshold == 0.5 else f", decision threshold {threshold:g}"
    scores = scores_text(asdict(metrics), metrics.samples)
    tell(f"{model.name}, preset {trained.config.described}{called}: {scores}")
    tell(
        f"  {measured_model_sentence(model)}; {_percent(rows.colliding.mean())} of these "
        f"{counted(len(rows), 'sample', 'samples')} collide"
    )
    for line in _verdict_lines(report):
        tell(f"  {line}")
    tell(
        f"  MSE {_number(metrics.energy_mse)}, RANK {_number(metrics.ranking_margin)}, "
        f"Spearman {_number(metrics.spearman)}, calibration error "
        f"{_number(metrics.calibration_error)}"
    )
    tell("  predicted probability: fraction that collides (samples)")
    for entry in metrics.calibration:
        if entry.probability is not None and entry.colliding_share is not None:
            tell(f"    {entry.probability:.2f}: {entry.colliding_share:.2f} ({entry.samples})")
    if metrics.sure:
        tell("  error bound: samples with a sure verdict")
    for sure in metrics.sure:
        tell(f"    {100.0 * sure.error_bound:g} %: {_percent(sure.coverage)}")
    for line in _part_lines(report["parts"]) + kind_lines(kinds):
        tell(f"  {line}")


def _report(scored: ScoredRows, threshold: float, parts: Sequence[str]) -> dict[str, Any]:
    """Return the results beyond the figures that a model stores, as JSON values."""
    from lcollision_core.predictor.metrics import auc_interval, interval

    counts, auc = scored.counts(threshold), scored.auc
    shares = counts.shares
    intervals = {name: interval(*share) for name, share in shares.items()}
    positive = counts.true_positives + counts.false_negatives
    intervals["auc"] = (
        auc if auc is None else auc_interval(auc, positive, len(scored.rows) - positive)
    )
    by_part = ({"part": parts[part.domain]} | asdict(part) for part in scored.parts())
    return {
        "counts": asdict(counts),
        **{
            name: shares[name][0] / shares[name][1] if shares[name][1] else None
            for name in ("precision", "recall")
        },
        "auc": auc,
        "intervals": intervals,
        "parts": list(by_part),
    }


def _verdict_lines(report: dict[str, Any]) -> list[str]:
    """Return the counts of each kind of verdict, and the confidence intervals of the rates."""
    counts, intervals = report["counts"], report["intervals"]
    lines = [
        f"{counts['true_positives']} called colliding rightly, {counts['false_positives']} "
        f"wrongly; {counts['true_negatives']} called free rightly, "
        f"{counts['false_negatives']} wrongly",
        f"precision {_percent(report['precision'])}, recall {_percent(report['recall'])}, "
        f"AUC {_number(report['auc'])}",
    ]
    ranges = [
        f"{name.replace('_', ' ')} {100.0 * ends[0]:.1f} to {100.0 * ends[1]:.1f} %"
        for name, ends in intervals.items()
        if ends is not None and name != "auc"
    ]
    if intervals["auc"] is not None:
        ranges.append("AUC {:.3f} to {:.3f}".format(*intervals["auc"]))
    return [*lines, f"with a confidence of 95 %: {', '.join(ranges)}"]


def _part_lines(parts: Sequence[dict[str, Any]]) -> list[str]:
    """Return a table of scores by body part."""
    if not parts:
        return []
    head = ("body part", "collides in", "AUC", "average precision", "Spearman")
    names = ("auc", "average_precision", "spearman")
    rows = [
        (part["part"], str(part["colliding"]), *(_number(part[name]) for name in names))
        for part in parts
    ]
    return _table((head, *rows))


def _pose_lines(samples: Sequence[dict[str, Any]]) -> list[str]:
    """Return a table of poses: the estimate, and the pairs of faces that collide."""
    rows = [
        (
            pose["pose"],
            f"{pose['probability']:.3f}",
            ("free", "colliding")[pose["called_colliding"]],
            str(pose["pairs"]),
        )
        for pose in samples
    ]
    return _table((("pose", "probability", "estimate", "colliding pairs"), *rows))


def _samples(
    scored: ScoredRows,
    kind: str,
    names: Sequence[str] | npt.NDArray[np.int64],
    threshold: float,
) -> list[dict[str, Any]]:
    """Return each sample's name or number under its kind, its labels, estimates and verdict."""
    import numpy as np

    rows, scale = scored.rows, scored.predictor.facts.energy_scale
    columns = {
        kind: names,
        "colliding": rows.colliding.astype(int),
        "pairs": rows.n_pairs,
        "energy": rows.energy,
        "called_colliding": scored.called(threshold).astype(int),
        "probability": scored.probability,
        "predicted_energy": scored.domain_energy.clip(0.0).sum(axis=1) * scale,
    }
    values = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in values]


def _with_figures(
    stored: LearnedBody, model: LearnedBody, measured: CollisionPredictor
) -> LearnedBody:
    """Return the model as its file now holds it, with the figures of its predictor."""
    import numpy as np

    now = stored.require_predictor().arrays
    is_same = stored.fingerprint == model.fingerprint and now.keys() == measured.arrays.keys()
    if not is_same or any(
        not np.array_equal(now[name], array) for name, array in measured.arrays.items()
    ):
        what = "has another predictor than the one that was measured"
        raise ModelFileError(what, "evaluate it again", where=stored.name)
    return stored.with_predictor(measured)


def kind_lines(kinds: Sequence[KindScores]) -> list[str]:
    """Return a table of scores by kind of pose."""
    if not kinds:
        return []
    head = ("poses", "number", "collide", "accuracy", "false positive", "false negative")
    rows = [
        (
            kind.kind,
            str(kind.samples),
            _percent(kind.colliding_share),
            _percent(kind.accuracy),
            _percent(kind.false_positive_rate),
            _percent(kind.false_negative_rate),
        )
        for kind in kinds
    ]
    return _table((head, *rows))


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align rows of cells: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if at == 0 else cell.rjust(width)
            for at, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def open_store(path: Path, model: LearnedBody) -> LabelStore:
    """Open the labels of a model.

    Raises
    ------
    LabelStoreError : there are none, or they are of another model; names the first difference.
    """
    from lcollision_core.labels import LabelStore, StoreIdentity

    store = LabelStore.open(path)
    labeller = model.labeller(store.identity.draws)
    store.require(StoreIdentity.of(labeller, store.identity.seed))
    return store


def _unseen(
    store: LabelStore, rows: LabelRows, trained: CollisionPredictor
) -> tuple[LabelRows, npt.NDArray[np.int64]]:
    """Return the rows, with their numbers, that took no part in training or tuning the predictor.

    In a store that it was not trained on, these are all samples of the box.
    """
    import numpy as np

    from lcollision_core.labels import is_of_box
    from lcollision_core.predictor import held_out_index

    draws = store.identity.draws
    if trained.facts.store != store.identity:
        numbers = np.flatnonzero(is_of_box(np.arange(len(rows)), draws))
        return rows.taken(numbers), numbers
    numbers = held_out_index(len(rows), trained.config, trained.facts.rows, draws)
    if not len(numbers):
        raise LabelStoreError(
            f"has {counted(len(rows), 'row', 'rows')}, none of which is held out",
            "label more",
            where=store.path,
        )
    return rows.taken(numbers), numbers


def _percent(fraction: float | None) -> str:
    return "none" if fraction is None else f"{100.0 * fraction:.1f} %"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.3f}"
