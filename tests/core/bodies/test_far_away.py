"""Meshes far from the origin and in another unit: the written mesh is checked and reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, NamedPose, read_poses, sample_poses, write_poses
from lcollision_core.bodies.body import likely_factor
from lcollision_core.contact import CollisionDetector
from lcollision_core.errors import MeshFileError, PoseSetError, ShapeError, WrongScaleError
from lcollision_core.files import (
    PoseSet,
    as_stored,
    can_hold,
    inspect_pose_set,
    read_mesh,
    read_pose_set,
    write_mesh,
    write_pose_set,
)
from lcollision_core.files.mesh_file import KEEP_PRECISION
from lcollision_core.meshes import RigidTransform, Topology
from lcollision_core.posing import ExactCheck
from tests.bending_tube import LENGTH_IN_FILES
from tests.core.shapes import random_rotation, sphere

FAR = [0.0, 1e4, 1e6, 1e8, 1e10]
BALL = sphere(n=16)


@pytest.fixture(scope="module")
def turn() -> np.ndarray:
    return random_rotation(np.random.default_rng(6))


def placed(distance: float, turn: np.ndarray, scale: float = 1.0) -> RigidTransform:
    return RigidTransform(turn, distance * np.array([1.0, -0.7, 0.3]), scale)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off"])
@pytest.mark.parametrize("distance", FAR)
def test_formats_of_doubles_give_a_far_mesh_back(
    tmp_path: Path, suffix: str, distance: float
) -> None:
    vertices = BALL.vertices + distance
    write_mesh(tmp_path / f"far{suffix}", vertices, BALL.faces)
    mesh = read_mesh(tmp_path / f"far{suffix}")
    assert np.array_equal(mesh.vertices, vertices)
    assert mesh.coarseness is None


@pytest.mark.parametrize("suffix", [".stl", ".glb"])
def test_formats_of_single_precision_refuse_what_they_would_ruin(
    tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"far{suffix}"
    write_mesh(path, BALL.vertices + 1e3, BALL.faces)
    before = path.read_bytes()
    with pytest.raises(MeshFileError, match=r"steps of .* of a short edge; write \.obj, \.ply or"):
        write_mesh(path, BALL.vertices + 1e6, BALL.faces)
    assert path.read_bytes() == before
    stored = as_stored(path, BALL.vertices + 1e3, BALL.topology)
    assert stored.dtype == np.float32
    mesh = read_mesh(path, topology=BALL.topology)
    assert np.array_equal(mesh.vertices[mesh.faces], stored[BALL.faces])


def test_no_format_writes_a_mesh_beyond_doubles(tmp_path: Path) -> None:
    with pytest.raises(MeshFileError, match="move the mesh nearer to the origin"):
        write_mesh(tmp_path / "far.obj", BALL.vertices + 1e15, BALL.faces)


def test_a_stray_vertex_does_not_decide_what_a_format_can_hold() -> None:
    vertices = np.concatenate([BALL.vertices, [[1e9, 0.0, 0.0]]])
    assert can_hold(vertices, Topology(BALL.faces, len(vertices)), np.float32)


@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_a_mesh_that_came_rounded_is_said_to_be(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"far{suffix}"
    rounded = (BALL.vertices + 1e6).astype(np.float32)
    write_mesh(path, rounded, BALL.faces)
    mesh = read_mesh(path)
    assert mesh.coarseness is not None
    assert f"{mesh.coarseness}; {KEEP_PRECISION}" in mesh.notes
    assert "stored in steps of 0.062" in mesh.coarseness


def test_pose_sets_that_came_rounded_are_refused_pose_by_pose(
    tube_poses: PoseSet, tmp_path: Path
) -> None:
    far = tube_poses.vertices.copy()
    far[2:4] += 1e8
    path = tmp_path / "set.npz"
    write_pose_set(path, replace(tube_poses, vertices=far.astype(np.float32)))
    inspection = inspect_pose_set(path)
    assert inspection.pose_set is not None
    assert len(inspection.pose_set) == len(tube_poses) - 2
    assert sum("is damaged: so far from the origin" in one for one in inspection.problems) == 2
    with pytest.raises(PoseSetError, match=r"pose 2 .* steps of 8"):
        read_pose_set(path)
    write_pose_set(path, replace(tube_poses, vertices=far))
    assert len(read_pose_set(path)) == len(tube_poses)


@pytest.mark.parametrize("distance", FAR)
def test_a_far_mesh_is_fitted_checked_and_given_back_as_a_near_one(
    tube_model: LearnedBody, turn: np.ndarray, distance: float
) -> None:
    colliding = sample_poses(tube_model, 2, seed=5, colliding=True)
    free = sample_poses(tube_model, 2, seed=5, colliding=False)
    near = tube_model.exact_check()
    far = replace(near, placement=placed(distance, turn))
    for latent in (*colliding, *free):
        decoded = far.decode(latent)[0]
        exported = far.exported(decoded)
        assert exported.dtype == np.float64
        assert len(np.unique(exported, axis=0)) == tube_model.n_vertices
        back = far.placement.inverse().apply(exported)  # type: ignore[union-attr]
        assert back == pytest.approx(decoded * tube_model.body_size, abs=1e-5 + 1e-15 * distance)
        expected, found = (one.find(one.exported(decoded)) for one in (near, far))
        assert len(found.pairs) == pytest.approx(len(expected.pairs), rel=0.2)
        assert far.is_free(latent) == (len(found.pairs) == 0) == near.is_free(latent)
        fit = tube_model.encode(exported)
        again = fit.placement.apply(tube_model.decode(fit.latent))
        reported = np.linalg.norm(again - exported, axis=1).max() / tube_model.body_size
        assert reported == pytest.approx(fit.fit_error_max, rel=0.05, abs=1e-6)
        assert fit.fit_error_max < 1e-3


def test_a_mesh_beyond_doubles_is_not_fitted(tube_model: LearnedBody) -> None:
    with pytest.raises(PoseSetError, match="so far from the origin"):
        tube_model.encode(tube_model.reference + 1e15)


def test_free_means_free_in_single_precision_too() -> None:
    """A triangle is so near to another that rounding to float32 makes them intersect."""
    topology = Topology(np.arange(6).reshape(2, 3), 6)
    generator = np.random.default_rng(0)
    told = set()
    for _ in range(200):
        flat = generator.uniform(0.5, 1.0, (3, 3))
        normal = np.cross(flat[1] - flat[0], flat[2] - flat[0])
        normal /= np.linalg.norm(normal)
        tip = flat.mean(axis=0) + 3e-9 * normal
        vertices = np.concatenate([flat, tip + np.array([[0], [1], [1]]) * normal])
        vertices[5] += 0.1 * (flat[1] - flat[0])
        detector = CollisionDetector(topology, vertices)
        check = ExactCheck(None, detector, 1.0, placed(0.0, np.eye(3)))  # type: ignore[arg-type]
        single = detector.detect(vertices.astype(np.float32)).colliding
        assert not detector.detect(vertices).colliding
        assert check.is_free_mesh(vertices) == (not single)
        told.add(single)
    assert told == {True, False}


@pytest.mark.parametrize(("factor", "distance"), [(1000.0, 0.0), (0.01, 1e6), (39.3701, 1e9)])
def test_a_mesh_in_another_unit_comes_back_in_its_own(
    tube_model: LearnedBody, turn: np.ndarray, factor: float, distance: float
) -> None:
    latent = sample_poses(tube_model, 1, seed=5, colliding=True)[0]
    mesh = factor * (tube_model.decode(latent) @ turn.T + distance)
    with pytest.raises(WrongScaleError, match="times as large") as refused:
        tube_model.encode(mesh)
    assert refused.value.factor == pytest.approx(1.0 / factor, rel=1e-5)
    fit = tube_model.encode(mesh, scale=1.0 / factor)
    again = fit.placement.apply(tube_model.decode(fit.latent))
    tolerance = 2.0 * factor * (fit.fit_error_max * tube_model.body_size + 1e-6 + 1e-15 * distance)
    assert np.abs(again - mesh).max() < tolerance
    assert fit.placement.scale == pytest.approx(factor)
    check = tube_model.exact_check(fit.placement)
    expected = tube_model.detector.detect(tube_model.decode(fit.latent))
    found = check.find(check.exported(check.decode(fit.latent)[0]))
    assert len(found.pairs) == pytest.approx(len(expected.pairs), rel=0.2)
    assert found.energy == pytest.approx(expected.energy, rel=1e-3)


def test_scales_that_cannot_be_are_refused(tube_model: LearnedBody) -> None:
    for scale in (0.0, -1.0, np.nan, np.inf, 1e300):
        with pytest.raises(ShapeError, match=r"a number above 0, got|is too large for the coord"):
            tube_model.encode(tube_model.reference, scale=scale)


@pytest.mark.parametrize(
    ("measured", "factor"),
    [(980.0, 1000.0), (0.0093, 0.01), (36.0, 39.3701), (2.6, 2.54), (0.31, 0.3048), (7e6, 7e6)],
)
def test_the_likely_factor_is_one_between_usual_units(measured: float, factor: float) -> None:
    assert likely_factor(measured) == pytest.approx(factor, rel=1e-4)


def test_pose_files_keep_the_unit(
    tube_model: LearnedBody, turn: np.ndarray, tmp_path: Path
) -> None:
    path = tmp_path / "poses.json"
    near = NamedPose("near", np.zeros(tube_model.latent_size), placed(1.0, turn))
    scaled = NamedPose("scaled", np.zeros(tube_model.latent_size), placed(1.0, turn, 1000.0))
    write_poses(path, tube_model, [near])
    assert '"format_version": 1' in path.read_text()
    write_poses(path, tube_model, [near, scaled])
    assert '"format_version": 2' in path.read_text()
    for wrote, read in zip([near, scaled], read_poses(path, tube_model), strict=True):
        assert wrote.placement is not None
        assert read.placement is not None
        assert read.placement.scale == wrote.placement.scale
        assert np.array_equal(read.placement.translation, wrote.placement.translation)


def test_a_model_of_far_poses_lies_about_the_origin(tube_poses: PoseSet) -> None:
    from lcollision_core.embedding.training import train_embedding
    from lcollision_core.embedding.training_run import EmbeddingConfig

    poses = replace(tube_poses, vertices=tube_poses.vertices[:8] + 1e8, names=tube_poses.names[:8])
    config = EmbeddingConfig(
        n_domains=2, n_domain_codes=3, level1_epochs=40, level2_epochs=10, held_out_stride=0
    )
    model = LearnedBody.from_training("far", train_embedding(poses, config), poses)
    assert np.abs(model.reference).max() < LENGTH_IN_FILES
    assert model.embedding.metrics is not None
    assert model.embedding.metrics.mean < 0.01
    fit = model.encode(poses.vertices[3])
    again = fit.placement.apply(model.decode(fit.latent))
    assert np.linalg.norm(again - poses.vertices[3], axis=1).max() < 0.05 * LENGTH_IN_FILES
