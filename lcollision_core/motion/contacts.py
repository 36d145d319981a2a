"""Contacts that a motion should keep: patches of the body on each other, and on the ground."""

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
"""Normalised distance up to which two patches, or a patch and the ground, are together."""

_AIM, _BELOW = 0.002, 0.001
"""Normalised distance to which patches are brought, and depth below the ground that is allowed."""

_ANCHORED = 2e-4
"""Normalised distance from its place up to which an anchored patch stands still."""

_MOST_PAIRS = 48
"""Most pairs of faces of two patches whose distance is measured, the nearest ones."""

KEPT_SHARE = 0.95
"""Share of its frames in which a contact must be together to count as kept."""


@dataclass(frozen=True, eq=False)
class Touch:
    """Two patches of a body that should touch in a frame, or one that should be on the ground.

    Attributes
    ----------
    contact : the index of its contact
    first : (m,) faces
    second : (n,) faces; None for the ground
    anchor : (3,) normalised target of the first patch's mean along the ground; None if it slides or
        is not on the ground
    """

    contact: int
    first: npt.NDArray[np.intp]
    second: npt.NDArray[np.intp] | None = None
    anchor: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Pulls:
    """Constraints that bring the patches of one frame together, to first order in its D codes.

    Attributes
    ----------
    apart : the distance that each touch lacks which is not together, by its index
    n_off : number of touches that are not in their place on the ground
    lack : sum of the distances that they lack, normalised
    normals, offsets : (M, D) and (M,): normals Z <= offsets
    standing, places : the same for equations, of patches that stand in their place
    """

    apart: Mapping[int, float]
    n_off: int
    lack: float
    normals: FloatArray
    offsets: FloatArray
    standing: FloatArray
    places: FloatArray

    @property
    def n_apart(self) -> int:
        """The number of touches that are not together, or not in their place on the ground."""
        return len(self.apart) + self.n_off


@dataclass(frozen=True, eq=False)
class KeptContacts:
    """The touches in each frame of a motion.

    Attributes
    ----------
    touches : of each of T frames
    names : of each contact, two body parts or one and "ground"
    up : (3,) unit vector
    ground : its height along `up`, normalised
    """

    touches: Sequence[Sequence[Touch]]
    names: tuple[tuple[str, str], ...]
    up: FloatArray
    ground: float

    def at(self, frames: Iterable[int]) -> KeptContacts:
        """Return the contacts of the given frames, in their order."""
        return replace(self, touches=[self.touches[frame] for frame in frames])

    def without(self, frames: Iterable[int]) -> KeptContacts:
        """Return the contacts without those of some frames."""
        left_out = set(frames)
        touches = enumerate(self.touches)
        return replace(self, touches=[() if at in left_out else touch for at, touch in touches])

    def without_touches(self, numbers: Mapping[int, Sequence[int]]) -> KeptContacts:
        """Return the contacts without some touches, given by frame."""
        remaining_touches = (
            [touch for number, touch in enumerate(own) if number not in numbers.get(at, ())]
            for at, own in enumerate(self.touches)
        )
        return replace(self, touches=list(remaining_touches))

    @cached_property
    def _level(self) -> FloatArray:
        """(2, 3) unit vectors along the ground."""
        across = np.cross(self.up, np.eye(3)[np.abs(self.up).argmin()])
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(self.up, across)])

    def apart(self, space: PoseSpace, frame: int, vertices: FloatArray) -> list[float]:
        """Return the normalised distances between the patches of a frame's touches.

        Parameters
        ----------
        space : of the body's poses
        vertices : (V, 3) of the frame, normalised, in model coordinates
        """
        faces = space.topology.faces
        return [abs(self._gap(faces, touch, vertices)[0]) for touch in self.touches[frame]]

    def mean_of(self, space: PoseSpace, touch: Touch, vertices: FloatArray) -> FloatArray:
        """Return the mean of a touch's first patch, (3,)."""
        mean: FloatArray = vertices[np.unique(space.topology.faces[touch.first])].mean(axis=0)
        return mean

    def pulls(self, space: PoseSpace, frame: int, codes: FloatArray, vertices: FloatArray) -> Pulls:
        """Return the constraints that bring the patches of a pose together.

        Parameters
        ----------
        space : of the frame's poses
        codes, vertices : (D,) and (V, 3) of the pose, normalised, in model coordinates
        """
        faces, slopes, bounds, level = space.topology.faces, list[FloatArray](), list[float](), []
        apart, n_off, lack = dict[int, float](), 0, 0.0
        for number, touch in enumerate(self.touches[frame]):
            gap, corners, by_corners = self._gap(faces, touch, vertices)
            if abs(gap) > TOGETHER and (gap > 0.0 or touch.second is None):
                apart[number] = abs(gap)
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
            apart,
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
        """Return the signed distance of a touch's patches, vertices, and the derivative by them.

        It is negative if they penetrate, or are below the ground.
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
    """Return the indices of the nearest pairs of (m, 3, 3) and (n, 3, 3) triangles, by bounds."""
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
    """How far a version of a motion keeps the motion's contacts.

    Attributes
    ----------
    kept, lost : pairs of body parts, or one and "ground", by contact; a contact is kept if the
        patches are together in nearly all of its frames
    n_frames, n_together : number of frames with contacts, counted per contact, and of those that
        are together
    slide : largest normalised motion of an anchored patch along the ground from one frame to the
        next
    """

    kept: tuple[tuple[str, str], ...] = ()
    lost: tuple[tuple[str, str], ...] = ()
    n_frames: int = 0
    n_together: int = 0
    slide: float = 0.0

    def to_json(self) -> dict[str, object]:
        """Return the values for reports."""
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
        """Measure a motion with as many frames as the contacts.

        Parameters
        ----------
        decoded : returns (V, 3) vertices of a frame, normalised, in model coordinates
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
