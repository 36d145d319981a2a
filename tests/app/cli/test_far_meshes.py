"""Meshes far from the origin and in another unit, through the commands."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, sample_poses
from lcollision_core.files import read_mesh, read_pose_set, write_mesh, write_pose_set
from lcollision_core.resolve import find_free_poses
from tests.app.support import Lcollision
from tests.bending_tube import bending_tube
from tests.core.shapes import random_rotation
from tests.independent_check import crossing_pairs, read_obj

TURN = random_rotation(np.random.default_rng(4))


@pytest.fixture(scope="module")
def model(editor_model: LearnedBody) -> LearnedBody:
    free = find_free_poses(editor_model.embedding, editor_model.exact_check())
    return editor_model.with_free_poses(free)


@pytest.fixture(scope="module")
def model_file(model: LearnedBody, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "tube.safetensors"
    model.save(path)
    return path


def meshes_of(
    model: LearnedBody, folder: Path, distance: float, factor: float = 1.0
) -> list[np.ndarray]:
    """Write four colliding meshes and a free one as OBJ, each with its own detail."""
    folder.mkdir()
    latents = [*sample_poses(model, 4, seed=5, colliding=True), np.zeros(model.latent_size)]
    detail = 1e-3 * model.body_size * np.sin(np.arange(model.n_vertices))[:, None]
    made = []
    for place, latent in enumerate(latents):
        vertices = factor * ((model.decode(latent) + detail) @ TURN.T) + distance
        write_mesh(folder / f"{place}.obj", vertices, model.faces)
        made.append(vertices)
    return made


@pytest.mark.variants
@pytest.mark.parametrize(
    ("distance", "factor", "options"), [(1e6, 1.0, []), (1e8, 1000.0, ["--keep-detail"])]
)
def test_far_meshes_are_free_as_they_are_written(
    lcollision: Lcollision,
    model: LearnedBody,
    model_file: Path,
    tmp_path: Path,
    distance: float,
    factor: float,
    options: list[str],
) -> None:
    before = meshes_of(model, tmp_path / "in", distance, factor)
    out = tmp_path / "out"
    result = lcollision(
        "resolve", model_file, tmp_path / "in", "-o", out, "--json", "--scale", 1 / factor, *options
    )
    assert result.exit_code == 0, result.stderr
    rows = json.loads(result.stdout)
    assert [row["exactly_free"] for row in rows] == [True] * 5
    assert [row["pairs_before"] > 0 for row in rows] == [True] * 4 + [False]
    for place, (row, original) in enumerate(zip(rows, before, strict=True)):
        vertices, faces = read_obj(out / f"{place}.obj")
        assert len(np.unique(vertices, axis=0)) == model.n_vertices
        assert crossing_pairs(vertices - vertices.mean(axis=0), faces) == set()
        size = factor * model.body_size
        moved = np.linalg.norm(vertices - original, axis=1) / size
        # The reported change, plus the detail that encoding loses.
        assert moved.max() < row["vertex_distance_max"] + 4e-3
        assert moved.max() >= 0.5 * row["vertex_distance_max"]
    check = lcollision("check", out)
    assert check.exit_code == 0


@pytest.mark.parametrize("suffix", ["stl", "glb"])
def test_a_format_that_cannot_hold_far_meshes_is_refused_before_the_work(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, tmp_path: Path, suffix: str
) -> None:
    meshes_of(model, tmp_path / "in", 1e8)
    out = tmp_path / "out"
    result = lcollision("resolve", model_file, tmp_path / "in", "-o", out, "--format", suffix)
    assert result.exit_code == 2
    assert "of a short edge; write .obj, .ply or .off" in result.stderr
    assert not out.exists()
    poses = tmp_path / "poses.json"
    assert lcollision("encode", model_file, tmp_path / "in", "-o", poses).exit_code == 0
    result = lcollision("decode", model_file, poses, "-o", out, "--format", suffix)
    assert result.exit_code == 2
    assert str(out) in result.stderr
    assert not out.exists()


def test_another_unit_is_named_and_helps(
    lcollision: Lcollision, model: LearnedBody, model_file: Path, tmp_path: Path
) -> None:
    factor = 1000.0
    before = meshes_of(model, tmp_path / "in", 0.0, factor)
    poses, out = tmp_path / "poses.json", tmp_path / "out"
    for arguments in (["encode", "-o", poses], ["resolve", "-o", out]):
        command, *rest = arguments
        result = lcollision(command, model_file, tmp_path / "in", *rest)
        assert result.exit_code == 2
        assert f"; scale it with --scale {1 / factor:.6g}" in result.stderr
    assert not out.exists()
    scaled = ["--scale", 1 / factor]
    assert lcollision("encode", model_file, tmp_path / "in", "-o", poses, *scaled).exit_code == 0
    assert lcollision("decode", model_file, poses, "-o", out).exit_code == 0
    for place, original in enumerate(before):
        decoded = read_mesh(out / f"{place}.obj").vertices
        assert np.abs(decoded - original).max() < 4e-3 * factor * model.body_size
    result = lcollision("encode", model_file, tmp_path / "in", "-o", poses, "--scale", 0)
    assert result.exit_code == 2
    assert "a number above 0" in result.stderr


def test_a_model_takes_the_unit_that_its_poses_are_scaled_to(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    path, out = tmp_path / "tubes.npz", tmp_path / "tube.safetensors"
    write_pose_set(path, bending_tube(4))
    result = lcollision(
        "train", "embedding", path, "-o", out, "--domains", 2, "--domain-codes", 2, "--scale", 0.01
    )
    assert result.exit_code == 0, result.stderr
    assert LearnedBody.load(out).body_size == pytest.approx(1.7)
    assert read_pose_set(path).vertices.max() > 17.0
    result = lcollision("train", "embedding", path, "-o", out, "--scale", -1)
    assert result.exit_code == 2
