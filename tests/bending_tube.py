"""A closed tube that bends at two joints: a body with analytic poses."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.files import PoseSet
from lcollision_core.meshes import Topology

RINGS, SIDES, RADIUS = 26, 8, 0.055
LENGTH_IN_FILES = 170.0
PLACE_IN_FILES = np.array([10.0, -20.0, 30.0])


def tube_topology() -> Topology:
    ring, side = np.meshgrid(np.arange(RINGS - 1), np.arange(SIDES), indexing="ij")
    a = (ring * SIDES + side).ravel()
    b = (ring * SIDES + (side + 1) % SIDES).ravel()
    walls = np.concatenate(
        [np.stack([a, b, b + SIDES], axis=1), np.stack([a, b + SIDES, a + SIDES], axis=1)]
    )
    first, following = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    bottom, top, last = RINGS * SIDES, RINGS * SIDES + 1, (RINGS - 1) * SIDES
    caps = np.concatenate(
        [
            np.stack([following, first, np.full(SIDES, bottom)], axis=1),
            np.stack([first + last, following + last, np.full(SIDES, top)], axis=1),
        ]
    )
    return Topology(np.concatenate([walls, caps]), top + 1)


def bent_tube(lower: float, upper: float) -> npt.NDArray[np.float64]:
    """Return the (V, 3) tube of length 1 along y, bent about z by two angles in radians."""
    along = np.linspace(0.0, 1.0, RINGS)
    turn = lower * np.clip((along - 0.2) / 0.2, 0, 1) + upper * np.clip((along - 0.6) / 0.2, 0, 1)
    tangents = np.stack([np.sin(turn), np.cos(turn), 0 * turn], axis=1)
    normals = np.stack([np.cos(turn), -np.sin(turn), 0 * turn], axis=1)
    steps = 0.5 * (tangents[1:] + tangents[:-1]) * np.diff(along)[:, None]
    centres = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    rings = centres[:, None] + RADIUS * (
        np.cos(angles)[None, :, None] * normals[:, None]
        - np.sin(angles)[None, :, None] * np.array([0.0, 0.0, 1.0])
    )
    return np.concatenate([rings.reshape(-1, 3), centres[[0]], centres[[-1]]])


def bending_tube(n_poses: int = 16, most: float = 3.0, labelled: bool = False) -> PoseSet:
    """Make a pose set whose first pose is straight, with an arbitrary unit and position."""
    angles = np.random.default_rng(5).uniform(-most, most, (n_poses, 2))
    angles[0] = 0.0
    vertices = np.stack([bent_tube(lower, upper) for lower, upper in angles])
    labels = np.where(np.arange(vertices.shape[1]) // SIDES < RINGS // 2, "left shin", "left thigh")
    labels[-2:] = "left shin", "left thigh"
    return PoseSet(
        vertices * LENGTH_IN_FILES + PLACE_IN_FILES,
        tube_topology(),
        tuple(f"bend {pose}" for pose in range(n_poses)),
        vertex_labels=labels if labelled else None,
    )
