"""``lcollision new``: from files to a model in one command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, open_body, own_source, read_poses
from lcollision_core.files import read_mesh, write_pose_set
from lcollision_core.files.scene_files import read_scene
from lcollision_core.learning_state import LearningStatus, RunState, Stage
from lcollision_core.options import Quality
from lcollision_core.tasks.learning import EFFORTS
from lcollision_core.tasks.work_folder import WorkFolder
from tests.app.support import Lcollision
from tests.bending_tube import bending_tube
from tests.core.tasks.test_run import SMALL
from tests.rigged_shapes import rigged_body, write_gltf
from tests.small_models import stored


@pytest.fixture(autouse=True)
def _small_effort(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EFFORTS, Quality.QUICK, SMALL)


@pytest.fixture
def tube(tmp_path: Path) -> Path:
    path = tmp_path / "tube.npz"
    write_pose_set(path, bending_tube(labelled=True))
    return path


def test_a_pose_set_becomes_a_model_with_a_card_and_a_picture(
    tube: Path, tmp_path: Path, lcollision: Lcollision
) -> None:
    model = tmp_path / "bent.safetensors"
    result = lcollision("new", tube, "-o", model, "--quality", "quick", "--json")
    assert result.exit_code == 0, result.stderr
    card = json.loads(result.stdout)
    assert (card["vertices"], card["poses"], card["samples"]) == (210, 16, 256)
    assert card["model"] == str(model)
    assert Path(card["picture"]).read_bytes().startswith(b"\x89PNG")
    assert card["rules"] == LearnedBody.load(model).rules.to_json()
    # No other files are left.
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "bent-parts.png",
        "bent.safetensors",
        "tube.npz",
    ]


@pytest.mark.slow
def test_a_character_is_posed_by_its_rig_and_given_back_in_its_own_file(
    tmp_path: Path, lcollision: Lcollision
) -> None:
    file = write_gltf(rigged_body(), tmp_path / "figure.glb")
    arguments = ("--quality", "quick", "--by-rig", "20", "--ignore", "Head:Torso")
    result = lcollision("new", file, "-o", "hero", *arguments)
    assert result.exit_code == 0, result.stderr
    model = LearnedBody.load("hero")
    learned = f"hero: {model.n_vertices} vertices, 2 body parts, learned from "
    assert learned + f"{len(model.card.pose_names)} poses" in result.stdout
    assert model.card.pose_names[0] == "rest"
    assert sum("rig" in name for name in model.card.pose_names) == 20
    assert model.rules.ignored == (("Head", "Torso"),)
    # Apart from those, its rules are the rig's.
    assert replace(model.rules, ignored=()) == open_body(file).rules
    sources = model.card.provenance["poses"]["sources"]
    assert [one["by_rig"]["drawn"] for one in sources if "by_rig" in one] == [20]
    assert own_source(model) == file
    assert model.appearance is not None
    sampled, posed = tmp_path / "poses.json", tmp_path / "posed.glb"
    assert lcollision("sample", "hero", "-n", 1, "-o", sampled).exit_code == 0
    written = lcollision("decode", "hero", sampled, "-o", posed)
    assert written.exit_code == 0, written.stderr
    expected = model.decode(read_poses(sampled, model)[0].latent)
    held = read_mesh(posed, topology=model.topology)
    assert np.allclose(held.vertices, expected, atol=1e-5 * model.body_size)
    # The character's own file: its joints are still nodes, its mesh keeps its name.
    assert {"Body", "LeftForeArm"} <= set(read_scene(posed).node_names)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("{folder}/none.glb",), "none.glb"),
        (("{folder}/same.npz",), "one pose isn't enough to learn from; add poses that differ"),
        (("{tube}", "--by-rig", "5"), "has no joints to pose it by"),
        (("{tube}", "--ignore", "nose"), "the ignored pair 'nose' is not A:B"),
        (("{tube}", "-o", "{folder}/tube.obj"), "a model is a .safetensors file"),
    ],
)
def test_what_cannot_be_learned_from_is_one_sentence(
    arguments: tuple[str, ...], sentence: str, tube: Path, tmp_path: Path, lcollision: Lcollision
) -> None:
    given = [one.format(folder=tmp_path, tube=tube) for one in arguments]
    poses = bending_tube(2)
    write_pose_set(tmp_path / "same.npz", replace(poses, vertices=poses.vertices[[0, 0]]))
    output = () if "-o" in given else ("-o", tmp_path / "m.safetensors")
    result = lcollision("new", *given, *output, "--quality", "quick")
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.glob("m.safetensors*"))


@pytest.mark.slow
def test_where_nearly_all_samples_collide_it_stops_before_the_predictor(
    tmp_path: Path, lcollision: Lcollision, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Make the run stop; a predictor can still be trained.
    monkeypatch.setattr("lcollision_core.tasks.learning.NEARLY_ALL", 0.0)
    file, model = write_gltf(rigged_body(), tmp_path / "figure.glb"), tmp_path / "m.safetensors"
    arguments = ("new", file, "-o", model, "--quality", "quick", "--by-rig", "20")
    result = lcollision(*arguments)
    assert result.exit_code == 2
    assert "of the first 1024 samples of the latent space collide" in result.stderr
    assert f"pose {file} by its joints, or leave parts out of the check" in result.stderr
    assert f"`lcollision edit {file}` poses it by its joints" in result.stderr
    assert not model.exists()
    again = lcollision(*arguments, "--regardless")
    assert again.exit_code == 0, again.stderr
    assert LearnedBody.load(model).has_predictor


def test_a_bundled_model_is_not_hidden(tube: Path, lcollision: Lcollision) -> None:
    result = lcollision("new", tube, "-o", "body", "--quality", "quick")
    assert result.exit_code == 2
    assert "a model 'body' already exists" in result.stderr


def test_info_says_how_far_a_model_is_that_is_being_learned(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    work = WorkFolder(tmp_path / "hero.safetensors")
    work.path.mkdir()
    work.write_status(
        LearningStatus(RunState.RUNNING, Stage.LABELS, 0.5, 0.62, seconds_left=120.0, facts=())
    )
    with work.lock():
        result = lcollision("info", tmp_path / "hero.safetensors")
        assert result.exit_code == 0, result.output
        assert result.stdout == (
            "hero: is being learned: labels 50 %, 62 % of all stages, about 2 minutes left\n"
        )
        report = json.loads(lcollision("info", tmp_path / "hero.safetensors", "--json").stdout)
        assert report["learning"]["running"]
        assert report["learning"]["done"] == 0.62
    said = lcollision("info", tmp_path / "hero.safetensors").stdout
    assert said.startswith("hero: its learning stopped at labels 50 %, 62 % of all stages; run its")


def test_a_model_that_is_there_is_not_replaced(
    tube: Path, tmp_path: Path, lcollision: Lcollision
) -> None:
    held = tmp_path / "held.safetensors"
    stored("tube").save(held)
    before = held.read_bytes()
    result = lcollision("new", tube, "-o", held, "--quality", "quick", "--seed", "1")
    assert result.exit_code == 2
    assert "a model 'held' already exists" in result.stderr
    assert held.read_bytes() == before
    assert not (tmp_path / "held.safetensors.work").exists()
