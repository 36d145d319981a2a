"""Exact self-collision against python-fcl and coal, pose by pose in one run.

The peers know no "share a vertex" rule, so they are asked for every contact of the mesh with
itself and their neighbours are dropped afterwards; they cannot stop at the first pair that
counts. Each of their poses includes building their tree, as python-fcl cannot refit one; ours
is built once for the set. Drawing the same poses in turn with every tool keeps the ratios honest
on a machine whose speed drifts.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import CollisionDetector, SelfCollisions
from lcollision_core.jobs import Progress, no_progress
from lcollision_core.meshes import PoseSet

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]
T = TypeVar("T")
FindPairs = Callable[[FloatArray, IntArray], npt.NDArray[np.int64]]

MAX_CONTACTS = 10_000_000
"""Far above the number of contacts of a mesh with itself, so that no peer's list is cut."""

REPEATS = 5
"""Calls per pose of ours, which is quick enough to be disturbed by a single interruption."""

THROUGHPUT_ROUNDS = 5


@dataclass(frozen=True, slots=True)
class DetectionTiming:
    """One row of ``lcollision benchmark detection``.

    Attributes
    ----------
    vertices, poses : size of the meshes, and how many were timed
    tool : "lcollision", "python-fcl" or "coal"
    threads : that the tool used
    mode : "all" finds every pair with its depth, "first" stops at the first
    ms_per_pose : median over the poses; with several threads, batch time over batch size
    agrees : whether its set of pairs equals ours on every pose (verdicts, in mode "first")
    """

    vertices: int
    poses: int
    tool: str
    threads: int
    mode: Literal["all", "first"]
    ms_per_pose: float
    agrees: bool


def time_detection(
    poses: PoseSet, n_poses: int, threads: int, progress: Progress = no_progress
) -> list[DetectionTiming]:
    """Time all tools on evenly spaced poses of one set.

    Parameters
    ----------
    poses : the set
    n_poses : how many of them to time
    threads : for the batch rows
    progress : in poses
    """
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(n_poses, len(poses))).astype(int))
    vertices = poses.vertices[chosen].astype(np.float64)
    detector = CollisionDetector(poses.topology, vertices[0])
    peers = {name: find for name, find in _PEERS.items() if find_spec(_MODULES[name])}

    detector.are_colliding(vertices[:1])  # load the compiled code
    truth: list[SelfCollisions] = []
    ours: dict[str, list[float]] = {"all": [], "first": []}
    theirs: dict[str, list[float]] = {name: [] for name in peers}
    agrees = dict.fromkeys(peers, True)
    verdicts = []
    for done, pose in enumerate(vertices):
        seconds, found = _timed(partial(detector.detect, pose), REPEATS)
        ours["all"].append(seconds)
        truth.append(found)
        seconds, verdict = _timed(partial(detector.are_colliding, pose[None], workers=1), REPEATS)
        ours["first"].append(seconds)
        verdicts.append(bool(verdict[0]) == found.colliding)
        expected = set(map(tuple, found.pairs.tolist()))
        for name, find in peers.items():
            seconds, contacts = _timed(partial(find, pose, poses.faces))
            theirs[name].append(seconds)
            agrees[name] &= _disjoint_pairs(contacts, poses.faces) == expected
        progress(done + 1, len(vertices))

    def row(
        tool: str,
        n_threads: int,
        mode: Literal["all", "first"],
        seconds: Iterable[float],
        agreed: bool,
    ) -> DetectionTiming:
        return DetectionTiming(
            vertices=poses.topology.n_vertices,
            poses=len(vertices),
            tool=tool,
            threads=n_threads,
            mode=mode,
            ms_per_pose=1e3 * statistics.median(seconds),
            agrees=agreed,
        )

    rows = [
        row("lcollision", 1, "all", ours["all"], True),
        row("lcollision", 1, "first", ours["first"], all(verdicts)),
    ]
    if threads > 1:
        whole = [
            _timed(lambda: detector.detect_batch(vertices, workers=threads))
            for _ in range(THROUGHPUT_ROUNDS)
        ]
        same = [
            bool((batch.n_pairs == [len(found.pairs) for found in truth]).all())
            for _, batch in whole
        ]
        per_pose = [seconds / len(vertices) for seconds, _ in whole]
        rows.append(row("lcollision", threads, "all", per_pose, all(same)))
    rows += [row(name, 1, "all", theirs[name], agrees[name]) for name in peers]
    return rows


def missing_peers() -> list[str]:
    """Return the names of the peers that are not installed."""
    return [name for name, module in _MODULES.items() if find_spec(module) is None]


def _timed(call: Callable[[], T], repeats: int = 1) -> tuple[float, T]:
    """Return the median seconds of some calls, and the last result."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds), result


def _disjoint_pairs(contacts: npt.NDArray[np.int64], faces: IntArray) -> set[tuple[int, ...]]:
    """Drop contacts of a face with itself or with one that shares a vertex."""
    first, second = faces[contacts[:, 0]], faces[contacts[:, 1]]
    share = (first[:, :, None] == second[:, None, :]).any(axis=(1, 2))
    return set(map(tuple, np.sort(contacts[~share], axis=1).tolist()))


def _contacts_of_fcl(vertices: FloatArray, faces: IntArray) -> npt.NDArray[np.int64]:
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
    result = coal.CollisionResult()
    here = coal.Transform3s.Identity()
    coal.collide(model, here, model, here, request, result)
    pairs = [(contact.b1, contact.b2) for contact in result.getContacts()]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


_MODULES = {"python-fcl": "fcl", "coal": "coal"}
_PEERS: dict[str, FindPairs] = {"python-fcl": _contacts_of_fcl, "coal": _contacts_of_coal}
