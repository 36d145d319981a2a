"""Slopes of penetration depths by corners and by codes, against finite differences."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, sample_poses
from lcollision_core.contact import depth_slopes, penetration_depth
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import ExactCheck
from lcollision_core.posing.exact import ContactRegions, contact_slopes
from lcollision_core.resolve.problem import single_torch_thread

STEP = 1e-6


def colliding_triangles(n_pairs: int) -> tuple[FloatArray, FloatArray]:
    generator = np.random.default_rng(0)
    a, b = generator.normal(size=(2, 5 * n_pairs, 3, 3))
    kept = np.flatnonzero(penetration_depth(a, b) > 0.0)[:n_pairs]
    assert len(kept) == n_pairs
    return a[kept], b[kept]


def test_depths_are_those_of_the_exact_check() -> None:
    a, b = colliding_triangles(100)
    depth, _ = depth_slopes(a, b)
    np.testing.assert_allclose(depth, penetration_depth(a, b), rtol=0, atol=1e-14)


def test_slopes_by_corners_are_those_of_differences() -> None:
    a, b = colliding_triangles(100)
    _, slopes = depth_slopes(a, b)
    corners = np.concatenate([a, b], axis=1)
    differences = np.empty_like(slopes)
    for corner in range(6):
        for axis in range(3):
            ends = []
            for sign in (1.0, -1.0):
                moved = corners.copy()
                moved[:, corner, axis] += sign * STEP
                ends.append(penetration_depth(moved[:, :3], moved[:, 3:]))
            differences[:, corner, axis] = (ends[0] - ends[1]) / (2.0 * STEP)
    np.testing.assert_allclose(slopes, differences, atol=1e-6)
    assert np.abs(slopes).max() > 0.5
    # Moving or rotating both together changes nothing.
    np.testing.assert_allclose(slopes.sum(axis=1), 0.0, atol=1e-12)


def test_both_kinds_of_direction_are_met() -> None:
    """A corner through a face and an edge through an edge, with known depths."""
    face = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
    corner = [[1, 1, -0.1], [1, 1, 3], [1.5, 1, 3]]
    depth, slopes = depth_slopes([face], [corner])
    assert depth.tolist() == pytest.approx([0.1])
    np.testing.assert_allclose(slopes[0, 3], [0, 0, -1], atol=1e-12)
    ridge = [[-2, 0, 0], [2, 0, 0], [0, 0.1, -4]]
    across = [[0, -2, -0.2], [0, 2, -0.2], [0.1, 0, 4]]
    depth, slopes = depth_slopes([ridge], [across])
    assert depth.tolist() == pytest.approx([0.2])
    np.testing.assert_allclose(slopes[0, :2].sum(axis=0), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(slopes[0, 3:5].sum(axis=0), [0, 0, -1], atol=1e-12)


@pytest.fixture(scope="module")
def colliding(tube_model: LearnedBody) -> FloatArray:
    return sample_poses(tube_model, 6, seed=3, colliding=True)


def check_of(model: LearnedBody) -> ExactCheck:
    return model.exact_check()


def test_slopes_by_codes_are_those_of_differences(
    tube_model: LearnedBody, colliding: FloatArray
) -> None:
    # The decoder's features are float32, so the step must be far above their rounding error.
    step = 1e-2
    generator = np.random.default_rng(1)
    by_vertices = generator.normal(size=(3, tube_model.n_vertices, 3))
    latent = colliding[0]
    slopes = tube_model.space.pull_back(latent, by_vertices)
    differences = np.empty_like(slopes)
    for code in range(tube_model.latent_size):
        ends = np.tile(latent, (4, 1))
        ends[:, code] += step * np.array([2.0, 1.0, -1.0, -2.0])
        decoded = tube_model.embedding.decode(ends)
        along = (-decoded[0] + 8.0 * decoded[1] - 8.0 * decoded[2] + decoded[3]) / (12.0 * step)
        differences[:, code] = (by_vertices * along).sum(axis=(1, 2))
    scale = np.abs(slopes).max()
    assert scale > 0.1
    np.testing.assert_allclose(slopes, differences, atol=2e-3 * scale)


def test_contacts_get_shallower_against_their_slopes(
    tube_model: LearnedBody, colliding: FloatArray
) -> None:
    check = check_of(tube_model)
    for latent in colliding:
        decoded = check.decode(latent)[0]
        found = check.find(check.exported(decoded))
        regions = ContactRegions.of(check.space, found)
        deepest, slopes = contact_slopes(check.space, latent, decoded, found, regions)
        depth = regions.depth[deepest]
        assert depth.max() <= found.penetration_depth.max() * (1 + 1e-12)
        assert (np.diff(depth) <= 0.0).all()
        assert len(depth) == len(slopes) >= 1
        step = 1e-3 * found.penetration_depth.max() * slopes[0] / (slopes[0] @ slopes[0])
        # The same pairs, moved out a little: their weighted depth falls as the slope predicts.
        a, b = tube_model.faces[found.pairs].transpose(1, 0, 2)
        weights = found.penetration_depth**2

        def mean_depth(at: FloatArray, a=a, b=b, weights=weights) -> float:
            moved = check.decode(at)[0]
            depths, _ = depth_slopes(moved[a], moved[b])
            return float(weights @ depths / weights.sum())

        if len(depth) == 1:
            fall = mean_depth(latent - step) - mean_depth(latent + step)
            expected = -2.0 * float(slopes[0] @ step)
            assert fall == pytest.approx(expected, rel=0.05)


def test_the_displacement_metric_measures_vertices(tube_model: LearnedBody) -> None:
    """Its distance predicts the mean squared vertex motion; the Euclidean one does not."""
    embedding = tube_model.embedding
    metric = tube_model.space.metric
    generator = np.random.default_rng(2)
    latents = tube_model.latent_space.sample(40, generator)
    steps = 0.05 * generator.normal(size=latents.shape) * embedding.latent_deviation
    moved = embedding.decode(latents + steps) - embedding.decode(latents)
    squared = (moved**2).sum(axis=2).mean(axis=1)
    ratio = np.sqrt(np.einsum("ni,ij,nj->n", steps, metric, steps) / squared)
    assert 0.7 < np.median(ratio) < 1.5
    plain = np.linalg.norm(steps, axis=1) / np.sqrt(squared)
    assert np.std(np.log(ratio)) < np.std(np.log(plain))
    assert (np.linalg.eigvalsh(metric) > 0.0).all()


_WHILE_TORCH_IS_IMPORTED = """
import sys, threading, time
from lcollision_core.resolve.problem import single_torch_thread
assert "torch" not in sys.modules
threading.Thread(target=lambda: __import__("torch")).start()
while "torch" not in sys.modules:
    time.sleep(0.001)
with single_torch_thread():
    print(sys.modules["torch"].get_num_threads())
"""


@pytest.mark.slow
def test_a_solve_waits_for_torch_where_another_thread_imports_it() -> None:
    command = [sys.executable, "-c", _WHILE_TORCH_IS_IMPORTED]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "1\n"


def test_torch_gets_its_threads_back() -> None:
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with single_torch_thread():
            assert torch.get_num_threads() == 1
            with single_torch_thread():
                assert torch.get_num_threads() == 1
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
