"""Several pose sets combined, without near-duplicates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.errors import CancelledError
from lcollision_core.files import PoseSet, concatenated, thinned
from lcollision_core.jobs import Job
from lcollision_core.meshes import body_size, fit_rigid
from tests.bending_tube import bending_tube
from tests.core.shapes import random_rotation


def made_of(vertices: np.ndarray, poses: PoseSet) -> PoseSet:
    return PoseSet(vertices, poses.topology, tuple(f"pose {n}" for n in range(len(vertices))))


def test_near_duplicates_are_left_out_wherever_they_lie() -> None:
    poses = bending_tube()
    size = float(np.ptp(poses.vertices[0], axis=0).max())
    random = np.random.default_rng(2)
    copies = np.stack(
        [pose @ random_rotation(random).T + random.normal(size=3) for pose in poses.vertices]
    )
    copies += 1e-3 * size * random.uniform(-1, 1, copies.shape)
    both = made_of(np.concatenate([poses.vertices, copies]), poses)
    alone = thinned(made_of(poses.vertices, poses))
    kept = thinned(both)
    assert kept.names == alone.names
    assert len(kept) > 10
    np.testing.assert_array_equal(kept.vertices[0], poses.vertices[0])
    n_left_out = len(both) - len(kept)
    assert kept.notes == (
        f"{n_left_out} poses are left out as nearly the same as others, within 0.5 % of the body "
        "size",
    )


@pytest.mark.parametrize("tolerance", [0.003, 0.006])
def test_the_distance_is_the_root_mean_square_after_the_best_motion(tolerance: float) -> None:
    poses = bending_tube()
    rest = poses.vertices[0].astype(np.float64)
    size = float(np.ptp(rest, axis=0).max())
    # Alternate vertices move out and in along an axis, which no rigid motion compensates.
    ways = np.where(np.arange(len(rest)) % 2, 1.0, -1.0)[:, None] * [0.0, 0.0, 1.0]
    ways -= ways.mean(axis=0)
    moved = rest + 0.0045 * size * ways
    n_kept = len(thinned(made_of(np.stack([rest, moved]), poses), tolerance))
    assert n_kept == (2 if tolerance < 0.0045 else 1)


def test_published_poses_are_hardly_thinned(scape: PoseSet, jumping: PoseSet) -> None:
    assert thinned(scape) is scape
    assert len(thinned(jumping)) == 145


def test_each_pose_is_compared_with_all_that_are_kept() -> None:
    tube = bending_tube()
    random = np.random.default_rng(3)
    chosen = random.integers(0, len(tube), 60)
    size = float(np.ptp(tube.vertices[0], axis=0).max())
    noise = random.normal(size=(60, *tube.vertices.shape[1:])) * size
    vertices = tube.vertices[chosen] + random.uniform(0.0, 0.004, (60, 1, 1)) * noise
    # A mirror image is a different pose.
    vertices = np.concatenate([vertices, vertices[:5] * [1.0, 1.0, -1.0]])
    kept: list[int] = []
    for pose, mesh in enumerate(vertices):
        turns, shifts = fit_rigid(vertices[kept], mesh)
        moved = np.einsum("kij,kvj->kvi", turns, vertices[kept]) + shifts[:, None]
        squares = ((moved - mesh) ** 2).sum(axis=2).mean(axis=1)
        if (squares >= (0.005 * body_size(vertices[0], tube.topology)) ** 2).all():
            kept.append(pose)
    assert 10 < len(kept) < 60
    assert thinned(made_of(vertices, tube)).names == tuple(f"pose {pose}" for pose in kept)


def test_thinning_can_be_cancelled() -> None:
    job = Job()
    job.cancel()
    with pytest.raises(CancelledError):
        thinned(bending_tube(), job=job)


def test_what_sets_are_made_of_is_listed() -> None:
    tube = bending_tube()

    def some(file: str, *poses: int, **provenance: object) -> PoseSet:
        names = tuple(f"p{pose}" for pose in poses)
        vertices = tube.vertices[list(poses)]
        return PoseSet(vertices, tube.topology, names, Path(file), provenance=provenance)

    plain = concatenated([some("a.npz", 0, 1), some("b.npz", 0, 2)])
    assert plain.provenance == {}
    assert plain.names == ("a p0", "a p1", "b p2")
    one = concatenated([some("a.npz", 0, 1), some("a.npz", 0, 2, 3, by_rig={"seed": 4})])
    assert one.names == ("p0", "p1", "p2", "p3")
    parts = [
        {"file": "a.npz", "poses": 2},
        {"file": "a.npz", "poses": 2, "by_rig": {"seed": 4}},
    ]
    assert one.provenance == {"sources": parts}
    more = concatenated([one, some("b.npz", 5)])
    assert more.provenance == {"sources": [*parts, {"file": "b.npz", "poses": 1}]}
    assert one.scaled(2.0).provenance == one.provenance
