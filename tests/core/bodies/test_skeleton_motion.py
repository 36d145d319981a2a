"""Motions of rigs as BVH files and VRM animations, read by independent code."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import RigBody
from lcollision_core.bodies.motions import read_motions
from lcollision_core.bodies.retargeting import require_skeleton, write_skeleton
from lcollision_core.errors import MeshFileError
from lcollision_core.files import Character
from tests.bvh_files import joint_places
from tests.rigged_shapes import FloatArray, rigged_body
from tests.skeletons import HORSE, PERSON, SNAKE, both_sides, character_from

N_FRAMES, FPS = 5, 24.0

A_POSE = {
    **PERSON,
    **both_sides(
        [
            ("clavicle", "chest", (0.04, 1.42, 0.0)),
            ("upperarm", "clavicle", (0.18, 1.42, 0.0)),
            ("forearm", "upperarm", (0.37, 1.23, -0.01)),
            ("hand", "forearm", (0.54, 1.05, 0.0)),
        ]
    ),
}
"""A person whose arms point diagonally down at rest."""


def moving(body: RigBody) -> FloatArray:
    """Return (T, D) codes of poses at different positions."""
    space = body.space
    return np.random.default_rng(4).uniform(space.low, space.high, (N_FRAMES, len(space.low)))


def written(body: RigBody, codes: FloatArray, path: Path) -> tuple[list[Any], tuple[str, ...]]:
    stored, notes = write_skeleton(path, body, list(codes), list(body.decode(codes)), FPS)
    return [stored(frame) for frame in range(len(codes))], notes


def axes_of(body: RigBody) -> FloatArray:
    """Return the body's left, up and front as rows."""
    return np.stack([np.cross(body.space.up, body.space.front), body.space.up, body.space.front])


def loose(character: Character) -> Character:
    """Make the upper body a separate tree."""
    rig = character.rig
    assert rig is not None
    parents = rig.parents.copy()
    parents[rig.joint_names.index("Spine")] = -1
    return replace(character, rig=replace(rig, parents=parents))


@pytest.mark.parametrize("kind", ["person", "several roots", "horse", "snake"])
def test_a_bvh_file_has_the_joints_where_the_motion_has_them(tmp_path: Path, kind: str) -> None:
    animals = {"horse": HORSE, "snake": SNAKE}
    character = character_from(animals[kind]) if kind in animals else rigged_body()
    has_one_root = kind != "several roots"
    body = RigBody.of(character if has_one_root else loose(character))
    codes, path = moving(body), tmp_path / "moves.bvh"
    stored, notes = written(body, codes, path)
    assert notes == ()
    assert np.abs(stored - body.decode(codes)).max() < 1e-5 * body.body_size
    names, rest, places, frame_time = joint_places(path.read_text())
    assert frame_time == pytest.approx(1.0 / FPS)
    assert len(places) == N_FRAMES
    rig, axes = body.space.rig, axes_of(body)
    assert set(names) == {*rig.joint_names, *(() if has_one_root else ("root",))}
    own = [names.index(name) for name in rig.joint_names]
    expected = np.array([body.space.transforms(row)[:, :3, 3] for row in codes]) @ axes.T
    np.testing.assert_allclose(places[:, own], expected, atol=1e-5 * body.body_size)
    np.testing.assert_allclose(rest[own], rig.rest[:, :3, 3] @ axes.T, atol=1e-5)


def test_a_bvh_file_comes_back_as_the_motion(tmp_path: Path) -> None:
    body, path = RigBody.of(rigged_body()), tmp_path / "moves.bvh"
    codes = moving(body)
    stored, notes = written(body, codes, path)
    assert notes == ()
    (back,) = read_motions(body, path)
    assert back.rate == pytest.approx(FPS, rel=1e-6)
    for frame in (*stored, *body.decode(back.codes)):
        frame_of = min(np.abs(frame - own).max() for own in body.decode(codes))
        assert frame_of < 1e-5 * body.body_size


