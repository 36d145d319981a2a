"""Scenes of several bodies on the command line: ``--with``, ``--at``, ``--fixed``, ``--ground``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import open_body
from lcollision_core.bodies.motions import read_motions
from lcollision_core.bodies.scene_file import body_of_scene
from lcollision_core.jobs import Job
from lcollision_core.options import MotionChoice, SceneOptions
from lcollision_core.tasks.opening import open_any
from lcollision_core.tasks.scenes import (
    export_scene_motion,
    playing,
    scene_motion,
    scene_of,
    write_member_motions,
)
from tests.app.support import Lcollision, refusal
from tests.core.fbx_builder import character_fbx
from tests.core.motion.swings import CLIP, OTHER, swinging_body
from tests.rigged_shapes import rigged_body, write_gltf
from tests.skeletons import PERSON, character_from


@pytest.fixture(scope="module")
def hero(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a character with a clip of 8 frames."""
    return write_gltf(rigged_body(n_frames=8), tmp_path_factory.mktemp("body") / "hero.glb")


def test_two_bodies_are_checked_and_resolved_each_to_its_own_file(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    villain = tmp_path / "villain.glb"
    villain.write_bytes(hero.read_bytes())
    scene = ["--with", villain, "--at", "villain=0.5,0.02,0,180", "--ground"]
    checked = lcollision("check", "--json", hero, *scene)
    assert checked.exit_code == 1
    (row,) = json.loads(checked.stdout)
    assert row["pairs"] > 0
    assert all("hero: " in part and "villain: " in part for part in row["parts"])
    out = tmp_path / "out"
    resolved = lcollision("resolve", hero, *scene, "-o", f"{out}/")
    assert resolved.exit_code == 0, resolved.output
    assert sorted(path.name for path in out.iterdir()) == ["hero.glb", "villain.glb"]
    again = ["--with", out / "villain.glb", *scene[2:]]
    assert lcollision("check", out / "hero.glb", *again).exit_code == 0


def test_a_learned_model_is_checked_beside_a_character(lcollision: Lcollision, hero: Path) -> None:
    far = lcollision("check", "--json", hero, "--with", "body", "--at", "body=50,0,0")
    assert far.exit_code == 0, far.output
    near = lcollision("check", "--json", hero, "--with", "body")
    assert near.exit_code == 1
    (row,) = json.loads(near.stdout)
    assert row["vertices"] == open_body(hero).n_vertices + open_body("body").n_vertices
    assert all("hero: " in part and "body: " in part for part in row["parts"])


def test_random_poses_of_a_scene_are_written_body_by_body(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    poses, out = tmp_path / "poses.json", tmp_path / "out"
    scene = ["--with", hero, "--at", "hero 2=1.5,0,0"]
    drawn = lcollision("sample", hero, *scene, "--fixed", "hero 2", "-n", 1, "--free", "-o", poses)
    assert drawn.exit_code == 0, drawn.output
    assert lcollision("decode", hero, poses, *scene, "-o", f"{out}/").exit_code == 0
    first, second = (open_any(out / name).reference for name in ("hero.glb", "hero 2.glb"))
    rest = open_body(hero).reference
    assert np.abs(first - rest).max() > 0.1
    # A fixed body is at rest, and its file has its own coordinates.
    np.testing.assert_allclose(second, rest, atol=1e-6)
    scene_file = tmp_path / "scene.json"
    described = {"format": "lcollision-scene", "format_version": 1, "bodies": [{"file": str(hero)}]}
    scene_file.write_text(json.dumps(described))
    info = lcollision("info", scene_file, "--json")
    assert json.loads(info.stdout)["vertices"] == len(rest)
    scene_file.write_text(json.dumps(described | {"ground": "rest"}))
    assert "posed by the joints of hero.glb, without" in lcollision("info", scene_file).stdout


def test_each_pose_of_a_body_in_a_scene_is_reported_by_name(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    poses, out = tmp_path / "poses.json", tmp_path / "out"
    assert lcollision("sample", hero, "-n", 2, "-o", poses).exit_code == 0
    scene = ["--with", hero, "--at", "hero 2=1.5,0,0"]
    resolved = lcollision("resolve", hero, poses, *scene, "--json", "-o", f"{out}/")
    rows = json.loads(resolved.stdout)
    assert [row["source"] for row in rows] == [f"{poses}: scene {number}" for number in (1, 2)]
    assert sorted(path.name for path in out.iterdir()) == ["scene 1", "scene 2"]
    # Poses of the scene, or of its first body, are checked like a motion.
    in_scene = tmp_path / "scene.json"
    assert lcollision("resolve", hero, poses, *scene, "-o", in_scene).exit_code == 0
    for file, energies in ((in_scene, [0.0, 0.0]), (poses, [row["energy_before"] for row in rows])):
        checked = lcollision("check", "--clips", "--json", file, "--body", hero, *scene)
        (row,) = json.loads(checked.stdout)
        assert row["frames"] == 2
        colliding = [frame["frame"] for frame in row["colliding_frames"]]
        assert colliding == [number for number, energy in enumerate(energies) if energy > 0.0]


def test_a_motion_of_the_first_body_is_checked_in_its_scene(
    lcollision: Lcollision, hero: Path
) -> None:
    scene = ["--with", hero, "--at", "hero 2=0.9,0.02,0,180", "--json"]
    own = lcollision("check", "--clips", hero, *scene)
    played = lcollision("check", "--clips", hero, "--body", hero, *scene)
    assert json.loads(played.stdout) == json.loads(own.stdout)
    with_joints = lcollision("check", "--clips", hero, "--body", hero, "--joints", "a.json", *scene)
    assert with_joints.exit_code == 2
    assert "isn't a rigged character, so --joints doesn't apply" in with_joints.stderr


def test_a_clip_is_chosen_also_in_a_motion_file(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    swing = write_gltf(swinging_body(), tmp_path / "swing.glb")
    other = tmp_path / "other.glb"
    other.write_bytes(swing.read_bytes())
    scene = ["--with", hero, "--at", "hero=9,0,0", "--json"]
    for clip in (CLIP, OTHER):
        done = lcollision("check", "--clips", other, "--body", swing, *scene, "--clip", clip)
        (row,) = json.loads(done.stdout)
        assert (row["clip"], bool(row["colliding_frames"])) == (f"{clip} + moves", clip == CLIP)
    unknown = lcollision("check", "--clips", other, "--body", swing, *scene, "--clip", "wave")
    assert "has no clip 'wave'; its clips are 'swing', 'nod', 'moves'" in unknown.stderr


@pytest.mark.slow
def test_clips_play_together_from_when_they_are_said_to(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    clip = open_body(hero).own_clips[0]
    scene = ["--with", hero, "--at", "hero 2=0.9,0.02,0,180", "--play", f"hero 2={clip}@0.1"]
    checked = lcollision("check", "--clips", "--json", hero, *scene)
    (row,) = json.loads(checked.stdout)
    assert row["frames"] == 8 + round(0.1 * row["fps"])
    out = tmp_path / "out"
    resolved = lcollision("resolve", "--motion", hero, *scene, "-o", f"{out}/", "--json")
    (after,) = json.loads(resolved.stdout)
    assert after["frames"] == row["frames"]
    assert after["free_after"] >= after["free_before"]
    # The first one gives way to the second one after the end of its own clip.
    for name, n_frames in (("hero.glb", row["frames"]), ("hero 2.glb", 8)):
        (motion,) = read_motions(open_body(out / name), out / name)
        assert len(motion) == n_frames
        assert np.isfinite(motion.codes).all()


def test_copies_in_the_same_place_are_named(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    same = (
        "hero 2: it stands exactly where hero does, and faces that coincide do not collide; move "
        "it with --at"
    )
    scene = (hero, "--with", hero)
    checked = lcollision("check", "--clips", *scene)
    assert same in checked.stderr
    assert same in lcollision("resolve", *scene, "-o", f"{tmp_path}/out/").stderr
    later = lcollision("check", "--clips", *scene, "--at", "hero 2=0.9,0.02,0,180")
    assert "stands exactly" not in later.stderr


def test_a_written_scene_plays_as_it_was_reported_when_one_clip_ends_first(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    short = write_gltf(rigged_body(n_frames=3), tmp_path / "short.glb")
    out, place = tmp_path / "out", ("--at", "short=0.9,0.02,0,180")
    resolved = lcollision(
        *("resolve", "--motion", "--json", hero, "--with", short, *place, "-o", f"{out}/")
    )
    (row,) = json.loads(resolved.stdout)
    again = ("--clips", "--json", out / "hero.glb", "--with", out / "short.glb", *place)
    (played,) = json.loads(lcollision("check", *again).stdout)
    assert played["frames"] == row["frames"] == 8
    assert row["free_after"] > row["free_before"]
    colliding = [frame["frame"] for frame in played["colliding_frames"]]
    assert colliding == row["colliding_frames"]
    (longer,) = read_motions(open_body(out / "short.glb"), out / "short.glb")
    assert len(longer) > 3


def test_a_motion_without_its_body_is_refused_in_a_scene(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    walk, out = tmp_path / "walk.bvh", tmp_path / "out"
    assert lcollision("resolve", "--motion", hero, "-o", walk).exit_code == 0
    scene = ("--with", hero, "--at", "hero 2=3,0,0")
    refused = refusal(lcollision, "resolve", hero, walk, *scene, "-o", f"{out}/")
    assert refused.endswith(
        f"walk.bvh is a motion, not a body of the scene; assign it with --play 'hero={walk}'"
    )
    # Unity names motions like this.
    play = ("--play", f"hero={walk.rename(tmp_path / 'hero@walk.bvh')}")
    assert lcollision("resolve", "--motion", hero, *scene, *play, "-o", f"{out}/").exit_code == 0
    for command in (("check", "--clips"), ("resolve", "--motion", "-o", f"{out}/")):
        refused = refusal(lcollision, *command, hero, *scene, "--clip", "wlak")
        assert refused.endswith(
            f"has no clip 'wlak'; its clips are {open_body(hero).own_clips[0]!r}"
        )


def test_what_moves_before_a_clip_starts_is_reported_as_it_is_played(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    clip, out = open_body(hero).own_clips[0], tmp_path / "out"
    place = ("--at", "hero 2=0.9,0.02,0,180", "--play", f"hero 2={clip}@0.15")
    resolved = lcollision(
        *("resolve", "--motion", "--json", hero, "--with", hero, *place, "-o", f"{out}/")
    )
    (row,) = json.loads(resolved.stdout)
    again = ("--clips", "--json", out / "hero.glb", "--with", out / "hero 2.glb", *place)
    (played,) = json.loads(lcollision("check", *again).stdout)
    assert [frame["frame"] for frame in played["colliding_frames"]] == row["colliding_frames"]
    note = "hero 2: until its clip starts, it stays in the first frame"
    assert note in resolved.stderr
    reasons = {span["reason"] for span in row["kept_spans"]}
    assert "the clip of a body that should move starts later" in reasons


def test_an_export_says_what_moves_before_a_clip_starts(hero: Path, tmp_path: Path) -> None:
    options = SceneOptions(others=(str(hero),), places=("hero 2=2,0,0",))
    clip = open_body(hero).own_clips[0]
    body = body_of_scene(playing(scene_of(str(hero), options), 1, clip, 0.15))
    before, _ = scene_motion(body, (), MotionChoice())
    codes = before.codes.copy()
    own = body.space.codes[1]
    # Into the other hero, until its clip starts.
    codes[:2, own[0]] -= 1.1
    assert not replace(before, codes=codes).are_free(body.exact_check())[:2].any()
    said = export_scene_motion(tmp_path / "out", body, before, replace(before, codes=codes), Job())
    assert said == (
        "Exported each body to out; hero 2: until its clip starts, it stays in the first frame"
    )
    file = tmp_path / "out" / "hero 2.glb"
    (written,), (own_clip,) = (read_motions(open_body(path), path) for path in (file, hero))
    np.testing.assert_allclose(written.codes, own_clip.codes, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--fixed", "hero"], "--fixed is for scenes"),
        (["--ground", "--fixed", "nobody"], "names 'nobody', which is not in the scene"),
        (["--ground", "--at", "hero=1,2"], "is not NAME=X,Y,Z"),
        (["--ground=low"], "--ground must be a height"),
    ],
)
def test_options_of_scenes_that_say_nothing_are_refused(
    lcollision: Lcollision, hero: Path, tmp_path: Path, options: list[str], sentence: str
) -> None:
    result = lcollision("resolve", hero, "-o", tmp_path / "out/", *options)
    assert result.exit_code == 2
    assert sentence in result.stderr


def test_a_motion_says_how_it_stands_on_the_ground(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    command = ("check", "--clips", hero, "--json")
    (row,) = json.loads(lcollision(*command).stdout)
    assert row["ground"] is None
    (on_ground,) = json.loads(lcollision(*command, "--ground").stdout)
    # The ground is raised.
    size, rest = open_body(hero).body_size, open_body(hero).reference[:, open_body(hero).up_axis]
    raised = float(rest.min()) + 0.02 * size
    deep = lcollision(*command, "--ground", raised)
    assert deep.exit_code == 1
    (sunk,) = json.loads(deep.stdout)
    higher = sunk["ground"]["sink"] - on_ground["ground"]["sink"]
    assert higher == pytest.approx(0.02, abs=1e-3)
    told = lcollision("check", "--clips", hero, "--ground", raised).stdout
    assert "sinks into the ground by " in told
    out = f"{tmp_path / 'out'}/"
    resolved = lcollision("resolve", "--motion", hero, "--ground", raised, "-o", out, "--json")
    (after,) = json.loads(resolved.stdout)
    assert after["ground"]["sink"] < sunk["ground"]["sink"]


@pytest.mark.parametrize("what", [[], pytest.param(["--motion"], marks=pytest.mark.slow)])
def test_no_file_of_a_body_is_replaced_unless_in_place(
    lcollision: Lcollision, hero: Path, tmp_path: Path, what: list[str]
) -> None:
    mine, villain = tmp_path / "hero.glb", tmp_path / "villain.glb"
    for path in (mine, villain):
        path.write_bytes(hero.read_bytes())
    before = hero.read_bytes()
    scene = [mine, *what, "--with", villain, "--at", "villain=0.9,0.02,0,180"]
    for output in (f"{tmp_path}/", *([] if what else [villain])):
        result = lcollision("resolve", *scene, "-o", output)
        assert result.exit_code == 2
        assert "--in-place" in result.stderr
        assert [path.read_bytes() for path in (mine, villain)] == [before, before]
    result = lcollision("resolve", *scene, "-o", f"{tmp_path}/", "--in-place")
    assert result.exit_code in (0, 1), result.output
    assert villain.read_bytes() != before


@pytest.mark.slow
def test_scenes_of_a_character_are_free_also_by_vtk(lcollision: Lcollision, tmp_path: Path) -> None:
    human = write_gltf(character_from(PERSON), tmp_path / "human.glb")
    result = lcollision("benchmark", "scenes", human, "--json")
    assert result.exit_code == 0, result.output
    rows = {row["scene"]: row for row in json.loads(result.stdout)}
    assert len(rows) == 6
    assert all(row["pairs"] > 0 for row in rows.values())
    crossing = {name for name, row in rows.items() if row["foreign"]}
    assert crossing >= {"hand in hand", "fist in chest", "sword in thigh"}
    assert not any(row["pairs_after"] for row in rows.values())
    # The grip stays in the hand.
    assert [name for name, row in rows.items() if row["foreign_after"]] == ["sword in thigh"]


def test_what_the_clip_of_a_body_cannot_hold_is_reported(hero: Path, tmp_path: Path) -> None:
    swing = write_gltf(swinging_body(), tmp_path / "swing.glb")
    others = SceneOptions(others=(str(swing),), places=("swing=9,0,0",))
    body = body_of_scene(playing(scene_of(str(hero), others), 1, CLIP, 1.0))
    before, played = scene_motion(body, (), MotionChoice())
    first, places = played[1].start, body.space.codes[1]
    assert first > 0
    codes = before.codes.copy()
    # One span is deeper than before, which the file refuses.
    deeper = slice(first + 20, first + 28)
    codes[deeper, places] += 0.2 * (codes[deeper, places] - codes[first, places])
    after, out = replace(before, codes=codes), tmp_path / "out"
    written = write_member_motions(out, body, before, after, played)
    assert written.put_back == [range(first + 20, first + 28)]
    np.testing.assert_allclose(written.stored.codes, before.codes, atol=1e-6)
    collides = ~before.are_free(body.exact_check())
    said = export_scene_motion(out, body, before, after, Job())
    assert said == f"Exported each body to out; {collides.sum()} frames collide"


def test_the_clip_of_an_fbx_is_reported_as_it_is_stored(
    lcollision: Lcollision, hero: Path, tmp_path: Path
) -> None:
    pytest.importorskip("ufbx")
    rigged = rigged_body(n_frames=8)
    assert rigged.rig is not None
    # Retargeting does not match joints of these names.
    names = tuple(f"bone {number}" for number in range(len(rigged.rig.joint_names)))
    rigged = replace(rigged, rig=replace(rigged.rig, joint_names=names))
    source, out = character_fbx(rigged, tmp_path / "other.fbx"), tmp_path / "out"
    still = character_fbx(replace(rigged, clips={}), tmp_path / "still.fbx")
    scene = ("--with", hero, "--at", "hero=90,0,0", "--with", still, "--at", "still=180,0,0")
    done = lcollision("resolve", source, *scene, "--motion", "-o", f"{out}/", "--json")
    assert done.exit_code == 0, done.output
    assert sorted(path.name for path in out.iterdir()) == ["hero.glb", "other.glb", "still.glb"]
    for name in ("other", "still"):
        assert f"{name}: FBX can't be written, so {name}.fbx comes back as GLB" in done.stderr
    (row,) = json.loads(done.stdout)
    assert row["free_after"] == row["frames"]
    assert row["kept_spans"] == []
