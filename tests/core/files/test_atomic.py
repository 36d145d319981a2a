"""Mesh files are written atomically."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.errors import MeshFileError, PoseSetError, ShapeError
from lcollision_core.files import atomic_write, read_mesh, write_mesh
from lcollision_core.files.formats import WRITABLE_SUFFIXES

VERTICES = np.array([[0.1, 0.2, 0.3], [1, 0, 0], [0, 1, 0], [1 / 3, 2 / 3, -0.7]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3]], dtype=np.int32)


@pytest.mark.parametrize("suffix", WRITABLE_SUFFIXES)
def test_failed_write_leaves_the_old_file(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"m{suffix}"
    path.write_bytes(b"old")

    def full_disk(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(MeshFileError, match="No space left on device; free some space"):
        write_mesh(path, VERTICES, FACES)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_interrupted_write_leaves_nothing(tmp_path: Path) -> None:
    def write_half() -> None:
        with atomic_write(tmp_path / "m.obj") as file:
            file.write(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert list(tmp_path.iterdir()) == []


def test_write_replaces_what_a_link_names_and_keeps_the_link(tmp_path: Path) -> None:
    (tmp_path / "real.obj").write_text("old")
    (tmp_path / "link.obj").symlink_to(tmp_path / "real.obj")
    write_mesh(tmp_path / "link.obj", VERTICES, FACES)
    assert (tmp_path / "link.obj").is_symlink()
    assert np.array_equal(read_mesh(tmp_path / "real.obj").vertices, VERTICES)


def test_written_file_has_the_permissions_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("x")
    write_mesh(tmp_path / "m.obj", VERTICES, FACES)
    assert (tmp_path / "m.obj").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_unwritable_places_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.obj").mkdir()
    for path, message in (
        (tmp_path / "none" / "m.obj", "there is no folder"),
        (tmp_path / "folder.obj", "is a folder"),
        (tmp_path / "m.fbx", r"\.fbx is not a known mesh format"),
        (tmp_path / "m.gltf", r"\.gltf is not a known mesh format"),
        (tmp_path / "m", "without extension"),
        (tmp_path / ("x" * 300 + ".obj"), "too long"),
    ):
        with pytest.raises(MeshFileError, match=message) as caught:
            write_mesh(path, VERTICES, FACES)
        assert str(caught.value).startswith(f"{path} cannot be written: ")
    os.mkfifo(tmp_path / "pipe.obj")
    with pytest.raises(MeshFileError, match="not a plain file"):
        write_mesh(tmp_path / "pipe.obj", VERTICES, FACES)


def test_bad_arrays_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "m.obj"
    with pytest.raises(ShapeError, match=r"\(V, 3\)"):
        write_mesh(path, VERTICES[:, :2], FACES)
    with pytest.raises(ShapeError, match=r"vertex 0 .* not finite"):
        write_mesh(path, np.full((4, 3), np.nan), FACES)
    with pytest.raises(PoseSetError, match="face 0 names"):
        write_mesh(path, VERTICES, FACES + 2)
    for suffix in (".stl", ".glb"):
        with pytest.raises(MeshFileError, match="exceeds float32"):
            write_mesh(tmp_path / f"m{suffix}", VERTICES * 1e300, FACES)
    assert list(tmp_path.iterdir()) == []
