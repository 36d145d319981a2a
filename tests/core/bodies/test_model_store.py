"""Recognition of the bundled models."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from lcollision_core.bodies import find_model, is_bundled


def test_what_came_with_the_program_or_is_in_no_file_is_changed_in_a_copy(tmp_path: Path) -> None:
    bundled, own = find_model("body"), tmp_path / "body.safetensors"
    shutil.copy(bundled, own)
    assert is_bundled(bundled)
    assert is_bundled(os.path.relpath(bundled))
    assert is_bundled("body")
    assert not is_bundled(own)
    assert not is_bundled(str(own))
