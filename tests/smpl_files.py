"""Body models in the layout of SMPL, SMPL-H and SMPL-X, from the built-in body; and motions."""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from lcollision_core.files import read_pose_set
from lcollision_core.meshes.normals import vertex_normals
from tests.rigged_shapes import FloatArray

Arrays = dict[str, npt.NDArray[Any]]

_BODY = Path(__file__).parents[1] / "resources" / "poses" / "body.npz"

_MIDDLE = {
    0: (0.0, 0.87, 0.0),
    3: (0.0, 0.96, 0.0),
    6: (0.0, 1.09, 0.0),
    9: (0.0, 1.2, 0.0),
    12: (0.0, 1.37, 0.0),
    15: (0.0, 1.45, 0.02),
}
_LEFT = {
    1: (0.085, 0.83, 0.015),
    4: (0.141, 0.446, 0.0),
    7: (0.175, 0.085, -0.005),
    10: (0.19, 0.02, 0.12),
    13: (0.05, 1.32, 0.01),
    16: (0.15, 1.31, 0.01),
    18: (0.317, 1.115, 0.045),
    20: (0.473, 0.948, 0.123),
}
"""Positions of the left and middle joints in the built-in body, by their numbers in SMPL."""

_PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]
_LEFT_WRIST, _RIGHT_WRIST, _HEAD = 20, 21, 15
_FACE = ((0.0, 1.47, 0.05), (0.03, 1.54, 0.1), (-0.03, 1.54, 0.1))
_TIP = (0.55, 0.83, 0.19)
"""Tip of the left hand."""


@cache
def _mesh() -> tuple[FloatArray, npt.NDArray[np.int32]]:
    """Return the built-in body at rest: metres, y up, facing z."""
    poses = read_pose_set(_BODY)
    x, y, z = poses.vertices[0].astype(np.float64).T
    return np.stack([x, z, -y], axis=1), poses.topology.faces


def _joints(n_joints: int) -> tuple[FloatArray, list[int]]:
    """Return the positions of the joints of SMPL, SMPL-H or SMPL-X, and their parents."""
    places, parents = np.zeros((22, 3)), list(_PARENTS)
    for joint, place in (_MIDDLE | _LEFT).items():
        places[joint] = place
    for joint in _LEFT:
        places[joint + 1] = places[joint] * [-1.0, 1.0, 1.0]
    rows, mirrored = [*places], np.array([-1.0, 1.0, 1.0])
    along = (np.array(_TIP) - places[_LEFT_WRIST]) / 4.0
    across = np.cross(along, [0.0, 0.0, 1.0])
    across /= 60.0 * np.linalg.norm(across)
    if n_joints == 24:
        rows += [places[_LEFT_WRIST] + 2.0 * along, (places[_LEFT_WRIST] + 2.0 * along) * mirrored]
        parents += [_LEFT_WRIST, _RIGHT_WRIST]
    if n_joints == 55:
        rows += [np.array(place) for place in _FACE]
        parents += [_HEAD] * 3
    for wrist, side in ((_LEFT_WRIST, np.ones(3)), (_RIGHT_WRIST, mirrored)):
        for finger in range(5 if n_joints > 24 else 0):
            for number in range(3):
                place = places[_LEFT_WRIST] + (1.6 + 0.7 * number) * along + (finger - 2) * across
                parents.append(len(rows) - 1 if number else wrist)
                rows.append(place * side)
    return np.array(rows), parents


def smpl_arrays(n_joints: int = 55, n_shapes: int = 10, seed: int = 0) -> Arrays:
    """Return the arrays of a model file, with made-up shape and pose directions."""
    vertices, faces = _mesh()
    joints, parents = _joints(n_joints)
    generator = np.random.default_rng(seed)
    weights = _weights(vertices, joints, parents)
    normals = vertex_normals(vertices, faces)
    shapes = np.empty((len(vertices), 3, n_shapes))
    for number in range(n_shapes):
        # Taller, and wider in places.
        width = 0.01 * np.cos(3.0 * vertices @ generator.normal(size=3))
        shapes[..., number] = 0.01 * generator.normal(size=3) * vertices + width[:, None] * normals
    # Each joint bulges the skin around it, by up to about a centimetre.
    near = weights[:, 1:] + np.take(weights, parents[1:], axis=1)
    bulge = 0.006 * generator.normal(size=(9 * (n_joints - 1), 3))
    bulge = bulge[None] + 0.006 * generator.normal(size=(1, len(bulge), 1)) * normals[:, None]
    poses = np.repeat(near, 9, axis=1)[:, None] * bulge.transpose(0, 2, 1)
    table = np.array([parents, range(n_joints)]) % 2**32
    return {
        "v_template": vertices,
        "shapedirs": shapes,
        "posedirs": poses,
        "J_regressor": _regressor(vertices, joints),
        "weights": weights,
        "kintree_table": table.astype(np.uint32),
        "f": faces.astype(np.uint32),
    }


def tiny_arrays() -> Arrays:
    """Return the arrays of a model in SMPL's layout: a tetrahedron around each joint."""
    generator = np.random.default_rng(3)
    joints, parents = _joints(24)
    corners = 0.03 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    vertices = (joints[:, None] + corners).reshape(-1, 3)
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    owner = np.repeat(np.eye(24), 4, axis=0)
    table = np.array([parents, range(24)]) % 2**32
    return {
        "v_template": vertices,
        "shapedirs": 0.01 * generator.normal(size=(96, 3, 4)),
        "posedirs": 0.001 * generator.normal(size=(96, 3, 207)),
        "J_regressor": owner.T / 4.0,
        "weights": owner,
        "kintree_table": table.astype(np.uint32),
        "f": (4 * np.arange(24)[:, None, None] + faces).reshape(-1, 3).astype(np.uint32),
    }


