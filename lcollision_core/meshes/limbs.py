"""What moves by itself, as a tree: which limb a drag holds, and what joins in out of its reach."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray

_SHARE = 0.15
"""Of a patch: what leads less of it is not held."""

_GROUND = 0.01
"""Normalised: what is no higher above the lowest vertex stands on the ground."""

LEAST_LIMB = 0.12
"""Normalised length of a limb that counts as one; fingers belong to their arm."""

_LEAST_SHARE = 0.1
"""Of the length of a limb, what a segment at its end turns at least."""


@dataclass(frozen=True, eq=False)
class Limbs:
    """The tree of the joints of a rig, or of the body parts of a learned model: its segments.

    A limb is a chain of segments: from one up to the last before that on which several limbs hang.
    The root, on which all hang, is in the limb of no other. Bodies of a scene have a root each.

    Attributes
    ----------
    parents : (S,) int64 array, the segment on which each hangs, -1 for a root
    branches : (S,) bool array, whether several limbs hang on it
    lengths : (S,) float64 array, how far it and what hangs on it reach at rest, normalised
    leads : (V,) int64 array, the segment that leads each vertex
    owner : (D,) int64 array, the segment that each code moves
    is_relative : whether codes turn a segment against the one on which it hangs, and those of the
        root move the whole body; else segments turn in space, and the body has no place of its own
    bases : segments on which all limbs hang that stand at rest: who holds one holds the root
    """

    parents: npt.NDArray[np.int64]
    branches: npt.NDArray[np.bool_]
    lengths: FloatArray
    leads: npt.NDArray[np.int64]
    owner: npt.NDArray[np.int64]
    is_relative: bool
    bases: frozenset[int] = frozenset()

    @cached_property
    def root(self) -> int:
        """The segment on which all hang, of several bodies that of the first."""
        return int(self.parents.argmin())

    def body(self, segment: int) -> frozenset[int]:
        """Return the segments of the body that a segment is of."""
        root = self.path(segment)[-1]
        everyone = range(len(self.parents))
        return frozenset(joint for joint in everyone if self.path(joint)[-1] == root)

    def path(self, segment: int) -> list[int]:
        """Return a segment and what it hangs on, up to the root."""
        path = [segment]
        while self.parents[path[-1]] >= 0:
            path.append(int(self.parents[path[-1]]))
        return path

    def limb(self, segment: int, least: float = 0.0) -> list[int]:
        """Return the limb of a segment from there upwards.

        Parameters
        ----------
        least : normalised; where the limb is shorter, that on which it hangs counts
        """
        path = self.path(segment)
        while True:
            n_own = 1
            while n_own < len(path) - 1 and not self.branches[path[n_own]]:
                n_own += 1
            if n_own == len(path) or self.lengths[path[n_own - 1]] >= least:
                return path[:n_own]
            path = path[n_own:]

    @cached_property
    def tops(self) -> npt.NDArray[np.int64]:
        """(S,) the segment at which the arm, leg or other long limb of each segment begins."""
        limb_tops = [self.limb(segment, LEAST_LIMB)[-1] for segment in range(len(self.parents))]
        return np.array(limb_tops)

    def codes_beside(self, segment: int) -> npt.NDArray[np.bool_]:
        """Return which of the (D,) codes move the arm, leg or trunk that a segment is of."""
        beside: npt.NDArray[np.bool_] = self.tops[self.owner] == self.tops[segment]
        return beside

    @cached_property
    def _own_tops(self) -> npt.NDArray[np.int64]:
        """(S,) the segment at which the limb of each segment begins, however short it is."""
        return np.array([self.limb(segment)[-1] for segment in range(len(self.parents))])

    @cached_property
    def are_short(self) -> npt.NDArray[np.bool_]:
        """(S,) whether each segment is of a limb as short as a finger, that hangs on another."""
        tops = self._own_tops
        short: npt.NDArray[np.bool_] = (self.lengths[tops] < LEAST_LIMB) & (self.parents[tops] >= 0)
        return short

    @cached_property
    def shares(self) -> FloatArray:
        """(S,) how much of the length of its limb each segment turns: 1 at its top, less after.

        1 of a limb without length: it leads no vertex, though it may share some.
        """
        whole = self.lengths[self._own_tops]
        turning = np.maximum(self.lengths, _LEAST_SHARE * whole)
        return np.where(whole > 0.0, turning, 1.0) / np.where(whole > 0.0, whole, 1.0)

    def holding(self, vertices: npt.NDArray[np.integer], weights: FloatArray) -> int:
        """Return the segment that is held with (n,) vertices: the one on which all theirs hang.

        Parameters
        ----------
        weights : (n,) that sum to 1; what leads few of the vertices does not count
        """
        shares = np.bincount(self.leads[vertices], weights, minlength=len(self.parents))
        first, *others = (
            self.path(int(segment))
            for segment in np.flatnonzero(shares >= min(_SHARE, max(shares)))
        )
        common = next(segment for segment in first if all(segment in other for other in others))
        return self.path(common)[-1] if common in self.bases else common

    def reaches(self, held: int, least: float = 0.0) -> list[list[int]]:
        """Return what a drag moves, and what joins in, step by step, out of its reach.

        Parameters
        ----------
        held : segment
        least : see `limb`
        """
        reaches = [self.limb(held, least)]
        while (above := int(self.parents[reaches[-1][-1]])) >= 0:
            if self.parents[above] < 0 and self.is_relative:
                break
            reaches.append(self.limb(above))
        if not self.is_relative and self.parents[held] >= 0:
            # What hangs on the limb turns with it only if it may.
            reaches[0] += [
                segment
                for segment in range(len(self.parents))
                if segment not in reaches[0] and set(self.path(segment)) & set(reaches[0])
            ]
        return reaches

    def carried(self, held: int, least: float = 0.0) -> npt.NDArray[np.bool_]:
        """Return which vertices go with a limb: (V,); see `limb`."""
        top = self.limb(held, least)[-1]
        goes = np.array([top in self.path(segment) for segment in range(len(self.parents))])
        carried: npt.NDArray[np.bool_] = goes[self.leads]
        return carried

    def with_pinned(self, moving: Iterable[int], pinned: Iterable[int]) -> frozenset[int]:
        """Add what must move so that pinned segments stay while others do."""
        must_move = set(moving)
        for segment in pinned:
            path = self.path(segment)
            above = [place for place, on in enumerate(path) if on in must_move]
            must_move.update(set(path[: above[0]]) - self.bases if above else ())
        return frozenset(must_move)

    def codes_of(self, segments: Iterable[int]) -> npt.NDArray[np.bool_]:
        """Return which codes move segments: (D,)."""
        codes: npt.NDArray[np.bool_] = np.isin(self.owner, list(segments))
        return codes

    def standing(self, vertices: FloatArray, up: FloatArray, held: int) -> dict[int, list[int]]:
        """Find what stands on the ground, other than the limb that is held.

        Parameters
        ----------
        vertices : (V, 3) normalised
        up : (3,) unit vector
        held : segment

        Returns
        -------
        points : vertices that stand and are far apart, by the top of each limb
        """
        heights = vertices @ up
        low = np.flatnonzero(heights < heights.min() + _GROUND)
        of_limb: dict[int, list[int]] = {}
        for segment in np.unique(self.leads[low]).tolist():
            inside = low[self.leads[low] == segment].tolist()
            of_limb.setdefault(int(self.tops[segment]), []).extend(inside)
        tops = {*self.path(held), *np.flatnonzero(self.parents < 0).tolist()}
        return {
            top: far_apart(vertices, np.array(inside))
            for top, inside in of_limb.items()
            if top not in tops
        }


def far_apart(
    vertices: FloatArray, chosen: npt.NDArray[np.integer], first: int | None = None
) -> list[int]:
    """Return some of (n,) vertices that fix the place and the orientation of all.

    Parameters
    ----------
    vertices : (V, 3)
    chosen : indices from 0
    first : one of them, by default the one farthest from their middle
    """
    points = vertices[chosen]
    if first is None:
        first = int(chosen[np.linalg.norm(points - points.mean(axis=0), axis=1).argmax()])
    arms = points - vertices[first]
    second = int(np.linalg.norm(arms, axis=1).argmax())
    axis = arms[second] / max(float(np.linalg.norm(arms[second])), 1e-12)
    third = int(np.linalg.norm(np.cross(arms, axis), axis=1).argmax())
    return list(dict.fromkeys([first, int(chosen[second]), int(chosen[third])]))
