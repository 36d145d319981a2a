"""Fixtures that several test modules share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lcollision_core.meshes import PoseSet, read_pose_set


def _published_set(name: str) -> PoseSet:
    """Read a published pose set that may not be redistributed, or skip the test."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("LCOLLISION_DATA", default))
    path = folder / name
    if not path.is_file():
        pytest.skip(f"the published pose set {name} is not in {folder} (set LCOLLISION_DATA)")
    return read_pose_set(path)


@pytest.fixture(scope="session")
def scape() -> PoseSet:
    """Return the 71 SCAPE poses at 2161 vertices."""
    return _published_set("scape71.npz")


@pytest.fixture(scope="session")
def jumping() -> PoseSet:
    """Return the 150 frames of the MIT jumping sequence at 10 002 vertices."""
    return _published_set("jumping150.npz")
