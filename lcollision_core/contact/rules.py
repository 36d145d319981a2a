"""The contact rules applied to one mesh: the exclusions that the search looks up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse import csgraph

from lcollision_core.contact.arrays import Exclusions
from lcollision_core.contact.kernels import NEAR, REST, find_rules
from lcollision_core.errors import ShapeError
from lcollision_core.meshes.contact_rules import ContactRules
from lcollision_core.meshes.face_groups import FaceGroup, require_groups
from lcollision_core.meshes.topology import FloatArray, Topology

Pairs = npt.NDArray[np.integer]

MAX_EXCLUDED = 250_000_000
"""The most pairs of faces that are listed: 1.25 GB. All pairs of 20 000 faces are 200 million."""

_CELLS_AT_ONCE = 1 << 23
"""Entries of a dense block of distances, or of rows of a table before they are cut in half."""

_MAX_REGIONS = 4096

_SAMPLED = 200
"""Vertices whose neighbourhoods are measured for an estimate of all."""

_NEAR, _REST = "near exclusion", "rest exclusion"


def exclusions_of(
    rules: ContactRules,
    topology: Topology,
    reference: FloatArray,
    body_size: float,
    touching: Pairs,
    groups: Sequence[FaceGroup] = (),
) -> Exclusions:
    """List which pairs of faces the rules exclude, before any pose is searched.

    Parameters
    ----------
    reference : (V, 3) float64 array, the rest pose
    body_size : in its unit
    touching : (n, 2) pairs of faces that touch at rest, used where there is a rest exclusion
    groups : what the names of ignored pairs mean; groups of one name are one

    Raises
    ------
    ShapeError : a group of an ignored pair is unknown, a group has faces that the mesh has not, or
        too many pairs are excluded.
    """
    require_groups(rules, groups, topology.n_faces)
    none: sparse.csr_matrix = sparse.csr_matrix(2 * (topology.n_faces,), dtype=np.uint8)
    near = rest = none
    if rules.near_exclusion > 0.0:
        corners = _corner_table(topology)
        reached = _reached(topology, reference, rules.near_exclusion * body_size, _NEAR)
        near = _later_faces(corners @ reached, corners.T.tocsr(), _NEAR)
    if rules.rest_exclusion is not None and len(touching):
        rest = _near_touching(topology, reference, rules.rest_exclusion * body_size, touching)
    # Codes add up to 3 where both apply; the first rule is the one that is reported.
    table = (near + 2 * rest if near.nnz else 2 * rest).tocsr() if rest.nnz else near
    table.sort_indices()
    region, ignored = _regions(rules.ignored, groups, topology.n_faces)
    return Exclusions(
        start=table.indptr.astype(np.int64),
        face=table.indices.astype(np.int32),
        rule=np.where(table.data == 2, REST, NEAR).astype(np.uint8),
        region=region,
        ignored=ignored,
        squared_tolerance=rules.tolerated_depth**2,
    )


def rules_of(
    exclusions: Exclusions, pairs: Pairs, penetration_depth: FloatArray
) -> npt.NDArray[np.uint8]:
    """Return (n,) the first rule by which each pair does not count, `kernels.COUNTED` if none.

    Parameters
    ----------
    pairs : (n, 2) face indices
    penetration_depth : (n,) normalised
    """
    rule = np.empty(len(pairs), dtype=np.uint8)
    find_rules(pairs, np.asarray(penetration_depth, dtype=np.float64) ** 2, exclusions, rule)
    return rule


def near_pairs_estimate(topology: Topology, reference: FloatArray, distance: float) -> float:
    """Estimate how many pairs of faces a near exclusion lists, from some of the vertices.

    Parameters
    ----------
    reference : (V, 3) float64 array, the rest pose
    distance : > 0, in its unit
    """
    used = topology.used_vertices
    some = used[np.linspace(0, len(used) - 1, min(len(used), _SAMPLED)).astype(np.int64)]
    reached = _reached(topology, reference, distance, _NEAR, some).nnz / len(some)
    return float(0.5 * topology.n_faces**2 * reached / len(used))


def require_room(n_excluded: int, rule: str) -> None:
    """Refuse more than `MAX_EXCLUDED` excluded pairs of faces, with a `ShapeError`."""
    if n_excluded > MAX_EXCLUDED:
        raise ShapeError(
            f"excludes more than {MAX_EXCLUDED} pairs of faces",
            "make it smaller or leave it out",
            where=f"the {rule}",
        )


def _corner_table(topology: Topology) -> sparse.csr_matrix:
    """Return (F, V) bool: which vertices are corners of each face."""
    n_faces, corners = topology.n_faces, topology.faces
    start = np.arange(0, 3 * n_faces + 1, 3)
    ones = np.ones(3 * n_faces, dtype=np.bool_)
    return sparse.csr_matrix((ones, corners.ravel(), start), shape=(n_faces, topology.n_vertices))


def _reached(
    topology: Topology,
    reference: FloatArray,
    distance: float,
    rule: str,
    sources: npt.NDArray[np.integer] | None = None,
) -> sparse.csr_matrix:
    """Return (S, V) bool: the vertices that an edge path of at most `distance` leads to.

    `sources` are all vertices by default.
    """
    n_vertices = topology.n_vertices
    i, j = topology.edges.T
    lengths = topology.edge_lengths(reference)
    # Duplicate vertices give edges of length 0, which a sparse graph stores like any other.
    graph = sparse.coo_matrix((lengths, (i, j)), shape=2 * (n_vertices,)).tocsr()
    sources = np.arange(n_vertices) if sources is None else sources
    blocks, n_related = [], 0
    at_once = max(1, _CELLS_AT_ONCE // n_vertices)
    for first in range(0, len(sources), at_once):
        block = sources[first : first + at_once]
        distances = csgraph.dijkstra(graph, directed=False, indices=block, limit=distance)
        blocks.append(sparse.csr_matrix(distances <= distance))
        n_related += blocks[-1].nnz
        require_room(n_related, rule)
    return sparse.vstack(blocks, format="csr")


def _near_touching(
    topology: Topology, reference: FloatArray, distance: float, touching: Pairs
) -> sparse.csr_matrix:
    """Return (F, F) uint8, its upper half: the pairs near pairs that touch at rest."""
    n_faces = topology.n_faces
    ones = np.ones(len(touching), dtype=np.bool_)
    half = sparse.csr_matrix((ones, touching.T), shape=2 * (n_faces,))
    touches = (half + half.T).tocsr()
    if distance == 0.0:
        return sparse.triu(touches, format="csr").astype(np.uint8)
    faces = np.unique(touching)
    corners = _corner_table(topology)
    vertices = np.unique(topology.faces[faces])
    reached = _reached(topology, reference, distance, _REST, vertices)
    # Rows of the faces that touch: the faces within the distance of each.
    around = corners[faces][:, vertices] @ reached @ corners.T.tocsr()
    return _later_faces(around.T.tocsr(), touches[faces][:, faces] @ around, _REST)


def _later_faces(left: sparse.csr_matrix, right: sparse.csr_matrix, rule: str) -> sparse.csr_matrix:
    """Return the upper half of a symmetric product of tables (F, n) and (n, F), as uint8 ones."""
    n_faces = left.shape[0]
    blocks, n_excluded = [], 0
    at_once = max(1, _CELLS_AT_ONCE // n_faces)
    for first in range(0, n_faces, at_once):
        product = left[first : first + at_once] @ right
        blocks.append(sparse.triu(product, k=first + 1, format="csr").astype(np.uint8))
        n_excluded += blocks[-1].nnz
        require_room(n_excluded, rule)
    return sparse.vstack(blocks, format="csr")


def _regions(
    ignored: tuple[tuple[str, str], ...], groups: Sequence[FaceGroup], n_faces: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.bool_]]:
    """Return (F,) regions of faces of the same groups, and (R, R) which of them are ignored."""
    if not ignored:
        return np.empty(0, dtype=np.int32), np.zeros((0, 0), dtype=np.bool_)
    names = list(dict.fromkeys(name for pair in ignored for name in pair))
    is_of = np.zeros((len(names), n_faces), dtype=np.bool_)
    for group in groups:
        if group.name in names:
            is_of[names.index(group.name), group.faces] = True
    packed, region = np.unique(np.packbits(is_of, axis=0), axis=1, return_inverse=True)
    if packed.shape[1] > _MAX_REGIONS:
        raise ShapeError(
            f"overlap in more than {_MAX_REGIONS} ways", "name fewer", where="the ignored groups"
        )
    of_region = np.unpackbits(packed, axis=0, count=len(names)).astype(np.bool_)
    table = np.zeros(2 * (packed.shape[1],), dtype=np.bool_)
    for a, b in ignored:
        one_way = np.outer(of_region[names.index(a)], of_region[names.index(b)])
        table |= one_way | one_way.T
    return region.ravel().astype(np.int32), table
