"""The detection benchmark runs, compares the right results, and reports differences."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from app.benchmarks import detection
from app.cli import benchmark
from lcollision_core.files import PoseSet, write_pose_set
from lcollision_core.meshes import Topology
from tests.app.support import Lcollision

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def crossing_sheets() -> PoseSet:
    """Two grids in one mesh: apart in pose 0, crossing at a slant in poses 1 and 2."""
    n = 9
    x, y = np.meshgrid(np.arange(n) / n, np.arange(n) / n, indexing="ij")
    flat = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate(
        [
            np.stack([corner, corner + n, corner + 1], axis=1),
            np.stack([corner + 1, corner + n, corner + n + 1], axis=1),
        ]
    )
    poses = []
    for offset in (2.0, 0.013, 0.21):
        other = flat[:, [2, 0, 1]] + [0.47, 0.031, offset - 0.29]
        other[:, 0] += 0.3 * other[:, 1]
        poses.append(np.concatenate([flat, other]))
    topology = Topology(np.concatenate([faces, faces + n * n]), 2 * n * n)
    return PoseSet(np.stack(poses), topology, ("apart", "crossing", "also crossing"))


def test_peers_find_the_same_pairs(crossing_sheets: PoseSet) -> None:
    assert detection.missing_peers() == []
    rows = detection.time_detection(crossing_sheets, n_poses=3, threads=2)
    assert [(row["tool"], row["threads"], row["mode"]) for row in rows] == [
        ("lcollision", 1, "all"),
        ("lcollision", 2, "all"),
        ("lcollision", 1, "first"),
        ("python-fcl", 1, "all"),
        ("coal", 1, "all"),
    ]
    assert all(row["agrees"] for row in rows)
    assert all(row["ms_per_pose"] > 0 for row in rows)
    assert {(row["vertices"], row["poses"]) for row in rows} == {(162, 3)}


def test_a_peer_that_differs_is_exposed(
    crossing_sheets: PoseSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = detection._PEERS["coal"]
    monkeypatch.setitem(detection._PEERS, "coal", lambda *mesh: find(*mesh)[:-1:2])
    rows = detection.time_detection(crossing_sheets, n_poses=3, threads=1)
    assert {row["tool"]: row["agrees"] for row in rows} == {
        "lcollision": True,
        "python-fcl": True,
        "coal": False,
    }


def test_command_prints_the_rows(
    lcollision: Lcollision, crossing_sheets: PoseSet, tmp_path: Path
) -> None:
    path = tmp_path / "sheets.npz"
    write_pose_set(path, crossing_sheets)
    result = lcollision("benchmark", "detection", "--data", path, "-n", 2, "--json")
    assert result.exit_code == 0
    rows = json.loads(result.stdout)
    assert set(rows[0]) == {
        "vertices",
        "poses",
        "tool",
        "threads",
        "ms_per_pose",
        "mode",
        "agrees",
    }
    table = lcollision("benchmark", "detection", "--data", path, "-n", 2).stdout
    assert "python-fcl" in table
    assert "NO" not in table
    (ratios,) = (
        line.split()[2:] for line in table.splitlines() if line.strip().startswith("x ours")
    )
    assert ratios[0] == "1"
    assert len(ratios) == len(rows)


def test_a_table_shows_each_field_of_each_row(capsys: pytest.CaptureFixture[str]) -> None:
    benchmark.print_table([{"tool": "ours", "ms": 1.23456, "agrees": False, "fcl": None}])
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines == [["tool", "ours"], ["ms", "1.235"], ["agrees", "NO"], ["fcl", "-"]]
