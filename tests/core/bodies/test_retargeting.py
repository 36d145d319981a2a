"""BVH and VRMA motions on a character's joints: its own, others, and damaged files."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.motions import MotionChange, read_motions, write_clips
from lcollision_core.bodies.retargeting import Retargeting
from lcollision_core.errors import MeshFileError
from lcollision_core.files.gltf.schema import GltfDocument
from lcollision_core.files.motion.bvh import Bvh, read_bvh
from lcollision_core.motion import resolve_motion
from tests.bvh_files import bvh_text
from tests.core.motion.swings import CLIP, swinging, swinging_body
from tests.hostile_values import damaged_glbs
from tests.rigged_shapes import FloatArray, rigged_body, write_gltf

IN_CM = 100.0
TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from the body's axes, z up and facing -y, to those of most BVH files."""


def of_rig(body: RigBody, codes: FloatArray, fps: float = 30.0) -> str:
    """Write a motion of a body on its own skeleton, in centimetres, y up."""
    space = body.space
    rig, transforms = space.rig, np.array([space.transforms(row) for row in codes])
    # Its left is x, its up y, its front z.
    axes = np.stack([np.cross(space.up, space.front), space.up, space.front])
    moved = transforms[..., :3, :3] @ np.linalg.inv(rig.rest[:, :3, :3])
    turns = moved.copy()
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            turns[:, joint] = np.swapaxes(moved[:, parent], 1, 2) @ moved[:, joint]
    root = int(np.flatnonzero(rig.parents < 0)[0])
    return bvh_text(
        rig.joint_names,
        rig.parents.tolist(),
        IN_CM * rig.rest[:, :3, 3] @ axes.T,
        axes @ turns @ axes.T,
        IN_CM * transforms[:, root, :3, 3] @ axes.T,
        fps=fps,
    )


def test_the_own_skeleton_comes_back_in_its_place(tmp_path: Path) -> None:
    body = RigBody.of(rigged_body())
    codes = np.random.default_rng(4).uniform(body.space.low, body.space.high, (5, body.latent_size))
    path = tmp_path / "moves.bvh"
    path.write_text(of_rig(body, codes, fps=24.0))
    (motion,) = read_motions(body, path)
    assert (motion.name, motion.source, len(motion)) == ("moves", "moves.bvh", 5)
    assert motion.rate == pytest.approx(24.0, rel=1e-5)
    difference = body.decode(motion.codes) - body.decode(codes)
    assert np.abs(difference).max() < 1e-6 * body.body_size
    assert read_motions(body, path, fps=60.0)[0].rate == pytest.approx(60.0)


FOREIGN = {
    "Hips": ("", (0.0, 0.0, 0.0)),
    "Chest": ("Hips", (0.0, 5.2, 0.0)),
    "Neck": ("Chest", (0.0, 18.6, 0.0)),
    "Head": ("Neck", (0.0, 5.4, 0.0)),
    **{
        f"{side}{name}": (parent if parent in ("Hips", "Chest") else side + parent, place)
        for side, sign in (("Left", 1.0), ("Right", -1.0))
        for name, parent, place in (
            ("Collar", "Chest", (1.1 * sign, 16.2, 1.9)),
            ("UpArm", "Collar", (5.5 * sign, 0.0, 0.0)),
            ("LowArm", "UpArm", (0.0, -12.0, 0.0)),
            ("Hand", "LowArm", (0.0, -9.9, 0.0)),
            ("UpLeg", "Hips", (3.9 * sign, 0.0, 0.0)),
            ("LowLeg", "UpLeg", (0.0, -18.3, 0.0)),
            ("Foot", "LowLeg", (0.0, -17.4, 0.0)),
        )
    },
}
"""Name, parent and offset of a motion capture skeleton whose arms hang at rest."""


def foreign(path: Path, turns: FloatArray, roots: FloatArray) -> Bvh:
    names = list(FOREIGN)
    parents = [names.index(parent) if parent else -1 for parent, _ in FOREIGN.values()]
    places = np.array([offset for _, offset in FOREIGN.values()])
    for joint, parent in enumerate(parents):
        if parent >= 0:
            places[joint] += places[parent]
    down = {joint: (0.0, -6.0, 0.0) for joint, name in enumerate(names) if "Hand" in name}
    flat = {joint: (0.0, -3.0, 6.0) for joint, name in enumerate(names) if "Foot" in name}
    path.write_text(bvh_text(names, parents, places, turns, roots, ends={**down, **flat}))
    return read_bvh(path)


