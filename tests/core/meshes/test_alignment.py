from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lcollision_core.errors import CancelledError, ShapeError
from lcollision_core.files import PoseSet
from lcollision_core.jobs import Job
from lcollision_core.meshes import RigidTransform, align_rigid, body_size, fit_rigid, up_axis


def _body(seed: int = 0, n: int = 200) -> np.ndarray:
    """Return a cloud without symmetry, longest along y."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal((n, 3)) * [0.3, 1.0, 0.2] + [0.05, 0.0, 0.0]


def _turned(body: np.ndarray, rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    return body @ rotations.transpose(0, 2, 1) + translations[:, None]


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 1.0, 1e4]))
@settings(max_examples=50, deadline=None)
def test_rigid_copies_come_back_exactly(seed: int, unit: float) -> None:
    body = _body() * unit
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(4, rng).as_matrix()
    translations = rng.uniform(-3, 3, (4, 3)) * unit
    alignment = align_rigid(_turned(body, rotations, translations), body)
    assert np.abs(alignment.vertices - body).max() < 1e-12 * unit
    assert np.abs(alignment.rotations - rotations.transpose(0, 2, 1)).max() < 1e-12


def test_half_turns_about_any_axis_come_back() -> None:
    body = _body()
    axes = np.vstack([np.eye(3), [[0.6, 0.8, 0.0]], [[0.48, 0.6, 0.64]]])
    rotations = Rotation.from_rotvec(np.pi * axes).as_matrix()
    alignment = align_rigid(_turned(body, rotations, np.zeros((5, 3))), body)
    assert np.abs(alignment.vertices - body).max() < 1e-12


def test_an_arm_that_is_a_fifth_of_the_body_does_not_tilt_it() -> None:
    body = _body()
    rng = np.random.default_rng(1)
    rotations = Rotation.random(12, rng).as_matrix()
    poses = np.repeat(body[None], 12, axis=0)
    arm = np.argsort(body[:, 0])[-40:]
    shoulder = body[arm[0]]
    swings = Rotation.from_rotvec(rng.uniform(-2, 2, (12, 3))).as_matrix()
    poses[:, arm] = _turned(body[arm] - shoulder, swings, np.repeat(shoulder[None], 12, axis=0))
    alignment = align_rigid(_turned(poses, rotations, rng.uniform(-1, 1, (12, 3))), body)
    torso = np.setdiff1d(np.arange(len(body)), arm)
    assert np.abs(alignment.vertices[:, torso] - body[torso]).max() < 1e-12
    assert alignment.weights[torso].min() > 0.99
    assert alignment.weights[arm[1:]].max() < 1e-6
    plain, _ = fit_rigid(poses, body)
    assert np.abs(plain - np.eye(3)).max() > 0.05  # the arm tilts an unweighted fit


def test_alignment_does_not_depend_on_where_poses_stand() -> None:
    body = _body()
    rng = np.random.default_rng(2)
    poses = body + 0.1 * rng.standard_normal((6, *body.shape)) * (np.arange(200) > 120)[:, None]
    rotations = Rotation.random(6, rng).as_matrix()
    moved = _turned(poses, rotations[0][None].repeat(6, 0), np.ones((6, 3)))
    moved = np.stack([pose @ turn.T for pose, turn in zip(moved, rotations, strict=True)])
    here, there = align_rigid(poses, body), align_rigid(moved, body)
    assert np.abs(here.vertices - there.vertices).max() < 1e-12


def test_unit_scales_through() -> None:
    body = _body()
    poses = body + 0.1 * np.random.default_rng(3).standard_normal((6, *body.shape))
    small = align_rigid(poses * 1e-3, body * 1e-3)
    assert np.abs(small.vertices * 1e3 - align_rigid(poses, body).vertices).max() < 1e-12


def test_a_mirrored_body_is_turned_never_reflected() -> None:
    body = _body()
    alignment = align_rigid((body * [-1, 1, 1])[None], body)
    assert np.linalg.det(alignment.rotations[0]) == pytest.approx(1.0, abs=1e-12)
    assert np.abs(alignment.vertices[0] - body).max() > 0.1


def test_flat_meshes_align_without_reflection() -> None:
    flat = _body() * [1, 1, 0]
    rotations = Rotation.random(5, np.random.default_rng(4)).as_matrix()
    alignment = align_rigid(_turned(flat, rotations, np.zeros((5, 3))), flat)
    assert np.allclose(np.linalg.det(alignment.rotations), 1.0, atol=1e-12)
    assert np.abs(alignment.vertices - flat).max() < 1e-12


def test_a_mesh_shrunk_to_a_point_gets_some_rotation() -> None:
    alignment = align_rigid(np.ones((1, 200, 3)), _body())
    assert np.linalg.det(alignment.rotations[0]) == pytest.approx(1.0, abs=1e-12)


def test_transforms_follow_the_stated_convention() -> None:
    body = _body()
    poses = _turned(body, Rotation.random(3, np.random.default_rng(5)).as_matrix(), np.eye(3))
    alignment = align_rigid(poses, body)
    for pose in range(3):
        moved = poses[pose] @ alignment.rotations[pose].T + alignment.translations[pose]
        assert np.abs(moved - alignment.vertices[pose]).max() < 1e-14
        transform = RigidTransform(alignment.rotations[pose], alignment.translations[pose])
        assert np.abs(transform.apply(poses[pose]) - moved).max() < 1e-14
        back = transform.inverse().apply(alignment.vertices[pose])
        assert np.abs(back - poses[pose]).max() < 1e-13


def test_weights_choose_what_the_fit_follows() -> None:
    body = _body()
    bent = body.copy()
    bent[100:] = bent[100:] @ Rotation.from_rotvec([0, 0, 1.0]).as_matrix().T + 1.0
    weights = (np.arange(200) < 100).astype(float)
    rotation, translation = fit_rigid(bent, body, weights)
    fitted = RigidTransform(rotation, translation).apply(bent)
    assert np.abs(fitted[:100] - body[:100]).max() < 1e-13


def test_fit_is_the_minimum_over_small_turns_and_moves() -> None:
    body = _body()
    rng = np.random.default_rng(6)
    noisy = body + 0.1 * rng.standard_normal(body.shape)
    weights = rng.uniform(0.1, 1.0, 200)
    rotation, translation = fit_rigid(noisy, body, weights)

    def misfit(turn: np.ndarray, shift: np.ndarray) -> float:
        nudged = Rotation.from_rotvec(turn).as_matrix() @ rotation
        return float(weights @ ((noisy @ nudged.T + translation + shift - body) ** 2).sum(axis=1))

    best = misfit(np.zeros(3), np.zeros(3))
    for direction in np.vstack([np.eye(3), -np.eye(3)]):
        assert misfit(1e-3 * direction, np.zeros(3)) > best
        assert misfit(np.zeros(3), 1e-3 * direction) > best


def test_a_batch_is_fitted_as_its_members_are() -> None:
    body = _body()
    poses = body + 0.3 * np.random.default_rng(7).standard_normal((2, 3, *body.shape))
    rotations, translations = fit_rigid(poses, body)
    assert rotations.shape == (2, 3, 3, 3)
    for index in np.ndindex(2, 3):
        rotation, translation = fit_rigid(poses[index], body)
        assert np.abs(rotations[index] - rotation).max() < 1e-14
        assert np.abs(translations[index] - translation).max() < 1e-14


def test_wrong_shapes_are_refused() -> None:
    body = _body()
    with pytest.raises(ShapeError, match=r"\(N, V, 3\)"):
        align_rigid(body, body)
    with pytest.raises(ShapeError, match="200"):
        align_rigid(np.zeros((2, 199, 3)), body)
    with pytest.raises(ShapeError, match="weights"):
        fit_rigid(body, body, np.zeros(200))
    with pytest.raises(ShapeError, match="weights"):
        fit_rigid(body, body, np.ones(199))


def test_cancel_ends_the_alignment() -> None:
    token = Job()
    token.cancel()
    with pytest.raises(CancelledError):
        align_rigid(_body()[None], _body(), token)


def test_height_and_up_axis_are_the_longest_side() -> None:
    box = np.array([[0.0, -1.0, 0.0], [1.0, 2.0, 0.5]])
    assert body_size(box) == 3.0
    assert up_axis(box) == 1
    with pytest.raises(ShapeError, match=r"\(V, 3\)"):
        body_size(np.empty((0, 3)))


def _calm_motion(vertices: np.ndarray) -> float:
    """Return the normalised deviation of the stillest tenth of the body from its mean position."""
    spread = np.sqrt(((vertices - vertices.mean(axis=0)) ** 2).sum(axis=2).mean(axis=0))
    return float(np.quantile(spread, 0.1)) / body_size(vertices[0])


def test_scape_torsos_stay_put(scape: PoseSet) -> None:
    poses = scape.vertices.astype(np.float64)
    rotations, translations = fit_rigid(poses, poses[0])
    plain = poses @ rotations.transpose(0, 2, 1) + translations[:, None]
    alignment = align_rigid(poses, poses[0])
    assert np.allclose(np.linalg.det(alignment.rotations), 1.0, atol=1e-12)
    assert _calm_motion(alignment.vertices) < 0.5 * _calm_motion(plain)
    turns = Rotation.random(len(poses), np.random.default_rng(8)).as_matrix()
    turned = align_rigid(poses @ turns.transpose(0, 2, 1) + 5.0, poses[0])
    assert np.abs(turned.vertices - alignment.vertices).max() < 1e-10


def test_jumping_turns_smoothly(jumping: PoseSet) -> None:
    poses = jumping.vertices[:, ::10].astype(np.float64)
    rotations = align_rigid(poses, poses[0]).rotations
    steps = Rotation.from_matrix(rotations[1:] @ rotations[:-1].transpose(0, 2, 1)).magnitude()
    assert np.degrees(steps.max()) < 40.0
