"""Drags: targets, fixed parts, and solid drags that never collide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import LearnedBody, sample_poses
from lcollision_core.errors import LCollisionError, ShapeError
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import (
    LARGEST_RADIUS,
    DragOptions,
    DragStep,
    Grip,
    Pin,
    PoseDragger,
    Twist,
    make_grip,
)
from lcollision_core.posing.dragger import Decoded, HeldPatch, PatchGoal, TwistGoal

PLAIN = DragOptions(solid=False, standing=False, whole_body=True)


@pytest.fixture(scope="module")
def free(tube_model: LearnedBody) -> FloatArray:
    """Return a free pose of the tube, nearly straight."""
    return sample_poses(tube_model, 1, seed=5, colliding=False)[0]


@pytest.fixture(scope="module")
def tip(tube_model: LearnedBody) -> Grip:
    along = tube_model.reference[:, tube_model.up_axis]
    return make_grip(tube_model.space, int(along.argmax()), 0.05)


@pytest.fixture(scope="module")
def foot(tube_model: LearnedBody) -> Grip:
    along = tube_model.reference[:, tube_model.up_axis]
    return make_grip(tube_model.space, int(along.argmin()), 0.05)


def settled(dragger: PoseDragger, target: FloatArray, events: int = 200) -> DragStep:
    for _ in range(events):
        step = dragger.move(target)
        if step.settled:
            break
    return step


def test_a_patch_goes_where_another_pose_has_it(
    tube_model: LearnedBody, free: FloatArray, tip: Grip
) -> None:
    dragger = tube_model.dragger()
    for share in (0.9, 0.7, 0.5, 0.0):
        target = tip.position(tube_model.decode(share * free))
        dragger.begin(free, tip, options=PLAIN)
        step = settled(dragger, target)
        assert step.miss < 0.01
        away = np.linalg.norm(tip.position(step.vertices) - target) / tube_model.body_size
        assert away == pytest.approx(step.miss, abs=1e-5)
        np.testing.assert_allclose(
            step.vertices, tube_model.decode(step.latent), atol=1e-6 * tube_model.body_size
        )


def test_weights_of_a_patch_fall_along_the_surface(tube_model: LearnedBody) -> None:
    grip = make_grip(tube_model.space, 40, 0.1)
    assert grip.weights.sum() == pytest.approx(1.0)
    assert grip.vertices[grip.weights.argmax()] == 40
    assert 1 < len(grip.vertices) < tube_model.n_vertices
    away = np.linalg.norm(tube_model.reference - tube_model.reference[40], axis=1)
    assert (away[grip.vertices] < 0.1 * tube_model.body_size).all()
    assert make_grip(tube_model.space, 40, 9.0).radius == LARGEST_RADIUS
    for vertex in (-1, tube_model.n_vertices):
        with pytest.raises(LCollisionError, match=r"must be 0 to \d+, got"):
            make_grip(tube_model.space, vertex)


def test_pins_stay_while_the_tip_moves(
    tube_model: LearnedBody, free: FloatArray, tip: Grip, foot: Grip
) -> None:
    dragger, vertices = tube_model.dragger(), tube_model.decode(free)
    target = tip.position(vertices) + 0.05 * tube_model.body_size * np.array([1.0, 0.0, 0.0])
    drifts = {}
    for pins in ((), (Pin.of(foot, vertices),)):
        dragger.begin(free, tip, pins, PLAIN)
        step = settled(dragger, target)
        moved = foot.position(step.vertices) - foot.position(vertices)
        drifts[len(pins)] = float(np.linalg.norm(moved)) / tube_model.body_size
    assert drifts[1] < 0.003 < drifts[0]


def test_a_solid_drag_is_free_where_a_plain_one_collides(
    tube_model: LearnedBody, free: FloatArray, tip: Grip, foot: Grip
) -> None:
    """The tip is dragged to the foot, and further."""
    start, end = (grip.position(tube_model.decode(free)) for grip in (tip, foot))
    collided = []
    dragger = tube_model.dragger()
    for solid in (False, True):
        step = dragger.begin(free, tip, options=replace(PLAIN, solid=solid, strength=0.0))
        for fraction in np.linspace(0.0, 1.5, 60):
            step = dragger.move(start + fraction * (end - start))
            exact = tube_model.detector.detect(step.vertices)
            if solid:
                assert step.exactly_free is True
                assert step.collisions is not None
                assert not exact.colliding
            else:
                assert step.exactly_free is None
                collided.append(exact.colliding)
    assert any(collided)
    assert len(step.contacts) > 0


@pytest.mark.slow
def test_many_random_solid_events_never_collide(
    tube_model: LearnedBody, free: FloatArray, tip: Grip, foot: Grip
) -> None:
    """Grips, twists, codes, pins and locks in random order, each from the last drag's end."""
    generator = np.random.default_rng(0)
    dragger, latent = tube_model.dragger(), free
    held, n_touching = 0, 0
    for _ in range(60):
        vertices = tube_model.decode(latent)
        vertex = int(generator.integers(tube_model.n_vertices))
        grip = [make_grip(tube_model.space, vertex), Twist(int(generator.integers(2))), None][
            generator.choice(3, p=[0.6, 0.2, 0.2])
        ]
        pins = [Pin.of(one, vertices) for one in (tip, foot) if generator.random() < 0.3]
        locked = frozenset(np.flatnonzero(generator.random(2) < 0.2).tolist())
        options = DragOptions(strength=float(generator.choice([0.0, 1.0])), locked_domains=locked)
        step = dragger.begin(latent, grip, pins, options)
        codes = tube_model.embedding.codes_of(locked)
        for event in range(40):
            # The pointer rests for a while at each position.
            if event % 10:
                pass
            elif grip is None:
                target = tube_model.latent_space.sample(1, generator)[0]
            elif isinstance(grip, Twist):
                target = generator.uniform(-3.0, 3.0, 1)
            else:
                other = generator.integers(tube_model.n_vertices)
                target = vertices[vertex] + 1.5 * (vertices[other] - vertices[vertex])
            step = dragger.move(target)
            assert not tube_model.detector.are_colliding(step.vertices[None])[0]
            assert step.exactly_free
            assert np.array_equal(step.latent[codes], latent[codes])
            n_touching += len(step.contacts) > 0
        held += not np.array_equal(step.latent, latent)
        latent = step.latent
    # The poses did move, and came into contact.
    assert held > 36
    assert n_touching > 12


