"""Rotations of polar decompositions, and logarithms that agree between neighbours."""

from __future__ import annotations

import heapq
import math

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.compiled import compiled, compiled_part
from lcollision_core.meshes.topology import FloatArray, IntArray

_JACOBI_SWEEPS = 12
_SINGULAR = 1e-14
_AXES = np.eye(3)


@compiled_part
def _orthogonalise(u: FloatArray, v: FloatArray) -> None:
    """Turn (3, 3) T in `u` into T V with orthogonal columns; write the rotation V to `v`.

    One-sided Jacobi keeps the digits of small singular values, which an eigensolver on the square
    of T would lose.
    """
    v[:] = 0.0
    v[0, 0] = v[1, 1] = v[2, 2] = 1.0
    for _ in range(_JACOBI_SWEEPS):
        turned = False
        for p in range(2):
            for q in range(p + 1, 3):
                alpha = u[0, p] * u[0, p] + u[1, p] * u[1, p] + u[2, p] * u[2, p]
                beta = u[0, q] * u[0, q] + u[1, q] * u[1, q] + u[2, q] * u[2, q]
                gamma = u[0, p] * u[0, q] + u[1, p] * u[1, q] + u[2, p] * u[2, q]
                if abs(gamma) <= 1e-15 * math.sqrt(alpha * beta):
                    continue
                turned = True
                zeta = (beta - alpha) / (2.0 * gamma)
                t = 1.0 / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
                if zeta < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = c * t
                for a in range(3):
                    low, high = u[a, p], u[a, q]
                    u[a, p], u[a, q] = c * low - s * high, s * low + c * high
                    low, high = v[a, p], v[a, q]
                    v[a, p], v[a, q] = c * low - s * high, s * low + c * high
        if not turned:
            break


@compiled_part
def _write_quaternion(r: FloatArray, quaternion: FloatArray) -> None:
    """Write the unit quaternion (w, x, y, z), w >= 0, of a (3, 3) rotation matrix (Shepperd)."""
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    if trace >= r[0, 0] and trace >= r[1, 1] and trace >= r[2, 2]:
        w, x, y, z = 1.0 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    elif r[0, 0] >= r[1, 1] and r[0, 0] >= r[2, 2]:
        w, x = r[2, 1] - r[1, 2], 1.0 + 2.0 * r[0, 0] - trace
        y, z = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]
    elif r[1, 1] >= r[2, 2]:
        w, x = r[0, 2] - r[2, 0], r[0, 1] + r[1, 0]
        y, z = 1.0 + 2.0 * r[1, 1] - trace, r[1, 2] + r[2, 1]
    else:
        w, x = r[1, 0] - r[0, 1], r[0, 2] + r[2, 0]
        y, z = r[1, 2] + r[2, 1], 1.0 + 2.0 * r[2, 2] - trace
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        scale = -scale
    quaternion[0], quaternion[1] = scale * w, scale * x
    quaternion[2], quaternion[3] = scale * y, scale * z


@compiled
def split_gradients(gradients: FloatArray, quaternions: FloatArray, stretches: FloatArray) -> None:
    """Split every vertex's deformation gradient T = R S into a rotation and a symmetric stretch.

    Where T mirrors, S takes the negative sign in its weakest direction. Where T is singular, the
    rotation of the lost directions is arbitrary, but R is still a rotation and R S is still T.

    Parameters
    ----------
    gradients : (V, 3, 3) float64 array, T
    quaternions : (V, 4) float64 array, overwritten with R as (w, x, y, z), w >= 0
    stretches : (V, 6) float64 array, overwritten with the upper triangle of S row by row
    """
    u, v, rotation = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    left, value = np.empty((3, 3)), np.empty(3)
    for i in range(len(gradients)):
        for a in range(3):
            for b in range(3):
                u[a, b] = gradients[i, a, b]
        _orthogonalise(u, v)
        for a in range(3):
            value[a] = math.sqrt(u[0, a] * u[0, a] + u[1, a] * u[1, a] + u[2, a] * u[2, a])
        strong = 0
        for a in range(1, 3):
            if value[a] > value[strong]:
                strong = a
        weak = (strong + 1) % 3
        if value[(strong + 2) % 3] < value[weak]:
            weak = (strong + 2) % 3
        middle = 3 - strong - weak
        handed = 1.0 if (middle - strong) % 3 == 1 else -1.0

        # The rotation takes V's columns to the unit columns of T V, completed to a rotation.
        is_point = not value[strong] > 0.0
        is_line = not value[middle] > _SINGULAR * value[strong]
        for a in range(3):
            left[a, strong] = _AXES[0, a] if is_point else u[a, strong] / value[strong]
        axis = 0 if abs(left[0, strong]) < 0.6 else 1
        along, squared_length = 0.0, 0.0
        for a in range(3):
            left[a, middle] = _AXES[axis, a] if is_line else u[a, middle]
            along += left[a, strong] * left[a, middle]
        for a in range(3):
            left[a, middle] -= along * left[a, strong]
            squared_length += left[a, middle] * left[a, middle]
        for a in range(3):
            left[a, middle] /= math.sqrt(squared_length)
        value[weak] = 0.0
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            normal = left[b, strong] * left[c, middle] - left[c, strong] * left[b, middle]
            left[a, weak] = handed * normal
            value[weak] += left[a, weak] * u[a, weak]

        n = 0
        for a in range(3):
            for b in range(3):
                rotation[a, b] = (
                    left[a, strong] * v[b, strong]
                    + left[a, middle] * v[b, middle]
                    + left[a, weak] * v[b, weak]
                )
            for b in range(a, 3):
                stretches[i, n] = (
                    v[a, strong] * value[strong] * v[b, strong]
                    + v[a, middle] * value[middle] * v[b, middle]
                    + v[a, weak] * value[weak] * v[b, weak]
                )
                n += 1
        _write_quaternion(rotation, quaternions[i])


