"""``lcollision train predictor``, ``evaluate`` and ``benchmark predictor``, end to end."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from app.benchmarks import predictor as timing
from app.cli.models import measured_model_sentence
from lcollision_core import predictor as predictors
from lcollision_core.bodies import (
    LearnedBody,
    NamedPose,
    PoseKind,
    find_model,
    learned_body,
    scoring,
    write_poses,
)
from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.labels import LabelStore, is_held_out
from lcollision_core.model_file import Section
from lcollision_core.predictor import PRESETS, CollisionPredictor, KindScores
from lcollision_core.predictor import config as predictor_config
from tests.app.support import Lcollision, refusal
from tests.bending_tube import bending_tube
from tests.core.killed import after_checkpoint

N_ROWS = 1000
SECONDS_TO_WAIT = 600.0


@pytest.fixture(autouse=True)
def _few_poses_on_the_card(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge a trained predictor on 40 poses of each kind instead of 500."""
    monkeypatch.setattr(scoring, "CARD_POSES", 40)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a small model, without a predictor."""
    from lcollision_core.embedding.training import train_embedding
    from lcollision_core.embedding.training_run import EmbeddingConfig

    poses = bending_tube()
    config = EmbeddingConfig(
        n_domains=2, n_domain_codes=3, level1_epochs=30, level2_epochs=5, held_out_stride=0
    )
    path = tmp_path_factory.mktemp("model") / "tube.safetensors"
    LearnedBody.from_training("tube", train_embedding(poses, config), poses).save(path)
    return path


@pytest.fixture(scope="module")
def n_rows(request: pytest.FixtureRequest) -> int:
    """Return the number of labelled samples: a test of quality asks for more."""
    return int(getattr(request, "param", N_ROWS))


@pytest.fixture(scope="module")
def store(lcollision: Lcollision, model: Path, n_rows: int) -> Path:
    """Return the model's labelled samples."""
    path = model.with_name(f"store {n_rows}")
    assert lcollision("label", model, "-n", n_rows, "-o", path).exit_code == 0
    return path


@pytest.fixture(scope="module")
def trained(lcollision: Lcollision, model: Path, store: Path, n_rows: int) -> Path:
    """Return a model with the paper's predictor, trained by the command.

    How well such a small predictor ranks depends on its seed; with others, on the processor too.
    """
    path = store.with_name(f"of {n_rows}") / "trained.safetensors"
    path.parent.mkdir()
    command = ("train", "predictor", model, store, "-o", path, "--preset", "paper", "--seed", 2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scoring, "CARD_POSES", 40)
        result = lcollision(*command)
    assert result.exit_code == 0, result.output
    assert result.stdout == ""
    said = _without_progress(result.stderr)
    assert said.startswith(f"lcollision: wrote {path}: ")
    assert f" on {3 * n_rows // 10} unseen samples" in said
    assert not path.with_name("trained.safetensors.checkpoint").exists()
    return path


def _without_progress(said: str) -> str:
    """Remove the progress lines that a slow machine prints."""
    lines = said.splitlines(keepends=True)
    return "".join(
        line for line in lines if not re.match(r"lcollision: epoch \d+ of \d+: \d+ %", line)
    )


@pytest.mark.slow
@pytest.mark.parametrize("n_rows", [2000], indirect=True)
def test_a_trained_predictor_beats_the_majority_on_real_labels(
    lcollision: Lcollision, trained: Path, store: Path
) -> None:
    report = json.loads(lcollision("evaluate", trained, store, "--kinds", 0, "--json").stdout)
    assert report["accuracy"] > report["majority_rate"] + 0.03
    assert report["spearman"] > 0.7


