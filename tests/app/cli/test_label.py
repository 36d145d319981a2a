"""``lcollision label``."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody
from lcollision_core.contact import ContactRules, RuleCounts
from lcollision_core.embedding.training import train_embedding
from lcollision_core.embedding.training_run import EmbeddingConfig
from lcollision_core.labels import ROWS_PER_CHUNK, LabelStore
from tests.app.support import Lcollision, refusal
from tests.bending_tube import bending_tube
from tests.core.labelled import as_bytes

SECONDS_TO_WAIT = 600.0


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a barely trained model: its quality does not matter here."""
    poses = bending_tube()
    config = EmbeddingConfig(
        n_domains=2, n_domain_codes=3, level1_epochs=10, level2_epochs=2, held_out_stride=0
    )
    path = tmp_path_factory.mktemp("model") / "tube.safetensors"
    LearnedBody.from_training("tube", train_embedding(poses, config), poses).save(path)
    return path


def _start(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "app", "label", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _wait_for_chunks(store: Path, n_chunks: int, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + SECONDS_TO_WAIT
    while len(list(store.glob("*.npz"))) < n_chunks:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_label_says_how_many_and_what_share_collides(
    lcollision: Lcollision, model: Path, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    result = lcollision("label", model, "-n", 600, "-o", store)
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    share = 100.0 * LabelStore.open(store).load().colliding.mean()
    assert share > 0.5
    expected = f"{store}: 600 rows of tube, {share:.1f} % collide (600 labelled now, "
    assert result.stdout.startswith(expected)
    sizes = "|Z_0| = 2, |Z_k| = 3 for 2 domains, no near exclusion"
    assert result.stdout.endswith(f"/s)\n  {sizes}\n")


def test_json_is_one_document_and_a_second_run_has_nothing_to_do(
    lcollision: Lcollision, model: Path, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    for labelled in (300, 0):
        result = lcollision("label", model, "-n", 300, "-o", store, "--seed", 4, "--json")
        assert result.exit_code == 0
        report = json.loads(result.stdout)
        assert report.pop("seconds") > 0.0
        assert report == {
            "store": str(store),
            "model": "tube",
            "seed": 4,
            "draws": "box",
            "rows": 300,
            "labelled": labelled,
            "colliding_share": LabelStore.open(store).load().colliding.mean(),
            "level1_codes": 2,
            "domain_codes": [3, 3],
            "near_exclusion": 0.0,
            "excluded_at_rest": RuleCounts().to_json(),
        }
        assert result.stderr == ""


def test_info_says_what_a_label_store_is(
    lcollision: Lcollision, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "store"
    order = ("label", model, "-n", 320, "-o", store, "--draws", "mixed", "--seed", 3)
    assert lcollision(*order).exit_code == 0
    report = json.loads(lcollision("info", store, "--json").stdout)
    fingerprint = LearnedBody.load(model).fingerprint
    # Half of mixed samples are of the box; the last three of ten of these are held out.
    n_held_out = sum(index % 10 >= 7 and index % 32 < 16 for index in range(320))
    assert report == {
        "store": str(store),
        "model": None,
        "fingerprint": fingerprint,
        "rows": 320,
        "held_out": n_held_out,
        "seed": 3,
        "draws": "mixed",
        "rules": ContactRules().to_json(),
    }
    said = lcollision("info", store).stdout
    assert "a label store that `lcollision label` made, 320 rows of a model that is not" in said
    assert f"{n_held_out} of them (15 %) held out" in said
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    models = tmp_path / "data" / "lcollision" / "models"
    models.mkdir(parents=True)
    shutil.copy(model, models / "mine.safetensors")
    assert "320 rows of mine (mixed, seed 3)" in lcollision("info", store).stdout


def test_fewer_than_there_are_takes_none_away(
    lcollision: Lcollision, model: Path, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    assert lcollision("label", model, "-n", 300, "-o", store).exit_code == 0
    result = lcollision("label", model, "-n", 200, "-o", store)
    assert result.exit_code == 0
    assert result.stderr == f"lcollision: {store} already has more than 200 rows; kept\n"
    assert result.stdout.startswith(f"{store}: 300 rows of tube, ")


def test_a_store_of_mixed_samples_goes_on_as_it_began(
    lcollision: Lcollision, model: Path, tmp_path: Path
) -> None:
    store, whole = tmp_path / "store", tmp_path / "whole"
    for order in (("-n", 40, "--draws", "mixed"), ("-n", 100)):
        report = json.loads(lcollision("label", model, *order, "-o", store, "--json").stdout)
        assert report["draws"] == "mixed"
    assert lcollision("label", model, "-n", 100, "--draws", "mixed", "-o", whole).exit_code == 0
    rows = [LabelStore.open(path).load() for path in (store, whole)]
    assert as_bytes(rows[0]) == as_bytes(rows[1])
    refused = refusal(lcollision, "label", model, "-n", 100, "--draws", "box", "-o", store)
    assert "labels mixed samples, not box samples" in refused


@pytest.mark.slow
def test_a_killed_run_goes_on_and_ends_with_the_same_rows(
    lcollision: Lcollision, model: Path, tmp_path: Path
) -> None:
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    process = _start(model, "-n", 200_000, "-o", killed)
    _wait_for_chunks(killed, 2, process)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    kept = LabelStore.open(killed)
    assert 2 * ROWS_PER_CHUNK <= kept.n_rows < 200_000
    before = kept.load()

    n_rows = kept.n_rows + 300
    result = lcollision("label", model, "-n", n_rows, "-o", killed, "--workers", 1, "--json")
    assert json.loads(result.stdout)["labelled"] == 300
    assert lcollision("label", model, "-n", n_rows, "-o", whole, "--workers", 2).exit_code == 0
    rows = LabelStore.open(killed).load()
    assert as_bytes(rows) == as_bytes(LabelStore.open(whole).load())
    assert as_bytes(rows.taken(slice(len(before)))) == as_bytes(before)
    assert len(np.unique(rows.latent, axis=0)) == n_rows


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for another process")
def test_ctrl_c_keeps_what_is_there_and_says_so(model: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    process = _start(model, "-n", 200_000, "-o", store)
    _wait_for_chunks(store, 1, process)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=SECONDS_TO_WAIT)
    assert process.returncode == 130
    assert stdout == ""
    n_rows = LabelStore.open(store).n_rows
    assert n_rows >= ROWS_PER_CHUNK
    assert stderr == (
        f"lcollision: stopped; {store} has {n_rows} rows; run the same command again to continue\n"
    )


def test_damage_is_told_found_by_check_and_repaired(
    lcollision: Lcollision, model: Path, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    order = ("label", model, "-o", store, "--seed", 3)
    assert lcollision(*order, "-n", 2100).exit_code == 0
    whole = LabelStore.open(store).load()
    result = lcollision("label", model, "-o", store, "--check")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == f"{store}: intact, 2100 rows of tube\n"

    chunk = store / "0000001024-0000002047.npz"
    content = bytearray(chunk.read_bytes())
    content[9000] ^= 4
    chunk.write_bytes(content)
    repair = f"run `lcollision label M -n 2100 -o {store} --seed 3` with its model M"
    sentence = refusal(
        lcollision, "train", "predictor", model, store, "-o", tmp_path / "m.safetensors"
    )
    assert f"{store} is damaged: rows 1024 to 2047 are damaged; {repair}" in sentence
    result = lcollision("label", model, "-o", store, "--check")
    assert result.exit_code == 1
    assert result.stdout == f"{store}: damaged, rows 1024 to 2047; {repair} to label them again\n"
    report = json.loads(lcollision("label", model, "-o", store, "--check", "--json").stdout)
    assert report == {
        "store": str(store),
        "rows": 1076,
        "damaged": [[1024, 2047]],
        "description_verified": True,
    }
    assert "1024 labelled now" in lcollision(*order, "-n", 2100).stdout
    assert lcollision("label", model, "-o", store, "--check").exit_code == 0
    assert as_bytes(LabelStore.open(store).load()) == as_bytes(whole)


def test_check_is_asked_for_alone(lcollision: Lcollision, model: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    for options in ((), ("-n", 10, "--check")):
        assert "give either -n N" in refusal(lcollision, "label", model, "-o", store, *options)
    assert "there is no label store" in refusal(lcollision, "label", model, "-o", store, "--check")
    assert not store.exists()


def test_what_cannot_be_labelled_is_refused(
    lcollision: Lcollision, model: Path, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    assert lcollision("label", model, "-n", 40, "-o", store).exit_code == 0
    assert "samples of seed 0, not samples of seed 9" in refusal(
        lcollision, "label", model, "-n", 40, "-o", store, "--seed", 9
    )
    other = tmp_path / "other.safetensors"
    trained = LearnedBody.load(model)
    few = bending_tube(9)
    config = EmbeddingConfig(
        n_domains=2, n_domain_codes=2, level1_epochs=1, level2_epochs=1, held_out_stride=0
    )
    LearnedBody.from_training("other", train_embedding(few, config), few).save(other)
    assert f"labels the model of fingerprint {trained.fingerprint}, not the model of" in refusal(
        lcollision, "label", other, "-n", 40, "-o", store
    )
    both = ("--workers", 2, "--scheduler", "tcp://127.0.0.1:9")
    assert "can't be used together" in refusal(
        lcollision, "label", model, "-n", 40, "-o", store, *both
    )
    assert "there is no model or file 'nobody'" in refusal(
        lcollision, "label", "nobody", "-n", 40, "-o", store
    )
    shutil.rmtree(store)
    store.write_text("a letter")
    assert "is not a label store" in refusal(lcollision, "label", model, "-n", 40, "-o", store)
    assert store.read_text() == "a letter"
