"""Motions of the SMPL family: under any array names, posed by the paper's equations."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.motions import MotionChange, body_of_motion, read_motions, write_clips
from lcollision_core.errors import MeshFileError
from lcollision_core.files.motion.smpl import JOINT_NAMES, read_smpl_motion, skeleton_of_smpl
from lcollision_core.meshes.contact_rules import ContactRules
from lcollision_core.motion import Motion
from tests.small_models import stored
from tests.smpl_files import (
    Arrays,
    linear_blend_skinning,
    motion_arrays,
    smpl_arrays,
    tiny_arrays,
    write_model,
)

SAME = 1e-7
NAMES = JOINT_NAMES[55]


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    for n_joints in JOINT_NAMES:
        write_model(folder / f"{n_joints}.npz", n_joints)
    return folder


@pytest.fixture(scope="module")
def body(models: Path) -> RigBody:
    held = open_body(models / "55.npz")
    assert isinstance(held, RigBody)
    return held


NOTHING_COUNTS = ContactRules(tolerated_depth=0.9)


def of_file(body: RigBody, path: Path, arrays: Arrays) -> tuple[RigBody, Motion, tuple[str, ...]]:
    """Write a motion, and read it as poses of the body in the motion's shape."""
    np.savez(path, **arrays)
    shaped, notes = body_of_motion(body, path)
    assert isinstance(shaped, RigBody)
    (motion,) = read_motions(shaped, path)
    return shaped, motion, notes


def test_a_motion_without_places_stays_where_it_rests_whichever_way_is_up(tmp_path: Path) -> None:
    skeletons = []
    for z_is_up in (False, True):
        arrays, path = motion_arrays(24, 4, z_is_up=z_is_up), tmp_path / f"{z_is_up}.npz"
        np.savez(path, **arrays | {"trans": np.zeros((4, 3))})
        skeletons.append(skeleton_of_smpl(read_smpl_motion(path), 30.0))
    y_up, z_up = skeletons
    np.testing.assert_array_equal(z_up.places, y_up.places)
    np.testing.assert_allclose(z_up.turns, y_up.turns, atol=1e-12)


def as_posed(arrays: Arrays, motion: Arrays, frame: int, turns: np.ndarray) -> np.ndarray:
    betas = np.zeros(arrays["shapedirs"].shape[2])
    given = np.ravel(motion.get("betas", ()))[: len(betas)]
    betas[: len(given)] = given
    return linear_blend_skinning(arrays, betas, turns, motion["trans"][frame])


@pytest.mark.parametrize("n_joints", JOINT_NAMES)
def test_frames_are_posed_as_the_equations_say(models: Path, tmp_path: Path, n_joints: int) -> None:
    body = open_body(models / f"{n_joints}.npz")
    assert isinstance(body, RigBody)
    arrays = motion_arrays(n_joints, 5)
    shaped, motion, notes = of_file(body, tmp_path / "walk.npz", arrays)
    assert (motion.name, motion.source, motion.rate) == ("walk", "walk.npz", pytest.approx(30.0))
    assert notes == ("only the first 10 of its betas are in the body model",)
    assert motion.space_at is None
    turns = arrays["poses"].reshape(5, n_joints, 3)
    for frame, found in enumerate(shaped.decode(motion.codes)):
        expected = as_posed(smpl_arrays(n_joints), arrays, frame, turns[frame])
        assert np.abs(found - expected).max() < SAME
    assert read_motions(shaped, tmp_path / "walk.npz", fps=60.0)[0].rate == pytest.approx(60.0)
    # It already has the shape.
    assert body_of_motion(shaped, tmp_path / "walk.npz")[0] is shaped


