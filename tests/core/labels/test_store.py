"""The label store: interruptions, damage and refusals."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.contact import ContactRules
from lcollision_core.errors import LabelStoreError, LCollisionError, MeshFileError
from lcollision_core.jobs import Job
from lcollision_core.labels import (
    ROWS_PER_CHUNK,
    Labeller,
    LabelRows,
    LabelStore,
    StoreIdentity,
    label_poses,
)
from lcollision_core.labels import store as store_module
from tests.core.labelled import as_bytes, files_of
from tests.core.labels.conftest import N_ROWS, SEED

MANIFEST = "labels.json"
FIRST, MIDDLE, LAST = (
    f"{first:010}-{last:010}.npz" for first, last in ((0, 1023), (1024, 2047), (2048, 2347))
)


@pytest.fixture
def path(finished: Path, tmp_path: Path) -> Path:
    """Return a copy that a test may damage."""
    return Path(shutil.copytree(finished, tmp_path / "store"))


def _halve(file: Path) -> None:
    os.truncate(file, file.stat().st_size // 2)


def _flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def _empty(file: Path) -> None:
    file.write_bytes(b"")


def _first_instead(file: Path) -> None:
    shutil.copy(file.with_name(FIRST), file)


def _as_pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def _without_a_column(file: Path) -> None:
    _rewrite(file, lambda columns: columns.pop("energy"))


def _with_a_narrow_column(file: Path) -> None:
    _rewrite(file, lambda columns: columns.update(latent=columns["latent"][:, :2]))


def _not_finite(file: Path) -> None:
    _rewrite(file, lambda columns: columns["energy"].__setitem__(5, np.nan))


def _rewrite(file: Path, change: Callable[[dict[str, np.ndarray]], object]) -> None:
    columns = dict(np.load(file))
    change(columns)
    np.savez(file, **columns)


def _sentence(excinfo: pytest.ExceptionInfo[LCollisionError]) -> str:
    message = str(excinfo.value)
    assert "\n" not in message
    return message


def test_rows_are_read_whole_and_in_part(finished: Path, ground_truth: LabelRows) -> None:
    opened = LabelStore.open(finished)
    rows = opened.load()
    assert (opened.n_rows, opened.end, len(rows), rows.latent.dtype) == (
        N_ROWS,
        N_ROWS,
        N_ROWS,
        np.float32,
    )
    assert rows.domain_energy.dtype == rows.energy.dtype == np.float64
    for n_rows in (0, 1, ROWS_PER_CHUNK, ROWS_PER_CHUNK + 1, N_ROWS):
        assert as_bytes(opened.load(n_rows)) == as_bytes(ground_truth.taken(slice(n_rows)))
    with pytest.raises(LabelStoreError, match=f"has {N_ROWS} rows, not {N_ROWS + 1}"):
        opened.load(N_ROWS + 1)


def test_rows_are_read_from_any_shards(finished: Path, ground_truth: LabelRows) -> None:
    store = LabelStore.open(finished)
    for rows in (range(3), range(1000, 1100), range(1020, N_ROWS), range(2048, 2050), range(7, 7)):
        expected = ground_truth.taken(slice(rows.start, rows.stop))
        assert as_bytes(store.read(rows)) == as_bytes(expected)
    with pytest.raises(LabelStoreError, match=f"has {N_ROWS} rows, not {N_ROWS + 1}"):
        store.read(range(5, N_ROWS + 1))
    for rows in (range(-1, 5), range(0, 10, 2)):
        with pytest.raises(LabelStoreError, match="rows must be a range of step 1 from 0 on, got"):
            store.read(rows)


def test_anyone_can_read_it_with_numpy(finished: Path, ground_truth: LabelRows) -> None:
    assert sorted(files_of(finished)) == [FIRST, MIDDLE, LAST, MANIFEST]
    chunk = np.load(finished / MIDDLE)
    assert sorted(chunk) == ["domain_energy", "energy", "latent", "n_pairs"]
    assert np.array_equal(chunk["energy"], ground_truth.energy[1024:2048])
    assert np.array_equal(chunk["latent"], ground_truth.latent[1024:2048])
    manifest = json.loads((finished / MANIFEST).read_text())
    assert (manifest["format_version"], manifest["rows_per_chunk"]) == (3, ROWS_PER_CHUNK)
    assert manifest["labels"]["seed"] == SEED


@pytest.mark.variants(3)
@pytest.mark.parametrize(
    "damage",
    [
        *(_halve, _flip, _empty, _first_instead, _as_pipe, Path.unlink),
        *(_without_a_column, _with_a_narrow_column, _not_finite),
    ],
)
def test_a_chunk_that_is_not_whole_is_noticed_and_labelled_again(
    damage: Callable[[Path], None], path: Path, labeller: Labeller, ground_truth: LabelRows
) -> None:
    damage(path / MIDDLE)
    opened = LabelStore.open(path)
    for n_rows in (None, ROWS_PER_CHUNK + 1):
        with pytest.raises(LabelStoreError) as excinfo:
            opened.load(n_rows)
        assert f"rows {ROWS_PER_CHUNK} to " in _sentence(excinfo)
        assert f"run `lcollision label M -n {N_ROWS} -o {path} --seed 3`" in _sentence(excinfo)
    assert as_bytes(opened.load(ROWS_PER_CHUNK)) == as_bytes(
        ground_truth.taken(slice(ROWS_PER_CHUNK))
    )
    assert opened.check() == (range(ROWS_PER_CHUNK, 2 * ROWS_PER_CHUNK),)
    if damage is _as_pipe:
        with pytest.raises(MeshFileError, match=f"{MIDDLE} cannot be written: .* not a plain"):
            label_poses(labeller, path, 5, seed=SEED)
        return
    # Even if fewer rows are requested, the previous rows are restored.
    assert label_poses(labeller, path, 5, seed=SEED).labelled == ROWS_PER_CHUNK
    assert as_bytes(LabelStore.open(path).load()) == as_bytes(ground_truth)
    assert LabelStore.open(path).check() == ()


def test_stretches_of_damaged_rows_are_told_together(path: Path) -> None:
    _flip(path / FIRST)
    _flip(path / MIDDLE)
    progress: list[tuple[int, int]] = []
    found = LabelStore.open(path).check(Job(lambda done, total: progress.append((done, total))))
    assert found == (range(2 * ROWS_PER_CHUNK),)
    assert progress == [(1024, N_ROWS), (2048, N_ROWS), (N_ROWS, N_ROWS)]


def test_every_flipped_bit_is_noticed_or_harmless(
    labeller: Labeller, ground_truth: LabelRows, tmp_path: Path
) -> None:
    path, n_rows = tmp_path / "store", 40
    label_poses(labeller, path, n_rows, seed=SEED)
    expected, noticed = as_bytes(ground_truth.taken(slice(n_rows))), 0
    for file in path.iterdir():
        content = file.read_bytes()
        for place in range(0, len(content), 8):
            damaged = bytearray(content)
            damaged[place] ^= 1 << place % 7
            file.write_bytes(damaged)
            try:
                opened = LabelStore.open(path)
                opened.require(StoreIdentity.of(labeller, SEED))
                rows = opened.load()
            except LabelStoreError:
                noticed += 1
            else:
                assert as_bytes(rows) == expected, (file, place)
        file.write_bytes(content)
    assert noticed > 300


@pytest.mark.slow
def test_a_run_that_is_killed_while_it_writes_leaves_the_rows_before(
    path: Path, labeller: Labeller, ground_truth: LabelRows, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The chunk already existed, with fewer rows."""

    def die(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    before = files_of(path)
    with monkeypatch.context() as patched:
        patched.setattr(store_module.np, "savez", die)
        with pytest.raises(KeyboardInterrupt):
            label_poses(labeller, path, N_ROWS + 50, seed=SEED)
    assert files_of(path) == before
    (path / f".{LAST}.0123456789ab.part").write_bytes(b"what a killed process leaves")
    assert as_bytes(LabelStore.open(path).load()) == as_bytes(ground_truth)
    assert label_poses(labeller, path, N_ROWS + 50, seed=SEED).labelled == 350
    assert as_bytes(LabelStore.open(path).load(N_ROWS)) == as_bytes(ground_truth)


def test_a_store_of_something_else_is_refused_and_left_alone(
    path: Path, labeller: Labeller
) -> None:
    before = files_of(path)
    for other, seed, difference in (
        (replace(labeller, fingerprint="0123"), SEED, "not the model of fingerprint 0123"),
        (labeller, 1, "labels samples of seed 3, not samples of seed 1"),
        (
            replace(labeller, rules=ContactRules(0.02)),
            SEED,
            "a near exclusion of 0.0, not .* of 0.02",
        ),
        (
            replace(labeller, rules=ContactRules(rest_exclusion=0.02)),
            SEED,
            "contact rules .*rest_exclusion=None.* not .*rest_exclusion=0.02",
        ),
        (replace(labeller, body_size=2.0), SEED, "with a body size of 170"),
    ):
        with pytest.raises(LabelStoreError, match=difference) as excinfo:
            label_poses(other, path, N_ROWS + 5000, seed=seed)
        assert str(path) in _sentence(excinfo)
    identity = LabelStore.open(path).identity
    with pytest.raises(LabelStoreError, match="different latent box"):
        LabelStore.open(path).require(replace(identity, box_low=(-9.0, *identity.box_low[1:])))
    LabelStore.open(path).require(StoreIdentity.of(labeller, SEED))
    assert files_of(path) == before


def _no_such(path: Path) -> None:
    shutil.rmtree(path)


def _plain_file(path: Path) -> None:
    shutil.rmtree(path)
    path.write_text("a file")


def _other_folder(path: Path) -> None:
    (path / MANIFEST).unlink()


def _no_json(path: Path) -> None:
    (path / MANIFEST).write_text("{")


def _a_list(path: Path) -> None:
    (path / MANIFEST).write_text("[]")


def _manifest_as_pipe(path: Path) -> None:
    _as_pipe(path / MANIFEST)


def _describe_otherwise(path: Path, checksum: str | None = None, **changes: object) -> None:
    manifest = {**json.loads((path / MANIFEST).read_text()), **changes}
    del manifest["sha256"]
    manifest["sha256"] = checksum or store_module._digest(manifest)
    (path / MANIFEST).write_text(json.dumps(manifest))


def _later(path: Path) -> None:
    _describe_otherwise(path, format_version=4)


def _no_version(path: Path) -> None:
    _describe_otherwise(path, format_version="new")


def _no_labels(path: Path) -> None:
    _describe_otherwise(path, labels=None)


def _no_box(path: Path) -> None:
    labels = json.loads((path / MANIFEST).read_text())["labels"]
    _describe_otherwise(path, labels={**labels, "box_low": [], "box_high": []})


def _wrong_checksum(path: Path) -> None:
    _describe_otherwise(path, checksum="0" * 64)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (_no_such, "there is no label store"),
        (_plain_file, "is not a label store"),
        (_other_folder, "is not a label store"),
        (_no_json, "is not a label store"),
        (_a_list, "is not a label store"),
        (_manifest_as_pipe, "is not a label store"),
        (_later, "has format version 4, this program reads up to 3; update the program"),
        (_no_version, "is damaged"),
        (_no_labels, "is damaged"),
        (_no_box, "is damaged"),
        (_wrong_checksum, "is damaged"),
    ],
)
def test_what_is_no_store_is_refused(
    spoil: Callable[[Path], None], sentence: str, path: Path, labeller: Labeller
) -> None:
    spoil(path)
    with pytest.raises(LabelStoreError, match=sentence) as excinfo:
        LabelStore.open(path)
    assert str(path) in _sentence(excinfo)
    if spoil is not _no_such:
        before = sorted(path.rglob("*"))
        with pytest.raises(LabelStoreError, match=sentence):
            label_poses(labeller, path, 10, seed=SEED)
        assert sorted(path.rglob("*")) == before


def test_labels_that_are_not_finite_are_not_written(path: Path, ground_truth: LabelRows) -> None:
    rows, before = ground_truth.taken(slice(ROWS_PER_CHUNK)), files_of(path)
    energy = rows.energy.copy()
    energy[5] = np.nan
    with pytest.raises(LabelStoreError, match="the energy of a labelled pose is not finite"):
        LabelStore.open(path).write(range(ROWS_PER_CHUNK), replace(rows, energy=energy))
    assert files_of(path) == before


def test_a_store_needs_a_folder_that_can_be_written(labeller: Labeller, tmp_path: Path) -> None:
    with pytest.raises(MeshFileError, match=r"nowhere/store .*: there is no folder .*nowhere"):
        label_poses(labeller, tmp_path / "nowhere" / "store", 10)
    (tmp_path / "empty").mkdir()
    assert label_poses(labeller, tmp_path / "empty", 10).done == 10
    assert [file.name for file in tmp_path.iterdir()] == ["empty"]


def test_a_full_disk_is_told_in_a_sentence(
    path: Path, labeller: Labeller, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store_module.np, "savez", full)
    with pytest.raises(MeshFileError, match="cannot be written: No space left on device"):
        label_poses(labeller, path, N_ROWS + 5, seed=SEED)
