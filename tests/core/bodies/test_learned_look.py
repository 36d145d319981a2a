"""A model learned from a character looks like it while the character's file exists."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import pytest

from lcollision_core.bodies import LearnedBody, export_mesh
from lcollision_core.files.scene import fbx

COLOUR = (1.0, 0.25, 0.0, 1.0)


def painted(path: Path) -> None:
    """Give the mesh of a GLB a material of one colour."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    held = json.loads(data[20 : 20 + length])
    held["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": COLOUR}}]
    for mesh in held["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
    words = json.dumps(held).encode()
    words += b" " * (-len(words) % 4)
    body = struct.pack("<I4s", len(words), b"JSON") + words + data[20 + length :]
    path.write_bytes(data[:8] + struct.pack("<I", 12 + len(body)) + body)


def learned_from(model: LearnedBody, path: Path) -> LearnedBody:
    request = {"sources": [str(path)], "scale": 1.0}
    card = replace(model.card, provenance={**model.card.provenance, "request": request})
    return LearnedBody(model.name, model.embedding, card)


def test_a_learned_model_looks_as_the_file_that_it_came_from(
    tube_model: LearnedBody, tmp_path: Path
) -> None:
    path = tmp_path / "mine.glb"
    export_mesh(path, tube_model, tube_model.reference)
    painted(path)
    look = learned_from(tube_model, path).appearance
    assert look is not None
    assert len(look.faces) == tube_model.topology.n_faces
    assert (look.colours == [255, 137, 0, 255]).all()
    assert tube_model.appearance is None
    path.write_bytes(b"glTF, but damaged")
    assert learned_from(tube_model, path).appearance is None
    path.unlink()
    assert learned_from(tube_model, path).appearance is None


def test_a_model_of_an_fbx_opens_without_what_reads_that(
    tube_model: LearnedBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "mine.fbx"
    path.write_bytes(b"Kaydara FBX Binary  \x00\x1a\x00")
    monkeypatch.setattr(fbx, "find_spec", lambda _: None)
    assert learned_from(tube_model, path).appearance is None
