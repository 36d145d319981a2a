"""Files of scenes: characters and what else has nodes, skins and animations."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from lcollision_core.errors import MeshFileError, PoseSetError
from lcollision_core.jobs import CancelToken
from lcollision_core.meshes.formats import fbx, gltf
from lcollision_core.meshes.formats.hidden_parts import shown_scene
from lcollision_core.meshes.formats.scene import Scene
from lcollision_core.regular_files import open_regular

SCENE_SUFFIXES = (".glb", ".gltf", ".vrm", ".fbx")
"""Extensions that `read_scene` reads, in lower case."""


def read_scene(path: str | os.PathLike[str], cancel: CancelToken | None = None) -> Scene:
    """Read what a file shows, without scenery about its characters; its extension says the format.

    Parameters
    ----------
    path : of the file
    cancel : polled while FBX is read, and its clips sampled

    Raises
    ------
    CancelledError : `cancel` was set.
    MeshFileError : the file is missing, damaged, compressed, too large, or shows no triangles. The
        sentence names the file.
    """
    with one_sentence(path), _opened(path) as file:
        return scene_of(file, Path(path), cancel)


def has_skin(path: str | os.PathLike[str]) -> bool:
    """Whether a file shows something that joints move.

    Raises
    ------
    MeshFileError : as of `read_scene`, as far as the file's description tells.
    """
    with one_sentence(path), _opened(path) as file:
        return fbx.has_skin(file) if _is_fbx(path) else gltf.has_skin(file, Path(path))


def is_character(path: str | os.PathLike[str]) -> bool:
    """Whether a file of any kind shows something that joints move; see `has_skin`."""
    return Path(path).suffix.lower() in SCENE_SUFFIXES and has_skin(path)


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    suffix = Path(path).suffix.lower()
    with open_regular(path) as file:
        if suffix not in SCENE_SUFFIXES:
            raise MeshFileError(
                f"{suffix or 'a name without extension'} is not a known format of characters",
                f"use one of {', '.join(SCENE_SUFFIXES)}",
            )
        if os.fstat(file.fileno()).st_size == 0:
            raise MeshFileError("it is empty")
        yield file


def scene_of(file: BinaryIO, path: Path, cancel: CancelToken | None = None) -> Scene:
    """Read an open file at its start, as `read_scene`; the sentence does not name it."""
    scene = fbx.read_scene(file, path, cancel) if _is_fbx(path) else gltf.read_scene(file, path)
    return shown_scene(scene).scene


def _is_fbx(path: str | os.PathLike[str]) -> bool:
    return Path(path).suffix.lower() == ".fbx"


@contextmanager
def one_sentence(path: str | os.PathLike[str], what: str = "cannot be read") -> Iterator[None]:
    """Turn what goes wrong while a file is read, or `what` says, into one sentence that names it.

    Raises
    ------
    MeshFileError : anything of the file or the system went wrong.
    """
    try:
        try:
            yield
        except FileNotFoundError as error:
            raise MeshFileError("there is no such file", "check the name") from error
        except PermissionError as error:
            raise MeshFileError("permission is denied", "change the file's permissions") from error
        except OSError as error:
            reason = "the name is too long" if error.errno == errno.ENAMETOOLONG else error.strerror
            raise MeshFileError(str(reason or error), "check the file") from error
        except MemoryError as error:
            raise MeshFileError(
                "it needs more memory than there is", "decimate the mesh"
            ) from error
    except (MeshFileError, PoseSetError) as error:
        raise MeshFileError.because(path, what, error, "export the mesh again") from error
