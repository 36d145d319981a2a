"""The least overlap within a largest change, and tolerated depths of pairs of parts."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.bodies import Body, RigBody, open_body, sample_poses
from lcollision_core.contact import DEPTH_TOLERANCE
from lcollision_core.errors import LCollisionError
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.options import RuleOptions
from lcollision_core.posing import DragOptions
from lcollision_core.resolve import ResolveOptions, ResolveResult, Step
from lcollision_core.resolve.steps import LeastOverlap, draw_nearer, fall_back
from tests.core.brute_force import all_pairs
from tests.rigged_shapes import rigged_body, skirted_body


@pytest.fixture(scope="module")
def body() -> Body:
    return open_body("body")


@pytest.fixture(scope="module")
def colliding(body: Body) -> FloatArray:
    return sample_poses(body, 4, seed=0, colliding=True)


def soft(body: Body, latent: FloatArray, most: float) -> ResolveResult:
    """Resolve within a largest change, and verify the result by brute force."""
    result = body.resolve(latent, ResolveOptions(largest_change=most))
    ends = body.decode(np.stack([latent, result.latent])) / body.body_size
    change = np.linalg.norm(ends[1] - ends[0], axis=1).max()
    assert result.vertex_distance_max == pytest.approx(change, rel=1e-9)
    assert change <= most
    size = body.body_size
    left = all_pairs(result.vertices.astype(np.float64), body.faces, DEPTH_TOLERANCE * size)
    counts = body.detector.rules_of(left.pairs, left.depth / size) == 0
    depth = left.depth[counts] / size
    assert result.exactly_free == (not len(depth))
    assert result.pairs_after == len(depth)
    assert result.deepest_after == pytest.approx(depth.max(initial=0.0), abs=1e-9)
    assert result.energy_after == pytest.approx((depth**2).sum(), rel=1e-6)
    assert result.energy_before is not None
    assert result.energy_after <= result.energy_before
    assert result.pairs_before is not None
    assert len(depth) <= result.pairs_before
    return result


def test_the_overlap_falls_within_the_bound(body: Body, colliding: FloatArray) -> None:
    gone = 0
    for latent in colliding[1:3]:
        plain = body.resolve(latent)
        results = [soft(body, latent, most) for most in (0.005, 0.02)]
        energies = [result.energy_after or 0.0 for result in results]
        assert energies[1] <= energies[0] < 0.8 * (plain.energy_before or 0.0)
        for result, most in zip(results, (0.005, 0.02), strict=True):
            assert result.largest_change == most
            if plain.vertex_distance_max <= most:
                # The plain result is near enough.
                assert result.step == plain.step
                np.testing.assert_array_equal(result.latent, plain.latent)
                gone += 1
            elif not result.exactly_free:
                assert result.step == Step.SOFT
                assert "no free pose was found within" in (result.note or "")
    assert gone > 0


def test_a_free_pose_within_the_bound_is_found_where_resolve_goes_farther(
    body: Body, colliding: FloatArray
) -> None:
    latent = colliding[3]
    assert body.resolve(latent).vertex_distance_max > 0.005
    result = soft(body, latent, 0.005)
    assert (result.exactly_free, result.step, result.note) == (True, Step.SOFT, None)


def test_a_free_pose_stays_and_locked_parts_do(body: Body, colliding: FloatArray) -> None:
    free = body.free_latent[0].astype(np.float64)
    result = body.resolve(free, ResolveOptions(largest_change=0.01))
    assert (result.step, result.latent_distance) == (Step.UNCHANGED, 0.0)
    locked = frozenset(range(0, len(body.domain_names), 2))
    options = ResolveOptions(largest_change=0.004, locked_domains=locked)
    result = body.resolve(colliding[0], options)
    own = body.space.codes_of(locked)
    np.testing.assert_array_equal(result.latent[own], colliding[0][own])
    assert result.step == Step.SOFT
    assert result.latent_distance > 0.0
    everything = ResolveOptions(
        largest_change=0.01, locked_domains=frozenset(range(len(body.domain_names)))
    )
    result = body.resolve(colliding[0], everything)
    assert (result.step, result.latent_distance) == (Step.NONE, 0.0)


def test_frames_and_characters_are_bounded_as_well() -> None:
    model = RigBody.of(rigged_body())
    poses = sample_poses(model, 2, seed=3, colliding=True)
    for latent in poses:
        result = soft(model, latent, 0.003)
        assert (result.energy_after or 0.0) < 0.9 * (result.energy_before or 0.0)
    frames = np.linspace(poses[0], poses[1], 4)
    options = ResolveOptions(largest_change=0.01, clearance=0.002)
    results = model.resolver.resolve_many(frames, options, workers=2, sequence=True)
    assert max(result.vertex_distance_max for result in results) <= 0.01
    assert all((r.energy_after or 0.0) <= (r.energy_before or 0.0) for r in results)


def test_a_character_is_pushed_out_of_its_clothes_where_that_is_nearer() -> None:
    model = RigBody.of(skirted_body())
    gains = []
    for latent in sample_poses(model, 57, seed=11, colliding=True)[[8, 35, 56]]:
        plain = model.resolve(latent, ResolveOptions(largest_change=None))
        assert (plain.exactly_free, plain.step) == (True, Step.TOWARDS)
        result = soft(model, latent, 0.25)
        assert result.exactly_free
        assert result.step in (Step.TOWARDS, Step.PUSH_OUT)
        gains.append(1.0 - result.vertex_distance_mean / plain.vertex_distance_mean)
        assert (result.step == Step.PUSH_OUT) == (gains[-1] > 0.0)
    assert min(gains) >= 0.0
    assert max(gains) > 0.1


def test_steps_out_of_contact_end_in_a_nearer_pose_than_is_known_or_none() -> None:
    model = RigBody.of(skirted_body())
    latent = sample_poses(model, 57, seed=11, colliding=True)[8]
    check = model.exact_check()
    least = LeastOverlap(check, model.resolver.problem(latent, ResolveOptions()), 0.25)
    far = least.push_out(lambda free: free, None)
    assert far is not None
    assert check.is_free(far)
    finished: list[FloatArray] = []

    def finish(free: FloatArray) -> FloatArray:
        finished.append(free)
        return free

    nearest = latent + 1e-6 * (far - latent)
    assert least.push_out(finish, nearest) is None
    assert finished == []


@pytest.mark.parametrize("locked", [False, True])
def test_draws_come_nearer_and_stay_free(locked: bool) -> None:
    model = RigBody.of(skirted_body())
    latent = sample_poses(model, 57, seed=11, colliding=True)[8]
    domains = frozenset(range(model.space.n_domains // 2)) if locked else frozenset()
    check = model.exact_check()
    problem = model.resolver.problem(latent, ResolveOptions(locked_domains=domains))
    free = fall_back(check, problem, np.atleast_2d(model.free_latent))
    assert free is not None
    drawn = draw_nearer(check, problem, free)
    assert check.is_free(drawn)
    target, before, after = check.decode(np.stack([latent, free, drawn]))
    far, near = (np.linalg.norm(pose - target, axis=1).mean() for pose in (before, after))
    assert near < 0.8 * far
    assert (problem.low <= drawn).all()
    assert (drawn <= problem.high).all()
    assert np.array_equal(drawn, draw_nearer(check, problem, free))
    assert not np.array_equal(drawn, draw_nearer(check, problem, free, seed=1))


def test_a_largest_change_is_checked() -> None:
    with pytest.raises(LCollisionError, match="a largest change needs the exact check"):
        ResolveOptions(largest_change=0.1, verify=False)
    # The default works without the exact check.
    assert not ResolveOptions(verify=False).verify


def deepest_by_parts(body: Body, vertices: np.ndarray) -> dict[frozenset[int], float]:
    """Return the largest depth of each pair of domains, by brute force."""
    size = body.body_size
    found = all_pairs(vertices.astype(np.float64), body.faces, DEPTH_TOLERANCE * size)
    owner = body.space.vertex_domain[body.faces[:, 0]]
    deepest: dict[frozenset[int], float] = {}
    for pair, depth in zip(owner[found.pairs].tolist(), found.depth / size, strict=True):
        deepest[frozenset(pair)] = max(deepest.get(frozenset(pair), 0.0), depth)
    return deepest


def test_a_belly_gives_and_a_hand_does_not(body: Body) -> None:
    parts = body.domain_names
    belly, tolerated = parts.index("belly & chest"), 0.003
    arms = [name for name in parts if "upper arm" in name]
    entries = tuple(f"{parts[belly]}:{name}={tolerated}" for name in arms)
    tolerant = body.with_options(RuleOptions(tolerated_pairs=entries))
    gives = {frozenset((belly, parts.index(name))) for name in arms}
    colliding = sample_poses(body, 5, seed=6, colliding=True)
    before = [deepest_by_parts(body, body.exported_vertices(latent)) for latent in colliding[3:]]
    assert any("hand" in parts[part] for pair in before[0] for part in pair)
    dragger = tolerant.dragger()
    for latent, was in zip(colliding[3:], before, strict=True):
        assert set(was) - gives
        assert max(was.get(pair, 0.0) for pair in gives) > tolerated
        result = tolerant.resolve(latent)
        assert result.exactly_free
        left = deepest_by_parts(body, result.vertices)
        assert set(left) <= gives
        assert 0.0 < max(left.values()) <= tolerated
        # It is nearer than the result without overlap.
        assert result.vertex_distance_mean < body.resolve(latent).vertex_distance_mean
        # A drag from there goes no deeper.
        dragger.begin(result.latent, None, options=DragOptions(solid=True))
        for _ in range(3):
            end = dragger.move(latent)
        assert end.exactly_free
        dragged = deepest_by_parts(body, end.vertices)
        assert set(dragged) <= gives
        assert max(dragged.values()) <= tolerated
    drawn = sample_poses(tolerant, 30, seed=1, colliding=False)
    overlap = [latent for latent in drawn if not body.exact_check().is_free(latent)]
    deepest = deepest_by_parts(body, body.exported_vertices(overlap[0]))
    assert set(deepest) <= gives
