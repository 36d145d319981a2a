"""Files with buffers compressed by meshopt or Draco, and quantised numbers."""

from __future__ import annotations

import base64
import json
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import DracoPy
import numpy as np
import pytest

from lcollision_core.errors import MeshFileError, MissingExtraError
from lcollision_core.files import read_character, read_mesh, write_character
from lcollision_core.files.gltf.packed import decode
from lcollision_core.files.gltf.schema import GltfDocument
from tests.core.gltf_builder import GltfBuilder, arm, tube

VECTORS = json.loads((Path(__file__).parents[2] / "data" / "meshopt.json").read_text())
"""Buffers encoded by meshoptimizer 1.3, and the output of its own decoder."""

_MESHOPT, _DRACO = "EXT_meshopt_compression", "KHR_draco_mesh_compression"


def _decoded(vector: dict[str, Any], packed: bytes) -> bytes:
    return decode(packed, *(vector[name] for name in ("count", "stride", "mode", "filter")))


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["name"])
def test_buffers_are_decoded_as_by_their_own_library(vector: dict[str, Any]) -> None:
    packed, plain = (base64.b64decode(vector[name]) for name in ("packed", "plain"))
    assert len(packed) < len(plain) or vector["filter"] != "NONE"
    assert _decoded(vector, packed) == plain


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["name"])
def test_damaged_buffers_are_refused_or_decoded_to_as_many_bytes(vector: dict[str, Any]) -> None:
    packed, generator = base64.b64decode(vector["packed"]), np.random.default_rng(0)
    for cut in (0, 1, len(packed) // 2):
        with pytest.raises(MeshFileError, match=r"compressed data \(meshopt\) are damaged"):
            _decoded(vector, packed[:cut])
    for _ in range(50):
        damaged = bytearray(packed)
        damaged[generator.integers(1, len(packed))] = generator.integers(256)
        with suppress(MeshFileError):
            assert len(_decoded(vector, bytes(damaged))) == vector["count"] * vector["stride"]


def _verbatim(rows: np.ndarray) -> bytes:
    """Encode up to 256 rows of bytes in meshopt's format, without compression."""
    n = len(rows)
    n_groups = -(-n // 16)
    deltas = np.diff(rows.astype(np.int64), axis=0, prepend=0).astype(np.int8).astype(np.int64)
    zigzag = np.zeros((16 * n_groups, rows.shape[1]), dtype=np.uint8)
    zigzag[:n] = (deltas << 1) ^ (deltas >> 63)
    header = bytes([0xFF]) * -(-n_groups // 4)
    columns = b"".join(header + column.tobytes() for column in zigzag.T)
    return b"\xa0" + columns + bytes(max(32, rows.shape[1]))


def _with_meshopt() -> GltfBuilder:
    """Return the arm with vertices that exist only in a compressed buffer."""
    builder = arm()
    accessor = builder.description["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    number = builder.description["accessors"][accessor]["bufferView"]
    view = builder.description["bufferViews"][number]
    start, size = view["byteOffset"], view["byteLength"]
    rows = np.frombuffer(builder.blob[start : start + size], np.uint8).reshape(-1, 12)
    packed = builder.view(np.frombuffer(_verbatim(rows), np.uint8))
    held = builder.description["bufferViews"].pop(packed)
    held |= {"count": len(rows), "byteStride": 12, "mode": "ATTRIBUTES"}
    view |= {"buffer": 1, "byteOffset": 0, "extensions": {_MESHOPT: held}}
    builder.blob = builder.blob[:start] + bytes(size) + builder.blob[start + size :]
    builder.description["extensionsRequired"] = [_MESHOPT, "KHR_mesh_quantization"]
    builder.description["extensionsUsed"] = [_MESHOPT, "KHR_mesh_quantization"]
    return builder


def _write(builder: GltfBuilder, path: Path) -> Path:
    """Write a .gltf file with a second, placeholder buffer for compressed data."""
    described = json.loads(builder.write(path).read_text())
    described["buffers"].append({"byteLength": len(builder.blob)})
    path.write_text(json.dumps(described))
    return path


def test_meshes_of_meshopt_are_read_and_written_plain(tmp_path: Path) -> None:
    plain = read_character(arm().write(tmp_path / "plain.glb"))
    packed = read_character(_write(_with_meshopt(), tmp_path / "packed.gltf"))
    np.testing.assert_array_equal(packed.rest_vertices, plain.rest_vertices)
    assert packed.topology == plain.topology
    assert packed.rig is not None
    vertices, out = packed.rest_vertices, tmp_path / "out.glb"
    write_character(out, packed, vertices, "joints", packed.rig.rest)
    again = read_character(out)
    np.testing.assert_array_equal(again.rest_vertices, vertices)
    written = GltfDocument(out.read_bytes(), out).description
    assert written["extensionsRequired"] == ["KHR_mesh_quantization"]
    assert len(written["buffers"]) == 1


def _with_draco(packed: bytes | None = None) -> GltfBuilder:
    """Return the arm with vertices and faces that exist only in Draco's data, in order."""
    builder = arm(split=False)
    if packed is None:
        packed = DracoPy.encode(*tube(), quantization_bits=20, preserve_order=True)
    primitive = builder.description["meshes"][0]["primitives"][0]
    for number in (primitive["attributes"]["POSITION"], primitive["indices"]):
        del builder.description["accessors"][number]["bufferView"]
    view = builder.view(np.frombuffer(packed, np.uint8))
    primitive["extensions"] = {_DRACO: {"bufferView": view, "attributes": {"POSITION": 0}}}
    builder.description["extensionsUsed"] = builder.description["extensionsRequired"] = [_DRACO]
    return builder


def test_meshes_of_draco_are_read_and_written_plain(tmp_path: Path) -> None:
    plain = read_character(arm(split=False).write(tmp_path / "plain.glb"))
    packed = read_character(_with_draco().write(tmp_path / "packed.glb"))
    np.testing.assert_allclose(packed.rest_vertices, plain.rest_vertices, atol=1e-5)
    assert packed.topology == plain.topology
    assert packed.rig is not None
    out = tmp_path / "out.glb"
    write_character(out, packed, packed.rest_vertices, "joints", packed.rig.rest)
    np.testing.assert_array_equal(read_character(out).rest_vertices, packed.rest_vertices)
    assert "extensionsRequired" not in GltfDocument(out.read_bytes(), out).description


def test_damaged_draco_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshFileError, match=r"compressed data \(Draco\) are damaged"):
        read_mesh(_with_draco(b"DRACO no more").write(tmp_path / "m.glb"))


def test_draco_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    advice = r"by Draco.*install lcollision\[draco\], or export it without compression$"
    with pytest.raises(MissingExtraError, match=advice):
        read_mesh(_with_draco().write(tmp_path / "m.glb"))