def test_where_z_is_up_the_body_stands(body: RigBody, tmp_path: Path) -> None:
    stands = motion_arrays(n_frames=4)
    lies = motion_arrays(n_frames=4, z_is_up=True)
    one, upright, _ = of_file(body, tmp_path / "y.npz", stands)
    other, turned, _ = of_file(body, tmp_path / "z.npz", lies)
    # The file rotates about the origin, which is not at the pelvis.
    moved = one.decode(upright.codes) - other.decode(turned.codes)
    assert np.ptp(moved, axis=1).max() < SAME
    assert np.abs(moved[:, 0] - moved[0, 0]).max() < SAME


def split(arrays: Arrays, names: dict[str, slice], trans: str = "trans") -> Arrays:
    """Return a motion with the rotations of some columns under separate names."""
    rest = {name: one for name, one in arrays.items() if name not in ("poses", "trans")}
    own = {name: arrays["poses"][:, columns].copy() for name, columns in names.items()}
    return rest | own | {trans: arrays["trans"]}


PARTS = {
    "smplx": {
        "global_orient": slice(0, 3),
        "body_pose": slice(3, 66),
        "jaw_pose": slice(66, 69),
        "leye_pose": slice(69, 72),
        "reye_pose": slice(72, 75),
        "left_hand_pose": slice(75, 120),
        "right_hand_pose": slice(120, 165),
    },
    "amass": {
        "root_orient": slice(0, 3),
        "pose_body": slice(3, 66),
        "pose_hand": slice(75, 165),
        "pose_jaw": slice(66, 69),
        "pose_eye": slice(69, 75),
    },
}


@pytest.mark.parametrize("kind", PARTS)
def test_turns_may_be_in_parts(body: RigBody, tmp_path: Path, kind: str) -> None:
    arrays = motion_arrays(n_frames=3)
    arrays["poses"][:, 66:] = 0.1 * np.random.default_rng(0).normal(size=(3, 99))
    _, whole, _ = of_file(body, tmp_path / "whole.npz", arrays)
    trans = "transl" if kind == "smplx" else "trans"
    _, parts, notes = of_file(body, tmp_path / "parts.npz", split(arrays, PARTS[kind], trans))
    assert len(notes) == 1
    np.testing.assert_array_equal(parts.codes, whole.codes)


def test_what_a_motion_does_not_turn_is_still_and_said(body: RigBody, tmp_path: Path) -> None:
    whole = motion_arrays(n_frames=3)
    short = whole | {"poses": whole["poses"][:, :66]}
    shaped, motion, notes = of_file(body, tmp_path / "short.npz", short)
    assert "it has no rotations for jaw, left eye, right eye and 30 more" in notes[0]
    assert shaped.latent_size == motion.codes.shape[1] == 6 + 3 * 21
    turns = np.zeros((55, 3))
    turns[:22] = short["poses"][1].reshape(22, 3)
    expected = as_posed(smpl_arrays(), short, 1, turns)
    assert np.abs(shaped.decode(motion.codes[1]) - expected).max() < SAME
    # SMPL-H's joints with hands; the body model's face does not move.
    of_smplh = motion_arrays(52, 3)
    of_smplh["poses"][:, 66:] = 0.1
    shaped, motion, notes = of_file(body, tmp_path / "smplh.npz", of_smplh)
    assert "it has no rotations for jaw, left eye, right eye, which keep" in notes[0]
    turns = np.insert(of_smplh["poses"][2].reshape(52, 3), 22, np.zeros((3, 3)), axis=0)
    expected = as_posed(smpl_arrays(), of_smplh, 2, turns)
    assert np.abs(shaped.decode(motion.codes[2]) - expected).max() < SAME


def hands(n: int) -> Arrays:
    generator = np.random.default_rng(n)
    made: Arrays = {}
    for side in "lr":
        made[f"hands_components{side}"] = np.linalg.qr(generator.normal(size=(45, 45)))[0]
        made[f"hands_mean{side}"] = 0.1 * generator.normal(size=45)
    return made


