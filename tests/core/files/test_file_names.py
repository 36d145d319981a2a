"""File system limits: pose names as file names, and extensions."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcollision_core.errors import MeshFileError
from lcollision_core.files import atomic_files, file_stem, file_stems, has_known_suffix


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("hand on hip", "hand on hip"),
        ("../../etc/passwd", "_.._etc_passwd"),
        ('a<b>c:d|e?f*g"h\\i/j', "a_b_c_d_e_f_g_h_i_j"),
        ("two\nlines\u2028and\x9b more", "two_lines_and_ more"),
        (" . ", "pose"),
        ("\N{DANCER}" * 100, "\N{DANCER}" * 32),
        ("x" * 129 + " end", "x" * 129),
        ("NUL", "_NUL"),
        ("com1.left", "_com1.left"),
        ("lpt² .x", "_lpt² .x"),
        ("console", "console"),
    ],
)
def test_names_become_those_of_files(name: str, stem: str) -> None:
    assert file_stem(name) == stem


@pytest.mark.slow
@given(st.lists(st.text(max_size=300).filter(lambda name: name.isprintable()), max_size=8))
def test_any_names_give_different_ones_that_fit(names: list[str]) -> None:
    stems = file_stems(names)
    assert len({stem.casefold() for stem in stems}) == len(names)
    for stem in stems:
        assert 0 < len(os.fsencode(stem)) <= 130
        assert stem == stem.strip(" .")


def test_many_poses_of_one_name_are_numbered() -> None:
    stems = file_stems(["Walk"] + ["walk"] * 20_000 + ["walk 7"])
    assert stems[:3] == ["Walk", "walk 2", "walk 3"]
    assert stems[-1] == "walk 7 2"


@pytest.mark.parametrize("name", ["a.fbx", "a.TXT", "a.usdz", "a.png", "a.docx", "a.tar.gz"])
def test_files_of_other_programs_are_known(name: str) -> None:
    assert has_known_suffix(Path(name))


@pytest.mark.parametrize("name", ["results_v0.9", "o_1.05", "walk", "take.final", ".hidden", "a."])
def test_what_is_no_extension_is_not(name: str) -> None:
    assert not has_known_suffix(Path(name))


def test_files_come_together_or_not_at_all(tmp_path: Path) -> None:
    folder = tmp_path / "out"

    def write(*names: str, fail: bool) -> None:
        with atomic_files(folder) as unfinished:
            for name in names:
                (unfinished / name).write_text("new")
            if fail:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write("a", fail=True)
    assert not folder.exists()
    folder.mkdir()
    (folder / "a").write_text("old")
    (folder / "mine").write_text("old")
    with pytest.raises(KeyboardInterrupt):
        write("a", "b", fail=True)
    assert {file.name: file.read_text() for file in folder.iterdir()} == {"a": "old", "mine": "old"}
    write("a", "b", fail=False)
    assert {file.name: file.read_text() for file in folder.iterdir()} == {
        "a": "new",
        "b": "new",
        "mine": "old",
    }
    (folder / "c").mkdir()
    with pytest.raises(MeshFileError, match="c cannot be written: it is a folder"):
        write("b", "c", fail=False)


def test_an_interruption_while_files_take_their_places_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace, interrupted = Path.replace, []

    def interrupt_once(self: Path, target: str) -> Path:
        if not interrupted:
            interrupted.append(self)
            raise KeyboardInterrupt
        return replace(self, target)

    def write() -> None:
        with atomic_files(tmp_path) as unfinished:
            for name in "abc":
                (unfinished / name).touch()
            monkeypatch.setattr(Path, "replace", interrupt_once)

    with pytest.raises(KeyboardInterrupt):
        write()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a", "b", "c"]


def test_a_folder_that_cannot_be_made_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "none" / "out", tmp_path / ("x" * 300)):
        with (
            pytest.raises(MeshFileError, match=r".* cannot be written"),
            atomic_files(folder),
        ):
            pass
