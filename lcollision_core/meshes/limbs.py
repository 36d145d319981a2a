"""The tree of segments that move: the limb that a drag moves, and those that join in beyond it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.meshes.trees import lineage

_SHARE = 0.15
"""A segment that leads a smaller share of the grip is not held."""

_GROUND = 0.01
"""Normalised: vertices within this height above the lowest one stand on the ground."""

LEAST_LIMB = 0.12
"""Least length of a limb of its own, normalised; fingers belong to their arm."""

_LEAST_SHARE = 0.1
"""Least length that a segment turns, as a fraction of its limb's."""


@dataclass(frozen=True, eq=False)
class Limbs:
    """A tree of segments: the joints of a rig, or the body parts of a learned model.

    A limb is a chain of segments, from one up to the last below a segment with several limbs. The
    root belongs to no limb but its own. Each body of a scene has a root.

    Attributes
    ----------
    parents : (S,) int64 array of parent segments, -1 for a root
    branches : (S,) bool array, whether several limbs hang on a segment
    lengths : (S,) float64 array, reach of a segment and its descendants at rest, normalised
    leads : (V,) int64 array, the segment that leads each vertex
    owner : (D,) int64 array, the segment that each code moves
    is_relative : whether codes turn a segment relative to its parent and those of the root move the
        whole body; else segments turn in space, and the body has no whole-body shift
    bases : segments that carry all limbs standing at rest; a drag of one holds the root
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
        """The root segment, that of the first body if there are several."""
        return int(self.parents.argmin())

    def body(self, segment: int) -> frozenset[int]:
        """Return all segments of the body of a segment."""
        root = self.path(segment)[-1]
        everyone = range(len(self.parents))
        return frozenset(joint for joint in everyone if self.path(joint)[-1] == root)

    def path(self, segment: int) -> list[int]:
        """Return a segment and its ancestors, up to the root."""
        return lineage(self.parents, segment)

    def limb(self, segment: int, least: float = 0.0) -> list[int]:
        """Return the limb of a segment from there upwards.

        Parameters
        ----------
        least : normalised; if the limb is shorter, return the limb on which it hangs
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
        """(S,) top segment of the arm, leg or other long limb of each segment."""
        limb_tops = [self.limb(segment, LEAST_LIMB)[-1] for segment in range(len(self.parents))]
        return np.array(limb_tops)

    def codes_beside(self, segment: int) -> npt.NDArray[np.bool_]:
        """Return the (D,) mask of the codes that move the arm, leg or trunk of a segment."""
        beside: npt.NDArray[np.bool_] = self.tops[self.owner] == self.tops[segment]
        return beside

    @cached_property
    def _own_tops(self) -> npt.NDArray[np.int64]:
        """(S,) top segment of the limb of each segment, however short it is."""
        return np.array([self.limb(segment)[-1] for segment in range(len(self.parents))])

    @cached_property
    def are_short(self) -> npt.NDArray[np.bool_]:
        """(S,) whether each segment belongs to a limb as short as a finger, which has a parent."""
        tops = self._own_tops
        short: npt.NDArray[np.bool_] = (self.lengths[tops] < LEAST_LIMB) & (self.parents[tops] >= 0)
        return short

    @cached_property
    def shares(self) -> FloatArray:
        """(S,) fraction of its limb's length that each segment turns: 1 at the top, less below.

        1 in a limb without length, which leads no vertex, though it may have weight in some.
        """
        whole = self.lengths[self._own_tops]
        turning = np.maximum(self.lengths, _LEAST_SHARE * whole)
        return np.where(whole > 0.0, turning, 1.0) / np.where(whole > 0.0, whole, 1.0)

    def held_segment(self, vertices: npt.NDArray[np.integer], weights: FloatArray) -> int:
        """Return the segment held by a grip: the lowest common ancestor of its vertices' segments.

        Parameters
        ----------
        vertices : (n,) vertices of the grip
        weights : (n,) weights that sum to 1; segments with a small share are ignored
        """
        shares = np.bincount(self.leads[vertices], weights, minlength=len(self.parents))
        first, *others = (
            self.path(int(segment))
            for segment in np.flatnonzero(shares >= min(_SHARE, max(shares)))
        )
        common = next(segment for segment in first if all(segment in other for other in others))
        return self.path(common)[-1] if common in self.bases else common

    def drag_stages(self, held: int, least: float = 0.0) -> list[list[int]]:
        """Return the segments that a drag moves, then those that join in if it cannot reach.

        Parameters
        ----------
        held : the segment that is dragged
        least : see `limb`
        """
        reaches = [self.limb(held, least)]
        while (above := int(self.parents[reaches[-1][-1]])) >= 0:
            if self.parents[above] < 0 and self.is_relative:
                break
            reaches.append(self.limb(above))
        if not self.is_relative and self.parents[held] >= 0:
            # Segments turn in space, so descendants follow the limb only if they may turn too.
            reaches[0] += [
                segment
                for segment in range(len(self.parents))
                if segment not in reaches[0] and set(self.path(segment)) & set(reaches[0])
            ]
        return reaches

    def carried(self, held: int, least: float = 0.0) -> npt.NDArray[np.bool_]:
        """Return the (V,) mask of the vertices that move with a limb; see `limb`."""
        top = self.limb(held, least)[-1]
        goes = np.array([top in self.path(segment) for segment in range(len(self.parents))])
        carried: npt.NDArray[np.bool_] = goes[self.leads]
        return carried

    def with_pinned(self, moving: Iterable[int], pinned: Iterable[int]) -> frozenset[int]:
        """Add the segments that must move so that pinned ones can stay in place."""
        must_move = set(moving)
        for segment in pinned:
            path = self.path(segment)
            above = [place for place, on in enumerate(path) if on in must_move]
            must_move.update(set(path[: above[0]]) - self.bases if above else ())
        return frozenset(must_move)

    def codes_of(self, segments: Iterable[int]) -> npt.NDArray[np.bool_]:
        """Return the (D,) mask of the codes that move `segments`."""
        codes: npt.NDArray[np.bool_] = np.isin(self.owner, list(segments))
        return codes

    def standing(self, vertices: FloatArray, up: FloatArray, held: int) -> dict[int, list[int]]:
        """Find the limbs that stand on the ground, other than the one that is held.

        Parameters
        ----------
        vertices : (V, 3) normalised
        up : (3,) unit vector
        held : the segment that is dragged

        Returns
        -------
        points : up to three standing vertices far apart, by the top segment of each limb
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
    """Return up to three of some vertices that determine their position and orientation.

    Parameters
    ----------
    vertices : (V, 3)
    chosen : (n,) indices
    first : one of them; by default the one farthest from their centre
    """
    points = vertices[chosen]
    if first is None:
        first = int(chosen[np.linalg.norm(points - points.mean(axis=0), axis=1).argmax()])
    arms = points - vertices[first]
    second = int(np.linalg.norm(arms, axis=1).argmax())
    axis = arms[second] / max(float(np.linalg.norm(arms[second])), 1e-12)
    third = int(np.linalg.norm(np.cross(arms, axis), axis=1).argmax())
    return list(dict.fromkeys([first, int(chosen[second]), int(chosen[third])]))
