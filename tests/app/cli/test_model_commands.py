"""``train embedding``, ``models``, ``info``, ``domains``, ``encode``, ``decode``, ``sample``."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from app.cli.main import app
from app.cli.models import note_where_written
from lcollision_core.bodies import (
    LearnedBody,
    NamedPose,
    RigBody,
    change_model,
    checkpoint_path,
    open_body,
    read_poses,
    remember_choices,
    user_models_folder,
    write_poses,
)
from lcollision_core.bundled import bundled_file
from lcollision_core.embedding.training_run import EmbeddingConfig
from lcollision_core.files import PoseSet, locked, read_mesh, write_mesh, write_pose_set
from lcollision_core.meshes import ContactRules
from lcollision_core.model_file import Section
from tests.app.support import Lcollision, refusal
from tests.bending_tube import LENGTH_IN_FILES, bending_tube
from tests.core.killed import after_checkpoint
from tests.core.shapes import random_rotation
from tests.rigged_shapes import head_in_torso, rigged_body, write_gltf
from tests.small_models import DATA

TRAINING = ("--domains", "2", "--domain-codes", "3", "--seed", "1", "--licence", "CC0-1.0")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dataset") / "bends.npz"
    write_pose_set(path, replace(bending_tube(), provenance={"by_rig": {"seed": 7}}))
    return path


@pytest.fixture(scope="module")
def trained(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trained") / "tube.safetensors"
    result = CliRunner().invoke(
        app, ["train", "embedding", str(dataset), "-o", str(path), *TRAINING]
    )
    assert result.exit_code == 0, result.output
    assert result.stdout == ""
    assert f"wrote {path}: vertex error" in result.stderr
    assert list(path.parent.iterdir()) == [path]
    return path


@pytest.fixture
def tube(trained: Path, tmp_path: Path) -> Path:
    """Return a copy of the trained model that a test may change."""
    return Path(shutil.copy(trained, tmp_path / "tube.safetensors"))


@pytest.fixture(autouse=True)
def user_models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Hide the models of the user who runs the tests."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path / "data" / "lcollision" / "models"


def test_info_of_a_character_needs_no_folder_of_models(
    lcollision: Lcollision, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The name is too long for a file system: like a locked folder, it cannot even be looked at.
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / ("x" * 300)))
    monkeypatch.chdir(DATA)
    result = lcollision("info", "swing.glb")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("swing: 848 vertices")


def test_info_prints_what_scripts_read(lcollision: Lcollision, tube: Path) -> None:
    result = lcollision("info", tube, "--json")
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert (
        report.items()
        >= {
            "name": "tube",
            "version": 3,
            "vertices": 210,
            "faces": 416,
            "latent_size": 8,
            "near_exclusion": 0.0,
            "licence": "CC0-1.0",
            "source": "bends.npz",
            "predictor": None,
        }.items()
    )
    assert [domain["name"] for domain in report["domains"]] == ["part 1", "part 2"]
    assert sum(domain["vertices"] for domain in report["domains"]) == 210
    assert [domain["codes"] for domain in report["domains"]] == [3, 3]
    errors = report["reconstruction"]
    assert 0 < errors["mean"] < errors["level1_mean"] < 0.05
    assert errors["mean"] < errors["max"] < 0.05
    assert 0 < errors["held_out_mean"] < errors["held_out_max"]
    assert errors["pca_held_out_mean"] > 0
    assert 0 < report["acap"]["mean"] < report["acap"]["max"] < 0.02
    assert report["masks"]["connected_share"] > 0.95
    assert 1 <= report["masks"]["domains_per_vertex"] <= 2
    assert report["provenance"]["seed"] == 1
    assert report["provenance"]["training"]["encoded_codes"] is False
    assert report["provenance"]["poses"] == {"by_rig": {"seed": 7}}


def test_info_in_words_names_domains_and_errors(lcollision: Lcollision, tube: Path) -> None:
    result = lcollision("info", tube)
    assert result.exit_code == 0
    assert "210 vertices, 416 faces, 16 poses, 2 domains, 8 codes a pose" in result.stdout
    assert "vertex error 0." in result.stdout
    assert "held-out poses" in result.stdout
    assert " 2  part 2  (" in result.stdout


def test_info_of_a_character_names_its_parts_and_nothing_trained(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    file = write_gltf(rigged_body(), tmp_path / "hero.glb")
    report = json.loads(lcollision("info", file, "--json").stdout)
    assert {"Torso", "Left forearm"} <= {domain["name"] for domain in report["domains"]}
    codes = sum(domain["codes"] for domain in report["domains"])
    assert report["latent_size"] == codes + 6
    trained = ("version", "reconstruction", "acap", "masks", "predictor")
    assert [report[field] for field in trained] == [None] * len(trained)
    assert report["rules"]["rest_exclusion"] == 0.02
    words = lcollision("info", file).stdout
    assert "posed by the joints of hero.glb" in words
    assert "predictor" not in words


def test_commands_apply_the_rules_that_were_chosen_for_a_character_and_say_so(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    file = write_gltf(rigged_body(), tmp_path / "hero.glb")
    body = open_body(file)
    assert isinstance(body, RigBody)
    remember_choices(body.with_rules(ContactRules(tolerated_depth=0.5)))
    words = lcollision("info", file).stdout
    assert "its contact rules are those that you chose for it" in words
    assert "not counted: pairs not deeper than 0.5" in words
    assert json.loads(lcollision("info", file, "--json").stdout)["rules"]["tolerated_depth"] == 0.5
    sampled = lcollision("sample", file, "-n", "1", "-o", tmp_path / "poses.json")
    assert sampled.exit_code == 0
    chosen = "hero uses the contact rules that you chose"
    assert (
        chosen
        in lcollision("mirror", file, tmp_path / "poses.json", "-o", tmp_path / "m.json").stderr
    )


@pytest.mark.slow
def test_contact_rules_of_a_character_are_shown_proposed_and_chosen(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    file = write_gltf(head_in_torso(30), tmp_path / "hero.glb")
    strict = lcollision("contacts", file, "--near-exclusion", 0, "--tolerated-depth", 1e-6)
    assert "the contact rules of hero have changed" in strict.stderr
    body = open_body(file)
    assert isinstance(body, RigBody)
    remember_choices(body.with_rules(ContactRules()))
    first = lcollision("contacts", file)
    assert first.stdout.startswith(
        "hero: every pair counts\n  10 of 10 sampled poses collide, 1 without"
    )
    assert "--ignore-proposed" in first.stdout
    assert first.stderr == ""
    report = json.loads(lcollision("contacts", file, "--json").stdout)
    assert report["rules"]["ignored"] == []
    proposed = ContactRules.from_json(report["proposed"]["rules"])
    assert proposed.touching
    assert not proposed.ignored
    accepted = lcollision("contacts", file, "--ignore-proposed")
    assert accepted.exit_code == 0
    assert "touch in nearly every pose" in accepted.stdout
    assert open_body(file).rules == proposed
    assert "nothing to ignore: " in lcollision("contacts", file, "--ignore-proposed").stderr
    restored = lcollision("contacts", file, "--defaults", "--ignore", "Head:Head")
    assert restored.exit_code == 0
    assert open_body(file).rules == replace(body.own_rules, ignored=(("Head", "Head"),))
    unknown = lcollision("contacts", file, "--ignore", "Hat:Head")
    assert unknown.exit_code == 2
    assert "'Hat'" in unknown.stderr
    assert open_body(file).rules.ignored == (("Head", "Head"),)


def test_the_parts_and_the_axis_of_a_character_are_changed_and_remembered(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    file = write_gltf(rigged_body(), tmp_path / "hero.glb")
    assert "  2  Torso  (" in lcollision("domains", file).stdout
    renamed = lcollision("domains", file, "--name", "2=trunk")
    assert "  2  trunk  (" in renamed.stdout
    assert open_body(file).domain_names[1] == "trunk"
    assert lcollision("upright", file).stdout == "hero: y is up\n"
    assert lcollision("upright", file, "--up", "z").stdout == "hero: z is up\n"
    assert open_body(file).up_axis == 2
    assert open_body(file, 0).up_axis == 0
    assert lcollision("upright", file, "--up", "y").stdout == "hero: y is up\n"
    again = open_body(file)
    assert (again.up_axis, again.domain_names[1]) == (1, "trunk")


def test_frames_of_a_character_are_checked_by_the_rules_that_it_is_posed_by(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    file = write_gltf(rigged_body(n_frames=12), tmp_path / "hero.glb")
    by_rig = json.loads(lcollision("info", file, "--json").stdout)["rules"]
    assert by_rig["near_exclusion"] == 0.1
    assert json.loads(lcollision("dataset", "check", file, "--json").stdout)["rules"] == by_rig


def test_contact_rules_of_a_model_are_kept_in_its_file_until_a_predictor_depends_on_them(
    lcollision: Lcollision, trained: Path, tmp_path: Path
) -> None:
    path = tmp_path / "own.safetensors"
    shutil.copy(trained, path)
    changed = lcollision("contacts", path, "--near-exclusion", 0.05)
    assert changed.exit_code == 0
    assert LearnedBody.load(path).rules == ContactRules(near_exclusion=0.05)
    bundled = lcollision("contacts", "body", "--near-exclusion", 0.05)
    assert bundled.exit_code == 2
    assert "has a predictor" in bundled.stderr


def test_figure_shows_each_domain_in_its_colour(
    lcollision: Lcollision, tube: Path, tmp_path: Path
) -> None:
    path = tmp_path / "masks.png"
    result = lcollision("info", tube, "--json", "--figure", path)
    assert result.exit_code == 0
    colours = [domain["colour"] for domain in json.loads(result.stdout)["domains"]]
    pixels = np.asarray(Image.open(path).convert("RGB"), dtype=float)
    assert pixels.shape[0] > 800
    # The model's upper domain is listed first and drawn above the other, on both sides.
    surface = pixels[:1300].reshape(1300, 2, 900, 3)
    for side in range(2):
        levels = []
        for colour in colours:
            wanted = np.array(list(bytes.fromhex(colour[1:])), dtype=float)
            drawn = surface[:, side]
            length = np.linalg.norm(drawn, axis=2) * np.linalg.norm(wanted)
            alike = (drawn @ wanted / np.maximum(length, 1.0) > 0.99) & (np.ptp(drawn, axis=2) > 60)
            assert alike.sum() > 5000
            levels.append(np.nonzero(alike)[0].mean())
        assert levels[0] < levels[1]
    assert (pixels[:20] == 255).all()


@pytest.mark.slow
def test_a_figure_is_drawn_without_a_word_where_nothing_can_be_cached(
    tube: Path, tmp_path: Path
) -> None:
    # Even root cannot create anything below a file.
    home, path = tmp_path / "home", tmp_path / "masks.png"
    home.touch()
    kept = {name: value for name, value in os.environ.items() if not name.startswith("XDG_")}
    for name in ("MPLCONFIGDIR", "MESA_SHADER_CACHE_DISABLE"):
        kept.pop(name, None)
    result = subprocess.run(
        [sys.executable, "-m", "app", "info", tube, "--json", "--figure", path],
        env={**kept, "HOME": str(home)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert path.exists()
    assert [
        line for line in result.stderr.splitlines() if not line.startswith("lcollision: ")
    ] == []


def test_domains_are_listed_and_renamed_for_good(lcollision: Lcollision, tube: Path) -> None:
    result = lcollision("domains", tube)
    assert result.exit_code == 0
    assert [line.split("  ")[2] for line in result.stdout.splitlines()] == ["part 1", "part 2"]
    before = LearnedBody.load(tube)
    result = lcollision("domains", tube, "--name", "2=foot = end", "--name", "1=neck")
    assert result.exit_code == 0
    assert "neck" in result.stdout
    after = LearnedBody.load(tube)
    assert after.domain_names == ("neck", "foot = end")
    assert after.fingerprint == before.fingerprint
    assert np.array_equal(after.known_poses, before.known_poses)
    assert "foot = end" in lcollision("domains", tube).stdout
    lcollision("domains", tube, "--name", "1=foot = end", "--name", "2=neck")
    assert LearnedBody.load(tube).domain_names == ("foot = end", "neck")


@pytest.mark.slow
def test_two_renamings_at_once_lose_no_name(tube: Path) -> None:
    command = [sys.executable, "-m", "app", "domains", tube, "--name"]
    renamings = [
        subprocess.Popen([*command, request], stdout=subprocess.DEVNULL)
        for request in ("1=neck", "2=foot")
    ]
    assert [renaming.wait(timeout=600) for renaming in renamings] == [0, 0]
    assert LearnedBody.load(tube).domain_names == ("neck", "foot")
    assert list(tube.parent.iterdir()) == [tube]


def test_a_model_renamed_while_another_is_trained_to_its_file_stays(
    lcollision: Lcollision,
    dataset: Path,
    tube: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from lcollision_core.tasks import learning

    train = learning.train_embedding

    def rename_then_train(poses: PoseSet, config: EmbeddingConfig, **options: Any) -> Any:
        change_model(tube, lambda model: model.edit_domains({0: "neck"}))
        quick = replace(config, level1_epochs=10, level2_epochs=5, held_out_stride=0)
        return train(poses, quick, **options)

    monkeypatch.setattr(learning, "train_embedding", rename_then_train)
    result = lcollision("train", "embedding", dataset, "-o", tube, "--domains", 1, "--seed", 2)
    assert result.exit_code == 0, result.output
    beside = tube.with_name("tube 2.safetensors")
    assert f"was left alone; the trained model is {beside}" in result.stderr
    assert LearnedBody.load(tube).domain_names == ("neck", "part 2")
    assert LearnedBody.load(beside).domain_names == ("part 1",)


def test_two_trainings_to_one_file_are_refused(
    lcollision: Lcollision, dataset: Path, tube: Path
) -> None:
    with locked(checkpoint_path(tube)):
        sentence = refusal(lcollision, "train", "embedding", dataset, "-o", tube, *TRAINING)
    assert f"{checkpoint_path(tube)} is being written by another command" in sentence


@pytest.mark.parametrize("request_", ["3=tail", "0=tail", "x=tail", "tail", "1=", "1=fine", "=a"])
def test_bad_renamings_change_nothing(lcollision: Lcollision, tube: Path, request_: str) -> None:
    before = tube.read_bytes()
    refusal(lcollision, "domains", tube, "--name", "2=fine", "--name", request_)
    assert tube.read_bytes() == before


def test_bundled_models_are_not_renamed(
    lcollision: Lcollision, tube: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = tube.read_bytes()
    monkeypatch.setattr("lcollision_core.bodies.learned_body.bundled_folder", lambda _: tube.parent)
    assert "part 1" in lcollision("domains", "tube").stdout
    assert "bundled model" in refusal(lcollision, "domains", "tube", "--name", "1=neck")
    assert tube.read_bytes() == before


def test_models_are_listed_and_used_by_name(
    lcollision: Lcollision, tube: Path, user_models: Path, tmp_path: Path
) -> None:
    user_models.mkdir(parents=True)
    shutil.copy(tube, user_models / "my tube.safetensors")
    result = lcollision("models", "--json")
    assert result.exit_code == 0
    (mine,) = (report for report in json.loads(result.stdout) if not report["bundled"])
    assert mine["name"] == "my tube"
    assert mine["vertices"] == 210
    assert mine["reconstruction"]["mean"] > 0
    assert "my tube: 210 vertices" in lcollision("models").stdout
    poses = tmp_path / "poses.json"
    assert lcollision("sample", "my tube", "-n", 2, "-o", poses).exit_code == 0
    assert poses.exists()
    sentence = refusal(lcollision, "info", "our tube")
    assert "'our tube'" in sentence
    assert "my tube" in sentence


def test_a_damaged_model_is_named_and_the_others_are_listed(
    lcollision: Lcollision, tube: Path, user_models: Path
) -> None:
    user_models.mkdir(parents=True)
    shutil.copy(tube, user_models / "good.safetensors")
    (user_models / "bad.safetensors").write_bytes(tube.read_bytes()[:-1])
    model = LearnedBody.load(tube)
    record = Section({}, {"preset": "paper", "config": {"epochs": 0}, "metrics": None})
    odd = LearnedBody("odd", model.embedding, model.card, {"predictor": record})
    odd.save(user_models / "odd.safetensors")
    result = lcollision("models")
    assert result.exit_code == 2
    assert "good: 210 vertices" in result.stdout
    assert "bad.safetensors" in result.stderr
    assert "odd.safetensors is unusable: the model's predictor does not fit" in result.stderr


def test_no_models_are_no_error(
    lcollision: Lcollision, user_models: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lcollision_core.bodies.learned_body.bundled_folder", lambda _: user_models)
    result = lcollision("models")
    assert result.exit_code == 0
    assert str(user_models) in result.stdout
    assert json.loads(lcollision("models", "--json").stdout) == []


def test_samples_are_the_seeds_own(lcollision: Lcollision, tube: Path, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.json", "b.json", "c.json")]
    for path, seed in zip(files, (5, 5, 6), strict=True):
        assert lcollision("sample", tube, "-n", 12, "-o", path, "--seed", seed).exit_code == 0
    assert files[0].read_bytes() == files[1].read_bytes()
    model = LearnedBody.load(tube)
    poses = read_poses(files[0], model)
    assert [pose.name for pose in poses] == [f"sample {n:02d}" for n in range(1, 13)]
    other = read_poses(files[2], model)
    assert not np.array_equal(poses[0].latent, other[0].latent)


def test_poses_of_another_model_are_refused_with_its_name(
    lcollision: Lcollision, tube: Path, user_models: Path, tmp_path: Path
) -> None:
    poses = bundled_file("poses", "body.json")
    for command in (("decode", tube, poses), ("mirror", tube, poses)):
        sentence = refusal(lcollision, *command, "-o", tmp_path / "out.json")
        assert "contains poses of the model 'body', not of 'tube'; use them with 'body'" in sentence
        assert LearnedBody.load("body").fingerprint not in sentence
    assert not user_models.exists()


def test_what_the_editor_saved_is_decoded_with_its_working_pose(
    lcollision: Lcollision, tube: Path, tmp_path: Path
) -> None:
    model, poses = LearnedBody.load(tube), tmp_path / "poses.json"
    first, second = (NamedPose("kick", row) for row in model.known_poses[:2])
    write_poses(poses, model, [first], second)
    assert lcollision("decode", tube, poses, "-o", tmp_path / "out").exit_code == 0
    files = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert files == ["kick 2.obj", "kick.obj"]


@pytest.mark.parametrize(("option", "status"), [("--free", 0), ("--colliding", 1)])
def test_exported_samples_are_of_the_kind_asked_for(
    lcollision: Lcollision, tube: Path, tmp_path: Path, option: str, status: int
) -> None:
    poses, folder = tmp_path / "poses.json", tmp_path / "meshes"
    assert lcollision("sample", tube, "-n", 6, "-o", poses, option).exit_code == 0
    assert lcollision("decode", tube, poses, "-o", folder, "--format", "ply").exit_code == 0
    meshes = sorted(folder.iterdir())
    assert [mesh.name for mesh in meshes] == [f"sample {n}.ply" for n in range(1, 7)]
    result = lcollision("check", "--json", *meshes)
    assert result.exit_code == status
    assert [report["colliding"] for report in json.loads(result.stdout)] == [bool(status)] * 6


def test_a_mesh_comes_back_to_its_place(lcollision: Lcollision, tube: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    model = LearnedBody.load(tube)
    latent = model.latent_space.sample(2, rng)
    meshes = []
    for place, vertices in enumerate(model.decode(latent)):
        meshes.append(tmp_path / f"mesh {place}.obj")
        write_mesh(meshes[-1], vertices @ random_rotation(rng).T + 1000.0, model.faces)
    poses, folder = tmp_path / "poses.json", tmp_path / "back"
    result = lcollision("encode", tube, *meshes, "-o", poses)
    assert result.exit_code == 0
    assert "mesh 1: fit error of 0.000 % of the body size" in result.stdout
    encoded = read_poses(poses, model)
    assert [pose.name for pose in encoded] == ["mesh 0", "mesh 1"]
    for pose, wanted in zip(encoded, latent, strict=True):
        assert pose.latent == pytest.approx(wanted, abs=1e-4 * np.abs(wanted).max())
        assert pose.fit_error_max == pytest.approx(0.0, abs=1e-6)
    assert lcollision("decode", tube, poses, "-o", folder).exit_code == 0
    for mesh in meshes:
        back = read_mesh(folder / mesh.name).vertices
        assert np.abs(back - read_mesh(mesh).vertices).max() < 1e-5 * LENGTH_IN_FILES


def test_form_of_the_output_decides_what_decode_writes(
    lcollision: Lcollision, tube: Path, tmp_path: Path
) -> None:
    one, two = tmp_path / "one.json", tmp_path / "two.json"
    lcollision("sample", tube, "-n", 1, "-o", one)
    lcollision("sample", tube, "-n", 2, "-o", two)
    model = LearnedBody.load(tube)
    mesh = tmp_path / "mesh.GLB"
    assert lcollision("decode", tube, one, "-o", mesh).exit_code == 0
    decoded = model.decode(read_poses(one, model)[0].latent)
    assert np.array_equal(read_mesh(mesh).vertices, decoded.astype(np.float32))
    copy = tmp_path / "copy.json"
    assert lcollision("decode", tube, two, "-o", copy).exit_code == 0
    assert copy.read_bytes() == two.read_bytes()
    existing = tmp_path / "folder.with.dots"
    existing.mkdir()
    assert lcollision("decode", tube, two, "-o", existing).exit_code == 0
    assert sorted(path.name for path in existing.iterdir()) == ["sample 1.obj", "sample 2.obj"]
    for output, sentence in (
        (tmp_path / "both.obj", "2 poses; name a folder"),
        (tmp_path / "both.xyz", ".xyz is not a format of poses"),
        (tmp_path / ("x" * 300), "File name too long"),
        (tmp_path / "none" / "folder", "there is no folder"),
        (one / "folder", "there is no folder"),
    ):
        assert sentence in refusal(lcollision, "decode", tube, two, "-o", output)
        assert not os.path.lexists(output)


def test_pose_names_that_are_no_file_names_are_made_safe(
    lcollision: Lcollision, tube: Path, tmp_path: Path
) -> None:
    poses, folder = tmp_path / "poses.json", tmp_path / "meshes"
    given = ("../up", "A", "a", ". .", "\N{DANCER}" * 100, "con", "two\nlines", "\u00e9", "e\u0301")
    lcollision("sample", tube, "-n", len(given), "-o", poses)
    document = json.loads(poses.read_text())
    for pose, name in zip(document["poses"], given, strict=True):
        pose["name"] = name
    poses.write_text(json.dumps(document))
    assert lcollision("decode", tube, poses, "-o", folder, "--format", "off").exit_code == 0
    names = sorted(path.name for path in folder.iterdir())
    assert names == sorted(
        [
            *("A.off", "_up.off", "a 2.off", "pose.off", "_con.off", "two_lines.off"),
            *("\u00e9.off", "e\u0301 2.off", "\N{DANCER}" * 32 + ".off"),
        ]
    )
    assert not (tmp_path / "up.off").exists()


def test_bad_input_is_refused_in_a_sentence_and_leaves_nothing(
    lcollision: Lcollision, tube: Path, dataset: Path, tmp_path: Path
) -> None:
    work = tmp_path / "work"
    work.mkdir()
    mesh, foreign = work / "mesh.obj", work / "foreign.obj"
    model = LearnedBody.load(tube)
    write_mesh(mesh, model.reference, model.faces)
    write_mesh(foreign, model.reference, model.faces[:-1])
    larger = work / "larger.obj"
    write_mesh(larger, 1000.0 * model.reference, model.faces)
    other_model = work / "other.safetensors"
    other_model.write_bytes(b"not a model")
    poses = work / "poses.json"
    before = sorted(work.iterdir())
    output = work / "out"
    refusals = [
        (("info", other_model), "not an LCollision model"),
        (("info", "."), "it is a folder, not a plain file"),
        (("domains", tube, "--role", "Leg"), "'Leg' does not set a role; write JOINT=ROLE"),
        (("info", tube, "--figure", work / "m.jpg"), "must be a .png file"),
        (("info", tube, "--figure", work / "none" / "m.png"), "no folder"),
        (("encode", tube, mesh, foreign, "-o", poses), "foreign.obj has 415 faces"),
        (("encode", tube, work / "none.obj", "-o", poses), "none.obj"),
        (("encode", tube, mesh, larger, "-o", poses), "larger.obj cannot be encoded"),
        (("encode", tube, mesh, "-o", work / "poses.obj"), "must be a .json file"),
        (("encode", other_model, mesh, "-o", poses), "not an LCollision model"),
        (("decode", tube, poses, "-o", output), "no such file"),
        (("decode", tube, mesh, "-o", output), "not JSON"),
        (("encode", tube, mesh, "-o", poses, "--scale", "nan"), "scale must be a number above 0"),
        (("encode", tube, mesh, "-o", poses, "--scale", "1e300"), "is too large for the coord"),
        (("blender-addon", "-o", work / "addon.txt"), "must be a .zip file"),
        (("sample", tube, "-n", 1, "-o", work / "poses"), "must be a .json file"),
        (("train", "embedding", work / "none.npz", "-o", work / "m.safetensors"), "none.npz"),
        (("train", "embedding", dataset, "-o", work / "m.obj"), "a model is a .safetensors file"),
        (("train", "embedding", dataset, "-o", work / "x" / "m.safetensors"), "no folder"),
        (("train", "embedding", mesh, "-o", work / "m.safetensors"), "one mesh, not a pose set"),
    ]
    for arguments, sentence in refusals:
        assert sentence in refusal(lcollision, *arguments)
        assert sorted(work.iterdir()) == before


def test_poses_of_another_model_are_refused(
    lcollision: Lcollision, tube: Path, tmp_path: Path
) -> None:
    poses = tmp_path / "poses.json"
    lcollision("sample", tube, "-n", 1, "-o", poses)
    document = json.loads(poses.read_text())
    document["model"] = {"name": "dancer", "fingerprint": "0" * 16}
    poses.write_text(json.dumps(document))
    sentence = refusal(lcollision, "decode", tube, poses, "-o", tmp_path / "out")
    assert "model 'dancer'" in sentence


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
def test_an_interrupted_training_goes_on_and_ends_with_the_same_model(
    dataset: Path, trained: Path, tmp_path: Path
) -> None:
    output = tmp_path / "tube.safetensors"
    checkpoint = tmp_path / "tube.safetensors.checkpoint"
    code = after_checkpoint(3, "SIGINT") + "from app.cli.main import main\nmain()\n"
    command = [sys.executable, "-c", code, "train", "embedding", dataset, "-o", output, *TRAINING]
    process = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert process.returncode == 130, process.stderr
    assert "run the same command again" in process.stderr
    assert "Traceback" not in process.stderr
    assert sorted(tmp_path.iterdir()) == [output, checkpoint][1:]
    result = CliRunner().invoke(app, [str(argument) for argument in command[3:]])
    assert result.exit_code == 0, result.output
    assert f"continuing from {checkpoint}" in result.stderr
    assert list(tmp_path.iterdir()) == [output]
    assert output.read_bytes() == trained.read_bytes()


def test_a_mesh_far_from_every_pose_is_doubted(
    lcollision: Lcollision, tube: Path, tmp_path: Path
) -> None:
    """The mesh is flattened, with edges about as long as the body's."""
    model = LearnedBody.load(tube)
    mesh = tmp_path / "flat.obj"
    write_mesh(mesh, model.reference * [1.0, 1.0, 0.02], model.faces)
    out = tmp_path / "out.json"
    result = lcollision("encode", tube, mesh, "-o", out)
    assert result.exit_code == 0
    assert result.stdout.rstrip().endswith("is it this body, in the model's vertex order?")
    write_mesh(mesh, model.reference, model.faces)
    assert "which is large" not in lcollision("encode", tube, mesh, "-o", out).stdout


