"""Motions of scenes: each body by itself, and together where they meet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lcollision_core.bodies import SceneBody, open_body
from lcollision_core.bodies.motions import read_motions
from lcollision_core.bodies.scene_body import SceneFile, ScenePart
from lcollision_core.bodies.scene_file import body_of_scene
from lcollision_core.jobs import Job
from lcollision_core.motion import Motion, resolve_motion
from lcollision_core.options import MotionChoice
from lcollision_core.tasks.scenes import scene_motion
from tests.small_models import SWING


def _scene(x: float) -> tuple[SceneBody, Motion]:
    """Open two swinging bodies, the second shifted and turned round."""
    second = ScenePart(str(SWING), "second", (x, 0.0, 0.0), 180.0)
    body = body_of_scene(SceneFile((ScenePart(str(SWING), "first"), second)))
    return body, scene_motion(body, (), MotionChoice())[0]


def _pairs(body: SceneBody, motion: Motion, frame: int) -> int:
    return len(body.detector.detect(motion.vertices(frame, body.exact_check())).pairs)


def test_bodies_that_do_not_meet_come_out_as_each_does_alone() -> None:
    body, motion = _scene(9.0)
    motion = motion.part(range(4, 20))
    alone = open_body(SWING)
    own = read_motions(alone, Path(SWING), motion.name, None)[0].part(range(4, 20))
    reports: list[tuple[int, int]] = []
    job = Job(lambda *done: reports.append(done))
    expected = resolve_motion(alone.resolver, own, alone.up, job=job)
    of_one = reports[-1]
    reports.clear()
    result = resolve_motion(body.resolver, motion, body.up, job=job)
    assert not result.before.all()
    assert result.after.all()
    for name in ("first", "second"):
        codes = body.codes_of_member(name, result.motion.codes)
        np.testing.assert_array_equal(codes, expected.motion.codes)
    assert [span.start for span in result.spans] == [span.start for span in expected.spans]
    done = [n_done for n_done, _ in reports]
    assert done == sorted(done)
    # Both move alike, and are resolved once.
    assert reports[-1] == of_one
    assert of_one[0] == of_one[1]


def test_no_frame_has_more_pairs_where_bodies_meet() -> None:
    body, motion = _scene(1.0)
    motion = motion.part(range(3, 14))
    meshes = (motion.vertices(frame, body.exact_check()) for frame in range(len(motion)))
    pairs = np.concatenate([body.detector.detect(mesh).pairs for mesh in meshes])
    assert (np.diff(pairs < body.faces_of["first"].stop, axis=1) != 0).any()
    result = resolve_motion(body.resolver, motion, body.up)
    before, after = (
        [_pairs(body, of, frame) for frame in range(len(motion))] for of in (motion, result.motion)
    )
    assert sum(before) > sum(after)
    assert all(new <= old for old, new in zip(before, after, strict=True))
    assert [n == 0 for n in after] == result.after.tolist()
    assert [n == 0 for n in before] == result.before.tolist()


def test_a_stop_keeps_what_was_freed_in_each_body() -> None:
    body, motion = _scene(1.0)
    motion = motion.part(range(3, 14))
    # Bodies that move differently are not resolved as one.
    first, second = (body.codes_of_member(name, motion.codes) for name in ("first", "second"))
    each = zip(first, 1.001 * second, strict=True)
    motion = replace(motion, codes=np.stack([body.joined_codes(codes) for codes in each]))
    stop, totals = Job(), list[int]()

    def report(_: int, n_frames: int) -> None:
        totals.append(n_frames)
        # Both bodies have as many frames to resolve; more are of both together.
        if n_frames > 2 * totals[0]:
            stop.cancel()

    result = resolve_motion(body.resolver, motion, body.up, job=Job(report), stop=stop)
    assert stop.cancelled
    assert result.unfinished
    moved = (result.motion.codes != motion.codes).any(axis=1)
    assert all(moved[span].all() for span in map(list, result.rough))
    pairs = [
        [_pairs(body, of, frame) for frame in range(len(motion))] for of in (motion, result.motion)
    ]
    assert [n == 0 for n in pairs[1]] == result.after.tolist()
    assert result.before.sum() < result.after.sum() < len(motion)
    assert all(new <= old for old, new in zip(*pairs, strict=True))
