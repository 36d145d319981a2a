"""``lcollision decode --like`` and ``resolve --like``: the user's own file with another pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import (
    LearnedBody,
    NamedPose,
    RigBody,
    open_body,
    read_poses,
    sample_poses,
    write_poses,
)
from lcollision_core.files import read_character, read_mesh, write_mesh
from lcollision_core.files.motion.caches import read_point_cache
from tests.app.support import Lcollision
from tests.core.character_file import described, figure
from tests.core.fbx_builder import character_fbx
from tests.core.motion.swings import CLIP, OTHER, swinging_body
from tests.rigged_shapes import rigged_body, write_gltf

FAR = ("--largest-change", "1")


@pytest.fixture(scope="module")
def body() -> LearnedBody:
    return LearnedBody.load("body")


@pytest.fixture
def poses(body: LearnedBody, tmp_path: Path) -> Path:
    path = tmp_path / "poses.json"
    latent = sample_poses(body, 2, seed=1, colliding=True)
    write_poses(path, body, [NamedPose(f"pose {n}", row) for n, row in enumerate(latent)])
    return path


@pytest.fixture
def own(body: LearnedBody, tmp_path: Path) -> Path:
    """Write the body as an OBJ file with materials, UVs and groups, as programs do."""
    path = tmp_path / "own.obj"
    write_mesh(path, body.reference, body.faces)
    content = path.read_bytes().replace(b"\nf", b"\nvt 0 1\ng all\nusemtl skin\nf", 1)
    path.write_bytes(b"mtllib own.mtl\n" + content)
    return path


def _rest_of(path: Path) -> list[bytes]:
    return [line for line in path.read_bytes().splitlines() if not line.startswith(b"v ")]


def test_decode_gives_back_the_user_s_obj(
    lcollision: Lcollision, body: LearnedBody, poses: Path, own: Path, tmp_path: Path
) -> None:
    plain, like = tmp_path / "plain", tmp_path / "like"
    assert lcollision("decode", "body", poses, "-o", plain).exit_code == 0
    done = lcollision("decode", "body", poses, "-o", like, "--like", own)
    assert done.exit_code == 0, done.output
    for name in ("pose 0.obj", "pose 1.obj"):
        assert _rest_of(like / name) == _rest_of(own)
        vertices = read_mesh(like / name, topology=body.topology).vertices
        np.testing.assert_array_equal(vertices, read_mesh(plain / name).vertices)


@pytest.mark.parametrize("suffix", [".pc2", ".mdd"])
@pytest.mark.parametrize("has_source", [False, True])
def test_decode_writes_all_poses_as_frames(
    lcollision: Lcollision,
    body: LearnedBody,
    poses: Path,
    own: Path,
    tmp_path: Path,
    suffix: str,
    has_source: bool,
) -> None:
    path = tmp_path / f"run{suffix}"
    like = ("--like", own) if has_source else ()
    done = lcollision("decode", "body", poses, "-o", path, "--axes", "maya", "--fps", 25, *like)
    assert done.exit_code == 0, done.output
    assert f"wrote 2 poses to {path}" in done.stderr
    frames = read_point_cache(path)
    expected = [body.decode(pose.latent) for pose in read_poses(poses, body)]
    turned = 100.0 * np.stack(expected)[:, :, [0, 2, 1]] * [1.0, 1.0, -1.0]
    np.testing.assert_allclose(frames, turned, rtol=1e-5, atol=1e-5)
    if suffix == ".mdd":
        assert np.frombuffer(path.read_bytes(), ">f4", 2, 8).tolist() == [0.0, np.float32(1 / 25)]


def test_a_folder_of_a_character_has_its_own_files(lcollision: Lcollision, tmp_path: Path) -> None:
    hero = write_gltf(rigged_body(), tmp_path / "hero.glb")
    model = open_body(hero)
    poses = tmp_path / "poses.json"
    turned = np.full(model.latent_size, 0.05)
    write_poses(poses, model, [NamedPose("one", turned), NamedPose("two", -turned)])
    out = tmp_path / "out"
    assert lcollision("decode", hero, poses, "-o", out).exit_code == 0
    assert sorted(path.name for path in out.iterdir()) == ["one.glb", "two.glb"]
    posed = read_character(out / "one.glb").rest_vertices
    np.testing.assert_allclose(posed, model.decode(turned), atol=1e-5)
    # Axes and units for programs apply to OBJ files.
    for_maya = tmp_path / "maya"
    assert lcollision("decode", hero, poses, "-o", for_maya, "--axes", "maya").exit_code == 0
    assert {path.suffix for path in for_maya.iterdir()} == {".obj"}


def test_clips_are_kept_where_that_is_asked_for(lcollision: Lcollision, tmp_path: Path) -> None:
    hero = figure().write(tmp_path / "hero.glb")
    model, poses, out = open_body(hero), tmp_path / "poses.json", tmp_path / "posed.glb"
    turned = np.full(model.latent_size, 0.05)
    write_poses(poses, model, [NamedPose("one", turned)])
    plain = lcollision("decode", hero, poses, "-o", out)
    assert plain.exit_code == 0, plain.output
    assert "clips left out, as they would hide the pose: wave" in plain.stderr
    assert list(read_character(out).clips) == ["orbit"]
    for command in ("decode", "resolve"):
        kept = lcollision(command, hero, poses, "-o", out, "--keep-clips")
        assert kept.exit_code == 0, kept.output
        assert "left out" not in kept.stderr
        again = read_character(out)
        assert list(again.clips) == ["wave", "walk", "orbit"]
        size = float(np.ptp(again.rest_vertices, axis=0).max())
        shown = np.abs(again.rest_vertices - model.decode(turned)).max()
        # The decoded pose is not free of collisions.
        assert (shown < 1e-5 * size) == (command == "decode")
        before, after = (read_character(file).sample("wave", None) for file in (hero, out))
        assert np.abs(after.vertices - before.vertices).max() < 1e-6 * size
    for name, options in (("a.obj", ()), ("a.pc2", ()), ("a.glb", ("--form", "mesh"))):
        refused = lcollision("decode", hero, poses, "-o", tmp_path / name, "--keep-clips", *options)
        assert refused.exit_code == 2
        assert "clips are kept only where joints hold the pose" in refused.stderr
        assert not (tmp_path / name).exists()


@pytest.mark.slow
def test_poses_of_an_fbx_come_back_in_a_rigged_glb(lcollision: Lcollision, tmp_path: Path) -> None:
    pytest.importorskip("ufbx")
    hero = character_fbx(swinging_body(), tmp_path / "hero.fbx")
    model, poses = open_body(hero), tmp_path / "poses.json"
    turned = np.full(model.latent_size, 0.05)
    named = [NamedPose("one", turned), NamedPose("two", -turned)]
    write_poses(poses, model, named)
    joints, clip = tmp_path / "out", tmp_path / "both.glb"
    for out, form in ((joints, ()), (clip, ("--form", "clip"))):
        done = lcollision("decode", hero, poses, "-o", out, *form)
        assert done.exit_code == 0, done.output
        assert done.stderr.count("FBX can't be written, so hero.fbx comes back as GLB") == 1
    frames = read_character(clip)
    assert list(frames.clips) == ["poses"]
    for number, pose in enumerate(named):
        # From z up, in centimetres.
        expected = 0.01 * model.decode(pose.latent)[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
        size = float(np.ptp(expected, axis=0).max())
        posed = read_character(joints / f"{pose.name}.glb")
        assert posed.rig is not None
        assert posed.clips == {}
        assert np.abs(posed.rest_vertices - expected).max() < 1e-5 * size
        assert np.abs(frames.sample("poses", None).vertices[number] - expected).max() < 1e-5 * size
    kept = lcollision("decode", hero, poses, "-o", joints, "--keep-clips")
    assert kept.exit_code == 0, kept.output
    assert list(read_character(joints / "one.glb").clips) == [CLIP, OTHER]
    # The exported file is checked by its character's rules, and can be resolved.
    assert lcollision("check", joints / "one.glb").exit_code == 0
    done = lcollision("resolve", hero, hero, "-o", tmp_path / "rest.glb")
    assert done.exit_code == 0, done.output
    rest = read_character(tmp_path / "rest.glb")
    expected = 0.01 * model.reference[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    assert np.abs(rest.rest_vertices - expected).max() < 1e-5 * np.ptp(expected)


def test_every_file_that_a_motion_replaces_is_counted(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    hero = figure().write(tmp_path / "hero.glb")
    model, poses, out = open_body(hero), tmp_path / "poses.json", tmp_path / "run.pc2"
    write_poses(poses, model, [NamedPose("one", np.zeros(model.latent_size))])
    for told in ("wrote 1 pose to", "replacing 3 files of the same names"):
        done = lcollision("decode", hero, poses, "-o", out)
        assert done.exit_code == 0, done.output
        assert told in done.stderr
        assert ("replacing" in done.stderr) is told.startswith("replacing")
    assert not out.exists()


def test_resolve_writes_what_it_checked(
    lcollision: Lcollision, body: LearnedBody, poses: Path, own: Path, tmp_path: Path
) -> None:
    out = tmp_path / "free"
    done = lcollision("resolve", "body", poses, "-o", out, "--like", own)
    assert done.exit_code == 0, done.output
    for name in ("pose 0.obj", "pose 1.obj"):
        assert _rest_of(out / name) == _rest_of(own)
        vertices = read_mesh(out / name, topology=body.topology).vertices
        assert not body.detector.detect(vertices).colliding


@pytest.mark.parametrize(
    ("output", "options", "sentence"),
    [
        ("out.ply", ("--like", "own.obj"), "own.obj does not offer .ply; choose one of its forms"),
        ("out.obj", ("--like", "own.obj", "--form", "mesh"), "does not offer .obj with the form"),
        ("out.obj", ("--like", "none.obj"), "there is no such file"),
        ("out.obj", ("--like", "poses.json"), "has a format that cannot be written (.json)"),
        ("out.obj", ("--like", "other.obj"), "has 3 vertices"),
        ("out.json", ("--like", "own.obj"), "would contain codes"),
        ("out.glb", ("--form", "morph"), "applies only to a character's file"),
        ("out.fbx", (), ".fbx is not a format of poses; use one of"),
    ],
)
def test_what_cannot_be_is_one_sentence_and_writes_nothing(
    lcollision: Lcollision,
    body: LearnedBody,
    poses: Path,
    own: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    output: str,
    options: tuple[str, ...],
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_mesh("other.obj", np.eye(3), np.array([[0, 1, 2]]))
    one = read_poses(poses, body)[:1]
    write_poses(poses, body, one)
    refused = lcollision("decode", "body", poses, "-o", output, *options)
    assert refused.exit_code == 2
    assert sentence in refused.stderr
    assert refused.stderr.count("\n") == 1
    assert not Path(output).exists()
    assert own.exists()


def test_a_character_s_own_file_comes_back(lcollision: Lcollision, tmp_path: Path) -> None:
    own = figure().write(tmp_path / "figure.glb")
    model = open_body(own)
    latent = np.random.default_rng(0).uniform(-0.4, 0.4, model.latent_size)
    write_poses(tmp_path / "poses.json", model, [NamedPose("bow", latent)])
    expected = model.decode(latent)
    for form in ((), ("--form", "joints"), ("--form", "mesh"), ("--form", "morph")):
        out = tmp_path / "posed.glb"
        done = lcollision("decode", own, tmp_path / "poses.json", "-o", out, *form)
        assert done.exit_code == 0, done.output
        assert "clips left out, as they would hide the pose: wave" in done.stderr
        posed = read_character(out)
        assert np.abs(posed.rest_vertices[posed.joined] - expected[_joined(own)]).max() < 1e-5
        has_skin = any("skin" in node for node in described(out)[0]["nodes"])
        assert has_skin == ("mesh" not in form)
    done = lcollision("decode", own, tmp_path / "poses.json", "-o", tmp_path / "run.pc2")
    assert done.exit_code == 0, done.output
    assert {path.name for path in tmp_path.glob("*.pc2")} == {
        "run Body.pc2",
        "run Core.pc2",
        "run Hat.pc2",
    }


@pytest.mark.parametrize("sheared", [False, True], ids=["scaled unevenly", "sheared"])
def test_a_pose_is_written_in_whatever_form_can_hold_it(
    lcollision: Lcollision, tmp_path: Path, sheared: bool
) -> None:
    builder = figure()
    nodes = builder.description["nodes"]
    nodes[1]["scale"] = [1.05, 1.0, 1.0]
    if sheared:
        held = [1.0, 0.0, 0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -100.0, 1.0]
        nodes[2] = {"name": "LeftForeArm", "children": [3], "matrix": held}
    own, out = builder.write(tmp_path / "figure.glb"), tmp_path / "posed.glb"
    model = open_body(own)
    latent = np.full(model.latent_size, 0.2)
    write_poses(tmp_path / "poses.json", model, [NamedPose("bow", latent)])
    done = lcollision("decode", own, tmp_path / "poses.json", "-o", out)
    assert done.exit_code == 0, done.output
    assert ("so it is written as a static mesh" in done.stderr) == sheared
    posed = read_character(out)
    assert (posed.rig is None) == sheared
    expected = model.decode(latent)[_joined(own)]
    assert np.abs(posed.rest_vertices[posed.joined] - expected).max() < 1e-5
    # Frames of a clip have no other form: the finished poses stay.
    words = ("resolve", own, tmp_path / "poses.json", "-o", tmp_path / "run.glb", "--form", "clip")
    done = lcollision(*words)
    assert (done.exit_code == 2) == sheared
    if sheared:
        assert "figure.glb cannot be written with these poses: its joints cannot" in done.stderr
        assert "has 1 of 1 pose, run the same command again to continue" in done.stderr


def test_poses_of_a_character_become_a_clip_of_its_file(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    own = figure().write(tmp_path / "figure.glb")
    model = open_body(own)
    latents = np.linspace(0.0, 0.3, 3)[:, None] * np.ones(model.latent_size)
    poses = [NamedPose(f"frame {n}", row) for n, row in enumerate(latents)]
    write_poses(tmp_path / "poses.json", model, poses)
    out = tmp_path / "run.glb"
    words = ("decode", own, tmp_path / "poses.json", "-o", out)
    refused = lcollision(*words)
    assert refused.exit_code == 2
    assert "is one mesh file, but there are 3 poses" in refused.stderr
    done = lcollision(*words, "--form", "clip", "--fps", 10)
    assert done.exit_code == 0, done.output
    frames = read_character(out).sample("poses", None)
    np.testing.assert_allclose(frames.times, [0.0, 0.1, 0.2], rtol=1e-6)
    assert np.abs(frames.vertices - model.decode(latents)).max() < 1e-5


@pytest.mark.variants
@pytest.mark.parametrize("form", ["joints", "mesh"])
def test_resolve_frees_a_character_in_its_own_file(
    lcollision: Lcollision, tmp_path: Path, form: str
) -> None:
    own = figure().write(tmp_path / "figure.glb")
    model = open_body(own)
    assert isinstance(model, RigBody)
    folded = np.where(model.space.joint_of_code > 0, model.space.high, 0.0)
    write_poses(tmp_path / "poses.json", model, [NamedPose("folded", folded)])
    out = tmp_path / "free.glb"
    done = lcollision("resolve", own, tmp_path / "poses.json", "-o", out, "--form", form, *FAR)
    assert "resolved" in done.stdout
    held = np.empty_like(model.reference)
    again = read_character(out)
    held[model.character.joined] = again.rest_vertices[again.joined]
    is_free = not model.detector.detect(held).colliding
    assert (done.exit_code == 0) == is_free
    if form == "mesh":
        assert is_free
    elif not is_free:
        assert "after rounding; --form mesh writes the vertices that were checked" in done.stderr


def _joined(path: Path) -> np.ndarray:
    return read_character(path).joined
