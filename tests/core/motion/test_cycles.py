"""Cycles, whose last frame equals the first: they stay cyclic and smooth across the seam."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lcollision_core.bodies import RigBody
from lcollision_core.meshes import RigidTransform
from lcollision_core.motion import (
    Motion,
    MotionOptions,
    Solved,
    colliding_spans,
    resolve_motion,
    screen_motion,
)
from lcollision_core.motion import spans as span_solver
from tests.core.motion.swings import CLIP, swinging_body
from tests.rigged_shapes import FloatArray

UP = (0.0, 0.0, 1.0)
N_FRAMES = 49


@cache
def cycle() -> tuple[RigBody, Motion]:
    """Return a body and a cycle: the arm is in the trunk at the seam, and free in the middle."""
    character = swinging_body(n_frames=N_FRAMES, begin=0.5)
    body = RigBody.of(character)
    frames = character.sample(CLIP, None)
    assert frames.transforms is not None
    codes = body.space.codes_of_transforms(frames.transforms)
    codes[-1] = codes[0]
    return body, Motion(CLIP, frames.times, codes)


def bends(rows: FloatArray) -> FloatArray:
    """Return the (T - 1) squared second differences of (T, ...) rows of a cycle, the seam first."""
    turn = rows[:-1].reshape(len(rows) - 1, -1)
    bend = np.roll(turn, 1, axis=0) - 2.0 * turn + np.roll(turn, -1, axis=0)
    return np.asarray((bend**2).sum(axis=1), dtype=np.float64)


@pytest.mark.parametrize(
    "easing",
    [
        pytest.param(8, id="a span across the seam"),
        pytest.param(60, marks=pytest.mark.slow, id="a span of all frames"),
    ],
)
@pytest.mark.parametrize("window", [pytest.param(120, marks=pytest.mark.slow), 30])
def test_a_collision_at_the_seam_is_resolved_as_any_other(
    easing: int, window: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(span_solver, "WINDOW", window)
    monkeypatch.setattr(span_solver, "OVERLAP", 10)
    body, motion = cycle()
    check = body.exact_check()
    kept: dict[int, Solved] = {}
    options = MotionOptions(easing=easing)
    found = resolve_motion(body.resolver, motion, UP, options, keep=kept.__setitem__)
    codes = found.motion.codes
    assert not found.before[[0, 1, -2, -1]].any()
    assert found.after.all()
    assert codes[0].tobytes() == codes[-1].tobytes()
    screened = screen_motion(found.motion, check)
    assert (screened.colliding, screened.in_between) == ((), ())
    if easing == 8:
        first, last = found.spans
        assert (first.start, last.stop) == (0, N_FRAMES)
        assert codes[first.stop : last.start].tobytes() == (
            motion.codes[first.stop : last.start].tobytes()
        )
    else:
        assert found.spans == (range(N_FRAMES),)
    old, new = (body.decode(rows) / body.body_size for rows in (motion.codes, codes))
    # The seam is no worse than its surroundings.
    correction = bends(new - old)
    assert 0.0 < correction[0] < 2.0 * max(correction[-4:].max(), correction[1:5].max())
    if window > N_FRAMES:
        assert bends(new).sum() < 1.05 * bends(old).sum()
    again = resolve_motion(body.resolver, motion, UP, options, done=kept)
    assert again.motion.codes.tobytes() == codes.tobytes()


def test_a_range_that_ends_at_the_seam_changes_both_its_frames() -> None:
    body, motion = cycle()
    for within in (range(14), range(N_FRAMES - 14, N_FRAMES)):
        found = resolve_motion(body.resolver, motion, UP, MotionOptions(easing=4), within=within)
        codes = found.motion.codes
        assert (codes[0] != motion.codes[0]).any()
        assert codes[0].tobytes() == codes[-1].tobytes()
        inside = {frame % (N_FRAMES - 1) for frame in within} | {N_FRAMES - 1}
        others = [frame for frame in range(N_FRAMES) if frame not in inside]
        assert codes[others].tobytes() == motion.codes[others].tobytes()


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_shortest_cycles_stay_cycles(n: int) -> None:
    body, motion = cycle()
    codes = np.array(motion.codes[[*range(n), 0]])
    found = resolve_motion(body.resolver, Motion("short", np.arange(n + 1) / 30.0, codes), UP)
    assert found.after.all()
    assert (found.motion.codes[0] != codes[0]).any()
    assert found.motion.codes[0].tobytes() == found.motion.codes[-1].tobytes()


def test_frames_that_lie_elsewhere_or_hold_more_are_no_cycle() -> None:
    body, motion = cycle()
    assert motion.is_cycle
    assert not motion.part(range(40)).is_cycle
    assert not motion.part(range(1)).is_cycle
    here, there = (RigidTransform(np.eye(3), np.full(3, way)) for way in (0.0, 1.0))
    for end, is_cycle in ((here, True), (there, False), (None, False)):
        placed = replace(motion, placements=(*(here,) * (N_FRAMES - 1), end))
        assert placed.is_cycle is is_cycle
    rest = body.space.rest_vertices
    thicker = [body.space.shaped_as(motion.codes[0], (1.0 + 0.01 * n) * rest) for n in range(49)]
    assert replace(motion, space_at=lambda time: thicker[int(time) % 48]).is_cycle
    assert not replace(motion, space_at=lambda time: thicker[int(time)]).is_cycle


def test_two_turns_go_on_where_the_first_ends() -> None:
    body, motion = cycle()
    thicker = [body.space.shaped_as(motion.codes[0], body.space.rest_vertices) for _ in range(49)]
    placed = RigidTransform(np.eye(3), np.ones(3))
    twice = replace(
        motion,
        placements=(placed,) * N_FRAMES,
        space_at=lambda time: thicker[int(time)],
    ).two_turns()
    n = N_FRAMES - 1
    assert len(twice) == 2 * n
    np.testing.assert_allclose(np.diff(twice.times), 1.0 / 30.0)
    assert twice.codes[n:].tobytes() == twice.codes[:n].tobytes() == motion.codes[:n].tobytes()
    assert twice.placement(n + 3) is placed
    assert twice.space(n + 3, body.space) is thicker[3]


def test_spans_of_a_cycle_go_on_across_its_seam() -> None:
    colliding = np.zeros(20, dtype=np.bool_)
    colliding[[1, 10]] = True
    assert colliding_spans(colliding, 2) == [range(4), range(8, 13)]
    assert colliding_spans(colliding, 2, None, True) == [range(8, 13), range(19, 24)]
    assert colliding_spans(colliding, 2, range(18), True) == [range(8, 13), range(20, 24)]
    # The frame after the last one is the first.
    assert colliding_spans(colliding, 2, range(9, 21), True) == [range(9, 13), range(19, 21)]
    assert colliding_spans(colliding, 30, None, True) == [range(20)]
    colliding[0] = True
    assert colliding_spans(colliding, 30, None, True) == [range(2, 22)]
    assert colliding_spans(np.zeros(20, dtype=np.bool_), 30, None, True) == []
