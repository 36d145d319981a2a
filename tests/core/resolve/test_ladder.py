"""Resolve on a small body: each step of the ladder, and its guarantees."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest

from lcollision_core.bodies import LearnedBody, sample_poses
from lcollision_core.contact import DEPTH_TOLERANCE
from lcollision_core.errors import CancelledError, LCollisionError, ShapeError
from lcollision_core.jobs import Job
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import ExactCheck
from lcollision_core.resolve import (
    Metric,
    PoseResolver,
    ResolveOptions,
    ResolveResult,
    Solver,
    Step,
    find_free_poses,
    largest_correction_change,
)
from lcollision_core.resolve.problem import CollisionModel
from lcollision_core.resolve.steps import bisect
from tests.core.brute_force import all_pairs
from tests.core.resolve.toys import Ball, toy_problem
from tests.core.shapes import random_rotation

FAR = ResolveOptions(largest_change=None)
"""No limit of the displacement: only the ladder, without the step of least overlap."""

MEAN_ALONE = 1
"""Number of known free poses used: the mean pose comes first."""


@pytest.fixture(scope="module")
def free_latents(tube_model: LearnedBody) -> FloatArray:
    return find_free_poses(tube_model.embedding, tube_model.exact_check())


@pytest.fixture(scope="module")
def colliding(tube_model: LearnedBody) -> FloatArray:
    return sample_poses(tube_model, 24, seed=5, colliding=True)


@pytest.fixture(scope="module")
def check(tube_model: LearnedBody) -> ExactCheck:
    return tube_model.exact_check()


@pytest.fixture(scope="module")
def deep(tube_model: LearnedBody, colliding: FloatArray) -> FloatArray:
    """Return a pose that neither polishing nor luck frees."""
    for latent in colliding:
        alone = resolver_of(tube_model, useless(latent), np.empty((0, 8)))
        if alone.resolve(latent, FAR).step == Step.NONE:
            return latent
    raise AssertionError("every pose was resolved without a predictor")


@pytest.fixture(scope="module")
def shallow(check: ExactCheck, colliding: FloatArray) -> FloatArray:
    """Return a pose that barely collides."""
    latent = colliding[0]
    return bisect(check, wide_problem(latent), np.zeros_like(latent), latent, 12)[1]


def wide_problem(latent: FloatArray):
    return toy_problem(useless(latent), latent, bound=1e3)


def useless(latent: FloatArray) -> Ball:
    """Make a predictor that calls everything colliding and shows no way out."""
    return Ball(np.zeros_like(latent), 0.0, sign=-1.0, plateau=0.0)


def around_the_mean(latent: FloatArray, radius: float, steepness: float = 100.0) -> Ball:
    """Make a predictor that calls a ball around the mean free; its radius is in pose lengths."""
    size = float(np.linalg.norm(latent))
    return Ball(np.zeros_like(latent), radius * size, -1.0, steepness / size)


def resolver_of(
    model: LearnedBody, predictor: CollisionModel, free_latents: npt.ArrayLike
) -> PoseResolver:
    return PoseResolver(model.exact_check(), predictor, free_latents)


def facts(result: ResolveResult) -> dict:
    """Return all fields that do not depend on the clock."""
    values = asdict(result)
    del values["seconds"]
    arrays = {name: values[name].tobytes() for name in ("latent", "vertices")}
    return values | arrays


def assert_free_by_brute_force(model: LearnedBody, result: ResolveResult) -> None:
    assert result.exactly_free
    assert np.array_equal(result.vertices, model.exported_vertices(result.latent))
    assert result.vertices.dtype == np.float32
    vertices = result.vertices.astype(np.float64)
    found = all_pairs(vertices, model.faces, DEPTH_TOLERANCE * model.body_size)
    assert len(found.pairs) == 0
    assert (result.pairs_after, result.energy_after) == (0, 0.0)


def assert_measured(model: LearnedBody, latent: FloatArray, result: ResolveResult) -> None:
    moved = np.linalg.norm(model.decode(result.latent) - model.decode(latent), axis=1)
    moved /= model.body_size
    assert result.vertex_distance_mean == pytest.approx(moved.mean(), rel=1e-9)
    assert result.vertex_distance_max == pytest.approx(moved.max(), rel=1e-9)
    way = np.linalg.norm(result.latent - latent) / np.linalg.norm(latent)
    assert result.latent_distance == pytest.approx(way, rel=1e-9)
    before = model.detector.detect(model.decode(latent).astype(np.float32))
    assert result.pairs_before == len(before.pairs)
    assert result.energy_before == pytest.approx(before.energy)


def test_a_free_pose_comes_back_unchanged(
    tube_model: LearnedBody, free_latents: FloatArray
) -> None:
    latent = free_latents[3] + 0.0
    result = resolver_of(tube_model, useless(latent), free_latents).resolve(latent)
    assert result.step == Step.UNCHANGED
    assert result.latent.tobytes() == latent.tobytes()
    assert result.solver_status == "not run"
    assert result.latent_distance == result.vertex_distance_max == 0.0
    assert not result.predicted_free
    assert_free_by_brute_force(tube_model, result)


@pytest.mark.parametrize("solver", Solver)
@pytest.mark.parametrize("metric", Metric)
def test_the_solver_alone(
    tube_model: LearnedBody, colliding: FloatArray, solver: Solver, metric: Metric
) -> None:
    latent = colliding[0]
    resolver = resolver_of(tube_model, around_the_mean(latent, 0.3), np.empty((0, 8)))
    result = resolver.resolve(latent, ResolveOptions(solver=solver, metric=metric))
    assert result.step == Step.SOLVER
    # The first free pose of the default solver ends its search.
    assert result.converged or solver == Solver.SQP
    assert result.iterations > 0
    assert result.note is None
    assert_free_by_brute_force(tube_model, result)
    assert_measured(tube_model, latent, result)


@pytest.mark.parametrize("solver", [Solver.SQP, Solver.AUGLAG])
def test_a_raised_margin(tube_model: LearnedBody, colliding: FloatArray, solver: Solver) -> None:
    latent = colliding[0]
    # The predictor calls it almost free: only the margins lead to free poses.
    predictor = around_the_mean(latent, 0.999, steepness=20.0)
    result = resolver_of(tube_model, predictor, np.empty((0, 8))).resolve(
        latent, ResolveOptions(solver=solver)
    )
    assert result.step == Step.MARGIN
    assert_free_by_brute_force(tube_model, result)


def test_another_start(tube_model: LearnedBody, deep: FloatArray) -> None:
    predictor = around_the_mean(deep, 0.3)
    predictor.plateau = 0.7 * float(np.linalg.norm(deep))
    resolver = resolver_of(tube_model, predictor, np.zeros((MEAN_ALONE, 8)))
    result = resolver.resolve(deep)
    assert result.step == Step.RESTART
    assert_free_by_brute_force(tube_model, result)


def test_polishing_shallow_contact(tube_model: LearnedBody, shallow: FloatArray) -> None:
    resolver = resolver_of(tube_model, useless(shallow), np.empty((0, 8)))
    result = resolver.resolve(shallow)
    assert result.step == Step.POLISH
    assert result.vertex_distance_max < 0.01
    assert_free_by_brute_force(tube_model, result)


def test_falling_back_to_a_known_free_pose(
    tube_model: LearnedBody, check: ExactCheck, deep: FloatArray, free_latents: FloatArray
) -> None:
    # Halfway to these it still collides, so they are not starts.
    halfway = ~check.are_free(0.5 * (free_latents + deep))
    assert halfway.any()
    far = free_latents[halfway]
    result = resolver_of(tube_model, useless(deep), far).resolve(deep)
    assert result.step == Step.FALL_BACK
    assert not result.predicted_free
    assert_free_by_brute_force(tube_model, result)
    assert_measured(tube_model, deep, result)
    # Pulled back: nearer than any of the fallback poses.
    ways = np.linalg.norm(far - deep, axis=1) / np.linalg.norm(deep)
    assert result.latent_distance < ways.min()


def test_no_way_out_is_a_statement(tube_model: LearnedBody, deep: FloatArray) -> None:
    result = resolver_of(tube_model, useless(deep), np.empty((0, 8))).resolve(deep, FAR)
    assert result.step == Step.NONE
    assert result.exactly_free is False
    assert result.pairs_after == result.pairs_before > 0
    assert result.latent.tobytes() == deep.tobytes()
    assert result.note == (
        "no collision-free pose is known to fall back to, so the pose still collides"
    )


@pytest.mark.parametrize(
    ("options", "is_free", "note"),
    [
        ({}, False, "no pose without collisions was found"),
        ({"clearance": 0.3}, False, "no pose without collisions was found"),
        ({"clearance": 0.3}, True, "no pose with this clearance was found; choose a smaller one"),
        ({"locked_domains": frozenset({1})}, False, "no pose without collisions was found"),
    ],
)
def test_advice_is_given_only_where_it_makes_a_known_pose_free(
    tube_model: LearnedBody,
    check: ExactCheck,
    deep: FloatArray,
    free_latents: FloatArray,
    options: dict,
    is_free: bool,
    note: str,
) -> None:
    is_near = ~check.with_clearance(0.3).are_free(free_latents)
    known = free_latents[is_near] if is_free else deep[None]
    assert len(known)
    resolver = resolver_of(tube_model, useless(deep), known)
    result = resolver.resolve(deep, replace(FAR, time_budget=1e-9, **options))
    assert result.exactly_free is False
    assert result.note == note


@pytest.mark.parametrize("solver", [Solver.SQP, Solver.SLSQP])
def test_progress_never_sticks(
    tube_model: LearnedBody, deep: FloatArray, free_latents: FloatArray, solver: Solver
) -> None:
    reports: list[tuple[int, int]] = []
    far = free_latents[np.argsort(-np.linalg.norm(free_latents - deep, axis=1))[:2]]
    resolver = resolver_of(tube_model, useless(deep), far)
    options = ResolveOptions(solver=solver)
    resolver.resolve(deep, options, Job(lambda *at: reports.append(at)), near=0.0 * deep)
    done, totals = zip(*reports, strict=True)
    assert set(totals) == {done[-1]}
    assert list(done[:-1]) == list(range(1, len(done)))
    assert done[-2] < done[-1]


@pytest.mark.parametrize("solver", Solver)
def test_the_zero_pose_is_freed(tube_model: LearnedBody, solver: Solver) -> None:
    """The zero pose has no length to divide by: its distance is the absolute one."""
    zero, pose = np.zeros(8), tube_model.known_poses[-1]
    size = float(np.linalg.norm(pose))
    predictor = Ball(0.2 * pose, 0.3 * size, steepness=100.0 / size)
    resolver = resolver_of(tube_model, predictor, np.empty((0, 8)))
    result = resolver.resolve(zero, ResolveOptions(solver=solver, verify=False))
    assert result.predicted_free
    assert result.latent_distance == np.linalg.norm(result.latent)
    assert result.latent_distance == pytest.approx(0.1 * size, rel=0.05)


def test_the_neighbours_correction_comes_first(
    tube_model: LearnedBody, deep: FloatArray, free_latents: FloatArray
) -> None:
    resolver = resolver_of(tube_model, useless(deep), free_latents)
    alone = resolver.resolve(deep)
    result = resolver.resolve(deep, near=1.1 * (alone.latent - deep))
    assert result.step == Step.NEIGHBOUR
    assert_free_by_brute_force(tube_model, result)
    to_mean = resolver.resolve(deep, near=-deep)
    assert to_mean.step == Step.NEIGHBOUR
    assert_free_by_brute_force(tube_model, to_mean)


def test_pulling_back_beats_bisection(
    tube_model: LearnedBody, check: ExactCheck, colliding: FloatArray, free_latents: FloatArray
) -> None:
    """Without a predictor, against bisection to the mean pose: the baseline without learning."""
    ratios = []
    for latent in colliding[:8]:
        problem = wide_problem(latent)
        baseline, _ = bisect(check, problem, np.zeros_like(latent), latent, 12)
        result = resolver_of(tube_model, useless(latent), free_latents).resolve(
            latent, ResolveOptions(metric=Metric.LATENT)
        )
        ratios.append(np.linalg.norm(result.latent - latent) / np.linalg.norm(baseline - latent))
    assert np.mean(ratios) < 0.8


@pytest.mark.parametrize("domain", [0, 1])
def test_a_locked_domain_keeps_its_codes(
    tube_model: LearnedBody, colliding: FloatArray, free_latents: FloatArray, domain: int
) -> None:
    options = replace(FAR, locked_domains=frozenset({domain}))
    locked = [domain, *range(2 + 3 * domain, 5 + 3 * domain)]
    n_moved = 0
    for latent in colliding[:8]:
        resolver = resolver_of(tube_model, around_the_mean(latent, 0.3), free_latents)
        result = resolver.resolve(latent, options)
        assert result.latent[locked].tobytes() == latent[locked].tobytes()
        n_moved += int(result.step != Step.NONE)
        if result.exactly_free:
            assert_free_by_brute_force(tube_model, result)
        else:
            assert result.note is not None
            assert result.note.endswith("that keeps the locked body parts; unlock one")
    assert n_moved >= 4


def test_all_domains_locked_is_a_statement(
    tube_model: LearnedBody, colliding: FloatArray, free_latents: FloatArray
) -> None:
    resolver = resolver_of(tube_model, useless(colliding[0]), free_latents)
    options = ResolveOptions(locked_domains=frozenset({0, 1}))
    result = resolver.resolve(colliding[0], options)
    assert (result.step, result.exactly_free) == (Step.NONE, False)
    assert result.latent.tobytes() == colliding[0].tobytes()
    assert result.note == "all body parts are locked, so the pose was not changed; unlock one"
    free = resolver.resolve(free_latents[2], options)
    assert (free.step, free.exactly_free, free.note) == (Step.UNCHANGED, True, None)
    for solver in Solver:
        alone = resolver.resolve(
            colliding[0], replace(options, solver=solver, verify=False, threshold=0.4)
        )
        assert (alone.step, alone.predicted_free, alone.note) == (Step.NONE, False, result.note)
        assert alone.latent.tobytes() == colliding[0].tobytes()


def test_a_dear_group_moves_less(
    tube_model: LearnedBody, colliding: FloatArray, free_latents: FloatArray
) -> None:
    shares = []
    for weights in (None, (1.0, 1.0, 1e4)):
        moved = []
        for latent in colliding[:6]:
            resolver = resolver_of(tube_model, around_the_mean(latent, 0.5), free_latents)
            result = resolver.resolve(latent, ResolveOptions(group_weights=weights))
            assert result.exactly_free
            way = result.latent - latent
            moved.append(np.linalg.norm(way[5:8]) / np.linalg.norm(way))
        shares.append(np.mean(moved))
    assert shares[1] < 0.5 * shares[0]


def test_codes_far_outside_the_box_are_solved_with_a_note(
    tube_model: LearnedBody, deep: FloatArray, free_latents: FloatArray
) -> None:
    result = resolver_of(tube_model, useless(deep), free_latents).resolve(5.0 * deep, FAR)
    assert result.note is not None
    assert re.search(r"sliders? (is|are) outside the trained range", result.note)
    assert_free_by_brute_force(tube_model, result)


def test_without_verifying_nothing_exact_is_said(
    tube_model: LearnedBody, colliding: FloatArray
) -> None:
    latent = colliding[0]
    predictor = around_the_mean(latent, 0.999)
    resolver = resolver_of(tube_model, predictor, np.empty((0, 8)))
    result = resolver.resolve(latent, ResolveOptions(verify=False))
    assert result.step == Step.SOLVER
    assert result.predicted_free
    assert result.exactly_free is None
    exact = (result.energy_before, result.energy_after, result.pairs_before, result.pairs_after)
    assert exact == (None,) * 4
    assert np.linalg.norm(result.latent) == pytest.approx(0.999 * np.linalg.norm(latent), rel=1e-3)
    free = resolver.resolve(0.5 * latent, ResolveOptions(verify=False))
    assert (free.step, free.latent_distance) == (Step.UNCHANGED, 0.0)
    helpless = resolver_of(tube_model, useless(latent), np.empty((0, 8)))
    stuck = helpless.resolve(latent, ResolveOptions(verify=False))
    assert (stuck.step, stuck.predicted_free, stuck.exactly_free) == (Step.NONE, False, None)


def test_threshold_and_margin_move_the_constraint(
    tube_model: LearnedBody, colliding: FloatArray
) -> None:
    latent = colliding[0]
    size = float(np.linalg.norm(latent))
    resolver = resolver_of(tube_model, around_the_mean(latent, 0.5), np.empty((0, 8)))
    for options, logit in (
        (ResolveOptions(verify=False, threshold=0.1), np.log(1 / 9)),
        (ResolveOptions(verify=False, margin=5.0), -5.0),
        (ResolveOptions(verify=False, margin=5.0, threshold=0.9), np.log(9) - 5.0),
    ):
        result = resolver.resolve(latent, options)
        assert np.linalg.norm(result.latent) == pytest.approx(size * (0.5 + logit / 100), rel=1e-3)


def test_no_time_goes_straight_to_falling_back(
    tube_model: LearnedBody, colliding: FloatArray, free_latents: FloatArray
) -> None:
    latent = colliding[0]
    resolver = resolver_of(tube_model, around_the_mean(latent, 0.3), free_latents)
    result = resolver.resolve(latent, ResolveOptions(time_budget=1e-9))
    assert result.step == Step.FALL_BACK
    assert_free_by_brute_force(tube_model, result)


def test_a_pose_that_came_as_a_mesh_is_checked_where_it_lies(
    tube_model: LearnedBody, colliding: FloatArray, free_latents: FloatArray
) -> None:
    rotation = random_rotation(np.random.default_rng(0))
    placement = RigidTransform(rotation, 3.0 * tube_model.body_size * np.ones(3))
    for latent in colliding[:4]:
        resolver = resolver_of(tube_model, around_the_mean(latent, 0.5), free_latents)
        result = resolver.resolve(latent, placement=placement)
        tolerance = DEPTH_TOLERANCE * tube_model.body_size
        assert len(all_pairs(result.vertices, tube_model.faces, tolerance).pairs) == 0
        assert result.vertices.dtype == np.float64
        assert result.exactly_free


def test_many_poses_keep_their_order_on_any_number_of_threads(
    tube_model: LearnedBody, colliding: FloatArray, free_latents: FloatArray
) -> None:
    latents = np.concatenate([colliding[:5], free_latents[:2]])
    resolver = resolver_of(tube_model, around_the_mean(colliding[0], 0.5), free_latents)
    reports: list[tuple[int, int]] = []
    kept: dict[int, ResolveResult] = {}
    one = resolver.resolve_many(
        latents, workers=1, job=Job(lambda *at: reports.append(at)), keep=kept.__setitem__
    )
    assert reports == [(done, 7) for done in range(1, 8)]
    assert [kept[place] for place in range(7)] == one
    three = resolver.resolve_many(latents, workers=3)
    assert [facts(result) for result in one] == [facts(result) for result in three]
    assert [facts(result) for result in one] == [facts(resolver.resolve(z)) for z in latents]
    assert [result.step == Step.UNCHANGED for result in one] == [False] * 5 + [True] * 2


def bending(latent: FloatArray, n_frames: int) -> FloatArray:
    """Return a motion from the mean pose into a colliding one and back."""
    ways = np.sin(np.linspace(0.0, np.pi, n_frames))
    return ways[:, None] * latent


def test_a_sequence_does_not_depend_on_threads_nor_jump(
    tube_model: LearnedBody, deep: FloatArray, free_latents: FloatArray
) -> None:
    frames = bending(deep, 24)
    resolver = resolver_of(tube_model, around_the_mean(deep, 0.5), free_latents)
    one = resolver.resolve_many(frames, workers=1, sequence=True)
    three = resolver.resolve_many(frames, workers=3, sequence=True)
    assert [facts(result) for result in one] == [facts(result) for result in three]
    assert all(result.exactly_free for result in one)
    assert {Step.UNCHANGED, Step.NEIGHBOUR} <= {result.step for result in one}
    decoded = tube_model.embedding.decode(frames)
    motion = np.linalg.norm(np.diff(decoded, axis=0), axis=2).mean(axis=1).max()
    assert 0.0 < largest_correction_change(tube_model.embedding.decode, frames, one) < 2.0 * motion


def test_the_change_of_corrections_is_measured_in_heights(
    tube_model: LearnedBody, deep: FloatArray, free_latents: FloatArray
) -> None:
    frames = bending(deep, 37)
    resolver = resolver_of(tube_model, around_the_mean(deep, 0.5), free_latents)
    results = resolver.resolve_many(frames)
    moved = [
        tube_model.decode(result.latent) - tube_model.decode(frame)
        for result, frame in zip(results, frames, strict=True)
    ]
    changes = [
        np.linalg.norm(after - before, axis=1).mean() / tube_model.body_size
        for before, after in pairwise(moved)
    ]
    assert max(changes) > 0.0
    measured = largest_correction_change(tube_model.embedding.decode, frames, results)
    assert measured == pytest.approx(max(changes), rel=1e-9)
    assert largest_correction_change(tube_model.embedding.decode, frames[:1], results[:1]) == 0.0


class _Cancelling:
    """Cancels at one of the evaluations."""

    def __init__(self, at_call: int) -> None:
        self.token, self.n_calls, self._at_call = Job(), 0, at_call

    def logit_and_gradient(self, latent: npt.NDArray) -> tuple[FloatArray, FloatArray]:
        self.n_calls += 1
        if self.n_calls == self._at_call:
            self.token.cancel()
        return 1.0 + (latent**2).sum(axis=1), 2.0 * latent


@pytest.mark.parametrize("solver", Solver)
@pytest.mark.parametrize("at_call", [1, 2])
def test_cancel_within_one_evaluation(
    tube_model: LearnedBody, deep: FloatArray, solver: Solver, at_call: int
) -> None:
    predictor = _Cancelling(at_call)
    resolver = resolver_of(tube_model, predictor, np.zeros((MEAN_ALONE, 8)))
    with pytest.raises(CancelledError):
        resolver.resolve(deep, ResolveOptions(solver=solver), job=predictor.token)
    assert predictor.n_calls == at_call


def test_cancelling_many_keeps_what_was_finished(
    tube_model: LearnedBody, colliding: FloatArray, free_latents: FloatArray
) -> None:
    token = Job()
    kept: dict[int, ResolveResult] = {}

    def keep(place: int, result: ResolveResult) -> None:
        kept[place] = result
        if len(kept) == 3:
            token.cancel()

    resolver = resolver_of(tube_model, around_the_mean(colliding[0], 0.5), free_latents)
    with pytest.raises(CancelledError):
        resolver.resolve_many(colliding, workers=1, job=token, keep=keep)
    assert sorted(kept) == [0, 1, 2]
    assert all(result.exactly_free for result in kept.values())


class _CancellingDetector:
    """Checks like the model's own, and cancels at the second check."""

    clearance = 0.0

    def __init__(self, model: LearnedBody) -> None:
        self.token, self.n_calls, self._detector = Job(), 0, model.detector

    def are_colliding(
        self, vertices: npt.NDArray, workers: int, unit: float
    ) -> npt.NDArray[np.bool_]:
        self.n_calls += 1
        if self.n_calls == 2:
            self.token.cancel()
        return self._detector.are_colliding(vertices, workers=workers, unit=unit)


