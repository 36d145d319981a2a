"""SMPL body models and motions through the command: collisions resolved, all else kept."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.motions import body_of_motion
from tests.app.support import Lcollision
from tests.independent_check import IndependentRules, crossing_pairs, faces_about_joints
from tests.smpl_files import (
    Arrays,
    linear_blend_skinning,
    motion_arrays,
    smpl_arrays,
    write_model,
    write_motion,
)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(tmp_path_factory.mktemp("models") / "SMPLX_NEUTRAL.npz")


def counted_crossings(body: RigBody, motion: Arrays, frames: list[int]) -> list[int]:
    """Return how many counting faces cross in frames of a file, by independent code.

    The frames are posed by the paper's equations; the rules follow docs/contact-rules.md.
    """
    arrays, rig = smpl_arrays(), body.space.rig
    betas = motion["betas"][:10]
    faces = arrays["f"].astype(np.int64)
    still = np.zeros((55, 3))
    rest = linear_blend_skinning(arrays, betas, still, np.zeros(3))
    parents = [-1, *arrays["kintree_table"][0, 1:].tolist()]
    main = arrays["weights"].argmax(axis=1).tolist()
    about = faces_about_joints(rest, faces, parents, rig.rest[:, :3, 3], main)
    rules = IndependentRules(
        rest, faces, crossing_pairs(rest, faces), body.rules.to_json(), {}, about
    )
    found = []
    for row, place in zip(motion["poses"][frames], motion["trans"][frames], strict=True):
        posed = linear_blend_skinning(arrays, betas, row.reshape(55, 3), place)
        pairs = dict.fromkeys(crossing_pairs(posed, faces), 1.0)
        found.append(len(pairs) - len(rules.excluding(pairs)))
    return found


@pytest.mark.slow
def test_a_motion_comes_back_free_with_all_that_it_holds(
    lcollision: Lcollision, tmp_path: Path, model: Path
) -> None:
    source, free = tmp_path / "walk.npz", tmp_path / "free.npz"
    write_motion(source, n_frames=8, z_is_up=True)
    result = lcollision("check", source, "--clips", "--body", model, "--json")
    assert result.exit_code == 1, result.output
    (report,) = json.loads(result.stdout)
    colliding = [one["frame"] for one in report["colliding_frames"]]
    assert report["frames"] == 8
    assert 0 < len(colliding) < 8
    chosen = ("--motion", "--easing", "1")
    result = lcollision("resolve", model, source, *chosen, "-o", free, "--json")
    assert result.exit_code == 0, result.output
    (row,) = json.loads(result.stdout)
    assert row["free_before"] == 8 - len(colliding)
    assert row["free_after"] == 8
    with np.load(source) as old, np.load(free) as new:
        assert new.files == old.files
        before, after = ({name: held[name] for name in held.files} for held in (old, new))
    for name in ("betas", "gender", "mocap_framerate"):
        assert after[name].tobytes() == before[name].tobytes()
    changed = (after["poses"] != before["poses"]).any(axis=1)
    assert changed[colliding].all()
    assert not changed.all()
    np.testing.assert_array_equal(after["trans"][~changed], before["trans"][~changed])
    assert lcollision("check", free, "--clips", "--body", model).exit_code == 0
    body, _ = body_of_motion(open_body(model), source)
    assert isinstance(body, RigBody)
    some = colliding[:: max(1, len(colliding) // 3)]
    assert all(counted_crossings(body, before, some))
    assert not any(counted_crossings(body, after, some))


@pytest.mark.slow
def test_a_folder_of_motions_of_many_shapes(
    lcollision: Lcollision, tmp_path: Path, model: Path
) -> None:
    walks, out = tmp_path / "walks", tmp_path / "free"
    walks.mkdir()
    for seed in range(2):
        write_motion(walks / f"walk {seed}.npz", n_frames=4, seed=seed)
    write_motion(walks / "body.npz", n_joints=52, n_frames=3)
    shutil.copy(model, walks)
    (walks / "torn.npz").write_bytes((walks / "body.npz").read_bytes()[:900])
    result = lcollision("resolve", model, walks, "--motion", "-o", out)
    assert result.exit_code == 2, result.output
    with (out / "motions.csv").open() as file:
        rows = {row["source"]: row for row in csv.DictReader(file)}
    assert len(rows) == 4
    assert "torn.npz" in rows["torn.npz"]["error"]
    for name in ("body.npz", "walk 0.npz", "walk 1.npz"):
        assert rows[name]["free_after"] == rows[name]["frames"]
        with np.load(walks / name) as old, np.load(out / name) as new:
            assert new.files == old.files
    assert "has no rotations for jaw, left eye, right eye" in result.stderr


@pytest.mark.slow
def test_motions_by_name_and_in_subfolders_are_as_a_folder(
    lcollision: Lcollision, tmp_path: Path, model: Path
) -> None:
    walks, out = tmp_path / "walks", tmp_path / "free"
    (walks / "Subject1").mkdir(parents=True)
    (walks / "Subject2").mkdir()
    for seed, subject in enumerate(("Subject1", "Subject2")):
        write_motion(walks / subject / "walk.npz", n_frames=2, seed=seed)
        np.savez(walks / subject / "shape.npz", betas=np.zeros(10))
    (walks / "walk_meta.json").write_text('{"text": "a person walks", "num_samples": 1}')
    np.save(walks / "joints.npy", np.zeros((2, 22, 3)))
    result = lcollision("resolve", model, walks, "--motion", "-o", out, "--json")
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)
    assert [row["source"] for row in rows] == ["Subject1/walk.npz", "Subject2/walk.npz"]
    assert [row["output"] for row in rows] == [str(out / row["source"]) for row in rows]
    assert all(Path(row["output"]).is_file() for row in rows)
    assert "joints.npy" in result.stderr
    assert "shape.npz" in result.stderr
    assert "no motion in them that can be read; save arrays by name" in result.stderr
    # By a shell's pattern, whatever their shapes; results within the folder are not inputs.
    named = [walks / "Subject1" / "walk.npz", walks / "Subject2" / "walk.npz"]
    result = lcollision("resolve", model, *named, "--motion", "-o", tmp_path / "two/", "--json")
    assert result.exit_code == 0, result.output
    assert [row["source"] for row in json.loads(result.stdout)] == ["walk.npz", "walk.npz"]
    assert len(list((tmp_path / "two").glob("*.npz"))) == 2
    result = lcollision("resolve", model, walks, "--motion", "-o", walks / "free", "--json")
    again = lcollision("resolve", model, walks, "--motion", "-o", walks / "free", "--json")
    for said in (result, again):
        sources = [row["source"] for row in json.loads(said.stdout)]
        assert sources == ["Subject1/walk.npz", "Subject2/walk.npz"]


def test_a_motion_made_for_another_body_says_so(
    lcollision: Lcollision, tmp_path: Path, model: Path
) -> None:
    source = write_motion(tmp_path / "walk.npz", n_frames=2)
    with np.load(source) as held:
        arrays = {name: held[name] for name in held.files}
    arrays["gender"], arrays["surface_model_type"] = np.array("male"), np.array("smplh")
    arrays["expressions"] = np.zeros((2, 10))
    np.savez(source, **arrays)
    result = lcollision("check", source, "--clips", "--body", model)
    name = "SMPLX_NEUTRAL.npz"
    assert f"it was made for a male body ('gender'), and {name} is neutral" in result.stderr
    assert f"it was made for SMPLH ('surface_model_type'), and {name} is SMPLX" in result.stderr
    assert "left out: its facial expressions ('expressions')" in result.stderr
    # A pickled text stays unread, and is no reason to refuse the rotations.
    arrays["gender"] = np.array([b"male", None], dtype=object)
    arrays["surface_model_type"] = np.array(b"smplx_locked_head")
    np.savez(source, **arrays)
    result = lcollision("check", source, "--clips", "--body", model)
    assert result.exit_code in (0, 1)
    assert "it was made for" not in result.stderr


def test_no_source_is_replaced_unless_in_place(
    lcollision: Lcollision, tmp_path: Path, model: Path
) -> None:
    walks = tmp_path / "walks"
    walks.mkdir()
    source = write_motion(walks / "walk.npz", n_frames=2)
    poses, mesh = tmp_path / "poses.json", tmp_path / "meshes" / "windmill.obj"
    shutil.copytree(Path("resources/poses"), mesh.parent)
    assert lcollision("sample", "body", "-n", 1, "-o", poses).exit_code == 0
    link = tmp_path / "link.json"
    link.symlink_to(poses)
    for arguments, replaced in (
        (("resolve", model, source, "--motion", "-o", source), source),
        (("resolve", model, walks, "--motion", "-o", walks), source),
        (("resolve", "body", poses, "-o", poses), poses),
        (("resolve", "body", poses, "-o", link), poses),
        (("mirror", "body", poses, "-o", poses), poses),
        (("resolve", "body", mesh, "-o", mesh), mesh),
        (("resolve", "body", mesh.parent, "-o", mesh.parent), mesh),
    ):
        before = replaced.read_bytes()
        result = lcollision(*arguments)
        assert result.exit_code == 2, arguments
        assert "is an input, which the output would replace; name another" in result.stderr
        assert replaced.read_bytes() == before
    result = lcollision("mirror", "body", poses, "-o", poses, "--in-place")
    assert result.exit_code == 0, result.output
    assert "replacing 1 file of the same name" in result.stderr


def test_a_body_model_is_a_character(lcollision: Lcollision, tmp_path: Path, model: Path) -> None:
    poses, free, meshes = (tmp_path / name for name in ("poses.json", "free.json", "meshes"))
    result = lcollision("sample", model, "-n", "1", "--colliding", "-o", poses)
    assert result.exit_code == 0, result.output
    result = lcollision("resolve", model, poses, "-o", free)
    assert result.exit_code == 0, result.output
    result = lcollision("decode", model, free, "-o", meshes)
    assert result.exit_code == 0, result.output
    written = sorted(meshes.iterdir())
    assert len(written) == 1
    result = lcollision("check", *written)
    assert result.exit_code == 0, result.output
    assert "left_elbow: elbow-left" in lcollision("domains", model).stdout


def test_what_cannot_be_is_said(lcollision: Lcollision, tmp_path: Path, model: Path) -> None:
    source = write_motion(tmp_path / "walk.npz", n_frames=2)
    other = write_motion(tmp_path / "other.npz", n_frames=2, seed=1)
    out = tmp_path / "out.npz"
    for arguments, said in (
        (("check", source, "--clips"), "name one with --body"),
        (("check", source, "--clips", "--body", "body"), "which a body without joints"),
        (("resolve", model, source, other, "--motion", "-o", out), "is of another shape"),
        (("resolve", model, "--motion", "-o", out), "has no clips"),
    ):
        result = lcollision(*arguments)
        assert result.exit_code == 2
        assert said in result.stderr
    assert not out.exists()
    # A body model's motion can be written as its skeleton's motion.
    skeleton = tmp_path / "out.bvh"
    assert lcollision("resolve", model, source, "--motion", "-o", skeleton).exit_code == 0
    assert skeleton.read_text().startswith("HIERARCHY")
    np.savez(tmp_path / "meshes.npz", vertices=np.zeros((1, 3, 3)), faces=[[0, 1, 2]])
    result = lcollision("info", tmp_path / "meshes.npz")
    assert result.exit_code == 2
    assert "meshes.npz cannot be read: it is a pose set, not a body" in result.stderr


def test_frames_become_a_point_cache(lcollision: Lcollision, tmp_path: Path, model: Path) -> None:
    source, out = tmp_path / "walk.npz", tmp_path / "walk.pc2"
    arrays = motion_arrays(n_frames=3)
    np.savez(source, **arrays)
    result = lcollision("resolve", model, source, "--motion", "-o", out)
    assert result.exit_code == 0, result.output
    assert out.stat().st_size == 32 + 3 * 12 * len(smpl_arrays()["v_template"])
