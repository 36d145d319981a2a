"""Train a predictor on labelled samples, and choose its decision threshold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.errors import LabelStoreError
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.labels import LabelRows, StoreIdentity, is_of_box
from lcollision_core.meshes import FaceGroup
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.options import SampleDistribution
from lcollision_core.predictor.config import PRESETS, PredictorConfig, split_rows
from lcollision_core.predictor.evaluation import score_rows
from lcollision_core.predictor.metrics import mean_difference
from lcollision_core.predictor.predictor import (
    CollisionPredictor,
    TrainingFacts,
    require_model,
)

_MISTAKES_ADDED = 0.5
"""Additional mistakes allowed, as a fraction of those at logit 0."""

_ERRORS_APART = 2.0
"""Number of standard errors up to which two rates may be equal."""


def balanced_logit(logit: FloatArray, colliding: npt.NDArray[np.bool_]) -> float:
    """Return the decision threshold: the logit above which poses are called colliding.

    The most accurate classifier misjudges the rarer class more often. If the false positive and
    false negative rates at logit 0 differ significantly, the threshold moves towards equal rates,
    as long as the expected mistakes grow by at most half.

    Expectations come from a logistic curve through all rows (Platt 1999): counting the few rows
    near a threshold would favour chance. The bound is on mistakes, not on calls, so that a
    predictor that errs once in a thousand calls does not err ten times.

    Parameters
    ----------
    logit : (B,) of poses that did not train the predictor
    colliding : (B,) bool array, ground truth

    Returns
    -------
    threshold : 0 if one class is missing
    """
    n_rows, n_colliding = len(logit), int(colliding.sum())
    n_free = n_rows - n_colliding
    if not n_colliding or not n_free:
        return 0.0
    false_positive, its_variance = _rate(int((logit[~colliding] > 0.0).sum()), n_free)
    false_negative, other_variance = _rate(int((logit[colliding] <= 0.0).sum()), n_colliding)
    error = np.sqrt(its_variance + other_variance)
    if abs(false_positive - false_negative) <= _ERRORS_APART * error:
        return 0.0
    ordered = np.sort(logit)
    probability = _calibrated(logit, colliding, ordered)
    # Candidates lie between two different neighbours, or at 0; only the number below counts.
    cuts = 1 + np.flatnonzero(ordered[1:] > ordered[:-1])
    limits = np.append(0.5 * (ordered[cuts] + ordered[cuts - 1]), 0.0)
    n_below = np.append(cuts, np.searchsorted(ordered, 0.0, side="right"))
    false_negatives = np.append(0.0, probability.cumsum())[n_below]
    false_positives = np.append(0.0, (1.0 - probability)[::-1].cumsum())[n_rows - n_below]
    gap = np.abs(false_positives / (1.0 - probability).sum() - false_negatives / probability.sum())
    wrong = false_negatives + false_positives
    gap[wrong > wrong[-1] * (1.0 + _MISTAKES_ADDED)] = np.inf
    best = limits[gap == gap.min()]
    return float(best[np.abs(best).argmin()])


def _rate(count: int, total: int) -> tuple[float, float]:
    """Return a rate and its variance, valid at 0 and 1 too (Agresti and Coull 1998)."""
    rate = (count + 2.0) / (total + 4.0)
    return rate, rate * (1.0 - rate) / (total + 4.0)


def _calibrated(
    logit: FloatArray, colliding: npt.NDArray[np.bool_], wanted: FloatArray
) -> FloatArray:
    """Return collision probabilities at the wanted logits, by a logistic curve through the rows.

    Platt's targets avoid 0 and 1, so that the curve stays finite even for separable rows.
    """
    from scipy.optimize import minimize
    from scipy.special import expit

    n_colliding = int(colliding.sum())
    n_free = len(logit) - n_colliding
    target = np.where(colliding, (n_colliding + 1.0) / (n_colliding + 2.0), 1.0 / (n_free + 2.0))

    def loss(curve: FloatArray) -> tuple[float, FloatArray]:
        score = curve[0] * logit + curve[1]
        slope = expit(score) - target
        value = np.logaddexp(0.0, score) - target * score
        return float(value.mean()), np.array([(slope * logit).mean(), slope.mean()])

    scale, offset = minimize(loss, [1.0, 0.0], jac=True, method="BFGS").x
    probability: FloatArray = expit(scale * wanted + offset)
    return probability


def train_predictor(
    rows: LabelRows,
    embedding: Embedding,
    config: PredictorConfig | None = None,
    *,
    store: StoreIdentity | None = None,
    groups: Sequence[FaceGroup] = (),
    device: str = "auto",
    checkpoint: Path | None = None,
    job: Job = UNWATCHED,
    seed: int = 0,
) -> CollisionPredictor:
    """Train a predictor on labelled samples and measure it on held-out ones.

    Rows that `measures` selects never train. A killed run that is started again with the same
    checkpoint resumes and ends with the same bits, on one machine with the same number of threads.
    Under torchrun every process calls this with the same arguments: they share the labelling of
    patches and each batch, and all return the same predictor.

    Parameters
    ----------
    rows : samples 0, 1, 2, ... of a store, with at least one free and one colliding training row.
        Some may only choose the threshold, see `split_rows`.
    embedding : of the model that the rows label
    config : how to train, by default the preset "default"
    store : identity of the rows' store, with the contact rules; stored with the predictor
    groups : groups of faces that these rules may name
    device : "cpu", "cuda", or "auto" for CUDA if there is such a device
    checkpoint : a file to resume from and to save to; kept when the run ends
    job : reports a `PredictorStatus` every few steps and after every epoch; polled after every step
    seed : of the initial weights and of the order

    Returns
    -------
    predictor : CollisionPredictor, on the CPU, with its metrics

    Raises
    ------
    ShapeError : the rows are of another latent space, or not finite.
    LabelStoreError : all training rows collide, or none does, or none is held out.
    LCollisionError : the checkpoint belongs to another run or is damaged, the training diverges,
        or there is no such device.
    CancelledError : the job was cancelled; the checkpoint holds the last step, or the file beside
        it, see `patches_path`, the patches labelled up to the last twentieth.
    """
    # Imported here, so that reading a predictor's types loads no torch.
    from lcollision_core.predictor.training_loop import TrainingLoop

    config = PRESETS["default"] if config is None else config
    require_model(rows, embedding)
    draws = SampleDistribution.BOX if store is None else store.draws
    split = split_rows(len(rows), config, draws)
    energy = rows.energy[split.training]
    colliding = rows.colliding[split.training]
    n_training, n_colliding = len(colliding), int(colliding.sum())
    if not 0 < n_colliding < n_training or not len(split.held_out):
        raise LabelStoreError(
            f"{n_colliding} of {n_training} training rows collide and {len(split.held_out)} rows "
            "are held out",
            "label more samples: training needs colliding, free and held-out rows",
        )
    scale = float(energy[colliding].mean())
    if not scale > 0.0:
        raise LabelStoreError("no colliding row has any depth to learn", "label more samples")
    facts = TrainingFacts(
        rows=len(rows),
        training_rows=n_training,
        colliding_share=float(rows.colliding[is_of_box(np.arange(len(rows)), draws)].mean()),
        seed=seed,
        energy_scale=scale,
        margin=mean_difference(energy) / scale,
        store=store,
    )
    loop = TrainingLoop(
        rows,
        split,
        embedding,
        config,
        facts,
        device,
        checkpoint,
        Job(job.report, job),
        groups,
    )
    state = loop.run().state_dict()
    arrays = {name: values.detach().cpu().numpy() for name, values in state.items()}
    predictor = CollisionPredictor(embedding, arrays, config, facts)
    if config.balanced and len(split.validation):
        chosen_by = rows.taken(split.validation)
        logit = predictor.scaled_outputs(chosen_by.latent)[1]
        limit = balanced_logit(logit, chosen_by.colliding)
        if limit != 0.0:
            predictor = replace(predictor, facts=replace(facts, logit_shift=-limit))
    return replace(predictor, metrics=score_rows(predictor, rows.taken(split.held_out)).metrics())
