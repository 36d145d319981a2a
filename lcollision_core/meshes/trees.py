"""Trees given by the parent of each node, -1 for a root."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def lineage(parents: npt.NDArray[np.integer], node: int) -> list[int]:
    """Return a node and its ancestors, up to the root."""
    path = [node]
    while (above := int(parents[path[-1]])) >= 0:
        path.append(above)
    return path


def ancestry(parents: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """Return an (n, n) mask: row i holds node i and its ancestors; parents come before children."""
    mask = np.eye(len(parents), dtype=np.bool_)
    for node, parent in enumerate(parents.tolist()):
        if parent >= 0:
            mask[node] |= mask[parent]
    return mask
