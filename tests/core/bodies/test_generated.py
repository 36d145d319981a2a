"""Generated motions, as arrays of joints, on a character."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import RigBody
from lcollision_core.bodies.motions import body_of_motion, read_motions
from lcollision_core.errors import MeshFileError
from lcollision_core.files.motion.generated import read_generated
from lcollision_core.tasks.inputs import holds_motion, motion_files
from tests.rigged_shapes import FloatArray, rigged_body

PLACES = {
    "pelvis": (0.0, 0.95, 0.0),
    "spine1": (0.0, 1.05, 0.0),
    "spine2": (0.0, 1.18, 0.0),
    "spine3": (0.0, 1.25, 0.0),
    "neck": (0.0, 1.45, 0.0),
    "head": (0.0, 1.55, 0.0),
    **{
        f"{side}_{name}": (sign * x, y, z)
        for side, sign in (("left", 1.0), ("right", -1.0))
        for name, x, y, z in (
            ("hip", 0.1, 0.88, 0.0),
            ("knee", 0.1, 0.48, 0.0),
            ("ankle", 0.1, 0.08, 0.0),
            ("foot", 0.1, 0.02, 0.13),
            ("collar", 0.07, 1.36, 0.0),
            ("shoulder", 0.18, 1.39, 0.0),
            ("elbow", 0.45, 1.39, 0.0),
            ("wrist", 0.7, 1.39, 0.0),
        )
    },
}
LIMBS = [
    (f"{side}{bone}", f"{side}{end}", f"{side.lower()}_{theirs}", f"{side.lower()}_{last}")
    for side in ("Left", "Right")
    for bone, end, theirs, last in (
        ("Arm", "ForeArm", "shoulder", "elbow"),
        ("ForeArm", "Hand", "elbow", "wrist"),
        ("UpLeg", "Leg", "hip", "knee"),
        ("Leg", "Foot", "knee", "ankle"),
    )
]
N_FRAMES = 5


def posed(names: tuple[str, ...], parents: list[int]) -> tuple[FloatArray, FloatArray]:
    """Return world positions and rotations of an SMPL skeleton in random poses."""
    vectors = np.random.default_rng(2).normal(0.0, 0.25, (N_FRAMES, len(names), 3))
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    turns = local.reshape(N_FRAMES, len(names), 3, 3)
    places = np.tile([PLACES[name] for name in names], (N_FRAMES, 1, 1))
    rest = places[0].copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            way = turns[:, parent] @ (rest[joint] - rest[parent])
            places[:, joint] = places[:, parent] + way
            turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return places, turns


@pytest.mark.parametrize("kind", ["kimodo.npz", "joints.npy"])
def test_limbs_point_as_the_generated_ones(tmp_path: Path, kind: str) -> None:
    from lcollision_core.files.motion.generated import _SMPL as SMPL

    names, body, path = tuple(SMPL), RigBody.of(rigged_body()), tmp_path / kind
    places, turns = posed(names, list(SMPL.values()))
    if kind.endswith("z"):
        np.savez(path, posed_joints=places, global_rot_mats=turns)
    else:
        np.save(path, places.astype(np.float32))
    _, notes = body_of_motion(body, path)
    said = "a motion of Kimodo on the skeleton of SMPL-X" if kind.endswith("z") else "% at most"
    assert said in notes[0]
    (motion,) = read_motions(body, path)
    assert (motion.name, len(motion)) == (path.stem, N_FRAMES)
    assert motion.rate == pytest.approx(30.0 if kind.endswith("z") else 20.0)
    ours = list(body.space.rig.joint_names)
    shown = np.stack([body.space.transforms(row) for row in motion.codes])[..., :3, 3]
    # The body is z up and faces -y.
    shown = shown @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T
    for start, end, first, last in LIMBS:
        own = shown[:, ours.index(end)] - shown[:, ours.index(start)]
        theirs = places[:, names.index(last)] - places[:, names.index(first)]
        cosines = (own * theirs).sum(1) / np.linalg.norm(own, axis=1)
        cosines /= np.linalg.norm(theirs, axis=1)
        assert np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).max() < 2.0
    assert motion_files(tmp_path) == [path]


@pytest.mark.parametrize("kind", ["kimodo.npz", "joints.npy"])
def test_frames_that_only_fill_an_array_are_left_out(tmp_path: Path, kind: str) -> None:
    from lcollision_core.files.motion.generated import _SMPL as SMPL

    path, plain = tmp_path / kind, tmp_path / f"plain {kind}"
    places, turns = posed(tuple(SMPL), list(SMPL.values()))
    for file, n_filling in ((path, 3), (plain, 0)):
        fills = [np.zeros((n_filling, *array.shape[1:])) for array in (places, turns)]
        arrays = [np.concatenate(pair) for pair in zip((places, turns), fills, strict=True)]
        if kind.endswith("z"):
            np.savez(file, posed_joints=arrays[0], global_rot_mats=arrays[1])
        else:
            np.save(file, arrays[0])
    (filled,), (whole,) = read_generated(path), read_generated(plain)
    assert len(filled.times) == len(whole.times) == N_FRAMES
    np.testing.assert_array_equal(filled.offsets, whole.offsets)
    assert filled.notes[:-1] == whole.notes
    assert filled.notes[-1] == "its last 3 frames hold no figure and are left out"


def test_files_that_macos_adds_to_a_zip_are_no_motions(tmp_path: Path) -> None:
    path, hidden = tmp_path / "a" / "walk.bvh", tmp_path / "__MACOSX" / "a" / "._walk.bvh"
    for file in (path, hidden, tmp_path / "a" / "._walk.npz", tmp_path / ".cache" / "b.bvh"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"\0\5\x16\7")
    assert motion_files(tmp_path) == [path]
    path.unlink()
    assert not holds_motion(tmp_path)


def test_other_arrays_are_refused_by_what_was_expected(tmp_path: Path) -> None:
    path = tmp_path / "vectors.npy"
    np.save(path, np.zeros((9, 262)))
    with pytest.raises(MeshFileError, match=r"it is \(9, 262\), expected \(T, 22, 3\) or"):
        read_generated(path)
    assert motion_files(tmp_path) == []
    np.save(path, np.random.default_rng(0).normal(0.0, 1.0, (9, 263)) * 3.0)
    with pytest.raises(MeshFileError, match=r"undo the normalisation: multiply by Std\.npy"):
        read_generated(path)
    np.save(path, np.array({"motion": 1}, dtype=object))
    with pytest.raises(MeshFileError, match=r"it holds no 'motion', expected \(N, 22, 3, T\), or"):
        read_generated(path)
    np.save(path, np.array({"motion": Path("a")}, dtype=object))
    with pytest.raises(MeshFileError, match=r"Python objects \(pathlib.*, which are not run"):
        read_generated(path)
    np.save(path, np.array({"motion": np.zeros((2, 24, 6, 9))}, dtype=object))
    with pytest.raises(MeshFileError, match=r"it holds 'motion' of \(2, 24, 6, 9\), expected"):
        read_generated(path)
    path.unlink()
    other = tmp_path / "robot.npz"
    np.savez(other, posed_joints=np.zeros((4, 34, 3)), global_rot_mats=np.zeros((4, 34, 3, 3)))
    with pytest.raises(MeshFileError, match="of Kimodo with J = 22 or 30 or 77 joints"):
        read_generated(other)
    np.savez(other, posed_joints=np.ones((4, 22, 3)), global_rot_mats=np.zeros((4, 22, 3, 3)))
    with pytest.raises(MeshFileError, match="all its joints are in one place"):
        read_generated(other)
    spread = np.arange(4 * 22 * 3, dtype=np.float64).reshape(4, 22, 3)
    np.savez(other, posed_joints=spread, global_rot_mats=np.zeros((4, 22, 3, 3)))
    with pytest.raises(MeshFileError, match="has matrices that are not rotations"):
        read_generated(other)
    path.write_bytes(other.read_bytes())
    assert motion_files(tmp_path) == [other]
    with pytest.raises(MeshFileError, match="it is no array of NumPy"):
        read_generated(path)
    np.save(path, np.zeros((1, 22, 3)))
    data = path.read_bytes().replace(b"(1, 22, 3), }" + b" " * 11, b"(100000000000, 22, 3), }")
    path.write_bytes(data)
    with pytest.raises(MeshFileError, match=r"vectors\.npy cannot be read"):
        read_generated(path)
    assert motion_files(tmp_path) == [other]


class _Runs:
    """An object that executes code when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (Path(self.path),)  # type: ignore[return-value]


