"""The main workflow end to end, by the commands that a user types, on real input."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import scoring
from lcollision_core.files import PoseSet, read_pose_set, write_mesh
from tests.app.support import Lcollision
from tests.independent_check import crossing_pairs, read_obj

N_BODY_POSES = int(os.environ.get("LCOLLISION_BODY_POSES", "25"))
"""Colliding poses of the bundled body that are resolved and checked."""


def test_the_independent_check_agrees_on_the_shipped_poses(lcollision: Lcollision) -> None:
    windmill = Path("resources/poses/windmill.obj")
    report = json.loads(lcollision("check", windmill, "--json").stdout)
    found = crossing_pairs(*read_obj(windmill))
    assert len(found) == 50
    assert report[0]["pairs"] == 50
    assert not crossing_pairs(*read_obj(Path("resources/poses/rest.obj")))


def test_colliding_poses_of_the_bundled_body_end_free(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    poses, free, before = (tmp_path / name for name in ("poses.json", "free", "before"))
    arguments = ("-n", N_BODY_POSES, "--colliding", "--seed", "11", "-o", poses)
    assert lcollision("sample", "body", *arguments).exit_code == 0
    assert lcollision("decode", "body", poses, "-o", before).exit_code == 0
    assert lcollision("resolve", "body", poses, "-o", free).exit_code == 0
    collided = sorted(before.glob("*.obj"))
    resolved = sorted(free.glob("*.obj"))
    assert len(collided) == len(resolved) == N_BODY_POSES
    assert all(crossing_pairs(*read_obj(path)) for path in collided[:3])
    assert not [path.name for path in resolved if crossing_pairs(*read_obj(path))]


@pytest.mark.long
def test_scape_from_meshes_to_an_exported_pose(
    scape: PoseSet,
    lcollision: Lcollision,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A folder of scans, three commands to a model, and one scan resolved."""
    monkeypatch.setattr(scoring, "CARD_POSES", 40)
    folder = tmp_path / "scans"
    folder.mkdir()
    for number, vertices in enumerate(scape.vertices[:32]):
        write_mesh(folder / f"mesh{number:03}.obj", vertices, scape.topology.faces)
    model, store = tmp_path / "dancer.safetensors", tmp_path / "dancer.store"
    # Two of the published poses collide.
    scan, fixed = folder / "mesh007.obj", tmp_path / "fixed.obj"
    assert crossing_pairs(*read_obj(scan))
    steps = {
        "train embedding": (folder, "--domains", 4, "-o", model),
        "label": (model, "-n", 1000, "-o", store),
        "train predictor": (model, store, "-o", model),
        "resolve": (model, scan, "-o", fixed),
    }
    times = {}
    for command, arguments in steps.items():
        began = time.perf_counter()
        result = lcollision(*command.split(), *arguments)
        times[command] = time.perf_counter() - began
        assert result.exit_code == 0, result.stderr
    with capsys.disabled():
        took = (f"{command} {seconds:.1f} s" for command, seconds in times.items())
        sys.stdout.write(f"\n{', '.join(took)}\n")
    vertices, faces = read_obj(fixed)
    assert np.array_equal(faces, scape.topology.faces)
    assert not crossing_pairs(vertices, faces)
    height = np.ptp(scape.vertices[0], axis=0).max()
    moved = np.linalg.norm(vertices - scape.vertices[7], axis=1)
    assert moved.mean() < 0.03 * height
    # The written file is an ordinary mesh of a pose set.
    again = tmp_path / "again"
    again.mkdir()
    for number in range(3):
        shutil.copy(fixed, again / f"{number}.obj")
    assert read_pose_set(again).vertices.shape == (3, *vertices.shape)
