"""One axis and angle per vertex, chosen so that neighbours agree (step 3 of Gao et al. 2019)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph, csr_matrix

from lcollision_core.compiled import compiled
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology

_TURN = 2.0 * math.pi
_AXIS_DEFINED_ABOVE = 1e-7
# Sine of half the angle: 90 degrees to either side of a full turn. On a tube that is wound as
# steeply as its surface can bear, 60 degrees were too few to pass the full turn.
_AXIS_TRUSTED_ABOVE = 0.7
_N_LANDMARKS = 8


def component_roots(topology: Topology, rest_vertices: FloatArray) -> IntArray:
    """Find the vertex of each connected component that is nearest to its middle along the surface.

    The same root in every pose keeps poses comparable. On a body it lies in the trunk, which
    hardly turns once a pose is aligned; the vertex that turns least could lie in a forearm that
    has come full circle, and then everything else would be given a full turn.

    Parameters
    ----------
    topology : the connectivity
    rest_vertices : (V, 3) float64 array, the reference

    Returns
    -------
    roots : (n_components,) int32 array, ordered by the component's number
    """
    i, j = topology.edges.T
    lengths = topology.edge_lengths(rest_vertices)
    # csgraph takes an entry of 0 for no edge.
    lengths = np.maximum(lengths, 1e-12 * max(float(lengths.max()), 1e-300))
    graph = csr_matrix((lengths, (i, j)), shape=(topology.n_vertices, topology.n_vertices))
    count, component = topology.vertex_components
    order = np.argsort(component, kind="stable")
    starts = np.searchsorted(component[order], np.arange(count))

    def distances_from(landmarks: npt.NDArray[np.signedinteger]) -> FloatArray:
        found: FloatArray = csgraph.dijkstra(
            graph, directed=False, indices=landmarks, min_only=True
        )
        return found

    nearest = distances_from(order[starts])
    farthest = np.zeros(topology.n_vertices)
    for _ in range(_N_LANDMARKS):
        ranked = order[np.lexsort((-nearest[order], component[order]))]
        distance = distances_from(ranked[starts])
        farthest = np.maximum(farthest, distance)
        nearest = np.minimum(nearest, distance)
    ranked = order[np.lexsort((farthest[order], component[order]))]
    return ranked[starts].astype(np.int32)


@compiled
def _push(heap_key: FloatArray, heap_edge: IntArray, size: int, key: float, edge: int) -> int:
    at = size
    while at > 0:
        above = (at - 1) >> 1
        if heap_key[above] <= key:
            break
        heap_key[at] = heap_key[above]
        heap_edge[at] = heap_edge[above]
        at = above
    heap_key[at] = key
    heap_edge[at] = edge
    return size + 1


@compiled
def _pop(heap_key: FloatArray, heap_edge: IntArray, size: int) -> int:
    """Drop the least entry (which the caller has read at index 0); return the new size."""
    size -= 1
    key, edge = heap_key[size], heap_edge[size]
    at = 0
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and heap_key[child + 1] < heap_key[child]:
            child += 1
        if key <= heap_key[child]:
            break
        heap_key[at] = heap_key[child]
        heap_edge[at] = heap_edge[child]
        at = child
    heap_key[at] = key
    heap_edge[at] = edge
    return size


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
    n_vertices = len(quaternions)
    source = np.empty(len(ring), dtype=np.int32)
    heap_key = np.empty(len(ring) + 1)
    heap_edge = np.empty(len(ring) + 1, dtype=np.int32)
    best = np.full(n_vertices, 2.0)
    done = np.zeros(n_vertices, dtype=np.bool_)
    count = 0
    for root in roots:
        size = 0
        vertex = root
        parent[root] = root
        while True:
            done[vertex] = True
            order[count] = vertex
            count += 1
            q = quaternions[vertex]
            for k in range(ring_start[vertex], ring_start[vertex + 1]):
                other = ring[k]
                if done[other]:
                    continue
                o = quaternions[other]
                # Falls with the cosine of half the relative angle, whichever sign q has.
                key = 1.0 - abs(q[0] * o[0] + q[1] * o[1] + q[2] * o[2] + q[3] * o[3])
                # A pose out of all measure gives NaN, and is still to be walked to its end.
                if not key <= 1.0:
                    key = 1.0
                if key < best[other]:
                    best[other] = key
                    source[k] = vertex
                    size = _push(heap_key, heap_edge, size, key, k)
            while size > 0 and done[ring[heap_edge[0]]]:
                size = _pop(heap_key, heap_edge, size)
            if size == 0:
                break
            vertex = ring[heap_edge[0]]
            parent[vertex] = source[heap_edge[0]]
            size = _pop(heap_key, heap_edge, size)


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
    # No axis to speak of: whole turns about that of `near`.
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
def _count_jumps(logs: FloatArray, ring_start: IntArray, ring: IntArray) -> int:
    """Count the edges whose angles differ by more than pi once their axes point the same way."""
    n_jumps = 0
    for vertex in range(len(logs)):
        for k in range(ring_start[vertex], ring_start[vertex + 1]):
            other = ring[k]
            if other < vertex:
                continue
            here, there, along = 0.0, 0.0, 0.0
            for a in range(3):
                here += logs[vertex, a] * logs[vertex, a]
                there += logs[other, a] * logs[other, a]
                along += logs[vertex, a] * logs[other, a]
            signed = math.sqrt(there) if along >= 0.0 else -math.sqrt(there)
            if abs(math.sqrt(here) - signed) > math.pi:
                n_jumps += 1
    return n_jumps


@compiled
def consistent_logarithms(
    quaternions: FloatArray,
    ring_start: IntArray,
    ring: IntArray,
    roots: IntArray,
    logs: FloatArray,
) -> int:
    """Choose each vertex's rotation vector to agree with its parent's in the spanning tree.

    The root has three choices (its short way round, and a full turn more or less); the one with
    the least sum of squared rotation vectors over the component is kept.

    Parameters
    ----------
    quaternions : (V, 4) float64 array
    ring_start, ring : the one-rings in CSR form
    roots : (n_components,) int32 array
    logs : (V, 3) float64 array, overwritten with theta * axis in radians

    Returns
    -------
    n_jumps : edges whose angles still differ by more than pi, their axes pointing the same way
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
    return _count_jumps(logs, ring_start, ring)
