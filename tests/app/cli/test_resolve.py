"""``lcollision resolve`` and ``benchmark resolve``, on a small body."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lcollision_core.bodies import (
    Body,
    LearnedBody,
    NamedPose,
    read_poses,
    sample_poses,
    write_poses,
)
from lcollision_core.contact import DEPTH_TOLERANCE, ContactRules
from lcollision_core.errors import ModelFileError
from lcollision_core.files import as_stored, locked, read_mesh, write_mesh, write_pose_set
from lcollision_core.meshes import RigidTransform
from lcollision_core.resolve import PoseResolver, find_free_poses
from lcollision_core.tasks import exporting, progress
from tests.app.support import Lcollision
from tests.bending_tube import bending_tube
from tests.core.brute_force import all_pairs
from tests.core.shapes import random_rotation

FIELDS = [
    "source",
    "output",
    "solver_status",
    "predicted_free",
    "exactly_free",
    "step",
    "energy_before",
    "energy_after",
    "pairs_before",
    "pairs_after",
    "latent_distance",
    "vertex_distance_mean",
    "vertex_distance_max",
    "iterations",
    "evaluations",
    "seconds",
    "clearance",
    "least_distance",
    "largest_change",
    "deepest_after",
    "near_exclusion",
    "excluded_at_rest",
]


@pytest.fixture(scope="module")
def model(editor_model: LearnedBody) -> LearnedBody:
    free = find_free_poses(editor_model.embedding, editor_model.exact_check())
    return editor_model.with_free_poses(free)


@pytest.fixture(scope="module")
def model_file(model: LearnedBody, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "tube.safetensors"
    model.save(path)
    return path


@pytest.fixture(scope="module")
def helpless_file(editor_model: LearnedBody, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a model without a known free pose."""
    path = tmp_path_factory.mktemp("model") / "helpless.safetensors"
    editor_model.save(path)
    return path


@pytest.fixture(scope="module")
def colliding(model: LearnedBody) -> np.ndarray:
    return sample_poses(model, 4, seed=5, colliding=True)


@pytest.fixture
def poses(model: LearnedBody, colliding: np.ndarray, tmp_path: Path) -> Path:
    """Return a file of four colliding poses and a free one."""
    path = tmp_path / "poses.json"
    named = [NamedPose(f"pose {place}", row) for place, row in enumerate(colliding)]
    write_poses(path, model, [*named, NamedPose("mean", np.zeros(model.latent_size))])
    return path


def colliding_mesh(model: LearnedBody, latent: np.ndarray, path: Path) -> np.ndarray:
    """Write a mesh with another placement, and with detail that the model does not decode."""
    generator = np.random.default_rng(1)
    detail = 2e-3 * model.body_size * np.sin(np.arange(model.n_vertices))[:, None]
    turned = (model.decode(latent) + detail) @ random_rotation(generator).T
    vertices = turned + 50.0
    write_mesh(path, vertices, model.faces)
    return vertices


def n_pairs(model: LearnedBody, vertices: np.ndarray) -> int:
    """Count colliding pairs by brute force."""
    return len(all_pairs(vertices, model.faces, DEPTH_TOLERANCE * model.body_size).pairs)


