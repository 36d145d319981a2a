"""Damaged files of every format: one sentence or a valid mesh, never anything else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lcollision_core.errors import LCollisionError
from lcollision_core.files import PoseSet, read_mesh, read_pose_set, write_mesh, write_pose_set
from lcollision_core.meshes import Topology

pytestmark = pytest.mark.slow

Result = TypeVar("Result")

FUZZ = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=250
)

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1.5, 0], [0, 0, -2.25]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
TEXT_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\nelement face 3\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n4 0 1 2 3\n3 0 2 3\n"
)
RAGGED_PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 2\nproperty list uchar short vertex_indices\nend_header\n"
    + np.arange(12, dtype="<f4").tobytes()
    + b"\4\0\0\1\0\2\0\3\0\3\0\0\1\0\2\0"
)
TEXT_STL = "solid a\n" + "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n"
TEXT_STL += "vertex 0 1 0\nendloop\nendfacet\nendsolid a\n"
SLASHED_OBJ = (
    "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nf 1/1 2/1 3/1\nf -4//1 -3//1 -2//1 -1//1\n"
)


@st.composite
def damages(draw: st.DrawFn) -> tuple[float, list[tuple[float, int]], list[tuple[float, float]]]:
    """Draw where to cut the file, which bytes to overwrite, and which stretch to repeat."""
    place = st.floats(0, 1, exclude_max=True)
    cut = draw(st.one_of(st.just(1.0), place))
    overwritten = draw(st.lists(st.tuples(place, st.integers(0, 255)), max_size=4))
    repeated = draw(st.lists(st.tuples(place, place), max_size=1))
    return cut, overwritten, repeated


def _damaged(data: bytes, damage: tuple[float, list, list]) -> bytes:
    cut, overwritten, repeated = damage
    result = bytearray(data[: int(cut * len(data)) + 1])
    for place, byte in overwritten:
        result[int(place * len(result))] = byte
    for start, end in repeated:
        first, last = sorted((int(start * len(result)), int(end * len(result))))
        result[first:first] = result[first:last]
    return bytes(result)


def _one_sentence_or(read: Callable[[], Result], path: Path) -> Result | None:
    """Return what `read` returns, or None when it refuses in one sentence that names the file."""
    try:
        return read()
    except LCollisionError as error:
        sentence = str(error)
    assert str(path) in sentence
    assert "\n" not in sentence
    return None


def _whole_files(folder: Path) -> dict[str, bytes]:
    files = {
        "text.ply": TEXT_PLY.encode(),
        "ragged.ply": RAGGED_PLY,
        "text.stl": TEXT_STL.encode(),
        "slashed.obj": SLASHED_OBJ.encode(),
    }
    for suffix in (".obj", ".ply", ".off", ".stl", ".glb"):
        write_mesh(folder / f"plain{suffix}", VERTICES, FACES)
        files[f"plain{suffix}"] = (folder / f"plain{suffix}").read_bytes()
    return files


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return one valid file of each dialect."""
    return _whole_files(tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize(
    "name",
    [
        "plain.obj", "slashed.obj", "plain.ply", "text.ply", "ragged.ply", "plain.off",
        "plain.stl", "text.stl", "plain.glb",
    ],
)  # fmt: skip
@given(damage=damages())
@FUZZ
def test_damaged_mesh_files(
    tmp_path: Path, whole_files: dict[str, bytes], name: str, damage: tuple[float, list, list]
) -> None:
    path = tmp_path / name
    path.write_bytes(_damaged(whole_files[name], damage))
    mesh = _one_sentence_or(lambda: read_mesh(path, topology=Topology(FACES, 4)), path)
    if mesh is not None:
        assert mesh.vertices.shape == (mesh.topology.n_vertices, 3)
        assert np.isfinite(mesh.vertices).all()


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off", ".stl", ".glb", ".gltf", ".npz"])
@given(data=st.binary(max_size=300))
@settings(FUZZ, max_examples=60)
def test_garbage_is_refused(tmp_path: Path, suffix: str, data: bytes) -> None:
    path = tmp_path / f"garbage{suffix}"
    path.write_bytes(data)
    with pytest.raises(LCollisionError, match="garbage"):
        (read_pose_set if suffix == ".npz" else read_mesh)(path)


@given(damage=damages())
@settings(FUZZ, max_examples=400)
def test_damaged_pose_sets(tmp_path: Path, damage: tuple[float, list, list]) -> None:
    path = tmp_path / "set.npz"
    poses = np.stack([VERTICES, VERTICES + 1])
    write_pose_set(path, PoseSet(poses, Topology(FACES, 4), ("a", "b")))
    path.write_bytes(_damaged(path.read_bytes(), damage))
    pose_set = _one_sentence_or(lambda: read_pose_set(path), path)
    if pose_set is not None:
        assert pose_set.vertices.shape == (len(pose_set.names), pose_set.topology.n_vertices, 3)
        assert np.isfinite(pose_set.vertices).all()


def test_every_whole_file_is_readable(tmp_path: Path, whole_files: dict[str, bytes]) -> None:
    for name, data in whole_files.items():
        (tmp_path / name).write_bytes(data)
        assert len(read_mesh(tmp_path / name).faces) > 0
