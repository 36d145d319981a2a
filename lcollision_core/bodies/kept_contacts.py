"""Contacts of the body that a motion was made for, as patches of the body that it moves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.bodies.partners import common_name
from lcollision_core.bodies.retargeting import Retargeting
from lcollision_core.bodies.rig_body import RigBody
from lcollision_core.bodies.rig_space import ROOT_CODES, RigPoseSpace
from lcollision_core.contact.distance import triangle_distance
from lcollision_core.meshes.joint_kinds import Role
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion import Motion
from lcollision_core.motion.contacts import KeptContacts, Touch
from lcollision_core.motion.motion import runs

_TOUCHING = 0.01
"""Normalised distance below which parts of the source body touch."""

_PATCH, _SOLE_PATCH = 0.03, 0.04
"""Normalised radius of a patch at rest, and of a patch on the ground."""

_STANDING = 0.015
"""Normalised speed, per second, below which a patch on the ground stands; a faster one rolls."""

_STEADY = 2.0
"""Smoothing of the centres of sliding patches, in frames."""

_TRUNK = -1
"""Limb index of all joints of the trunk, which rigs divide differently."""

_ALONG, _AROUND, _ACROSS = 2.0, 0.7, 0.5
"""Weights for comparing places on two limbs: position along the limb, direction from its middle,
and distance outwards."""

_ENDS = (2.0, 98.0)
"""Percentiles that bound a limb along an axis."""


@dataclass(frozen=True, eq=False)
class Correspondence:
    """A correspondence between the vertices of two bodies.

    Joints that follow each other carry the same limb. On it, vertices correspond if they lie
    equally far along it and in the same direction from its middle; on equal meshes they are equal.

    Attributes
    ----------
    retargeting : from the source skeleton
    source : the source body's pose space
    motion, source_motion : the motion of each, frame by frame
    """

    retargeting: Retargeting
    source: RigPoseSpace
    motion: Motion
    source_motion: Motion

    @cached_property
    def limbs(self) -> npt.NDArray[np.int64]:
        """(V,) the limb of each of the body's vertices: a joint of the skeleton, or the trunk."""
        space, partner = self.retargeting.space, self.retargeting.partner.tolist()
        limb_of_joint = _limbs(space, partner, _trunk(space))
        return limb_of_joint[space.rig.heaviest]

    @cached_property
    def image(self) -> npt.NDArray[np.int64]:
        """The body's vertex for each of the source's vertices, -1 for none."""
        same = self.source.topology == self.retargeting.space.topology
        return np.arange(len(self.limbs)) if same else self.by_place()

    def by_place(self) -> npt.NDArray[np.int64]:
        """Find `image` limb by limb, independent of the topologies."""
        space, source = self.retargeting.space, self.source
        # The least bent pose.
        frame = int(np.abs(self.motion.codes[:, ROOT_CODES:]).sum(axis=1).argmin())
        partner, trunk = self.retargeting.partner, _trunk(space)
        listed = [*enumerate(self.retargeting.motion.names)]
        names = {common_name(name): joint for joint, name in reversed(listed)}
        followed = set(partner.tolist()) - {-1}
        of_trunk = {int(partner[joint]) for joint in trunk}
        numbers = [names.get(common_name(name), -1) for name in source.rig.joint_names]
        followed_numbers = [number if number in followed else -1 for number in numbers]
        own_trunk = _trunk(source) | {
            at for at, number in enumerate(followed_numbers) if number in of_trunk
        }
        theirs = _limbs(source, followed_numbers, own_trunk)[source.rig.heaviest]
        image = np.full(len(theirs), -1, dtype=np.int64)
        between = space.body_axes @ source.body_axes.T
        turns = _turns(source, self.source_motion, frame), _turns(space, self.motion, frame)
        for limb in np.unique(theirs).tolist():
            inside, own_vertices = (
                np.flatnonzero(theirs == limb),
                np.flatnonzero(self.limbs == limb),
            )
            if not len(own_vertices):
                continue
            first = _first(source, inside, limb), _first(space, own_vertices, limb)
            turned = between @ turns[0][first[0]], turns[1][first[1]]
            # In the frame's pose, limbs point the same way, whatever their rest poses.
            points = (
                (source.rest_vertices[inside] - source.origins[first[0]]) @ turned[0].T,
                (space.rest_vertices[own_vertices] - space.origins[first[1]]) @ turned[1].T,
            )
            places = []
            for side in points:
                axis = turned[1] @ space.up if limb == _TRUNK else side.mean(axis=0)
                places.append(_places(side, axis, space.front, space.up))
            image[inside] = own_vertices[scipy.spatial.cKDTree(places[1]).query(places[0])[1]]
        return image

    def patch(self, middle: FloatArray, limb: int, radius: float) -> npt.NDArray[np.intp]:
        """Return the faces of a limb near a place at rest, at least one."""
        by_limb, middles = self._faces
        faces = by_limb[limb]
        away = np.linalg.norm(middles[faces] - middle, axis=1)
        patch_vertices: npt.NDArray[np.intp] = faces[away <= max(radius, float(away.min()))]
        return patch_vertices

    @cached_property
    def _faces(self) -> tuple[dict[int, npt.NDArray[np.intp]], FloatArray]:
        space = self.retargeting.space
        owner = self.limbs[space.topology.faces[:, 0]]
        by_limb = {limb: np.flatnonzero(owner == limb) for limb in np.unique(owner).tolist()}
        return by_limb, space.rest_vertices[space.topology.faces].mean(axis=1)


