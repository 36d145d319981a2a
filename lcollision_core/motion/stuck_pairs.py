"""Pairs of body parts that collide in a motion and that nothing moves apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress

import numpy as np
import numpy.typing as npt

from lcollision_core.motion.frames import Frames
from lcollision_core.posing.exact import ContactRegions

DomainPair = tuple[int, int]
"""Two domains, the lower index first."""

_MOST_PAIRS = 40
"""Most pairs that are tried: each takes up to a second."""


@dataclass
class _Contact:
    """Where two domains collide.

    Attributes
    ----------
    deepest : the largest depth, see `ContactRegions`, and its frame
    corners : vertices of the colliding faces, in any frame
    """

    deepest: tuple[float, int]
    corners: set[int] = field(default_factory=set)


def stuck_pairs(
    frames: Frames, numbers: Sequence[int]
) -> tuple[list[DomainPair], npt.NDArray[np.intp]]:
    """Find the pairs of domains that collide in some frames and that nothing moves apart.

    Each pair is resolved alone in the frame in which it is deepest.

    Parameters
    ----------
    numbers : of the frames

    Returns
    -------
    pairs, codes : the pairs, none if only one pair or too many collide, and (n,) the codes that
        move their contacts

    Raises
    ------
    CancelledError : the frames' job was cancelled.
    """
    space, poses = frames.resolver.check.space, frames.motion.codes
    contacts: dict[DomainPair, _Contact] = {}
    overlaps = frames.pool.map(lambda at: frames.check(at).collisions(poses[at]), numbers)
    for frame, overlap in zip(numbers, overlaps, strict=True):
        faces, regions = space.topology.faces[overlap.pairs], ContactRegions.of(space, overlap)
        for region, name in enumerate(regions.names.tolist()):
            depth = float(regions.depth[region])
            contact = contacts.setdefault(divmod(name, space.n_domains), _Contact((depth, frame)))
            contact.deepest = max(contact.deepest, (depth, frame))
            contact.corners.update(faces[regions.of_pair == region].ravel().tolist())

    def is_stuck(pair: DomainPair) -> bool:
        check = frames.resolver.check.without_pairs(contacts.keys() - {pair})
        alone = replace(frames, resolver=frames.resolver.with_check(check))
        return alone.resolved(contacts[pair].deepest[1]) is None

    tried = list(contacts) if 1 < len(contacts) <= _MOST_PAIRS else []
    stuck = list(compress(tried, frames.pool.map(is_stuck, tried)))
    moves = np.zeros(poses.shape[1], dtype=np.bool_)
    for pair in stuck:
        # Any weights show which codes move the corners.
        corners = sorted(contacts[pair].corners)
        weights = np.zeros((1, space.topology.n_vertices, 3))
        weights[0, corners] = np.random.default_rng(0).normal(size=(len(corners), 3))
        frame = contacts[pair].deepest[1]
        moves |= frames.check(frame).space.pull_back(poses[frame], weights)[0] != 0.0
    return stuck, np.flatnonzero(moves)
