"""Propose contacts to ignore because they are nearly always there: patches and pairs of groups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.contact.arrays import Lists
from lcollision_core.contact.detector import CollisionDetector
from lcollision_core.contact.exclusions import require_listable
from lcollision_core.contact.kernels import NEAR
from lcollision_core.contact.reach import faces_within, lists_of, matrix_of, surface_of
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.contact_rules import MAX_TOUCHING, STRICT
from lcollision_core.meshes.face_groups import MAX_GROUPS, FaceGroup, require_groups

NEARLY_ALWAYS = 0.95
"""Share of the poses from which a contact says nothing about a pose."""

_PIECES_ALWAYS, _PIECES_PLACE = 0.85, 0.5
"""Share of the poses from which two pieces of the surface are meant to touch, as an arm and its
shield, and the share in which a patch of such a contact must touch."""

_PIECES_NEAR = 3.0
"""Largest distance, on the reference, of pieces that are meant to touch, in patch radii."""

_SEARCHED_SHARE = 0.5
"""Least distance between the centres of patches, in patch radii."""

GroupPair = tuple[str, str]


@dataclass(frozen=True)
class ProposedPair:
    """Two groups of faces that are in contact in nearly every pose.

    Attributes
    ----------
    groups : their names, in the order of the groups
    share : share of the poses with contact, 0 to 1
    """

    groups: GroupPair
    share: float


def touching_patches(
    detector: CollisionDetector,
    poses: npt.ArrayLike,
    radius: float,
    job: Job = UNWATCHED,
    *,
    of_pieces: bool = False,
) -> tuple[tuple[int, int], ...]:
    """Find patches of the surface that touch in nearly every pose, as a belt's and a jacket's.

    A patch holds the faces within a radius of one face, so that no whole part is left out against
    another.

    Parameters
    ----------
    detector : of the poses; pairs that its rules exclude are skipped
    poses : (N, V, 3) array, N > 0
    radius : of a patch, normalised
    job : reports (poses done, all poses); polled between poses
    of_pieces : whether to find also patches of two pieces, which share no vertices, that touch in
        at least half of the poses, if the pieces touch somewhere in at least 85 % and the patches
        are near each other on the reference; a forearm that rests on the trunk in most poses does
        not qualify

    Returns
    -------
    pairs of faces in the middle of two patches, for `ContactRules.touching`: a few that cover all
    pairs seen at such patches, those that cover most first

    Raises
    ------
    ShapeError : the poses do not fit the detector.
    CancelledError : the job was cancelled.
    """
    touching: list[npt.NDArray[np.int32]] = []
    vertices = np.asarray(poses)
    for done, pose in enumerate(vertices):
        job.check()
        touching.append(detector.detect(pose, counted_only=True).pairs)
        job.report(done + 1, len(vertices))
    return patches_about(detector, touching, radius, of_pieces=of_pieces)


def patches_about(
    detector: CollisionDetector,
    touching: Sequence[npt.NDArray[np.int32]],
    radius: float,
    *,
    of_pieces: bool = False,
) -> tuple[tuple[int, int], ...]:
    """Find patches that touch in nearly every pose; parameters are those of `touching_patches`.

    Parameters
    ----------
    touching : the (n, 2) pairs of faces that touch in each pose
    """
    patch_pairs, places = np.unique(np.concatenate(touching), axis=0, return_inverse=True)
    if not len(patch_pairs):
        return ()
    middles, near = _patches(detector, np.unique(patch_pairs), radius)
    of_first, of_second = near[patch_pairs[:, 0]], near[patch_pairs[:, 1]]
    n_poses_of = scipy.sparse.csr_matrix(2 * (len(middles),), dtype=np.int32)
    ends = np.cumsum([len(pairs) for pairs in touching])
    for rows in np.split(places.ravel(), ends[:-1]):
        one_way = of_first[rows].T @ of_second[rows]
        n_poses_of += (one_way + one_way.T).astype(np.int32)
    often = scipy.sparse.triu(n_poses_of).tocoo()
    is_frequent = often.data >= NEARLY_ALWAYS * len(touching)
    patches = np.stack([often.row, often.col], axis=1)
    if of_pieces:
        are_made_so = _of_touching_pieces(detector, touching, middles[patches])
        centres = detector.reference[detector.topology.faces[middles]].mean(axis=1)
        away = np.linalg.norm(np.subtract(*centres[patches].transpose(1, 0, 2)), axis=1)
        are_made_so &= away <= _PIECES_NEAR * radius * detector.body_size
        is_frequent |= are_made_so & (often.data >= _PIECES_PLACE * len(touching))
    return _covering(of_first.tocsc(), of_second.tocsc(), patches[is_frequent], middles)


def _of_touching_pieces(
    detector: CollisionDetector,
    found: Sequence[npt.NDArray[np.int32]],
    faces: npt.NDArray[np.int32],
) -> npt.NDArray[np.bool_]:
    """Return which of (n, 2) faces are of two pieces that touch in most poses.

    Parameters
    ----------
    found : the colliding pairs of each pose
    """
    topology = detector.topology
    n_pieces, of_vertex = topology.vertex_components
    piece_of = of_vertex[topology.faces[:, 0]].astype(np.int64)

    def number_of(pairs: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
        first, second = np.sort(piece_of[pairs], axis=1).T
        return np.where(first == second, -1, n_pieces * first + second)

    numbers = np.concatenate([np.unique(number_of(pairs)) for pairs in found])
    number, n_poses = np.unique(numbers, return_counts=True)
    often = number[(n_poses >= _PIECES_ALWAYS * len(found)) & (number >= 0)]
    return np.isin(number_of(faces), often)


def _patches(
    detector: CollisionDetector, faces: npt.NDArray[np.int32], radius: float
) -> tuple[npt.NDArray[np.int32], scipy.sparse.csr_matrix]:
    """Cover faces by n patches; return their middle faces, and (F, n) the faces in each."""
    surface = surface_of(detector.topology, detector.reference)
    require = partial(require_listable, rule="touching radius")

    def within(some: npt.NDArray[np.int32], share: float) -> Lists:
        return faces_within(surface, some, share * radius * detector.body_size, require)

    close = within(faces, _SEARCHED_SHARE)
    patch_roots: list[int] = []
    is_covered = np.zeros(detector.topology.n_faces, dtype=np.bool_)
    for place, face in enumerate(faces.tolist()):
        if not is_covered[face]:
            is_covered[close.entry[close.start[place] : close.start[place + 1]]] = True
            patch_roots.append(face)
    middles = np.array(patch_roots, dtype=np.int32)
    lists = within(middles, 1.0)
    return middles, matrix_of(lists, detector.topology.n_faces).T.tocsr()


def _covering(
    of_first: scipy.sparse.csc_matrix,
    of_second: scipy.sparse.csc_matrix,
    patches: npt.NDArray[np.integer],
    middles: npt.NDArray[np.int32],
) -> tuple[tuple[int, int], ...]:
    """Choose a few of (n, 2) pairs of patches that cover as much as all, the largest first.

    Parameters
    ----------
    of_first, of_second : (P, n) whether the first or second face of each pair lies in a patch
    """
    covered = []
    for a, b in patches.tolist():
        ways = ((a, b), (b, a))
        rows = [np.intersect1d(*_rows(of_first, i, of_second, j)) for i, j in ways]
        covered.append(np.union1d(*rows))
    is_covered = np.zeros(of_first.shape[0], dtype=np.bool_)
    covering_pairs = []
    for place in sorted(range(len(covered)), key=lambda place: -len(covered[place])):
        if not is_covered[covered[place]].all():
            is_covered[covered[place]] = True
            a, b = sorted(middles[patches[place]].tolist())
            covering_pairs.append((a, b))
    return tuple(covering_pairs[:MAX_TOUCHING])


def _rows(
    of_first: scipy.sparse.csc_matrix, i: int, of_second: scipy.sparse.csc_matrix, j: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Return the non-zero rows of a column of each of two matrices."""
    return (
        of_first.indices[of_first.indptr[i] : of_first.indptr[i + 1]],
        of_second.indices[of_second.indptr[j] : of_second.indptr[j + 1]],
    )


