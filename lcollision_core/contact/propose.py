"""Which pairs of groups of faces to ignore, by how often they are in contact."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from lcollision_core.contact.detector import CollisionDetector
from lcollision_core.contact.kernels import NEAR
from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.meshes.contact_rules import MAX_IGNORED, STRICT
from lcollision_core.meshes.face_groups import GROUP_KINDS, MAX_GROUPS, FaceGroup, require_groups

NEARLY_ALWAYS = 0.95
"""Share of the poses from which contact says nothing about a pose."""

MOSTLY = 0.5
"""Share of the poses from which a body of shells collides by being made of shells."""

LEAST_GAIN = 0.25
"""Share of the poses that ignored pairs must free: what collides by its pose does so without."""

GroupPair = tuple[str, str]


@dataclass(frozen=True)
class ProposedPair:
    """Two groups of faces that are in contact in nearly every pose.

    Attributes
    ----------
    groups : their names, in the order of the groups
    share : of the poses, from 0 to 1
    """

    groups: GroupPair
    share: float


def propose_ignored(
    detector_without: Callable[[Sequence[GroupPair]], CollisionDetector],
    poses: npt.ArrayLike,
    kinds: Mapping[str, Sequence[FaceGroup]],
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> tuple[GroupPair, ...]:
    """Choose pairs of groups to ignore so that poses collide for what they are, not by the mesh.

    Pairs of components that collide in nearly every pose, or of body parts where the mesh is in one
    piece. Where shells make up the body and most poses still collide, also the pairs within each
    body part, and of body parts that touch in nearly every pose, at rest too, if that frees many:
    links and neighbouring links, which robots' set-up assistants never test either.

    Parameters
    ----------
    detector_without : makes a detector that ignores further pairs
    poses, kinds, progress, cancel : see `propose_by_kind`

    Returns
    -------
    pairs : in the order found, none where nothing collides nearly always; no more than rules may
        ignore

    Raises
    ------
    ShapeError, CancelledError : see `propose_by_kind`.
    """
    _, parts, components = GROUP_KINDS

    def pairs_of(kind: str, detector: CollisionDetector, *, counted_only: bool) -> list[GroupPair]:
        found = propose_by_kind(
            detector,
            poses,
            {kind: kinds[kind]},
            counted_only=counted_only,
            progress=progress,
            cancel=cancel,
        )
        return [pair.groups for pair in found[kind]]

    in_pieces = len(kinds[components]) > 1
    kind = components if in_pieces else parts
    detector = detector_without(())
    most = MAX_IGNORED - len(detector.rules.ignored)
    pairs = pairs_of(kind, detector, counted_only=True)[:most]
    if not in_pieces or not kinds[parts]:
        return tuple(pairs)

    def share(detector: CollisionDetector) -> float:
        return float(np.mean(detector.are_colliding(poses, cancel=cancel)))

    detector = detector_without(pairs)
    colliding = share(detector)
    if colliding > MOSTLY:
        links = [(part.name, part.name) for part in kinds[parts]]
        links += pairs_of(parts, detector, counted_only=False)
        links = [*pairs, *links][:most]
        if colliding - share(detector_without(links)) >= LEAST_GAIN:
            pairs = links
    return tuple(pairs)


def propose_by_kind(
    detector: CollisionDetector,
    poses: npt.ArrayLike,
    kinds: Mapping[str, Sequence[FaceGroup]],
    least_share: float = NEARLY_ALWAYS,
    *,
    counted_only: bool = False,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> dict[str, tuple[ProposedPair, ...]]:
    """Find the pairs of groups that are in contact in nearly every pose, for each kind by itself.

    As the set-up assistants of robot arms do, which never test two links that always touch. Pairs
    of faces that the detector's rules exclude count too, as a group may be ignored instead, except
    for those near along the surface. Groups that have faces in common are not proposed, nor are
    groups of two kinds, as of a mesh and a body part, which say nothing that those of one do not.

    Parameters
    ----------
    detector : of the poses
    poses : (N, V, 3) array, N > 0
    kinds : groups by kind, see `groups_by_kind`, of which the first `MAX_GROUPS` are looked at; of
        equal ones the first is proposed
    least_share : of the poses, above 0
    counted_only : whether excluded pairs do not count here either, so that what is proposed is what
        the rules still call a collision in nearly every pose
    progress : called with (poses looked at, poses in all)
    cancel : polled between poses

    Returns
    -------
    proposals : by kind, the most frequent first

    Raises
    ------
    ShapeError : the poses or the groups do not fit the detector.
    CancelledError : `cancel` was set.
    """
    tallies = {kind: _Tally(groups[:MAX_GROUPS], detector) for kind, groups in kinds.items()}
    vertices = np.asarray(poses)
    for done, pose in enumerate(vertices):
        if cancel is not None:
            cancel.raise_if_cancelled()
        found = detector.detect(pose)
        excluded = found.excluded_pairs[found.excluded_rule != NEAR]
        pairs = found.pairs if counted_only else np.concatenate([found.pairs, excluded])
        for tally in tallies.values():
            tally.add(pairs)
        progress(done + 1, len(vertices))
    return {kind: tally.proposals(least_share) for kind, tally in tallies.items()}


class _Tally:
    """Counts the poses in which groups are in contact; of equal groups the first stands for all."""

    def __init__(self, groups: Sequence[FaceGroup], detector: CollisionDetector) -> None:
        n_faces = detector.topology.n_faces
        require_groups(STRICT, groups, n_faces)
        by_faces: dict[bytes, FaceGroup] = {}
        for group in groups:
            by_faces.setdefault(group.faces.tobytes(), group)
        self._groups = list(by_faces.values())
        self._member = _members(self._groups, n_faces)
        self._in_contact = np.zeros(2 * (len(self._groups),), dtype=np.int64)
        self._n_poses = 0

    def add(self, pairs: npt.NDArray[np.integer]) -> None:
        """Count a pose with (P, 2) pairs of faces in contact."""
        first, second = self._member[pairs[:, 0]], self._member[pairs[:, 1]]
        one_way = (first.T @ second).toarray() > 0
        self._in_contact += one_way | one_way.T
        self._n_poses += 1

    def proposals(self, least_share: float) -> tuple[ProposedPair, ...]:
        overlap = (self._member.T @ self._member).toarray() > 0
        share = np.where(overlap, 0.0, self._in_contact / max(1, self._n_poses))
        first, second = np.nonzero(np.triu(share >= least_share, k=1))
        order = np.argsort(-share[first, second], kind="stable")
        return tuple(
            ProposedPair((self._groups[a].name, self._groups[b].name), float(share[a, b]))
            for a, b in zip(first[order], second[order], strict=True)
        )


def _members(groups: Sequence[FaceGroup], n_faces: int) -> sparse.csr_matrix:
    """Return (F, G) ones where a face is of a group."""
    faces = np.concatenate([np.empty(0, dtype=np.int64), *(group.faces for group in groups)])
    of_group = np.repeat(np.arange(len(groups)), [len(group.faces) for group in groups])
    ones = np.ones(len(faces), dtype=np.int32)
    return sparse.csr_matrix((ones, (faces, of_group)), shape=(n_faces, len(groups)))
