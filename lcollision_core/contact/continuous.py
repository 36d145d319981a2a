"""Test whether a mesh touches itself on the linear path from one pose to another.

The continuous collision detection is ipctk's, based on inclusion (Wang et al. 2021, "A Large Scale
Benchmark and an Inclusion-Based Algorithm for Continuous Collision Detection"). It tests the
edge-edge and face-vertex pairs of two faces whose contact counts.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.contact.distance import triangle_distance
from lcollision_core.contact.kernels import SLACK
from lcollision_core.errors import MissingExtraError
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology

_USED_UP = 1.0
"""Share of the initial distance that may be used up; ipctk's default reports contact earlier."""


_TOUCHING = 1e-9
"""Normalised length: pairs initially this near touch, and ipctk is not asked about them."""


class LinearPath:
    """Test paths between poses of one mesh.

    Parameters
    ----------
    topology : of all poses
    reference : (V, 3) normalised vertices of one pose

    Attributes
    ----------
    edge : median length of the edges of the reference, normalised

    Raises
    ------
    MissingExtraError : ipctk is not installed.
    """

    def __init__(self, topology: Topology, reference: FloatArray) -> None:
        self._ipctk = require_ipctk()
        self._ccd = self._ipctk.TightInclusionCCD(conservative_rescaling=_USED_UP)
        self._faces, self._edges, n = topology.faces, topology.edges, topology.n_vertices
        self.edge = float(np.median(topology.edge_lengths(reference)))
        columns = (np.asfortranarray(array) for array in (reference, self._edges, self._faces))
        self._mesh = self._ipctk.CollisionMesh(*columns)
        # The three edges of each face; edges are in lexicographic order.
        ends = np.sort(np.stack([self._faces, np.roll(self._faces, -1, axis=1)]), axis=0)
        first, second = ends.astype(np.int64)
        keys = self._edges[:, 0] * np.int64(n) + self._edges[:, 1]
        self._edges_of = np.searchsorted(keys, first * n + second)

    def touches(self, pairs: IntArray, start: FloatArray, end: FloatArray) -> bool:
        """Return whether any pair of faces touches on the path from one pose to another.

        Parameters
        ----------
        pairs : (P, 2) faces that share no vertex and do not penetrate each other in `start`
        start, end : (V, 3) normalised vertices; each moves on a line

        Returns
        -------
        touches : False is certain; True is possible for pairs that come as near as 10⁻⁶
        """
        at_first = triangle_distance(*(start[self._faces[side]] for side in pairs.T)).distance
        if at_first.min(initial=np.inf) <= _TOUCHING:
            # ipctk would complain about touching pairs on standard output.
            return True
        # The approach of two faces is at most the largest relative motion of two of their corners.
        moved, other_moved = ((end - start)[self._faces[side]] for side in pairs.T)
        apart = np.linalg.norm(moved[:, :, None] - other_moved[:, None], axis=3)
        reach = apart.max(axis=(1, 2), initial=0.0)
        one, other = pairs[at_first <= reach * (1.0 + SLACK) + SLACK].T
        if not len(one):
            return False
        low, high = np.minimum(start, end), np.maximum(start, end)
        points = np.arange(len(start))[:, None]
        edges = np.sort(_all_with_all(self._edges_of[one], self._edges_of[other]), axis=1)
        vertices = np.concatenate(
            [
                _all_with_all(face[:, None], self._faces[opposite])
                for face, opposite in ((one, other), (other, one))
            ]
        )
        candidates = self._ipctk.Candidates()
        candidates.ee_candidates = [
            self._ipctk.EdgeEdgeCandidate(*pair)
            for pair in _meeting(edges, self._edges, self._edges, low, high)
        ]
        candidates.fv_candidates = [
            self._ipctk.FaceVertexCandidate(*pair)
            for pair in _meeting(vertices, self._faces, points, low, high)
        ]
        poses = (np.asfortranarray(pose) for pose in (start, end))
        return not candidates.is_step_collision_free(self._mesh, *poses, narrow_phase_ccd=self._ccd)


def require_ipctk() -> Any:
    """Return the ipctk module, with its logging off.

    Raises
    ------
    MissingExtraError : ipctk is not installed.
    """
    try:
        import ipctk
    except ImportError as error:
        raise MissingExtraError(
            "the check between frames needs ipctk",
            "run: pip install 'lcollision[ccd]'",
        ) from error
    ipctk.set_logger_level(ipctk.LoggerLevel.off)
    return ipctk


def _all_with_all(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return the pairs of each entry of (P, m) rows with each of (P, n) rows, (P m n, 2)."""
    both = np.broadcast_arrays(one[:, :, None], other[:, None, :])
    return np.stack(both, axis=-1).reshape(-1, 2).astype(np.int64)


def _meeting(
    pairs: npt.NDArray[np.int64],
    first: npt.NDArray[np.integer],
    second: npt.NDArray[np.integer],
    low: FloatArray,
    high: FloatArray,
) -> list[list[int]]:
    """Return the distinct (P, 2) pairs whose boxes overlap.

    Parameters
    ----------
    first, second : (n, corners) vertices of either side
    low, high : (V, 3) box of each vertex
    """
    n = np.int64(len(second))
    a, b = np.divmod(np.unique(pairs @ np.array([n, 1])), n)
    (a_low, a_high), (b_low, b_high) = (
        (low[corners].min(axis=1), high[corners].max(axis=1)) for corners in (first[a], second[b])
    )
    meet = ((a_low <= b_high) & (b_low <= a_high)).all(axis=1)
    meeting_pairs: list[list[int]] = np.stack([a, b], axis=1)[meet].tolist()
    return meeting_pairs
