"""Where a predictor is sure: the verdicts that rarely err, and the curve of risk and coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta
from scipy.special import betaincinv

from lcollision_core.meshes.topology import FloatArray

ERROR_BOUNDS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
"""Shares of wrong verdicts for which it is known where the predictor is sure."""

_CONFIDENCE = 0.95


@dataclass(frozen=True)
class SureRange:
    """Where estimates may stand for the exact check.

    Attributes
    ----------
    error_bound : with a confidence of 95 %, no larger share of all samples is judged wrongly
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
    Limits chosen for each side would need other rows to confirm them. Of calibrated logits no other
    limits judge more with as few errors (Chow 1970).

    Parameters
    ----------
    logit : (B,) of samples that did not train the predictor, drawn independently
    colliding : (B,) bool array, ground truth
    error_bounds : ascending; those that so few samples cannot confirm are left out
    """
    distance = np.abs(logit)
    # The limit that lets k samples be judged wrongly is the distance of the next such one.
    limits = np.append(-np.sort(-distance[(logit > 0.0) != colliding]), 0.0)
    found = []
    for bound in error_bounds:
        most = _most_errors(len(logit), bound)
        if most is not None:
            limit = float(limits[min(most, len(limits) - 1)])
            found.append(SureRange(bound, -limit, limit, float((distance > limit).mean())))
    return tuple(found)


def _most_errors(n_samples: int, bound: float) -> int | None:
    """Return how many errors among the samples still confirm a bound; None if even 0 do not.

    By the upper end of the interval of Clopper and Pearson (1934), which grows with the errors.
    """
    confirmed, refuted = -1, int(bound * n_samples) + 1
    while refuted - confirmed > 1:
        middle = (confirmed + refuted) // 2
        if betaincinv(middle + 1, max(n_samples - middle, 1), _CONFIDENCE) <= bound:
            confirmed = middle
        else:
            refuted = middle
    return None if confirmed < 0 else confirmed
