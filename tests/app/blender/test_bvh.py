"""BVH files as Blender's own importer reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies.retargeting import write_skeleton
from tests.app.blender.running import in_blender
from tests.core.motion.swings import N_FRAMES, swinging

pytestmark = pytest.mark.slow


def test_blender_has_the_joints_where_the_motion_has_them(tmp_path: Path) -> None:
    body, motion = swinging()
    path, space = tmp_path / "swing.bvh", body.space
    write_skeleton(path, body, list(motion.codes), list(body.decode(motion.codes)), 30.0)
    frames = in_blender(tmp_path, "bones_of_bvh", path)
    assert len(frames) == N_FRAMES
    # Blender turns y up to z up.
    left, front = np.cross(space.up, space.front), space.front
    axes = np.stack([left, -front, space.up])
    for frame, codes in zip(frames, motion.codes, strict=True):
        places = space.transforms(codes)[:, :3, 3] @ axes.T
        for name, place in zip(space.rig.joint_names, places, strict=True):
            np.testing.assert_allclose(frame[name], place, atol=1e-5)
