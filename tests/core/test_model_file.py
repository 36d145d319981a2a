"""The model file: round trips and refusals."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save

from lcollision_core.errors import ModelFileError
from lcollision_core.model_file import (
    FORMAT_VERSION,
    Section,
    read_model_file,
    write_model_file,
)


def _sections() -> dict[str, Section]:
    rng = np.random.default_rng(3)
    return {
        "embedding": Section(
            {
                "weights": rng.standard_normal((4, 3)).astype(np.float32),
                "reference": rng.standard_normal((5, 3)),
                "faces": np.array([[0, 1, 2], [2, 3, 4]], np.int32),
                "offsets": np.array([0, 2**40], np.int64),
                "flags": np.array([True, False]),
                "levels": np.array([0, 255], np.uint8),
                "nothing": np.empty((0, 3)),
                "height": np.array(1.75),
            },
            {"names": ["left hand", "größer ☃"], "epochs": 20, "licence": None},
        ),
        "model": Section({}, {"source": "a test"}),
        "run/level 1": Section({"step": np.array(3, np.int64)}, {}),
    }


def _equal(a: dict[str, Section], b: dict[str, Section]) -> bool:
    return a.keys() == b.keys() and all(
        a[name].metadata == b[name].metadata
        and a[name].arrays.keys() == b[name].arrays.keys()
        and all(
            array.dtype == b[name].arrays[key].dtype
            and np.array_equal(array, b[name].arrays[key])
            and array.shape == b[name].arrays[key].shape
            for key, array in a[name].arrays.items()
        )
        for name in a
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "m.safetensors"
    write_model_file(path, _sections())
    return path


def _resave(path: Path, change: dict[str, object]) -> None:
    """Rewrite the file with another JSON document and the same tensors."""
    content = path.read_bytes()
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    document = json.loads(header["__metadata__"]["lcollision"]) | change
    path.write_bytes(save(load(content), metadata={"lcollision": json.dumps(document)}))


def test_sections_come_back_as_they_were(path: Path) -> None:
    assert _equal(read_model_file(path), _sections())


def test_arrays_that_were_read_are_read_only(path: Path) -> None:
    with pytest.raises(ValueError, match="read-only"):
        read_model_file(path)["embedding"].arrays["weights"][0, 0] = 1.0


def test_equal_content_gives_equal_bytes(path: Path, tmp_path: Path) -> None:
    reordered = {
        name: Section(dict(reversed(section.arrays.items())), dict(section.metadata))
        for name, section in reversed(_sections().items())
    }
    write_model_file(tmp_path / "again", reordered)
    assert (tmp_path / "again").read_bytes() == path.read_bytes()
    write_model_file(tmp_path / "third", read_model_file(path))
    assert (tmp_path / "third").read_bytes() == path.read_bytes()


def test_a_section_of_a_later_program_survives_a_rewrite(path: Path) -> None:
    later = Section({"bones": np.arange(6, dtype=np.int32)}, {"kind": {"nested": [1, 2.5]}})
    write_model_file(path, read_model_file(path) | {"skeleton": later})
    sections = read_model_file(path)
    write_model_file(path, sections)
    assert _equal(read_model_file(path), _sections() | {"skeleton": later})


def test_any_safetensors_reader_can_read_the_arrays(path: Path) -> None:
    tensors = load(path.read_bytes())
    reference = _sections()["embedding"].arrays["reference"]
    assert np.array_equal(tensors["embedding/reference"], reference)


def test_every_truncation_is_refused(path: Path) -> None:
    content = path.read_bytes()
    for length in range(len(content)):
        path.write_bytes(content[:length])
        with pytest.raises(ModelFileError, match=r"truncated|empty|not an LCollision model"):
            read_model_file(path)


def test_anything_added_is_refused(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(ModelFileError, match="added to"):
        read_model_file(path)


@pytest.mark.slow
@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damage_is_refused_or_harmless(path: Path, data: st.DataObject) -> None:
    write_model_file(path, _sections())
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    try:
        sections = read_model_file(path)
    except ModelFileError:
        return
    # A padding space of the header may have become a newline.
    assert _equal(sections, _sections())


def test_every_flipped_bit_of_the_tensors_is_refused(path: Path) -> None:
    content = path.read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    for place in range(start, len(content)):
        for bit in (1, 128):
            damaged = bytearray(content)
            damaged[place] ^= bit
            path.write_bytes(damaged)
            with pytest.raises(ModelFileError, match="damaged"):
                read_model_file(path)


@settings(max_examples=200, deadline=None)
@given(content=st.binary(max_size=300))
def test_any_other_file_is_refused(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "foreign"
    path.write_bytes(content)
    with pytest.raises(ModelFileError, match="foreign"):
        read_model_file(path)


def test_a_later_version_is_refused(path: Path) -> None:
    _resave(path, {"format_version": FORMAT_VERSION + 1})
    with pytest.raises(ModelFileError, match=f"version {FORMAT_VERSION + 1}.*update the program"):
        read_model_file(path)


@pytest.mark.parametrize("version", [0, -1, 1.5, "1", True, None, [1]])
def test_a_version_that_never_was_is_refused(path: Path, version: object) -> None:
    _resave(path, {"format_version": version})
    with pytest.raises(ModelFileError, match="damaged"):
        read_model_file(path)


@pytest.mark.parametrize(
    "change", [{"sections": []}, {"sections": {"embedding": 3}}, {"sections": {}}, {"sha256": 5}]
)
def test_a_document_that_does_not_fit_is_refused(path: Path, change: dict[str, object]) -> None:
    _resave(path, change)
    with pytest.raises(ModelFileError, match="damaged"):
        read_model_file(path)


def test_the_safetensors_of_another_program_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.safetensors"
    for metadata in (None, {"format": "pt"}):
        path.write_bytes(save({"weight": np.zeros(3, np.float32)}, metadata=metadata))
        with pytest.raises(ModelFileError, match="not an LCollision model"):
            read_model_file(path)


def test_a_huge_or_hostile_header_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hostile"
    nested = b"[" * 200_000
    headers = [
        (2**63).to_bytes(8, "little") + b"{}",
        (2**30).to_bytes(8, "little") + b"{}",
        (len(nested) + 5).to_bytes(8, "little") + b'{"a":' + nested,
        (2).to_bytes(8, "little") + b"{}",
        (4).to_bytes(8, "little") + b"{\xff\xfe}",
    ]
    for content in headers:
        path.write_bytes(content)
        with pytest.raises(ModelFileError, match="hostile"):
            read_model_file(path)


def test_metadata_of_any_depth_is_refused(path: Path) -> None:
    for depth in (10, 100, *range(900, 1000, 3), 5000):
        deep = "[" * depth + "]" * depth
        sections = f'{{"embedding": {{"deep": {deep}}}}}'
        document = f'{{"format_version": 1, "sections": {sections}, "sha256": "0"}}'
        tensors = load(path.read_bytes())
        path.write_bytes(save(tensors, metadata={"lcollision": document}))
        with pytest.raises(ModelFileError, match="damaged"):
            read_model_file(path)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_neither_written_nor_read(
    tmp_path: Path, bad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "m"
    sections = {"embedding": Section({"weights": np.array([1.0, bad], np.float32)})}
    with pytest.raises(ModelFileError, match=r"embedding/weights.*not finite"):
        write_model_file(path, sections)
    assert list(tmp_path.iterdir()) == []
    # A program without that check must not be able to pass one on either.
    monkeypatch.setattr("lcollision_core.model_file._require_storable", lambda *_: None)
    write_model_file(path, sections)
    with pytest.raises(ModelFileError, match=r"embedding/weights.*not finite"):
        read_model_file(path)


@pytest.mark.parametrize(
    "section",
    [
        Section({"x": np.array(["text"])}),
        Section({"x/y": np.zeros(2)}),
        Section({"x": np.zeros(2, np.complex128)}),
        Section({"x": np.array([object()])}),
        Section({}, {"x": float("nan")}),
        Section({}, {"x": {1, 2}}),
    ],
)
def test_what_the_format_cannot_hold_leaves_the_old_file(path: Path, section: Section) -> None:
    before = path.read_bytes()
    with pytest.raises(ModelFileError):
        write_model_file(path, {"s": section})
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_missing_and_odd_paths_are_named(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, reason in (
        (tmp_path / "none", "does not exist"),
        (tmp_path, "folder"),
        (tmp_path / "pipe", "not a plain file"),
        (tmp_path / "a\0b", "cannot be read"),
    ):
        with pytest.raises(ModelFileError, match=reason):
            read_model_file(path)
    with pytest.raises(ModelFileError, match="no folder"):
        write_model_file(tmp_path / "none" / "m", _sections())
