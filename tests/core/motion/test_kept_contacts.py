"""Contacts of a motion moved onto another body: kept with the option, lost without it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.kept_contacts import Correspondence
from lcollision_core.bodies.motions import read_motions
from lcollision_core.bodies.retargeting import retargeted_motions
from lcollision_core.files import Character, ClipFrames
from lcollision_core.motion import Motion, MotionOptions, contact_report, resolve_motion
from lcollision_core.options import ResolveOptions
from tests.rigged_shapes import rigged_body, skinned, turned, write_gltf

CLIP, N_FRAMES = "hip", 32
DOWN, INWARDS = np.radians(42.0), np.radians(97.0)
"""Angles of the arm below horizontal and of the elbow when the hand is on the hip."""


def with_hand_on_hip(girth: float) -> Character:
    """Return a body that puts its left hand on its hip and back; its feet are on the ground."""
    body = rigged_body(girth=girth)
    rig = body.rig
    assert rig is not None
    arm, elbow = (rig.joint_names.index(name) for name in ("LeftArm", "LeftForeArm"))
    times = np.arange(N_FRAMES) / 30.0
    phase = np.clip(1.6 * np.sin(np.pi * times / times[-1]), 0.0, 1.0)

    def sample(clip: str, fps: float | None) -> ClipFrames:  # noqa: ARG001
        rotations = np.tile(np.eye(3), (N_FRAMES, len(rig.parents), 1, 1))
        for joint, most in ((arm, DOWN), (elbow, INWARDS)):
            turn = np.outer(most * phase, [0.0, 1.0, 0.0])
            rotations[:, joint] = Rotation.from_rotvec(turn).as_matrix()
        transforms = np.stack([turned(rig, one) for one in rotations])
        names = tuple(f"{clip} {frame}" for frame in range(N_FRAMES))
        meshes = [skinned(rig, one) for one in transforms]
        return ClipFrames(names, times, transforms, lambda: np.stack(meshes))

    return replace(body, clips={CLIP: float(times[-1])}, sample=sample)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gltf(with_hand_on_hip(0.13), tmp_path_factory.mktemp("contacts") / "source.glb")


def moved_onto(girth: float, source: Path, folder: Path) -> tuple[RigBody, Motion]:
    """Return a body of another girth, and the motion on it with copied rotations."""
    body = open_body(write_gltf(rigged_body(girth=girth), folder / "body.glb"))
    assert isinstance(body, RigBody)
    (motion,) = read_motions(body, source)
    return body, motion


@pytest.mark.parametrize(
    ("girth", "is_lifted"), [(0.10, True), pytest.param(0.17, False, marks=pytest.mark.slow)]
)
def test_a_hand_stays_on_the_hip_of_another_body(
    girth: float, is_lifted: bool, source: Path, tmp_path: Path
) -> None:
    body, motion = moved_onto(girth, source, tmp_path)
    check = body.exact_check()
    copied = contact_report(motion, check)
    assert copied is not None
    assert copied.lost == (("Hips", "Left hand"),)
    assert bool(check.are_free(motion.codes).all()) == is_lifted
    kept = resolve_motion(body.resolver, motion, body.space.up)
    report = contact_report(kept.motion, check)
    assert report is not None
    assert set(report.kept) == {
        *(("Hips", "Left hand"), ("Left foot", "ground"), ("Right foot", "ground")),
    }
    assert report.lost == ()
    assert kept.after.all()
    assert check.are_free(kept.motion.codes).all()
    assert report.slide < 5e-4


def test_without_the_flag_a_free_motion_stays(source: Path, tmp_path: Path) -> None:
    body, motion = moved_onto(0.10, source, tmp_path)
    options = MotionOptions(keep_contacts=False)
    found = resolve_motion(body.resolver, motion, body.space.up, options)
    np.testing.assert_array_equal(found.motion.codes, motion.codes)


def test_what_cannot_move_loses_its_contact_and_stays(source: Path, tmp_path: Path) -> None:
    body, motion = moved_onto(0.10, source, tmp_path)
    locked = ResolveOptions(locked_domains=frozenset(range(body.space.n_domains)))
    found = resolve_motion(body.resolver, motion, body.space.up, MotionOptions(frame=locked))
    np.testing.assert_array_equal(found.motion.codes, motion.codes)
    report = contact_report(found.motion, body.exact_check())
    assert report is not None
    assert report.lost == (("Hips", "Left hand"),)


def test_a_part_of_a_motion_has_its_contacts(source: Path, tmp_path: Path) -> None:
    _, motion = moved_onto(0.10, source, tmp_path)
    assert motion.contacts is not None
    part = motion.part(range(10, 20)).contacts
    assert part is not None
    whole, own = motion.contacts(), part()
    assert whole is not None
    assert own is not None
    assert [len(touches) for touches in own.touches] == [
        len(touches) for touches in whole.touches[10:20]
    ]


def test_places_correspond_along_and_around_their_limbs(source: Path, tmp_path: Path) -> None:
    body, _ = moved_onto(0.17, source, tmp_path)
    ((motion, retargeting),) = retargeted_motions(body, source)
    own = open_body(source)
    assert isinstance(own, RigBody)
    (source_motion,) = read_motions(own, source)
    found = Correspondence(retargeting, own.space, motion, source_motion).by_place()
    np.testing.assert_array_equal(found, np.arange(body.n_vertices))