def test_components_of_hands_need_those_of_the_model(body: RigBody, tmp_path: Path) -> None:
    arrays, held = motion_arrays(n_frames=3), hands(1)
    arrays = split(arrays, PARTS["smplx"])
    shares = 0.2 * np.random.default_rng(2).normal(size=(3, 12))
    arrays["left_hand_pose"] = shares
    np.savez(tmp_path / "motion.npz", **arrays)
    with pytest.raises(MeshFileError, match="12 components of a hand's poses, which the body"):
        body_of_motion(body, tmp_path / "motion.npz")
    np.savez(tmp_path / "model.npz", **smpl_arrays(), **held)
    able = open_body(tmp_path / "model.npz")
    assert isinstance(able, RigBody)
    left = slice(NAMES.index("left_index1"), NAMES.index("left_thumb3") + 1)
    for flat, mean in ((None, True), (False, True), (True, False)):
        own = arrays | ({} if flat is None else {"flat_hand_mean": np.array(flat)})
        shaped, motion, _ = of_file(able, tmp_path / "motion.npz", own)
        turned, _ = shaped.space.rotations_of(motion.codes[1])
        expected = shares[1] @ held["hands_componentsl"][:12] + mean * held["hands_meanl"]
        np.testing.assert_allclose(turned[left].ravel(), expected, atol=1e-12)


def test_rules_and_names_go_along_to_another_shape(body: RigBody, tmp_path: Path) -> None:
    chosen = body.with_rules(ContactRules(near_exclusion=0.01)).edit_domains({0: "middle"})
    shaped, _, _ = of_file(chosen, tmp_path / "walk.npz", motion_arrays(n_frames=2))
    assert shaped is not chosen
    assert shaped.rules == chosen.rules
    assert shaped.domain_names == chosen.domain_names
    assert shaped.detector.rules == chosen.rules


def changed(motion: Motion, frames: list[int]) -> MotionChange:
    codes = np.array(motion.codes)
    codes[frames] += 0.05 * np.random.default_rng(7).normal(size=codes[frames].shape)
    spans = [range(frame, frame + 1) for frame in frames]
    return MotionChange(motion, Motion(motion.name, motion.times, codes), spans)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("z_is_up", [False, True])
def test_a_file_comes_back_with_some_frames_changed(
    body: RigBody, tmp_path: Path, z_is_up: bool, dtype: type
) -> None:
    source, out = tmp_path / "walk.npz", tmp_path / "free.npz"
    arrays = motion_arrays(n_frames=6, z_is_up=z_is_up)
    # An additional full turn gives the same pose, and is kept.
    first = arrays["poses"][:, 48:51] + 0.3
    arrays["poses"][:, 48:51] = first + 2.0 * np.pi * first / np.linalg.norm(first, axis=1)[:, None]
    arrays["poses"], arrays["trans"] = (arrays[name].astype(dtype) for name in ("poses", "trans"))
    arrays["Rh"] = arrays["poses"][:, :3].copy()
    arrays["pose_body"] = arrays["poses"][:, 3:66] + 1.0
    arrays["labels"] = np.array([{"a": 1}, None], dtype=object)
    shaped, motion, notes = of_file(body, source, arrays)
    assert "'pose_body' contradicts 'poses' and is left as it is" in notes
    # The change happens to make poses collide, which would not be written.
    shaped = shaped.with_rules(NOTHING_COUNTS)
    change = changed(motion, [1, 4])
    write_clips(out, shaped, source, [change])
    (back,) = read_motions(shaped, out)
    np.testing.assert_allclose(
        shaped.decode(back.codes), shaped.decode(change.after.codes), atol=2e-6
    )
    kept = [0, 2, 3, 5]
    with np.load(source, allow_pickle=True) as old, np.load(out, allow_pickle=True) as new:
        assert new.files == old.files
        for name in old.files:
            assert (new[name].dtype, new[name].shape) == (old[name].dtype, old[name].shape)
        for name in ("poses", "trans", "Rh"):
            np.testing.assert_array_equal(new[name][kept], old[name][kept])
            assert (new[name][[1, 4]] != old[name][[1, 4]]).any()
        np.testing.assert_array_equal(new["Rh"], new["poses"][:, :3])
        assert np.abs(new["poses"] - old["poses"]).max() < 0.5
    with zipfile.ZipFile(source) as before, zipfile.ZipFile(out) as after:
        for name in ("labels", "pose_body", "betas", "gender"):
            assert after.read(f"{name}.npy") == before.read(f"{name}.npy")