def propose_by_kind(
    detector: CollisionDetector,
    poses: npt.ArrayLike,
    kinds: Mapping[str, Sequence[FaceGroup]],
    least_share: float = NEARLY_ALWAYS,
    job: Job = UNWATCHED,
) -> dict[str, tuple[ProposedPair, ...]]:
    """Find the pairs of groups that are in contact in nearly every pose, for each kind by itself.

    Set-up assistants of robot arms do the same: they skip two links that always touch. Pairs of
    faces that the detector's rules exclude count too, as a group may be ignored instead, except
    those near along the surface. Groups that share faces are not proposed, nor are groups of two
    kinds, such as a mesh and a body part, which add nothing to those of one kind.

    Parameters
    ----------
    detector : of the poses
    poses : (N, V, 3) array, N > 0
    kinds : groups by kind, see `groups_by_kind`; only the first `MAX_GROUPS` of a kind are used,
        and of equal ones the first is proposed
    least_share : of the poses, above 0
    job : reports (poses done, all poses); polled between poses

    Returns
    -------
    proposals : by kind, the most frequent first

    Raises
    ------
    ShapeError : the poses or the groups do not fit the detector.
    CancelledError : the job was cancelled.
    """
    tallies = {kind: _Tally(groups[:MAX_GROUPS], detector) for kind, groups in kinds.items()}
    vertices = np.asarray(poses)
    for done, pose in enumerate(vertices):
        job.check()
        collisions = detector.detect(pose)
        excluded = collisions.excluded_pairs[collisions.excluded_rule != NEAR]
        pairs = np.concatenate([collisions.pairs, excluded])
        for tally in tallies.values():
            tally.add(pairs)
        job.report(done + 1, len(vertices))
    return {kind: tally.proposals(least_share) for kind, tally in tallies.items()}