def test_cancelling_a_sequence_stops_its_first_check(
    tube_model: LearnedBody, colliding: FloatArray
) -> None:
    detector, size = _CancellingDetector(tube_model), tube_model.latent_size
    resolver = PoseResolver(
        replace(tube_model.exact_check(), detector=detector),
        useless(colliding[0]),
        np.empty((0, size)),
    )
    with pytest.raises(CancelledError):
        resolver.resolve_many(colliding, workers=1, job=detector.token, sequence=True)
    assert detector.n_calls == 2


@pytest.mark.parametrize(
    ("latent", "options", "sentence"),
    [
        (np.zeros(7), ResolveOptions(), r"must be 8 numbers, got shape \(7,\)"),
        (np.full(8, np.nan), ResolveOptions(), "NaN or infinity"),
        (np.full(8, np.inf), ResolveOptions(), "NaN or infinity"),
        (
            np.zeros(8),
            ResolveOptions(locked_domains=frozenset({2})),
            "unknown domain 3 to lock; the model has 2",
        ),
        (
            np.zeros(8),
            ResolveOptions(group_weights=(1.0, 1.0)),
            "group weights must be 3 numbers, got 2",
        ),
    ],
)
def test_bad_requests_are_refused(
    tube_model: LearnedBody, latent: FloatArray, options: ResolveOptions, sentence: str
) -> None:
    resolver = resolver_of(tube_model, useless(np.zeros(8)), np.empty((0, 8)))
    with pytest.raises(LCollisionError, match=sentence):
        resolver.resolve(latent, options)