_TURN = 2.0 * math.pi
_AXIS_DEFINED_ABOVE = 1e-7
# Sine of half the angle: 90 degrees to either side of a full turn. On a tube twisted as steeply as
# its surface allows, 60 degrees were too few to pass the full turn.
_AXIS_TRUSTED_ABOVE = 0.7
_N_LANDMARKS = 8
_DONE = -1.0


def component_roots(graph: scipy.sparse.csr_matrix) -> IntArray:
    """Find the vertex of each connected component that is nearest to its middle along the surface.

    The same root in every pose keeps poses comparable. On a body it lies in the trunk, which
    hardly turns once a pose is aligned. The vertex that turns least could lie in a forearm that
    has made a full turn, and then everything else would be given a full turn.

    Parameters
    ----------
    graph : (V, V) symmetric matrix of the lengths of edges on the reference

    Returns
    -------
    roots : (n_components,) int32 array, ordered by the component's number
    """
    count, component = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(component, kind="stable")
    starts = np.searchsorted(component[order], np.arange(count))

    def distances_from(landmarks: npt.NDArray[np.signedinteger]) -> FloatArray:
        distances: FloatArray = scipy.sparse.csgraph.dijkstra(
            graph, indices=landmarks, min_only=True
        )
        return distances

    nearest = distances_from(order[starts])
    farthest = np.zeros(len(component))
    for _ in range(_N_LANDMARKS):
        ranked = order[np.lexsort((-nearest[order], component[order]))]
        distance = distances_from(ranked[starts])
        farthest = np.maximum(farthest, distance)
        nearest = np.minimum(nearest, distance)
    ranked = order[np.lexsort((farthest[order], component[order]))]
    return ranked[starts].astype(np.int32)


@compiled
def spanning_order(
    quaternions: FloatArray,
    ring_start: IntArray,
    ring: IntArray,
    roots: IntArray,
    order: IntArray,
    parent: IntArray,
) -> None:
    """Grow the minimum spanning forest of the relative rotation angles by Prim's algorithm.

    Parameters
    ----------
    quaternions : (V, 4) float64 array, one rotation per vertex
    ring_start, ring : (V + 1,) and (2E,) int32 arrays, the one-rings in CSR form
    roots : (n_components,) int32 array
    order, parent : (V,) int32 arrays, overwritten: every vertex after its parent; a root is its
        own parent
    """
    best = np.full(len(quaternions), 2.0)
    count = 0
    for root in roots:
        queue = [(0.0, root, root)]
        while len(queue) > 0:
            _, vertex, source = heapq.heappop(queue)
            if best[vertex] == _DONE:
                continue
            best[vertex] = _DONE
            parent[vertex] = source
            order[count] = vertex
            count += 1
            q = quaternions[vertex]
            for k in range(ring_start[vertex], ring_start[vertex + 1]):
                other = ring[k]
                o = quaternions[other]
                # Decreases with the cosine of half the relative angle, whatever the sign of q.
                key = 1.0 - abs(q[0] * o[0] + q[1] * o[1] + q[2] * o[2] + q[3] * o[3])
                # Huge coordinates give NaN, but their vertices must be visited too.
                if not key <= 1.0:
                    key = 1.0
                if key < best[other]:
                    best[other] = key
                    heapq.heappush(queue, (key, other, vertex))