def test_a_colliding_pose_is_not_made_worse(tube_model: LearnedBody, tip: Grip) -> None:
    generator = np.random.default_rng(1)
    dragger, freed = tube_model.dragger(), 0
    for latent in sample_poses(tube_model, 6, seed=9, colliding=True):
        step = dragger.begin(latent, tip)
        assert step.exactly_free is False
        before = step.collisions
        start = tip.position(step.vertices)
        for _ in range(20):
            step = dragger.move(start + generator.normal(size=3) * 0.3 * tube_model.body_size)
            assert step.collisions is not None
            assert before is not None
            # Up to rounding, or up to the tolerated depths of a region.
            assert step.collisions.energy <= before.energy * (1.0 + 1e-5) or step.exactly_free
            before = step.collisions
        freed += bool(step.exactly_free)
    assert freed > 0


def test_codes_that_the_target_leaves_do_not_move(
    tube_model: LearnedBody, free: FloatArray
) -> None:
    """Like a single slider: it stops at contact, and the others stay."""
    dragger, low, high = tube_model.dragger(), tube_model.space.low, tube_model.space.high
    stopped = 0
    for code in range(tube_model.latent_size):
        for end in (low[code], high[code]):
            target = free.copy()
            target[code] = end
            dragger.begin(free, None)
            step = settled(dragger, target)
            others = np.arange(len(free)) != code
            assert np.array_equal(step.latent[others], free[others])
            assert step.exactly_free
            if tube_model.detector.are_colliding(tube_model.decode(target)[None])[0]:
                assert step.latent[code] != end
                stopped += 1
    assert stopped > 0


def test_a_twist_turns_a_limb_about_its_long_axis() -> None:
    body = LearnedBody.load("body")
    thigh = body.domain_names.index("left thigh")
    start = body.known_poses[0].astype(np.float64)
    dragger = body.dragger()
    before = dragger.begin(start, Twist(thigh)).vertices.astype(np.float64)
    step = settled(dragger, np.array([0.5]))
    inside = body.space.vertex_domain == thigh
    now = step.vertices[inside].astype(np.float64)
    before = before[inside] - before[inside].mean(axis=0)
    # A rigid fit turns about the limb, by about the requested angle.
    turn, _ = Rotation.align_vectors(now - now.mean(axis=0), before)
    axis = np.linalg.eigh(before.T @ before)[1][:, -1]
    assert abs(float(turn.as_rotvec() @ axis)) == pytest.approx(0.5, abs=0.15)
    assert turn.magnitude() < 0.7