def test_limbs_point_as_those_of_another_skeleton_do(tmp_path: Path) -> None:
    body = RigBody.of(rigged_body())
    names, n_frames = list(FOREIGN), 4
    vectors = np.random.default_rng(7).normal(0.0, 0.3, (n_frames, len(names), 3))
    vectors[0] = 0.0
    turns = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    turns = turns.reshape(n_frames, len(names), 3, 3)
    roots = np.array([[0.0, 38.7, 0.0]] * n_frames) + np.outer(np.arange(n_frames), [3, 1, 2])
    path = tmp_path / "capture.bvh"
    bvh = foreign(path, turns, roots)
    transforms = Retargeting.of(bvh.motion, body.space, path).transforms()
    ours = list(body.space.rig.joint_names)
    world, places = turns.copy(), np.empty((n_frames, len(names), 3))
    for joint, (name, offset) in enumerate(FOREIGN.values()):
        parent = names.index(name) if name else -1
        places[:, joint] = roots if parent < 0 else places[:, parent] + world[:, parent] @ offset
        if parent >= 0:
            world[:, joint] = world[:, parent] @ turns[:, joint]
    for side in ("Left", "Right"):
        for start, end, other_start, other_end in (
            ("Arm", "ForeArm", "UpArm", "LowArm"),
            ("ForeArm", "Hand", "LowArm", "Hand"),
            ("UpLeg", "Leg", "UpLeg", "LowLeg"),
            ("Leg", "Foot", "LowLeg", "Foot"),
        ):
            own, theirs = (
                all_places[:, listed.index(side + b)] - all_places[:, listed.index(side + a)]
                for all_places, listed, a, b in (
                    (transforms[..., :3, 3] @ TO_Y_UP.T, ours, start, end),
                    (places, names, other_start, other_end),
                )
            )
            own /= np.linalg.norm(own, axis=1, keepdims=True)
            theirs /= np.linalg.norm(theirs, axis=1, keepdims=True)
            np.testing.assert_allclose(own, theirs, atol=1e-6)
    # At rest it stands as before, arms down, and its path is equally long in leg lengths.
    hips = transforms[:, ours.index("Hips"), :3, 3] @ TO_Y_UP.T
    feet = transforms[0, ours.index("LeftFoot"), :3, 3] @ TO_Y_UP.T
    np.testing.assert_allclose(hips[0] - feet, [-0.12, 0.9, 0.0], atol=1e-6)
    np.testing.assert_allclose((hips[1:] - hips[:-1]) * 35.7, [np.multiply([3, 1, 2], 0.8)] * 3)


@pytest.mark.parametrize("height", [8.0, 300.0])
def test_a_body_stands_on_the_ground_wherever_the_root_of_the_capture_rests(
    tmp_path: Path, height: float
) -> None:
    body, path = RigBody.of(rigged_body()), tmp_path / "capture.bvh"
    turns = np.broadcast_to(np.eye(3), (2, len(FOREIGN), 3, 3))
    foreign(path, turns, np.array([[0.0, 38.7, 0.0], [0.0, 38.7, 9.0]]))
    (plain,) = read_motions(body, path)
    text = path.read_text()
    path.write_text(text.replace("OFFSET 0.000000 0.000000", f"OFFSET 0.000000 {height}", 1))
    (other,) = read_motions(body, path)
    np.testing.assert_allclose(other.codes, plain.codes, atol=1e-6)


def test_a_capture_in_place_or_about_its_hips_stands_as_the_body_does(tmp_path: Path) -> None:
    body, path = RigBody.of(rigged_body()), tmp_path / "capture.bvh"
    turns = np.broadcast_to(np.eye(3), (2, len(FOREIGN), 3, 3))
    bvh = foreign(path, turns, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 9.0]]))
    hips = Retargeting.of(bvh.motion, body.space, path).transforms()[:, 0, :3, 3] @ TO_Y_UP.T
    at_rest = body.space.rig.rest[0, :3, 3] @ TO_Y_UP.T
    np.testing.assert_allclose(hips[0], at_rest, atol=1e-6)
    np.testing.assert_allclose((hips[1] - hips[0]) * 35.7, [0.0, 0.0, 9.0 * 0.8], atol=1e-6)