def test_angles_go_on_from_frame_to_frame(tmp_path: Path) -> None:
    body, path = RigBody.of(rigged_body()), tmp_path / "turns.bvh"
    codes = np.zeros((40, body.latent_size))
    # Two full turns, which rotations alone cannot distinguish from standing still.
    codes[:, 4] = np.linspace(0.0, 4.0 * np.pi, 40)
    written(body, codes, path)
    numbers = np.array(
        [line.split() for line in path.read_text().splitlines()[-40:]], dtype=np.float64
    )
    assert np.abs(np.diff(numbers, axis=0)).max() < 20.0
    assert np.abs(numbers[-1] - numbers[0]).max() == pytest.approx(720.0, abs=1e-3)


def test_names_that_bvh_cannot_hold_are_replaced(tmp_path: Path) -> None:
    character = character_from(PERSON, lambda number, name: "{ }" if number == 1 else f"{name}\n{{")
    body, path = RigBody.of(character), tmp_path / "moves.bvh"
    written(body, np.zeros((1, body.latent_size)), path)
    names = joint_places(path.read_text())[0]
    assert names[:3] == ["hips", "joint 1", "chest"]


def vrma_of(path: Path) -> tuple[dict[str, int], FloatArray, FloatArray, FloatArray]:
    """Read a VRM animation following the glTF specification.

    Returns
    -------
    bones : the node of each
    rest, turns, places : (N, 3) rest positions, (T, N, 3, 3) and (T, N, 3) at the keys, world
    """
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    held, blob = json.loads(data[20 : 20 + length]), data[28 + length :]

    def array(number: int) -> FloatArray:
        accessor = held["accessors"][number]
        assert accessor["componentType"] == 5126
        view = held["bufferViews"][accessor["bufferView"]]
        n = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        found = np.frombuffer(blob, "<f4", n * accessor["count"], view["byteOffset"])
        return found.reshape(-1, n).astype(np.float64)

    nodes, (animation,) = held["nodes"], held["animations"]
    offsets = np.array([node["translation"] for node in nodes])
    assert not any("rotation" in node or "scale" in node for node in nodes)
    n_keys = held["accessors"][animation["samplers"][0]["input"]]["count"]
    turns = np.tile(np.eye(3), (n_keys, len(nodes), 1, 1))
    places = np.tile(offsets, (n_keys, 1, 1))
    for channel in animation["channels"]:
        sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
        assert sampler["interpolation"] == "LINEAR"
        values = array(sampler["output"])
        np.testing.assert_allclose(array(sampler["input"])[:, 0], np.arange(n_keys) / FPS)
        if target["path"] == "rotation":
            turns[:, target["node"]] = Rotation.from_quat(values).as_matrix()
        else:
            assert (target["path"], target["node"]) == ("translation", bones_of(held)["hips"])
            places[:, target["node"]] = values
    rest = offsets.copy()

    def go_down(node: int) -> None:
        for child in nodes[node].get("children", ()):
            rest[child] += rest[node]
            places[:, child] = places[:, node] + np.einsum(
                "txy,ty->tx", turns[:, node], places[:, child]
            )
            turns[:, child] = turns[:, node] @ turns[:, child]
            go_down(child)

    go_down(held["scenes"][held["scene"]]["nodes"][0])
    return bones_of(held), rest, turns, places


def bones_of(held: Any) -> dict[str, int]:
    extension = held["extensions"]["VRMC_vrm_animation"]
    assert extension["specVersion"] == "1.0"
    return {bone: one["node"] for bone, one in extension["humanoid"]["humanBones"].items()}