def _weights(vertices: FloatArray, joints: FloatArray, parents: list[int]) -> FloatArray:
    """Return (V, J) weights, at most 4 per vertex, by the distance to bones of the same side."""
    distance = np.full((len(vertices), len(joints)), np.inf)
    children = {parent: joint for joint, parent in enumerate(parents)}
    for joint, start in enumerate(joints):
        own = [child for child, parent in enumerate(parents) if parent == joint]
        ends = joints[own] if joint in children else start[None] + 0.3 * (start - joints[0]) * 0.1
        for end in ends:
            way = end - start
            share = np.clip((vertices - start) @ way / max(way @ way, 1e-12), 0.0, 1.0)
            away = np.linalg.norm(vertices - start - share[:, None] * way, axis=1)
            is_far = np.sign(start[0]) * vertices[:, 0] < -0.01
            distance[:, joint] = np.minimum(distance[:, joint], np.where(is_far, np.inf, away))
    nearness = (distance + 0.01) ** -5.0
    nearness[nearness < -np.sort(-nearness, axis=1)[:, 3:4]] = 0.0
    return nearness / nearness.sum(axis=1, keepdims=True)


def _regressor(vertices: FloatArray, joints: FloatArray) -> FloatArray:
    """Return the sparse (J, V) regressor of the joints."""
    regressor = np.zeros((len(joints), len(vertices)))
    for joint, place in enumerate(joints):
        near = np.linalg.norm(vertices - place, axis=1).argsort()[:12]
        system = np.concatenate([vertices[near].T, np.ones((1, len(near)))])
        regressor[joint, near] = np.linalg.lstsq(system, [*place, 1.0], rcond=None)[0]
    return regressor


def write_model(path: Path, n_joints: int = 55, **rest: int) -> Path:
    """Write a model file."""
    np.savez(path, **smpl_arrays(n_joints, **rest))
    return path


def motion_arrays(
    n_joints: int = 55, n_frames: int = 40, seed: int = 0, *, z_is_up: bool = False
) -> Arrays:
    """Return the arrays of a motion in AMASS's layout: an arm swings into the body and out again.

    Small motions elsewhere, the shape and the path depend on the seed.
    """
    generator = np.random.default_rng(seed)
    share = np.linspace(0.0, 1.0, n_frames)
    turns = np.zeros((n_frames, n_joints, 3))
    sway, rate = 0.05 * generator.normal(size=(22, 3)), generator.uniform(0.5, 1.5, (22, 3))
    turns[:, :22] = sway * np.sin(2.0 * np.pi * rate * share[:, None, None])
    side = int(generator.integers(2))
    down, elbow = generator.uniform(0.78, 0.9), generator.uniform(0.1, 0.4)
    inwards = np.array([[0.0, 0.3, -down], [0.0, -elbow, -0.2]]) * [1.0, 1.0 - 2.0 * side, 1.0]
    inwards[:, 2] *= 1.0 - 2.0 * side
    turns[:, [16 + side, 18 + side]] += np.sin(np.pi * share)[:, None, None] ** 2 * inwards
    places = share[:, None] * generator.normal(size=3)
    if z_is_up:
        upright = Rotation.from_rotvec([0.5 * np.pi, 0.0, 0.0])
        turns[:, 0] = (upright * Rotation.from_rotvec(turns[:, 0])).as_rotvec()
        places = upright.apply(places)
    return {
        "poses": turns.reshape(n_frames, -1),
        "trans": places,
        "betas": generator.normal(size=16),
        "gender": np.array("neutral"),
        "mocap_framerate": np.array(30.0),
    }


def write_motion(path: Path, **rest: Any) -> Path:
    """Write a motion in AMASS's layout."""
    np.savez(path, **motion_arrays(**rest))
    return path


def linear_blend_skinning(
    arrays: Arrays, betas: FloatArray, turns: FloatArray, trans: FloatArray
) -> FloatArray:
    """Return the (V, 3) vertices of one pose, by equations 2 to 10 of Loper et al. 2015.

    Parameters
    ----------
    turns, trans : (J, 3) and (3,)
    """
    parents = [-1, *arrays["kintree_table"][0, 1:].tolist()]
    shape = arrays["v_template"] + np.einsum("vxs,s->vx", arrays["shapedirs"], betas)
    joints = arrays["J_regressor"] @ shape
    rotations = Rotation.from_rotvec(turns).as_matrix()
    entries = (rotations[1:] - np.eye(3)).reshape(-1)
    rest = shape + np.einsum("vxe,e->vx", arrays["posedirs"], entries)
    placed: list[FloatArray] = []
    vertices = np.zeros_like(rest)
    for joint, parent in enumerate(parents):
        own = np.eye(4)
        own[:3, :3] = rotations[joint]
        own[:3, 3] = joints[joint] - (joints[parent] if joint else 0.0)
        placed.append(placed[parent] @ own if joint else own)
        moved = (rest - joints[joint]) @ placed[joint][:3, :3].T + placed[joint][:3, 3]
        vertices += arrays["weights"][:, joint, None] * moved
    return vertices + trans


if __name__ == "__main__":
    # A model and 20 motions that collide, for docs/results.md.
    folder = Path(sys.argv[1])
    (folder / "motions").mkdir(parents=True)
    write_model(folder / "SMPLX_NEUTRAL.npz", n_shapes=400)
    for number in {*range(21)} - {16}:
        path = folder / "motions" / f"motion {number}.npz"
        write_motion(path, seed=number, z_is_up=number % 2 == 1)
