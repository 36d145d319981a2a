"""Which pairs of groups of faces to ignore, by how often they are in contact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from lcollision_core.contact.detector import CollisionDetector
from lcollision_core.contact.kernels import NEAR
from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.meshes.face_groups import FaceGroup, require_groups

NEARLY_ALWAYS = 0.95
"""Share of the poses from which contact says nothing about a pose."""


@dataclass(frozen=True)
class ProposedPair:
    """Two groups of faces that are in contact in nearly every pose.

    Attributes
    ----------
    groups : their names, in the order of the groups
    share : of the poses, from 0 to 1
    """

    groups: tuple[str, str]
    share: float


def propose_ignored(
    detector: CollisionDetector,
    poses: npt.ArrayLike,
    groups: Sequence[FaceGroup],
    least_share: float = NEARLY_ALWAYS,
    *,
    counted_only: bool = False,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> tuple[ProposedPair, ...]:
    """Find the pairs of groups that are in contact in nearly every pose.

    As the set-up assistants of robot arms do, which never test two links that always touch. Pairs
    of faces that the detector's rules exclude count too, as a group may be ignored instead, except
    for those near along the surface. Groups that have faces in common are not proposed.

    Parameters
    ----------
    detector : of the poses
    poses : (N, V, 3) array, N > 0
    groups : components, materials, meshes or body parts; of equal ones the first is proposed
    least_share : of the poses, above 0
    counted_only : whether excluded pairs do not count here either, so that what is proposed is what
        the rules still call a collision in nearly every pose

    Returns
    -------
    proposals : the most frequent first

    Raises
    ------
    ShapeError : the poses or the groups do not fit the detector.
    CancelledError : `cancel` was set.
    """
    n_faces = detector.topology.n_faces
    require_groups(detector.rules, (*groups, *detector.groups), n_faces)
    by_faces: dict[bytes, FaceGroup] = {}
    for group in groups:
        by_faces.setdefault(group.faces.tobytes(), group)
    distinct = list(by_faces.values())
    if len(distinct) < 2:
        return ()
    member = _members(distinct, n_faces)
    in_contact = np.zeros(2 * (len(distinct),), dtype=np.int64)
    vertices = np.asarray(poses)
    for done, pose in enumerate(vertices):
        if cancel is not None:
            cancel.raise_if_cancelled()
        found = detector.detect(pose)
        excluded = found.excluded_pairs[found.excluded_rule != NEAR]
        pairs = found.pairs if counted_only else np.concatenate([found.pairs, excluded])
        one_way = (member[pairs[:, 0]].T @ member[pairs[:, 1]]).toarray() > 0
        in_contact += one_way | one_way.T
        progress(done + 1, len(vertices))
    overlap = (member.T @ member).toarray() > 0
    share = np.where(overlap, 0.0, in_contact / len(vertices))
    first, second = np.nonzero(np.triu(share >= least_share, k=1))
    order = np.argsort(-share[first, second], kind="stable")
    return tuple(
        ProposedPair((distinct[a].name, distinct[b].name), float(share[a, b]))
        for a, b in zip(first[order], second[order], strict=True)
    )


def _members(groups: Sequence[FaceGroup], n_faces: int) -> sparse.csr_matrix:
    """Return (F, G) ones where a face is of a group."""
    faces = np.concatenate([group.faces for group in groups])
    of_group = np.repeat(np.arange(len(groups)), [len(group.faces) for group in groups])
    ones = np.ones(len(faces), dtype=np.int32)
    return sparse.csr_matrix((ones, (faces, of_group)), shape=(n_faces, len(groups)))
