"""``lcollision evaluate``: scores of a model's predictor on labelled samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.console import JsonOption, note, print_json, progress_bar, tell
from app.cli.inputs import RowsOption
from app.cli.interrupt import cancel_on_interrupt
from app.cli.models import (
    ModelArgument,
    changeable_model,
    changed_body,
    measured_model,
    measured_model_sentence,
)
from app.cli.results import require_output
from app.wording import counted
from lcollision_core.errors import LabelStoreError, LCollisionError, ModelFileError

if TYPE_CHECKING:
    from lcollision_core.labels import LabelRows, LabelStore
    from lcollision_core.model import PoseModel
    from lcollision_core.predictor import CollisionPredictor, KindScores, PredictorMetrics

StoreArgument = Annotated[
    Path, typer.Argument(metavar="STORE", help="Samples of the model, from `lcollision label`.")
]


def evaluate(
    model_name: ModelArgument,
    store_path: StoreArgument,
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
            metavar="RISK.png",
            help="Save the risk-coverage curve: errors among the poses that the predictor is "
            "sure of.",
        ),
    ] = None,
    keep: Annotated[
        bool,
        typer.Option("--keep", help="Also write these figures into the model, as its own."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Score a model's predictor against exact labels.

    On the store that it was trained on, only rows that took no part in its training count; on any
    other store of the model, every row does. MSE and RANK are in energies divided by the mean of
    the colliding training samples.
    """
    from lcollision_core.model import PoseModel, score_kinds
    from lcollision_core.predictor import evaluate_predictor

    if keep and (n_rows is not None or threshold != 0.5):
        what = "--keep is for figures of all rows at the decision threshold 0.5"
        raise LCollisionError(what, "leave out --rows and --threshold, or --keep")
    if figure is not None:
        require_output(figure, ".png")
    model = PoseModel.load(model_name)
    trained = model.require_predictor()
    store = open_store(store_path, model)
    if keep:
        changeable_model(model_name)
    rows = _unseen(store, store.load(n_rows), trained)
    with cancel_on_interrupt() as cancel, progress_bar("Evaluating") as progress:
        metrics = evaluate_predictor(
            trained, rows, threshold=threshold, progress=progress, cancel=cancel
        )
    kinds: tuple[KindScores, ...] = ()
    if n_of_kind:
        with cancel_on_interrupt() as cancel, progress_bar("Judging kinds of poses") as progress:
            kinds = score_kinds(model, n_of_kind, progress=progress, cancel=cancel)
    if keep:
        measured_by = replace(trained, metrics=metrics, kinds=kinds or trained.kinds)
        changed_body(model_name, model, lambda held: _with_figures(held, model, measured_by))
    if figure is not None:
        from app.view.risk_figure import draw_risk

        draw_risk(trained, rows, figure)
        note(f"saved the risk-coverage curve of {model.name} to {figure}")
    if as_json:
        measured = {"colliding_share": float(rows.colliding.mean()), "threshold": threshold}
        by_kind = {"kinds": [asdict(one) for one in kinds]}
        print_json(measured_model(model) | measured | asdict(metrics) | by_kind)
        return
    called = "" if threshold == 0.5 else f", decision threshold {threshold:g}"
    tell(f"{model.name}, preset {trained.config.preset}{called}: {scores_sentence(metrics)}")
    tell(
        f"  {measured_model_sentence(model)}; {_percent(rows.colliding.mean())} of these "
        f"{counted(len(rows), 'sample')} collide"
    )
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
    for line in kind_lines(kinds):
        tell(f"  {line}")


def _with_figures(held: PoseModel, model: PoseModel, measured_by: CollisionPredictor) -> PoseModel:
    """Return the model that its file holds now with the figures of its predictor."""
    import numpy as np

    now = held.require_predictor().arrays
    is_same = held.fingerprint == model.fingerprint and now.keys() == measured_by.arrays.keys()
    if not is_same or any(
        not np.array_equal(now[name], array) for name, array in measured_by.arrays.items()
    ):
        what = "has another predictor than the one that was measured"
        raise ModelFileError(what, "evaluate it again", where=held.name)
    return held.with_predictor(measured_by)


def kind_lines(kinds: Sequence[KindScores]) -> list[str]:
    """Return a table of the scores by kind of pose."""
    if not kinds:
        return []
    head = ("poses", "number", "collide", "accuracy", "false positive", "false negative")
    rows = [
        (
            one.kind,
            str(one.samples),
            _percent(one.colliding_share),
            _percent(one.accuracy),
            _percent(one.false_positive_rate),
            _percent(one.false_negative_rate),
        )
        for one in kinds
    ]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if at == 0 else cell.rjust(width)
            for at, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (head, *rows)
    ]


def open_store(path: Path, model: PoseModel) -> LabelStore:
    """Open the labels of a model.

    Raises
    ------
    LabelStoreError : there are none, or they are of another model, naming the first difference.
    """
    from lcollision_core.labels import LabelStore, StoreIdentity

    store = LabelStore.open(path)
    labeller = model.labeller(store.identity.draws)
    store.require(StoreIdentity.of(labeller, store.identity.seed))
    return store


def scores_sentence(metrics: PredictorMetrics) -> str:
    """Describe the scores of the classification."""
    return (
        f"accuracy {_percent(metrics.accuracy)} on {metrics.samples} unseen samples (majority "
        f"baseline: {_percent(metrics.majority_rate)}), false positive rate "
        f"{_percent(metrics.false_positive_rate)}, false negative rate "
        f"{_percent(metrics.false_negative_rate)}"
    )


def _unseen(store: LabelStore, rows: LabelRows, trained: CollisionPredictor) -> LabelRows:
    """Return the rows that neither trained the predictor nor chose anything for it.

    Of another store than the one that it was trained on, all samples of the box.
    """
    import numpy as np

    from lcollision_core.labels import is_of_box
    from lcollision_core.predictor import held_out_rows

    draws = store.identity.draws
    if trained.facts.store != store.identity:
        return rows.taken(is_of_box(np.arange(len(rows)), draws))
    held_out = held_out_rows(rows, trained.config, trained.facts.rows, draws)
    if not len(held_out):
        raise LabelStoreError(
            f"has {counted(len(rows), 'row')}, none of which is held out",
            "label more",
            where=store.path,
        )
    return held_out


def _percent(fraction: float | None) -> str:
    return "none" if fraction is None else f"{100.0 * fraction:.1f} %"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.3f}"