class _Tally:
    """Count the poses in which groups are in contact; the first of equal groups stands for all."""

    def __init__(self, groups: Sequence[FaceGroup], detector: CollisionDetector) -> None:
        n_faces = detector.topology.n_faces
        require_groups(STRICT, groups, n_faces)
        by_faces: dict[bytes, FaceGroup] = {}
        for group in groups:
            by_faces.setdefault(group.faces.tobytes(), group)
        self._groups = list(by_faces.values())
        members = lists_of([group.faces for group in self._groups], n_faces)
        self._member = matrix_of(members, len(self._groups))
        self._in_contact = np.zeros(2 * (len(self._groups),), dtype=np.int64)
        self._n_poses = 0

    def add(self, pairs: npt.NDArray[np.integer]) -> None:
        """Count a pose with (P, 2) pairs of faces in contact."""
        first, second = self._member[pairs[:, 0]], self._member[pairs[:, 1]]
        one_way = (first.T @ second).toarray()
        self._in_contact += one_way | one_way.T
        self._n_poses += 1

    def proposals(self, least_share: float) -> tuple[ProposedPair, ...]:
        overlap = (self._member.T @ self._member).toarray()
        share = np.where(overlap, 0.0, self._in_contact / max(1, self._n_poses))
        first, second = np.nonzero(np.triu(share >= least_share, k=1))
        order = np.argsort(-share[first, second], kind="stable")
        return tuple(
            ProposedPair((self._groups[a].name, self._groups[b].name), float(share[a, b]))
            for a, b in zip(first[order], second[order], strict=True)
        )
