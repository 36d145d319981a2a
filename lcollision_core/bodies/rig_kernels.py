"""Compiled loops of linear blend skinning, and pose blend shapes.

Joint b turns by exp(w_b) in its own axes X_b about its rest position o_b, and moves with its
parent: D_b = D_parent o (x -> p_b + X_b exp(w_b) Y_b (x - o_b)). D_0 adds the shift. For a body at
rest p_b is o_b and Y_b is X_b^-1; for one that a clip scales and stretches see `JointOffsets`. X_b
is orthonormal unless an ancestor is scaled unevenly at rest. Then it is P_b times an orthonormal
frame, so that the joint's local transform is still a pure rotation, and P_b shears as in every
engine; see `Rig.stretch`. A vertex is the weighted mean of D_b points over its influences. Parents
come before children; b counts the joints that have codes.

Rows are filled entry by entry: for an assignment of whole rows, Numba would spend over a second
compiling its shape mismatch message.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import compiled, compiled_part, compiled_sums
from lcollision_core.meshes.topology import FloatArray, IntArray

_F: TypeAlias = FloatArray
JointFrames: TypeAlias = tuple[npt.NDArray[np.int64], _F, _F, _F, _F, _F, _F]
"""The J joints at rest: their parents, -1 for joint 0 only; X_b, axes as columns, and X_b^-1; o_b
and p_b; Y_b, and its inverse or pseudo-inverse."""

Influences: TypeAlias = tuple[IntArray, IntArray, FloatArray, FloatArray]
"""The (V + 1,) start of each vertex's influences; their (M,) joints and weights; (M, 3) points."""

Motions: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""(J, 3, 3) and (J, 3) linear maps and translations of D_b; q_b, the posed joint positions; and
(J, 3, 3, 3) K_b,i: a point p carried by D_b moves by K_b,i (p - q_b) per unit of entry i of w_b."""

_SERIES = 0.02
"""Radians below which the coefficients of the exponential's derivative are series."""


@compiled_part
def _cross_matrix(vector: FloatArray) -> FloatArray:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@compiled_part
def _put(values: FloatArray, out: FloatArray) -> None:
    for row in range(3):
        for column in range(3):
            out[row, column] = values[row, column]


@compiled_part
def _coefficients(turn: FloatArray) -> tuple[float, float, float]:
    """Return the factors of [w]x and [w]x^2 in the exponential, and of [w]x^2 in its Jacobian."""
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
    return sine, versine, rest


