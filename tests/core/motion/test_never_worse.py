"""Resolving never makes a motion worse."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.motions import (
    MotionChange,
    motion_of_transforms,
    read_motions,
    write_clips,
)
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.contact import DEPTH_TOLERANCE
from lcollision_core.errors import CancelledError
from lcollision_core.files import Rig
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import Topology
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion import (
    Motion,
    MotionOptions,
    ResolvedMotion,
    resolve_motion,
    screen_motion,
)
from lcollision_core.motion.corrected_frames import CorrectedFrames
from lcollision_core.motion.frames import Frames, Reason
from lcollision_core.motion.spans import SpanSolver
from lcollision_core.options import MotionChoice
from lcollision_core.resolve import ResolveOptions
from lcollision_core.tasks.exporting import Output, write_motions
from lcollision_core.tasks.resolving import ResolveMotionsRequest, resolve_motions
from tests.core.brute_force import all_pairs
from tests.core.motion.swings import CLIP, swinging, swinging_body
from tests.rigged_shapes import (
    character_of,
    limb,
    limb_faces,
    rigged_body,
    skinned,
    turned,
    write_gltf,
)

UP = (0.0, 0.0, 1.0)


def overlaps(body: RigBody, vertices: np.ndarray) -> tuple[int, float]:
    """Return the number of counting pairs and the largest depth, by brute force."""
    size = body.body_size
    found = all_pairs(vertices.astype(np.float64), body.faces, DEPTH_TOLERANCE * size)
    depth = found.depth[body.detector.rules_of(found.pairs, found.depth / size) == 0] / size
    return len(depth), float(depth.max(initial=0.0))


def largest_bend(body: RigBody, motion: Motion) -> float:
    """Return the largest second difference of a frame, as root mean square, normalised."""
    check = body.exact_check()
    vertices = np.stack([motion.vertices(frame, check) for frame in range(len(motion))])
    bends = np.linalg.norm(np.diff(vertices, 2, axis=0), axis=2) / body.body_size
    return float(np.sqrt((bends**2).mean(axis=1)).max())


def require_no_worse(
    body: RigBody, before: Motion, found: ResolvedMotion, largest_change: float
) -> None:
    """Compare a motion with the original, frame by frame."""
    after, check = found.motion, body.exact_check()
    named = np.zeros(len(before), dtype=np.bool_)
    for kept in found.kept:
        frames = slice(kept.frames[0], kept.frames[1] + 1)
        named[frames] = True
        if kept.is_original:
            assert after.codes[frames].tobytes() == before.codes[frames].tobytes()
    may_change = np.zeros(len(before), dtype=np.bool_)
    for span in found.spans:
        may_change[span.start : span.stop] = True
    assert after.codes[~may_change].tobytes() == before.codes[~may_change].tobytes()
    is_freed = found.after & ~found.before
    # A correction jerks by its displacements to first order.
    was_bent, is_bent = (largest_bend(body, motion) for motion in (before, after))
    assert is_bent <= 1.5 * max(0.03, 3.0 * was_bent)
    # Most poses of a result are the original's, to the bit.
    known: dict[bytes, tuple[int, float]] = {}

    def overlap(vertices: np.ndarray) -> tuple[int, float]:
        key = vertices.tobytes()
        if key not in known:
            known[key] = overlaps(body, vertices)
        return known[key]

    original = [overlap(before.vertices(frame, check)) for frame in range(len(before))]
    for frame, (n_before, depth_before) in enumerate(original):
        old, new = (motion.vertices(frame, check) for motion in (before, after))
        moved = np.linalg.norm(new - old, axis=1).max() / body.body_size
        assert moved <= largest_change + 1e-6
        n_after, depth_after = overlap(new)
        assert n_after <= n_before
        assert depth_after <= depth_before + 2e-9
        assert bool(found.after[frame]) == (n_after == 0)
        assert named[frame] or n_after == 0
        if frame + 1 < len(before) and not is_freed[frame : frame + 2].any():
            was = [*original[frame : frame + 2], overlap(before.vertices(frame, check, 0.5))]
            n_between, depth_between = overlap(after.vertices(frame, check, 0.5))
            assert n_between <= max(n for n, _ in was)
            assert depth_between <= max(depth for _, depth in was) + 2e-9


def figure(n_arms: int, radius: float) -> tuple[Rig, Topology, FloatArray]:
    """Return a trunk of two joints, with arms of two joints each."""
    names, parents, places = ["Hips", "Spine"], [-1, 0], [[0.0, 0.0, 0.4], [0.0, 0.0, 0.7]]
    limbs = [([0, 1], [0.0, 0.0, 1.2], 0.12)]
    for sign in (1.0, -1.0)[:n_arms]:
        first = len(names)
        names += [f"Arm{sign}", f"ForeArm{sign}"]
        parents += [1, first]
        places += [[0.22 * sign, 0.0, 1.1], [0.5 * sign, 0.0, 1.1]]
        limbs.append(([first, first + 1], [0.8 * sign, 0.0, 1.1], radius))
    points, faces, blends, n = [], [], [], 0
    for joints, end, width in limbs:
        rows, shares = limb(np.array([*(places[joint] for joint in joints), end]), width, 0.02)
        held = np.zeros((len(rows), len(names)))
        held[:, joints] = shares
        points.append(rows)
        blends.append(held)
        faces.append(limb_faces() + n)
        n += len(rows)
    rest = np.broadcast_to(np.eye(4), (len(names), 4, 4)).copy()
    rest[:, :3, 3] = places
    vertices, weights = np.concatenate(points), np.concatenate(blends)
    rig = Rig(
        joint_names=tuple(names),
        parents=np.array(parents),
        rest=rest,
        nodes=np.arange(len(names)),
        joint_of=np.tile(np.arange(len(names), dtype=np.int32), (n, 1)),
        weights=weights,
        points=np.repeat(vertices[:, None], len(names), axis=1),
    )
    return rig, Topology(np.concatenate(faces), n), vertices


@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    n_arms=st.integers(1, 2),
    radius=st.sampled_from((0.03, 0.06)),
    down=st.floats(0.6, 2.4),
    wide=st.floats(0.0, 0.9),
    bump=st.sampled_from((0.0, 0.05, 0.2)),
    largest_change=st.sampled_from((0.02, 0.25)),
    seed=st.integers(0, 2**16),
)
def test_no_rig_morph_or_clip_comes_out_worse(
    n_arms: int,
    radius: float,
    down: float,
    wide: float,
    bump: float,
    largest_change: float,
    seed: int,
) -> None:
    """Arms swing into a trunk, and a morph target of the trunk grows into them."""
    rig, topology, rest = figure(n_arms, radius)
    body = RigBody.of(character_of("figure", topology, rest, rig, list(UP), 0))
    random, n = np.random.default_rng(seed), 12
    phase = np.sin(np.pi * np.arange(n) / (n - 1)) ** 2
    shape = (
        bump
        * rest
        * [1.0, 1.0, 0.0]
        / 0.12
        * (np.arange(len(rest)) < len(rest) // (1 + n_arms))[:, None]
    )
    transforms, shown = [], {}
    ways = random.normal(0.0, 0.2, (len(rig.parents), 3))
    for frame in range(n):
        vectors = phase[frame] * ways
        for arm in range(n_arms):
            sign = 1.0 - 2.0 * arm
            vectors[2 + 2 * arm] += [0.0, sign * (wide + down * phase[frame]), 0.0]
        transforms.append(turned(rig, Rotation.from_rotvec(vectors).as_matrix()))
        if bump:
            vertices = skinned(rig, transforms[-1]) + (phase * (phase > 0.6))[frame] * shape
            shown[frame] = lambda vertices=vertices: vertices
    motion = motion_of_transforms(
        body.space, "clip", np.arange(n) / 30.0, np.stack(transforms), shown=shown
    )
    options = MotionOptions(
        easing=3, keep_feet=False, frame=ResolveOptions(largest_change=largest_change)
    )
    found = resolve_motion(body.resolver, motion, UP, options)
    require_no_worse(body, motion, found, largest_change)


def test_a_correction_that_jerks_is_left_out_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    body, motion = swinging()
    motion = motion.part(range(10, 18))
    assert resolve_motion(body.resolver, motion, body.up).after.all()
    # As if the swing itself were a jerk.
    limits = sys.modules["lcollision_core.motion.resolve_motion"]
    monkeypatch.setattr(limits, "_JERK", 0.0)
    monkeypatch.setattr(limits, "_JERKIER", 0.5)
    found = resolve_motion(body.resolver, motion, body.up)
    assert {kept.reason for kept in found.kept} == {Reason.JERKS}
    assert found.before.sum() <= found.after.sum() < len(motion)
    require_no_worse(body, motion, found, ResolveOptions().largest_change or np.inf)


def in_the_trunk(frames: range, size: float = 3.0) -> tuple[RigBody, Motion]:
    """Return the swing; in `frames`, a morph turns the head into a ball around the neck."""
    body, motion = swinging()
    is_head = body.space.vertex_domain == body.domain_names.index("Head")
    space = body.space
    shape = space.rest_vertices.copy()
    neck = space.origins[space.rig.joint_names.index("Neck")]
    shape[is_head] = neck + size * (shape[is_head] - shape[is_head].mean(axis=0))
    sunk = space.shaped_as(np.zeros(body.latent_size), shape)

    def space_at(time: float) -> RigPoseSpace:
        return sunk if int(time) in frames else body.space

    return body, Motion(motion.name, motion.times, motion.codes, None, space_at)


@pytest.mark.slow
def test_what_no_joint_can_free_stays_and_its_neighbours_are_freed() -> None:
    body, motion = in_the_trunk(range(2, 5))
    check = body.exact_check()
    before = screen_motion(motion, check)
    swing = [one.frame for one in before.colliding if one.frame > 4]
    # Their easing overlaps.
    options = MotionOptions(easing=12)
    found = resolve_motion(body.resolver, motion, UP, options)
    (kept,) = found.kept
    assert (kept.frames, kept.is_original) == ((2, 4), True)
    assert [one.frame for one in screen_motion(found.motion, check).colliding] == [2, 3, 4]
    assert swing
    assert found.after[swing].all()
    assert kept.deepest == pytest.approx(max(one.deepest for one in before.colliding[:3]))
    names = {body.domain_names[part] for part in kept.parts[0]}
    assert "Head" in names
    assert kept.sentence(body.domain_names).startswith("frames 2 to 4 stay as they were: ")
    require_no_worse(body, motion, found, 0.25)


def test_what_no_joint_can_free_does_not_keep_other_limbs_as_they_were() -> None:
    body, motion = in_the_trunk(range(19), size=1.5)
    motion = motion.part(range(11, 19))
    check = body.exact_check()
    head = body.domain_names.index("Head")

    def limbs(motion: Motion) -> list[int]:
        """Return the frames in which something collides besides the head."""
        return [
            one.frame
            for one in screen_motion(motion, check).colliding
            if any(head not in pair for pair in one.domains)
        ]

    found = resolve_motion(body.resolver, motion, UP)
    assert limbs(motion)
    assert limbs(found.motion) == []
    assert {(kept.reason, kept.is_original) for kept in found.kept} == {(Reason.NO_JOINT, False)}
    assert all(head in kept.parts[0] for kept in found.kept)
    require_no_worse(body, motion, found, 0.25)


def test_within_a_small_change_a_span_gets_less_overlap() -> None:
    body, swing = swinging()
    # Nearly still, and not a cycle.
    codes = np.tile(swing.codes[16], (4, 1)) + 1e-9 * np.arange(4)[:, None]
    motion = Motion("still", swing.times[:4], codes)
    options = MotionOptions(easing=2, frame=ResolveOptions(largest_change=0.02))
    found = resolve_motion(body.resolver, motion, UP, options)
    (kept,) = found.kept
    assert (kept.frames, kept.is_original) == ((0, 3), False)
    check = body.exact_check()
    was = screen_motion(motion, check).deepest
    assert 0.0 < kept.deepest < 0.9 * was
    assert "overlap as little as was found" in kept.sentence(body.domain_names)
    require_no_worse(body, motion, found, 0.02)


def test_a_stop_while_overlap_is_reduced_keeps_what_was_freed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    body, motion = in_the_trunk(range(2, 5))
    motion, stop = motion.part(range(2, 10)), Job()
    softened = Frames.softened

    def stopped(frames: Frames, frame: int) -> np.ndarray:
        stop.cancel()
        return softened(frames, frame)

    monkeypatch.setattr(Frames, "softened", stopped)
    found = resolve_motion(body.resolver, motion, UP, stop=stop)
    assert stop.cancelled
    assert not found.after[:3].any()
    assert found.after[3:].all()
    assert [kept.frames for kept in found.kept] == [(0, 2)]


def test_what_a_stop_leaves_worse_between_frames_stays_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    body, motion = in_the_trunk(range(2, 5))
    motion, stop = motion.part(range(5, 14)), Job()
    solve = SpanSolver.solve

    def stopped(solver: SpanSolver) -> None:
        solve(solver)
        stop.cancel()
        raise CancelledError("stopped")

    def between(corrected: CorrectedFrames, span: range) -> dict[int, Reason]:
        return {int(corrected.colliding[span.start :].argmax()) + span.start: Reason.BETWEEN}

    monkeypatch.setattr(SpanSolver, "solve", stopped)
    monkeypatch.setattr(SpanSolver, "keep_finished", lambda solver: solver.span)
    monkeypatch.setattr(CorrectedFrames, "faults", between)
    result = resolve_motion(body.resolver, motion, UP, stop=stop)
    assert np.array_equal(result.motion.codes, motion.codes)
    assert np.array_equal(result.after, result.before)
    assert not result.after.all()


def waving() -> tuple[RigBody, Motion]:
    """Return a body, and four free frames; an arm swings through a leg after the first."""
    body = RigBody.of(rigged_body())
    rig = body.space.rig
    turns = {
        "Spine": [[-0.3, 0, 0], [0.17, 0, 0], [0.11, 0, 0], [-0.29, 0, 0]],
        "LeftArm": [[-0.1, 1.02, 0], [0.12, 1.51, 0], [-0.04, 1.06, 0], [-0.07, 1.38, 0]],
        "LeftForeArm": [[0, 0, -1.29], [0, 0, -1.04], [0, 0, -0.84], [0, 0, -1.42]],
        "RightArm": [[0.26, -1.34, 0], [-0.48, -1.32, 0], [0.52, -1.1, 0], [-0.36, -1.16, 0]],
        "RightForeArm": [[0, 0, 1.26], [0, 0, 0.52], [0, 0, 1.0], [0, 0, 1.0]],
        "RightUpLeg": [[-0.35, -0.14, 0], [0.32, -0.25, 0], [0.07, -0.25, 0], [-0.38, -0.15, 0]],
    }
    vectors = np.zeros((4, len(rig.parents), 3))
    for name, way in turns.items():
        vectors[:, rig.joint_names.index(name)] = way
    transforms = [turned(rig, Rotation.from_rotvec(frame).as_matrix()) for frame in vectors]
    codes = body.space.codes_of_transforms(np.stack(transforms))
    return body, Motion("waving", np.arange(4) / 8.0, codes)


def test_the_way_between_two_free_frames_gets_no_deeper() -> None:
    body, motion = waving()
    assert 0 in screen_motion(motion, body.exact_check()).in_between
    options = MotionOptions(frame=ResolveOptions(largest_change=0.02))
    result = resolve_motion(body.resolver, motion, UP, options)
    assert result.before[:2].all()
    require_no_worse(body, motion, result, 0.02)


def test_contacts_between_frames_are_those_met_first_from_one_of_them() -> None:
    body, motion = waving()
    with ThreadPoolExecutor(1) as pool:
        frames = Frames(motion, body.resolver, ResolveOptions(), pool)
        middle = motion.codes[:2].mean(axis=0)
        deep = frames.contacts(0, middle)
        contacts = frames.contacts_between(0, 0.5, *motion.codes[:2])
    assert contacts is not None
    assert deep is not None
    normals, offsets = contacts
    assert 0 < len(offsets) < len(deep[1])
    assert (normals @ middle > offsets).any()
    assert (normals @ motion.codes[:2].T <= offsets[:, None]).all(axis=0).any()


def test_what_a_file_cannot_hold_is_put_back_in_it(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(), tmp_path / "swing.glb")
    body = open_body(source)
    assert isinstance(body, RigBody)
    (motion,) = read_motions(body, source, CLIP)
    codes = np.array(motion.codes)
    # Make one span deeper than before, and leave another almost unchanged.
    codes[20:28] += 0.2 * (motion.codes[20:28] - motion.codes[0])
    codes[2] += 1e-3
    worse = Motion(CLIP, motion.times, codes)
    change = MotionChange(motion, worse, [range(2, 3), range(20, 28)], 0.25)
    written = write_clips(tmp_path / "out.glb", body, source, [change])
    assert written.put_back == [[range(20, 28)]]
    (back,) = read_motions(body, tmp_path / "out.glb", CLIP)
    np.testing.assert_allclose(back.codes[3:], motion.codes[3:], atol=1e-6)
    assert np.abs(back.codes[2] - codes[2]).max() < 1e-6
    output, choice = Output(tmp_path / "again.glb", "mesh", None), MotionChoice(clip=CLIP)
    request = ResolveMotionsRequest(body, [source], output, MotionOptions(), choice)
    (row,) = resolve_motions(replace(request, only_check=True), UNWATCHED)
    write_motions(output, body, source, [change], [row], UNWATCHED)
    named = [tuple(span["frames"]) for span in row.kept_spans]
    assert named == [(20, 27), (12, 19), (28, 35)]
    assert 0.0 < row.largest_change < 5e-3
    far = MotionChange(motion, Motion(CLIP, motion.times, codes), [range(2, 3)], 1e-5)
    assert write_clips(tmp_path / "far.glb", body, source, [far]).put_back == [[range(2, 3)]]


def test_what_is_written_is_judged_as_what_is_read(tmp_path: Path) -> None:
    """Two legs approach by a billionth per frame until they touch, and further."""
    character = swinging_body(n_frames=41)
    rig = character.rig
    assert rig is not None
    way = np.zeros((41, 3))
    # Each limb has a corner on the side facing the other.
    way[:, 0] = 0.1 - np.arange(-20, 21) * 1e-9
    source = write_gltf(character, tmp_path / "touch.glb", shifts={"RightUpLeg": way})
    body = open_body(source)
    motions = read_motions(body, source)
    changes = [MotionChange(motion, motion, ()) for motion in motions]
    out = tmp_path / "out.glb"
    written = write_clips(out, body, source, changes)
    check = body.exact_check()
    for free, motion, again in zip(written.free, motions, read_motions(body, out), strict=True):
        for one in (motion, again):
            colliding = [found.frame for found in screen_motion(one, check).colliding]
            assert np.flatnonzero(~free).tolist() == colliding