def test_poses_come_back_free_in_their_order(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    out = tmp_path / "free.json"
    result = lcollision("resolve", model_file, poses, "-o", out, "--json")
    assert result.exit_code == 0, result.stderr
    rows = json.loads(result.stdout)
    assert [list(row) for row in rows] == [FIELDS] * 5
    assert [row["source"] for row in rows] == [
        *(f"{poses}: pose {place}" for place in range(4)),
        f"{poses}: mean",
    ]
    assert [row["output"] for row in rows] == [str(out)] * 5
    assert [row["exactly_free"] for row in rows] == [True] * 5
    assert [row["step"] == "unchanged" for row in rows] == [False] * 4 + [True]
    before, after = read_poses(poses, model), read_poses(out, model)
    assert [pose.name for pose in after] == [pose.name for pose in before]
    assert after[4].latent.tolist() == [0.0] * model.latent_size
    for row, was, pose in zip(rows, before, after, strict=True):
        exported = model.decode(pose.latent).astype(np.float32).astype(np.float64)
        assert n_pairs(model, exported) == 0
        moved = np.linalg.norm(pose.latent - was.latent)
        assert row["latent_distance"] * np.linalg.norm(was.latent) == pytest.approx(moved)


@pytest.mark.parametrize(
    "solver",
    ["auglag", *(pytest.param(name, marks=pytest.mark.slow) for name in ("slsqp", "ccsaq"))],
)
def test_every_solver_by_its_name(
    lcollision: Lcollision, model_file: Path, poses: Path, tmp_path: Path, solver: str
) -> None:
    out = tmp_path / "free.json"
    options = ("--solver", solver, "--metric", "latent", "--margin", "1", "--threshold", "0.4")
    result = lcollision("resolve", model_file, poses, "-o", out, *options)
    assert result.exit_code == 0, result.stderr
    assert result.stdout.count(": resolved ") == 4
    assert "mean: already free, unchanged" in result.stdout


def test_a_mesh_comes_back_in_its_place(
    lcollision: Lcollision,
    model: LearnedBody,
    model_file: Path,
    colliding: np.ndarray,
    tmp_path: Path,
) -> None:
    source, out = tmp_path / "bent.obj", tmp_path / "free.ply"
    vertices = colliding_mesh(model, colliding[1], source)
    result = lcollision("resolve", model_file, source, "-o", out)
    assert result.exit_code == 0, result.stderr
    assert "bent.obj is encoded with a fit error of " in result.stderr
    fixed = read_mesh(out)
    assert np.array_equal(fixed.topology.faces, model.faces)
    assert n_pairs(model, fixed.vertices) == 0
    assert n_pairs(model, vertices) > 0
    # Nearer than with a wrong placement or vertex order.
    assert np.linalg.norm(fixed.vertices - vertices, axis=1).mean() < 0.1 * model.body_size


def test_detail_is_kept_where_it_stays_free(
    lcollision: Lcollision,
    model: LearnedBody,
    model_file: Path,
    colliding: np.ndarray,
    tmp_path: Path,
) -> None:
    n_kept = 0
    for place, latent in enumerate(colliding):
        source = tmp_path / f"bent{place}.obj"
        vertices = colliding_mesh(model, latent, source)
        plain, detailed = tmp_path / "plain.obj", tmp_path / "detailed.obj"
        assert lcollision("resolve", model_file, source, "-o", plain).exit_code == 0
        result = lcollision("resolve", model_file, source, "-o", detailed, "--keep-detail")
        assert result.exit_code == 0
        fixed, bare = read_mesh(detailed).vertices, read_mesh(plain).vertices
        assert n_pairs(model, fixed) == 0
        if "its detail was left out, because with it the mesh would collide" in result.stderr:
            assert np.array_equal(fixed, bare)
            continue
        n_kept += 1
        encoded = model.encode(read_mesh(source).vertices)
        residual = vertices - encoded.placement.apply(model.decode(encoded.latent))
        np.testing.assert_allclose(fixed - bare, residual, atol=2e-4 * model.body_size)
        assert np.abs(residual).max() > 1e-3 * model.body_size
    assert n_kept > 0


def test_a_free_mesh_with_detail_comes_back_as_it_was(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, tmp_path: Path
) -> None:
    source, out = tmp_path / "straight.obj", tmp_path / "same.obj"
    colliding_mesh(model, np.zeros(model.latent_size), source)
    result = lcollision("resolve", model_file, source, "-o", out, "--keep-detail")
    assert result.exit_code == 0
    assert np.array_equal(read_mesh(out).vertices, read_mesh(source).vertices)


def test_a_folder_takes_several(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "mean.off").write_text("an older one")
    result = lcollision("resolve", model_file, poses, "-o", out, "--format", "off", "--json")
    assert result.exit_code == 0
    names = [*(f"pose {place}.off" for place in range(4)), "mean.off"]
    assert [row["output"] for row in json.loads(result.stdout)] == [
        str(out / name) for name in names
    ]
    told = f"lcollision: wrote 5 poses to {out}, replacing 1 file of the same name"
    assert told in result.stderr.splitlines()
    assert {file.name for file in out.iterdir()} == set(names)
    for file in out.iterdir():
        assert n_pairs(model, read_mesh(file).vertices) == 0


def test_what_the_check_saw_is_what_is_written(
    lcollision: Lcollision,
    model_file: Path,
    poses: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    checked: list[np.ndarray] = []
    resolve_many = PoseResolver.resolve_many

    def remember(self: PoseResolver, *arguments: Any, **options: Any) -> Any:
        results = resolve_many(self, *arguments, **options)
        checked.extend(result.vertices for result in results)
        return results

    monkeypatch.setattr(PoseResolver, "resolve_many", remember)
    monkeypatch.delattr(Body, "exported_vertices")
    out = tmp_path / "out"
    result = lcollision("resolve", model_file, poses, "-o", out, "--format", "ply", "--json")
    assert result.exit_code == 0
    files = [row["output"] for row in json.loads(result.stdout)]
    for file, vertices in zip(files, checked, strict=True):
        assert np.array_equal(read_mesh(file).vertices, vertices)


def test_a_folder_stands_for_its_meshes(
    lcollision: Lcollision,
    model: LearnedBody,
    model_file: Path,
    colliding: np.ndarray,
    tmp_path: Path,
) -> None:
    folder, out = tmp_path / "scans", tmp_path / "free"
    folder.mkdir()
    colliding_mesh(model, colliding[0], folder / "scan10.obj")
    colliding_mesh(model, np.zeros(model.latent_size), folder / "scan2.obj")
    (folder / "notes.txt").write_text("both of Monday")
    result = lcollision("resolve", model_file, folder, "-o", out)
    assert result.exit_code == 0, result.stderr
    first, second = result.stdout.splitlines()
    assert first.startswith(
        f"{folder / 'scan2.obj'}: already free, written as the nearest model pose, "
    )
    assert second.startswith(f"{folder / 'scan10.obj'}: resolved ")
    assert ", written as the nearest model pose, " in second
    assert "unchanged" not in result.stdout
    assert {file.name for file in out.iterdir()} == {"scan2.obj", "scan10.obj"}
    result = lcollision("resolve", model_file, folder / "scan2.obj", "-o", out, "--keep-detail")
    assert ": already free, with its detail (" in result.stdout
    poses = tmp_path / "scans.json"
    assert lcollision("encode", model_file, folder, "-o", poses).exit_code == 0
    assert [pose.name for pose in read_poses(poses, model)] == ["scan2", "scan10"]


def test_a_folder_of_nothing_and_one_mesh_for_several_are_refused_at_once(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    result = lcollision("resolve", model_file, folder, "-o", tmp_path / "free")
    assert result.exit_code == 2
    assert f"{folder} contains no mesh; name a folder of .obj" in result.stderr
    for name in "ab":
        colliding_mesh(model, np.zeros(model.latent_size), folder / f"{name}.obj")
    result = lcollision("resolve", model_file, folder, "-o", tmp_path / "one.obj")
    assert result.exit_code == 2
    assert "one.obj is one mesh file, but there are 2 poses; name a folder" in result.stderr
    assert "encoded" not in result.stderr


def test_the_near_exclusion_is_stated(
    lcollision: Lcollision, model: LearnedBody, colliding: np.ndarray, tmp_path: Path
) -> None:
    path, poses, out = (tmp_path / name for name in ("m.safetensors", "poses.json", "free.json"))
    near = LearnedBody(model.name, model.embedding, replace(model.card, rules=ContactRules(0.05)))
    assert model.predictor is not None
    near.with_predictor(model.predictor).with_free_poses(model.free_latent).save(path)
    write_poses(poses, model, [NamedPose("bent", colliding[0])])
    sentence = "not counted: pairs within 0.05 along the surface; at rest: no pair"
    assert sentence in lcollision("resolve", path, poses, "-o", out).stderr
    rows = json.loads(lcollision("resolve", path, poses, "-o", out, "--json").stdout)
    assert [row["near_exclusion"] for row in rows] == [0.05]
    options = ("--model", path, "-n", "1", "--solver", "sqp")
    assert sentence in lcollision("benchmark", "resolve", *options).stderr


def test_a_folder_is_one_whatever_it_is_called(
    lcollision: Lcollision, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    for name in ("x.obj", "x.json"):
        out = tmp_path / name
        out.mkdir()
        result = lcollision("resolve", model_file, poses, "-o", out)
        assert result.exit_code == 0, result.stderr
        assert len(list(out.glob("*.obj"))) == 5


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".stl", ".glb"])
def test_the_mesh_written_is_the_one_that_was_proved_free(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, tmp_path: Path, suffix: str
) -> None:
    latent, turn = 0.3 * model.known_poses[4], random_rotation(np.random.default_rng(2))
    pose = NamedPose("placed", latent, RigidTransform(turn, np.array([1e4, -70.0, 3.0])))
    check = model.exact_check(pose.placement)
    exported = check.exported(check.decode(latent)[0])
    path, out = tmp_path / "placed.json", tmp_path / f"placed{suffix}"
    write_poses(path, model, [pose])
    assert lcollision("decode", model_file, path, "-o", out).exit_code == 0
    mesh, proved = read_mesh(out), as_stored(out, exported, model.topology)
    assert proved.dtype == (np.float32 if suffix in (".stl", ".glb") else np.float64)
    assert np.array_equal(mesh.vertices[mesh.faces], proved[model.faces])


def test_locks_and_weights_by_name(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    out = tmp_path / "free.json"
    name = model.domain_names[0]
    result = lcollision("resolve", model_file, poses, "-o", out, "--lock", name, "--json")
    assert result.exit_code in (0, 1)
    for before, after in zip(read_poses(poses, model), read_poses(out, model), strict=True):
        assert after.latent[2:5].tolist() == before.latent[2:5].tolist()
    result = lcollision("resolve", model_file, poses, "-o", out, "--weight", "2=50")
    assert result.exit_code == 0


def test_all_domains_locked_leaves_poses_colliding(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    out = tmp_path / "same.json"
    result = lcollision("resolve", model_file, poses, "-o", out, "--lock", "1", "--lock", "2")
    assert result.exit_code == 1
    assert result.stderr.count("all body parts are locked") == 4
    assert result.stdout.count("still colliding") == 4
    for before, after in zip(read_poses(poses, model), read_poses(out, model), strict=True):
        assert after.latent.tolist() == before.latent.tolist()


def test_unverified_answers_say_so(
    lcollision: Lcollision, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    out = tmp_path / "free.json"
    result = lcollision("resolve", model_file, poses, "-o", out, "--no-verify", "--json")
    rows = json.loads(result.stdout)
    assert {row["exactly_free"] for row in rows} == {None}
    assert {row["pairs_before"] for row in rows} == {None}
    assert result.exit_code == (0 if all(row["predicted_free"] for row in rows) else 1)


def test_a_pose_that_may_move_little_keeps_the_least_overlap(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    out = tmp_path / "soft.json"
    command = ("resolve", model_file, poses, "-o", out, "--soft", "0.004")
    result = lcollision(*command, "--json")
    assert result.exit_code == 1
    rows = json.loads(result.stdout)
    assert (rows[4]["step"], rows[4]["largest_change"]) == ("unchanged", 0.004)
    left = [row for row in rows if not row["exactly_free"]]
    for row, was, pose in zip(rows, read_poses(poses, model), read_poses(out, model), strict=True):
        ends = model.decode(np.stack([was.latent, pose.latent]))
        change = np.linalg.norm(ends[1] - ends[0], axis=1).max() / model.body_size
        assert change == pytest.approx(row["vertex_distance_max"])
        assert change <= 0.004
        exported = ends[1].astype(np.float32).astype(np.float64)
        assert n_pairs(model, exported) == row["pairs_after"]
        assert row["energy_after"] <= row["energy_before"]
        assert (row["deepest_after"] > 0.0) == (row["pairs_after"] > 0)
    said = lcollision(*command)
    for row in left:
        assert row["step"] == ("soft" if row["vertex_distance_max"] > 0.0 else "none")
    assert said.stdout.count("still colliding, ") == len(left) > 0
    assert said.stdout.count(", most of ") == len(left)
    first = left[0]
    share = 100.0 * first["energy_after"] / first["energy_before"]
    assert f"pairs of faces of {first['pairs_before']}, up to " in said.stdout
    assert f"% of the body size deep, overlap {share:.0f} % of before, moved by" in said.stdout
    assert "no free pose was found within 0.4 % of the body size" in said.stderr


def test_a_sequence_is_resolved_as_a_motion_and_told_to_be_deprecated(
    lcollision: Lcollision,
    model: LearnedBody,
    model_file: Path,
    colliding: np.ndarray,
    tmp_path: Path,
) -> None:
    path, out = tmp_path / "motion.json", tmp_path / "free.json"
    ways = np.linspace(0.0, 1.0, 12)
    frames = [NamedPose(f"frame {i}", way * colliding[0]) for i, way in enumerate(ways)]
    write_poses(path, model, frames)
    result = lcollision("resolve", model_file, path, "-o", out, "--sequence")
    assert result.exit_code == 0
    assert "--sequence is deprecated and means --motion; use that" in result.stderr
    assert "of 12 frames free before, all after" in result.stdout
    as_sequence = out.read_bytes()
    assert len(read_poses(out, model)) == 12
    result = lcollision("resolve", model_file, path, "-o", out, "--motion")
    assert "deprecated" not in result.stderr
    assert out.read_bytes() == as_sequence


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--threshold", "0"), "the threshold must be over 0.0, got 0"),
        (("--threshold", "1.5"), "--threshold must be at most 1, got 1.5; see lcollision resolve"),
        (("--solver", "magic"), "unknown solver 'magic'; choose one of sqp, auglag"),
        (("--metric", "near"), "unknown metric 'near'; choose one of vertices, latent"),
        (("--margin", "-2"), "--margin must be at least 0, got -2"),
        (("--budget", "nan"), "--budget must be a number, got nan"),
        (("--substeps", "1.5"), "--substeps must be a whole number, got 1.5"),
        (("--lock", "tail"), "has no domain 'tail'; its domains are"),
        (("--lock", "0"), "has no domain '0'; its domains are"),
        (("--weight", "1"), "--weight '1' is not DOMAIN=W"),
        (("--weight", "1=-3"), "--weight '1=-3' is not DOMAIN=W"),
        (("--time-budget", "0"), "the time budget must be over 0.0, got 0"),
        (("--keep-detail",), "--keep-detail applies only to meshes"),
        (("--soft", "0"), "the largest change must be over 0.0, got 0"),
        (("--soft", "0.1", "--no-verify"), "a largest change needs the exact check; leave out"),
    ],
)
def test_bad_options_are_one_sentence(
    lcollision: Lcollision,
    model_file: Path,
    poses: Path,
    tmp_path: Path,
    options: tuple[str, ...],
    sentence: str,
) -> None:
    result = lcollision("resolve", model_file, poses, "-o", tmp_path / "free.json", *options)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""
    assert not (tmp_path / "free.json").exists()


def test_bad_inputs_are_one_sentence_each_and_the_rest_is_done(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    empty, alien, broken = (tmp_path / name for name in ("empty.json", "alien.json", "nan.json"))
    empty.write_text("")
    text = poses.read_text()
    alien.write_text(text.replace(model.fingerprint, "0" * 16))
    document = json.loads(text)
    document["poses"][1]["latent"][3] = float("nan")
    broken.write_text(json.dumps(document))
    none = tmp_path / "none.json"
    none.write_text(json.dumps(json.loads(text) | {"poses": []}))
    out = tmp_path / "free.json"
    inputs = (empty, alien, broken, none, tmp_path / "gone.obj", poses)
    result = lcollision("resolve", model_file, *inputs, "-o", out)
    assert result.exit_code == 2
    *sentences, wrote = result.stderr.splitlines()
    assert wrote == f"lcollision: wrote 5 poses to {out}"
    for path, sentence in zip(inputs[:-1], sentences, strict=True):
        assert str(path) in sentence
    assert "is not JSON" in sentences[0]
    assert "which is not" in sentences[1]
    assert "contains no poses" in sentences[3]
    assert len(read_poses(out, model)) == 5
    alone = lcollision("resolve", model_file, empty, "-o", tmp_path / "other.json")
    assert alone.exit_code == 2
    assert not (tmp_path / "other.json").exists()


def test_an_output_that_cannot_be_is_refused_first(
    lcollision: Lcollision, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    (tmp_path / "free").write_text("mine")
    has_proc = Path("/proc/self").exists()
    for out, sentence in (
        (tmp_path / "no" / "free.json", "there is no folder"),
        *([("/proc/free.json", "/proc/free.json cannot be written: no file can")] * has_proc),
        *([("/proc", "lcollision: no file can be made in the folder /proc: No such")] * has_proc),
        (tmp_path / "free.docx", ".docx is not a format of poses"),
        (tmp_path / "free.fbx", ".fbx is not a format of poses"),
        (tmp_path / "free.txt", ".txt is not a format of poses"),
        (tmp_path / ("x" * 300 + ".json"), "File name too long"),
        (tmp_path / ("x" * 300), "File name too long"),
        (f"{tmp_path / 'free'}/", "cannot be created: a file has this name; name another"),
        (tmp_path / "free", "cannot be created: a file has this name; name another"),
        (tmp_path / "free.obj", "is one mesh file, but there are 5 poses"),
    ):
        result = lcollision("resolve", model_file, poses, "-o", out)
        assert result.exit_code == 2
        assert sentence in result.stderr
        assert result.stderr.count("\n") == 1


def test_a_model_without_a_predictor_is_refused(
    lcollision: Lcollision, model: LearnedBody, poses: Path, tmp_path: Path
) -> None:
    path = tmp_path / "bare.safetensors"
    LearnedBody(model.name, model.embedding, model.card).save(path)
    mesh = tmp_path / "mesh.obj"
    write_mesh(mesh, model.decode(model.known_poses[0]), model.faces)
    for given in (poses, mesh):
        result = lcollision("resolve", path, given, "-o", tmp_path / "free.json")
        assert result.exit_code == 2
        assert "has no predictor" in result.stderr
        assert result.stderr.count("\n") == 1


@pytest.mark.variants(2)
@pytest.mark.parametrize("name", ["results_v0.9", "o_1.05", "new.obj/", "a.v2"])
def test_a_name_with_a_dot_that_is_no_format_is_a_folder(
    lcollision: Lcollision, model_file: Path, poses: Path, tmp_path: Path, name: str
) -> None:
    result = lcollision("resolve", model_file, poses, "-o", f"{tmp_path}/{name}")
    assert result.exit_code == 0, result.stderr
    assert len(list((tmp_path / name).glob("*.obj"))) == 5


_STOP_AFTER_TWO = """
import os, signal, sys
from app.cli import main
from lcollision_core.tasks import progress
how = getattr(signal, sys.argv.pop(1))
progress._SECONDS_BETWEEN_WRITES, progress._LARGEST_FRACTION = 0.0, 1.0
keep = progress.Run.keep
def keep_two(self, *arguments):
    keep(self, *arguments)
    if len(self.done) >= 2:
        os.kill(os.getpid(), how)
progress.Run.keep = keep_two
main.main()
"""


def stopped(how: str, *arguments: object) -> str:
    """Run a command, stop it by a signal once two poses are done, and return its output."""
    process = subprocess.run(
        [sys.executable, "-c", _STOP_AFTER_TWO, how, *map(str, arguments), "--workers", "1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == (-9 if how == "SIGKILL" else 130), process.stderr
    assert process.stdout == ""
    return process.stderr


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
@pytest.mark.parametrize(
    ("how", "form"), [("SIGINT", "free.json"), ("SIGTERM", "free"), ("SIGKILL", "free.json")]
)
def test_a_stopped_run_replaces_nothing_and_goes_on(
    lcollision: Lcollision,
    model: LearnedBody,
    model_file: Path,
    poses: Path,
    tmp_path: Path,
    how: str,
    form: str,
) -> None:
    whole, out, kept = tmp_path / "whole", tmp_path / form, tmp_path / "free.partial.json"
    options = ("--seed", "3")
    lcollision("resolve", model_file, poses, "-o", whole.with_suffix(out.suffix), *options)
    older = [replace(pose, latent=0.0 * pose.latent) for pose in read_poses(poses, model)]
    if form == "free":
        out.mkdir()
        for pose in older:
            (out / f"{pose.name}.obj").write_text("older")
    else:
        write_poses(out, model, older)
    before = contents(out)
    said = stopped(how, "resolve", model_file, poses, "-o", out, *options)
    assert contents(out) == before
    done = read_poses(kept, model)
    assert len(done) == 2
    if how != "SIGKILL":
        assert f"stopped; {kept} has 2 of 5 poses, run the same command again to continue" in said
    result = lcollision("resolve", model_file, poses, "-o", out, *options)
    assert result.exit_code == 0, result.stderr
    assert f"continuing from {kept}, which has 2 of 5 poses" in result.stderr
    assert contents(out) == contents(whole.with_suffix(out.suffix))
    assert not list(tmp_path.glob("*partial*"))


def contents(path: Path) -> dict[str, bytes]:
    """Return the bytes of a file, or of all files of a folder."""
    files = list(path.iterdir()) if path.is_dir() else [path]
    return {file.name if path.is_dir() else "": file.read_bytes() for file in files}


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
def test_what_another_run_left_is_neither_used_nor_lost(
    lcollision: Lcollision, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    out, kept = tmp_path / "free.json", tmp_path / "free.partial.json"
    stopped("SIGINT", "resolve", model_file, poses, "-o", out)
    left = kept.read_bytes()
    result = lcollision("resolve", model_file, poses, "-o", out, "--metric", "latent")
    assert result.exit_code == 2
    assert f"{kept} is of another run" in result.stderr
    assert kept.read_bytes() == left
    assert not out.exists()
    document = json.loads(left)
    document["unfinished"]["done"][0]["step"] = "flying"
    kept.write_text(json.dumps(document))
    result = lcollision("resolve", model_file, poses, "-o", out)
    assert result.exit_code == 2
    assert f"{kept} is damaged; delete it" in result.stderr
    # Renaming a body part changes no result.
    kept.write_bytes(left)
    lcollision("domains", model_file, "--name", "1=somewhere")
    assert lcollision("resolve", model_file, poses, "-o", out).exit_code == 0


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
def test_a_full_disk_loses_nothing_of_what_an_earlier_run_left(
    lcollision: Lcollision,
    model_file: Path,
    poses: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out, kept = tmp_path / "free.json", tmp_path / "free.partial.json"
    stopped("SIGINT", "resolve", model_file, poses, "-o", out)
    left = kept.read_bytes()

    def write(*_: object, **__: object) -> None:
        raise ModelFileError("it cannot be written: No space left on device")

    with monkeypatch.context() as full:
        full.setattr(exporting, "write_poses", write)
        full.setattr(progress, "write_poses", write)
        full.setattr(progress, "_SECONDS_BETWEEN_WRITES", -1.0)
        result = lcollision("resolve", model_file, poses, "-o", out, "--workers", "1")
    assert result.exit_code == 2
    # Once for the stored progress, and once for the output.
    assert result.stderr.count("No space left") == 2
    assert "stopped" not in result.stderr
    assert kept.read_bytes() == left
    assert "2 of 5" in lcollision("resolve", model_file, poses, "-o", out).stderr


def test_two_runs_to_one_output_are_refused(
    lcollision: Lcollision, model_file: Path, poses: Path, tmp_path: Path
) -> None:
    with locked(tmp_path / "free.partial.json"):
        result = lcollision("resolve", model_file, poses, "-o", tmp_path / "free.json")
    assert result.exit_code == 2
    assert "is being written by another command" in result.stderr


def test_an_output_that_others_wrote_meanwhile_stays(
    lcollision: Lcollision,
    model: LearnedBody,
    model_file: Path,
    poses: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """For example, the editor saves the poses that are being resolved in place."""
    resolve_many = PoseResolver.resolve_many

    def save_then_resolve(self: PoseResolver, *arguments: Any, **options: Any) -> Any:
        write_poses(poses, model, [NamedPose("saved meanwhile", np.zeros(model.latent_size))])
        return resolve_many(self, *arguments, **options)

    monkeypatch.setattr(PoseResolver, "resolve_many", save_then_resolve)
    result = lcollision("resolve", model_file, poses, "-o", poses, "--in-place", "--json")
    assert result.exit_code == 0, result.stderr
    beside = poses.with_name("poses 2.json")
    assert f"was left alone; the result is in {beside}" in result.stderr
    assert [row["output"] for row in json.loads(result.stdout)] == [str(beside)] * 5
    assert [pose.name for pose in read_poses(poses, model)] == ["saved meanwhile"]
    assert len(read_poses(beside, model)) == 5


@pytest.mark.slow
def test_benchmark_compares_the_solvers_with_bisection(
    lcollision: Lcollision, model_file: Path, tmp_path: Path
) -> None:
    figures = tmp_path / "figures"
    result = lcollision(
        *("benchmark", "resolve", "--model", model_file, "-n", "6", "--json"),
        *("--figure", figures, "--solver", "sqp", "--solver", "auglag"),
    )
    assert result.exit_code == 0, result.stderr
    rows = json.loads(result.stdout)
    assert [row["solver"] for row in rows] == ["bisection", "sqp", "auglag"]
    assert list(rows[0]) == [
        *("model", "near_exclusion", "solver", "poses", "median_ms", "p95_ms", "feasible_rate"),
        *("exactly_free_rate", "free_before_walk_back", "energy_decrease", "latent_distance"),
        *("vertex_distance", "largest_change", "overlap_left", "least_distance"),
        "least_by_brute_force",
    ]
    for row in rows:
        assert row["poses"] == 6
        assert row["exactly_free_rate"] == 1.0
        assert 0.0 < row["median_ms"] <= row["p95_ms"]
        assert 0.0 < row["vertex_distance"] < 0.5
    for name in ("convergence-sqp", "energy-sqp", "convergence-auglag", "energy-auglag"):
        with Image.open(figures / f"{name}.png") as picture:
            assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 3


@pytest.mark.slow
def test_benchmark_resolves_the_colliding_poses_of_a_set(
    lcollision: Lcollision, model_file: Path, helpless_file: Path, tmp_path: Path
) -> None:
    path = tmp_path / "bends.npz"
    write_pose_set(path, bending_tube(most=4.0))
    options = ("--data", path, "-n", "3", "--json", "--solver", "sqp")
    result = lcollision("benchmark", "resolve", "--model", model_file, *options)
    assert result.exit_code == 0, result.stderr
    assert [row["exactly_free_rate"] for row in json.loads(result.stdout)][1:] == [1.0]
    helpless = lcollision("benchmark", "resolve", "--model", helpless_file, *options)
    assert helpless.exit_code == 2
    assert "knows no free pose to bisect to" in helpless.stderr
