"""The label store: what survives an interruption, what is noticed, what is refused."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr

from lcollision_core.errors import LabelStoreError, LCollisionError
from lcollision_core.labels import (
    ROWS_A_CHUNK,
    Labeller,
    LabelRows,
    LabelStore,
    StoreIdentity,
    label_poses,
    store,
)
from lcollision_core.labels.store import StoreCheck
from lcollision_core.model import PoseModel
from tests.core.labelled import as_bytes, labeller_of

N_ROWS = 2 * ROWS_A_CHUNK + 300


@pytest.fixture(scope="module")
def labeller(tube_model: PoseModel) -> Labeller:
    return labeller_of(tube_model)


@pytest.fixture(scope="module")
def finished(labeller: Labeller, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("finished") / "store"
    label_poses(labeller, path, N_ROWS)
    return path


@pytest.fixture(scope="module")
def truth(finished: Path) -> LabelRows:
    return LabelStore.open(finished).load()


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


def _sentence(excinfo: pytest.ExceptionInfo[LCollisionError]) -> str:
    message = str(excinfo.value)
    assert "\n" not in message
    return message


def test_rows_are_read_whole_in_part_and_by_chunk(path: Path, truth: LabelRows) -> None:
    opened = LabelStore.open(path)
    assert (opened.n_rows, len(truth), truth.latent.dtype) == (N_ROWS, N_ROWS, np.float32)
    assert truth.domain_energy.dtype == truth.energy.dtype == np.float64
    assert [len(rows) for rows in opened.chunks()] == [ROWS_A_CHUNK, ROWS_A_CHUNK, 300]
    assert as_bytes(LabelRows.joined(list(opened.chunks()))) == as_bytes(truth)
    for n_rows in (0, 1, ROWS_A_CHUNK, ROWS_A_CHUNK + 1, N_ROWS):
        assert as_bytes(opened.load(n_rows)) == as_bytes(truth.head(n_rows))
    with pytest.raises(LabelStoreError, match=f"has {N_ROWS} rows, not {N_ROWS + 1}"):
        opened.load(N_ROWS + 1)


def test_anyone_can_read_it_as_zarr(path: Path, truth: LabelRows) -> None:
    group = zarr.open_group(str(path), mode="r")
    assert sorted(name for name, _ in group.members()) == [
        "chunks",
        "domain_energy",
        "energy",
        "latent",
        "n_near_pairs",
        "n_pairs",
    ]
    assert group.metadata.zarr_format == 3
    assert np.array_equal(group["energy"][:], truth.energy)
    assert np.array_equal(group["latent"][:], truth.latent)


@pytest.mark.parametrize("damage", [_halve, _flip, _empty, Path.unlink])
@pytest.mark.parametrize("column", ["latent", "domain_energy", "energy", "n_pairs", "chunks"])
def test_a_chunk_that_is_not_whole_is_noticed_and_redone(
    column: str, damage: Callable[[Path], None], path: Path, labeller: Labeller, truth: LabelRows
) -> None:
    """As after a power cut: the file is there, its end is not."""
    file = path / column / "c" / "1"
    damage(file / "0" if file.is_dir() else file)
    opened = LabelStore.open(path)
    for read in (opened.load, lambda: opened.load(N_ROWS), lambda: list(opened.chunks())):
        with pytest.raises(LabelStoreError) as excinfo:
            read()
        assert f"rows {ROWS_A_CHUNK} to {2 * ROWS_A_CHUNK - 1} are " in _sentence(excinfo)
        assert f"run `lcollision label M -n {N_ROWS} -o {path}`" in _sentence(excinfo)
    assert as_bytes(opened.load(ROWS_A_CHUNK)) == as_bytes(truth.head(ROWS_A_CHUNK))
    assert opened.check() == StoreCheck(
        N_ROWS - ROWS_A_CHUNK, ((ROWS_A_CHUNK, 2 * ROWS_A_CHUNK - 1),), has_checksum=True
    )
    repaired: list[int] = []
    # However few are asked for: what was there before is there again.
    label_poses(labeller, path, 5, progress=lambda status: repaired.append(status.done))
    assert repaired[0] == N_ROWS - ROWS_A_CHUNK
    assert as_bytes(LabelStore.open(path).load()) == as_bytes(truth)
    assert LabelStore.open(path).check() == StoreCheck(N_ROWS, (), has_checksum=True)


def test_every_flipped_bit_is_noticed_or_harmless(
    labeller: Labeller, truth: LabelRows, tmp_path: Path
) -> None:
    """Of the journal and of all descriptions, where a bit made rows vanish without a word."""
    path, n_rows = tmp_path / "store", ROWS_A_CHUNK + 40
    label_poses(labeller, path, n_rows)
    noticed = 0
    for file in (*path.rglob("zarr.json"), *path.glob("chunks/c/*/0")):
        content = file.read_bytes()
        for place in range(0, len(content), 3 if file.suffix else 1):
            damaged = bytearray(content)
            damaged[place] ^= 1 << place % 7
            file.write_bytes(damaged)
            try:
                opened = LabelStore.open(path)
                opened.require(StoreIdentity.of(labeller, opened.identity.seed))
                rows = opened.load()
            except LabelStoreError:
                noticed += 1
            else:
                assert as_bytes(rows) == as_bytes(truth.head(n_rows)), (file, place)
        file.write_bytes(content)
    assert noticed > 300


def test_a_store_of_an_older_version_is_read_and_its_check_says_so(
    path: Path, truth: LabelRows
) -> None:
    group = zarr.open_group(str(path), mode="r+")
    attributes = dict(group.attrs["lcollision"])
    del attributes["sha256"]
    group.attrs["lcollision"] = attributes
    assert as_bytes(LabelStore.open(path).load()) == as_bytes(truth)
    assert LabelStore.open(path).check() == StoreCheck(N_ROWS, (), has_checksum=False)
    attributes["sha256"] = "0" * 64
    group.attrs["lcollision"] = attributes
    with pytest.raises(LabelStoreError, match="is damaged: its description"):
        LabelStore.open(path)


@pytest.mark.parametrize(
    "name", ["zarr.json", "latent/zarr.json", "chunks/c/1/0", "energy/c/1", "latent/c/1/0"]
)
def test_a_pipe_inside_a_store_is_not_waited_for(
    name: str, path: Path, labeller: Labeller, truth: LabelRows
) -> None:
    (path / name).unlink()
    os.mkfifo(path / name)
    with pytest.raises(LabelStoreError, match=r"is damaged|is no label store") as excinfo:
        LabelStore.open(path).load()
    assert str(path) in _sentence(excinfo)
    if "/c/" in name:
        label_poses(labeller, path, N_ROWS)
        assert as_bytes(LabelStore.open(path).load()) == as_bytes(truth)


def test_a_store_that_announces_many_rows_opens_at_once(path: Path, truth: LabelRows) -> None:
    group = zarr.open_group(str(path), mode="r+")
    for name in ("chunks", "latent", "domain_energy", "energy", "n_pairs", "n_near_pairs"):
        group[name].resize((10**12, *group[name].shape[1:]))
    started = time.monotonic()
    assert as_bytes(LabelStore.open(path).load()) == as_bytes(truth)
    assert time.monotonic() - started < 20.0


def test_the_journal_is_read_as_zarr_writes_it(path: Path) -> None:
    journal = zarr.open_group(str(path), mode="r")["chunks"]
    opened = LabelStore.open(path)
    for chunk, words in enumerate(journal[:]):
        entry = opened._journal[chunk]
        assert entry.as_bytes() == (path / "chunks" / "c" / str(chunk) / "0").read_bytes()
        assert [entry.n_rows, entry.n_colliding] == words[:2].tolist()


def test_rows_of_another_chunk_are_noticed(path: Path) -> None:
    for column in path.iterdir():
        if column.is_dir():
            shutil.rmtree(column / "c" / "1", ignore_errors=True)
            (column / "c" / "1").unlink(missing_ok=True)
            source = column / "c" / "0"
            copy = shutil.copytree if source.is_dir() else shutil.copy
            copy(source, column / "c" / "1")
    with pytest.raises(LabelStoreError, match="are damaged"):
        LabelStore.open(path).load()


def test_a_run_that_died_while_it_wrote_leaves_the_rows_before(
    path: Path, labeller: Labeller, truth: LabelRows, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Die before each file of a chunk in turn; the chunk was there before, with fewer rows."""
    flush = store._flush
    for last in range(6):
        remaining = iter(range(last))

        def die(file: Path, remaining: object = remaining) -> None:
            if next(remaining, None) is None:  # type: ignore[call-overload]
                raise KeyboardInterrupt
            flush(file)

        with monkeypatch.context() as patched:
            patched.setattr(store, "_flush", die)
            with pytest.raises(KeyboardInterrupt):
                label_poses(labeller, path, N_ROWS + 50)
        kept = LabelStore.open(path)
        if last < 5:
            assert as_bytes(kept.load()) == as_bytes(truth.head(2 * ROWS_A_CHUNK))
        else:
            assert kept.n_rows == N_ROWS + 50
    label_poses(labeller, path, N_ROWS + 50)
    assert as_bytes(LabelStore.open(path).load(N_ROWS)) == as_bytes(truth)


