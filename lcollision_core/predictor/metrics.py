"""Scores of a predictor, with confidence intervals, and the ranges where it is sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
import scipy
from msgspec import Meta

from lcollision_core.meshes.topology import FloatArray

ERROR_BOUNDS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
"""Shares of wrong verdicts for which the predictor's sure range is stored."""

CONFIDENCE = 0.95
"""Confidence of the intervals, and of the sure ranges."""


@dataclass(frozen=True)
class SureRange:
    """The logits at which estimates may replace the exact check.

    Attributes
    ----------
    error_bound : with 95 % confidence, at most this share of all samples is judged wrongly
    free_below, colliding_above : logits; a pose between them is not judged
    coverage : share of the samples that are judged
    """

    error_bound: Annotated[float, Meta(gt=0.0, lt=1.0)]
    free_below: float
    colliding_above: float
    coverage: Annotated[float, Meta(ge=0.0, le=1.0)]


def sure_ranges(
    logit: FloatArray,
    colliding: npt.NDArray[np.bool_],
    error_bounds: Sequence[float] = ERROR_BOUNDS,
) -> tuple[SureRange, ...]:
    """Find for each error bound the range that judges most samples.

    Selective classification with a guaranteed risk (Geifman and El-Yaniv 2017). The limits are
    equally far from the decision threshold at 0: then ranges are nested, and the rows that choose
    one also confirm it (Bates et al. 2021, Distribution-Free, Risk-Controlling Prediction Sets).
    Limits chosen for each side would need other rows to confirm them. If logits are calibrated, no
    other limits judge more samples with as few errors (Chow 1970).

    Parameters
    ----------
    logit : (B,) of independent samples that did not train the predictor
    colliding : (B,) bool array, ground truth
    error_bounds : ascending; bounds that so few samples cannot confirm are left out
    """
    distance = np.abs(logit)
    # With k mistakes allowed, the limit is the distance of the next wrongly judged sample.
    limits = np.append(-np.sort(-distance[(logit > 0.0) != colliding]), 0.0)
    ranges = []
    for bound in error_bounds:
        most = _most_errors(len(logit), bound)
        if most is not None:
            limit = float(limits[min(most, len(limits) - 1)])
            ranges.append(SureRange(bound, -limit, limit, float((distance > limit).mean())))
    return tuple(ranges)


def _most_errors(n_samples: int, bound: float) -> int | None:
    """Return the largest number of errors that still confirms a bound; None if even 0 does not.

    It uses the upper end of the interval of Clopper and Pearson (1934), which grows with the
    errors.
    """
    confirmed, refuted = -1, int(bound * n_samples) + 1
    while refuted - confirmed > 1:
        middle = (confirmed + refuted) // 2
        if scipy.special.betaincinv(middle + 1, max(n_samples - middle, 1), CONFIDENCE) <= bound:
            confirmed = middle
        else:
            refuted = middle
    return None if confirmed < 0 else confirmed


CALIBRATION_BINS = 10

_PAIRING_SEED = 0
"""Seed of the pairs of RANK, so that equal predictions get equal scores."""


@dataclass(frozen=True)
class CalibrationBin:
    """The poses whose predicted probability lies in one tenth of [0, 1].

    Attributes
    ----------
    samples : number of poses
    probability : their mean prediction, None without samples
    colliding_share : share of them that collides, None without samples
    """

    samples: int
    probability: float | None = None
    colliding_share: float | None = None


_Rate = Annotated[float, Meta(ge=0.0, le=1.0)]


@dataclass(frozen=True)
class PredictorMetrics:
    """Scores over samples that did not train the predictor; rates are fractions from 0 to 1.

    Scores that the samples or the trained losses leave undefined are None.

    Attributes
    ----------
    samples : number of samples
    accuracy : CLASSIFY, fraction of correct decisions at probability 0.5
    false_positive_rate : fraction of free poses called colliding
    false_negative_rate : fraction of colliding poses called free
    majority_rate : accuracy of always answering the more frequent class
    energy_mse : MSE of PDe-sum, in scaled energies
    ranking_margin : RANK, mean of max(0, alpha - sign dS_sum) over random pairs of unequal
        PDe-sum, in scaled energies
    spearman : rank correlation of predicted and true PDe-sum over colliding samples
    calibration_error : expected calibration error over `calibration`
    calibration : the curve, `CALIBRATION_BINS` equal bins of the predicted probability
    sure : ranges where estimates may replace the exact check, by error bound
    """

    samples: Annotated[int, Meta(ge=1)]
    accuracy: _Rate
    false_positive_rate: _Rate | None
    false_negative_rate: _Rate | None
    majority_rate: _Rate
    energy_mse: float | None
    ranking_margin: float | None
    spearman: float | None
    calibration_error: float
    calibration: Annotated[
        tuple[CalibrationBin, ...], Meta(min_length=CALIBRATION_BINS, max_length=CALIBRATION_BINS)
    ]
    sure: tuple[SureRange, ...] = ()


