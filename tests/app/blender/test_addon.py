"""The Blender add-on in real Blender, without a window: poses."""

from __future__ import annotations

import io
import json
import re
import signal
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from app.blender_addon import addon_zip
from lcollision_core.bodies import open_body
from tests.app.blender.running import in_blender
from tests.app.support import Lcollision
from tests.core.motion.swings import CLIP, N_FRAMES, OTHER, swinging_body
from tests.independent_check import crossing_pairs
from tests.rigged_shapes import write_gltf

pytestmark = pytest.mark.slow

FREE = "No collisions (checked)"


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gltf(swinging_body(), tmp_path_factory.mktemp("body") / "body.glb")


@pytest.fixture(scope="module")
def forest(body: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return in_blender(tmp_path_factory.mktemp("forest"), "forest", body)


def crossing_the_arm(told: Any, points: Any) -> int:
    """Count, independently, the crossing faces of the left arm and the rest.

    They are far apart at rest, so no contact rule excludes them.
    """
    faces = np.array(told["faces"])
    owner = np.array([name.startswith("Left") and "Leg" not in name for name in told["groups"]])
    feet = np.array(["Foot" in name or "Toe" in name for name in told["groups"]])
    of_arm = (owner & ~feet)[faces].all(axis=1)
    return sum(
        bool(of_arm[a] != of_arm[b]) for a, b in crossing_pairs(np.array(points, float), faces)
    )


def n_pairs(said: Any) -> int:
    found = re.match(r"Colliding: (\d+) pairs? of faces", said["verdict"])
    assert found, said
    return int(found[1])


def test_the_file_holds_all_that_the_add_on_needs(lcollision: Lcollision, tmp_path: Path) -> None:
    path = tmp_path / "lcollision.zip"
    assert lcollision("blender-addon", "-o", path).exit_code == 0
    assert path.read_bytes() == addon_zip()
    with zipfile.ZipFile(io.BytesIO(addon_zip())) as file:
        names = set(file.namelist())
        manifest = tomllib.loads(file.read("blender_manifest.toml").decode())
        engine = json.loads(file.read("engine.json"))
        licence = file.read("LICENSE").decode()
        client = file.read("client.py").decode()
        assert "Apache" in file.read("msgpack/COPYING").decode()
    assert {"__init__.py", "panel.py", "operators.py", "msgpack/fallback.py"} <= names
    assert manifest["license"] == ["SPDX:GPL-3.0-or-later"]
    assert manifest["blender_version_min"] == "4.2.0"
    assert engine["python"] == sys.executable
    assert "for this folder alone" in licence
    assert "GNU GENERAL PUBLIC LICENSE" in licence
    assert "from . import msgpack" in client
    assert "lcollision_core" not in client
    sources = [name for name in names if name.endswith(".py") and "/" not in name]
    with zipfile.ZipFile(io.BytesIO(addon_zip())) as file:
        texts = {name: file.read(name).decode() for name in sources}
    jargon = re.compile(r"slider|\btrained|\bmodels?\b")
    assert [name for name, text in texts.items() if jargon.search(text)] == []


def test_a_pose_is_resolved_and_undone(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "resolve_pose", body, 105)
    assert told["rest"]["verdict"] == FREE
    assert told["rest"]["off_rig"] < 1e-6
    assert n_pairs(told["before"]) > 20
    assert "Torso and Left upper arm" in told["before"]["details"]
    assert crossing_the_arm(told, told["points_before"]) > 20
    assert told["after"]["verdict"] == told["again"]["verdict"] == FREE
    assert crossing_the_arm(told, told["points"]) == 0
    assert told["changed"]
    assert told["undone"]


def test_units_scales_and_mirrored_objects_do_not_matter(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "scales", body)
    assert len(told) == 4
    for name, one in told.items():
        assert one["rest"] == FREE, name
        assert n_pairs({"verdict": one["before"]}) > 20, name
        assert one["after"] == FREE, name
        assert crossing_the_arm(one, one["points"]) == 0, name


@pytest.mark.parametrize("kind", ["COPY_ROTATION", "IK"])
def test_what_constraints_move_is_resolved_on_a_baked_copy(
    body: Path, tmp_path: Path, kind: str
) -> None:
    told = in_blender(tmp_path, "constrained", body, kind)
    assert n_pairs(told["before"]) > 0
    assert told["said"] == "Writes to a baked copy: bones have constraints or drivers"
    assert told["after"]["verdict"] == FREE
    assert crossing_the_arm(told, told["points"]) == 0
    assert told["copy"].endswith(".free")
    assert told["meshes"] == ["Body.free"]
    assert told["constraints"] == 0
    assert told["original"]
    assert told["is_hidden"]
    assert told["frames"]
    assert 1 not in told["frames"]
    assert told["action"] == "No collisions in 11 frames (checked)"
    assert ".free" in told["baked"]


def test_what_drivers_turn_is_checked_as_it_is_shown_and_resolved_on_a_copy(
    body: Path, tmp_path: Path
) -> None:
    told = in_blender(tmp_path, "driven", body)
    assert told["raised"]["verdict"] == FREE
    assert n_pairs(told["lowered"]) > 20
    assert crossing_the_arm(told, told["points_before"]) > 20
    assert "label: Writes to a baked copy: bones have constraints or drivers" in told["panel"]
    assert told["after"]["verdict"] == FREE
    assert crossing_the_arm(told, told["points"]) == 0
    assert told["copy"].endswith(".free")
    assert told["drivers"] == [3, 0]
    assert told["original"]


def test_a_clearance_is_checked_and_kept(body: Path, tmp_path: Path) -> None:
    metres = 0.01
    told = in_blender(tmp_path, "clearance", body, CLIP, metres)
    assert told["touching"]["verdict"] == FREE
    assert told["near"]["verdict"].startswith("Too near: ")
    assert told["near"]["details"][0].startswith("Short by ")
    assert any(line.startswith("prop: ") and line.endswith(" clearance") for line in told["panel"])
    assert told["kept"]["verdict"] == "The clearance is kept (checked)"
    # Independently: the distance of the arm's vertices from all others that are far at rest.
    points, groups = np.array(told["points"]), np.array(told["groups"])
    arm, trunk = points[groups == "LeftForeArm"], points[np.isin(groups, ["Spine", "Hips"])]
    assert np.linalg.norm(arm[:, None] - trunk[None], axis=2).min() > metres
    assert told["action"].endswith("frames come too near")
    assert told["resolved"] == f"The clearance is kept in {N_FRAMES} frames (checked)"


def test_shape_keys_and_modifiers_are_part_of_what_is_checked(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "shape_keys", body)
    assert told["plain"]["off_rig"] < 1e-6
    assert told["key"]["off_rig"] < 1e-6
    assert n_pairs(told["key"]) != n_pairs(told["plain"])
    assert n_pairs(told["modifier"]) != n_pairs(told["key"])
    assert told["again"]["off_rig"] > 1e-4
    assert told["after"]["verdict"] == told["again"]["verdict"] == FREE
    assert crossing_the_arm(told, told["points"]) == 0


def test_several_meshes_on_one_armature_are_one_character(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "several_meshes", body)
    assert told["meshes"] == 8
    assert n_pairs(told["split"]) == n_pairs(told["whole"])
    assert told["after"]["verdict"] == FREE
    assert {"Body", "Body.001"} <= set(told["groups"])


def crossing_the_staff(told: Any) -> int:
    """Count, independently, the faces of the staff that cross faces other than the hand's."""
    faces, groups = np.array(told["faces"]), np.array(told["groups"])
    is_staff = (faces >= len(groups) - STAFF_VERTICES).all(axis=1)
    is_hand = (groups == "LeftHand")[faces].any(axis=1) & ~is_staff
    return sum(
        bool(is_staff[a] != is_staff[b] and not is_hand[a] and not is_hand[b])
        for a, b in crossing_pairs(np.array(told["points"], float), faces)
    )


STAFF_VERTICES = 8
"""The staff is a box, and the last mesh by name."""


def test_what_bones_carry_is_checked_listed_and_left_out_if_unticked(
    body: Path, tmp_path: Path
) -> None:
    told = in_blender(tmp_path, "carried_meshes", body)
    assert told["rest"]["verdict"] == FREE
    assert {"prop: Body", "prop: Hat", "prop: Staff"} <= set(told["panel"])
    assert n_pairs(told["lowered"]) > 0
    assert crossing_the_staff(told["before"]) > 0
    # An independent check finds the counted pairs and those that the rules leave out.
    crossing = crossing_pairs(
        np.array(told["before"]["points"], float), np.array(told["before"]["faces"])
    )
    left_out = sum(told["counts"]["left_out"].values())
    assert left_out > 0
    assert n_pairs(told["lowered"]) == told["counts"]["pairs"]
    assert len(crossing) == told["counts"]["pairs"] + left_out
    assert re.search(r"\d+ pairs? .*not counted", told["lowered"]["details"][-1])
    assert told["unticked"]["verdict"] == "No collisions (checked without 1 mesh)"
    assert "prop: Staff" in told["panel_without"]
    assert "label: Not checked: Staff (not ticked)" in told["panel_without"]
    assert told["hidden"]["verdict"] == "No collisions (checked without 2 meshes)"
    assert told["resolved"]["verdict"] == FREE
    assert crossing_the_staff(told["after"]) == 0
    # A copy is written: everything that bones carry is copied, and the originals are not rendered.
    assert told["baked"]["verdict"] == "No collisions (checked without 1 mesh)"
    assert told["carried"] == [
        ["Hat.free", "Head"],
        ["Lantern.free", "LeftHand"],
        ["Staff.free", "LeftHand"],
    ]
    assert told["left"] == told["rendered"] == []
    assert len(told["copies"]) == 5
    assert crossing_the_staff(told["baked_after"]) == 0


@pytest.mark.parametrize("kind", ["control", "between", "roots"])
def test_limbs_on_bones_that_do_not_deform_follow_the_trunk(forest: Any, kind: str) -> None:
    told = forest[kind]
    roots = [name for name, above in told["parents"].items() if above is None]
    assert roots == ["Hips"]
    assert told["parents"]["LeftArm"] == "Spine"
    assert n_pairs(told["before"]) > 20
    assert told["after"]["verdict"] == FREE
    assert crossing_the_arm(told, told["points"]) == 0
    assert told["trunk_turns"]
    assert told["apart"] < 1e-5


@pytest.fixture(scope="module")
def moved(body: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return in_blender(tmp_path_factory.mktemp("moved"), "moved_besides", body)


@pytest.mark.parametrize(
    ("kind", "besides"),
    [
        ("Subdivision", ["Subdivision of Body"]),
        ("Smooth", ["Smooth of Body"]),
        ("Mirror", ["Mirror of Body"]),
        ("Preserve Volume", ["Preserve Volume of Body"]),
        ("scaled", ["the scale of Spine", "the scale of LeftArm"]),
        ("not inherited", []),
    ],
)
def test_one_press_goes_on_until_what_blender_shows_is_free(
    moved: Any, kind: str, besides: list[str]
) -> None:
    told = moved[kind]
    assert n_pairs(told["before"]) > 20
    assert [one["verdict"] for one in told["presses"]] == [FREE, FREE]
    assert told["besides"] == besides


def test_the_live_check_follows_the_newest_pose(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "live", body, tmp_path)
    assert [one.split(":")[0] for one in told["verdicts"]] == [FREE, "Colliding", FREE]
    assert told["shown"][0] == told["shown"][2] == 0
    assert told["shown"][1] > 0
    assert told["shown"][1] % 3 == 0
    assert "_on_update" not in told["handlers"]
    # A file loaded with the live check on is checked, without the previous file's faces.
    loaded = told["loaded"]
    assert (loaded["shown"], loaded["handlers"], loaded["timer"]) == (0, ["_on_update"], True)
    assert loaded["verdict"].startswith("Colliding")
    assert loaded["shown_again"] > 0
    assert loaded["shown_off"] == 0


def test_the_live_check_follows_changed_rules_and_meshes(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "changed_character", body)
    assert told["first"].startswith("Colliding")
    assert told["ignored"] == FREE
    assert told["rules"] == [["LeftFoot", "RightFoot"], ["Body", "Body"]]
    assert told["counted"] == told["first"]
    assert told["divided"].startswith("Colliding")
    assert told["divided"] != told["first"]
    assert told["is_on"]
    assert told["off_rig_live"] == told["off_rig"] < 1e-6
    assert told["open"] == [1, 1]


def test_the_panel_draws_what_was_found(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "panel", body)
    assert told["empty"] == ["label: Make a mesh with an armature active"]
    assert "operator: lcollision.resolve_pose" in told["new"]
    assert "label: Not checked yet" in told["new"]
    assert "label: Writes to the deforming bones" in told["new"]
    assert any(line.startswith("label: Colliding: ") for line in told["colliding"])
    assert "label: Torso and Left upper arm" in told["colliding"]
    assert "label: 1 bone keeps its rotation (locked)" in told["colliding"]
    assert {"torso", "LeftArm", "sleeve"} <= set(told["groups"])
    assert "Torso" not in told["groups"]
    assert told["too_wide"] == []
    said = " ".join(told["all"])
    assert "Shape keys, modifiers or constraints move the mesh by" in said
    assert "label: 1 place not counted" in told["all"]
    assert "Choose two groups" in told["refused"]
    assert told["ignored"]["verdict"] == FREE
    assert any("sleeve and Body" in line for line in told["rules"])
    assert n_pairs(told["counted"]) > 0
    assert any(line.startswith("template_list") for line in told["listed"])
    assert told["item"] == ["label: 7", "label: 1.00 %", "label: Torso and Left hand"]


def test_locked_bones_stay_and_auto_keying_keys_in_each_rotation_mode(
    body: Path, tmp_path: Path
) -> None:
    told = in_blender(tmp_path, "locked_and_keyed", body)
    assert n_pairs(told["before"]) > 0
    assert told["after"]["verdict"] == told["keyed"]["verdict"] == FREE
    assert told["spine"]
    assert "LeftArm" in told["turned"]
    for name in told["turned"]:
        assert any(f'"{name}"' in path and "rotation" in path for path in told["keys"]), name
    assert {key[0] for keys in told["keys"].values() for key in keys} == {12.0}


def test_a_still_shows_what_crosses_in_red_and_nothing_once_it_is_resolved(
    body: Path, tmp_path: Path
) -> None:
    told = in_blender(tmp_path, "still", body, tmp_path)
    assert told["verdict"] == FREE
    pixels = [np.asarray(Image.open(tmp_path / f"{one}.png"), int) for one in ("before", "after")]
    red = [int((one[..., 0] > 2 * one[..., 1:3].max(axis=-1)).sum()) for one in pixels]
    assert red[0] > 200
    assert red[1] == 0


def test_what_cannot_be_is_said(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "errors", body)
    assert "Make a mesh with an armature active" in told["no character"]
    assert "has no action; make one active" in told["no action"]
    assert "No visible mesh is deformed by" in told["no mesh"]
    assert "cannot start /nowhere/python" in told["no engine"]
    assert told["again"]["verdict"] == told["enabled"]["verdict"] == FREE
    assert told["disabled"]


def test_an_action_is_resolved_on_a_copy_and_undone(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(begin=0.3), tmp_path / "body.glb")
    told = in_blender(tmp_path, "resolve_action", source, CLIP, N_FRAMES, tmp_path)
    before, after = (np.load(tmp_path / f"{name}.npy") for name in ("before", "after"))
    frames = range(N_FRAMES)
    crossing = [at for at in frames if crossing_the_arm(told, before[at])]
    assert told["colliding"] == told["markers"] == crossing
    assert 0 < len(crossing) < N_FRAMES
    assert told["jumped"] == crossing[1]
    assert told["frame"] == 3
    assert told["colliding_after"] == []
    assert told["verdict"] == f"No collisions in {N_FRAMES} frames (checked)"
    assert [at for at in frames if crossing_the_arm(told, after[at])] == []
    assert (told["old"], told["new"]) == (CLIP, f"{CLIP}.free")
    assert told["old_is_untouched"]
    assert told["undone"]
    assert told["actions"] == sorted([CLIP, OTHER])


def test_a_resolution_is_cancelled_and_leaves_nothing(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(begin=0.3), tmp_path / "body.glb")
    told = in_blender(tmp_path, "cancelled", source, CLIP)
    assert "Resolving" in told["texts"]
    assert told["action"] == CLIP
    assert told["actions"] == sorted([CLIP, OTHER])
    assert told["frame"] == 3
    assert told["alive"]
    assert told["after"]["verdict"]


@pytest.mark.parametrize("kind", ["cancelled", "engine", "baked"])
def test_a_resolution_whose_check_does_not_end_is_taken_back(tmp_path: Path, kind: str) -> None:
    source = write_gltf(swinging_body(begin=0.3), tmp_path / "body.glb")
    told = in_blender(tmp_path, "failing", source, CLIP, kind)
    assert told["said"] == ("the engine is gone" if kind == "engine" else "cancelled")
    assert told["changed"] == []


@pytest.mark.parametrize("kind", ["turned", "baked"])
def test_a_pose_whose_check_fails_is_taken_back(body: Path, tmp_path: Path, kind: str) -> None:
    told = in_blender(tmp_path, "failing_pose", body, kind)
    assert "the engine is gone" in told["said"]
    assert (told["changed"], told["n"]) == ([], 2)


def test_the_curves_of_an_action_are_those_of_the_slot(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "slots", body, CLIP)
    assert told == [["location"], ['pose.bones["LeftArm"].rotation_quaternion']]


def test_in_a_window_actions_are_done_tick_by_tick_and_escape_ends_them(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(begin=0.3), tmp_path / "body.glb")
    told = in_blender(tmp_path, "modal", source, CLIP)
    for name, said in (("ended", "the engine is gone"), ("gone", "The character is gone")):
        one = told.pop(name)
        assert (one["done"], one["reports"]) == (["CANCELLED"], [["ERROR", said]])
        assert (one["told"][-1], one["timers"], one["going_on"]) == (None, 0, 0)
    for name, one in told.items():
        assert one["passed"] == ["PASS_THROUGH"], name
        assert (one["timers"], one["frame"]) == (0, 0), name
        assert one["told"][-1] is None, name
        assert all("Esc: cancel" in text for text in one["told"][:-1]), name
    assert told["checked"]["done"] == told["resolved"]["done"] == ["FINISHED"]
    assert told["checked"]["reports"][0][1].endswith("frames collide")
    assert "none does now" in told["resolved"]["reports"][0][1]
    assert any(text.startswith("Resolving frames") for text in told["resolved"]["told"][:-1])
    assert told["resolved"]["action"] == f"{CLIP}.free"
    assert (told["escaped"]["done"], told["escaped"]["reports"]) == (["CANCELLED"], [])
    assert told["escaped"]["action"] == CLIP


def test_a_hung_engine_is_ended_and_neither_a_window_nor_its_end_waits(
    body: Path, tmp_path: Path
) -> None:
    told = in_blender(tmp_path, "hung", body)
    for name in ("check_pose", "resolve_pose"):
        done, reports, texts = told[f"LCOLLISION_OT_{name}"]
        assert (done, reports, texts[-1]) == (["CANCELLED"], [], None)
        assert all("Esc: cancel" in text for text in texts[:-1])
    for said in told["said"].values():
        assert "the engine did not answer and was ended; try again" in said
    assert told["ended"] == 3 * [-signal.SIGKILL]
    assert len(told["said"]) == 4
    assert told["again"] == told["first"]
    # The test itself has not turned the arm, up to rounding.
    assert told["moved"] < 1e-5
    assert told["quit"] == -signal.SIGKILL


def test_in_a_window_a_pose_is_resolved_with_progress_unless_it_changes_meanwhile(
    body: Path, tmp_path: Path
) -> None:
    told = in_blender(tmp_path, "modal_pose", body)
    moved, resolved = told["moved"], told["resolved"]
    assert (moved["done"], moved["changed"]) == (["CANCELLED"], False)
    assert "The pose has changed meanwhile; nothing was written" in moved["reports"][0][1]
    assert (resolved["done"], resolved["changed"]) == (["FINISHED"], True)
    assert resolved["reports"][0][1].startswith("Resolved ")
    assert resolved["told"][-1] is None
    assert any(text.startswith("Resolving the pose") for text in resolved["told"][:-1])
    assert told["after"] == FREE


def test_what_is_no_longer_so_is_taken_back_at_once(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(begin=0.3), tmp_path / "body.glb")
    told = in_blender(tmp_path, "stale", source, CLIP)
    for change in ("pose", "frame", "key", "button", "undone"):
        before, after = told[change]
        assert before[0].startswith("Colliding: "), change
        assert before[1] > 0, change
        assert after == ["Not checked yet", 0, 0.0], change
    assert told["kept"][0].startswith("Colliding: ")
    assert told["kept"][1] > 0
    # While another object is active.
    assert told["active"][1][1] == 0
    frames, jumped, n_markers = told["frames"]
    assert jumped == [frames[3], frames[2], frames[1]]
    assert n_markers == len(frames)
    assert told["action"].endswith("frames collide")
    assert told["cleared"] == [0, 0]
    coloured, grey, again = told["live"]
    assert coloured > 1
    assert grey == 1
    assert again > 1
    assert told["scenes"] == [True, True, True, False, False, False, False, True, True]


def test_what_the_window_offers_the_panel_offers_too(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(begin=0.3), tmp_path / "body.glb")
    told = in_blender(tmp_path, "options", source, CLIP)
    deep, shallow, n = told["colours"]
    assert deep < 0.1 < 0.6 < shallow
    assert n > 2
    assert "No deforming bone is selected: select some in Pose Mode" in told["none"]
    verdict, turned = told["selected"]
    assert verdict == FREE
    assert set(turned) <= {"LeftArm", "LeftForeArm"}
    assert told["tolerated"] == FREE
    # Verdicts on a pose and on an action say what they leave out.
    assert re.fullmatch(
        r"\d+ pairs? not deeper than [\d.]+ (is|are) not counted", told["not_counted"]
    )
    verdict, left_out = told["action_not_counted"]
    assert verdict.startswith("No collisions in ")
    said = re.fullmatch(
        r"Not counted: (\d+) pairs in (\d+) frames, up to ([\d.]+) % deep", left_out
    )
    assert said is not None
    assert all(float(number) > 0.0 for number in said.groups())
    assert re.match(r"10 of 10 poses collide; without \d+ places? .*, none", told["proposed"][0])
    assert told["proposed"][1] > 0
    assert told["tint"][2] == 1.0
    assert told["ignored"] == FREE
    assert told["counted"]
    frames, within, verdict = told["range"]
    assert within == [frame for frame in frames if frame <= frames[len(frames) // 2]]
    assert verdict == f"No collisions in {within[-1] - frames[0] + 1} frames (checked)"
    assert set(within) <= set(told["moved"])
    assert min(told["moved"]) >= frames[0]
    assert max(told["moved"]) <= within[-1]


def test_a_mesh_that_changes_with_the_pose_is_said_in_words(body: Path, tmp_path: Path) -> None:
    told = in_blender(tmp_path, "decimated", body)
    assert len(told) == 4
    for said in told.values():
        assert re.search(r"Body is shown with \d+ vertices and has \d+ in the rest pose", said)
        assert "Decimate" in said
        assert "turn it off in the viewport" in said


def in_file_order(body: Any, points: Any) -> Any:
    """Return (..., V, 3) vertices of a character in its file's axes and order.

    Blender is z up, glTF y up; the importer keeps the order of the file's vertices.
    """
    joined = body.character.joined
    turned = np.asarray(points)[..., [0, 2, 1]] * [1.0, 1.0, -1.0]
    assert turned.shape[-2] == len(joined)
    vertices = np.empty((*turned.shape[:-2], body.n_vertices, 3), np.float32)
    vertices[..., joined, :] = turned
    return vertices


REAL = pytest.mark.parametrize("name", ["mannequin-moves", "xbot-moves"])


@REAL
def test_poses_of_real_characters_are_resolved(characters: Path, tmp_path: Path, name: str) -> None:
    source = characters / f"{name}.glb"
    told = in_blender(tmp_path, "resolve_pose", source, 100)
    assert told["rest"]["verdict"] == FREE
    assert n_pairs(told["before"]) > 100
    assert told["after"]["verdict"] == FREE
    assert told["undone"]
    # In the file's order and by its rules, without the add-on.
    body = open_body(source)
    check = body.exact_check()
    assert check.find(in_file_order(body, told["points_before"])).colliding
    assert not check.find(in_file_order(body, told["points"])).colliding


@REAL
def test_actions_of_real_characters_are_resolved(
    characters: Path, tmp_path: Path, name: str
) -> None:
    source = characters / f"{name}.glb"
    told = in_blender(tmp_path, "resolve_action", source, "moves", 90, tmp_path)
    assert told["verdict"] == "No collisions in 90 frames (checked)"
    assert told["old_is_untouched"]
    assert told["undone"]
    body = open_body(source)
    check = body.exact_check()
    before, after = (
        in_file_order(body, np.load(tmp_path / f"{one}.npy")) for one in ("before", "after")
    )
    assert [at for at in range(90) if check.find(before[at]).colliding] == told["colliding"]
    assert [at for at in range(90) if check.find(after[at]).colliding] == []
    # As smooth as before, in the changed frames and their neighbours.
    moved = np.flatnonzero(np.abs(after - before).max(axis=(1, 2)) > 1e-4)
    near = np.unique([moved - 1, moved, moved + 1])
    near = near[(near >= 1) & (near < 89)] - 1
    old, new = (float((np.diff(one, 2, axis=0)[near] ** 2).sum()) for one in (before, after))
    assert new <= 1.05 * old
