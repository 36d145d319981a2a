"""Exact checks on a GPU against those on the CPU: equal results, and microseconds per pose.

The fields of a row:

what : "all pairs", with energies; "any pair"; "all pairs, on the GPU", of poses already there;
    "codes to labels", for models with a predictor
items : poses
equal : whether both find the same counting pairs of faces, verdicts, or numbers of pairs
difference : largest difference of a depth or an energy, relative to the largest value
us_cpu, us_gpu : microseconds per pose on all cores, and on the GPU after a call that compiles
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from app.benchmarks.measures import Row, median_seconds
from lcollision_core.bodies import Body, LearnedBody
from lcollision_core.contact import CollisionDetector
from lcollision_core.contact.kernels import COUNTED
from lcollision_core.devices import Device, choose_device
from lcollision_core.files import PoseSet
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.labels import Labeller

_ROUNDS = 3

Vertices = npt.NDArray[np.float32]


def time_gpu(body: Body, n_poses: int, job: Job = UNWATCHED) -> list[Row]:
    """Compare checks of random poses of a body, and their labels if it has a predictor."""
    codes = body.sample(n_poses, np.random.default_rng(0))
    rows = time_checks(body.detector, body.decode(codes).astype(np.float32), job)
    if body.has_predictor:
        labeller = LearnedBody.load(body.name).labeller()
        rows.append(_time_labels(labeller, codes.astype(np.float32)))
    return rows


def blended_poses(poses: PoseSet, n_poses: int) -> Vertices:
    """Return the first poses of a set, filled up to `n_poses` by blends of random pairs."""
    generator = np.random.default_rng(0)
    given_poses = poses.vertices[:n_poses].astype(np.float32)
    first, second = generator.integers(len(given_poses), size=(2, n_poses - len(given_poses)))
    share = generator.random((n_poses - len(given_poses), 1, 1), dtype=np.float32)
    return np.concatenate(
        [given_poses, given_poses[first] + share * (given_poses[second] - given_poses[first])]
    )


def time_checks(detector: CollisionDetector, vertices: Vertices, job: Job = UNWATCHED) -> list[Row]:
    """Compare the checks of (B, V, 3) vertices; `job` is polled between them."""
    from lcollision_core.on_gpu import cuda

    search, n_poses = detector.gpu_search(), len(vertices)
    starts = range(0, n_poses, search.at_once)
    there = [cuda.to_device(vertices[start : start + search.at_once]) for start in starts]

    def all_there() -> None:
        for part in there:
            search.search(part, with_energy=True).n_by_rule.copy_to_host()

    equal, difference = _same_pairs(detector, vertices)
    job.check()
    pairs, pair_times = _on_both(n_poses, lambda: detector.detect_batch(vertices))
    job.check()
    verdicts, any_times = _on_both(n_poses, lambda: detector.are_colliding(vertices))
    energies = [collisions.vertex_energy for collisions in pairs]
    all_there()
    return [
        _row("all pairs", n_poses, equal, max(difference, _difference(*energies)), pair_times),
        _row("any pair", n_poses, np.array_equal(*verdicts), 0.0, any_times),
        _row(
            "all pairs, on the GPU",
            n_poses,
            equal,
            difference,
            (pair_times[0], _microseconds(all_there, n_poses)),
        ),
    ]


def _time_labels(labeller: Labeller, codes: npt.NDArray[np.float32]) -> Row:
    labeller.prepare()
    rows, times = _on_both(len(codes), lambda: labeller.label(codes))
    equal = np.array_equal(*(label.n_pairs for label in rows))
    difference = _difference(*(label.domain_energy for label in rows))
    return _row("codes to labels", len(codes), equal, difference, times)


def _same_pairs(detector: CollisionDetector, vertices: Vertices) -> tuple[bool, float]:
    """Compare the pairs that count and, if they are equal, their depths."""
    of_processor = [detector.detect(pose) for pose in vertices]
    listed = detector.gpu_search().list_pairs(vertices)
    counts = listed.rule == COUNTED
    pose = np.repeat(
        np.arange(len(of_processor)), [collisions.n_pairs for collisions in of_processor]
    )
    pairs = np.concatenate([collisions.pairs for collisions in of_processor])
    equal = np.array_equal(listed.pose[counts], pose)
    if not (equal and np.array_equal(listed.pairs[counts], pairs)):
        return False, np.inf
    depths = np.concatenate([collisions.penetration_depth for collisions in of_processor])
    return True, _difference(depths, np.sqrt(listed.squared_depth[counts]))


def _on_both(n_poses: int, call: Callable[[], Any]) -> tuple[list[Any], tuple[float, float]]:
    """Return the results of a call on both devices, and its microseconds per pose."""
    results, times = [], []
    for device in (Device.CPU, Device.CUDA):
        choose_device(device)
        results.append(call())
        times.append(_microseconds(call, n_poses))
    return results, (times[0], times[1])


def _microseconds(call: Callable[[], object], n_poses: int) -> float:
    return 1e6 * median_seconds([call] * _ROUNDS) / n_poses


def _difference(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> float:
    return float(np.abs(one - other).max(initial=0.0) / max(np.abs(one).max(initial=0.0), 1e-300))


def _row(what: str, items: int, equal: bool, difference: float, times: tuple[float, float]) -> Row:
    return {
        "what": what,
        "items": items,
        "equal": equal,
        "difference": difference,
        "us_cpu": times[0],
        "us_gpu": times[1],
    }
