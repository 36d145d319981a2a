"""Reports on joints with unknown roles, and setting the roles by command."""

from __future__ import annotations

from pathlib import Path

from tests.app.support import Lcollision
from tests.rigged_shapes import write_gltf
from tests.skeletons import SNAKE, character_from


def test_unknown_joints_are_said_and_can_be_named(lcollision: Lcollision, tmp_path: Path) -> None:
    path = write_gltf(character_from(SNAKE, up=(0.0, 0.0, 1.0)), tmp_path / "snake.glb")
    options = ("-n", 1, "--error-bound", 0.1, "-o", tmp_path / "poses.json")
    result = lcollision("sample", path, *options)
    assert "has no predictor, so --error-bound has no effect" in result.stderr
    assert "its joints are not recognised as a person's" in result.stderr
    result = lcollision("domains", path, "--role", "link 3=hip-left", "--role", "link 4=knee-left")
    assert "  link 4: knee-left\n" in result.stdout
    assert "not known" not in result.stderr
    assert "  link 4: knee-left\n" in lcollision("domains", path).stdout
    lcollision("domains", path, "--role", "link 4=auto")
    assert "  link 4: unknown\n" in lcollision("domains", path).stdout
    for wrong in ("link 3=fin", "fin=head"):
        result = lcollision("domains", path, "--role", wrong)
        assert result.exit_code == 2
        assert "fin" in result.stderr