@dataclass(frozen=True)
class Counts:
    """Confusion matrix of verdicts; "positive" means colliding.

    Attributes
    ----------
    true_positives, false_positives, true_negatives, false_negatives : numbers of poses
    """

    true_positives: int
    false_positives: int
    true_negatives: int
    false_negatives: int

    @classmethod
    def of(cls, called: npt.NDArray[np.bool_], colliding: npt.NDArray[np.bool_]) -> Counts:
        """Count (B,) verdicts against the ground truth."""
        pairs = ((called, colliding), (called, ~colliding), (~called, ~colliding))
        return cls(*(int((a & b).sum()) for a, b in (*pairs, (~called, colliding))))

    @property
    def shares(self) -> dict[str, tuple[int, int]]:
        """Each rate by name, as (count, total)."""
        hits, alarms = self.true_positives, self.false_positives
        passed, missed = self.true_negatives, self.false_negatives
        return {
            "accuracy": (hits + passed, hits + alarms + passed + missed),
            "false_positive_rate": (alarms, alarms + passed),
            "false_negative_rate": (missed, hits + missed),
            "precision": (hits, hits + alarms),
            "recall": (hits, hits + missed),
        }


@dataclass(frozen=True)
class KindScores:
    """Scores on poses of one kind, see `PoseKind`; rates are fractions from 0 to 1.

    Attributes
    ----------
    kind : of the poses
    samples : number of poses
    colliding_share : share of them that collides
    accuracy, false_positive_rate, false_negative_rate : as in `PredictorMetrics`
    """

    kind: str
    samples: Annotated[int, Meta(ge=1)]
    colliding_share: _Rate
    accuracy: _Rate
    false_positive_rate: _Rate | None
    false_negative_rate: _Rate | None

    @classmethod
    def of(
        cls, kind: str, called: npt.NDArray[np.bool_], colliding: npt.NDArray[np.bool_]
    ) -> KindScores:
        """Compare (B,) verdicts with the ground truth, B >= 1."""
        accuracy = float((called == colliding).mean())
        rates = error_rates(called, colliding)
        return cls(kind, len(called), float(colliding.mean()), accuracy, *rates)


def measure(
    probability: FloatArray,
    predicted_energy: FloatArray,
    colliding: npt.NDArray[np.bool_],
    energy: FloatArray,
    margin: float,
    threshold: float = 0.5,
    *,
    depth: bool = True,
    rank: bool = True,
) -> PredictorMetrics:
    """Score predictions against exact labels.

    Parameters
    ----------
    probability : (B,) predicted, B >= 1
    predicted_energy : (B,) S_sum, scaled
    colliding : (B,) bool array, ground truth
    energy : (B,) PDe-sum, scaled
    margin : alpha, scaled
    threshold : probability above which a pose is called colliding
    depth, rank : whether L_PD and L_rank were trained; scores that depend on them are else None
    """
    called, ranked = probability > threshold, depth or rank
    n_colliding = int(colliding.sum())
    false_positive_rate, false_negative_rate = error_rates(called, colliding)
    bins, calibration_error = _calibration(probability, colliding)
    return PredictorMetrics(
        samples=len(colliding),
        accuracy=float((called == colliding).mean()),
        false_positive_rate=false_positive_rate,
        false_negative_rate=false_negative_rate,
        majority_rate=max(n_colliding, len(colliding) - n_colliding) / len(colliding),
        energy_mse=float(((predicted_energy - energy) ** 2).mean()) if depth else None,
        ranking_margin=_ranking_margin(predicted_energy, energy, margin) if ranked else None,
        spearman=spearman(predicted_energy[colliding], energy[colliding]) if ranked else None,
        calibration_error=calibration_error,
        calibration=bins,
    )


def mean_difference(values: FloatArray) -> float:
    """Return the mean of |a - b| over all pairs of different indices, 0 for fewer than two."""
    n_values = len(values)
    if n_values < 2:
        return 0.0
    weights = 2.0 * np.arange(n_values) - (n_values - 1)
    return float(2.0 * np.dot(weights, np.sort(values)) / (n_values * (n_values - 1)))


