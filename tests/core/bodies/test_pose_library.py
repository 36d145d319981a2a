"""The user's pose library: written at once, shared by several programs, and never overwritten."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import (
    LearnedBody,
    LibraryChange,
    NamedPose,
    PoseLibrary,
    read_pose_file,
    user_poses_folder,
)
from lcollision_core.errors import LCollisionError


@pytest.fixture
def told() -> list[LCollisionError]:
    return []


@pytest.fixture
def model(tube_model: LearnedBody) -> LearnedBody:
    return tube_model


def pose(model: LearnedBody, name: str, value: float = 0.0) -> NamedPose:
    return NamedPose(name, np.full(model.latent_size, value))


def make(library: PoseLibrary, *changes: LibraryChange) -> None:
    """Make changes and write them, reporting errors as an editor does."""
    library.change(changes)
    try:
        library.take(library.writing()())
    except LCollisionError as error:
        library._tell(error)


def add(library: PoseLibrary, *poses: NamedPose) -> None:
    for pose in poses:
        make(library, LibraryChange(None, pose, len(library.poses)))


def names(library: PoseLibrary) -> list[str]:
    return [pose.name for pose in library.poses]


def test_a_change_is_in_the_file_at_once_and_its_inverse_takes_it_back(
    model: LearnedBody, tmp_path: Path, told: list[LCollisionError]
) -> None:
    library = PoseLibrary(model, tmp_path / "poses", told.append)
    assert library.poses == ()
    assert not library.path.parent.exists()
    a, b, c = (pose(model, name, at / 3) for at, name in enumerate("abc"))
    add(library, a, b, c)
    renamed = LibraryChange(b, replace(b, name="B", tags=("kick",)), 1)
    removed = LibraryChange(a, None, 0)
    for change, after in (
        (renamed, ["a", "B", "c"]),
        (removed, ["B", "c"]),
        (removed.inverse, ["a", "B", "c"]),
        (renamed.inverse, ["a", "b", "c"]),
    ):
        make(library, change)
        assert names(library) == after
        held = read_pose_file(library.path, model).poses
        assert [kept.name for kept in held] == after
    assert [kept.latent.tobytes() for kept in held] == [p.latent.tobytes() for p in (a, b, c)]
    assert list(library.path.parent.iterdir()) == [library.path]
    assert told == []


def test_a_library_belongs_to_the_latent_space_whatever_the_model_is_called(
    model: LearnedBody, tmp_path: Path, told: list[LCollisionError], monkeypatch: pytest.MonkeyPatch
) -> None:
    add(PoseLibrary(model, tmp_path, told.append), pose(model, "a"))
    renamed = LearnedBody("snake / 2", model.embedding, model.card)
    assert names(PoseLibrary(renamed, tmp_path, told.append)) == ["a"]
    other = PoseLibrary(renamed, tmp_path / "other", told.append)
    add(other, pose(model, "b"))
    assert other.path.name == f"snake_2 {model.fingerprint}.json"
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert user_poses_folder() == tmp_path / "lcollision" / "poses"


def test_two_editors_at_once_lose_nothing(
    model: LearnedBody, tmp_path: Path, told: list[LCollisionError]
) -> None:
    one = PoseLibrary(model, tmp_path, told.append)
    add(one, pose(model, "a", 1.0), pose(model, "b", 2.0))
    two = PoseLibrary(model, tmp_path, told.append)
    first, second = pose(model, "new", 3.0), pose(model, "new", 4.0)
    add(one, first)
    add(two, second)
    assert sorted(names(two)) == ["a", "b", "new", "new 2"]
    assert one.refresh()
    assert not one.refresh()
    assert names(one) == names(two)
    # A pose changed by one program is neither removed nor replaced unseen by the other.
    a = one.poses[0]
    make(one, LibraryChange(a, replace(a, latent=a.latent + 5.0), 0))
    make(two, LibraryChange(two.poses[0], None, 0))
    assert names(two)[0] == "a"
    assert two.poses[0].latent[0] == 6.0
    b = two.poses[1]
    make(one, LibraryChange(b, None, 1))
    make(two, LibraryChange(b, replace(b, latent=b.latent + 5.0), 1))
    assert {kept.name: kept.latent[0] for kept in two.poses} == {
        "a": 6.0,
        "b": 7.0,
        "new": 3.0,
        "new 2": 4.0,
    }
    # Undoing one's own addition removes nothing of the other program's.
    make(one, LibraryChange(None, first, 2).inverse)
    assert names(one) == ["a", "b", "new 2"]
    assert told == []


def test_editors_that_know_the_model_by_other_names_begin_one_library(
    model: LearnedBody, tmp_path: Path, told: list[LCollisionError]
) -> None:
    copied = LearnedBody("copy", model.embedding, model.card)
    one, two, watching = (PoseLibrary(m, tmp_path, told.append) for m in (model, copied, copied))
    add(one, pose(model, "a"))
    add(two, pose(model, "b"))
    assert watching.refresh()
    for library in (two, watching, PoseLibrary(model, tmp_path, told.append)):
        assert names(library) == ["b", "a"]
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("damage", ["half", "garbage", "other model"])
def test_a_damaged_library_is_told_of_and_set_aside(
    model: LearnedBody, tmp_path: Path, told: list[LCollisionError], damage: str
) -> None:
    library = PoseLibrary(model, tmp_path, told.append)
    add(library, pose(model, "a"))
    text = library.path.read_text()
    other = json.dumps(json.loads(text) | {"model": {"name": "x", "fingerprint": "y"}})
    content = {"half": text[: len(text) // 2], "garbage": "[1", "other model": other}[damage]
    for number in ("", " 2"):
        library.path.write_text(content)
        opened = PoseLibrary(model, tmp_path, told.append)
        assert opened.poses == ()
        aside = tmp_path / f"{library.path.stem} damaged{number}.json"
        assert aside.read_text() == content
        assert f"was damaged and has been set aside as {aside}" in str(told[-1])
        add(opened, pose(model, "b"))
        assert names(PoseLibrary(model, tmp_path, told.append)) == ["b"]
    # A library that was read before the damage writes its poses again.
    library.path.write_text(content)
    add(library, pose(model, "c"))
    assert names(PoseLibrary(model, tmp_path, told.append)) == ["a", "c"]
    assert len(told) == 3


def test_a_library_of_a_later_version_is_neither_read_nor_touched(
    model: LearnedBody, tmp_path: Path, told: list[LCollisionError]
) -> None:
    library = PoseLibrary(model, tmp_path, told.append)
    add(library, pose(model, "a"))
    later = json.dumps(json.loads(library.path.read_text()) | {"format_version": 99})
    library.path.write_text(later)
    opened = PoseLibrary(model, tmp_path, told.append)
    assert "could not be read" in str(told[-1])
    assert not opened.refresh()
    add(opened, pose(model, "b"))
    assert "could not be saved" in str(told[-1])
    assert "[Errno" not in str(told[-1])
    assert "update the program" in str(told[-1])
    assert names(opened) == ["b"]
    assert library.path.read_text() == later
    assert len(told) == 2


def test_what_cannot_be_written_is_kept_until_it_can(
    model: LearnedBody, tmp_path: Path, told: list[LCollisionError]
) -> None:
    folder = tmp_path / "poses"
    folder.write_text("a file, where the folder should be")
    library = PoseLibrary(model, folder, told.append)
    add(library, pose(model, "a"))
    assert names(library) == ["a"]
    assert len(told) == 1
    folder.unlink()
    add(library, pose(model, "b"))
    assert names(library) == ["a", "b"]
    assert names(PoseLibrary(model, folder, told.append)) == ["a", "b"]
    assert len(told) == 1
