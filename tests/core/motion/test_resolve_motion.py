"""Resolved motions: free, near, equally smooth, and the frames that are kept."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.motions import read_motions
from lcollision_core.contact import STRICT
from lcollision_core.errors import CancelledError, LCollisionError, ShapeError
from lcollision_core.jobs import Job
from lcollision_core.meshes.face_groups import component_labels
from lcollision_core.motion import (
    Motion,
    MotionOptions,
    MotionReport,
    Reason,
    ResolvedMotion,
    Solved,
    resolve_motion,
    screen_motion,
)
from lcollision_core.motion import spans as span_solver
from lcollision_core.motion.motion import knots_of, windows
from lcollision_core.resolve import ResolveOptions
from tests.core.motion.swings import CLIP, swinging, swinging_body, through_the_trunk
from tests.independent_check import crossing_pairs
from tests.rigged_shapes import head_in_torso

UP = (0.0, 0.0, 1.0)
OPTIONS = MotionOptions(easing=6)


@pytest.fixture(scope="module")
def resolved() -> ResolvedMotion:
    body, motion = swinging()
    return resolve_motion(body.resolver, motion, UP, OPTIONS)


def test_all_frames_become_free_and_so_do_the_poses_between(resolved: ResolvedMotion) -> None:
    body, motion = swinging()
    check = body.exact_check()
    assert 10 < np.count_nonzero(~resolved.before) < 40
    assert resolved.after.all()
    screened = screen_motion(resolved.motion, check)
    assert (screened.colliding, screened.in_between) == ((), ())
    # By independent code; the tubes do not touch at rest, and pairs that are near along a tube are
    # not counted.
    faces = body.topology.faces.astype(np.int64)
    tube = component_labels(body.topology)[faces[:, 0]]

    def crossing(of: Motion, frame: int) -> bool:
        found = crossing_pairs(of.vertices(frame, check).astype(np.float64), faces)
        return any(tube[a] != tube[b] for a, b in found)

    assert not any(crossing(resolved.motion, frame) for frame in range(0, len(motion), 5))
    worst = max(screen_motion(motion, check).colliding, key=lambda one: one.deepest)
    assert crossing(motion, worst.frame)


def test_frames_outside_of_the_spans_keep_every_bit(resolved: ResolvedMotion) -> None:
    _, motion = swinging()
    (span,) = resolved.spans
    colliding = np.flatnonzero(~resolved.before)
    assert (span.start, span.stop) == (colliding[0] - 6, colliding[-1] + 7)
    outside = np.ones(len(motion), dtype=np.bool_)
    outside[span.start : span.stop] = False
    assert outside.any()
    assert resolved.motion.codes[outside].tobytes() == motion.codes[outside].tobytes()
    changed = (resolved.motion.codes != motion.codes).any(axis=1)
    assert changed[colliding].all()


def test_the_motion_stays_near_and_as_smooth_as_it_was(resolved: ResolvedMotion) -> None:
    body, motion = swinging()
    check = body.exact_check()
    report = MotionReport.of(motion, resolved.motion, check, resolved.standing)
    assert report.acceleration_ratio < 1.04
    assert 0.0 < report.mean_change < 0.01
    # Resolved frame by frame, each from the previous correction, it jitters.
    results = body.resolver.resolve_many(motion.codes, workers=1, sequence=True)
    codes = np.stack([result.latent for result in results])
    shaking = MotionReport.of(motion, Motion("shaking", motion.times, codes), check)
    assert shaking.acceleration_ratio > 2.0 * report.acceleration_ratio
    assert shaking.largest_jump > report.largest_jump


def test_accelerations_too_small_to_see_count_as_alike() -> None:
    body, motion = swinging()
    check, still = body.exact_check(), np.tile(motion.codes[24], (6, 1))
    side = np.array([0.0, 1.0, -1.0, 1.0, -1.0, 0.0])[:, None]
    turn = np.eye(body.latent_size)[int(np.ptp(motion.codes, axis=0).argmax())]

    def ratio(before: float, after: float, rate: float = 30.0) -> float:
        both = (
            Motion("still", np.arange(6) / rate, still + size * side * turn)
            for size in (before, after)
        )
        return MotionReport.of(*both, check).acceleration_ratio

    assert ratio(0.0, 0.0) == 1.0
    assert ratio(1e-8, 1e-5) < 1.01
    assert ratio(0.0, 0.03) > 10.0
    assert 3.5 < ratio(0.05, 0.1) < 4.0
    # The same poses follow each other faster, so they accelerate more.
    assert ratio(0.0, 0.03, 120.0) > 100.0 * ratio(0.0, 0.03)


def test_an_arm_that_passes_through_the_trunk_between_two_free_frames_goes_round_it() -> None:
    body, motion = through_the_trunk()
    check = body.exact_check()
    before = screen_motion(motion, check)
    assert (before.colliding, before.in_between) == ((), (13,))
    found = resolve_motion(body.resolver, motion, UP, OPTIONS)
    assert found.spans == (range(7, 21),)
    assert found.after.all()
    after = screen_motion(found.motion, check)
    assert (after.colliding, after.in_between) == ((), ())
    outside = [frame for frame in range(len(motion)) if frame not in found.spans[0]]
    assert found.motion.codes[outside].tobytes() == motion.codes[outside].tobytes()
    # Without in-between poses, no collision is found.
    assert resolve_motion(body.resolver, motion, UP, replace(OPTIONS, substeps=0)).spans == ()
    # Nor if only the frames on one side may change.
    assert resolve_motion(body.resolver, motion, UP, OPTIONS, within=range(14)).spans == ()


# The shortest and the longest of six.
@pytest.mark.parametrize("seed", [4, 5])
def test_noise_in_a_real_clip_leads_to_as_good_a_motion(characters: Path, seed: int) -> None:
    source = characters / "mannequin-moves.glb"
    body = open_body(source)
    (clip,) = read_motions(body, source)
    noise = np.random.default_rng(seed).normal(0.0, 1e-6, clip.codes.shape)
    motion = replace(clip, codes=clip.codes + noise)
    found = resolve_motion(body.resolver, motion, body.space.up)
    assert not found.before.all()
    assert found.after.all()
    check = body.exact_check()
    assert screen_motion(found.motion, check).in_between == ()
    report = MotionReport.of(motion, found.motion, check, found.standing)
    assert report.acceleration_ratio < 1.04
    assert report.mean_change < 0.006


def test_standing_feet_stay_and_may_be_let_go(resolved: ResolvedMotion) -> None:
    body, motion = swinging()
    feet = [n for n, name in enumerate(body.domain_names) if "foot" in name.lower()]
    assert len(feet) == 2
    assert resolved.standing[:, feet].all()
    report = MotionReport.of(motion, resolved.motion, body.exact_check(), resolved.standing)
    assert report.foot_slide < 5e-4
    loose = resolve_motion(body.resolver, motion, UP, MotionOptions(easing=6, keep_feet=False))
    assert not loose.standing.any()
    named = MotionOptions(easing=6, feet=frozenset(feet[:1]))
    assert resolve_motion(body.resolver, motion, UP, named).standing[:, feet[0]].all()


def test_still_parts_stay_where_the_motion_has_them(resolved: ResolvedMotion) -> None:
    body, motion = swinging()
    head = body.domain_names.index("Head")
    inside = body.space.vertex_domain == head
    frame = ResolveOptions(still_domains=frozenset({head}))
    kept = resolve_motion(body.resolver, motion, UP, replace(OPTIONS, frame=frame))
    assert kept.after.all()
    old, loose, still = (
        body.decode(rows)[:, inside] / body.body_size
        for rows in (motion.codes, resolved.motion.codes, kept.motion.codes)
    )
    assert np.abs(loose - old).max() > 3e-3
    assert np.abs(still - old).max() < 2e-3


def test_results_do_not_depend_on_the_threads(resolved: ResolvedMotion) -> None:
    body, motion = swinging()
    alone = resolve_motion(body.resolver, motion, UP, OPTIONS, workers=1)
    assert alone.motion.codes.tobytes() == resolved.motion.codes.tobytes()


def test_a_stopped_run_goes_on_from_its_windows(resolved: ResolvedMotion) -> None:
    body, motion = swinging()
    kept: dict[int, Solved] = {}
    resolve_motion(body.resolver, motion, UP, OPTIONS, keep=kept.__setitem__)
    assert sorted(kept) == list(resolved.spans[0])
    token, again = Job(), dict[int, Solved]()

    def progress(done: int, total: int) -> None:
        assert done <= total == len(resolved.spans[0])

    found = resolve_motion(
        body.resolver,
        motion,
        UP,
        OPTIONS,
        2,
        token.part(progress),
        done=kept,
        keep=again.__setitem__,
    )
    assert again == {}
    assert found.motion.codes.tobytes() == resolved.motion.codes.tobytes()
    token.cancel()
    with pytest.raises(CancelledError):
        resolve_motion(body.resolver, motion, UP, OPTIONS, job=token)


def test_a_run_that_is_to_end_keeps_the_spans_that_are_done() -> None:
    character = swinging_body(n_frames=80, n_swings=2)
    body = RigBody.of(character)
    frames = character.sample(CLIP, None)
    assert frames.transforms is not None
    motion = Motion(CLIP, frames.times, body.space.codes_of_transforms(frames.transforms))
    stop, told = Job(), []

    def progress(done: int, total: int) -> None:
        told.append((done, total))

    def keep(frame: int, solved: Solved) -> None:  # noqa: ARG001
        stop.cancel()

    options = MotionOptions(easing=2)
    found = resolve_motion(
        body.resolver, motion, UP, options, 1, Job(progress), keep=keep, stop=stop
    )
    (done,), (left,) = found.spans, found.unfinished
    assert told[0] == (0, len(done) + len(left))
    colliding = np.flatnonzero(~found.before)
    assert {at for at in colliding.tolist() if at in done} | {
        at for at in colliding.tolist() if at in left
    } == set(colliding.tolist())
    check, codes = body.exact_check(), found.motion.codes
    assert check.are_free(codes[done.start : done.stop]).all()
    outside = np.setdiff1d(np.arange(len(motion)), done)
    assert codes[outside].tobytes() == motion.codes[outside].tobytes()
    assert found.after.tolist() == [bool(free) for free in check.are_free(codes)]


@pytest.mark.slow
def test_a_run_that_is_to_end_keeps_the_windows_that_are_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    character = swinging_body(n_frames=80, n_swings=2)
    body = RigBody.of(character)
    frames = character.sample(CLIP, None)
    assert frames.transforms is not None
    # Without its end it is not a cycle.
    codes = body.space.codes_of_transforms(frames.transforms[:76])
    motion = Motion(CLIP, frames.times[:76], codes)
    monkeypatch.setattr(span_solver, "WINDOW", 44)
    monkeypatch.setattr(span_solver, "OVERLAP", 8)
    stop = Job()

    def keep(frame: int, solved: Solved) -> None:  # noqa: ARG001
        stop.cancel()

    options = MotionOptions(easing=14)
    found = resolve_motion(body.resolver, motion, UP, options, 1, keep=keep, stop=stop)
    (done,), (left,) = found.spans, found.unfinished
    assert done.stop == left.start
    colliding = np.flatnonzero(~found.before)
    inside = colliding[colliding < done.stop]
    assert 5 < len(inside) < len(colliding)
    check, codes = body.exact_check(), found.motion.codes
    assert check.are_free(codes[done.start : done.stop]).all()
    # The correction fades out after the last colliding frame.
    moved = np.linalg.norm(codes - motion.codes, axis=1)
    fading = moved[inside[-1] : done.stop + 1]
    assert fading[-1] == 0.0
    assert (np.diff(fading[1:]) < 0.0).all()
    outside = np.setdiff1d(np.arange(len(motion)), done)
    assert codes[outside].tobytes() == motion.codes[outside].tobytes()
    assert found.after.tolist() == [bool(free) for free in check.are_free(codes)]


@pytest.mark.parametrize(("share_of_polls", "all_free"), [(0.1, False), (0.3, True)])
def test_a_span_that_is_stopped_keeps_the_best_found_by_then(
    share_of_polls: float, all_free: bool
) -> None:
    body, motion = swinging()

    class Stop(Job):
        n_polls, last = 0, float("inf")

        @property
        def cancelled(self) -> bool:
            self.n_polls += 1
            return self.n_polls > self.last

    stop = Stop()
    whole = resolve_motion(body.resolver, motion, UP, OPTIONS, 1, stop=stop)
    assert whole.after.all()
    assert whole.rough == ()
    stop.last, stop.n_polls = share_of_polls * stop.n_polls, 0
    found = resolve_motion(body.resolver, motion, UP, OPTIONS, 1, stop=stop)
    check, codes = body.exact_check(), found.motion.codes
    assert found.after.tolist() == [bool(free) for free in check.are_free(codes)]
    assert found.before.sum() < found.after.sum()
    assert (found.after | ~found.before).all()
    assert found.after.all() == (not found.unfinished) == all_free
    moved = np.flatnonzero((codes != motion.codes).any(axis=1))
    assert [at for span in found.rough for at in span] == moved.tolist() != []
    assert {span.reason for span in found.kept} == (set() if all_free else {Reason.STOPPED})
    colliding = np.flatnonzero(~found.after)
    assert {at for span in found.kept for at in range(span.frames[0], span.frames[1] + 1)} == set(
        colliding.tolist()
    )
    (start, *_), (*_, end) = found.spans[0], found.spans[-1]
    outside = np.setdiff1d(np.arange(len(motion)), range(start, end + 1))
    assert codes[outside].tobytes() == motion.codes[outside].tobytes()


def test_a_frame_that_cannot_be_freed_ends_nothing() -> None:
    body = RigBody.of(head_in_torso(n_frames=3)).with_rules(STRICT)
    codes = np.zeros((3, body.latent_size))
    codes[1:, -1] = 0.1, 0.05
    motion = Motion("stuck", np.arange(3) / 30.0, codes)
    # Moving the whole body and one foot cannot remove the head from the trunk.
    locked = frozenset(range(len(body.domain_names))) - {body.domain_names.index("Left foot")}
    options = MotionOptions(keep_feet=False, frame=ResolveOptions(locked_domains=locked))
    reports: list[tuple[int, int]] = []
    job = Job(lambda *report: reports.append(report))
    found = resolve_motion(body.resolver, motion, UP, options, job=job)
    assert not found.before.any()
    assert not found.after.any()
    # Nothing is searched for, as that would take long and find nothing.
    assert reports == [(0, 0)]
    assert [span.reason for span in found.kept] == [Reason.NO_JOINT]
    # A span that cannot be freed is not changed.
    assert found.motion.codes.tobytes() == codes.tobytes()


def test_a_free_motion_comes_back_as_it_is() -> None:
    body, motion = swinging()
    still = Motion("still", motion.times[:4], motion.codes[:4].copy())
    found = resolve_motion(body.resolver, still, UP)
    assert found.spans == ()
    assert found.motion.codes.tobytes() == still.codes.tobytes()
    single = Motion("one", np.zeros(1), motion.codes[24:25].copy())
    assert resolve_motion(body.resolver, single, UP).after.all()


def test_the_codes_of_a_motion_are_read_only_and_the_callers_are_not() -> None:
    codes = np.zeros((2, 3))
    motion = Motion("m", np.arange(2.0), codes)
    assert codes.flags.writeable
    assert not motion.codes.flags.writeable


def test_what_is_no_motion_is_refused() -> None:
    codes = np.zeros((3, 5))
    with pytest.raises(ShapeError, match="2 times"):
        Motion("short", np.arange(2.0), codes)
    with pytest.raises(ShapeError, match="do not ascend"):
        Motion("back", np.array([0.0, 2.0, 1.0]), codes)
    broken = codes.copy()
    broken[1, 2] = np.nan
    with pytest.raises(ShapeError, match="frame 1 of the motion 'broken'"):
        Motion("broken", np.arange(3.0), broken)
    with pytest.raises(LCollisionError, match="easing"):
        MotionOptions(easing=-1)


def test_long_spans_are_cut_into_windows_that_overlap() -> None:
    assert windows(range(5, 50), 120, 24) == [range(5, 50)]
    cut = windows(range(10, 400), 120, 24)
    assert cut[0].start == 10
    assert cut[-1].stop == 400
    assert all(len(window) <= 120 for window in cut)
    assert all(a.stop - b.start == 24 for a, b in itertools.pairwise(cut))


@pytest.mark.parametrize("spacing", [1, 4])
def test_frames_resolved_first_hold_the_ends_of_each_run(spacing: int) -> None:
    free = np.array([True] * 6 + [False] * 9 + [True] + [False])
    knots = np.flatnonzero(knots_of(free, spacing)).tolist()
    assert knots == (list(range(17)) if spacing == 1 else [0, 4, 5, 6, 10, 14, 15, 16])