def test_what_was_resolved_goes_back_into_the_file_and_all_else_stays(tmp_path: Path) -> None:
    body, motion = swinging()
    path, out = tmp_path / "swing.bvh", tmp_path / "free.bvh"
    path.write_text(of_rig(body, motion.codes))
    (source,) = read_motions(body, path)
    found = resolve_motion(body.resolver, source, body.space.up)
    assert not found.before.all()
    assert found.after.all()
    change = MotionChange(source, found.motion, found.spans)
    written = write_clips(out, body, path, [change])
    assert written.free[0].all()
    (back,) = read_motions(body, out)
    difference = body.decode(back.codes) - body.decode(found.motion.codes)
    assert np.abs(difference).max() < 1e-6 * body.body_size
    before, after = path.read_text().splitlines(), out.read_text().splitlines()
    n_head = len(before) - len(motion)
    assert after[:n_head] == before[:n_head]
    same = [a == b for a, b in zip(before[n_head:], after[n_head:], strict=True)]
    changed = set(np.flatnonzero(~np.array(same)).tolist())
    inside = {frame for span in found.spans for frame in span}
    assert changed
    assert changed <= inside
    # Angles continue from the previous ones, without jumps of 360 degrees.
    old, new = read_bvh(path).numbers, read_bvh(out).numbers
    assert np.abs(new - old).max() < 90.0
    # A free motion is written unchanged, byte for byte.
    write_clips(out, body, path, [MotionChange(source, source, ())])
    assert out.read_bytes() == path.read_bytes()


@pytest.mark.variants(2)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16-le", "utf-16-be", "cp1252", "shift-jis"])
def test_a_file_of_any_encoding_and_line_ends_is_read_and_written_in_them(
    tmp_path: Path, encoding: str
) -> None:
    body, motion = swinging()
    text = of_rig(body, motion.codes).replace("\n", "\r\n")
    root = "頭" if encoding == "shift-jis" else "Tête"
    # Joint names that equal keywords of the format.
    text = re.sub(r"JOINT (?!Left|Right)\S+", "JOINT MOTION_root", text, count=1)
    text = re.sub(r"ROOT \S+", f"ROOT LOCOMOTION {root}", text)
    path = tmp_path / "motion.bvh"
    mark = "\ufeff" * encoding.startswith("utf-16")
    path.write_bytes((mark + text).encode(encoding))
    bvh = read_bvh(path)
    assert bvh.names[0].startswith("LOCOMOTION ")
    assert "MOTION_root" in bvh.names
    turns, roots = bvh.rotations()[[5]], bvh.positions()[[5], 0]
    before, after = path.read_bytes(), bvh.with_frames([5], turns, roots)
    assert bvh.with_frames([], turns[:0], roots[:0]) == before
    lines = [data.decode(encoding, "replace").split("\n") for data in (before, after)]
    changed = [number for number, (a, b) in enumerate(zip(*lines, strict=True)) if a != b]
    assert set(changed) <= {len(lines[0]) - 1 - len(bvh) + 5}
    assert lines[1][-2 - len(bvh) + 6].endswith("\r")


def test_named_ends_and_any_blanks_are_read(tmp_path: Path) -> None:
    body, motion = swinging()
    text, paths = of_rig(body, motion.codes), [tmp_path / "plain.bvh", tmp_path / "other.bvh"]
    other = text.replace("End Site", "End Site Tip end").replace("Frames:", "Frames :")
    for path, content in zip(
        paths, (text, other.replace("Frame Time: ", "Frame \t Time:")), strict=True
    ):
        path.write_text(content)
    plain, bvh = map(read_bvh, paths)
    assert (bvh.names, bvh.frame_time) == (plain.names, plain.frame_time)
    np.testing.assert_array_equal(bvh.ends, plain.ends)
    np.testing.assert_array_equal(bvh.numbers, plain.numbers)


HUMAN = {
    "hips": "Hips",
    "spine": "Spine",
    "neck": "Neck",
    "head": "Head",
    **{
        f"{side.lower()}{bone}": f"{side}{name}"
        for side in ("Left", "Right")
        for bone, name in (
            ("UpperArm", "Arm"),
            ("LowerArm", "ForeArm"),
            ("Hand", "Hand"),
            ("UpperLeg", "UpLeg"),
            ("LowerLeg", "Leg"),
            ("Foot", "Foot"),
        )
    },
}
"""Joints of the body of tubes, by VRM bone."""


