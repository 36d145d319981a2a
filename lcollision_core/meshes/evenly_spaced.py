"""Some of many, evenly spaced."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def evenly_spaced(count: int, most: int) -> npt.NDArray[np.int64]:
    """Return at most so many of the indices below `count`, ascending, with the first and last.

    Parameters
    ----------
    count : > 0
    most : > 0; of 1, the first
    """
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))
