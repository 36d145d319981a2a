"""Contacts that a motion is to keep: patches of the body on each other, and on the ground."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import depth_slopes, distance_slopes
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import PoseSpace

TOGETHER = 0.005
"""Normalised: patches that are no farther apart are together, and so is one with the ground."""

_AIM, _BELOW = 0.002, 0.001
"""Normalised: how near patches are brought, and how far below the ground they may stay."""

_ANCHORED = 2e-4
"""Normalised: what stands still on the ground is no farther from its place."""

_MOST_PAIRS = 48
"""Of faces of two patches whose distance is measured, those whose middles are nearest."""

KEPT_SHARE = 0.95
"""Share of its frames in which a contact is together, if it is kept."""


@dataclass(frozen=True, eq=False)
class Touch:
    """Two patches of a body that are to touch in a frame, or one that is to be on the ground.

    Attributes
    ----------
    contact : the number of the contact that it belongs to
    first : (m,) faces
    second : (n,) faces; None for the ground
    anchor : (3,) where the mean of the first patch is to be along the ground, normalised; None
        where it slides or is not on the ground
    """

    contact: int
    first: npt.NDArray[np.intp]
    second: npt.NDArray[np.intp] | None = None
    anchor: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Pulls:
    """What brings the patches of one frame together, to first order in its D codes.

    Attributes
    ----------
    apart : numbers of touches that are not together
    n_off : how many are not in their place on the ground
    lack : what all of them are too far apart, normalised
    normals, offsets : (M, D) and (M,): normals Z <= offsets
    standing, places : the same of equations, of what stands in its place
    """

    apart: tuple[int, ...]
    n_off: int
    lack: float
    normals: FloatArray
    offsets: FloatArray
    standing: FloatArray
    places: FloatArray

    @property
    def n_apart(self) -> int:
        """How many touches are not together, or not in their place on the ground."""
        return len(self.apart) + self.n_off


@dataclass(frozen=True, eq=False)
class KeptContacts:
    """What touches in each frame of a motion.

    Attributes
    ----------
    touches : of each of T frames
    names : of each contact, two body parts or one and "ground"
    up : (3,) unit vector
    ground : its height along that, normalised
    """

    touches: Sequence[Sequence[Touch]]
    names: tuple[tuple[str, str], ...]
    up: FloatArray
    ground: float

    def at(self, frames: Iterable[int]) -> KeptContacts:
        """Return the contacts of some frames, in their order."""
        return replace(self, touches=[self.touches[frame] for frame in frames])

    def without(self, frames: Iterable[int]) -> KeptContacts:
        """Return them without those of some frames."""
        left_out = set(frames)
        touches = enumerate(self.touches)
        return replace(self, touches=[() if at in left_out else touch for at, touch in touches])

    def without_touches(self, numbers: Mapping[int, Sequence[int]]) -> KeptContacts:
        """Return them without some touches of some frames."""
        kept = (
            [touch for number, touch in enumerate(own) if number not in numbers.get(at, ())]
            for at, own in enumerate(self.touches)
        )
        return replace(self, touches=list(kept))

    @cached_property
    def _level(self) -> FloatArray:
        """(2, 3) unit vectors along the ground."""
        across = np.cross(self.up, np.eye(3)[np.abs(self.up).argmin()])
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(self.up, across)])

    def apart(self, space: PoseSpace, frame: int, vertices: FloatArray) -> list[float]:
        """Return how far apart the patches of a frame's touches are, normalised.

        Parameters
        ----------
        space : of the body's poses
        vertices : (V, 3) of the frame, normalised, in the model's frame
        """
        faces = space.topology.faces
        return [abs(self._gap(faces, touch, vertices)[0]) for touch in self.touches[frame]]

    def mean_of(self, space: PoseSpace, touch: Touch, vertices: FloatArray) -> FloatArray:
        """Return the mean of a touch's first patch, (3,)."""
        mean: FloatArray = vertices[np.unique(space.topology.faces[touch.first])].mean(axis=0)
        return mean

    def pulls(self, space: PoseSpace, frame: int, codes: FloatArray, vertices: FloatArray) -> Pulls:
        """Return what brings the patches of a pose together.

        Parameters
        ----------
        space : of the frame's poses
        codes, vertices : (D,) and (V, 3) of the pose, normalised, in the model's frame
        """
        faces, slopes, bounds, level = space.topology.faces, list[FloatArray](), list[float](), []
        apart, n_off, lack = list[int](), 0, 0.0
        for number, touch in enumerate(self.touches[frame]):
            gap, corners, by_corners = self._gap(faces, touch, vertices)
            if abs(gap) > TOGETHER and (gap > 0.0 or touch.second is None):
                apart.append(number)
                lack += abs(gap)
            aims = [(_AIM - gap, corners, by_corners, False)]
            if touch.second is None and gap < 0.0:
                aims = [(_BELOW + gap, corners, -by_corners, False)]
            if touch.anchor is not None:
                corners = np.unique(faces[touch.first])
                off = self._level @ (touch.anchor - vertices[corners].mean(axis=0))
                if np.abs(off).max() > _ANCHORED:
                    n_off += 1
                    lack += float(np.abs(off).max())
                shares = np.full((len(corners), 1), 1.0 / len(corners))
                ways = zip(off, self._level, strict=True)
                aims += [(away, corners, shares * way, True) for away, way in ways]
            for bound, places, by_places, is_equation in aims:
                by_vertices = np.zeros(vertices.shape)
                np.add.at(by_vertices, places, by_places)
                slopes.append(by_vertices)
                bounds.append(float(bound))
                level.append(is_equation)
        is_level = np.array(level, dtype=np.bool_)
        normals = np.zeros((0, len(codes)))
        if slopes:
            normals = space.pull_back(codes, np.array(slopes))
        offsets = normals @ codes + np.array(bounds)
        return Pulls(
            tuple(apart),
            n_off,
            lack,
            normals[~is_level],
            offsets[~is_level],
            normals[is_level],
            offsets[is_level],
        )

    def _gap(
        self, faces: npt.NDArray[np.int32], touch: Touch, vertices: FloatArray
    ) -> tuple[float, npt.NDArray[np.integer], FloatArray]:
        """Return how far the patches of a touch are apart, and its derivative by some vertices.

        Below 0 they penetrate, or are below the ground.
        """
        if touch.second is None:
            corners = np.unique(faces[touch.first])
            heights = vertices[corners] @ self.up - self.ground
            lowest = int(heights.argmin())
            return float(heights[lowest]), corners[[lowest]], self.up[None]
        first, second = _near_pairs(vertices[faces[touch.first]], vertices[faces[touch.second]])
        pairs = touch.first[first], touch.second[second]
        triangles = vertices[faces[pairs[0]]], vertices[faces[pairs[1]]]
        distance, slopes = distance_slopes(*triangles)
        nearest = int(distance.argmin())
        gap = float(distance[nearest])
        if gap == 0.0:
            depth, deeper = depth_slopes(*triangles)
            nearest = int(np.where(distance == 0.0, depth, -np.inf).argmax())
            gap, slopes = -float(depth[nearest]), -deeper
        corners = np.concatenate([faces[side[nearest]] for side in pairs])
        return gap, corners, slopes[nearest]


