"""The scripted drags, and the check of all pairs that confirms them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from app.benchmarks.measures import is_free_by_brute_force, least_by_brute_force
from lcollision_core.bodies import LearnedBody, sample_poses
from tests.app.support import Lcollision
from tests.rigged_shapes import rigged_body, write_gltf

pytestmark = pytest.mark.slow


def test_the_command_prints_both_modes(lcollision: Lcollision) -> None:
    rows = json.loads(lcollision("benchmark", "drag", "-n", "1", "--json").stdout)
    plain, solid = rows
    assert [row["mode"] for row in rows] == ["plain", "solid"]
    assert plain["drags"] == solid["drags"] == 7
    assert solid["events"] == 60 * 7
    assert solid["exactly_free_rate"] == 1.0
    assert solid["confirmed"] > 0
    assert solid["confirmed_free_rate"] == 1.0
    assert 0.0 < plain["miss_reachable"] < 0.02
    assert plain["largest_stretch"] < 1.15
    # The first four targets of each patch have no pins.
    assert plain["pin_drift"] is None
    assert 0.0 < plain["median_ms"] <= plain["p95_ms"] <= plain["max_ms"]


@pytest.mark.parametrize("colliding", [True, False])
def test_all_pairs_agree_with_the_tree(colliding: bool) -> None:
    body = LearnedBody.load("body")
    for latent in sample_poses(body, 3, seed=2, colliding=colliding):
        vertices = body.decode(latent).astype(np.float32)
        assert is_free_by_brute_force(body, vertices) is not colliding


def test_the_least_distance_of_all_pairs_is_that_of_the_tree() -> None:
    body = LearnedBody.load("body")
    told = []
    for latent in sample_poses(body, 6, seed=2):
        vertices = body.decode(latent).astype(np.float32)
        found = body.detector.least_distance(vertices, 0.002)
        told.append(np.inf if found is None else found.distance)
        assert least_by_brute_force(body, vertices, 0.002) == pytest.approx(told[-1], abs=1e-9)
    assert min(told) < 0.0 < max(told)


def test_a_character_file_is_dragged_and_resolved(lcollision: Lcollision, tmp_path: Path) -> None:
    path = write_gltf(rigged_body(n_frames=4), tmp_path / "body.glb")
    plain, solid = json.loads(
        lcollision("benchmark", "drag", "--model", str(path), "-n", "1", "--json").stdout
    )
    assert (plain["drags"], plain["vertices"]) == (7, len(rigged_body().rest_vertices))
    assert plain["miss_reachable"] < 0.02
    assert solid["exactly_free_rate"] == 1.0
    _, steps = json.loads(
        lcollision("benchmark", "resolve", "--model", str(path), "-n", "6", "--json").stdout
    )
    assert (steps["solver"], steps["poses"]) == ("steps", 6)
    assert steps["exactly_free_rate"] == steps["confirmed_free_rate"] == 1.0
    assert steps["feasible_rate"] is None
    assert 0.0 < steps["vertex_distance"] < 0.3
    assert steps["overlap_left"] == 0.0
    assert steps["least_distance"] is steps["least_by_brute_force"] is None
    command = ("benchmark", "resolve", "--model", str(path), "-n", "3", "--json")
    _, near = json.loads(lcollision(*command, "--clearance", "0.004").stdout)
    assert near["exactly_free_rate"] == near["confirmed_free_rate"] == 1.0
    if near["least_distance"] is not None:
        assert near["least_distance"] >= 0.004 - 1e-9
    assert near["least_by_brute_force"] == pytest.approx(near["least_distance"])
    _, soft = json.loads(lcollision(*command, "--soft", "0.002").stdout)
    assert soft["largest_change"] <= 0.002
    assert 0.0 < soft["overlap_left"] < 1.0
    poses = str(tmp_path / "poses.json")
    assert lcollision("sample", str(path), "-n", "2", "--colliding", "-o", poses).exit_code == 0
    own = json.loads(lcollision(*command, "--data", poses).stdout)
    assert [row["solver"] for row in own] == ["bisection", "drags", "steps"]
    assert {row["poses"] for row in own} == {2}