def _trunk(space: RigPoseSpace) -> set[int]:
    """Return the joints of hips, spine and collar bones."""
    trunk_joints = {
        joint for joint, role in enumerate(space.roles) if role in (Role.SPINE, Role.SHOULDER)
    }
    return trunk_joints | {int(space.joint_of_code[0])}


def _limbs(space: RigPoseSpace, known: Sequence[int], trunk: set[int]) -> npt.NDArray[np.int64]:
    """Return the limb of each joint: the known one, else its parent's."""
    limbs = np.full(len(known), _TRUNK, dtype=np.int64)
    for joint, parent in enumerate(space.rig.parents.tolist()):
        if joint in trunk:
            continue
        if known[joint] >= 0:
            limbs[joint] = known[joint]
        elif parent >= 0:
            limbs[joint] = limbs[parent]
    return limbs


def _first(space: RigPoseSpace, vertices: npt.NDArray[np.intp], limb: int) -> int:
    """Return the first joint of a limb's vertices; for the trunk, the root."""
    if limb == _TRUNK:
        return max(int(space.joint_of_code[0]), 0)
    return int(space.rig.heaviest[vertices].min())


def _turns(space: RigPoseSpace, motion: Motion, frame: int) -> FloatArray:
    """Return the rotation of each joint from rest in a frame: (J, 3, 3)."""
    frame_space = motion.space(frame, space)
    assert isinstance(frame_space, RigPoseSpace)
    moved = frame_space.transforms(motion.codes[frame]) @ np.linalg.inv(space.rig.rest)
    left, _, right = np.linalg.svd(moved[:, :3, :3])
    turned: FloatArray = left @ right
    return turned


def _places(points: FloatArray, axis: FloatArray, front: FloatArray, up: FloatArray) -> FloatArray:
    """Return weighted coordinates of (n, 3) points along and around an axis: (n, 5)."""
    along = axis / np.linalg.norm(axis)
    beside = front if abs(along @ front) < 0.7 else up
    beside = beside - (beside @ along) * along
    axes = np.stack([along, beside / np.linalg.norm(beside)])
    axes = np.concatenate([axes, np.cross(axes[0], axes[1])[None]])
    own = points @ axes.T
    low, high = np.percentile(own, _ENDS, axis=0)
    own = 2.0 * (own - low) / np.maximum(high - low, 1e-9) - 1.0
    out = np.maximum(np.linalg.norm(own[:, 1:], axis=1), 1e-9)[:, None]
    return np.column_stack(
        [0.5 * _ALONG * own[:, 0], _AROUND * own[:, 1:] / out, _ACROSS * own[:, 1:]]
    )