@pytest.mark.parametrize("joints", [PERSON, A_POSE], ids=["T pose", "A pose"])
def test_a_vrm_animation_begins_in_a_t_pose_and_points_limbs_as_the_motion_does(
    tmp_path: Path, joints: Any
) -> None:
    turn = Rotation.from_euler("X", 90.0, degrees=True).as_matrix()
    body = RigBody.of(character_from(joints, turn=turn, up=(0.0, 0.0, 1.0)))
    codes, path = 0.5 * moving(body), tmp_path / "moves.vrma"
    written(body, codes, path)
    bones, rest, turns, places = vrma_of(path)
    assert len(turns) == N_FRAMES
    axes, names = axes_of(body), body.space.rig.joint_names
    expected = np.array([body.space.transforms(row)[:, :3, 3] for row in codes]) @ axes.T
    ground = (body.character.rest_vertices @ body.space.up).min()
    hips = expected[:, names.index("hips")] - [0.0, ground, 0.0]
    np.testing.assert_allclose(places[:, bones["hips"]], hips, atol=1e-5)
    limbs = {
        ("UpperArm", "LowerArm"): ("upperarm", "forearm"),
        ("LowerArm", "Hand"): ("forearm", "hand"),
        ("UpperLeg", "LowerLeg"): ("thigh", "shin"),
        ("LowerLeg", "Foot"): ("shin", "foot"),
        ("Foot", "Toes"): ("foot", "toe"),
    }
    for side, letter, sign in (("left", "L", 1.0), ("right", "R", -1.0)):
        for (start, end), (from_, to) in limbs.items():
            ends = bones[f"{side}{start}"], bones[f"{side}{end}"]
            way = places[:, ends[1]] - places[:, ends[0]]
            own = [names.index(f"{letter} {name}") for name in (from_, to)]
            wanted = expected[:, own[1]] - expected[:, own[0]]
            np.testing.assert_allclose(way, wanted, atol=1e-4)
            at_rest = rest[ends[1]] - rest[ends[0]]
            straight = [sign, 0.0, 0.0] if "Arm" in start else [0.0, -1.0, 0.0]
            if start != "Foot":
                np.testing.assert_allclose(at_rest / np.linalg.norm(at_rest), straight, atol=1e-6)
    # Read back, the body moves as before.
    (back,) = read_motions(body, path)
    assert np.abs(body.decode(back.codes) - body.decode(codes)).max() < 1e-4 * body.body_size


def vrm_name(_: int, name: str) -> str:
    """Return the name of a person's joint among VRM's bones."""
    side, _, kind = name.rpartition(" ")
    bones = {"forearm": "lowerArm", "upperarm": "upperArm", "thigh": "upperLeg", "shin": "lowerLeg"}
    bone = bones.get(kind, kind)
    return {"L": "left", "R": "right"}[side] + bone[0].upper() + bone[1:] if side else bone


@pytest.mark.parametrize("suffix", [".bvh", ".vrma"])
@pytest.mark.parametrize("height", [-1.0, 2.0])
def test_a_motion_comes_back_to_a_body_whose_origin_is_not_at_its_feet(
    tmp_path: Path, suffix: str, height: float
) -> None:
    joints = {name: (above, (x, y + height, z)) for name, (above, (x, y, z)) in PERSON.items()}
    body, path = RigBody.of(character_from(joints, vrm_name)), tmp_path / f"moves{suffix}"
    codes = 0.3 * moving(body)
    codes[:, :3] = 0.0
    written(body, codes, path)
    (back,) = read_motions(body, path)
    assert np.abs(body.decode(back.codes) - body.decode(codes)).max() < 1e-4 * body.body_size


def test_a_body_without_the_bones_of_vrm_is_refused_before_anything_is_written(
    tmp_path: Path,
) -> None:
    horse, path = RigBody.of(character_from(HORSE)), tmp_path / "horse.vrma"
    lame = {name: joint for name, joint in PERSON.items() if name != "L foot" and name != "L toe"}
    body = RigBody.of(character_from(lame))
    with pytest.raises(MeshFileError, match="bones that a VRM animation needs: leftFoot;"):
        written(body, np.zeros((2, body.latent_size)), path)
    assert not path.exists()
    require_skeleton(tmp_path / "horse.bvh", horse)
    require_skeleton(tmp_path / "horse.pc2", horse)