def error_rates(
    called: npt.NDArray[np.bool_], colliding: npt.NDArray[np.bool_]
) -> tuple[float | None, float | None]:
    """Return the false positive and false negative rates; None for a class without rows."""
    wrong = called != colliding
    return (
        float(wrong[~colliding].mean()) if not colliding.all() else None,
        float(wrong[colliding].mean()) if colliding.any() else None,
    )


def _ranking_margin(predicted: FloatArray, energy: FloatArray, margin: float) -> float | None:
    partner = np.random.default_rng(_PAIRING_SEED).permutation(len(energy))
    sign = np.sign(energy[partner] - energy)
    shortfall = np.maximum(0.0, margin - sign * (predicted[partner] - predicted))
    return float(shortfall[sign != 0.0].mean()) if (sign != 0.0).any() else None


def spearman(predicted: FloatArray, energy: FloatArray) -> float | None:
    """Return the rank correlation of (B,) values, None if those of one side are all equal."""
    from scipy.stats import spearmanr

    if len(energy) < 2 or np.ptp(predicted) == 0.0 or np.ptp(energy) == 0.0:
        return None
    return float(spearmanr(predicted, energy).statistic)


def interval(count: int, total: int) -> tuple[float, float] | None:
    """Return the interval of a share (Clopper and Pearson 1934), None if the total is 0."""
    if not total:
        return None
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = scipy.special.betaincinv(count, total - count + 1, tail) if count else 0.0
    high = scipy.special.betaincinv(count + 1, total - count, 1.0 - tail) if count < total else 1.0
    return float(low), float(high)


def auc_interval(auc: float, n_positive: int, n_negative: int) -> tuple[float, float]:
    """Return the interval of an area under the ROC curve (Hanley and McNeil 1982)."""
    of_positive, of_negative = auc / (2.0 - auc), 2.0 * auc**2 / (1.0 + auc)
    variance = (
        auc * (1.0 - auc)
        + (n_positive - 1) * (of_positive - auc**2)
        + (n_negative - 1) * (of_negative - auc**2)
    ) / (n_positive * n_negative)
    margin = float(scipy.special.ndtri(0.5 * (1.0 + CONFIDENCE)) * np.sqrt(max(variance, 0.0)))
    return max(0.0, auc - margin), min(1.0, auc + margin)


def roc_curve(score: FloatArray, positive: npt.NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Return the ROC curve from (0, 0) to (1, 1); equal scores are one step.

    Parameters
    ----------
    score : (B,) higher for rows that are more likely positive
    positive : (B,) bool array with both classes

    Returns
    -------
    false_positive_rate, true_positive_rate : (n,) float64 arrays, ascending
    """
    hits, calls = _ranked(score, positive)
    false_positives, true_positives = calls - hits, hits
    return (
        np.append(0.0, false_positives / false_positives[-1]),
        np.append(0.0, true_positives / true_positives[-1]),
    )


def area_under_roc(score: FloatArray, positive: npt.NDArray[np.bool_]) -> float | None:
    """Return the area under `roc_curve`, None if one class is missing."""
    if positive.all() or not positive.any():
        return None
    by, of = roc_curve(score, positive)
    return float((np.diff(by) * 0.5 * (of[1:] + of[:-1])).sum())


def average_precision(score: FloatArray, positive: npt.NDArray[np.bool_]) -> float | None:
    """Return the mean precision, weighted by recall gained; None if one class is missing."""
    if positive.all() or not positive.any():
        return None
    hits, calls = _ranked(score, positive)
    return float((np.diff(hits, prepend=0.0) * hits / calls).sum() / hits[-1])


def _ranked(score: FloatArray, positive: npt.NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Count positives and all rows down to each distinct score, highest first."""
    order = np.argsort(-score, kind="stable")
    last = np.append(np.flatnonzero(np.diff(score[order])), len(score) - 1)
    return positive[order].cumsum()[last].astype(np.float64), last + 1.0


def _calibration(
    probability: FloatArray, colliding: npt.NDArray[np.bool_]
) -> tuple[tuple[CalibrationBin, ...], float]:
    number = np.minimum((probability * CALIBRATION_BINS).astype(np.int64), CALIBRATION_BINS - 1)
    counts, expected, occurred = (
        np.bincount(number, weights, CALIBRATION_BINS) for weights in (None, probability, colliding)
    )
    bins = [
        CalibrationBin(int(n), float(mean / n), float(n_colliding / n)) if n else CalibrationBin(0)
        for n, mean, n_colliding in zip(counts, expected, occurred, strict=True)
    ]
    return tuple(bins), float(np.abs(expected - occurred).sum()) / len(colliding)
