"""What benchmarks share: rows, times, and verdicts by all pairs of faces, without a tree."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import Body
from lcollision_core.contact import DEPTH_TOLERANCE, penetration_depth, triangle_distance
from lcollision_core.contact.distance import REST_SHARE

Row = dict[str, Any]
"""One row of a benchmark, as printed and as written to JSON."""

Pairs = npt.NDArray[np.int64]

_ROWS_AT_ONCE = 256


def median_seconds(calls: Iterable[Callable[[], object]]) -> float:
    """Return the median duration of some calls, made one after the other."""
    seconds = []
    for call in calls:
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)


def is_free_by_brute_force(model: Body, vertices: npt.NDArray[np.floating]) -> bool:
    """Return whether no pair of faces of a (V, 3) pose that counts collides, without a tree."""
    corners = vertices[model.faces].astype(np.float64)
    for pairs in _near_pairs(model, corners, 0.0):
        deep = penetration_depth(corners[pairs[:, 0]], corners[pairs[:, 1]]) / model.body_size
        is_deep = deep > DEPTH_TOLERANCE
        if not model.detector.rules_of(pairs[is_deep], deep[is_deep]).all():
            return False
    return True


def least_by_brute_force(model: Body, vertices: npt.NDArray[np.floating], bound: float) -> float:
    """Measure the least distance of a (V, 3) pose by all pairs of faces that share no vertex.

    Returns
    -------
    least : the least signed distance, normalised, of the pairs that count and are nearer than half
        their distance at rest; infinite if it is not below `bound`, in normalised length
    """
    corners = vertices[model.faces].astype(np.float64) / model.body_size
    at_rest = model.reference[model.faces] / model.body_size
    least = np.inf
    for pairs in _near_pairs(model, corners, bound):
        a, b = corners[pairs[:, 0]], corners[pairs[:, 1]]
        depth = penetration_depth(a, b)
        signed = np.where(depth > DEPTH_TOLERANCE, -depth, triangle_distance(a, b).distance)
        rest = triangle_distance(at_rest[pairs[:, 0]], at_rest[pairs[:, 1]]).distance
        required = np.minimum(bound, REST_SHARE * rest)
        lacks = required - signed > DEPTH_TOLERANCE
        # A depth of 1 exceeds every tolerated depth.
        counts = model.detector.rules_of(pairs[lacks], np.ones(int(lacks.sum()))) == 0
        least = min(least, float(signed[lacks][counts].min(initial=np.inf)))
    return least


def _near_pairs(model: Body, corners: npt.NDArray[np.float64], distance: float) -> Iterator[Pairs]:
    """Yield (n, 2) pairs that share no vertex and whose boxes are at most `distance` apart."""
    faces = model.faces
    order = np.argsort(corners[:, :, 0].min(axis=1), kind="stable")
    low = corners[order].min(axis=1)
    high = corners[order].max(axis=1) + distance
    for first in range(0, len(faces), _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        # Only faces that begin later along x, and before the last of these rows ends.
        others = slice(first, int(np.searchsorted(low[:, 0], high[rows, 0].max(), "right")))
        touch = (low[rows, None] <= high[None, others]).all(axis=2)
        touch &= (low[None, others] <= high[rows, None]).all(axis=2)
        a, b = (order[first + axis] for axis in np.nonzero(touch))
        a, b = np.minimum(a, b), np.maximum(a, b)
        shared = (faces[a][:, :, None] == faces[b][:, None, :]).any(axis=(1, 2))
        yield np.unique(np.stack([a, b], axis=1)[~shared & (a < b)], axis=0)