def _near_pairs(
    first: FloatArray, second: FloatArray
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return which of (m, 3, 3) and (n, 3, 3) triangles to measure: of the nearest middles."""
    middles = first.mean(axis=1)[:, None] - second.mean(axis=1)[None]
    radii = [
        np.linalg.norm(side - side.mean(axis=1)[:, None], axis=2).max(axis=1)
        for side in (first, second)
    ]
    least = np.linalg.norm(middles, axis=2) - radii[0][:, None] - radii[1][None]
    order = np.argpartition(least.ravel(), min(_MOST_PAIRS, least.size) - 1)[:_MOST_PAIRS]
    a, b = np.unravel_index(order, least.shape)
    return a, b


@dataclass(frozen=True)
class ContactReport:
    """How much of what touches in a motion does so in a form of it.

    Attributes
    ----------
    kept, lost : pairs of body parts, or one and "ground", by contact: it is kept where the patches
        are together in nearly all of its frames
    n_frames, n_together : frames of contacts, each counted for each contact, and those together
    slide : the farthest that a patch that stands still moves along the ground from one frame to the
        next, normalised
    """

    kept: tuple[tuple[str, str], ...] = ()
    lost: tuple[tuple[str, str], ...] = ()
    n_frames: int = 0
    n_together: int = 0
    slide: float = 0.0

    def to_json(self) -> dict[str, object]:
        """Return what reports hold of it."""
        return {
            "kept": [list(names) for names in self.kept],
            "lost": [list(names) for names in self.lost],
            "frames": self.n_frames,
            "frames_together": self.n_together,
            "slide": self.slide,
        }

    @classmethod
    def of(
        cls,
        contacts: KeptContacts,
        decoded: Callable[[int], FloatArray],
        space: PoseSpace,
    ) -> ContactReport:
        """Measure a motion of as many frames.

        Parameters
        ----------
        decoded : (V, 3) of a frame, normalised, in the model's frame
        space : of the body's poses
        """
        count = np.zeros((len(contacts.names), 2), dtype=np.int64)
        slide, before = 0.0, dict[tuple[int, bytes], FloatArray]()
        for frame, touches in enumerate(contacts.touches):
            means = dict[tuple[int, bytes], FloatArray]()
            if touches:
                vertices = decoded(frame)
                gaps = contacts.apart(space, frame, vertices)
                for touch, gap in zip(touches, gaps, strict=True):
                    count[touch.contact] += (1, gap <= TOGETHER)
                    if touch.anchor is not None:
                        key = touch.contact, touch.anchor.tobytes()
                        mean = contacts._level @ contacts.mean_of(space, touch, vertices)
                        means[key] = mean
                        if key in before:
                            slide = max(slide, float(np.linalg.norm(mean - before[key])))
            before = means
        is_kept = count[:, 1] >= KEPT_SHARE * count[:, 0]
        named = [
            (name, bool(own), int(n))
            for name, own, n in zip(contacts.names, is_kept, count[:, 0], strict=True)
            if n
        ]
        return cls(
            tuple(name for name, own, _ in named if own),
            tuple(name for name, own, _ in named if not own),
            int(count[:, 0].sum()),
            int(count[:, 1].sum()),
            slide,
        )