_SPACING, _AT_REST = 0.007, 0.03
"""Normalised: distance between samples of a surface; and distance at rest below which contacts in
a pose are ignored."""


@dataclass(frozen=True, eq=False)
class _Samples:
    """Evenly spaced points of a body's surface.

    Attributes
    ----------
    faces, rest : of the body
    face, weights : (S,) and (S, 3), face and barycentric weights of each point
    part : (S,) its body part
    """

    faces: npt.NDArray[np.int32]
    rest: FloatArray
    face: npt.NDArray[np.intp]
    weights: FloatArray
    part: npt.NDArray[np.intp]

    @classmethod
    def of(cls, space: RigPoseSpace) -> _Samples:
        """Sample the rest pose."""
        faces, rest = space.topology.faces, space.rest_vertices
        sides = space.topology.longest_sides(rest)
        n_steps = np.minimum(np.ceil(sides / _SPACING), 99).astype(np.int64)
        owners, shares = list[npt.NDArray[np.intp]](), list[FloatArray]()
        for n in np.unique(np.maximum(n_steps, 1)).tolist():
            edges = np.flatnonzero(np.maximum(n_steps, 1) == n)
            a, b = (grid.ravel() for grid in np.meshgrid(np.arange(n), np.arange(n)))
            inside = a + b < n
            last_two = (np.column_stack([a, b])[inside] + 1.0 / 3.0) / n
            barycentric = np.column_stack([1.0 - last_two.sum(axis=1), last_two])
            owners.append(np.repeat(edges, len(barycentric)))
            shares.append(np.tile(barycentric, (len(edges), 1)))
        face, weights = np.concatenate(owners), np.concatenate(shares)
        part = space.vertex_domain[faces[face, weights.argmax(axis=1)]]
        cells = np.floor(_at(rest, faces, face, weights) / _SPACING).astype(np.int64)
        _, first_of_cell = np.unique(np.column_stack([cells, part]), axis=0, return_index=True)
        return cls(faces, rest, face[first_of_cell], weights[first_of_cell], part[first_of_cell])

    def touching(
        self, vertices: FloatArray, adjacent: set[tuple[int, int]]
    ) -> list[tuple[tuple[int, int], tuple[int, int]]]:
        """Return the parts that touch in a pose, with a vertex at the centre of each contact.

        Parameters
        ----------
        vertices : (V, 3) of the pose, normalised
        adjacent : pairs of parts to skip
        """
        points, at_rest = (
            _at(pose, self.faces, self.face, self.weights) for pose in (vertices, self.rest)
        )
        pairs = scipy.spatial.cKDTree(points).query_pairs(
            _TOUCHING + _SPACING, output_type="ndarray"
        )
        pairs = pairs[self.part[pairs[:, 0]] != self.part[pairs[:, 1]]]
        away = np.linalg.norm(at_rest[pairs[:, 0]] - at_rest[pairs[:, 1]], axis=1)
        pairs = pairs[away > _AT_REST]
        swapped = self.part[pairs[:, 0]] > self.part[pairs[:, 1]]
        pairs[swapped] = pairs[swapped, ::-1]
        n_parts, touching = int(self.part.max()) + 1, []
        keys = self.part[pairs] @ np.array([n_parts, 1])
        for key in np.unique(keys).tolist():
            a, b = divmod(key, n_parts)
            if (a, b) in adjacent:
                continue
            here = pairs[keys == key]
            both = np.unique(self.face[here], axis=0)
            distance, _ = triangle_distance(
                *(vertices[self.faces[both[:, side]]] for side in (0, 1))
            )
            both, lacks = both[distance < _TOUCHING], _TOUCHING - distance[distance < _TOUCHING]
            if not len(both):
                continue
            middles = []
            for side in (0, 1):
                corners = self.faces[both[:, side]]
                middle = np.average(self.rest[corners].mean(axis=1), axis=0, weights=lacks)
                touching_corners = np.unique(corners)
                away = np.linalg.norm(self.rest[touching_corners] - middle, axis=1)
                middles.append(int(touching_corners[away.argmin()]))
            touching.append(((a, b), (middles[0], middles[1])))
        return touching