def test_a_result_is_read_only_and_progress_ends_full(
    tube_model: LearnedBody, colliding: FloatArray, free_latents: FloatArray
) -> None:
    reports: Sequence[tuple[int, int]] = []
    resolver = resolver_of(tube_model, around_the_mean(colliding[0], 0.5), free_latents)
    result = resolver.resolve(colliding[0], job=Job(lambda *at: reports.append(at)))
    assert reports[-1][0] == reports[-1][1] > 0
    assert list(reports) == sorted(reports)
    assert len({total for _, total in reports}) == 1
    for array in (result.latent, result.vertices):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(ShapeError):
        resolver.resolve_many(np.zeros((2, 9)))


def test_known_free_poses_are_free(tube_model: LearnedBody, free_latents: FloatArray) -> None:
    assert len(free_latents) >= 10
    assert free_latents[0].tolist() == [0.0] * 8
    vertices = tube_model.decode(free_latents.astype(np.float32)).astype(np.float32)
    assert not tube_model.detector.are_colliding(vertices).any()
    training = tube_model.known_poses
    free = ~tube_model.detector.are_colliding(tube_model.decode(training).astype(np.float32))
    known = {row.tobytes() for row in free_latents}
    assert {row.tobytes() for row in training[free]} <= known


def test_without_a_predictor_the_way_in_leads_near(
    tube_model: LearnedBody, colliding: FloatArray, free_latents: FloatArray
) -> None:
    resolver = PoseResolver(tube_model.exact_check(), None, free_latents)
    fallen = resolver_of(tube_model, useless(colliding[0]), free_latents)
    steps, nearer = set(), []
    for latent in colliding[:8]:
        done: list[tuple[int, int]] = []
        result = resolver.resolve(latent, job=Job(lambda *at, done=done: done.append(at)))
        assert_free_by_brute_force(tube_model, result)
        assert_measured(tube_model, latent, result)
        assert (result.predicted_free, result.evaluations) == (None, 0)
        assert result.solver_status == "no predictor"
        assert done[-1][0] == done[-1][1]
        steps.add(result.step)
        other = fallen.resolve(latent, ResolveOptions(time_budget=1e-9))
        nearer.append(result.vertex_distance_mean <= other.vertex_distance_mean)
    assert Step.TOWARDS in steps
    assert np.mean(nearer) > 0.7
    free = resolver.resolve(free_latents[0])
    assert (free.step, free.predicted_free) == (Step.UNCHANGED, None)


