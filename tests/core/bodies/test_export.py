"""Meshes in the axes and the unit of other programs, exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import (
    ExportAxes,
    ExportRequest,
    LearnedBody,
    RigBody,
    export_frame,
    export_mesh,
    export_scale,
    open_body,
    write_pose,
)
from lcollision_core.files import read_mesh
from lcollision_core.meshes import RigidTransform, front_direction
from tests.core.fbx_builder import arm_fbx

X, Y, Z = np.eye(3)


@pytest.fixture(scope="module")
def body() -> LearnedBody:
    return LearnedBody.load("body")


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off", ".stl"])
@pytest.mark.parametrize("axes", list(ExportAxes))
def test_a_file_stands_upright_and_faces_the_front_of_its_program(
    body: LearnedBody, tmp_path: Path, axes: ExportAxes, suffix: str
) -> None:
    """The axes in the file, given the importers' default settings.

    Blender's OBJ importer assumes -Z forward and Y up and rotates; those of PLY and STL assume Y
    forward and Z up and rotate nothing; a body facing the front looks along -y. Maya rotates
    nothing. Unreal flips the sign of y, which does not affect x and z.
    """
    up, front = {
        ExportAxes.MODEL: (Z, -Y),
        ExportAxes.Y_UP: (Y, Z),
        ExportAxes.BLENDER: (Y, Z) if suffix == ".obj" else (Z, -Y),
        ExportAxes.MAYA: (Y, Z),
        ExportAxes.UNREAL: (Z, X),
    }[axes]
    vertices = body.exported_vertices(body.known_poses[0])
    path = tmp_path / f"body{suffix}"
    written = export_mesh(path, body, vertices, frame=export_frame(body, axes, path))
    read = read_mesh(path, topology=body.topology).vertices
    np.testing.assert_array_equal(read, written)
    sides = np.ptp(read, axis=0)
    scale = 100.0 if axes in ("maya", "unreal") else 1.0
    assert sides.argmax() == up.argmax()
    assert sides.max() == pytest.approx(scale * np.ptp(vertices, axis=0).max(), rel=1e-6)
    np.testing.assert_array_equal(front_direction(read, int(up.argmax())), front)
    # Never a mirror image: the signed volume stays.
    corners = read[body.faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    corners = vertices.astype(float)[body.faces]
    before = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume == pytest.approx(scale**3 * before, rel=1e-4)


def test_turn_and_scale_are_exact(body: LearnedBody, tmp_path: Path) -> None:
    path = tmp_path / "body.obj"
    vertices = body.exported_vertices(body.known_poses[3])
    frame = export_frame(body, "maya", path)
    export_mesh(path, body, vertices, frame=frame)
    read = read_mesh(path).vertices
    exact = vertices.astype(np.longdouble) * 100
    np.testing.assert_array_equal(read[:, 1].astype(np.longdouble), exact[:, 2])
    np.testing.assert_array_equal(read[:, 2].astype(np.longdouble), -exact[:, 1])
    np.testing.assert_array_equal(read[:, 0].astype(np.longdouble), exact[:, 0])


def test_a_body_in_centimetres_is_written_in_the_unit_of_each_program(tmp_path: Path) -> None:
    pytest.importorskip("ufbx")
    body = open_body(arm_fbx(tmp_path / "arm.fbx"))
    assert isinstance(body, RigBody)
    assert body.card.metres == pytest.approx(0.01)
    scales = {axes: export_scale(body, axes) for axes in ExportAxes}
    assert scales == {"model": 1.0, "y-up": 1.0, "blender": 0.01, "maya": 1.0, "unreal": 1.0}
    latent = body.known_poses[1]
    vertices = body.exported_vertices(latent)
    size = np.ptp(vertices, axis=0).max()
    # glTF's unit is the metre.
    for name, expected in (("arm.glb", 0.01 * size), ("arm.ply", 0.01 * size), ("a.obj", size)):
        axes = "blender" if name == "arm.ply" else "maya"
        written = write_pose(tmp_path / name, body, latent, vertices, None, ExportRequest(axes))
        read = read_mesh(tmp_path / name).vertices
        assert np.ptp(read, axis=0).max() == pytest.approx(expected, rel=1e-5)
        assert written.unit * np.ptp(written.vertices, axis=0).max() == pytest.approx(size)
    # An imported mesh is exported in its own unit.
    placed = RigidTransform(np.eye(3), np.zeros(3), 10.0)
    moved = placed.apply(vertices)
    write_pose(tmp_path / "back.glb", body, latent, moved, placed)
    read = read_mesh(tmp_path / "back.glb").vertices
    assert np.ptp(read, axis=0).max() == pytest.approx(10.0 * size, rel=1e-5)


@pytest.mark.parametrize("suffix", [".obj", ".stl"])
def test_what_is_checked_is_what_is_written(body: LearnedBody, tmp_path: Path, suffix: str) -> None:
    rng = np.random.default_rng(2)
    for latent in body.latent_space.sample(8, rng):
        vertices = body.exported_vertices(latent)
        path = tmp_path / f"pose{suffix}"
        frame = export_frame(body, "unreal", path)
        written = export_mesh(path, body, vertices, frame=frame)
        read = read_mesh(path, topology=body.topology).vertices
        np.testing.assert_array_equal(written, read)
        found = body.detector.detect(read, unit=1.0 / frame.scale)
        known = body.detector.detect(vertices)
        assert len(found.pairs) == len(known.pairs)
        assert found.energy == pytest.approx(known.energy, rel=1e-3)


def test_a_scale_of_its_own_and_glb_that_has_its_own_axes(
    body: LearnedBody, tmp_path: Path
) -> None:
    vertices = body.exported_vertices(body.known_poses[0])
    path = tmp_path / "body.ply"
    export_mesh(path, body, vertices, frame=export_frame(body, "model", path, scale=1000.0))
    np.testing.assert_array_equal(read_mesh(path).vertices, vertices.astype(float) * 1000.0)
    plain, turned = tmp_path / "plain.glb", tmp_path / "turned.glb"
    export_mesh(plain, body, vertices)
    export_mesh(turned, body, vertices, frame=export_frame(body, "unreal", turned, scale=7.0))
    assert plain.read_bytes() == turned.read_bytes()


def test_a_placed_mesh_is_turned_like_all_others(body: LearnedBody, tmp_path: Path) -> None:
    placement = RigidTransform(np.eye(3), np.array([0.0, 0.0, 2.0]))
    vertices = body.exported_vertices(body.known_poses[0], placement)
    path = tmp_path / "body.obj"
    frame = export_frame(body, "y-up", path)
    written = export_mesh(path, body, vertices, placement, frame)
    np.testing.assert_array_equal(written[:, 1], vertices[:, 2].astype(float))


@pytest.mark.parametrize("up_axis", [0, 1, 2])
def test_every_turn_is_a_rotation_by_right_angles(body: LearnedBody, up_axis: int) -> None:
    class Turned:
        def __init__(self) -> None:
            self.up = np.eye(3)[up_axis]
            self.front = -np.eye(3)[(up_axis + 2) % 3]

    for axes in ExportAxes:
        for name in ("a.obj", "a.stl"):
            turn = export_frame(Turned(), axes, name, 1.0).rotation  # type: ignore[arg-type]
            assert set(np.abs(turn).ravel()) <= {0.0, 1.0}
            np.testing.assert_array_equal(turn @ turn.T, np.eye(3))
            assert np.linalg.det(turn) == pytest.approx(1.0)
    assert body.front.tolist() == [0.0, -1.0, 0.0]
