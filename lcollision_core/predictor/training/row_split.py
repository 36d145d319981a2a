"""Which labelled samples train, which choose the decision threshold, which measure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.labels import measures
from lcollision_core.options.labels import Draws
from lcollision_core.predictor.config import PredictorConfig

_EVERY = 10
"""Every n-th held-out row chooses the decision threshold."""

LEAST_BALANCING = 5000
"""Fewer rows do not choose a decision threshold: their noise would cost more than the gain."""


@dataclass(frozen=True, eq=False)
class RowSplit:
    """Which rows do what: three int64 arrays of indices, ascending, no row in two of them.

    Attributes
    ----------
    training : rows that train
    validation : rows that choose the decision threshold, or none
    held_out : rows that measure the result
    """

    training: npt.NDArray[np.int64]
    validation: npt.NDArray[np.int64]
    held_out: npt.NDArray[np.int64]


def split_rows(n_rows: int, config: PredictorConfig, draws: Draws = Draws.BOX) -> RowSplit:
    """Split the samples 0, 1, ... of a store, drawn in one way.

    The decision threshold is chosen by a tenth of the rows that would measure, if these are many.
    """
    is_out = measures(np.arange(n_rows), draws)
    rest, held_out = np.flatnonzero(~is_out), np.flatnonzero(is_out)
    choosing = slice(None, None, _EVERY)
    if config.balanced and len(held_out[choosing]) >= LEAST_BALANCING:
        return RowSplit(rest, held_out[choosing], np.delete(held_out, choosing))
    return RowSplit(rest, rest[:0], held_out)


def held_out_index(
    n_rows: int, config: PredictorConfig, n_given: int, draws: Draws = Draws.BOX
) -> npt.NDArray[np.int64]:
    """Return the ascending numbers of the rows that neither trained nor chose anything.

    Parameters
    ----------
    n_rows : samples 0, 1, 2, ... of its store; fewer or more than it was given
    config : how it was trained
    n_given : how many rows of the store it was given, those held out among them
    draws : what the store's samples are drawn from
    """
    held_out = np.flatnonzero(measures(np.arange(n_rows), draws))
    return np.setdiff1d(held_out, split_rows(n_given, config, draws).validation)
