"""Distances of triangles against exact arithmetic, another library and central differences."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from lcollision_core.contact import distance_slopes, triangle_distance
from lcollision_core.errors import ShapeError
from tests.core.brute_force import exact_distance
from tests.core.shapes import random_rotation

FloatArray = npt.NDArray[np.float64]

N = 20


def random_pairs(seed: int = 0) -> FloatArray:
    """(N, 2, 3, 3) pairs of triangles about the size of a body."""
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (N, 2, 3, 3))


def flat(pairs: FloatArray) -> FloatArray:
    """Put both triangles into one plane that contains no axis."""
    pairs[..., 2] = 0.0
    return pairs @ random_rotation(np.random.default_rng(5)).T


def thin(pairs: FloatArray, height: float, seed: int = 2) -> FloatArray:
    """Make both triangles slivers that may cross in the middle."""
    noise = np.random.default_rng(seed).uniform(-height, height, (N, 2, 3))
    pairs[:, :, 2] = 0.3 * pairs[:, :, 1] + 0.7 * pairs[:, :, 0] + noise
    return pairs - pairs.mean(axis=2, keepdims=True)


def with_edges_along(pairs: FloatArray, apart: float) -> FloatArray:
    """Align an edge of one approximately with an edge of the other."""
    noise = np.random.default_rng(3).uniform(-apart, apart, (N, 2, 3))
    edge = pairs[:, 0, 1] - pairs[:, 0, 0]
    pairs[:, 1, 0] = pairs[:, 0, 0] - 0.3 * edge + noise[:, 0]
    pairs[:, 1, 1] = pairs[:, 0, 1] + noise[:, 1]
    return pairs


def sharing(pairs: FloatArray, n_corners: int) -> FloatArray:
    pairs[:, 1, :n_corners] = pairs[:, 0, 3 - n_corners :]
    return pairs


def nested(pairs: FloatArray) -> FloatArray:
    """Put a small triangle inside a large one, in its plane."""
    weights = np.array([[0.4, 0.3, 0.3], [0.3, 0.4, 0.3], [0.3, 0.3, 0.4]])
    pairs[:, 1] = weights @ pairs[:, 0]
    return pairs


def parallel(pairs: FloatArray) -> FloatArray:
    pairs[:, 1] = pairs[:, 0] + np.array([0.03, 0.02, 0.1])
    return pairs


def collapsed(pairs: FloatArray, a: tuple[int, ...], b: tuple[int, ...]) -> FloatArray:
    return np.stack([pairs[:, 0, list(a)], pairs[:, 1, list(b)]], axis=1)


KINDS = {
    "random": random_pairs(),
    "small, so that most are apart": random_pairs(1) * [[[[0.3]], [[0.1]]]],
    "touching at a corner": sharing(random_pairs(), 1),
    "touching along an edge": sharing(random_pairs(), 2),
    "the same twice": sharing(random_pairs(), 3),
    "nested": nested(random_pairs()),
    "parallel": parallel(random_pairs()),
    "in one plane": flat(random_pairs()),
    "on a lattice": np.random.default_rng(6).integers(-2, 3, (N, 2, 3, 3)) / 4.0,
    "a segment and a triangle": collapsed(random_pairs(), (0, 1, 0), (0, 1, 2)),
    "segments": collapsed(random_pairs(), (0, 1, 1), (0, 0, 2)),
    "points": collapsed(random_pairs(), (1, 1, 1), (0, 0, 0)),
    **{f"slivers of height {h:g}": thin(random_pairs(), h) for h in 10.0 ** -np.arange(2, 17, 2)},
    **{
        f"edges {a:g} from parallel": with_edges_along(random_pairs(), a)
        for a in 10.0 ** -np.arange(2, 17, 2)
    },
}


BETWEEN = {f"{size:g}" for size in 10.0 ** -np.array([4, 6, 10, 12, 14])}
"""Sizes within the series of `KINDS`, whose ends and middle are tested by default."""


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=[pytest.mark.slow] if BETWEEN & set(kind.split()) else ())
        for kind in KINDS
    ],
)
def test_distance_is_that_of_exact_arithmetic(kind: str) -> None:
    a, b = KINDS[kind].transpose(1, 0, 2, 3)
    expected = np.array([exact_distance(*pair) for pair in KINDS[kind]])
    for first, second in ((a, b), (b, a)):
        measured = triangle_distance(first, second)
        np.testing.assert_allclose(measured.distance, expected, rtol=0.0, atol=1e-12)
        # The two nearest points lie on the triangles, at that distance.
        assert measured.weights.min() >= 0.0
        places = np.einsum("pst,pstc->psc", measured.weights, np.stack([first, second], axis=1))
        apart = np.linalg.norm(places[:, 0] - places[:, 1], axis=1)
        np.testing.assert_allclose(apart, expected, rtol=0.0, atol=1e-12)


def test_the_kinds_hold_pairs_that_cross_and_pairs_that_are_apart() -> None:
    apart = {kind: triangle_distance(*np.moveaxis(KINDS[kind], 1, 0)).distance for kind in KINDS}
    crossing = apart["random"] < 1e-12
    assert 3 < crossing.sum() < N - 3
    assert (apart["small, so that most are apart"] > 1e-3).mean() > 0.5
    assert (apart["parallel"] > 0.05).any()


def test_distance_is_that_of_coal() -> None:
    coal = pytest.importorskip("coal")
    here = coal.Transform3s.Identity()

    def model(triangle: FloatArray) -> object:
        shape = coal.BVHModelOBBRSS()
        shape.beginModel(1, 3)
        shape.addVertices(triangle)
        shape.addTriangles(np.array([[0, 1, 2]]))
        shape.endModel()
        return shape

    for pairs in (random_pairs(7), parallel(random_pairs(8)), 0.2 * random_pairs(9)):
        measured = triangle_distance(*np.moveaxis(pairs, 1, 0)).distance
        for pair, distance in zip(pairs, measured, strict=True):
            result = coal.DistanceResult()
            request = coal.DistanceRequest()
            coal.distance(model(pair[0]), here, model(pair[1]), here, request, result)
            # If they cross, the other library's distance is minus the depth.
            assert max(result.min_distance, 0.0) == pytest.approx(distance, abs=1e-9)


def test_distance_scales_with_the_unit_and_moves_with_the_triangles() -> None:
    pairs = random_pairs(11)
    a, b = np.moveaxis(pairs, 1, 0)
    expected = triangle_distance(a, b).distance
    for unit in (1e-120, 1e120):
        np.testing.assert_allclose(
            triangle_distance(unit * a, unit * b).distance,
            unit * expected,
            rtol=1e-13,
            atol=1e-14 * unit,
        )
    turn, way = random_rotation(np.random.default_rng(4)), np.array([3.0, -1.0, 2.0])
    moved = triangle_distance(a @ turn.T + way, b @ turn.T + way).distance
    np.testing.assert_allclose(moved, expected, rtol=0.0, atol=1e-14)


def test_slopes_are_those_of_differences() -> None:
    a, b = np.moveaxis(0.6 * random_pairs(12) + [[[[0.0]], [[0.3]]]], 1, 0)
    distance, slopes = distance_slopes(a, b)
    apart = np.flatnonzero(distance > 1e-3)
    assert len(apart) > 10
    step, corners = 1e-7, np.concatenate([a, b], axis=1)
    for corner in range(6):
        for axis in range(3):
            ends = []
            for sign in (-1.0, 1.0):
                moved = corners.copy()
                moved[:, corner, axis] += sign * step
                ends.append(triangle_distance(moved[:, :3], moved[:, 3:]).distance)
            measured = (ends[1] - ends[0]) / (2.0 * step)
            np.testing.assert_allclose(
                slopes[apart, corner, axis], measured[apart], rtol=0.0, atol=1e-5
            )
    # Moving both equally changes nothing; moving one away changes the distance by as much.
    np.testing.assert_allclose(slopes[apart].sum(axis=1), 0.0, atol=1e-14)
    np.testing.assert_allclose(
        np.linalg.norm(slopes[apart, :3].sum(axis=1), axis=1), 1.0, atol=1e-13
    )
    assert not slopes[distance == 0.0].any()


def test_bad_triangles_are_refused() -> None:
    a = np.zeros((2, 3, 3))
    with pytest.raises(ShapeError, match=r"two \(P, 3, 3\) arrays of one length"):
        triangle_distance(a, a[:1])
    with pytest.raises(ShapeError, match="triangle pair 1 has a corner that is not finite"):
        triangle_distance(a, np.where(np.arange(2)[:, None, None] == 1, np.nan, a))
