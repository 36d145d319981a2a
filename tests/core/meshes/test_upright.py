"""The up axis of people, a quadruped, and ambiguous shapes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody
from lcollision_core.files import PoseSet, read_pose_set, write_mesh
from lcollision_core.meshes import Topology, guess_up
from tests.core.shapes import Mesh, box, join, sphere

BODY = Path(__file__).parents[3] / "resources" / "poses" / "body.npz"
TURNS = {0: [1, 2, 0], 1: [0, 1, 2], 2: [2, 0, 1]}
"""Right-handed permutations of the axes that move y to x, y and z."""


def divided(mesh: Mesh, times: int = 3) -> Mesh:
    """Subdivide each face into four, several times, so that points cover the surface."""
    vertices, faces = mesh.vertices, mesh.faces
    for _ in range(times):
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        rows = np.stack([a, b, c, 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)], axis=1)
        first = 6 * np.arange(len(faces))[:, None]
        quarters = [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]
        faces = np.concatenate([first + quarter for quarter in quarters])
        vertices = rows.reshape(-1, 3)
    return Mesh(vertices, faces.astype(np.int32))


def galloping(swing: float) -> Mesh:
    """Make a four-legged body, longer along z than high along y, with a foot at each corner."""
    parts = [
        box([-0.25, 0.8, -1.0], [0.25, 1.3, 1.0]),
        box([-0.12, 1.2, 0.9], [0.12, 1.9, 1.2]),
        box([-0.10, 1.7, 1.1], [0.10, 1.95, 1.7]),
    ]
    for x, z in ((-0.18, -0.85), (0.18, -0.85), (-0.18, 0.85), (0.18, 0.85)):
        leg = box([x - 0.07, 0.0, z - 0.07], [x + 0.07, 0.85, z + 0.07])
        foot = leg.vertices[:, 1] < 0.4
        vertices = leg.vertices.copy()
        vertices[foot, 2] += swing * np.sign(x * z)
        parts.append(Mesh(vertices, leg.faces))
    return divided(join(*parts))


@pytest.fixture(scope="module")
def horse() -> PoseSet:
    meshes = [galloping(swing) for swing in np.linspace(-0.3, 0.3, 6)]
    vertices = np.stack([mesh.vertices for mesh in meshes])
    return PoseSet(vertices, meshes[0].topology, tuple(f"frame {n}" for n in range(6)))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_galloping_horse_stands_on_its_legs(horse: PoseSet, axis: int) -> None:
    guess = guess_up(horse.topology, horse.vertices[:, :, TURNS[axis]])
    assert (guess.axis, guess.is_sure) == (axis, True)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_people_stand_on_their_feet_whatever_they_do(axis: int) -> None:
    poses = read_pose_set(BODY)
    assert poses.up.reason == "the set says so"
    # In that body, z is up.
    turned = poses.vertices[:, :, np.roll([0, 1, 2], axis - 2)]
    guess = guess_up(poses.topology, turned)
    assert (guess.axis, guess.is_sure) == (axis, True)


def test_people_who_lie_down_in_part_leave_a_doubt() -> None:
    poses = read_pose_set(BODY)
    vertices = poses.vertices.copy()
    vertices[::3] = vertices[::3][:, :, [0, 2, 1]]
    assert not guess_up(poses.topology, vertices).is_sure


def test_what_has_no_feet_leaves_a_doubt() -> None:
    ball = sphere()
    assert not guess_up(ball.topology, ball.vertices[None]).is_sure
    flat = Topology(np.array([[0, 1, 2]]), 3)
    guess = guess_up(flat, np.array([[[0.0, 0, 0], [0, 2, 0], [1, 0, 0]]]))
    assert (guess.axis, guess.is_sure) == (1, False)


def test_strays_do_not_count(horse: PoseSet) -> None:
    far = np.full((len(horse), 1, 3), 1e6)
    vertices = np.concatenate([horse.vertices, far], axis=1)
    guess = guess_up(Topology(horse.faces, vertices.shape[1]), vertices)
    assert (guess.axis, guess.is_sure) == (1, True)


def test_a_set_of_gltf_files_is_y_up(tmp_path: Path) -> None:
    ball = sphere()
    for name, suffix in (("a", ".glb"), ("b", ".glb")):
        write_mesh(tmp_path / f"{name}{suffix}", ball.vertices, ball.faces)
    poses = read_pose_set(tmp_path)
    assert poses.up_axis == 1
    assert poses.up.is_sure


def test_a_model_keeps_the_axis_that_it_is_turned_to(
    tube_model: LearnedBody, tmp_path: Path
) -> None:
    path = tmp_path / "turned.safetensors"
    turned = tube_model.turned_upright(0)
    turned.save(path)
    loaded = LearnedBody.load(path)
    assert (tube_model.up_axis, turned.up_axis, loaded.up_axis) == (1, 0, 0)
    assert loaded.fingerprint == tube_model.fingerprint
    assert replace(loaded.card, up_axis=1) == tube_model.card
