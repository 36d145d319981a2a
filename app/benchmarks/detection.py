"""Exact self-collision against python-fcl and coal, pose by pose in one run.

The peers have no "share a vertex" rule, so they report every contact of the mesh with itself and
neighbours are dropped afterwards; they cannot stop at the first pair that counts. Their times
include building a tree for each pose, as python-fcl cannot refit one; our tree is built once for
the set. All tools get the same poses within one run, so their ratios hold even if the machine's
speed drifts between runs.

The fields of a row:

vertices, poses : size of the meshes, and how many were timed
tool : "lcollision", "python-fcl" or "coal"
threads : that the tool used
mode : "all" finds every pair with its depth, "first" stops at the first
ms_per_pose : a peer's median over the poses; ours is the median over `ROUNDS` batches of
    the batch's time over its size
agrees : whether its pairs equal ours on every pose (in mode "first", its verdicts)
"""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from app.benchmarks.measures import Row
from lcollision_core.contact import CollisionDetector
from lcollision_core.files import PoseSet
from lcollision_core.jobs import UNWATCHED, Job

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]
T = TypeVar("T")
FindPairs = Callable[[FloatArray, IntArray], npt.NDArray[np.int64]]

MAX_CONTACTS = 10_000_000
"""Far above a mesh's number of contacts with itself, so that no peer truncates its list."""

COAL_TOLERANCE = 1e-9
"""Distance, in the mesh's unit, below which coal counts two faces as touching."""

ROUNDS = 5
"""Number of our batches whose median time is reported."""

BATCH_POSES_PER_THREAD = 32


def time_detection(poses: PoseSet, n_poses: int, threads: int, job: Job = UNWATCHED) -> list[Row]:
    """Time all tools on evenly spaced poses of one set.

    Parameters
    ----------
    poses : the set
    n_poses : how many of them to time
    threads : of our second row; 1 for no such row
    job : reports poses
    """
    pose_numbers = np.unique(np.linspace(0, len(poses) - 1, min(n_poses, len(poses))).astype(int))
    vertices = poses.vertices[pose_numbers].astype(np.float64)
    detector = CollisionDetector(poses.topology, vertices[0])
    expected = [set(map(tuple, detector.detect(pose).pairs.tolist())) for pose in vertices]
    # By tool, threads and mode: seconds per pose, and whether the answer was right.
    runs: dict[tuple[str, int, str], list[tuple[float, bool]]] = defaultdict(list)

    # Many poses per thread, so that start-up and idling at the end are negligible.
    repeats = -(-BATCH_POSES_PER_THREAD * threads // len(vertices))
    batch = np.tile(vertices, (repeats, 1, 1))
    n_pairs = np.tile([len(pairs) for pairs in expected], repeats)
    for _ in range(ROUNDS):
        for count in sorted({1, threads}):
            seconds, collisions = _timed(partial(detector.detect_batch, batch, workers=count))
            agrees = bool((collisions.n_pairs == n_pairs).all())
            runs["lcollision", count, "all"].append((seconds / len(batch), agrees))
        seconds, verdicts = _timed(partial(detector.are_colliding, batch, workers=1))
        agrees = bool((verdicts == (n_pairs > 0)).all())
        runs["lcollision", 1, "first"].append((seconds / len(batch), agrees))
    peers = {name: find for name, find in _PEERS.items() if find_spec(_MODULES[name])}
    for done, (pose, pairs) in enumerate(zip(vertices, expected, strict=True), 1):
        for name, find in peers.items():
            seconds, contacts = _timed(partial(find, pose, poses.faces))
            runs[name, 1, "all"].append((seconds, _disjoint_pairs(contacts, poses.faces) == pairs))
        job.report(done, len(vertices))
    return [
        {
            "vertices": poses.topology.n_vertices,
            "poses": len(vertices),
            "tool": tool,
            "threads": n_threads,
            "mode": mode,
            "ms_per_pose": 1e3 * statistics.median(seconds for seconds, _ in timed),
            "agrees": all(agrees for _, agrees in timed),
        }
        for (tool, n_threads, mode), timed in runs.items()
    ]


def missing_peers() -> list[str]:
    """Return the names of the peers that are not installed."""
    return [name for name, module in _MODULES.items() if find_spec(module) is None]


def _timed(call: Callable[[], T]) -> tuple[float, T]:
    start = time.perf_counter()
    result = call()
    return time.perf_counter() - start, result


def _disjoint_pairs(contacts: npt.NDArray[np.int64], faces: IntArray) -> set[tuple[int, ...]]:
    """Drop contacts of a face with itself or with one that shares a vertex."""
    first, second = faces[contacts[:, 0]], faces[contacts[:, 1]]
    adjacent = (first[:, :, None] == second[:, None, :]).any(axis=(1, 2))
    return set(map(tuple, np.sort(contacts[~adjacent], axis=1).tolist()))


def contacts_of_fcl(vertices: FloatArray, faces: IntArray) -> npt.NDArray[np.int64]:
    """Return (P, 2) faces that touch by python-fcl, including faces that share a vertex."""
    import fcl

    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(vertices, faces)
    model.endModel()
    request = fcl.CollisionRequest(num_max_contacts=MAX_CONTACTS, enable_contact=True)
    result = fcl.CollisionResult()
    fcl.collide(fcl.CollisionObject(model), fcl.CollisionObject(model), request, result)
    pairs = [(contact.b1, contact.b2) for contact in result.contacts]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _contacts_of_coal(vertices: FloatArray, faces: IntArray) -> npt.NDArray[np.int64]:
    import coal

    model = coal.BVHModelOBBRSS()
    model.beginModel(len(faces), len(vertices))
    model.addVertices(vertices)
    model.addTriangles(faces)
    model.endModel()
    request = coal.CollisionRequest()
    request.num_max_contacts = MAX_CONTACTS
    request.enable_contact = True
    # Its default of 1e-6 reports faces that are apart: one pair in frame 101 of MIT jumping.
    request.gjk_tolerance = COAL_TOLERANCE
    result = coal.CollisionResult()
    here = coal.Transform3s.Identity()
    coal.collide(model, here, model, here, request, result)
    pairs = [(contact.b1, contact.b2) for contact in result.getContacts()]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


_MODULES = {"python-fcl": "fcl", "coal": "coal"}
_PEERS: dict[str, FindPairs] = {"python-fcl": contacts_of_fcl, "coal": _contacts_of_coal}
