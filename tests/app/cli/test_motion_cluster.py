"""``resolve M FOLDER --motion --scheduler``: a folder of motions on the workers of a cluster."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from lcollision_core.bodies import open_body
from lcollision_core.bodies.motions import read_motions
from tests.app.support import Lcollision
from tests.core.bodies.test_retargeting import of_rig
from tests.core.motion.swings import CLIP, swinging_body
from tests.rigged_shapes import write_gltf

pytestmark = pytest.mark.slow

N_FRAMES = 20


@pytest.fixture
def swing(tmp_path: Path) -> Path:
    return write_gltf(swinging_body(n_frames=2 * N_FRAMES), tmp_path / "swing.glb")


@pytest.fixture
def folder(swing: Path, tmp_path: Path) -> Path:
    """Return a folder of two motions, one of them colliding, and an unreadable one."""
    body = open_body(swing)
    (motion,) = read_motions(body, swing, CLIP)
    made = tmp_path / "captured"
    made.mkdir()
    (made / "whole.bvh").write_text(of_rig(body, motion.codes[::2]))
    (made / "start.bvh").write_text(of_rig(body, motion.codes[:3]))
    (made / "broken.bvh").write_text("HIERARCHY\nMOTION\n")
    return made


def same(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows without the fields that differ from run to run."""
    return [{k: v for k, v in row.items() if k not in ("seconds", "output")} for row in rows]


def test_a_cluster_gives_the_rows_and_files_of_this_process(
    scheduler: str,
    lcollision: Lcollision,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Use rules other than the file's own, and paths relative to this process.
    monkeypatch.chdir(tmp_path)
    command = ("resolve", "swing.glb", "captured", "--motion", "--near-exclusion", 0.03, "--json")
    here = lcollision(*command, "-o", "here/")
    there = lcollision(*command, "-o", "there/", "--scheduler", scheduler)
    assert here.exit_code == there.exit_code == 2
    rows = json.loads(there.stdout)
    assert same(rows)[1:] == same(json.loads(here.stdout))[1:]
    assert [row["source"] for row in rows] == ["broken.bvh", "start.bvh", "whole.bvh"]
    # The worker reports the path that it could not read.
    assert f"{folder / 'broken.bvh'} cannot be read: " in rows[0]["error"]
    assert rows[0]["error"] in there.stderr
    assert [row["output"] for row in rows[1:]] == ["there/start.bvh", "there/whole.bvh"]
    assert rows[2]["free_before"] < rows[2]["free_after"] == N_FRAMES
    for name in ("start.bvh", "whole.bvh"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()
    table = list(csv.DictReader((tmp_path / "there" / "motions.csv").read_text().splitlines()))
    assert [row["source"] for row in table] == [row["source"] for row in rows]
    assert not list((tmp_path / "there").glob("*.partial.json"))


def test_what_a_cluster_is_not_for_is_refused(
    lcollision: Lcollision, swing: Path, folder: Path, tmp_path: Path
) -> None:
    address = ("--scheduler", "tcp://127.0.0.1:9")
    refusals = {
        "can't be used together": ("resolve", swing, folder, "--motion", "--workers", 1),
        "needs a folder of motions": ("resolve", swing, "--motion"),
        "needs --motion": ("resolve", swing, swing),
    }
    for said, command in refusals.items():
        result = lcollision(*command, "-o", tmp_path / "out/", *address)
        assert result.exit_code == 2
        assert said in result.stderr
    assert not list(tmp_path.glob("out/*.bvh"))