@compiled_part
def _choose_turn(q: FloatArray, near: FloatArray, log: FloatArray) -> None:
    """Write the rotation vector of `q` whose axis and angle agree best with the vector `near`.

    All vectors of one rotation lie on the line of its axis, 2 pi apart. The axis is flipped if it
    opposes that of `near`, then whole turns are added until the angles agree to pi.
    """
    half_sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    near_angle = math.sqrt(near[0] * near[0] + near[1] * near[1] + near[2] * near[2])
    if half_sine > _AXIS_DEFINED_ABOVE:
        angle = 2.0 * math.atan2(half_sine, q[0])
        x, y, z = q[1] / half_sine, q[2] / half_sine, q[3] / half_sine
        if x * near[0] + y * near[1] + z * near[2] < 0.0:
            near_angle = -near_angle
        angle += _TURN * math.floor((near_angle - angle) / _TURN + 0.5)
        log[0], log[1], log[2] = angle * x, angle * y, angle * z
        return
    # No defined axis: whole turns about that of `near`.
    turns = math.floor(near_angle / _TURN + 0.5)
    scale = turns * _TURN / near_angle if turns > 0.0 else 0.0
    for a in range(3):
        log[a] = scale * near[a] + 2.0 * q[1 + a]


@compiled_part
def _hand_down(
    q: FloatArray, log: FloatArray, from_parent: FloatArray, carried: FloatArray
) -> None:
    """Write the vector that a vertex's children should agree with.

    It is the vertex's own, except near a whole turn, where the slightest sideways tilt turns the
    axis away: there the parent's axis is passed on, or the vertices beyond would be unwound.
    """
    half_sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    length = math.sqrt(log[0] * log[0] + log[1] * log[1] + log[2] * log[2])
    scale = 0.0
    if half_sine < _AXIS_TRUSTED_ABOVE and length > math.pi:
        scale = length / math.sqrt(
            from_parent[0] * from_parent[0]
            + from_parent[1] * from_parent[1]
            + from_parent[2] * from_parent[2]
        )
    for a in range(3):
        carried[a] = scale * from_parent[a] if scale > 0.0 else log[a]


@compiled
def consistent_logarithms(
    quaternions: FloatArray,
    ring_start: IntArray,
    ring: IntArray,
    roots: IntArray,
    logs: FloatArray,
) -> None:
    """Choose each vertex's rotation vector to agree with its parent's in the spanning tree.

    The root has three choices: the shortest rotation, and a full turn more or less. The one with
    the least sum of squared rotation vectors over the component is kept.

    Parameters
    ----------
    quaternions : (V, 4) float64 array
    ring_start, ring : the one-rings in CSR form
    roots : (n_components,) int32 array
    logs : (V, 3) float64 array, overwritten with theta * axis in radians
    """
    n_vertices = len(quaternions)
    order = np.empty(n_vertices, dtype=np.int32)
    parent = np.empty(n_vertices, dtype=np.int32)
    spanning_order(quaternions, ring_start, ring, roots, order, parent)
    trial = np.empty((n_vertices, 3))
    carried = np.empty((n_vertices, 3))
    start = np.empty(3)
    begin = 0
    while begin < n_vertices:
        end = begin + 1
        while end < n_vertices and parent[order[end]] != order[end]:
            end += 1
        root = order[begin]
        q = quaternions[root]
        half_sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        least = np.inf
        for extra in range(-1, 2):
            if half_sine <= _AXIS_DEFINED_ABOVE and extra != 0:
                continue
            length = 2.0 * math.atan2(half_sine, q[0]) + _TURN * extra
            for a in range(3):
                start[a] = length * q[1 + a] / half_sine if extra != 0 else 0.0
            _choose_turn(q, start, trial[root])
            for a in range(3):
                carried[root, a] = trial[root, a]
            total = 0.0
            for k in range(begin, end):
                vertex = order[k]
                if k > begin:
                    near = carried[parent[vertex]]
                    _choose_turn(quaternions[vertex], near, trial[vertex])
                    _hand_down(quaternions[vertex], trial[vertex], near, carried[vertex])
                for a in range(3):
                    total += trial[vertex, a] * trial[vertex, a]
            if not total >= least:
                least = total
                for k in range(begin, end):
                    for a in range(3):
                        logs[order[k], a] = trial[order[k], a]
        begin = end