def _at(
    vertices: FloatArray,
    faces: npt.NDArray[np.int32],
    face: npt.NDArray[np.intp],
    weights: FloatArray,
) -> FloatArray:
    points: FloatArray = np.einsum("sk,skx->sx", weights, vertices[faces[face]])
    return points


def contacts_of(
    motion: Motion, source: RigBody, source_motion: Motion, retargeting: Retargeting
) -> KeptContacts:
    """Return the contacts of the body that a motion was made for, frame by frame.

    Parts touch if their faces come within 1 % of the body size; their contact patches surround the
    centres of the touching faces. Surfaces on the ground, the lowest point of the motion, are
    divided into patches, and those that hardly move stand.

    Parameters
    ----------
    motion : poses of the body that follows the source
    source : the body that the motion was made for
    source_motion : the source's poses, at the same times or more densely
    retargeting : from the source to the body
    """
    since = source_motion.times - source_motion.times[0]
    nearest = np.abs(motion.times[:, None] - motion.times[0] - since).argmin(axis=1)
    frames = _frames_at(source_motion, nearest)
    both = Correspondence(retargeting, source.space, motion, frames)
    own_space, space, names = retargeting.space, source.space, source.domain_names
    surface, adjacent = _Samples.of(space), _adjacent(space)
    # The central vertices of contacts, by the parts and the frame.
    middles_of: dict[tuple[int, int], dict[int, tuple[int, int]]] = defaultdict(dict)
    heights, level = list[FloatArray](), list[FloatArray]()
    for frame in range(len(frames)):
        vertices = frames.decoded(frame, space)
        heights.append(vertices @ space.up)
        level.append(vertices - heights[-1][:, None] * space.up)
        for parts, middles in surface.touching(vertices, adjacent):
            middles_of[parts][frame] = middles
    touches: list[list[Touch]] = [[] for _ in range(len(frames))]
    contacts = list[tuple[str, str]]()
    for (first_part, second_part), by_frame in middles_of.items():
        for run in runs(np.isin(np.arange(len(frames)), list(by_frame))):
            sides = _sliding(both, [by_frame[frame] for frame in run])
            if sides is None:
                continue
            for frame, (first, second) in zip(run, sides, strict=True):
                touches[frame].append(Touch(len(contacts), first, second))
            contacts.append((names[first_part], names[second_part]))

    @cache
    def decoded(frame: int) -> FloatArray:
        return motion.decoded(frame, own_space)

    ground_of = list[float]()
    for name, patch, on_ground, still in _soles(source, both, np.array(heights), np.array(level)):
        corners = np.unique(own_space.topology.faces[patch])
        for run in runs(on_ground):
            anchors = dict[int, FloatArray | None]()
            for stand in runs(still[run.start : run.stop]):
                own_frames = range(run.start + stand.start, run.start + stand.stop)
                anchor = np.mean([decoded(at)[corners].mean(axis=0) for at in own_frames], axis=0)
                anchors |= dict.fromkeys(own_frames, anchor)
            for frame in run:
                ground_of.append(float((decoded(frame)[corners] @ own_space.up).min()))
                touches[frame].append(Touch(len(contacts), patch, None, anchors.get(frame)))
            contacts.append((name, "ground"))
    ground = float(np.median(ground_of)) if ground_of else 0.0
    return KeptContacts(touches, tuple(contacts), own_space.up, ground)