def test_slopes_of_goals_are_those_of_differences(
    tube_model: LearnedBody, free: FloatArray, tip: Grip, foot: Grip
) -> None:
    space = tube_model.space
    start = space.decode(free[None])[0]
    pins = [HeldPatch(foot, foot.position(start) + 0.004)]
    goals = [
        (PatchGoal(space, tip, pins, 0.0), tip.position(start) + np.array([0.008, -0.004, 0.002])),
        (TwistGoal(space, 0, pins, 0.0, start), np.array([0.1])),
    ]
    for goal, target in goals:
        _, gradient = goal.cost(Decoded(free, start), target)

        def cost(codes: FloatArray, goal=goal, target=target) -> float:
            at = space.decode(codes[None])[0]
            drift = float(((foot.position(at) - pins[0].place) ** 2).sum())
            miss = goal.miss(Decoded(codes, at), target)
            if isinstance(goal, TwistGoal):
                arms = start[goal._part.vertices] - goal._part.position(start)
                radius = np.sqrt((np.cross(goal.axis, arms) ** 2).sum() / len(arms))
                middle = goal._part.position(at) - goal._part.position(start)
                return 0.5 * ((miss * radius) ** 2 + 100.0 * (drift + float(middle @ middle)))
            return 0.5 * (miss**2 + 100.0 * drift)

        step = 2e-3
        differences = np.array(
            [
                (cost(free + step * unit) - cost(free - step * unit)) / (2.0 * step)
                for unit in np.eye(len(free))
            ]
        )
        assert np.abs(gradient).max() > 1e-6
        np.testing.assert_allclose(gradient, differences, atol=0.05 * np.abs(gradient).max())


def test_limbs_do_not_stretch_beyond_the_limit(
    tube_model: LearnedBody, free: FloatArray, tip: Grip, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The tube's codes stretch it by at most 6 %.
    monkeypatch.setattr("lcollision_core.posing.dragger.STRETCH", 0.03)
    lengths = tube_model.topology.edge_lengths
    longest = np.max([lengths(v) for v in tube_model.decode(tube_model.known_poses)], axis=0)
    dragger, stretched = tube_model.dragger(), {}
    for strength in (0.0, 1.0):
        dragger.begin(free, tip, options=replace(PLAIN, strength=strength))
        step = settled(dragger, 5.0 * tip.position(tube_model.decode(free)))
        stretched[strength] = (lengths(step.vertices.astype(np.float64)) / longest).max()
    assert stretched[1.0] < 1.03 + 1e-6 < stretched[0.0]


def test_nothing_moves_where_nothing_can(
    tube_model: LearnedBody, free: FloatArray, tip: Grip
) -> None:
    dragger = tube_model.dragger()
    target = tip.position(tube_model.decode(free)) + 0.1
    dragger.begin(free, tip, options=DragOptions(locked_domains=frozenset({0, 1})))
    assert np.array_equal(dragger.move(target).latent, free)
    dragger.begin(free, tip)
    for nothing in (np.nan, np.inf):
        step = dragger.move(np.array([nothing, 0.0, 0.0]))
        assert np.array_equal(step.latent, free)
        assert step.settled
    far = dragger.move(np.full(3, 1e9))
    assert np.isfinite(far.latent).all()
    assert far.exactly_free
    dragger.end()
    with pytest.raises(RuntimeError, match="no drag has begun"):
        dragger.move(target)


def test_pins_that_contradict_the_grip_hold_it(
    tube_model: LearnedBody, free: FloatArray, tip: Grip
) -> None:
    dragger, vertices = tube_model.dragger(), tube_model.decode(free)
    dragger.begin(free, tip, [Pin.of(tip, vertices)], PLAIN)
    step = settled(dragger, tip.position(vertices) + 0.2 * tube_model.body_size)
    moved = np.linalg.norm(tip.position(step.vertices) - tip.position(vertices))
    assert moved < 0.003 * tube_model.body_size


def test_the_same_events_give_the_same_pose(
    tube_model: LearnedBody, free: FloatArray, tip: Grip, foot: Grip
) -> None:
    end = foot.position(tube_model.decode(free))
    latents = []
    for dragger in (tube_model.dragger(), tube_model.dragger()):
        dragger.begin(free, tip)
        latents.append(settled(dragger, end, 20).latent)
    assert np.array_equal(*latents)


def test_bad_poses_are_refused(tube_model: LearnedBody, free: FloatArray, tip: Grip) -> None:
    dragger = tube_model.dragger()
    with pytest.raises(ShapeError, match=r"a pose to drag must be \d+ numbers, got"):
        dragger.begin(free[:-1], tip)
    with pytest.raises(ShapeError, match="contains NaN"):
        dragger.begin(np.full_like(free, np.nan), tip)
    with pytest.raises(LCollisionError, match="the vertex to take hold of must be"):
        dragger.begin(free, tip, [Pin(10**6, 0.03, (0.0, 0.0, 0.0))])
    with pytest.raises(LCollisionError, match="the body part to twist must be 1 to 2, got 100"):
        dragger.begin(free, Twist(99))
    # A drag that failed to begin does not continue the previous one.
    with pytest.raises(RuntimeError, match="no drag has begun"):
        dragger.move(np.zeros(3))