def test_nothing_that_a_pickle_names_is_run(tmp_path: Path) -> None:
    path, mark = tmp_path / "results.npy", tmp_path / "mark"
    np.save(path, np.array({"motion": _Runs(mark)}, dtype=object))
    with pytest.raises(MeshFileError, match="which are not run"):
        read_generated(path)
    assert not mark.exists()


@pytest.mark.parametrize("order", ["C", "F"])
def test_mdm_results_are_motions_of_their_lengths(tmp_path: Path, order: str) -> None:
    from lcollision_core.files.motion.generated import _SMPL as SMPL

    places, _ = posed(tuple(SMPL), list(SMPL.values()))
    motion = np.asarray(np.stack([places, places[::-1]]).transpose(0, 2, 3, 1), np.float32, order)
    held = {
        "motion": motion,
        "text": ["a person walks", "back"],
        "lengths": np.array([N_FRAMES, 3]),
        "num_samples": 2,
        "num_repetitions": np.int64(1),
    }
    path = tmp_path / "results.npy"
    np.save(path, np.array(held, dtype=object))
    first, second = read_generated(path)
    assert (first.name, second.name) == ("results 1", "results 2")
    assert (len(first), len(second)) == (N_FRAMES, 3)
    assert "the joints of MDM" in first.notes[0]
    np.save(tmp_path / "plain.npy", places.astype(np.float32))
    (plain,) = read_generated(tmp_path / "plain.npy")
    # Sums depend on the array's memory layout.
    np.testing.assert_allclose(first.turns, plain.turns, atol=1e-12)
    assert motion_files(tmp_path) == [tmp_path / "plain.npy", path]
    # T2M-GPT and others keep the batch.
    for n in (1, 2):
        np.save(tmp_path / "batch.npy", np.stack([places.astype(np.float32)] * n))
        batch = read_generated(tmp_path / "batch.npy")
        assert [own.name for own in batch] == ([""] if n == 1 else ["batch 1", "batch 2"])
        for own in batch:
            np.testing.assert_allclose(own.turns, plain.turns, atol=1e-12)
    assert tmp_path / "batch.npy" in motion_files(tmp_path)