def _frames_at(motion: Motion, frames: npt.NDArray[np.intp]) -> Motion:
    """Return a motion made of given frames of another."""
    frame_space, hidden = motion.space_at, motion.hidden
    return replace(
        motion,
        times=np.arange(len(frames)) / motion.rate,
        codes=motion.codes[frames],
        placements=None
        if motion.placements is None
        else tuple(motion.placements[frame] for frame in frames.tolist()),
        space_at=None
        if frame_space is None
        else lambda time: frame_space(float(frames[int(time)])),
        hidden=None if hidden is None else lambda frame: hidden(int(frames[frame])),
        contacts=None,
    )


def _adjacent(space: RigPoseSpace) -> set[tuple[int, int]]:
    """Return pairs of body parts that a joint links, smaller index first."""
    parts, parents = space.part_of_joint, space.rig.parents
    return {
        (min(a, b), max(a, b))
        for joint, parent in enumerate(parents.tolist())
        if parent >= 0 and (a := int(parts[joint])) != (b := int(parts[parent]))
    }


def _sliding(
    both: Correspondence, vertices: Sequence[tuple[int, int]]
) -> list[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]] | None:
    """Return the patches of a contact in successive frames; None if the body lacks them."""
    sides = []
    for side in (0, 1):
        images = both.image[[pair[side] for pair in vertices]]
        if (images < 0).any():
            return None
        middles = both.retargeting.space.rest_vertices[images]
        middles = scipy.ndimage.gaussian_filter1d(middles, _STEADY, axis=0, mode="nearest")
        limbs = both.limbs[images].tolist()
        sides.append(
            [both.patch(middle, limb, _PATCH) for middle, limb in zip(middles, limbs, strict=True)]
        )
    return list(zip(*sides, strict=True))


def _soles(
    source: RigBody, both: Correspondence, heights: FloatArray, level: FloatArray
) -> Iterator[tuple[str, npt.NDArray[np.intp], npt.NDArray[np.bool_], npt.NDArray[np.bool_]]]:
    """Divide surfaces that touch the ground into patches.

    Parameters
    ----------
    heights, level : (T, V) heights and (T, V, 3) horizontal positions of the source's vertices

    Yields
    ------
    name : of the body part
    patch : of the body
    on_ground, still : (T,) when it is on the ground, and when it stays in place
    """
    space, slowest = both.source, _STANDING / both.source_motion.rate
    low = heights < heights.min() + _TOUCHING
    rest, domain = space.rest_vertices, space.vertex_domain
    for part in np.unique(domain[low.any(axis=0)]).tolist():
        left = np.flatnonzero(low.any(axis=0) & (domain == part))
        stood = np.zeros(len(low), dtype=np.bool_)
        while len(left):
            times = low[:, left].sum(axis=0)
            middle = rest[left[times.argmax()]]
            near = np.linalg.norm(rest[left] - middle, axis=1) < 2.0 * _SOLE_PATCH
            inside, left = left[near], left[~near]
            images = both.image[inside]
            if (images < 0).any():
                continue
            sole_centre = both.retargeting.space.rest_vertices[images].mean(axis=0)
            limb = int(both.limbs[images[0]])
            on_ground = low[:, inside].any(axis=1)
            means = level[:, inside].mean(axis=1)
            step = np.linalg.norm(np.diff(means, axis=0), axis=1) < slowest
            still = np.zeros(len(low), dtype=np.bool_)
            still[1:] |= step & on_ground[1:] & on_ground[:-1]
            still[:-1] |= step & on_ground[1:] & on_ground[:-1]
            # One patch per part keeps it in place.
            still &= ~stood
            stood |= still
            patch = both.patch(sole_centre, limb, _SOLE_PATCH)
            yield source.domain_names[part], patch, on_ground, still
