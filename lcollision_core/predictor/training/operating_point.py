"""The decision threshold at which false positive and false negative rates are about equal."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray

_MISTAKES_ADDED = 0.5
"""Further mistakes allowed, as a fraction of those at even odds."""

_ERRORS_APART = 2.0
"""Rates that differ by fewer standard errors may be the same."""


def balanced_logit(logit: FloatArray, colliding: npt.NDArray[np.bool_]) -> float:
    """Return the decision threshold: the logit above which poses are called colliding.

    The most accurate classifier misjudges the rarer class more often. Where the false positive and
    the false negative rate at logit 0 differ by more than chance, the threshold moves towards equal
    rates as far as at most half as many errors again are expected.
    What is expected is a logistic curve's through all rows (Platt 1999): counting the few rows near
    a limit would go where these happen to be favourable. The bound counts mistakes and not calls,
    for a predictor that errs once in a thousand calls is not to err ten times.

    Parameters
    ----------
    logit : (B,) of poses that did not train the predictor
    colliding : (B,) bool array, ground truth

    Returns
    -------
    threshold : 0 where one class is missing
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
    # Between two different neighbours, or at 0: how many lie below says all.
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
    """Return a rate and its variance, of none and of all too (Agresti and Coull 1998)."""
    rate = (count + 2.0) / (total + 4.0)
    return rate, rate * (1.0 - rate) / (total + 4.0)


def _calibrated(
    logit: FloatArray, colliding: npt.NDArray[np.bool_], wanted: FloatArray
) -> FloatArray:
    """Return how likely poses of the wanted logits collide, by a logistic curve through the rows.

    Platt's targets stay off 0 and 1, so that the curve is one even where a limit divides the rows.
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