def test_vectors_of_humanml3d_are_the_joints_that_they_were_made_of(tmp_path: Path) -> None:
    from lcollision_core.files.motion.generated import _SMPL as SMPL

    places, _ = posed(tuple(SMPL), list(SMPL.values()))
    half = 0.2 * np.arange(N_FRAMES)
    back = Rotation.from_rotvec(np.multiply.outer(2.0 * half, [0.0, 1.0, 0.0]))
    roots = np.array([[0.1 * n, 0.9, 0.05 * n * n] for n in range(N_FRAMES)])
    places += (roots - places[:, 0])[:, None]
    vectors = np.zeros((N_FRAMES, 263))
    vectors[:-1, 0] = np.diff(half)
    # A step is given in the frame that it leads to.
    vectors[:-1, 1:3] = back[1:].apply(np.diff(roots, axis=0))[:, [0, 2]]
    vectors[:, 3] = roots[:, 1]
    level = roots * [1.0, 0.0, 1.0]
    seen = np.einsum("txy,tjy->tjx", back.as_matrix(), places[:, 1:] - level[:, None])
    vectors[:, 4:67] = seen.reshape(N_FRAMES, -1)
    path = tmp_path / "vectors.npy"
    np.save(path, vectors.astype(np.float32))
    (motion,) = read_generated(path)
    np.save(tmp_path / "joints.npy", places)
    (joints,) = read_generated(tmp_path / "joints.npy")
    np.testing.assert_allclose(motion.turns, joints.turns, atol=1e-5)
    np.testing.assert_allclose(motion.places, joints.places, atol=1e-5)
    assert "the vectors of HumanML3D" in motion.notes[0]


def test_a_motion_of_smpl_moves_the_limbs_of_another_body(tmp_path: Path) -> None:
    from lcollision_core.bodies.standing_pose import in_world
    from lcollision_core.files.motion.smpl import read_smpl_motion, skeleton_of_smpl

    poses = np.random.default_rng(4).normal(0.0, 0.25, (N_FRAMES, 52 * 3))
    # AMASS is z up.
    up = Rotation.from_rotvec([np.pi / 2.0, 0.0, 0.0])
    poses[:, :3] = (up * Rotation.from_rotvec(poses[:, :3])).as_rotvec()
    path = tmp_path / "walk.npz"
    trans = np.linspace([0.0, 0.0, 1.1], [1.0, 0.0, 1.1], N_FRAMES)
    np.savez(path, poses=poses, trans=trans, betas=np.zeros(16), mocap_framerate=60.0)
    body = RigBody.of(rigged_body())
    same, notes = body_of_motion(body, path)
    assert same is body
    assert "read as an SMPL motion" in notes[0]
    (motion,) = read_motions(body, path)
    assert motion.rate == pytest.approx(60.0)
    ours = list(body.space.rig.joint_names)
    shown = np.stack([body.space.transforms(row) for row in motion.codes])[..., :3, 3]
    shown = shown @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T
    skeleton = skeleton_of_smpl(read_smpl_motion(path), 30.0)
    _, places = in_world(skeleton)
    for start, end, first, last in LIMBS:
        own = shown[:, ours.index(end)] - shown[:, ours.index(start)]
        names = skeleton.names
        theirs = places[:, names.index(last)] - places[:, names.index(first)]
        cosines = (own * theirs).sum(1) / np.linalg.norm(own, axis=1)
        cosines /= np.linalg.norm(theirs, axis=1)
        assert np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).max() < 2.0
    assert motion_files(tmp_path) == [path]
