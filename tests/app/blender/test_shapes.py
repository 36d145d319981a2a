"""Facial shapes written as weights, against Blender's own evaluation of the files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import RigBody
from lcollision_core.bodies.export import SourceFile
from lcollision_core.files import read_character
from lcollision_core.options import ExportRequest
from tests.app.blender.running import in_blender
from tests.core.bodies.test_shapes import face

pytestmark = pytest.mark.slow


def test_posed_faces_are_those_of_blender(tmp_path: Path) -> None:
    body = RigBody.of(read_character(face(tmp_path / "face.glb")))
    codes = np.zeros((4, body.latent_size))
    codes[1:, 6] = 0.2, 0.5, 0.8
    # Blender clips weights at 1.
    codes[1:, body.shape_codes] = [0.5, 0.0, -0.2], [0.0, 1.0, 0.5], [1.0, 0.3, 0.0]
    expected = np.stack([body.exported_vertices(row, None) for row in codes])
    posed, clip = tmp_path / "posed.glb", tmp_path / "clip.glb"
    source = SourceFile(body.character.source, body)
    source.write(posed, source.require_form(posed, "joints"), expected[2], codes[2])
    source.write_clip(clip, expected, list(codes), ExportRequest(fps=30.0))
    for path, wanted in ((posed, expected[2:3]), (clip, expected)):
        told = in_blender(tmp_path, "played", path, len(wanted), script="inside_shapes.py")
        # In Blender, z is up and y points backwards.
        x, y, z = np.moveaxis(np.array(told), -1, 0)
        shown = np.stack([x, z, -y], axis=-1)
        assert np.abs(shown - wanted[:, body.character.joined]).max() < 1e-5 * body.body_size