def test_one_run_at_a_time_appends(path: Path, labeller: Labeller, truth: LabelRows) -> None:
    """A second run changes nothing, not even what looks like leftovers, until the first ends."""
    written = path / "energy" / "c" / "3.partial"
    with LabelStore.open_to_append(path, StoreIdentity.of(labeller, 0), N_ROWS):
        written.write_bytes(b"by the first run")
        with pytest.raises(LabelStoreError, match="another run is labelling into") as excinfo:
            label_poses(labeller, path, N_ROWS + 50)
        assert str(path) in _sentence(excinfo)
        assert written.exists()
        assert as_bytes(LabelStore.open(path).load()) == as_bytes(truth)
    assert label_poses(labeller, path, N_ROWS + 50).n_rows == N_ROWS + 50
    assert not written.exists()


def test_a_store_of_something_else_is_refused_and_left_alone(
    path: Path, labeller: Labeller
) -> None:
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    for other, seed, difference in (
        (replace(labeller, fingerprint="0123"), 0, "not the model of fingerprint 0123"),
        (labeller, 1, "labels samples of seed 0, not samples of seed 1"),
        (replace(labeller, near_exclusion=0.02), 0, "a near exclusion of 0.0, not .* of 0.02"),
        (replace(labeller, height=2.0), 0, "with a height of 170"),
    ):
        with pytest.raises(LabelStoreError, match=difference) as excinfo:
            label_poses(other, path, N_ROWS + 5000, seed=seed)
        assert str(path) in _sentence(excinfo)
    identity = LabelStore.open(path).identity
    with pytest.raises(LabelStoreError, match="another latent box"):
        LabelStore.open(path).require(replace(identity, box_low=(-9.0, *identity.box_low[1:])))
    LabelStore.open(path).require(StoreIdentity.of(labeller, 0))
    assert before == {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_a_later_version_is_refused(path: Path) -> None:
    group = zarr.open_group(str(path), mode="r+")
    group.attrs["lcollision"] = {**group.attrs["lcollision"], "format_version": 2}
    with pytest.raises(LabelStoreError, match="format version 2, this program reads up to 1"):
        LabelStore.open(path)


def _no_such(path: Path) -> None:
    shutil.rmtree(path)


def _plain_file(path: Path) -> None:
    shutil.rmtree(path)
    path.write_text("a file")


def _other_folder(path: Path) -> None:
    shutil.rmtree(path)
    path.mkdir()
    (path / "letter.txt").write_text("keep me")


def _other_zarr(path: Path) -> None:
    shutil.rmtree(path)
    zarr.open_group(str(path), mode="w").create_array("latent", shape=(3,), dtype="f4")


def _no_description(path: Path) -> None:
    (path / "zarr.json").write_text("{")


def _no_version(path: Path) -> None:
    group = zarr.open_group(str(path), mode="r+")
    group.attrs["lcollision"] = {**group.attrs["lcollision"], "format_version": "new"}


def _no_labels(path: Path) -> None:
    group = zarr.open_group(str(path), mode="r+")
    attributes = dict(group.attrs["lcollision"])
    del attributes["labels"]
    group.attrs["lcollision"] = attributes


def _no_column(path: Path) -> None:
    shutil.rmtree(path / "energy")


def _narrow_column(path: Path) -> None:
    group = zarr.open_group(str(path), mode="r+")
    group.create_array("latent", shape=(9, 2), chunks=(ROWS_A_CHUNK, 2), dtype="f4", overwrite=True)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (_no_such, "there is no label store"),
        (_plain_file, "is no label store"),
        (_other_folder, "is no label store"),
        (_other_zarr, "is no label store"),
        (_no_description, "is no label store"),
        (_no_version, "is damaged"),
        (_no_labels, "is damaged"),
        (_no_column, "is damaged"),
        (_narrow_column, "is damaged"),
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
            label_poses(labeller, path, 10)
        assert sorted(path.rglob("*")) == before


def test_rows_that_are_not_finite_are_neither_written_nor_read(
    path: Path, labeller: Labeller, truth: LabelRows, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = truth.head(ROWS_A_CHUNK)
    energy = rows.energy.copy()
    energy[5] = np.nan
    with LabelStore.open_to_append(path, StoreIdentity.of(labeller, 0), N_ROWS) as opened:
        with pytest.raises(LabelStoreError, match="energy has a number that is not finite"):
            opened.write_chunk(0, replace(rows, energy=energy))
        assert as_bytes(LabelStore.open(path).load()) == as_bytes(truth)
        with monkeypatch.context() as patched:
            patched.setattr(store, "_require_finite", lambda *_: None)
            opened.write_chunk(0, replace(rows, energy=energy))
    with pytest.raises(LabelStoreError, match=r"unusable: its energy .* not finite"):
        LabelStore.open(path).load()


def test_a_store_needs_a_folder_that_can_be_written(labeller: Labeller, tmp_path: Path) -> None:
    with pytest.raises(LabelStoreError, match=r"there is no folder .*nowhere; create it first"):
        label_poses(labeller, tmp_path / "nowhere" / "store", 10)
    (tmp_path / "empty").mkdir()
    assert label_poses(labeller, tmp_path / "empty", 10).n_rows == 10
    assert [file.name for file in tmp_path.iterdir()] == ["empty"]


def test_a_full_disk_is_told_in_a_sentence(
    path: Path, labeller: Labeller, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: Path) -> None:
        raise OSError(28, "No space left on device", str(file))

    monkeypatch.setattr(store, "_flush", full)
    with pytest.raises(LabelStoreError, match="cannot be written: No space left on device"):
        label_poses(labeller, path, N_ROWS + 5)
