"""Files that are no files, that lie about their sizes, or that would fill the memory."""

from __future__ import annotations

import io
import json
import os
import socket
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcollision_core.errors import LCollisionError, MeshFileError
from lcollision_core.meshes import Topology, read_mesh, read_pose_set
from lcollision_core.meshes.files import READABLE_SUFFIXES
from lcollision_core.model import PoseModel, read_poses
from lcollision_core.model_file import read_model_file
from lcollision_core.regular_files import open_regular

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1.5, 0], [0, 0, -2.25]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def _folder(path: Path) -> None:
    path.mkdir()


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


KINDS = {"a folder": _folder, "a named pipe": os.mkfifo, "a device": _device, "a socket": _socket}


def _readers(model: PoseModel) -> dict[str, Callable[[Path], Any]]:
    return {
        **dict.fromkeys(READABLE_SUFFIXES, read_mesh),
        ".npz": read_pose_set,
        ".safetensors": read_model_file,
        ".json": lambda path: read_poses(path, model),
        "": open_regular,
    }


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_plain_file_is_never_opened(
    kind: str, tmp_path: Path, tube_model: PoseModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pipe would wait for its writer for ever, a device never end."""
    monkeypatch.chdir(tmp_path)  # Sockets have short names only.
    for suffix, read in _readers(tube_model).items():
        path = Path(f"f{suffix}")
        if kind == "a folder" and suffix == ".npz":
            continue  # A folder is a pose set of another form.
        KINDS[kind](path)
        with pytest.raises((LCollisionError, OSError)) as caught:
            read(path)
        assert f"it is {kind}, not a plain file" in str(caught.value)
        assert "\n" not in str(caught.value)


def _scene(uri: str) -> bytes:
    accessor = {"componentType": 5126, "count": 3, "type": "VEC3", "bufferView": 0}
    scene = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 36, "uri": uri}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [accessor],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    return json.dumps(scene).encode()


@pytest.mark.parametrize("kind", KINDS)
def test_a_gltf_buffer_that_is_no_plain_file_is_never_opened(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    KINDS[kind](Path("b.bin"))
    Path("m.gltf").write_bytes(_scene("b.bin"))
    with pytest.raises(MeshFileError, match=r"m\.gltf .*its buffer 'b\.bin' cannot be read"):
        read_mesh("m.gltf")


@pytest.mark.parametrize("uri", ["/etc/hostname", "../m.bin", "none.bin", "x" * 5000, "a\0b"])
def test_a_gltf_buffer_elsewhere_is_refused_shortly(uri: str, tmp_path: Path) -> None:
    (tmp_path / "m.gltf").write_bytes(_scene(uri))
    with pytest.raises(MeshFileError, match=r"its buffer .* cannot be read") as caught:
        read_mesh(tmp_path / "m.gltf")
    assert len(str(caught.value)) < 400


def _glb(faces: np.ndarray, n_vertices: int) -> bytes:
    corners = faces.astype("<u4").tobytes()
    points = np.resize(VERTICES, (n_vertices, 3)).astype("<f4").tobytes()
    scene = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(corners) + len(points)}],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(corners)},
            {"buffer": 0, "byteOffset": len(corners), "byteLength": len(points)},
        ],
        "accessors": [
            {"componentType": 5125, "count": faces.size, "type": "SCALAR", "bufferView": 0},
            {"componentType": 5126, "count": n_vertices, "type": "VEC3", "bufferView": 1},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    chunks = b"".join(
        len(data).to_bytes(4, "little") + kind + data
        for kind, data in ((b"JSON", text), (b"BIN\0", corners + points))
    )
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks


@pytest.mark.parametrize("n_vertices", [4, 5])
@pytest.mark.parametrize("expected", [None, Topology(FACES, 4)])
def test_a_glb_face_out_of_range_is_named(
    tmp_path: Path, n_vertices: int, expected: Topology | None
) -> None:
    faces = FACES.copy()
    faces[2, 1] = 70_000
    path = tmp_path / "m.glb"
    path.write_bytes(_glb(faces, n_vertices))
    with pytest.raises(MeshFileError, match=r"m\.glb .* face 2 names vertices \[1, 70000, 3\]"):
        read_mesh(path, topology=expected)
    path.write_bytes(_glb(FACES, 4))
    assert np.array_equal(read_mesh(path, topology=expected).faces, FACES)


def _entry(header: bytes, data: bytes) -> bytes:
    return b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + data


HEADER = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1, 4, 3), }\n"


@pytest.mark.parametrize(
    "header",
    [
        HEADER.replace(b"(1,", b"(True,"),
        HEADER.replace(b"(1,", b"(1.0,"),
        HEADER.replace(b"(1,", b"(-1,"),
        HEADER.replace(b"(1,", b"(None,"),
        HEADER.replace(b"(1, 4, 3)", b"[1, 4, 3]"),
        HEADER.replace(b"(1, 4, 3)", b"12"),
        HEADER.replace(b"(1,", b"(" + b"9" * 5000 + b","),
        HEADER.replace(b"(1,", b"(" + b"9" * 400 + b","),
        HEADER.replace(b"'<f8'", b"'<f3'"),
        HEADER.replace(b"'<f8'", b"'<U0'"),
        HEADER.replace(b"'<f8'", b"'<c16'"),
        HEADER.replace(b"'<f8'", b"'<M8[ns]'"),
        HEADER.replace(b"'<f8'", b"[('x', '<f8')]"),
        HEADER.replace(b"'<f8'", b"8"),
        HEADER.replace(b"False", b"None"),
        HEADER.replace(b"'shape'", b"'shapes'"),
        HEADER[:30],
        b"{" * 3000,
        b"\xff" * 60,
        b"",
    ],
)
def test_a_damaged_npz_header_is_one_sentence(header: bytes, tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    for name in ("vertices", "faces", "names", "up_axis"):
        whole = io.BytesIO()
        np.savez(whole, vertices=VERTICES[None], faces=FACES)
        entry = _entry(header, VERTICES.tobytes())
        with zipfile.ZipFile(whole) as held, zipfile.ZipFile(path, "w") as archive:
            for info in held.infolist():
                if info.filename != f"{name}.npy":
                    archive.writestr(info, held.read(info))
            archive.writestr(f"{name}.npy", entry)
        with pytest.raises(LCollisionError) as caught:
            read_pose_set(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 400


def _peak(work: Callable[[], object]) -> int:
    """Return the most bytes that a call took at a time."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_of_an_npz_only_what_is_wanted_is_read(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    unused = {f"unused{i}": np.zeros(5_000_000) for i in range(2)}
    np.savez_compressed(path, vertices=VERTICES[None], faces=FACES, V=unused["unused0"], **unused)
    assert path.stat().st_size < 10**6
    assert _peak(lambda: read_pose_set(path)) < 10**7


def test_an_npz_size_that_the_file_cannot_hold_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    header = HEADER.replace(b"(1,", b"(10000000,")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("vertices.npy", _entry(header, VERTICES.tobytes()))

    def read() -> None:
        with pytest.raises(MeshFileError, match="damaged"):
            read_pose_set(path)

    assert _peak(read) < 2 * 10**6
