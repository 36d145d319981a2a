"""Evenly spaced indices."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def evenly_spaced(count: int, most: int) -> npt.NDArray[np.int64]:
    """Return at most `most` of the indices below `count`, ascending, including first and last.

    Parameters
    ----------
    count : > 0
    most : > 0; 1 returns the first
    """
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))