def as_vrma(character: Path, path: Path, bones: dict[str, str] = HUMAN) -> Path:
    """Write a character's clips as a VRM animation, without a mesh."""
    document = GltfDocument(character.read_bytes(), character).editable()
    described = document.description
    names = [node.get("name") for node in described["nodes"]]
    for node in described["nodes"]:
        node.pop("mesh", None)
        node.pop("skin", None)
    for kind in ("meshes", "skins", "materials"):
        described.pop(kind, None)
    listed = {bone: {"node": names.index(name)} for bone, name in bones.items()}
    humanoid = {"specVersion": "1.0", "humanoid": {"humanBones": listed}}
    described["extensions"] = {"VRMC_vrm_animation": humanoid}
    described["extensionsUsed"] = ["VRMC_vrm_animation"]
    path.write_bytes(document.encoded())
    return path


def test_a_vrm_animation_moves_a_character(tmp_path: Path) -> None:
    character = write_gltf(swinging_body(), tmp_path / "swing.glb")
    body = open_body(character)
    (expected,) = read_motions(body, character, CLIP)
    (motion,) = read_motions(body, as_vrma(character, tmp_path / "swing.vrma"))
    assert (motion.name, len(motion)) == ("swing", len(expected))
    assert motion.rate == pytest.approx(30.0)
    difference = body.decode(motion.codes) - body.decode(expected.codes)
    assert np.abs(difference).max() < 1e-6 * body.body_size
    assert read_motions(body, tmp_path / "swing.vrma", fps=10.0)[0].rate == pytest.approx(10.0)
    with pytest.raises(MeshFileError, match="it has no humanoid bones"):
        read_motions(body, as_vrma(character, tmp_path / "none.vrma", {}))
    (tmp_path / "short.vrma").write_bytes((tmp_path / "swing.vrma").read_bytes()[:999])
    with pytest.raises(MeshFileError, match=r"short\.vrma cannot be read"):
        read_motions(body, tmp_path / "short.vrma")


def test_a_vrm_animation_of_a_real_character_is_the_clip(characters: Path, tmp_path: Path) -> None:
    source = characters / "mannequin-moves.glb"
    bones = {bone: f"mixamorig:{name}" for bone, name in HUMAN.items()}
    bones |= {"chest": "mixamorig:Spine1", "upperChest": "mixamorig:Spine2"}
    bones |= {f"{s.lower()}Shoulder": f"mixamorig:{s}Shoulder" for s in ("Left", "Right")}
    body = open_body(source)
    (expected,) = read_motions(body, source)
    (motion,) = read_motions(body, as_vrma(source, tmp_path / "moves.vrma", bones))
    difference = body.decode(motion.codes[::10]) - body.decode(expected.codes[::10])
    # Fingers and toes are not among the VRM bones.
    assert np.median(np.abs(difference)) < 1e-6 * body.body_size


def test_a_rig_without_one_root_leaves_the_skeleton_in_its_place(tmp_path: Path) -> None:
    body, path = RigBody.of(rigged_body()), tmp_path / "still.bvh"
    path.write_text(of_rig(body, np.zeros((2, body.latent_size))))
    bvh, rig = read_bvh(path), body.space.rig
    parents = rig.parents.copy()
    parents[rig.joint_names.index("Spine")] = -1
    loose = RigBody.of(replace(rigged_body(), rig=replace(rig, parents=parents))).space
    assert loose.joint_of_code[0] == -1
    retargeting = Retargeting.of(bvh.motion, loose, path)
    before = retargeting.transforms()
    np.testing.assert_allclose(before[..., :3, 3], [rig.rest[:, :3, 3]] * 2, atol=1e-6)
    after = before.copy()
    after[:, -1, :3, 3] += 0.1
    _, roots = retargeting.changed(range(2), before, after)
    np.testing.assert_array_equal(roots, bvh.positions()[:, 0])


def test_a_skeleton_of_something_else_is_refused(tmp_path: Path) -> None:
    body = RigBody.of(rigged_body())
    names = [f"link {number}" for number in range(12)]
    places = np.outer(np.arange(12), [0.0, 0.1, 0.0])
    turns = np.broadcast_to(np.eye(3), (2, 12, 3, 3))
    path = tmp_path / "snake.bvh"
    path.write_text(bvh_text(names, list(range(-1, 11)), places, turns, np.zeros((2, 3))))
    with pytest.raises(
        MeshFileError, match=r"snake\.bvh has joints that match the body's neither by"
    ):
        read_motions(body, path)


