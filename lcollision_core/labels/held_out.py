"""Which labelled samples are held out from training."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.embedding import ROWS_PER_BLOCK
from lcollision_core.options.labels import Draws

BOX_ROWS = 16
"""First rows of a mixed block: samples of the box."""


def measures(index: npt.ArrayLike, draws: Draws = Draws.BOX) -> npt.NDArray[np.bool_]:
    """Return which samples measure a predictor: those of the box that `is_held_out` holds out.

    Parameters
    ----------
    index : (B,) integer array, the samples' indices in the store
    draws : what they are drawn from
    """
    return is_held_out(index) & is_of_box(index, draws)


def is_of_box(index: npt.ArrayLike, draws: Draws) -> npt.NDArray[np.bool_]:
    """Return which samples, by (B,) indices in a store, are uniform samples of the latent box."""
    of_box: npt.NDArray[np.bool_] = np.asarray(index) % ROWS_PER_BLOCK < BOX_ROWS
    return of_box if draws is Draws.MIXED else np.ones_like(of_box)


def is_held_out(index: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Return which samples test a predictor and never train it: those whose index ends in 7, 8, 9.

    A fixed 30 %, so that a row keeps its side when its store grows. Samples are independent, so
    any fixed choice is as random as another.

    Parameters
    ----------
    index : (B,) integer array, the samples' indices in the store
    """
    held_out: npt.NDArray[np.bool_] = np.asarray(index) % 10 >= 7
    return held_out
