"""Parts hidden by scale in the rest pose: shown if a clip shows them, else left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies.rig_body import RigBody
from lcollision_core.errors import MeshFileError
from lcollision_core.files import (
    CharacterForm,
    read_character,
    read_mesh,
    read_pose_set,
    write_character,
)
from lcollision_core.files.scene_files import read_scene
from tests.core.gltf_builder import GltfBuilder, arm, rotation, tube

SHOWN = "hidden at rest by its scale, shown as in the clip 'draw': Shield"
HIDDEN = [0.0, 0.0, 0.0]
N = len(tube()[0])


def _with_shield(
    scale: list[float], *scales: list[float], parent: int | None = 3, clip: str = "draw"
) -> GltfBuilder:
    """Add a shield, parented to the hand, with its scale at rest and at the keys of a clip."""
    builder = arm(split=False)
    vertices, faces = tube()
    primitive = {
        "attributes": {"POSITION": builder.array(vertices * 0.5)},
        "indices": builder.array(faces.reshape(-1), "u2"),
    }
    mesh = builder.add("meshes", name="Mesh.007", primitives=[primitive])
    node = builder.add("nodes", name="Shield", mesh=mesh, translation=[0.3, 0.0, 0.0], scale=scale)
    if parent is not None:
        builder.description["nodes"][parent].setdefault("children", []).append(node)
    if scales:
        times = np.linspace(0.0, 1.0, len(scales))
        channel = {"node": node, "path": "scale", "interpolation": "STEP"}
        builder.animation(clip, channel | {"times": times, "values": list(scales)})
    return builder


@pytest.mark.parametrize(
    ("rest", "scales"),
    [
        (HIDDEN, [HIDDEN, [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]),
        ([1e-6, 1e-6, 1e-6], [[1e-6, 1e-6, 1e-6], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]),
        ([1.0, 0.0, 1.0], [[1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]),
        # Mirrored when shown.
        (HIDDEN, [[-1.0, 1.0, 1.0], HIDDEN, [-1.0, 1.0, 1.0]]),
        # It pops up gradually.
        (HIDDEN, [[0.2, 0.2, 0.2], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.3, 1.3, 1.3], HIDDEN]),
    ],
)
@pytest.mark.parametrize("suffix", [".glb", ".vrm"])
def test_a_prop_that_a_clip_shows_is_part_of_the_character(
    tmp_path: Path, rest: list[float], scales: list[list[float]], suffix: str
) -> None:
    builder = _with_shield(rest, *scales)
    character = read_character(builder.write(tmp_path / f"hero{suffix}"))
    assert SHOWN in character.notes
    assert character.rig is not None
    assert character.rig.joint_names == ("rig:LeftArm", "rig:LeftForeArm", "rig:LeftHand")
    assert character.topology.n_faces == 2 * len(tube()[1])
    # Same as without hiding at rest and without animated scale.
    plain = read_character(_with_shield(scales[-2]).write(tmp_path / "plain.glb"))
    expected = scales[1] if scales[-1] == HIDDEN else scales[-1]
    if expected == scales[-2]:
        assert np.allclose(character.rest_vertices, plain.rest_vertices, atol=1e-9)
        assert np.array_equal(character.topology.faces, plain.topology.faces)
        assert RigBody.of(character).fingerprint == RigBody.of(plain).fingerprint
    frames = character.sample("draw", None)
    sizes = np.ptp(frames.vertices[:, N:], axis=1).max(axis=1)
    assert (sizes > 0.1).tolist() == [
        min(map(abs, scale)) > 0.1 or 1.0 in scale for scale in scales
    ]
    poses = read_pose_set(tmp_path / f"hero{suffix}", clip="draw")
    assert poses.topology.n_faces == character.topology.n_faces


@pytest.mark.parametrize("form", list(CharacterForm))
def test_a_character_is_written_with_the_prop_that_is_shown(
    tmp_path: Path, form: CharacterForm
) -> None:
    path = _with_shield(HIDDEN, HIDDEN, [1.0, 1.0, 1.0]).write(tmp_path / "hero.glb")
    model = RigBody.of(read_character(path))
    pose = np.zeros(model.latent_size)
    pose[-3:] = 0.3
    vertices, transforms = model.decode(pose), model.space.transforms(pose)
    out = tmp_path / "posed.glb"
    write_character(out, model.character, vertices, form, transforms)
    assert np.allclose(read_mesh(out).vertices, vertices, atol=1e-5)


def test_a_prop_that_only_the_second_clip_shows_is_shown_as_in_that(tmp_path: Path) -> None:
    builder = _with_shield(HIDDEN, [1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
    hidden = {"node": 5, "path": "scale", "times": [0.0, 1.0], "values": [HIDDEN, HIDDEN]}
    builder.animation("walk", hidden)
    builder.description["animations"].reverse()
    scene = read_scene(builder.write(tmp_path / "hero.glb"))
    assert [clip.name for clip in scene.clips] == ["walk", "draw", "wave"]
    assert SHOWN in scene.notes


def test_a_prop_that_nothing_carries_moves_as_a_joint_of_its_own(tmp_path: Path) -> None:
    builder = _with_shield(HIDDEN, HIDDEN, [1.0, 1.0, 1.0], parent=None)
    character = read_character(builder.write(tmp_path / "hero.glb"))
    assert SHOWN in character.notes
    assert character.rig is not None
    assert "Shield" in character.rig.joint_names
    model = RigBody.of(character)
    # In a frame in which it is hidden, it does not turn.
    codes = model.latent_space.high - model.latent_space.low
    assert np.isfinite(codes).all()
    assert np.abs(model.known_poses[1:, model.space.joint_of_code == 3]).max() < 1e-6


@pytest.mark.parametrize("scales", [(), (HIDDEN, HIDDEN)])
@pytest.mark.parametrize("parent", [3, None])
def test_a_prop_that_is_never_seen_is_left_out_and_said(
    tmp_path: Path, scales: tuple[list[float], ...], parent: int | None
) -> None:
    builder = _with_shield(HIDDEN, *scales, parent=parent)
    character = read_character(builder.write(tmp_path / "hero.glb"))
    why = "as its scale is zero" if scales or parent else "as no joint carries it"
    assert f"left out, {why}: Shield" in character.notes
    assert character.rig is not None
    assert len(character.rest_vertices) == N


def test_a_skinned_joint_that_hides_its_part_is_shown_by_the_clip(tmp_path: Path) -> None:
    builder = arm(split=False)
    builder.description["nodes"][3]["scale"] = HIDDEN
    channel = {"node": 3, "path": "scale", "times": [0.0, 1.0], "interpolation": "STEP"}
    builder.animation("draw", channel | {"values": [HIDDEN, [1.0, 1.0, 1.0]]})
    character = read_character(builder.write(tmp_path / "hero.glb"))
    whole = read_character(arm(split=False).write(tmp_path / "whole.glb"))
    assert np.allclose(character.rest_vertices, whole.rest_vertices, atol=1e-9)
    assert character.rig is not None
    assert character.rig.joint_names[-1] == "rig:LeftHand"
    assert np.isfinite(RigBody.of(character).known_poses).all()


@pytest.mark.parametrize("node", [0, 1])
def test_joints_below_a_hidden_node_lie_as_bound_not_as_the_clip_bends_them(
    tmp_path: Path, node: int
) -> None:
    builder = arm(split=False)
    builder.description["nodes"][node]["scale"] = HIDDEN
    bent = {"node": 2, "path": "rotation", "times": [0.0, 1.0], "values": [rotation(0, 1.5)] * 2}
    shown = {"node": node, "path": "scale", "times": [0.0, 1.0], "interpolation": "STEP"}
    builder.animation("draw", bent, shown | {"values": [HIDDEN, [1.0, 1.0, 1.0]]})
    character = read_character(builder.write(tmp_path / "hero.glb"))
    straight = np.array([0.5, 0.0, -1.0]) + tube()[0]
    np.testing.assert_allclose(character.rest_vertices, straight, atol=1e-6)
    last = character.sample("draw", None).vertices[-1]
    assert np.abs(last - straight).max() > 1.0


def test_a_hidden_joint_is_said_of_the_parts_that_it_moves(tmp_path: Path) -> None:
    builder = _with_shield([1.0, 1.0, 1.0])
    shield = builder.description["nodes"][5]
    builder.description["nodes"][3]["children"].remove(5)
    n = len(tube()[0])
    attributes = builder.description["meshes"][shield["mesh"]]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = builder.array(np.zeros((n, 4)), "u1")
    attributes["WEIGHTS_0"] = builder.array(np.eye(4)[np.zeros(n, dtype=int)])
    shield["skin"] = 0
    builder.description["nodes"][3]["scale"] = HIDDEN
    channel = {"node": 3, "path": "scale", "times": [0.0, 1.0], "interpolation": "STEP"}
    builder.animation("draw", channel | {"values": [HIDDEN, [1.0, 1.0, 1.0]]})
    character = read_character(builder.write(tmp_path / "hero.glb"))
    assert "hidden at rest by its scale, shown as in the clip 'draw': Body" in character.notes


def test_a_file_of_nothing_but_hidden_parts_says_so(tmp_path: Path) -> None:
    builder = arm(split=False)
    builder.description["nodes"][0]["scale"] = HIDDEN
    del builder.description["animations"]
    with pytest.raises(
        MeshFileError, match="none of its faces has an area in its rest pose; check"
    ):
        read_character(builder.write(tmp_path / "hero.glb"))