def test_components_come_back_as_near_as_they_go(tmp_path: Path) -> None:
    held = hands(3)
    np.savez(tmp_path / "model.npz", **smpl_arrays(), **held)
    body = open_body(tmp_path / "model.npz")
    assert isinstance(body, RigBody)
    arrays = split(motion_arrays(n_frames=3), PARTS["smplx"], "transl")
    arrays["right_hand_pose"] = np.zeros((3, 45))[:, :6]
    source, out = tmp_path / "walk.npz", tmp_path / "free.npz"
    shaped, motion, _ = of_file(body, source, arrays)
    write_clips(out, shaped.with_rules(NOTHING_COUNTS), source, [changed(motion, [1])])
    with np.load(out) as new:
        shares = new["right_hand_pose"]
    assert (shares[[0, 2]] == 0.0).all()
    turned, _ = shaped.space.rotations_of(changed(motion, [1]).after.codes[1])
    right = turned[NAMES.index("right_index1") :].ravel() - held["hands_meanr"]
    np.testing.assert_allclose(shares[1], held["hands_componentsr"][:6] @ right, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"trans": None}, "no arrays 'poses' and 'trans'"),
        ({"poses": None}, "no arrays 'poses' and 'trans'"),
        ({"poses": np.zeros((4, 60))}, "has 60 numbers a frame, expected 66, 72, 156, 165"),
        ({"poses": np.zeros((3, 72))}, "'poses' has 3 frames, 'trans' 4"),
        ({"poses": np.zeros((4, 72), int)}, "expected numbers by frame, got int64"),
        ({"trans": np.full((4, 3), np.inf)}, "not finite or too large in frame 0"),
        ({"betas": np.arange(40.0).reshape(4, 10)}, "changes from frame to frame"),
        ({"mocap_framerate": np.array(0.0)}, "'mocap_framerate'"),
        ({"poses": np.array([{}], dtype=object)}, "Python objects"),
        ({"flat_hand_mean": np.array("no")}, "neither true nor false"),
    ],
)
def test_a_wrong_motion_is_refused_in_a_sentence(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    np.savez(tmp_path / "model.npz", **tiny_arrays())
    path, body = tmp_path / "walk.npz", open_body(tmp_path / "model.npz")
    arrays = motion_arrays(24, 4) | changes
    np.savez(path, **{name: one for name, one in arrays.items() if one is not None})
    with pytest.raises(MeshFileError, match=said) as refused:
        body_of_motion(body, path)
    assert str(path) in str(refused.value)


def test_other_bodies_and_other_shapes_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "model.npz", **tiny_arrays())
    body, path = open_body(tmp_path / "model.npz"), tmp_path / "walk.npz"
    np.savez(path, **motion_arrays(24, 4))
    with pytest.raises(MeshFileError, match="is of another shape"):
        read_motions(body, path)
    with pytest.raises(MeshFileError, match="which a body without joints can't follow"):
        body_of_motion(stored("tube"), path)
    with pytest.raises(MeshFileError, match="is a motion, not a body"):
        open_body(path)


def test_turns_about_the_pelvis_go_on(body: RigBody, tmp_path: Path) -> None:
    arrays = motion_arrays(n_frames=30)
    angles = np.linspace(0.0, 3.0 * np.pi, 30)
    spun = Rotation.from_rotvec(np.outer(angles, [0.0, 1.0, 0.0])).as_rotvec()
    arrays["poses"][:, :3] = spun
    _, motion, _ = of_file(body, tmp_path / "spin.npz", arrays)
    assert np.abs(np.diff(motion.codes[:, 3:6], axis=0)).max() < 0.4
