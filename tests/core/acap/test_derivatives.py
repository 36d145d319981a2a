"""Derivatives of decoding, against central differences, and the scaling of features."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import csr_matrix

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.acap.features import FeatureScaling
from lcollision_core.errors import ShapeError
from tests.core.shapes import join, sphere

FloatArray = npt.NDArray[np.float64]
STEP = 1e-5


@pytest.fixture(scope="module")
def codec() -> AcapCodec:
    """Return the codec of two spheres and a loose vertex, anchored unevenly."""
    mesh = join(sphere(n=10), sphere(0.3, 6).moved([1.6, 0.2, 0.1]))
    vertices = np.concatenate([mesh.vertices, [[3.0, 0.0, 0.0]]])
    weights = np.linspace(0.0, 1.0, len(vertices))
    return AcapCodec(type(mesh.topology)(mesh.faces, len(vertices)), vertices, weights)


@pytest.fixture(scope="module")
def features(codec: AcapCodec) -> FloatArray:
    """Return three fields: some rotations zero, some tiny, some beyond half and full turns."""
    rng = np.random.default_rng(0)
    n_vertices = codec.topology.n_vertices
    fields = np.zeros((3, n_vertices, 9))
    fields[..., [3, 6, 8]] = 1.0
    fields += 0.3 * rng.normal(size=fields.shape)
    fields[0, ::3, :3] = 0.0
    fields[1, ::3, :3] *= 1e-6
    fields[2, ::3, :3] *= 20.0
    return fields


def test_forward_derivative_is_the_central_difference(
    codec: AcapCodec, features: FloatArray
) -> None:
    tangents = np.random.default_rng(1).normal(size=(11, *features.shape[1:]))
    for at in features:
        moved = codec.decode_jvp(at, tangents)
        difference = codec.decode(at + STEP * tangents) - codec.decode(at - STEP * tangents)
        assert moved == pytest.approx(difference / (2 * STEP), abs=1e-7)
        assert np.abs(moved).max() > 0.1


def test_backward_is_the_transpose_of_forward(codec: AcapCodec, features: FloatArray) -> None:
    rng = np.random.default_rng(4)
    n_poses = 20
    fields = features[rng.integers(0, 3, n_poses)]
    tangents = rng.normal(size=fields.shape)
    pulls = rng.normal(size=(n_poses, codec.topology.n_vertices, 3))
    pulled = codec.decode_vjp(fields, pulls)
    for pose in range(n_poses):
        moved = codec.decode_jvp(fields[pose], tangents[pose : pose + 1])[0]
        assert (pulled[pose] * tangents[pose]).sum() == pytest.approx(
            (pulls[pose] * moved).sum(), rel=1e-9
        )
        one = slice(pose, pose + 1)
        assert np.array_equal(codec.decode_vjp(fields[one], pulls[one])[0], pulled[pose])


@pytest.mark.parametrize("n_patches", [1, 3, 25])
def test_derivatives_of_means_are_the_central_differences(
    codec: AcapCodec, features: FloatArray, n_patches: int
) -> None:
    rng = np.random.default_rng(5)
    n_vertices = codec.topology.n_vertices
    weights = np.where(rng.random((n_patches, n_vertices)) < 0.2, rng.random(n_vertices), 0.0)
    by_gradients = codec.means_by_gradients(csr_matrix(weights))
    pulls = rng.normal(size=(2, n_vertices, 3))
    for at in features:
        by_features = codec.means_vjp(at, by_gradients, pulls)
        assert by_features.shape == (3 * n_patches + 2, n_vertices, 9)
        for tangent in rng.normal(size=(4, n_vertices, 9)):
            ends = codec.decode(np.stack([at + STEP * tangent, at - STEP * tangent]))
            moved = (ends[0] - ends[1]) / (2 * STEP)
            expected = np.append((weights @ moved).ravel(), (pulls * moved).sum(axis=(1, 2)))
            assert (by_features * tangent).sum(axis=(1, 2)) == pytest.approx(expected, abs=1e-5)
            assert np.abs(expected).max() > 0.1


def test_derivatives_of_means_are_those_of_their_vertices(
    codec: AcapCodec, features: FloatArray
) -> None:
    rng = np.random.default_rng(6)
    weights = rng.random((2, codec.topology.n_vertices))
    by_gradients = codec.means_by_gradients(csr_matrix(weights))
    rows = (weights[:, None, :, None] * np.eye(3)[None, :, None, :]).reshape(6, -1, 3)
    none = np.empty((0, *rows.shape[1:]))
    for at in features:
        expected = codec.decode_vjp(np.repeat(at[None], 6, axis=0), rows)
        by_features = codec.means_vjp(at, by_gradients, none)
        assert by_features == pytest.approx(expected, abs=1e-13 * np.abs(expected).max())


def test_other_shapes_are_refused(codec: AcapCodec, features: FloatArray) -> None:
    n_vertices = codec.topology.n_vertices
    with pytest.raises(ShapeError, match=r"weights must be of shape \(m, "):
        codec.means_by_gradients(csr_matrix((1, n_vertices + 1)))
    with pytest.raises(ShapeError, match="features must be of shape"):
        codec.decode(np.zeros((1, n_vertices - 1, 9)))
    with pytest.raises(ShapeError, match="tangents must be of shape"):
        codec.decode_jvp(features[0], np.zeros((2, n_vertices, 3)))
    with pytest.raises(ShapeError, match="features must be of 1 or 3 poses, got 2"):
        codec.decode_vjp(np.zeros((2, n_vertices, 9)), np.zeros((3, n_vertices, 3)))


def test_scaling_takes_a_set_to_its_bounds_and_back(features: FloatArray) -> None:
    scaling = FeatureScaling.fit(features)
    scaled = scaling.apply(features)
    for numbers in (scaled[..., :3], scaled[..., 3:]):
        assert numbers.min() == pytest.approx(-0.95, abs=1e-12)
        assert numbers.max() == pytest.approx(0.95, abs=1e-12)
    assert scaling.invert(scaled) == pytest.approx(features, abs=1e-12)


def test_scaling_of_a_still_set_only_shifts() -> None:
    still = np.zeros((2, 4, 9))
    still[..., 3:] = 2.5
    scaling = FeatureScaling.fit(still)
    assert scaling == FeatureScaling(0.0, 1.0, 2.5, 1.0)
    assert np.array_equal(scaling.apply(still), np.zeros_like(still))
