"""One axis and angle per vertex, chosen so that neighbours agree (step 3 of Gao et al. 2019)."""

from __future__ import annotations

import heapq
import math

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph, csr_matrix

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import FloatArray, IntArray

_TURN = 2.0 * math.pi
_AXIS_DEFINED_ABOVE = 1e-7
# Sine of half the angle: 90 degrees to either side of a full turn. On a tube that is wound as
# steeply as its surface can bear, 60 degrees were too few to pass the full turn.
_AXIS_TRUSTED_ABOVE = 0.7
_N_LANDMARKS = 8
_DONE = -1.0


def component_roots(graph: csr_matrix) -> IntArray:
    """Find the vertex of each connected component that is nearest to its middle along the surface.

    The same root in every pose keeps poses comparable. On a body it lies in the trunk, which
    hardly turns once a pose is aligned; the vertex that turns least could lie in a forearm that
    has come full circle, and then everything else would be given a full turn.

    Parameters
    ----------
    graph : (V, V) symmetric matrix of the lengths of edges on the reference

    Returns
    -------
    roots : (n_components,) int32 array, ordered by the component's number
    """
    count, component = csgraph.connected_components(graph, directed=False)
    order = np.argsort(component, kind="stable")
    starts = np.searchsorted(component[order], np.arange(count))

    def distances_from(landmarks: npt.NDArray[np.signedinteger]) -> FloatArray:
        found: FloatArray = csgraph.dijkstra(graph, indices=landmarks, min_only=True)
        return found

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
    """Prim's minimum spanning forest of the relative rotation angles, in the order of its growth.

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
                # Falls with the cosine of half the relative angle, whichever sign q has.
                key = 1.0 - abs(q[0] * o[0] + q[1] * o[1] + q[2] * o[2] + q[3] * o[3])
                # Huge coordinates give NaN, and their vertices must be visited too.
                if not key <= 1.0:
                    key = 1.0
                if key < best[other]:
                    best[other] = key
                    heapq.heappush(queue, (key, other, vertex))


@compiled
def _choose_turn(q: FloatArray, near: FloatArray, log: FloatArray) -> None:
    """Write the rotation vector of `q` whose axis and angle agree best with the vector `near`.

    All vectors of one rotation lie on the line of its axis, 2 pi apart: the axis is flipped where
    it opposes that of `near`, then whole turns are added until the angles agree to pi.
    """
    half_sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    wanted = math.sqrt(near[0] * near[0] + near[1] * near[1] + near[2] * near[2])
    if half_sine > _AXIS_DEFINED_ABOVE:
        angle = 2.0 * math.atan2(half_sine, q[0])
        x, y, z = q[1] / half_sine, q[2] / half_sine, q[3] / half_sine
        if x * near[0] + y * near[1] + z * near[2] < 0.0:
            wanted = -wanted
        angle += _TURN * math.floor((wanted - angle) / _TURN + 0.5)
        log[0], log[1], log[2] = angle * x, angle * y, angle * z
        return
    # No defined axis: whole turns about that of `near`.
    turns = math.floor(wanted / _TURN + 0.5)
    scale = turns * _TURN / wanted if turns > 0.0 else 0.0
    for a in range(3):
        log[a] = scale * near[a] + 2.0 * q[1 + a]


@compiled
def _hand_down(
    q: FloatArray, log: FloatArray, from_parent: FloatArray, carried: FloatArray
) -> None:
    """Write the vector that a vertex's children shall agree with.

    It is the vertex's own, but near a whole turn, where the slightest sideways tilt turns the axis
    away: there the parent's axis is passed on, or what lies beyond would be wound back.
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

    The root has three choices (its short way round, and a full turn more or less); the one with
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
            carried[root] = trial[root]
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
                    logs[order[k]] = trial[order[k]]
        begin = end