@pytest.mark.parametrize(
    ("pattern", "other", "message"),
    [
        ("Frames: 48", "Frames: 49", "announces 49 frames and contains 48"),
        ("Frames: 48", "Frames: many", "'many' is not a number"),
        ("Frame Time: ", "Frame Time: -", "its frame time is -0.0333"),
        ("HIERARCHY", "HIERARCHIE", "it is not a BVH file"),
        ("MOTION", "", "it is not a BVH file"),
        ("Zrotation", "Wrotation", "has unknown or repeated channels"),
        ("OFFSET", "OFFSET nan", "'nan' is not a number"),
        (r"\}", "", "its braces do not match"),
        (r"\n(\S+) \S+ ", r"\n\1 1e99 ", "'1e99' is not a number that can be used"),
        (r"\n(\S+) \S+ ", r"\n\1 ", "numbers, its joints have"),
    ],
)
def test_damage_is_one_sentence(tmp_path: Path, pattern: str, other: str, message: str) -> None:
    body, motion = swinging()
    text = of_rig(body, motion.codes)
    assert re.search(pattern, text)
    start = text.index("Frame Time") if pattern.startswith(r"\n") else 0
    path = tmp_path / "damaged.bvh"
    path.write_text(text[:start] + re.sub(pattern, other, text[start:], count=1))
    with pytest.raises(MeshFileError, match=re.escape(message)) as caught:
        read_motions(body, path)
    assert "damaged.bvh cannot be read: " in str(caught.value)


def test_scale_channels_of_one_are_read_and_others_are_refused_by_name(tmp_path: Path) -> None:
    turns = np.broadcast_to(np.eye(3), (2, len(FOREIGN), 3, 3))
    plain = foreign(tmp_path / "plain.bvh", turns, np.zeros((2, 3)))
    scaled = tmp_path / "scaled.bvh"
    head, frames = (tmp_path / "plain.bvh").read_text().split("Frame Time:")
    root = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    assert root in head
    head = head.replace(root, f"{root.replace('6', '9')} Xscale Yscale Zscale")
    for scale in (1.0, 1.5):
        time, *rows = frames.splitlines()
        words = [row.split() for row in rows]
        rows = [" ".join([*row[:6], "1", f"{scale}", "1", *row[6:]]) for row in words]
        scaled.write_text(f"{head}Frame Time:{time}\n" + "\n".join(rows) + "\n")
        if scale == 1.0:
            assert np.array_equal(read_bvh(scaled).rotations(), plain.rotations())
            assert np.array_equal(read_bvh(scaled).positions(), plain.positions())
    with pytest.raises(MeshFileError, match="it scales the joint 'Hips'"):
        read_bvh(scaled)


def test_three_hundred_damaged_files_are_read_or_refused(tmp_path: Path) -> None:
    body, motion = swinging()
    text = of_rig(body, motion.codes[:3]).encode()
    path, generator = tmp_path / f"{CLIP}.bvh", np.random.default_rng(11)
    said: list[str] = []
    words = [b"{", b"}", b"JOINT", b"End Site", b"nan", b"-1", b"\0", b"\xff", b"CHANNELS 9", b""]
    for _ in range(300):
        data = bytearray(text)
        for place in generator.integers(0, len(data), generator.integers(1, 4)):
            word = words[generator.integers(len(words))]
            data[place : place + int(generator.integers(0, 40))] = word
        path.write_bytes(data[: int(generator.integers(1, 2 * len(data)))])
        try:
            read_motions(body, path)
        except MeshFileError as error:
            said.append(str(error))
    assert 200 < len(said) < 300
    assert not [sentence for sentence in said if "\n" in sentence]


@pytest.mark.slow
def test_three_hundred_damaged_vrm_animations_are_read_or_refused(tmp_path: Path) -> None:
    character, path = write_gltf(swinging_body(), tmp_path / "swing.glb"), tmp_path / "damaged.vrma"
    body = open_body(character)
    whole, said = as_vrma(character, tmp_path / "swing.vrma").read_bytes(), []
    for data in damaged_glbs(whole, 300, seed=12):
        path.write_bytes(data)
        try:
            read_motions(body, path)
        except MeshFileError as error:
            said.append(str(error))
    assert 100 < len(said) < 300
    assert not [sentence for sentence in said if "\n" in sentence or "damaged.vrma" not in sentence]