def test_a_trained_predictor_is_measured_on_real_labels(
    lcollision: Lcollision, trained: Path, store: Path
) -> None:
    result = lcollision("evaluate", trained, store, "--kinds", 40, "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    curve = report.pop("calibration")
    assert [one["kind"] for one in report.pop("kinds")] == [kind.value for kind in PoseKind]
    sure = report.pop("sure")
    assert [one["error_bound"] for one in sure] == [0.01, 0.03]  # smaller ones need more samples
    assert 0.0 < sure[0]["coverage"] < sure[1]["coverage"] <= 1.0
    assert [report.pop(name) for name in ("model", "level1_codes", "domain_codes")] == [
        "trained",
        2,
        [3, 3],
    ]
    assert report.pop("near_exclusion") == 0.0
    rows = LabelStore.open(store).load()
    held_out = rows.colliding[is_held_out(np.arange(N_ROWS))]
    assert report.pop("colliding_share") == held_out.mean()
    counts, intervals, parts = (report.pop(name) for name in ("counts", "intervals", "parts"))
    assert sum(counts.values()) == len(held_out)
    assert counts["true_positives"] + counts["false_negatives"] == held_out.sum()
    assert report["recall"] == counts["true_positives"] / held_out.sum()
    called = counts["true_positives"] + counts["false_positives"]
    assert report["precision"] == counts["true_positives"] / called
    for name, (low, high) in intervals.items():
        # The interval of a rate of 0 or 1 ends there.
        assert low < report[name] or low == report[name] == 0.0, name
        assert report[name] < high or report[name] == high == 1.0, name
    names = list(LearnedBody.load(trained).domain_names)
    assert [part["part"] for part in parts] == names
    assert all(part["auc"] > 0.6 for part in parts)
    assert set(report) == {
        "threshold",
        "samples",
        "accuracy",
        "false_positive_rate",
        "false_negative_rate",
        "majority_rate",
        "precision",
        "recall",
        "auc",
        "energy_mse",
        "ranking_margin",
        "spearman",
        "calibration_error",
    }
    assert report["samples"] == 3 * N_ROWS // 10
    assert report["accuracy"] > report["majority_rate"]
    assert sum(entry["samples"] for entry in curve) == report["samples"]
    # The file contains the figures that training measured on the held-out rows.
    predictor = LearnedBody.load(trained).predictor
    assert predictor is not None
    assert predictor.metrics is not None
    assert report["accuracy"] == predictor.metrics.accuracy
    assert predictor.config == PRESETS["paper"]
    assert predictor.facts.rows == N_ROWS
    assert predictor.facts.seed == 2


def test_each_sample_and_all_figures_are_written_where_that_is_asked_for(
    lcollision: Lcollision, trained: Path, store: Path, tmp_path: Path
) -> None:
    table, folder = tmp_path / "samples.csv", tmp_path / "figures"
    asked = ("--kinds", 0, "--threshold", 0.7, "--csv", table, "--figure", folder)
    result = lcollision("evaluate", trained, store, *asked)
    assert result.exit_code == 0, result.output
    with table.open() as file:
        samples = list(csv.DictReader(file))
    rows = LabelStore.open(store).load()
    numbers = np.array([int(sample["sample"]) for sample in samples])
    assert numbers.tolist() == np.flatnonzero(is_held_out(np.arange(N_ROWS))).tolist()
    probability = LearnedBody.load(trained).predict(rows.latent[numbers]).collision_probability
    assert [float(one["probability"]) for one in samples] == pytest.approx(probability, rel=1e-5)
    called = np.array([one["called_colliding"] == "1" for one in samples])
    assert np.array_equal(called, probability > 0.7)
    colliding = rows.colliding[numbers]
    assert [int(one["pairs"]) > 0 for one in samples] == colliding.tolist()
    right, wrong = int((called & colliding).sum()), int((called & ~colliding).sum())
    assert f"{right} called colliding rightly, {wrong} wrongly;" in result.stdout
    assert sorted(path.name for path in folder.iterdir()) == [
        "calibration.png",
        "risk.png",
        "roc.png",
    ]
    for path in folder.iterdir():
        picture = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
        blue = np.abs(picture.astype(int) - (18, 64, 133)).max(axis=1) < 40
        assert blue.sum() > 200, path.name


def test_poses_of_ones_own_are_listed_with_their_estimates(
    lcollision: Lcollision, trained: Path, tmp_path: Path
) -> None:
    model, poses, table = LearnedBody.load(trained), tmp_path / "poses.json", tmp_path / "poses.csv"
    latents = model.sample(3, np.random.default_rng(1))
    write_poses(poses, model, [NamedPose(f"p{n}", latent) for n, latent in enumerate(latents)])
    report = json.loads(lcollision("evaluate", trained, poses, "--csv", table, "--json").stdout)
    expected = model.predict(latents).collision_probability
    rows = report["poses"]
    assert [row["pose"] for row in rows] == ["p0", "p1", "p2"]
    assert [row["probability"] for row in rows] == pytest.approx(expected, rel=1e-5)
    free = model.exact_check().are_free(latents)
    assert [row["pairs"] == 0 for row in rows] == free.tolist()
    assert [row["colliding"] for row in rows] == (~free).astype(int).tolist()
    assert report["samples"] == 3
    assert report["kinds"] == []
    assert len(table.read_text().splitlines()) == 4
    said = lcollision("evaluate", trained, poses).stdout
    assert [line.split()[1] for line in said.splitlines()[1:4]] == [f"{p:.3f}" for p in expected]
    refused = refusal(lcollision, "evaluate", trained, poses, "--keep")
    assert "--keep and --rows are for label stores" in refused


def test_the_threshold_holds_for_the_kinds_of_poses_too(
    lcollision: Lcollision, trained: Path, store: Path
) -> None:
    reports = [
        json.loads(
            lcollision(
                "evaluate", trained, store, "--kinds", 40, "--threshold", threshold, "--json"
            ).stdout
        )["kinds"]
        for threshold in (0.0, 1.0)
    ]
    for all_called, none_called in zip(*reports, strict=True):
        assert all_called["accuracy"] == all_called["colliding_share"]
        assert none_called["accuracy"] == 1.0 - none_called["colliding_share"]


def test_the_figures_are_kept_and_drawn_where_that_is_asked_for(
    lcollision: Lcollision, trained: Path, store: Path, tmp_path: Path
) -> None:
    copy, figure = tmp_path / "copy.safetensors", tmp_path / "risk.png"
    bare = LearnedBody.load(trained)
    predictor = replace(bare.require_predictor(), metrics=None, kinds=())
    bare.with_predictor(predictor).save(copy)
    result = lcollision("evaluate", copy, store, "--kinds", 20, "--keep", "--figure", figure)
    assert result.exit_code == 0, result.output
    assert "error bound: samples with a sure verdict" in result.stdout
    (resolved,) = [line for line in result.stdout.splitlines() if "resolved" in line]
    kept = LearnedBody.load(copy).require_predictor()
    assert kept.metrics == bare.require_predictor().metrics
    assert [one.kind for one in kept.kinds] == [kind.value for kind in PoseKind]
    assert f"{100.0 * kept.kinds[-1].accuracy:.1f} %" in resolved
    picture = np.asarray(Image.open(figure).convert("RGB")).reshape(-1, 3)
    blue = np.abs(picture.astype(int) - (18, 64, 133)).max(axis=1) < 40
    assert blue.sum() > 200  # the curve is there
    shown = json.loads(lcollision("info", copy, "--json").stdout)["predictor"]
    assert [one["kind"] for one in shown["kinds"]] == [one.kind for one in kept.kinds]
    refused = refusal(lcollision, "evaluate", "body", store, "--keep")
    assert "labels the model" in refused


def test_figures_that_are_not_the_models_own_are_not_kept(
    lcollision: Lcollision,
    trained: Path,
    store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    copy = tmp_path / "copy.safetensors"
    bare = LearnedBody.load(trained)
    predictor = bare.require_predictor()
    kinds = (KindScores("blend", 10, 0.5, 0.9, 0.1, 0.1),)
    bare.with_predictor(replace(predictor, kinds=kinds)).save(copy)
    before = copy.read_bytes()
    for chosen in (("--rows", 100), ("--threshold", 0.9)):
        refused = refusal(lcollision, "evaluate", copy, store, "--keep", *chosen)
        assert "--keep is for figures of all rows" in refused
    assert copy.read_bytes() == before
    assert lcollision("evaluate", copy, store, "--keep", "--kinds", 0).exit_code == 0
    assert LearnedBody.load(copy).require_predictor().kinds == kinds
    measured = predictors.score_rows
    retrained = {name: 0.5 * array for name, array in predictor.arrays.items()}

    def while_another_is_trained(*args: Any, **options: Any) -> Any:
        scored = measured(*args, **options)
        bare.with_predictor(replace(predictor, arrays=retrained)).save(copy)
        return scored

    monkeypatch.setattr(predictors, "score_rows", while_another_is_trained)
    refused = refusal(lcollision, "evaluate", copy, store, "--keep", "--kinds", 0)
    assert "has another predictor than the one that was measured" in refused
    now = LearnedBody.load(copy).require_predictor()
    assert all(np.array_equal(now.arrays[name], array) for name, array in retrained.items())
    # Before anything is measured.
    monkeypatch.setattr(predictors, "score_rows", None)
    monkeypatch.setattr(learned_body, "bundled_folder", lambda _: tmp_path)
    refused = refusal(lcollision, "evaluate", copy, store, "--keep", "--kinds", 0)
    assert "is a bundled model and can't be changed" in refused


@pytest.mark.slow
def test_rows_that_set_where_to_call_do_not_count(
    lcollision: Lcollision,
    trained: Path,
    store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(predictor_config, "LEAST_BALANCING", 10)
    model = LearnedBody.load(trained)
    section = model.require_predictor().to_section()
    config = {**section.metadata["config"], "balanced": True}
    balanced = CollisionPredictor.from_section(
        Section(section.arrays, {**section.metadata, "config": config}), model.embedding
    )
    path = tmp_path / "balanced.safetensors"
    model.with_predictor(balanced).save(path)
    report = json.loads(lcollision("evaluate", path, store, "--kinds", 0, "--json").stdout)
    held_out = 3 * N_ROWS // 10
    assert report["samples"] == held_out - held_out // 10


def test_all_rows_of_another_store_count(
    lcollision: Lcollision, trained: Path, model: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    assert lcollision("label", model, "-n", 300, "-o", other, "--seed", 8).exit_code == 0
    report = json.loads(lcollision("evaluate", trained, other, "--kinds", 0, "--json").stdout)
    rows = LabelStore.open(other).load()
    prediction = LearnedBody.load(trained).predict(rows.latent)
    called = prediction.collision_probability > 0.5
    assert report["samples"] == 300
    assert report["accuracy"] == np.mean(called == rows.colliding)
    asked = ("--kinds", 0, "--threshold", 0.9, "--json")
    later = json.loads(lcollision("evaluate", trained, other, *asked).stdout)
    assert later["threshold"] == 0.9
    missed = (prediction.collision_probability <= 0.9)[rows.colliding]
    assert later["false_negative_rate"] == missed.mean() > report["false_negative_rate"]
    text = lcollision("evaluate", trained, other, "--kinds", 0, "--rows", 200).stdout
    assert text.startswith("trained, preset paper: ")
    assert " on 200 unseen samples" in text
    share = 100.0 * rows.colliding[:200].mean()
    sizes = "|Z_0| = 2, |Z_k| = 3 for 2 domains, no near exclusion"
    assert f"\n  {sizes}; {share:.1f} % of these 200 samples collide\n" in text


@pytest.mark.slow
def test_a_killed_training_goes_on_to_the_same_model(
    lcollision: Lcollision, model: Path, store: Path, tmp_path: Path
) -> None:
    killed, whole = tmp_path / "killed.safetensors", tmp_path / "whole.safetensors"
    options = ("--preset", "paper", "--no-domains", "--rows", 600)
    code = (
        f"import torch; torch.set_num_threads({torch.get_num_threads()})\n"
        f"{after_checkpoint(3)}"
        "from app.cli.main import main\n"
        "main()\n"
    )
    command = [sys.executable, "-c", code, "train", "predictor", model, store, "-o", killed]
    process = subprocess.run(
        [*map(str, command), *map(str, options)], timeout=SECONDS_TO_WAIT, check=False
    )
    assert process.returncode == -signal.SIGKILL
    checkpoint = killed.with_name(killed.name + ".checkpoint")
    assert checkpoint.exists()
    assert not killed.exists()
    results = [
        lcollision("train", "predictor", model, store, "-o", path, *options)
        for path in (killed, whole)
    ]
    assert results[0].stderr.startswith(f"lcollision: continuing from {checkpoint}\n")
    wrote, measured = _without_progress(results[1].stderr).splitlines()[:2]
    assert wrote.startswith(f"lcollision: wrote {whole}: ")
    share = 100.0 * LabelStore.open(store).load(600).colliding.mean()
    sizes = "|Z_0| = 2, |Z_k| = 3 for 2 domains, no near exclusion"
    assert measured == f"lcollision: {sizes}; {share:.1f} % of random poses collide"
    assert not checkpoint.exists()
    assert killed.read_bytes() == whole.read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for another process")
@pytest.mark.parametrize(("preset", "kept"), [("paper", ""), ("default", ".patches")])
def test_ctrl_c_keeps_a_checkpoint_and_says_so(
    model: Path, store: Path, tmp_path: Path, preset: str, kept: str
) -> None:
    """The preset default starts by labelling patches, which are stored some rows at a time."""
    output = tmp_path / "stopped.safetensors"
    code = (
        "import os, signal\n"
        "from lcollision_core.predictor import training_loop as loop\n"
        "loop._LEAST_PATCHES_KEPT = 16\n"
        "report = loop.TrainingLoop._report\n"
        "def interrupted(self, step):\n"
        "    report(self, step)\n"
        "    if self.config.preset == 'paper' or self._patches_path.exists():\n"
        "        loop.TrainingLoop._report = report\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "loop.TrainingLoop._report = interrupted\n"
        "from app.cli.main import main\n"
        "main()\n"
    )
    command = [sys.executable, "-c", code, "train", "predictor", model, store, "-o", output]
    result = subprocess.run(
        [*command, "--preset", preset],
        capture_output=True,
        text=True,
        timeout=SECONDS_TO_WAIT,
        check=False,
    )
    checkpoint = output.with_name(output.name + ".checkpoint")
    assert result.returncode == 130
    assert _without_progress(result.stderr) == (
        f"lcollision: stopped; run the same command again to continue from {checkpoint}\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == [f"{checkpoint.name}{kept}"]


def _finish_with(
    monkeypatch: pytest.MonkeyPatch, trained: Path, meanwhile: Callable[[], object]
) -> None:
    """Let training change the files, and return an already trained predictor."""
    finished = LearnedBody.load(trained).predictor

    def train(*_: object, **__: object) -> CollisionPredictor | None:
        meanwhile()
        return finished

    monkeypatch.setattr("lcollision_core.predictor.train_predictor", train)


@pytest.mark.slow
def test_a_renaming_during_the_training_stays(
    lcollision: Lcollision,
    model: Path,
    store: Path,
    trained: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = Path(shutil.copy(model, tmp_path / "tube.safetensors"))
    _finish_with(monkeypatch, trained, lambda: lcollision("domains", path, "--name", "2=left foot"))
    result = lcollision("train", "predictor", path, store, "-o", path)
    assert result.exit_code == 0, result.output
    kept = LearnedBody.load(path)
    assert kept.domain_names == ("part 1", "left foot")
    assert kept.has_predictor
    assert len(kept.free_latent) > 0
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
@pytest.mark.parametrize("change", ["another body", "no model", "gone"])
def test_what_replaced_the_model_during_the_training_stays(
    lcollision: Lcollision,
    model: Path,
    store: Path,
    trained: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    change: str,
) -> None:
    path = Path(shutil.copy(model, tmp_path / "tube.safetensors"))
    changes: dict[str, Callable[[], object]] = {
        "another body": lambda: shutil.copy(find_model("body"), path),
        "no model": lambda: path.write_bytes(b"another program's"),
        "gone": path.unlink,
    }
    _finish_with(monkeypatch, trained, changes[change])
    result = lcollision("train", "predictor", path, store, "-o", path)
    assert result.exit_code == 0, result.output
    if change == "gone":
        assert LearnedBody.load(path).has_predictor
        assert list(tmp_path.iterdir()) == [path]
        return
    beside = tmp_path / "tube 2.safetensors"
    assert f"{path} was replaced" in result.stderr
    assert f"the trained model is {beside}" in result.stderr
    assert LearnedBody.load(beside).has_predictor
    stays = find_model("body").read_bytes() if change == "another body" else b"another program's"
    assert path.read_bytes() == stays


def test_what_cannot_be_trained_or_evaluated_is_refused(
    lcollision: Lcollision, model: Path, store: Path, trained: Path, tmp_path: Path
) -> None:
    from lcollision_core.embedding.training import train_embedding
    from lcollision_core.embedding.training_run import EmbeddingConfig

    output = tmp_path / "m.safetensors"
    few = bending_tube(9)
    config = EmbeddingConfig(
        n_domains=2, n_domain_codes=2, level1_epochs=1, level2_epochs=1, held_out_stride=0
    )
    other = tmp_path / "other.safetensors"
    LearnedBody.from_training("other", train_embedding(few, config), few).save(other)
    assert "not the model " in refusal(lcollision, "train", "predictor", other, store, "-o", output)
    assert "has no predictor; run" in refusal(lcollision, "evaluate", model, store)
    assert "there is no label store" in refusal(
        lcollision, "train", "predictor", model, tmp_path / "none", "-o", output
    )
    assert "only the preset paper can be trained with the loss no-rank" in refusal(
        lcollision, "train", "predictor", model, store, "-o", output, "--loss", "no-rank"
    )
    too_many = ("--rows", N_ROWS + 1)
    assert f"has {N_ROWS} rows, not {N_ROWS + 1}" in refusal(
        lcollision, "train", "predictor", model, store, "-o", output, *too_many
    )
    assert "none of which is held out" in refusal(
        lcollision, "evaluate", trained, store, "--rows", 5
    )
    nearer = tmp_path / "nearer.safetensors"
    loaded = LearnedBody.load(trained)
    changed = LearnedBody(
        "nearer", loaded.embedding, replace(loaded.card, rules=ContactRules(0.2)), {}
    )
    assert loaded.predictor is not None
    changed.with_predictor(loaded.predictor).save(nearer)
    assert "near exclusion of 0.0, not" in refusal(lcollision, "evaluate", nearer, store)
    assert measured_model_sentence(changed).endswith("for 2 domains, near exclusion 0.2")
    assert not output.exists()


@pytest.mark.slow
def test_the_benchmark_times_the_predictor_beside_the_exact_check(
    lcollision: Lcollision, trained: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timing, "TABLE_POSES", 900)
    result = lcollision("benchmark", "predictor", "--model", trained, "-n", 300, "--json")
    assert result.exit_code == 0, result.output
    row = json.loads(result.stdout)[0]
    assert (row["device"], row["preset"], row["batch"]) == ("cpu", "paper", 500)
    assert (row["model"], row["level1_codes"], row["domain_codes"]) == ("trained", 2, [3, 3])
    assert row["near_exclusion"] == 0.0
    assert (row["table_poses"], row["exact_poses"], row["fcl_poses"]) == (900, 300, 8)
    exact = row["exact_ms_per_pose"] + row["decode_ms_per_pose"]
    assert row["speedup"] == pytest.approx(1e3 * exact / row["us_per_pose"])
    assert row["exact_seconds"] == pytest.approx(0.9 * exact)
    assert row["fcl_seconds"] > row["exact_seconds"]
    assert 0.0 < row["gemm_fraction"] < 3.0
    assert row["gradient_ms"] > 0.0
    loaded = LearnedBody.load(trained)
    vertices = loaded.decode(timing.drawn_poses(loaded, 300))
    detector = CollisionDetector(loaded.topology, loaded.reference)
    assert row["colliding_share"] == detector.are_colliding(vertices).mean()
    text = lcollision("benchmark", "predictor", "--model", trained, "-n", 20).stdout
    assert text.startswith("trained: |Z_0| = 2, |Z_k| = 3 for 2 domains, no near exclusion\n")
    assert re.search(r"exact_poses +20\b", text, re.MULTILINE)
    assert "has no predictor" in refusal(lcollision, "benchmark", "predictor", "--model", model)


def test_floating_point_operations_are_those_of_the_layers(trained: Path) -> None:
    predictor = LearnedBody.load(trained).predictor
    assert predictor is not None
    size, codes = predictor.embedding.latent_size, 3
    encoder = size * 512 + 512 * 256 + 256 * 256
    each = (256 + codes) * 512 + 512 * 256 + 256 * 256 + 256 * 128 + 128
    assert predictor.flops(7) == 7 * 2 * (encoder + 2 * each + 2 * 64 + 64)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["info", "models"])
def test_describing_a_predictor_loads_no_torch(trained: Path, tmp_path: Path, command: str) -> None:
    """Importing torch takes longer than everything else that these commands do."""
    users = tmp_path / "lcollision" / "models"
    users.mkdir(parents=True)
    shutil.copy(trained, users / "tube.safetensors")
    words = ["info", "tube"] if command == "info" else ["models"]
    code = (
        "import sys\n"
        "from app.cli.main import app\n"
        f"app({words!r}, standalone_mode=False)\n"
        "print('torch' in sys.modules)"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "XDG_DATA_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    *lines, torch_is_loaded = ended.stdout.splitlines()
    assert any("predictor paper, of 1000 labelled" in line for line in lines)
    assert torch_is_loaded == "False"
