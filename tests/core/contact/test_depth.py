"""Penetration depth of two triangles: values by hand and an exact reference."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcollision_core.contact import penetration_depth
from lcollision_core.errors import LCollisionError, ShapeError
from tests.core.brute_force import are_disjoint, exact_depth, exact_depth_and_direction
from tests.core.shapes import random_rotation

FLOOR = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
"""A triangle in the plane z = 0, larger than those that it meets."""


def depth(a: object, b: object, tolerance: float = 0.0) -> float:
    return float(penetration_depth([a], [b], tolerance)[0])


HAND_WORKED = {
    "stabbing: a tip 0.25 below the floor": (
        FLOOR,
        [[1, 1, -0.25], [1, 1, 2], [1.5, 1, 2]],
        0.25,
    ),
    "stabbing: more below than above, so up is out": (
        FLOOR,
        [[1, 1, -3], [1, 1, 0.5], [1.5, 1, 0.5]],
        0.5,
    ),
    "pierced near the rim: out sideways through the edge y = 0": (
        FLOOR,
        [[2, 0.125, -1], [2, 0.125, 1], [2, -3, 0]],
        0.125,
    ),
    "an edge pierces the floor, 0.5 below it at the lower end": (
        FLOOR,
        [[1, 1, -0.5], [1, 1, 1], [1, 1.5, 3]],
        0.5,
    ),
    "crossing: edge over edge, both hang in by 0.1, along z": (
        [[-1, 0, -0.1], [1, 0, -0.1], [0, 0, 5]],
        [[0, -1, 0], [0, 1, 0], [0, 0, -5]],
        0.1,
    ),
    "parallel, apart": (FLOOR, FLOOR + [0, 0, 0.5], 0.0),
    "parallel, apart by one unit in the last place": (FLOOR, FLOOR + [0, 0, 5e-324], 0.0),
    "coplanar, overlapping": (FLOOR, FLOOR + [0.5, 0.5, 0], 0.0),
    "coplanar, one inside the other": (FLOOR, 0.25 * FLOOR + [0.5, 0.5, 0], 0.0),
    "coplanar, edges touch": (FLOOR, FLOOR * [1, -1, 1], 0.0),
    "coplanar, apart": (FLOOR, FLOOR + [9, 0, 0], 0.0),
    "identical": (FLOOR, FLOOR, 0.0),
    "a corner touches the inside": (FLOOR, [[1, 1, 0], [1, 1, 1], [2, 1, 1]], 0.0),
    "a corner touches a corner": (FLOOR, [[4, 0, 0], [5, 0, 1], [5, 0, -1]], 0.0),
    "a corner touches an edge": (FLOOR, [[2, 0, 0], [2, -1, 1], [2, -1, -1]], 0.0),
    "an edge lies on the inside": (FLOOR, [[1, 1, 0], [2, 1, 0], [1, 1, 1]], 0.0),
    "an edge lies on an edge": (FLOOR, [[0, 0, 0], [4, 0, 0], [2, 0, -1]], 0.0),
    "an edge touches an edge across": (FLOOR, [[2, 0, 1], [2, 0, -1], [2, -1, 0]], 0.0),
    "apart beside the plane that both cross": (FLOOR, [[5, 5, -1], [5, 5, 1], [6, 5, 0]], 0.0),
    "boxes overlap, triangles do not": (FLOOR, [[3, 3, -1], [3, 3, 1], [4, 4, 0]], 0.0),
    # Degenerate triangles count as segments and points.
    "a segment stabs the floor by 0.25": (FLOOR, [[1, 1, -0.25], [1, 1, 1], [1, 1, 0.5]], 0.25),
    "a segment given as two equal corners": (FLOOR, [[1, 1, -0.25], [1, 1, 1], [1, 1, 1]], 0.25),
    "a segment lies in the floor": (FLOOR, [[0, 0, 0], [1, 1, 0], [2, 2, 0]], 0.0),
    "a segment passes by": (FLOOR, [[5, 5, -1], [5, 5, 1], [5, 5, 0]], 0.0),
    "a point in the floor": (FLOOR, [[1, 1, 0]] * 3, 0.0),
    "a point above the floor": (FLOOR, [[1, 1, 1]] * 3, 0.0),
    "crossing segments have no inside": (
        [[-1, 0, 0], [1, 0, 0], [0, 0, 0]],
        [[0, -1, 0], [0, 1, 0], [0, 0.5, 0]],
        0.0,
    ),
    "two segments on one line": (
        [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
        [[1, 0, 0], [2, 0, 0], [3, 0, 0]],
        0.0,
    ),
    "two equal points": ([[1, 2, 3]] * 3, [[1, 2, 3]] * 3, 0.0),
}


@pytest.mark.parametrize("name", HAND_WORKED)
def test_hand_worked_depths(name: str) -> None:
    a, b, expected = HAND_WORKED[name]
    assert exact_depth(a, b) == pytest.approx(expected, abs=1e-15)
    # Any order of the corners and of the two.
    for p, q in itertools.product(itertools.permutations(range(3)), repeat=2):
        first, second = np.asarray(a, dtype=float)[list(p)], np.asarray(b, dtype=float)[list(q)]
        assert depth(first, second) == pytest.approx(expected, abs=1e-15)
        assert depth(second, first) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("name", HAND_WORKED)
def test_hand_worked_depths_in_any_frame(name: str) -> None:
    a, b, expected = HAND_WORKED[name]
    rng = np.random.default_rng(5)
    for _ in range(20):
        rotation, shift = random_rotation(rng), rng.uniform(-10, 10, 3)
        first = np.asarray(a, dtype=float) @ rotation.T + shift
        second = np.asarray(b, dtype=float) @ rotation.T + shift
        # Exactly coplanar triangles are now coplanar only up to rounding.
        assert depth(first, second) == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize("scale", [1e-100, 1e-30, 1e-3, 1e3, 1e30, 1e100])
@pytest.mark.parametrize("name", HAND_WORKED)
def test_depth_scales_with_the_triangles(name: str, scale: float) -> None:
    a, b, expected = HAND_WORKED[name]
    a, b = np.asarray(a, dtype=float) * scale, np.asarray(b, dtype=float) * scale
    assert depth(a, b) == pytest.approx(expected * scale, rel=1e-12, abs=1e-15 * scale)


def test_many_pairs_at_once_are_the_pairs_one_by_one() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.random((2, 100, 3, 3))
    together = penetration_depth(a, b)
    assert together.shape == (100,)
    assert together.dtype == np.float64
    assert 10 < np.count_nonzero(together) < 90
    assert together.tolist() == [depth(p, q) for p, q in zip(a, b, strict=True)]


def test_no_pairs() -> None:
    assert penetration_depth(np.empty((0, 3, 3)), np.empty((0, 3, 3))).shape == (0,)


def test_depths_up_to_the_tolerance_are_contacts() -> None:
    b = [[1, 1, -0.25], [1, 1, 2], [1.5, 1, 2]]
    assert depth(FLOOR, b, tolerance=0.25) == 0.0
    assert depth(FLOOR, b, tolerance=np.nextafter(0.25, 1)) == 0.0
    assert depth(FLOOR, b, tolerance=np.nextafter(0.25, 0)) == 0.25


def test_inputs_are_left_alone() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.random((2, 5, 3, 3)).astype(np.float32)
    a.flags.writeable = b.flags.writeable = False
    before = a.copy(), b.copy()
    single = penetration_depth(a, b)
    assert np.array_equal(a, before[0])
    assert np.array_equal(b, before[1])
    assert np.array_equal(single, penetration_depth(a.astype(float), b.astype(float)))


@pytest.mark.parametrize(
    ("shape_a", "shape_b"),
    [((3, 3), (3, 3)), ((2, 3, 3), (3, 3, 3)), ((2, 3, 2), (2, 3, 2)), ((2, 4, 3), (2, 4, 3))],
)
def test_other_shapes_are_refused(shape_a: tuple[int, ...], shape_b: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match=r"\(P, 3, 3\)"):
        penetration_depth(np.zeros(shape_a), np.zeros(shape_b))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_corner_that_is_not_finite_is_named(bad: float) -> None:
    triangles = np.random.default_rng(0).random((4, 3, 3))
    broken = triangles.copy()
    broken[2, 1, 0] = bad
    with pytest.raises(LCollisionError, match="pair 2"):
        penetration_depth(triangles, broken)
    with pytest.raises(LCollisionError, match="pair 2"):
        penetration_depth(broken, triangles)


@pytest.mark.parametrize("sine", [1e-3, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 3e-10, 1.1e-10, 1e-11, 0.0])
def test_long_edges_that_are_nearly_parallel(sine: float) -> None:
    """Two wedges back to back, whose ridges cross at an angle of asin(2 sine) at the depth h.

    The way out is up, along the cross product of the ridges: nearly rounding noise, which must
    neither separate them (a missed collision) nor hide the way out.
    """
    rng = np.random.default_rng(int(1e12 * sine))
    missed_at_most = 0.0
    for _ in range(40):
        slope = 10 ** rng.uniform(-4, -1)
        h = max(sine / slope, 1e-9) * rng.uniform(0.1, 1.5)
        a_left, a_right, b_left, b_right = rng.uniform(0.2, 2.0, 4)
        a = np.array([[-a_left, 0, -h], [a_right, 0, -h], [0, 1, slope]])
        b = np.array([[-b_left, -sine * b_left, 0], [b_right, sine * b_right, 0], [0, 1, -slope]])
        rotation = random_rotation(rng)
        a, b = a @ rotation.T, b @ rotation.T
        expected = exact_depth(a, b)
        assert 0.0 < expected <= 2 * h
        missed_at_most = max(missed_at_most, abs(depth(a, b) - expected))
    # Dropping a direction across edges at an angle of 1e-10 costs up to 1e-10 times the slope.
    assert missed_at_most <= (1e-11 if sine < 1e-10 else 2e-15)


@pytest.mark.parametrize("width", [1e-3, 1e-6, 1e-9, 3e-10, 1e-11, 1e-13, 1e-15])
def test_slivers(width: float) -> None:
    rng = np.random.default_rng(int(-np.log10(width) * 10))
    n_penetrating = 0
    for _ in range(40):
        a = np.array([[-1.0, 0, 0], [1.0, 0, 0], [rng.uniform(-1, 1), width, 0]])
        b = rng.uniform(-1, 1, (3, 3))
        # Pierce the sliver near its middle.
        b -= b.mean(axis=0) - [rng.uniform(-0.5, 0.5), width * rng.uniform(0, 0.5), 0]
        rotation = random_rotation(rng)
        a, b = (a @ rotation.T)[rng.permutation(3)], b @ rotation.T
        expected = exact_depth(a, b)
        n_penetrating += expected > 0.0
        # Corners are rounded by 1e-16; a dropped normal of a sliver costs up to its width.
        assert depth(a, b) == pytest.approx(expected, abs=2e-10 if width < 1e-9 else 1e-14)
    assert n_penetrating >= 20


# Few bits make touching, coplanar, parallel and degenerate cases frequent and exact.
lattice_triangles = st.lists(
    st.tuples(*[st.integers(-3, 3)] * 3), min_size=3, max_size=3
).map(lambda corners: np.array(corners, dtype=np.float64))  # fmt: skip


@settings(max_examples=400, deadline=None)
@given(a=lattice_triangles, b=lattice_triangles)
def test_lattice_triangles_against_the_exact_reference(a: np.ndarray, b: np.ndarray) -> None:
    expected = exact_depth(a, b)
    assert depth(a, b) == pytest.approx(expected, rel=1e-14)
    assert (depth(a, b) == 0.0) == (expected == 0.0)


@settings(max_examples=300, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    size_a=st.floats(-6, 1),
    size_b=st.floats(-6, 1),
    flatness=st.floats(-12, 0),
)
def test_random_triangles_against_the_exact_reference(
    seed: int, size_a: float, size_b: float, flatness: float
) -> None:
    rng = np.random.default_rng(seed)
    flat = [1.0, 1.0, 10**flatness]
    rotation = random_rotation(rng)
    a = 10**size_a * rng.uniform(-1, 1, (3, 3)) * flat @ rotation.T
    b = 10**size_b * rng.uniform(-1, 1, (3, 3)) * flat @ rotation.T
    # Make a point of one coincide with a point of the other, so that nearly all touch.
    a += rng.dirichlet(np.ones(3)) @ b - rng.dirichlet(np.ones(3)) @ a
    size = max(np.abs(a).max(), np.abs(b).max())
    assert depth(a, b) == pytest.approx(exact_depth(a, b), abs=1e-14 * size)


def test_the_depth_is_the_shortest_way_out() -> None:
    """Checked by the definition, with a linear program deciding what is disjoint."""
    rng = np.random.default_rng(11)
    n_penetrating = 0
    while n_penetrating < 12:
        a, b = rng.uniform(-1, 1, (2, 3, 3))
        found = depth(a, b)
        assert (found == 0.0) == are_disjoint(a, b)
        if found < 1e-3:
            continue
        n_penetrating += 1
        _, way_out = exact_depth_and_direction(a, b)
        assert are_disjoint(a + (found + 1e-6) * way_out, b)
        assert not are_disjoint(a + (found - 1e-6) * way_out, b)
        for direction in rng.normal(size=(20, 3)):
            direction /= np.linalg.norm(direction)
            assert not are_disjoint(a + (found - 1e-6) * direction, b)


@pytest.mark.parametrize("tolerance", [-1e-9, float("nan")])
def test_a_tolerance_that_is_no_length_is_refused(tolerance: float) -> None:
    with pytest.raises(ShapeError, match="tolerance must be 0 or more"):
        penetration_depth([FLOOR], [FLOOR], tolerance)
