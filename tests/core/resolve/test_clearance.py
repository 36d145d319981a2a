"""Poses, drags and motions that keep a clearance, by brute force over all pairs."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from lcollision_core.bodies import Body, open_body
from lcollision_core.contact import depth_slopes
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion import MotionOptions, resolve_motion, screen_motion
from lcollision_core.posing import DragOptions
from lcollision_core.posing.exact import ContactRegions, clearance_slopes, contact_slopes
from lcollision_core.resolve import ResolveOptions, Step
from tests.core.brute_force import distances, signed_distances
from tests.core.motion.swings import swinging

CLEARANCE = 0.001
N_POSES = int(os.environ.get("LCOLLISION_POSES", "4"))


@pytest.fixture(scope="module")
def body() -> Body:
    return open_body("body")


@pytest.fixture(scope="module")
def colliding(body: Body) -> FloatArray:
    drawn = body.sample(5 * N_POSES, np.random.default_rng(4))
    is_colliding = body.detector.are_colliding(body.decode(drawn).astype(np.float32))
    return drawn[is_colliding][:N_POSES]


def least_by_brute_force(body: Body, vertices: npt.NDArray[np.floating], bound: float) -> float:
    """Return the least signed distance between parts, infinite if it is not below the bound."""
    faces, size = body.topology.faces, body.body_size
    found = signed_distances(vertices.astype(np.float64) / size, faces, bound)
    corners = body.detector.reference[faces] / size
    at_rest = distances(corners[found.pairs[:, 0]], corners[found.pairs[:, 1]])
    return float(found.depth[found.depth < 0.5 * at_rest].min(initial=np.inf))


def test_resolved_poses_keep_the_clearance(body: Body, colliding: FloatArray) -> None:
    options, touching = ResolveOptions(clearance=CLEARANCE), 0
    assert len(colliding) == N_POSES
    for latent in colliding:
        result = body.resolve(latent, options)
        assert result.exactly_free
        least = least_by_brute_force(body, result.vertices, 0.002)
        assert least >= CLEARANCE - 1e-9
        if result.least_distance is None:
            assert least >= 0.002 - 1e-9
        else:
            assert result.least_distance == pytest.approx(least, abs=1e-9)
        # The clearance is not exceeded by much, as the pose stays near.
        touching += least < 1.5 * CLEARANCE
        plain = body.resolve(latent)
        assert plain.least_distance is None
        assert plain.exactly_free
    assert touching >= 2


def test_a_pose_that_is_free_and_too_near_moves(body: Body, colliding: FloatArray) -> None:
    # Free poses that nearly touch, as Resolve without a clearance leaves them.
    for latent in colliding:
        near = body.resolve(latent)
        least = least_by_brute_force(body, near.vertices, 0.002)
        if least < 0.5 * CLEARANCE:
            break
    assert least < 0.5 * CLEARANCE
    assert body.resolve(near.latent).step == Step.UNCHANGED
    result = body.resolve(near.latent, ResolveOptions(clearance=CLEARANCE))
    assert (result.exactly_free, result.step == Step.UNCHANGED) == (True, False)
    assert result.pairs_before is not None
    assert result.pairs_before > 0 == result.pairs_after
    again = body.resolve(result.latent, ResolveOptions(clearance=CLEARANCE))
    assert again.step == Step.UNCHANGED


def test_many_at_once_are_those_one_by_one_wherever_they_lie(
    body: Body, colliding: FloatArray
) -> None:
    options = ResolveOptions(clearance=CLEARANCE)
    far = RigidTransform(np.eye(3), np.array([30.0, -10.0, 5.0]), 1.0)
    some = body.resolver.resolve_many(
        colliding[:2], options, 2, placements=[None, far], sequence=True
    )
    alone = body.resolve(colliding[0], options)
    np.testing.assert_array_equal(some[0].latent, alone.latent)
    check = body.exact_check(far, clearance=CLEARANCE)
    assert check.is_free(some[1].latent)
    nearest = check.least_distance(some[1].vertices)
    assert nearest is None or nearest.distance >= CLEARANCE - 1e-9


def test_slopes_of_what_pairs_lack_are_those_of_differences() -> None:
    generator = np.random.default_rng(1)
    a = generator.uniform(-0.5, 0.5, (60, 3, 3))
    b = generator.uniform(-0.5, 0.5, (60, 3, 3)) + [0.0, 0.0, 0.1]
    slopes = clearance_slopes(a, b)
    penetrates = distances(a, b) < 1e-9
    corners = np.concatenate([a, b], axis=1)

    def lacks(moved: FloatArray) -> FloatArray:
        one, other = moved[:, :3], moved[:, 3:]
        lack = -distances(one, other)
        lack[penetrates] = depth_slopes(one[penetrates], other[penetrates])[0]
        return lack

    for corner, axis in np.ndindex(6, 3):
        step = np.zeros_like(corners)
        step[:, corner, axis] = 1e-6
        numbers = (lacks(corners + step) - lacks(corners - step)) / 2e-6
        np.testing.assert_allclose(slopes[:, corner, axis], numbers, atol=1e-4)
    n_far = np.count_nonzero(~penetrates)
    assert 10 < n_far < 50


def test_contacts_that_do_not_touch_get_farther_against_their_slopes(
    body: Body, colliding: FloatArray
) -> None:
    near = body.resolve(colliding[0]).latent
    check = body.exact_check(clearance=0.004)
    decoded = check.decode(near)[0]
    found = check.find(check.exported(decoded))
    regions = ContactRegions.of(check.space, found)
    deepest, slopes = contact_slopes(check.space, near, decoded, found, regions, has_clearance=True)
    assert found.colliding
    region = deepest[0]
    step = 1e-4 * slopes[0] / (slopes[0] @ slopes[0])
    pairs = body.faces[found.pairs[regions.of_pair == region]]
    weights = found.penetration_depth[regions.of_pair == region] ** 2

    def lacks(codes: FloatArray) -> float:
        moved = check.decode(codes)[0] / 1.0
        return -float(weights @ distances(*(moved[side] for side in np.moveaxis(pairs, 1, 0))))

    fall = (lacks(near - step) - lacks(near + step)) / weights.sum()
    assert fall == pytest.approx(-2e-4, rel=0.05)


@pytest.mark.slow
def test_a_solid_drag_keeps_the_clearance(body: Body, colliding: FloatArray) -> None:
    dragger, least = body.dragger(), []
    for clearance in (CLEARANCE, 0.0):
        here = dragger.begin(body.free_latent[0], None, options=DragOptions(clearance=clearance))
        for target in colliding[:2]:
            for _ in range(40):
                here = dragger.move(target)
                assert here.exactly_free
                if here.settled:
                    break
            least.append(least_by_brute_force(body, here.vertices, 0.004))
            # Contact stops it.
            assert len(here.contacts) > 0
    assert min(least[:2]) >= CLEARANCE - 1e-9
    assert max(least[:2]) < 0.004
    assert min(least[2:]) < CLEARANCE


@pytest.mark.slow
def test_a_motion_keeps_the_clearance_in_all_frames_and_between() -> None:
    body, motion = swinging()
    frame = ResolveOptions(clearance=0.005)
    found = resolve_motion(
        body.resolver, motion, (0.0, 0.0, 1.0), MotionOptions(easing=6, frame=frame)
    )
    assert found.after.all()
    near = body.exact_check(clearance=0.005)
    before, after = (screen_motion(one, near) for one in (motion, found.motion))
    assert 10 < len(before.colliding) < 40
    assert (after.colliding, after.in_between) == ((), ())
    plain = resolve_motion(
        body.resolver,
        motion,
        (0.0, 0.0, 1.0),
        MotionOptions(easing=6, frame=replace(frame, clearance=0.0)),
    )
    assert screen_motion(plain.motion, near).colliding
