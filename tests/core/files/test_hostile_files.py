"""Files that lie about their sizes, or that would fill the memory."""

from __future__ import annotations

import io
import json
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.errors import LCollisionError, MeshFileError
from lcollision_core.files import read_mesh, read_pose_set
from lcollision_core.meshes import Topology
from tests.core.background import wait_for_tables
from tests.hostile_values import UNPLAIN_FILES, changed_arrays

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1.5, 0], [0, 0, -2.25]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


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


@pytest.mark.parametrize("kind", UNPLAIN_FILES)
def test_a_gltf_buffer_that_is_no_plain_file_is_never_opened(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    UNPLAIN_FILES[kind](Path("b.bin"))
    Path("m.gltf").write_bytes(_scene("b.bin"))
    with pytest.raises(MeshFileError, match=r"m\.gltf .*its buffer 'b\.bin' cannot be read"):
        read_mesh("m.gltf")


@pytest.mark.parametrize("uri", ["/etc/hostname", "../m.bin", "none.bin", "x" * 5000, "a\0b"])
def test_a_gltf_buffer_elsewhere_is_refused_shortly(uri: str, tmp_path: Path) -> None:
    (tmp_path / "m.gltf").write_bytes(_scene(uri))
    with pytest.raises(MeshFileError, match=r"its buffer .* cannot be read") as caught:
        read_mesh(tmp_path / "m.gltf")
    assert len(str(caught.value)) < 400


def test_a_gltf_buffer_below_the_file_is_found_by_its_escaped_name(tmp_path: Path) -> None:
    (tmp_path / "a part").mkdir()
    (tmp_path / "a part" / "b.bin").write_bytes(VERTICES[:3].astype("<f4").tobytes())
    (tmp_path / "m.gltf").write_bytes(_scene("a%20part/b.bin"))
    assert np.array_equal(read_mesh(tmp_path / "m.gltf").vertices, VERTICES[:3])


@pytest.mark.parametrize(
    "uri",
    ["%2e%2e/b.bin", "//host/b.bin", "\\\\host\\b.bin", "http://host/b.bin", "C:b.bin", "link.bin"],
)
def test_a_gltf_buffer_outside_its_folder_is_never_opened(tmp_path: Path, uri: str) -> None:
    (tmp_path / "b.bin").write_bytes(VERTICES[:3].astype("<f4").tobytes())
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "link.bin").symlink_to(tmp_path / "b.bin")
    (folder / "m.gltf").write_bytes(_scene(uri))
    with pytest.raises(MeshFileError, match="cannot be read: it is not beside the file"):
        read_mesh(folder / "m.gltf")


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
        wait_for_tables()
        tracemalloc.stop()


@pytest.mark.slow
def test_of_an_npz_only_what_is_wanted_is_read(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    unused = {f"unused{i}": np.zeros(5_000_000) for i in range(2)}
    np.savez_compressed(path, vertices=VERTICES[None], faces=FACES, V=unused["unused0"], **unused)
    assert path.stat().st_size < 10**6
    read_pose_set(path)  # What is compiled is compiled.
    assert _peak(lambda: read_pose_set(path)) < 10**7


@pytest.mark.slow
def test_an_npz_size_that_the_file_cannot_hold_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    header = HEADER.replace(b"(1,", b"(10000000,")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("vertices.npy", _entry(header, VERTICES.tobytes()))

    def read() -> None:
        with pytest.raises(MeshFileError, match="damaged"):
            read_pose_set(path)

    assert _peak(read) < 2 * 10**6


N_ROWS = 20_000
POINTS = np.random.default_rng(0).normal(size=(N_ROWS, 3)).astype(np.float32)
CORNERS = np.stack([np.arange(N_ROWS - 2) + i for i in range(3)], axis=1)


def _text_files() -> dict[str, str]:
    """Return meshes in which nothing is plain, so that no short way through is taken."""
    points = [f"{x:.7g} {y:.7g} {z:.7g}" for x, y, z in POINTS.tolist()]
    rows = [" ".join(map(str, row)) for row in CORNERS.tolist()]
    ply = (
        f"ply\nformat ascii 1.0\nelement vertex {N_ROWS}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(rows) + 1}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    odd = ["1_0 0 0", *points[1:]]
    facets = [
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {odd[i]}\n" for i in row)
        + "endloop\nendfacet\n"
        for row in CORNERS[: N_ROWS // 6].tolist()
    ]
    return {
        ".ply": ply + "\n".join([*odd, "4 0 1 2 3", *(f"3 {row}" for row in rows)]) + "\n",
        ".obj": "\n".join(
            [f"v {odd[0]} # first", *(f"v {p}" for p in odd[1:]), "f -3 -2 -1", "f 1/1 2/2 3/3"]
            + ["f " + " ".join(map(str, row)) for row in (CORNERS + 1).tolist()]
        ),
        ".off": f"OFF\n{N_ROWS} {len(rows) + 1} 0\n"
        + "\n".join([*odd, "4 0 1 2 3", *(f"3 {row}" for row in rows)]),
        ".stl": "solid a\n" + "".join(facets) + "endsolid a\n",
    }


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl"])
def test_text_takes_memory_by_its_size(suffix: str, tmp_path: Path) -> None:
    """Words and lines as Python's objects took thirty times the file, all at the same time."""
    path = tmp_path / f"m{suffix}"
    path.write_text(_text_files()[suffix])
    meshes = []
    read_mesh(path)  # What is compiled is compiled.
    peak = _peak(lambda: meshes.append(read_mesh(path)))
    assert len(meshes[0].faces) >= N_ROWS // 6
    assert meshes[0].vertices[0].tolist() == [10.0, 0.0, 0.0]
    assert np.allclose(meshes[0].vertices[1:50], POINTS[1:50])
    assert peak < 14 * path.stat().st_size


@pytest.mark.slow
def test_a_pose_set_with_any_array_changed(tmp_path: Path) -> None:
    path, n_refused = tmp_path / "s.npz", 0
    arrays: dict[str, np.ndarray] = {
        "vertices": np.stack([VERTICES, VERTICES + 1.0]),
        "faces": FACES,
        "names": np.array(["a", "b"]),
        "notes": np.array(["a note"]),
        "near_exclusion": np.array(0.01),
        "up_axis": np.array(1),
        "vertex_labels": np.array(["arm", "arm", "leg", "leg"]),
        "format_version": np.array(1),
    }
    for name, array in arrays.items():
        for _, changed in changed_arrays(array):
            others = {key: held for key, held in arrays.items() if key != name}
            np.savez(path, **others, **({} if changed is None else {name: changed}))
            try:
                pose_set = read_pose_set(path)
            except LCollisionError as error:
                sentence = str(error)
            else:
                assert np.isfinite(pose_set.vertices).all()
                continue
            n_refused += 1
            assert str(path) in sentence
            assert "\n" not in sentence
            assert len(sentence) < len(str(path)) + 600
    assert n_refused > 80
