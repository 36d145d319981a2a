"""The latent pose space: slopes of patches' means, solved once, and cached features."""

from __future__ import annotations

import gc
import weakref

import numpy as np
from scipy.sparse import csr_matrix

from lcollision_core.bodies import LearnedBody, sample_poses
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.pose_space import LatentPoseSpace


def patches(model: LearnedBody) -> FloatArray:
    """Return the (4, V) weights of four means over a tenth of the vertices each."""
    generator = np.random.default_rng(0)
    weights = generator.random((4, model.n_vertices))
    weights[generator.random(weights.shape) > 0.1] = 0.0
    return weights / weights.sum(axis=1, keepdims=True)


def test_mean_slopes_are_those_of_vertices(tube_model: LearnedBody) -> None:
    space, weights = tube_model.space, patches(tube_model)
    slopes = space.mean_slopes(csr_matrix(weights))
    rows = (weights[:, None, :, None] * np.eye(3)[None, :, None, :]).reshape(12, -1, 3)
    others = np.random.default_rng(1).normal(size=(2, tube_model.n_vertices, 3))
    for codes in sample_poses(tube_model, 3, seed=4):
        for further in (others, others[:0]):
            expected = space.pull_back(codes, np.concatenate([rows, further]))
            found = slopes(codes, further)
            assert found.shape == (12 + len(further), len(codes))
            np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_mean_slopes_are_those_of_differences(tube_model: LearnedBody) -> None:
    # The decoder's features are float32, so the step must be far above their rounding error.
    step = 1e-2
    space, weights = tube_model.space, patches(tube_model)
    codes = sample_poses(tube_model, 1, seed=4)[0]
    slopes = space.mean_slopes(csr_matrix(weights))(codes, np.empty((0, tube_model.n_vertices, 3)))
    differences = np.empty_like(slopes)
    for code, unit in enumerate(np.eye(len(codes))):
        decoded = space.decode(codes + step * np.array([[2.0], [1.0], [-1.0], [-2.0]]) * unit)
        along = (-decoded[0] + 8.0 * decoded[1] - 8.0 * decoded[2] + decoded[3]) / (12.0 * step)
        differences[:, code] = (weights @ along).ravel()
    scale = np.abs(slopes).max()
    assert scale > 0.001
    np.testing.assert_allclose(slopes, differences, atol=2e-3 * scale)


def test_a_pose_does_not_depend_on_the_one_before(tube_model: LearnedBody) -> None:
    """The features of the last codes are cached, and codes may be changed in place."""
    space, poses = tube_model.space, sample_poses(tube_model, 2, seed=4)
    slopes = space.mean_slopes(csr_matrix(patches(tube_model)))
    none = np.empty((0, tube_model.n_vertices, 3))
    together = space.decode(poses)
    by_codes = [slopes(codes, none) for codes in poses]
    assert not np.array_equal(*by_codes)
    here = np.empty((1, poses.shape[1]))
    for pose in (0, 1, 1, 0):
        here[0] = poses[pose]
        assert np.array_equal(slopes(here[0], none), by_codes[pose])
        here[0] = poses[1 - pose]
        assert np.array_equal(space.decode(here)[0], together[1 - pose])


def test_chosen_vertices_are_those_of_all(tube_model: LearnedBody) -> None:
    space, poses, chosen = tube_model.space, sample_poses(tube_model, 3, seed=5), np.array([9, 2])
    assert space.decode_some(poses, chosen).tobytes() == space.decode(poses)[:, chosen].tobytes()


def test_a_space_remembers_its_last_poses_and_nothing_keeps_it(tube_model: LearnedBody) -> None:
    space = LatentPoseSpace(tube_model.embedding)
    codes = np.random.default_rng(4).uniform(space.low, space.high, (30, len(space.low)))
    first = space.decode(codes[:1])
    assert np.shares_memory(first, space.decode(codes[:1]))
    for one in codes:
        np.testing.assert_array_equal(
            space.decode(one[None]), tube_model.embedding.decode(one[None])
        )
    # It has been replaced in the cache.
    assert not np.shares_memory(first, space.decode(codes[:1]))
    gone = weakref.ref(space)
    gc.disable()
    try:
        del space
        assert gone() is None
    finally:
        gc.enable()