def test_the_way_in_keeps_locked_domains_and_says_when_there_is_none(
    tube_model: LearnedBody, colliding: FloatArray, deep: FloatArray, free_latents: FloatArray
) -> None:
    resolver = PoseResolver(tube_model.exact_check(), None, free_latents)
    locked = tube_model.space.codes_of([1])
    options, n_moved = replace(FAR, locked_domains=frozenset({1})), 0
    for latent in colliding[:8]:
        result = resolver.resolve(latent, options)
        assert np.array_equal(result.latent[locked], latent[locked])
        if result.step == Step.NONE:
            assert not result.exactly_free
            assert (result.note or "").endswith("that keeps the locked body parts; unlock one")
        else:
            assert_free_by_brute_force(tube_model, result)
            n_moved += 1
    assert n_moved >= 4
    nothing = PoseResolver(tube_model.exact_check(), None, np.empty((0, 8))).resolve(deep, FAR)
    assert (nothing.step, nothing.exactly_free) == (Step.NONE, False)
    assert "no collision-free pose is known" in (nothing.note or "")
    with pytest.raises(LCollisionError, match="has no predictor, so Resolve needs"):
        resolver.resolve(deep, ResolveOptions(verify=False))
    token = Job()
    token.cancel()
    with pytest.raises(CancelledError):
        resolver.resolve(deep, job=token)
