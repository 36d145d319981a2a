"""Read files of scenes: characters and other files with nodes, skins and animations."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, TypeAlias

from lcollision_core.errors import LCollisionError, MeshFileError, PoseSetError
from lcollision_core.files.formats import SCENE_SUFFIXES
from lcollision_core.files.gltf import read as gltf_scene
from lcollision_core.files.gltf.schema import GltfDocument
from lcollision_core.files.mesh.polygons import read_rest
from lcollision_core.files.safe import open_regular
from lcollision_core.files.scene import fbx
from lcollision_core.files.scene.fbx import FbxDocument
from lcollision_core.files.scene.scene import NoMeshError, Scene, shown_scene
from lcollision_core.jobs import UNWATCHED, Job

SceneDocument: TypeAlias = GltfDocument | FbxDocument
"""A file of a scene, read once, from which its scene, clips and appearance are made."""


def open_scene(path: str | os.PathLike[str], job: Job = UNWATCHED) -> SceneDocument:
    """Read a file without making its scene; the extension determines the format.

    Parameters
    ----------
    path : path of the file
    job : polled while FBX is read and its clips are sampled

    Raises
    ------
    MeshFileError : the file is missing, damaged or too large. The message names the file.
    """
    with as_file_error(path), opened(path, SCENE_SUFFIXES) as file:
        return document_of(file, Path(path), job)


def read_scene(source: str | os.PathLike[str] | SceneDocument, job: Job = UNWATCHED) -> Scene:
    """Read the scene of a file, without scenery around its characters.

    Parameters
    ----------
    source : the file, or the result of `open_scene`
    job : see `open_scene`

    Raises
    ------
    CancelledError : the job was cancelled.
    MeshFileError : see `open_scene`; or the file is compressed, or shows no triangles.
    """
    document = source if isinstance(source, SceneDocument) else open_scene(source, job)
    with as_file_error(document.path):
        return scene_of(document)


def read_skeleton_scene(path: str | os.PathLike[str]) -> Scene:
    """Read only the nodes and clips of a file, which need not have a mesh.

    Raises
    ------
    MeshFileError : see `open_scene`.
    """
    document = open_scene(path)
    with as_file_error(path):
        if isinstance(document, FbxDocument):
            return fbx.read_nodes(document)
        return gltf_scene.read_nodes(document)


def open_rigged(path: str | os.PathLike[str]) -> SceneDocument | None:
    """Open a file as `open_scene` does; return None if it is not a scene with a skin."""
    if Path(path).suffix.lower() not in SCENE_SUFFIXES:
        return None
    document = open_scene(path)
    return document if document.has_skin else None


def is_animation_alone(document: SceneDocument) -> bool:
    """Whether a file has an animation but no mesh; return False for a damaged one."""
    try:
        scene_of(document)
    except NoMeshError:
        return True
    except LCollisionError:
        # The error is raised later, when the file is read.
        return False
    return False


@contextmanager
def opened(
    path: str | os.PathLike[str], suffixes: Sequence[str], kind: str = "format of characters"
) -> Iterator[BinaryIO]:
    """Open a file with one of these extensions that is not empty; errors do not name it."""
    suffix = Path(path).suffix.lower()
    with open_regular(path) as file:
        if suffix not in suffixes:
            use = f"use one of {', '.join(suffixes)}"
            if suffix == ".npz":
                use += "; `lcollision dataset check` checks the poses of an .npz"
            raise MeshFileError(
                f"{suffix or 'a name without extension'} is not a known {kind}", use
            )
        if os.fstat(file.fileno()).st_size == 0:
            raise MeshFileError("it is empty")
        yield file


def document_of(file: BinaryIO, path: Path, job: Job = UNWATCHED) -> SceneDocument:
    """Read an open file from its start, as `open_scene`; errors do not name it."""
    if path.suffix.lower() == ".fbx":
        return FbxDocument(read_rest(file), path, job)
    return GltfDocument(read_rest(file), path)


def scene_of(document: SceneDocument) -> Scene:
    """Make the scene of a file, as `read_scene`; errors do not name it."""
    if isinstance(document, FbxDocument):
        return shown_scene(fbx.read_shown(document))
    return shown_scene(gltf_scene.read_shown(document))


@contextmanager
def as_file_error(path: str | os.PathLike[str], what: str = "cannot be read") -> Iterator[None]:
    """Turn errors in the block into one error that names the file and says `what` failed.

    Raises
    ------
    MeshFileError : the block raised an error of the file or the system.
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
        raise MeshFileError.because(path, what, error, "export it again") from error
