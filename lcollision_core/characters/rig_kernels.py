"""The loops of posing by a rig: joints to vertices, and derivatives back.

Joint b turns by exp(w_b) in its own axes X_b about its rest place o_b, and its parent carries it:
D_b = D_parent o (x -> o_b + X_b exp(w_b) X_b^T (x - o_b)). D_0 shifts besides. A vertex is the
weighted mean of D_b points over its influences. Parents come before children; b counts the joints
that have codes.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import FloatArray, IntArray

_SERIES = 0.02
"""Radians below which the coefficients of the exponential's derivative are summed as a series."""


@compiled
def _cross_matrix(vector: FloatArray) -> FloatArray:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@compiled
def _exponential(turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return exp of a (3,) rotation vector, and the left Jacobian of exp there, both (3, 3)."""
    squared = turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2
    angle = math.sqrt(squared)
    if angle < _SERIES:
        sine = 1.0 - squared / 6.0 + squared**2 / 120.0
        versine = 0.5 - squared / 24.0 + squared**2 / 720.0
        rest = 1.0 / 6.0 - squared / 120.0 + squared**2 / 5040.0
    else:
        sine = math.sin(angle) / angle
        versine = 2.0 * math.sin(0.5 * angle) ** 2 / squared
        rest = (angle - math.sin(angle)) / (angle * squared)
    across = _cross_matrix(turn)
    twice = across @ across
    return np.eye(3) + sine * across + versine * twice, np.eye(3) + versine * across + rest * twice


@compiled
def joint_motions(
    turns: FloatArray,
    shift: FloatArray,
    parents: npt.NDArray[np.int64],
    axes: FloatArray,
    origins: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return each joint's motion D_b from the rest pose, and how its turn moves the world.

    Parameters
    ----------
    turns : (J, 3) rotation vectors w_b in the joints' axes
    shift : (3,) of joint 0
    parents : (J,), -1 for joint 0 alone
    axes : (J, 3, 3) orthonormal X_b, an axis a column
    origins : (J, 3) o_b

    Returns
    -------
    rotations, translations : (J, 3, 3) and (J, 3) of D_b
    pivots : (J, 3) the posed places of the joints
    slopes : (J, 3, 3), column i: the posed rotation vector by entry i of w_b
    """
    n_joints = len(turns)
    rotations, slopes = np.empty((n_joints, 3, 3)), np.empty((n_joints, 3, 3))
    translations, pivots = np.empty((n_joints, 3)), np.empty((n_joints, 3))
    for joint in range(n_joints):
        turn, slope = _exponential(turns[joint])
        parent = parents[joint]
        if parent < 0:
            before = axes[joint].copy()
            pivots[joint] = origins[joint] + shift
        else:
            before = rotations[parent] @ axes[joint]
            pivots[joint] = rotations[parent] @ origins[joint] + translations[parent]
        rotations[joint] = before @ turn @ axes[joint].T
        translations[joint] = pivots[joint] - rotations[joint] @ origins[joint]
        slopes[joint] = before @ slope
    return rotations, translations, pivots, slopes


@compiled
def skin(
    first: IntArray,
    joints: IntArray,
    weights: FloatArray,
    points: FloatArray,
    rotations: FloatArray,
    translations: FloatArray,
) -> FloatArray:
    """Return the (V, 3) vertices of joints' motions.

    Parameters
    ----------
    first : (V + 1,) where each vertex's influences begin
    joints, weights, points : (M,), (M,) and (M, 3), the influences
    rotations, translations : (J, 3, 3) and (J, 3)
    """
    vertices = np.zeros((len(first) - 1, 3))
    for vertex in range(len(vertices)):
        for influence in range(first[vertex], first[vertex + 1]):
            joint, weight, point = joints[influence], weights[influence], points[influence]
            for row in range(3):
                vertices[vertex, row] += weight * (
                    rotations[joint, row, 0] * point[0]
                    + rotations[joint, row, 1] * point[1]
                    + rotations[joint, row, 2] * point[2]
                    + translations[joint, row]
                )
    return vertices


@compiled
def _posed(rotation: FloatArray, translation: FloatArray, point: FloatArray, row: int) -> float:
    along = rotation[row, 0] * point[0] + rotation[row, 1] * point[1] + rotation[row, 2] * point[2]
    return float(along + translation[row])


@compiled
def pull_back_moments(
    by_vertices: FloatArray,
    first: IntArray,
    joints: IntArray,
    weights: FloatArray,
    points: FloatArray,
    parents: npt.NDArray[np.int64],
    rotations: FloatArray,
    translations: FloatArray,
    pivots: FloatArray,
    slopes: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Turn derivatives by the vertices into those by the joints' turns and the shift.

    Parameters
    ----------
    by_vertices : (n, V, 3)
    others : see `skin` and `joint_motions`

    Returns
    -------
    by_turns, by_shift : (n, J, 3) and (n, 3)

    Notes
    -----
    With g the derivative by a vertex and p where one joint has it, the moments about the origin
    A = sum w p x g and the forces B = sum w g of the joints below b give the derivative by the
    posed rotation vector of b, A - q_b x B, at its pivot q_b.
    """
    n_rows, n_joints = len(by_vertices), len(parents)
    by_turns, by_shift = np.empty((n_rows, n_joints, 3)), np.empty((n_rows, 3))
    for row in range(n_rows):
        moments, forces = np.zeros((n_joints, 3)), np.zeros((n_joints, 3))
        for vertex in range(by_vertices.shape[1]):
            x, y, z = by_vertices[row, vertex]
            # Rows of patches and contacts are zero at most vertices.
            if x == 0.0 and y == 0.0 and z == 0.0:
                continue
            for influence in range(first[vertex], first[vertex + 1]):
                joint, weight, point = joints[influence], weights[influence], points[influence]
                rotation, translation = rotations[joint], translations[joint]
                a = _posed(rotation, translation, point, 0)
                b = _posed(rotation, translation, point, 1)
                c = _posed(rotation, translation, point, 2)
                moments[joint, 0] += weight * (b * z - c * y)
                moments[joint, 1] += weight * (c * x - a * z)
                moments[joint, 2] += weight * (a * y - b * x)
                forces[joint, 0] += weight * x
                forces[joint, 1] += weight * y
                forces[joint, 2] += weight * z
        for joint in range(n_joints - 1, -1, -1):
            if joint > 0:
                moments[parents[joint]] += moments[joint]
                forces[parents[joint]] += forces[joint]
            torque = moments[joint] - _cross_matrix(pivots[joint]) @ forces[joint]
            by_turns[row, joint] = slopes[joint].T @ torque
        by_shift[row] = forces[0]
    return by_turns, by_shift


@compiled
def tangents(
    chosen: npt.NDArray[np.int64],
    first: IntArray,
    joints: IntArray,
    weights: FloatArray,
    points: FloatArray,
    parents: npt.NDArray[np.int64],
    rotations: FloatArray,
    translations: FloatArray,
    pivots: FloatArray,
    slopes: FloatArray,
) -> FloatArray:
    """Return how (n,) chosen vertices move with the joints' turns: (J, 3, n, 3).

    Parameters
    ----------
    chosen : indices from 0
    others : see `skin` and `joint_motions`
    """
    moved = np.zeros((len(parents), 3, len(chosen), 3))
    for place in range(len(chosen)):
        vertex = chosen[place]
        for influence in range(first[vertex], first[vertex + 1]):
            weight, joint = weights[influence], joints[influence]
            point = points[influence]
            posed = rotations[joint] @ point + translations[joint]
            while joint >= 0:
                turned = -_cross_matrix(posed - pivots[joint]) @ slopes[joint]
                for entry in range(3):
                    for row in range(3):
                        moved[joint, entry, place, row] += weight * turned[row, entry]
                joint = parents[joint]
    return moved