def test_glb_is_upright_whatever_is_up_in_the_model(
    lcollision: Lcollision, tube: Path, tmp_path: Path
) -> None:
    model = LearnedBody.load(tube)
    turned = tmp_path / "turned.safetensors"
    LearnedBody("turned", model.embedding, replace(model.card, up_axis=2), {}).save(turned)
    poses, mesh = tmp_path / "pose.json", tmp_path / "pose.glb"
    assert lcollision("sample", turned, "-n", 1, "-o", poses).exit_code == 0
    assert lcollision("decode", turned, poses, "-o", mesh).exit_code == 0
    decoded = model.decode(read_poses(poses, model)[0].latent).astype(np.float32)
    written = read_mesh(mesh).vertices
    assert np.array_equal(written, decoded[:, [0, 2, 1]] * [1.0, 1.0, -1.0])
    # A mesh imported upright is exported in its original placement.
    placed, again = tmp_path / "placed.json", tmp_path / "again.glb"
    assert lcollision("encode", turned, mesh, "-o", placed).exit_code == 0
    assert lcollision("decode", turned, placed, "-o", again).exit_code == 0
    assert read_mesh(again).vertices == pytest.approx(written, abs=1e-3 * model.body_size)


def test_a_model_that_hides_a_bundled_one_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    for name, said in (("body", "'body' now names this model"), ("mine", "")):
        path = user_models_folder() / f"{name}.safetensors"
        note_where_written(path, path)
        assert said in (text := capsys.readouterr().err)
        assert bool(said) == bool(text)