@compiled_part
def _exponential(turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the exponential of a (3,) rotation vector and its left Jacobian, both (3, 3)."""
    sine, versine, rest = _coefficients(turn)
    across = _cross_matrix(turn)
    twice = across @ across
    return np.eye(3) + sine * across + versine * twice, np.eye(3) + versine * across + rest * twice


@compiled_part
def _put_rotation(turn: FloatArray, out: FloatArray) -> None:
    """Write the exponential of a (3,) rotation vector to a (3, 3) array."""
    sine, versine, _ = _coefficients(turn)
    x, y, z = turn
    out[0, 0], out[0, 1] = 1.0 - versine * (y * y + z * z), versine * x * y - sine * z
    out[0, 2], out[1, 0] = versine * x * z + sine * y, versine * x * y + sine * z
    out[1, 1], out[1, 2] = 1.0 - versine * (x * x + z * z), versine * y * z - sine * x
    out[2, 0], out[2, 1] = versine * x * z - sine * y, versine * y * z + sine * x
    out[2, 2] = 1.0 - versine * (x * x + y * y)


@compiled_part
def _put_product(one: FloatArray, other: FloatArray, out: FloatArray) -> None:
    for row in range(3):
        for column in range(3):
            out[row, column] = (
                one[row, 0] * other[0, column]
                + one[row, 1] * other[1, column]
                + one[row, 2] * other[2, column]
            )


@compiled
def local_rotations(turns: FloatArray, axes: FloatArray, own: FloatArray) -> FloatArray:
    """Return each joint's linear map relative to its parent, X_b exp(w_b) Y_b: (J, 3, 3).

    Parameters
    ----------
    turns, axes, own : see `joint_motions`
    """
    rotations = np.empty((len(turns), 3, 3))
    for joint in range(len(turns)):
        turn, _ = _exponential(turns[joint])
        _put(axes[joint] @ turn @ own[joint], rotations[joint])
    return rotations


@compiled
def rotation_slopes(turns: FloatArray, axes: FloatArray, own: FloatArray) -> FloatArray:
    """Return the derivatives of `local_rotations` by the entries of w_b: (J, 3, 3, 3)."""
    slopes = np.empty((len(turns), 3, 3, 3))
    for joint in range(len(turns)):
        turn, slope = _exponential(turns[joint])
        for entry in range(3):
            moved = _cross_matrix(slope[:, entry].copy()) @ turn
            _put(axes[joint] @ moved @ own[joint], slopes[joint, entry])
    return slopes


@compiled
def joint_motions(turns: FloatArray, shift: FloatArray, frames: JointFrames) -> Motions:
    """Return each joint's motion D_b from the rest pose, and its derivatives by the turns.

    Parameters
    ----------
    turns : (J, 3) rotation vectors w_b in the joints' axes
    shift : (3,) of joint 0
    """
    parents, axes, inverses, origins, places, own, own_inverses = frames
    n_joints = len(turns)
    linear, generators = np.empty((n_joints, 3, 3)), np.empty((n_joints, 3, 3, 3))
    inverted = np.empty((n_joints, 3, 3))
    translations, pivots = np.empty((n_joints, 3)), np.empty((n_joints, 3))
    for joint in range(n_joints):
        turn, slope = _exponential(turns[joint])
        parent = parents[joint]
        if parent < 0:
            before, back = axes[joint].copy(), inverses[joint].copy()
            carried, moved = places[joint].copy(), shift
        else:
            before, back = linear[parent] @ axes[joint], inverses[joint] @ inverted[parent]
            carried, moved = linear[parent] @ places[joint], translations[parent]
        _put(before @ turn @ own[joint], linear[joint])
        _put(own_inverses[joint] @ turn.T @ back, inverted[joint])
        turned = linear[joint] @ origins[joint]
        for row in range(3):
            pivots[joint, row] = carried[row] + moved[row]
            translations[joint, row] = pivots[joint, row] - turned[row]
            for column in range(3):
                # B [e_k]x B^-1 for axis k; entry i sums them with column i of the slope.
                a = before[row, 2] * back[1, column] - before[row, 1] * back[2, column]
                b = before[row, 0] * back[2, column] - before[row, 2] * back[0, column]
                c = before[row, 1] * back[0, column] - before[row, 0] * back[1, column]
                for entry in range(3):
                    generators[joint, entry, row, column] = (
                        slope[0, entry] * a + slope[1, entry] * b + slope[2, entry] * c
                    )
    return linear, translations, pivots, generators


@compiled_part
def _posed(linear: FloatArray, translation: FloatArray, point: FloatArray, row: int) -> float:
    along = linear[row, 0] * point[0] + linear[row, 1] * point[1] + linear[row, 2] * point[2]
    return float(along + translation[row])


@compiled_part
def skinned_vertex(
    linear: FloatArray,
    translations: FloatArray,
    first: IntArray,
    joints: IntArray,
    weights: FloatArray,
    points: FloatArray,
    vertex: int,
) -> tuple[float, float, float]:
    """Return the position of a vertex in one pose; see `skin`."""
    x, y, z = 0.0, 0.0, 0.0
    # By element, as every row of an array costs its reference count.
    for influence in range(np.uint64(first[vertex]), np.uint64(first[vertex + 1])):
        weight, joint = weights[influence], np.uint64(joints[influence])
        a, b, c = points[influence, 0], points[influence, 1], points[influence, 2]
        x += weight * (
            linear[joint, 0, 0] * a
            + linear[joint, 0, 1] * b
            + linear[joint, 0, 2] * c
            + translations[joint, 0]
        )
        y += weight * (
            linear[joint, 1, 0] * a
            + linear[joint, 1, 1] * b
            + linear[joint, 1, 2] * c
            + translations[joint, 1]
        )
        z += weight * (
            linear[joint, 2, 0] * a
            + linear[joint, 2, 1] * b
            + linear[joint, 2, 2] * c
            + translations[joint, 2]
        )
    return x, y, z


@compiled
def skin(
    linear: FloatArray, translations: FloatArray, influences: Influences, vertices: FloatArray
) -> None:
    """Write the (V, 3) vertices of one pose, given `Motions` of the joints."""
    first, joints, weights, points = influences
    for vertex in range(len(first) - 1):
        x, y, z = skinned_vertex(linear, translations, first, joints, weights, points, vertex)
        vertices[vertex, 0] = x
        vertices[vertex, 1] = y
        vertices[vertex, 2] = z


@compiled
def move_joints(
    turns: FloatArray,
    shifts: FloatArray,
    frames: JointFrames,
    linear: FloatArray,
    translations: FloatArray,
) -> None:
    """Write the joints' motions, (B, J, 3, 3) and (B, J, 3), for turns and shifts of B poses.

    They are those of `joint_motions`, without derivatives.
    """
    parents, axes, _, origins, places, own, _ = frames
    before, turn, turned = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for pose in range(len(turns)):
        moved, shift = linear[pose], translations[pose]
        for joint in range(turns.shape[1]):
            parent = parents[joint]
            _put_rotation(turns[pose, joint], turn)
            if parent < 0:
                _put_product(axes[joint], turn, turned)
            else:
                _put_product(moved[parent], axes[joint], before)
                _put_product(before, turn, turned)
            _put_product(turned, own[joint], moved[joint])
            for row in range(3):
                if parent < 0:
                    at = places[joint, row] + shifts[pose, row]
                else:
                    at = _posed(moved[parent], shift[parent], places[joint], row)
                shift[joint, row] = at - (
                    moved[joint, row, 0] * origins[joint, 0]
                    + moved[joint, row, 1] * origins[joint, 1]
                    + moved[joint, row, 2] * origins[joint, 2]
                )


@compiled
def skin_poses(
    turns: FloatArray,
    shifts: FloatArray,
    frames: JointFrames,
    influences: Influences,
    vertices: FloatArray,
) -> None:
    """Write the (B, V, 3) vertices of a block of poses, for (B, J, 3) turns and (B, 3) shifts."""
    n_poses, n_joints = turns.shape[:2]
    linear, translations = np.empty((n_poses, n_joints, 3, 3)), np.empty((n_poses, n_joints, 3))
    move_joints(turns, shifts, frames, linear, translations)
    for pose in range(n_poses):
        skin(linear[pose], translations[pose], influences, vertices[pose])


@compiled
def pull_back_moments(
    by_vertices: FloatArray,
    influences: Influences,
    parents: npt.NDArray[np.int64],
    motions: Motions,
) -> tuple[FloatArray, FloatArray]:
    """Turn (n, V, 3) derivatives by vertices into those by the joints' turns and the shift.

    Returns
    -------
    by_turns, by_shift : (n, J, 3) and (n, 3)

    Notes
    -----
    With g the derivative by a vertex and p its position as moved by one joint, the moments about
    the origin A = sum w g p^T and the forces F = sum w g over b and its descendants give the
    derivative by entry i of w_b: the sum of the entries of K_b,i * (A - F q_b^T).
    """
    first, joints, weights, points = influences
    linear, translations, pivots, generators = motions
    n_rows, n_joints = len(by_vertices), len(parents)
    by_turns, by_shift = np.zeros((n_rows, n_joints, 3)), np.empty((n_rows, 3))
    for row in range(n_rows):
        moments, forces = np.zeros((n_joints, 3, 3)), np.zeros((n_joints, 3))
        for vertex in range(by_vertices.shape[1]):
            x, y, z = by_vertices[row, vertex]
            # Derivatives of patches and contacts are zero at most vertices.
            if x == 0.0 and y == 0.0 and z == 0.0:
                continue
            for influence in range(first[vertex], first[vertex + 1]):
                joint, weight, point = joints[influence], weights[influence], points[influence]
                for axis in range(3):
                    moment = weight * _posed(linear[joint], translations[joint], point, axis)
                    moments[joint, 0, axis] += x * moment
                    moments[joint, 1, axis] += y * moment
                    moments[joint, 2, axis] += z * moment
                forces[joint, 0] += weight * x
                forces[joint, 1] += weight * y
                forces[joint, 2] += weight * z
        for joint in range(n_joints - 1, -1, -1):
            for axis in range(3):
                if joint > 0:
                    forces[parents[joint], axis] += forces[joint, axis]
                for other in range(3):
                    if joint > 0:
                        moments[parents[joint], axis, other] += moments[joint, axis, other]
                    about = moments[joint, axis, other] - forces[joint, axis] * pivots[joint, other]
                    for entry in range(3):
                        by_turns[row, joint, entry] += generators[joint, entry, axis, other] * about
        for axis in range(3):
            by_shift[row, axis] = forces[0, axis]
    return by_turns, by_shift


@compiled
def tangents(
    chosen: npt.NDArray[np.int64],
    influences: Influences,
    parents: npt.NDArray[np.int64],
    motions: Motions,
) -> FloatArray:
    """Return the derivatives of (n,) chosen vertices by the joints' turns: (J, 3, n, 3)."""
    first, joints, weights, points = influences
    linear, translations, pivots, generators = motions
    moved = np.zeros((len(parents), 3, len(chosen), 3))
    for place in range(len(chosen)):
        vertex = chosen[place]
        for influence in range(first[vertex], first[vertex + 1]):
            weight, joint = weights[influence], joints[influence]
            point = points[influence]
            posed = linear[joint] @ point + translations[joint]
            while joint >= 0:
                arm = weight * (posed - pivots[joint])
                for entry in range(3):
                    by_entry = generators[joint, entry] @ arm
                    for axis in range(3):
                        moved[joint, entry, place, axis] += by_entry[axis]
                joint = parents[joint]
    return moved


_Shapes = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PoseShapes:
    """Offsets of V vertices' points per entry of R_b - I, for the B bones of a pose space.

    Attributes
    ----------
    directions : (V, 3, B, 9) float32 array, zero for the first bone
    """

    directions: _Shapes

    def offsets(self, rotations: FloatArray, chosen: npt.NDArray[np.integer]) -> FloatArray:
        """Return the (n, 3) offsets of chosen vertices for (B, 3, 3) rotations."""
        flat = self.directions.reshape(len(self.directions), 3, -1)
        return _offsets(flat, (rotations - np.eye(3)).reshape(-1), chosen.astype(np.int64))

    def tangents(
        self,
        slopes: FloatArray,
        chosen: npt.NDArray[np.int64],
        influences: Influences,
        linear: FloatArray,
    ) -> FloatArray:
        """Return derivatives of chosen vertices, via their points, by the turns: (B, 3, n, 3).

        Parameters
        ----------
        slopes : (B, 3, 3, 3) derivatives of the rotations by the turns
        chosen : (n,) indices from 0
        influences : of the chosen vertices
        linear : of the bones' motions
        """
        blended = _blended(influences, linear)
        return _moved(self.directions, slopes.reshape(len(slopes), 3, 9), chosen, blended)

    def pull_back(
        self,
        slopes: FloatArray,
        by_vertices: FloatArray,
        chosen: npt.NDArray[np.int64],
        influences: Influences,
        linear: FloatArray,
    ) -> FloatArray:
        """Turn derivatives by the chosen vertices, (m, n, 3), into those by turns, (m, B, 3)."""
        blended = _blended(influences, linear)
        by_points = np.einsum("mnx,nxa->mna", by_vertices, blended)
        flat = self.directions.reshape(len(self.directions), 3, -1)
        by_entries = _summed(flat, by_points, chosen)
        shape = len(by_entries), len(slopes), 9
        pulled: FloatArray = np.einsum(
            "mbi,bei->mbe", by_entries.reshape(shape), slopes.reshape(len(slopes), 3, 9)
        )
        return pulled


@compiled_sums
def _offsets(directions: _Shapes, entries: FloatArray, chosen: npt.NDArray[np.int64]) -> FloatArray:
    moved = np.empty((len(chosen), 3))
    for place in range(len(chosen)):
        for axis in range(3):
            row = directions[chosen[place], axis]
            total = 0.0
            for entry in range(len(entries)):
                total += row[entry] * entries[entry]
            moved[place, axis] = total
    return moved


@compiled
def _blended(influences: Influences, linear: FloatArray) -> FloatArray:
    """Return the weighted mean of each vertex's linear maps: (n, 3, 3)."""
    first, joints, weights, _ = influences
    blended = np.zeros((len(first) - 1, 3, 3))
    for place in range(len(blended)):
        for influence in range(first[place], first[place + 1]):
            blended[place] += weights[influence] * linear[joints[influence]]
    return blended


@compiled
def _moved(
    directions: _Shapes,
    slopes: FloatArray,
    chosen: npt.NDArray[np.int64],
    blended: FloatArray,
) -> FloatArray:
    """Return the derivatives of chosen vertices by the turns: (B, 3, n, 3)."""
    moved = np.zeros((len(slopes), 3, len(chosen), 3))
    for place in range(len(chosen)):
        for bone in range(len(slopes)):
            for entry in range(3):
                for axis in range(3):
                    along = 0.0
                    for number in range(9):
                        along += (
                            directions[chosen[place], axis, bone, number]
                            * slopes[bone, entry, number]
                        )
                    for row in range(3):
                        moved[bone, entry, place, row] += blended[place, row, axis] * along
    return moved


@compiled
def _summed(
    directions: _Shapes, by_points: FloatArray, chosen: npt.NDArray[np.int64]
) -> FloatArray:
    """Turn (m, n, 3) derivatives by points into derivatives by rotations: (m, entries)."""
    summed = np.zeros((len(by_points), directions.shape[2]))
    for place in range(len(chosen)):
        for axis in range(3):
            row = directions[chosen[place], axis]
            for number in range(len(by_points)):
                factor = by_points[number, place, axis]
                if factor != 0.0:
                    for entry in range(len(row)):
                        summed[number, entry] += factor * row[entry]
    return summed
