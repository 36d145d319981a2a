"""Where to call a pose colliding: free and colliding ones are to be mistaken equally often."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray

_ACCURACY_GIVEN_UP = 1e-3
"""So much of what is right at even odds may be lost."""

_ERRORS_APART = 2.0
"""Rates that differ by fewer standard errors may be the same."""


def balanced_logit(logit: FloatArray, colliding: npt.NDArray[np.bool_]) -> float:
    """Return the logit above which to call poses colliding, such that both kinds fare alike.

    A classifier that is right as often as it can be mistakes the rarer kind more often. This goes
    from even odds, logit 0, as little as makes the false positive and the false negative rate
    differ by no more than chance may, or else as far towards that as costs no more than a
    thousandth of all calls.

    Parameters
    ----------
    logit : (B,) of poses that did not train the predictor
    colliding : (B,) the truth

    Returns
    -------
    limit : 0 where poses of one kind are missing
    """
    n_colliding = int(colliding.sum())
    n_free = len(colliding) - n_colliding
    if not n_colliding or not n_free:
        return 0.0
    # Between two neighbours, or at 0: how many lie below says all.
    order = np.argsort(logit)
    ordered = logit[order]
    limits = np.append(0.5 * (ordered[1:] + ordered[:-1]), 0.0)
    n_below = np.append(np.arange(1, len(logit)), np.searchsorted(ordered, 0.0, side="right"))
    missed = np.append(0, np.cumsum(colliding[order]))[n_below]
    alarms = n_free - (n_below - missed)
    wrong = missed + alarms
    false_positive, false_negative = alarms / n_free, missed / n_colliding
    variance = (
        false_positive * (1.0 - false_positive) / n_free
        + false_negative * (1.0 - false_negative) / n_colliding
    )
    gap = np.abs(false_positive - false_negative)
    # What cannot be told from nothing is nothing.
    gap[gap <= _ERRORS_APART * np.sqrt(variance)] = 0.0
    gap[wrong > wrong[-1] + _ACCURACY_GIVEN_UP * len(logit)] = np.inf
    best = limits[gap == gap.min()]
    return float(best[np.abs(best).argmin()])
