"""The structured program of a span against the equivalent dense one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from lcollision_core.motion import span_program
from lcollision_core.motion.span_program import (
    SOFTNESS,
    HalfSpaces,
    TimeKernel,
    _solve_lcp,
    least_corrections,
)
from tests.rigged_shapes import FloatArray

N, SIZE, WEIGHT = 7, 3, 20.0


def cost(rows: FloatArray, metric: FloatArray, lead: FloatArray, tail: FloatArray) -> float:
    """Return the cost of (N, SIZE) corrections, given two fixed ones on each side."""
    bends = np.diff(np.concatenate([lead, rows, tail]), n=2, axis=0)
    squared = [np.einsum("td,de,te->", part, metric, part) for part in (rows, bends)]
    return float(squared[0] + WEIGHT * squared[1])


@pytest.fixture
def metric() -> FloatArray:
    root = np.random.default_rng(3).normal(size=(SIZE, SIZE))
    return root @ root.T + np.eye(SIZE)


def test_without_constraints_the_corrections_are_the_smoothest(metric: FloatArray) -> None:
    generator = np.random.default_rng(4)
    lead, tail = generator.normal(size=(2, 2, SIZE))
    pinned = {2: generator.normal(size=SIZE)}
    kernel = TimeKernel.of(N, WEIGHT, lead, tail, pinned, SIZE)
    np.testing.assert_array_equal(kernel.mean[2], pinned[2])
    assert not kernel.spread[2].any()
    others = [frame for frame in range(N) if frame != 2]
    least = cost(kernel.mean, metric, lead, tail)
    for frame in others:
        for code in range(SIZE):
            for step in (-1e-3, 1e-3):
                moved = kernel.mean.copy()
                moved[frame, code] += step
                assert cost(moved, metric, lead, tail) > least


def test_the_corrections_of_a_cycle_are_as_smooth_across_its_seam() -> None:
    pinned = {1: np.array([1.0])}
    kernel = TimeKernel.of(N, WEIGHT, None, None, pinned, 1, is_cycle=True)

    def of_cycle(rows: FloatArray) -> float:
        bend = np.roll(rows, 1, axis=0) - 2.0 * rows + np.roll(rows, -1, axis=0)
        return float((rows**2).sum() + WEIGHT * (bend**2).sum())

    for frame in {*range(N)} - {1}:
        for step in (-1e-3, 1e-3):
            moved = kernel.mean.copy()
            moved[frame] += step
            assert of_cycle(moved) > of_cycle(kernel.mean)
    # It is symmetric around the pinned frame.
    around = np.roll(kernel.mean[:, 0], -1)
    np.testing.assert_allclose(around[1:], around[:0:-1])


def test_constraints_hold_at_the_least_cost(metric: FloatArray) -> None:
    generator = np.random.default_rng(5)
    still = np.zeros((2, SIZE))
    kernel = TimeKernel.of(N, WEIGHT, still, still, {}, SIZE)
    shares = np.eye(N)[[1, 3, 5]]
    # Halfway between two frames.
    shares[1] = 0.5 * (np.eye(N)[3] + np.eye(N)[4])
    normals, offsets = generator.normal(size=(3, SIZE)), np.array([-0.5, -0.2, 0.3])
    found = least_corrections(kernel, np.linalg.inv(metric), HalfSpaces(shares, normals, offsets))
    assert found is not None

    def slack(flat: FloatArray) -> FloatArray:
        rows = flat.reshape(N, SIZE)
        return offsets - np.einsum("mt,td,md->m", shares, rows, normals)

    dense = minimize(
        lambda flat: cost(flat.reshape(N, SIZE), metric, still, still),
        np.zeros(N * SIZE),
        constraints={"type": "ineq", "fun": slack},
        method="SLSQP",
        options={"ftol": 1e-12, "maxiter": 500},
    )
    assert dense.success
    assert np.abs(dense.x).max() > 0.05
    np.testing.assert_allclose(found, dense.x.reshape(N, SIZE), atol=2e-3)
    assert (slack(found.ravel()) > -1e-3).all()


def test_many_contacts_that_contradict_each_other_hold_as_far_as_they_yield() -> None:
    """With the softness on the Gram matrix's diagonal, multipliers and residuals are >= 0."""
    generator = np.random.default_rng(7)
    for n_contacts, n_codes in ((40, 60), (200, 20), (300, 3)):
        normals = generator.normal(size=(n_contacts, n_codes))
        normals[::3] *= -1.0
        normals[1::5] = normals[0]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        gram = normals @ normals.T + SOFTNESS * np.eye(n_contacts)
        bounds = generator.normal(size=n_contacts)
        multipliers = _solve_lcp(gram, bounds, bounds < 0.0)
        assert multipliers is not None
        left = bounds + gram @ multipliers
        assert multipliers.min() == 0.0
        assert left.min() > -1e-6
        assert np.abs(left[multipliers > 0.0]).max() < 1e-6
        assert np.count_nonzero(multipliers) > 1


@pytest.mark.parametrize("n_equal", [0, 4])
def test_of_many_contacts_those_that_are_added_step_by_step_give_the_same(
    metric: FloatArray, n_equal: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = np.random.default_rng(11)
    still = np.zeros((2, SIZE))
    kernel = TimeKernel.of(N, WEIGHT, still, still, {}, SIZE)

    def drawn(n_rows: int) -> HalfSpaces:
        shares = np.eye(N)[generator.integers(N, size=n_rows)]
        normals = generator.normal(size=(n_rows, SIZE))
        return HalfSpaces(shares, normals, generator.normal(0.5, 0.5, size=n_rows))

    rows, equations = drawn(400), drawn(n_equal)
    corrections = []
    for n_added, n_dropping in ((400, 0), (20, 30), (20, 1)):
        monkeypatch.setattr(span_program, "_ADDED", n_added)
        monkeypatch.setattr(span_program, "_DROPPING_ROUNDS", n_dropping)
        solution = least_corrections(kernel, np.linalg.inv(metric), rows, equations)
        assert solution is not None
        corrections.append(solution)
    assert np.abs(corrections[0]).max() > 0.1
    for solution in corrections[1:]:
        np.testing.assert_allclose(solution, corrections[0], rtol=0.0, atol=1e-8)


def test_locked_codes_do_not_move(metric: FloatArray) -> None:
    still = np.zeros((2, SIZE))
    kernel = TimeKernel.of(N, WEIGHT, still, None, {}, SIZE)
    inverse = np.zeros((SIZE, SIZE))
    inverse[1:, 1:] = np.linalg.inv(metric[1:, 1:])
    rows = HalfSpaces(np.eye(N)[[2]], np.ones((1, SIZE)), np.array([-1.0]))
    found = least_corrections(kernel, inverse, rows)
    assert found is not None
    assert not found[:, 0].any()
    assert found[2].sum() == pytest.approx(-1.0, abs=1e-3)
    # A constraint that only locked codes could satisfy changes nothing.
    out_of_reach = HalfSpaces(np.eye(N)[[3]], np.eye(1, SIZE), np.array([-1.0]))
    both = rows.joined(out_of_reach)
    np.testing.assert_array_equal(least_corrections(kernel, inverse, both), found)
    np.testing.assert_array_equal(least_corrections(kernel, inverse, out_of_reach), kernel.mean)
