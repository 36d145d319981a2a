"""Consistency of the rotations of features."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes import Topology


def n_jumps(features: npt.NDArray[np.float64], topology: Topology) -> list[int]:
    """Count each pose's edges whose angles differ by more than pi, with axes aligned."""
    logs = features[:, topology.edges.T, :3]
    angles = np.linalg.norm(logs, axis=3)
    signs = np.where((logs[:, 0] * logs[:, 1]).sum(axis=2) < 0.0, -1.0, 1.0)
    counts: list[int] = (np.abs(angles[:, 0] - signs * angles[:, 1]) > np.pi).sum(axis=1).tolist()
    return counts
