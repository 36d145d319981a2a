"""The pose space of a rig: joint angles and morph weights as codes, their limits, the skin."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence, Set
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.bodies import rig_kernels
from lcollision_core.bodies.anatomy import Anatomy, anatomy_of, axes_of, joint_limits, rig_of
from lcollision_core.bodies.rig_kernels import Influences, JointFrames, Motions, PoseShapes
from lcollision_core.errors import ShapeError
from lcollision_core.files.character import Character, Rig
from lcollision_core.files.scene.transforms import (
    from_rotation_vectors,
    nearest_winding,
    rotation_vectors,
)
from lcollision_core.meshes.extents import body_size
from lcollision_core.meshes.joint_kinds import Role
from lcollision_core.meshes.limbs import LEAST_LIMB, Limbs
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology, length_graph
from lcollision_core.meshes.trees import ancestry
from lcollision_core.posing.pose_space import DisplacementMetrics, PosesOnGpu

ROOT_CODES = 6
"""Codes of the whole body: its shift along left, up and front, and its turn about them."""

SHIFTS = 3

_SHIFT, _TURN = 1.0, np.pi
"""Bounds of the whole body's shift, normalised, and of its turn about an axis."""

_HIDDEN = 1e-6
"""Scale relative to rest below which a joint is hidden and has no orientation."""

_SLACK = np.radians(5.0)
"""Angle added to the limits beyond the frames of the character's clips."""

_ANY_AXIS = np.radians(5.0)
"""Angle added to the limits by role for joints that turn about any axis."""

_LEAST_BEND = np.radians(10.0)
"""Least bend of elbows and knees at which a drag computes derivatives."""

_METRIC_POSES = 8
_METRIC_VERTICES = 3000
_STRETCH_POSES = 64
_STRETCH_SLACK = 1.25
"""Factor on edge lengths: edges may get longer than in the sampled poses."""

_SPREAD = 0.25
"""Standard deviation of a code in plausible poses as a share of its range, without clips."""

_TURNED = 3e-5
"""In drags, the price of a squared turn of a dragged limb's joint against its parent."""

_RELUCTANT, _HELPING, _WHOLE_TURN = 100.0, 3.0, 100.0
"""Factors of that price: for other joints, for these if they are to help, and for the root."""

_TINY = 1e-12
"""Determinant below which a joint is hidden."""

_SEED = 0


@dataclass(frozen=True, eq=False)
class JointOffsets:
    """Scales and offsets of joints in N poses, beside the turns in their codes.

    Attributes
    ----------
    offsets : (N, B, 3) float64 array, each bone's offset from its rest position before its parent
        moves it, normalised
    linear : (N, B, 3, 3) float64 array, the linear map of each bone before it turns, in its axes:
        Y_b of `rig_kernels`
    """

    offsets: FloatArray
    linear: FloatArray


class RigPoseSpace:
    """The poses of a character's rig, as a `posing.PoseSpace`.

    Codes are the shift of the whole body (normalised) and its turn, along and about left, up and
    front; then, for each body part, the rotation vectors of its joints, in radians, in axes along
    the bones; then the `n_shapes` morph target weights. Zeros are the rest pose. Joints without
    skinned vertices below them have no codes.

    Parameters
    ----------
    character : one with a rig
    parts : J body part names, by joint; by default `Anatomy.labels`
    frames : (N, J, 4, 4) global transforms of the joints in plausible poses, as in `ClipFrames`:
        they widen the limits and determine `precision`
    shapes : (N, S) float64 array, morph target weights in these poses; at rest if None

    Attributes
    ----------
    part_names : K names of the body parts
    n_shapes : S, the number of the last codes, which are morph target weights
    joint_of_code, axis_of_code : (D - S,) int64 arrays: the joint of the rig, and its axis: 0
        bends, 1 twists, 2 turns sideways; for the root's first six codes the axis is 0 to 5
    rig : of the character
    roles, sides : J each, the joints' roles and sides of the body
    anatomy : source of roles, sides and axes
    origins : (J, 3) float64 array, joint positions in the rest pose, normalised
    axes : (J, 3, 3) float64 array, the joints' axes in the rest pose, as columns
    part_of_joint : (J,) each joint's body part, an index from 0
    frame_codes : (N, D) float64 array, the codes of the `frames`
    up : (3,) float64 unit vector
    front : (3,) float64 unit vector, the direction that the character faces at rest
    body_axes : (3, 3) float64 array, left, up and front as columns
    body_size : the unit of the normalised lengths, in the character's unit

    Raises
    ------
    LCollisionError : the character has no rig.
    ShapeError : `parts` or `frames` do not match its joints.
    """

    def __init__(
        self,
        character: Character,
        parts: Sequence[str] | None = None,
        frames: FloatArray | None = None,
        shapes: FloatArray | None = None,
    ) -> None:
        anatomy = anatomy_of(character)
        rig = rig_of(character)
        n_joints = len(rig.parents)
        if parts is None:
            parts = anatomy.labels
        if len(parts) != n_joints:
            raise ShapeError.must_be("body parts of a rig", f"{n_joints} names", len(parts))
        self.topology = character.topology
        self.body_size = body_size(character.rest_vertices, character.topology)
        self.rest_vertices: FloatArray = character.rest_vertices / self.body_size
        self.rig = rig
        self.origins: FloatArray = rig.rest[:, :3, 3] / self.body_size
        self._set_bones(rig)
        self.up: FloatArray = character.up
        self._set_axes(rig, anatomy)
        self._set_influences(rig)
        self.n_shapes = 0 if rig.shapes is None else len(rig.shapes.names)
        self.low, self.high = self._set_codes(rig, parts)
        self.frame_codes = np.empty((0, len(self.low)))
        if frames is not None:
            self.frame_codes = self.codes_of_transforms(frames, shapes)
            if len(self.frame_codes):
                slack = np.where(self.are_shapes, 0.0, _SLACK)
                self.low = np.minimum(self.low, self.frame_codes.min(axis=0) - slack)
                self.high = np.maximum(self.high, self.frame_codes.max(axis=0) + slack)

    def _set_bones(self, rig: Rig) -> None:
        """Find the root, the lowest joint that carries all vertices, and the joints with codes.

        `_bones` are their indices in the rig. If the rig's roots have no common ancestor, a
        virtual root, -1, is added.
        """
        n_joints, used = len(rig.parents), np.zeros(len(rig.parents), dtype=np.int64)
        # Pose shapes count like skin weights.
        used[rig.joint_of[rig.weights > 0.0] if rig.pose_shapes is None else slice(None)] = 1
        below = used.copy()
        for joint in range(n_joints - 1, -1, -1):
            if rig.parents[joint] >= 0:
                below[rig.parents[joint]] += below[joint]
        carriers = np.flatnonzero(below == used.sum())
        root = int(carriers[-1]) if len(carriers) else -1
        above = {-1, *carriers.tolist()} - {root}
        bones = [root] + [
            joint for joint in range(n_joints) if below[joint] and joint not in {root, *above}
        ]
        number = {joint: place for place, joint in enumerate(bones)}
        self._bones = np.array(bones)
        parents = [-1] + [number.get(int(rig.parents[joint]), 0) for joint in bones[1:]]
        self._parents = np.array(parents, dtype=np.int64)
        self._bone_of = np.zeros(n_joints, dtype=np.int64)
        """Bone that carries each joint; -1 above the root."""
        for joint in range(n_joints):
            parent = int(rig.parents[joint])
            carried = self._bone_of[parent] if parent >= 0 else (0 if root < 0 else -1)
            self._bone_of[joint] = number.get(joint, carried)

    def _set_axes(self, rig: Rig, anatomy: Anatomy) -> None:
        self.anatomy, self.front = anatomy, anatomy.front
        self.roles, self.sides = anatomy.roles, anatomy.sides
        self.axes: FloatArray = anatomy.axes.copy()
        self._least, self._most = joint_limits(rig, self.roles)
        if rig.moving is not None:
            self._least, self._most = self._least - _ANY_AXIS, self._most + _ANY_AXIS
            self._least[~rig.moving] = self._most[~rig.moving] = 0.0
        self.body_axes = body = axes_of(self.up, self.front)
        root = self._bones[0]
        middle = 0.5 * (self.rest_vertices.min(axis=0) + self.rest_vertices.max(axis=0))
        self._bone_origins = self.origins[self._bones]
        self._bone_axes = np.ascontiguousarray(self.axes[self._bones])
        self._bone_axes[0] = body
        if root < 0:
            self._bone_origins[0] = middle
        else:
            self.axes[root] = body
        if rig.stretch is not None:
            # A virtual root takes the stretch of the first bone below it.
            stretch = rig.stretch[self._bones]
            stretch[0] = rig.stretch[self._bones[0 if root >= 0 else 1]]
            self._bone_axes = stretch @ self._bone_axes
        self._bone_inverses = np.linalg.inv(self._bone_axes)
        # Values for the body at rest: see `with_joint_offsets`.
        self._places, self._own, self._own_inverses = (
            self._bone_origins,
            self._bone_inverses,
            self._bone_axes,
        )
        self._origin: RigPoseSpace | None = None

    def _set_influences(self, rig: Rig) -> None:
        counts = rig.weights > 0.0
        self._first = np.concatenate([[0], np.cumsum(counts.sum(axis=1))]).astype(np.int32)
        self._joints = self._bone_of[rig.joint_of[counts]].astype(np.int32)
        self._weights = np.ascontiguousarray(rig.weights[counts])
        self._points = self.influence_points(rig.points)
        self._shaped_points = self._points, b"", self._points
        self._shapes: PoseShapes | None = None
        if rig.pose_shapes is not None:
            by_joint = rig.pose_shapes.reshape(len(rig.pose_shapes), 3, -1, 9) / self.body_size
            by_bone = np.zeros((len(by_joint), 3, len(self._bones), 9), dtype=np.float32)
            by_bone[:, :, 1:] = by_joint[:, :, self._bones[1:] - 1]
            self._shapes = PoseShapes(by_bone)

    def influence_points(self, points: FloatArray) -> FloatArray:
        """Return the normalised (M, 3) points with a weight, of (V, I, 3) points of the rig."""
        weighing: FloatArray = np.ascontiguousarray(points[self.rig.weights > 0.0])
        return weighing / self.body_size

    def _set_codes(self, rig: Rig, parts: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Assign vertices and codes to body parts by their joints; return the codes' bounds.

        A joint whose part would lead no vertex belongs to its parent's part.
        """
        leading = {parts[joint] for joint in np.unique(rig.heaviest)}
        part_of: dict[int, str] = {}
        for joint in self._bones.tolist():
            name = parts[joint] if joint >= 0 else ""
            above = part_of.get(int(rig.parents[joint]), "") if joint >= 0 else ""
            part_of[joint] = name if name in leading else above
        # A root that leads no vertex joins the first part that does.
        fallback = next(name for name in part_of.values() if name)
        part_of = {joint: name or fallback for joint, name in part_of.items()}
        self.part_names = tuple(dict.fromkeys(part_of.values()))
        part_of_joint = np.array(
            [
                self.part_names.index(part_of[int(self._bones[bone])]) if bone >= 0 else 0
                for bone in self._bone_of
            ]
        )
        self.vertex_domain: npt.NDArray[np.intp] = part_of_joint[rig.heaviest]
        self.part_of_joint = part_of_joint
        # A virtual root has no part.
        self._root_part = int(part_of_joint[self._bones[0]]) if self._bones[0] >= 0 else -1
        bones, axes, sizes = [0] * ROOT_CODES, list(range(ROOT_CODES)), [ROOT_CODES]
        low, high = [-_SHIFT] * 3 + [-_TURN] * 3, [_SHIFT] * 3 + [_TURN] * 3
        for name in self.part_names:
            before = len(bones)
            for bone, joint in enumerate(self._bones.tolist()):
                if bone == 0 or part_of[joint] != name:
                    continue
                for axis in range(3):
                    if self._least[joint, axis] < self._most[joint, axis]:
                        bones.append(bone)
                        axes.append(axis)
                        low.append(self._least[joint, axis])
                        high.append(self._most[joint, axis])
            sizes.append(len(bones) - before)
        self._bone_of_code, self.axis_of_code = np.array(bones), np.array(axes)
        self.joint_of_code = self._bones[self._bone_of_code]
        self.group_sizes: tuple[int, ...] = tuple(sizes)
        hinges = [
            bool(axis == 0 and joint >= 0 and self.roles[joint] in (Role.FOREARM, Role.SHIN))
            for joint, axis in zip(self.joint_of_code, self.axis_of_code, strict=True)
        ]
        self._hinges = np.flatnonzero(hinges)
        # Index of each code among the shift and the turns of all bones.
        self._place = self.axis_of_code + np.where(
            self._bone_of_code == 0, 0, 3 + 3 * self._bone_of_code
        )
        if rig.shapes is not None:
            low, high = [*low, *rig.shapes.low], [*high, *rig.shapes.high]
        return np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)

    @property
    def to_body(self) -> FloatArray:
        """(3, 3) rotation from the character's axes to left, up and front."""
        return np.ascontiguousarray(self.body_axes.T)

    @property
    def are_shapes(self) -> npt.NDArray[np.bool_]:
        """(D,) mask of the codes that are morph target weights."""
        return np.arange(len(self.low)) >= len(self._place)

    @property
    def domains_of_shapes(self) -> list[int]:
        """The body part that each of the S shapes moves most."""
        shapes, domains = self.rig.shapes, []
        owner = np.repeat(self.vertex_domain, np.diff(self._first))
        for column in range(self.n_shapes):
            assert shapes is not None
            moved = np.linalg.norm(shapes.offsets(np.eye(1, self.n_shapes, column)[0]), axis=1)
            domains.append(int(np.bincount(owner, self._weights * moved).argmax()))
        return domains

    @property
    def n_domains(self) -> int:
        """K, the number of body parts."""
        return len(self.part_names)

    @property
    def n_joints(self) -> int:
        """J, the number of the rig's joints."""
        return len(self.rig.parents)

    @cached_property
    def attention_mask(self) -> npt.NDArray[np.float32]:
        """(K, V) skin weights of each body part's joints."""
        mask = np.zeros((self.n_domains, self.topology.n_vertices))
        part = self.part_of_joint[self.rig.joint_of]
        vertex = np.broadcast_to(np.arange(len(part))[:, None], part.shape)
        np.add.at(mask, (part, vertex), self.rig.weights)
        return mask.astype(np.float32)

    @cached_property
    def _plausible(self) -> FloatArray:
        """(n, D) codes of the rest pose and of some frames, or else of moderate random poses."""
        if len(self.frame_codes):
            pose_numbers = np.linspace(0, len(self.frame_codes) - 1, _METRIC_POSES - 1).astype(int)
            others = self.frame_codes[np.unique(pose_numbers)]
        else:
            others = 0.5 * self._random(_METRIC_POSES - 1)
        return np.concatenate([np.zeros((1, len(self.low))), others])

    def _random(self, n: int) -> FloatArray:
        """Return (n, D) random codes within the bounds; the whole body and the shapes stay."""
        poses = np.random.default_rng(_SEED).uniform(self.low, self.high, (n, len(self.low)))
        poses[:, :ROOT_CODES] = 0.0
        poses[:, self.are_shapes] = 0.0
        return poses

    @cached_property
    def domain_metrics(self) -> DisplacementMetrics:
        """J_k^T J_k / V of the Jacobian, averaged over plausible poses; see `PoseSpace`."""
        if self._origin is not None:
            return self._origin.domain_metrics
        every = max(1, self.topology.n_vertices // _METRIC_VERTICES)
        sample = self.topology.used_vertices[::every].astype(np.int64)
        led = self.vertex_domain[sample]
        moving = [np.flatnonzero(codes) for codes in self._codes_that_move_parts()]
        blocks = [np.zeros((len(codes), len(codes))) for codes in moving]
        for pose in self._plausible:
            moved = self.tangents(pose, sample)
            for domain, (codes, block) in enumerate(zip(moving, blocks, strict=True)):
                by_code = moved[np.ix_(codes, led == domain)].reshape(len(codes), -1)
                block += by_code @ by_code.T
        for block in blocks:
            block /= len(self._plausible) * len(sample)
        return DisplacementMetrics(len(self.low), moving, blocks)

    def _codes_that_move_parts(self) -> npt.NDArray[np.bool_]:
        """Return a (K, D) mask of the codes that move vertices led by each part."""
        by_part = np.zeros((self.n_domains, len(self._bones)), dtype=np.bool_)
        by_part[np.repeat(self.vertex_domain, np.diff(self._first)), self._joints] = True
        codes = np.zeros((self.n_domains, len(self.low)), dtype=np.bool_)
        codes[:, : len(self._place)] = (by_part @ self._carried)[:, self._bone_of_code]
        codes[self.domains_of_shapes, np.flatnonzero(self.are_shapes)] = True
        return codes

    @cached_property
    def _carried(self) -> npt.NDArray[np.bool_]:
        """(B, B) mask: row b holds bone b and its ancestors."""
        return ancestry(self._parents)

    @property
    def metric(self) -> FloatArray:
        """The sum of `domain_metrics`, slightly regularised on the diagonal."""
        return self.domain_metrics.definite

    @cached_property
    def precision(self) -> FloatArray:
        """Inverse covariance: the mean of one from the limits and one from the frames, if any."""
        covariance = np.diag((_SPREAD * (self.high - self.low)) ** 2)
        if len(self.frame_codes):
            frames = self.frame_codes
            covariance = 0.5 * covariance + 0.5 * frames.T @ frames / len(frames)
        return np.linalg.inv(covariance).astype(np.float64)

    @cached_property
    def longest_edges(self) -> FloatArray:
        """(E,) float64 array: the longest length of each edge in extreme poses, with slack.

        Skinning stretches edges at joints; the bound only prevents tears.
        """
        if self._origin is not None:
            at_rest = np.zeros(len(self.low))
            own_lengths, plain = (
                self.topology.edge_lengths(space.decode(at_rest[None])[0])
                for space in (self, self._origin)
            )
            return self._origin.longest_edges + np.maximum(own_lengths - plain, 0.0)
        extremes = np.concatenate([np.diag(self.low), np.diag(self.high)])
        longest = self.topology.edge_lengths(self.rest_vertices)
        for codes in np.concatenate([extremes, self._random(_STRETCH_POSES), self._plausible]):
            lengths = self.topology.edge_lengths(self.decode(codes[None])[0])
            np.maximum(longest, lengths, out=longest)
        # Joined seams may have edges of zero length.
        shortest = np.finfo(np.float64).eps * float(longest.max())
        return np.maximum(_STRETCH_SLACK * longest, shortest).astype(np.float64)

    @cached_property
    def surface_graph(self) -> scipy.sparse.csr_matrix:
        """(V, V) lengths of the edges in the reference."""
        return length_graph(self.topology.edges, self.rest_vertices)

    def codes_of(self, domains: Iterable[int]) -> npt.NDArray[np.bool_]:
        """Return a (D,) mask of body parts' codes; the root's part owns those of the whole body."""
        domain_list = list(domains)
        owner = np.repeat(np.arange(-1, self.n_domains), self.group_sizes)
        owned = np.zeros(len(self.low), dtype=np.bool_)
        owned[: len(owner)] = np.isin(owner, domain_list)
        owned[:ROOT_CODES] = self._root_part in domain_list
        return owned

    def codes_of_joints(self, joints: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """Return a (D,) mask of the codes of joints, given by their indices."""
        owned = np.zeros(len(self.low), dtype=np.bool_)
        owned[: len(self._place)] = np.isin(self._bones[self._bone_of_code], joints)
        return owned

    @cached_property
    def limbs(self) -> Limbs:
        """The tree of the joints that have codes; `Limbs.leads` are the heaviest influences."""
        n_bones = len(self._bones)
        leads = np.maximum(self._bone_of[self.rig.heaviest], 0)
        lengths, sizes = np.zeros(n_bones), np.ones(n_bones, dtype=np.int64)
        for bone in range(n_bones - 1, -1, -1):
            below = self._carried[:, bone]
            inside = self.rest_vertices[below[leads]] - self._bone_origins[bone]
            lengths[bone] = np.linalg.norm(inside, axis=1).max(initial=0.0)
            sizes[bone] = below.sum()
        # A short leaf bone, such as a twist or an eye, is not a limb.
        is_limb = (sizes > 1) | (lengths > LEAST_LIMB)
        counted = self._parents[is_limb & (self._parents >= 0)]
        limbs = Limbs(
            parents=self._parents,
            branches=np.bincount(counted, minlength=n_bones) > 1,
            lengths=lengths,
            leads=leads,
            owner=np.append(self._bone_of_code, np.full(self.n_shapes, -1)),
            is_relative=True,
        )
        stands = limbs.standing(self.rest_vertices, self.up, limbs.root)
        above = [set(limbs.path(top)[1:]) for top in stands]
        bases = set.intersection(*above) if above else set()
        if not (leads == 0).any():
            parts = self.part_of_joint[self._bones]
            bases |= set(np.flatnonzero((self._parents == 0) & (parts == self._root_part)).tolist())
        return replace(limbs, bases=frozenset(bases))

    def price(self, moved: FloatArray, held: Set[int], whole_body: bool) -> FloatArray:  # noqa: ARG002
        """Return the price of joint turns against their parents; see `posing.PoseSpace`.

        Children follow a joint at no cost. The whole body shifts for free, but hardly turns. A
        joint near the end of its limb costs more: a wrist, which moves little of the mesh, would
        otherwise bend to its limit before the elbow does.
        """
        others = _HELPING if whole_body else _RELUCTANT
        prices = np.where(self.limbs.codes_of(held), 1.0, others)
        prices[ROOT_CODES:] /= self.limbs.shares[self.limbs.owner[ROOT_CODES:]]
        prices[:SHIFTS], prices[SHIFTS:ROOT_CODES] = 0.0, _WHOLE_TURN
        return np.diag(_TURNED * prices)

    def _turns(self, codes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the (B, 3) turns of the bones in their axes, and the (3,) shift."""
        numbers = np.zeros(3 + 3 * len(self._bones))
        numbers[self._place] = codes[: len(self._place)]
        return numbers[3:].reshape(-1, 3), self.body_axes @ numbers[:3]

    def _by_codes(self, numbers: FloatArray) -> FloatArray:
        """Return (..., D) codes from (..., 3 + 3 B) shift and turns; those of shapes are 0."""
        codes = np.zeros((*numbers.shape[:-1], len(self.low)))
        codes[..., : len(self._place)] = numbers[..., self._place]
        return codes

    def _points_of(self, codes: FloatArray) -> FloatArray:
        """Return the (M, 3) influence points including the morph targets of a pose."""
        numbers, shapes = codes[len(self._place) :], self.rig.shapes
        if shapes is None or not numbers.any():
            return self._points
        # Drags and Resolve repeat the same shapes.
        of, last, points = self._shaped_points
        if of is not self._points or last != numbers.tobytes():
            points = self._points + shapes.offsets(numbers) / self.body_size
            self._shaped_points = self._points, numbers.tobytes(), points
        return points

    def _motions(self, codes: FloatArray) -> Motions:
        turns, shift = self._turns(codes)
        return rig_kernels.joint_motions(turns, shift, self._joint_frames)

    @property
    def _joint_frames(self) -> JointFrames:
        return (
            self._parents,
            self._bone_axes,
            self._bone_inverses,
            self._bone_origins,
            self._places,
            self._own,
            self._own_inverses,
        )

    @property
    def _influences(self) -> Influences:
        return self._first, self._joints, self._weights, self._points

    @cached_property
    def _everyone(self) -> npt.NDArray[np.int64]:
        return np.arange(self.topology.n_vertices)

    def _slopes(self, codes: FloatArray) -> FloatArray:
        turns, _ = self._turns(codes)
        return rig_kernels.rotation_slopes(turns, self._bone_axes, self._own)

    def _shaped(
        self, codes: FloatArray, influences: Influences, chosen: npt.NDArray[np.integer]
    ) -> Influences:
        """Return influences of chosen vertices including the pose blend shapes."""
        if self._shapes is None:
            return influences
        first, joints, weights, points = influences
        turns, _ = self._turns(codes)
        rotations = rig_kernels.local_rotations(turns, self._bone_axes, self._own)
        moved = self._shapes.offsets(rotations, chosen)
        return first, joints, weights, points + np.repeat(moved, np.diff(first), axis=0)

    def decode(self, codes: FloatArray) -> FloatArray:
        """Turn (B, D) codes into (B, V, 3) vertices, on the calling thread."""
        return self.decode_some(codes, self._everyone)

    def decode_some(self, codes: FloatArray, chosen: npt.NDArray[np.integer]) -> FloatArray:
        """Turn (B, D) codes into (B, n, 3) chosen vertices, identical to those of `decode`."""
        poses = np.asarray(codes, dtype=np.float64)
        turns, shifts = self._turns_of_poses(poses)
        vertices = np.empty((len(poses), len(chosen), 3))
        # Pose blend shapes differ per pose; morph targets may be the same in successive poses.
        shapes = poses[:, self.are_shapes]
        is_first = np.ones(len(poses), dtype=np.bool_)
        if self._shapes is None:
            is_first[1:] = (shapes[1:] != shapes[:-1]).any(axis=1)
        starts = np.flatnonzero(is_first).tolist()
        for start, end in pairwise([*starts, len(poses)]):
            influences = self._influences_of(chosen, poses[start])
            block, shaped = slice(start, end), self._shaped(poses[start], influences, chosen)
            at_rest, out = self._joint_frames, vertices[block]
            rig_kernels.skin_poses(turns[block], shifts[block], at_rest, shaped, out)
        return vertices

    def gpu_decoder(self, body_size: float) -> PosesOnGpu | None:
        """See `PoseSpace`; shapes stay at rest. Pose blend shapes run on the CPU only."""
        from lcollision_core.bodies.gpu_skinning import GpuSkin

        if self._shapes is not None:
            return None
        return GpuSkin(self._turns_of_poses, self._joint_frames, self._influences, body_size)

    def _turns_of_poses(self, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
        both = [self._turns(pose) for pose in poses]
        turns = np.array([turns for turns, _ in both]).reshape(len(poses), len(self._bones), 3)
        return turns, np.array([shift for _, shift in both]).reshape(len(poses), 3)

    def _influences_of(self, chosen: npt.NDArray[np.integer], codes: FloatArray) -> Influences:
        points = self._points_of(codes)
        if chosen is self._everyone:
            return self._first, self._joints, self._weights, points
        first, rows = self._rows_of(chosen)
        return first, self._joints[rows], self._weights[rows], points[rows]

    def _rows_of(self, chosen: npt.NDArray[np.integer]) -> tuple[IntArray, IntArray]:
        """Return the start of each chosen vertex's influences, and their rows among all."""
        counts = np.diff(self._first)[chosen]
        first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        rows = np.repeat(self._first[chosen] - first[:-1], counts) + np.arange(first[-1])
        return first, rows.astype(np.int32)

    def _pulled_to_shapes(
        self, by_vertices: FloatArray, chosen: npt.NDArray[np.integer], linear: FloatArray
    ) -> FloatArray:
        """Turn derivatives by chosen vertices, (m, n, 3), into those by shape codes, (m, S)."""
        if self.rig.shapes is None:
            return np.zeros((len(by_vertices), 0))
        used = np.flatnonzero(by_vertices.any(axis=(0, 2)))
        first, rows = self._rows_of(chosen[used])
        columns = by_vertices[:, np.repeat(used, np.diff(first))]
        by_points = np.einsum("nma,mab->nmb", columns, linear[self._joints[rows]])
        by_points *= self._weights[rows, None] / self.body_size
        deltas = self.rig.shapes.by_row[(3 * rows[:, None] + np.arange(3)).ravel()]
        by_shapes: FloatArray = (deltas.T @ by_points.reshape(len(columns), 3 * len(rows)).T).T
        return by_shapes

    def pull_back(self, codes: FloatArray, by_vertices: FloatArray) -> FloatArray:
        """Turn derivatives by one pose's vertices, (n, V, 3), into those by its codes, (n, D)."""
        return self._pulled_back(codes, by_vertices, self._everyone, by_shapes=True)

    def _pulled_back(
        self,
        codes: FloatArray,
        by_vertices: FloatArray,
        chosen: npt.NDArray[np.int64],
        influences: Influences | None = None,
        *,
        by_shapes: bool = False,
    ) -> FloatArray:
        given, motions = np.ascontiguousarray(by_vertices, dtype=np.float64), self._motions(codes)
        if self._shapes is not None:
            # Shaping a vertex costs more than everything else.
            used = np.flatnonzero(given.any(axis=(0, 2)))
            given, chosen = np.ascontiguousarray(given[:, used]), chosen[used]
            influences = None
        if influences is None or self.n_shapes:
            influences = self._influences_of(chosen, codes)
        influences = self._shaped(codes, influences, chosen)
        by_turns, by_shift = rig_kernels.pull_back_moments(
            given, influences, self._parents, motions
        )
        if self._shapes is not None:
            slopes = self._slopes(codes)
            by_turns += self._shapes.pull_back(slopes, given, chosen, influences, motions[0])
        by_numbers = np.concatenate(
            [by_shift @ self.body_axes, by_turns.reshape(len(by_shift), 3 * len(self._bones))],
            axis=1,
        )
        by_codes = self._by_codes(by_numbers)
        if by_shapes:
            by_codes[:, self.are_shapes] = self._pulled_to_shapes(given, chosen, motions[0])
        return by_codes

    def tangents(self, codes: FloatArray, chosen: npt.NDArray[np.int64]) -> FloatArray:
        """Return the derivatives of (n,) vertices of a (D,) pose by its codes: (D, n, 3)."""
        motions = self._motions(codes)
        influences = self._shaped(codes, self._influences_of(chosen, codes), chosen)
        turned = rig_kernels.tangents(np.arange(len(chosen)), influences, self._parents, motions)
        if self._shapes is not None:
            slopes = self._slopes(codes)
            turned += self._shapes.tangents(slopes, chosen, influences, motions[0])
        shifted = np.broadcast_to(self.body_axes.T[:, None], (3, len(chosen), 3))
        moved = np.concatenate([shifted, turned.reshape(-1, len(chosen), 3)])
        return np.concatenate([moved[self._place], self._moved_by_shapes(chosen, motions[0])])

    def _moved_by_shapes(self, chosen: npt.NDArray[np.integer], linear: FloatArray) -> FloatArray:
        """Return derivatives of (n,) vertices by shape codes, for linear bone maps: (S, n, 3)."""
        if self.rig.shapes is None or not len(chosen):
            return np.zeros((self.n_shapes, len(chosen), 3))
        first, rows = self._rows_of(chosen)
        turned = linear[self._joints[rows]] * (self._weights[rows] / self.body_size)[:, None, None]
        deltas = self.rig.shapes.by_row[(3 * rows[:, None] + np.arange(3)).ravel()].toarray()
        moved = np.einsum("mab,mbs->sma", turned, deltas.reshape(len(rows), 3, self.n_shapes))
        by_shapes: FloatArray = np.add.reduceat(moved, first[:-1], axis=1)
        return by_shapes

    def mean_slopes(
        self, weights: scipy.sparse.csr_matrix
    ) -> Callable[[FloatArray, FloatArray], FloatArray]:
        """Prepare the derivatives of patches' means by the codes; see `posing.PoseSpace`.

        Straight elbows and knees count as slightly bent: to first order, bending a straight limb
        does not shorten it, so a hand pulled to the shoulder would move any other way. Drags
        leave the shapes: derivatives by them are 0.

        Parameters
        ----------
        weights : (m, V) of the patches' means
        """
        # Only the vertices of the patches count.
        used_vertices = np.unique(weights.indices)
        means = weights[:, used_vertices].toarray()[:, None, :, None] * np.eye(3)[:, None]
        means = means.reshape(-1, len(used_vertices), 3)
        influences = self._influences_of(used_vertices, np.zeros(len(self.low)))

        def slopes(codes: FloatArray, by_vertices: FloatArray) -> FloatArray:
            bent = np.array(codes, dtype=np.float64)
            bent[self._hinges] = np.maximum(bent[self._hinges], _LEAST_BEND)
            pulled = self._pulled_back(bent, means, used_vertices.astype(np.int64), influences)
            others = self._pulled_back(codes, by_vertices, self._everyone)
            return np.concatenate([pulled, others])

        return slopes

    def shifted(self, codes: FloatArray, way: FloatArray) -> FloatArray:
        """Move the whole body of (D,) codes by a (3,) normalised displacement."""
        moved: FloatArray = codes.copy()
        moved[:SHIFTS] += way @ self.body_axes
        return moved

    def transforms(self, codes: FloatArray) -> FloatArray:
        """Return the joints' global transforms in a (D,) pose: (J, 4, 4), as in `Rig.rest`."""
        linear, translations, _, _ = self._motions(np.asarray(codes, dtype=np.float64))
        moved = np.broadcast_to(np.eye(4), (self.n_joints, 4, 4)).copy()
        carried = self._bone_of >= 0
        moved[carried, :3, :3] = linear[self._bone_of[carried]]
        moved[carried, :3, 3] = translations[self._bone_of[carried]] * self.body_size
        return moved @ self.rig.rest

    def codes_of_transforms(
        self, transforms: npt.ArrayLike, shapes: FloatArray | None = None
    ) -> FloatArray:
        """Find the codes that reproduce the turns of given joint transforms.

        Codes cannot express scale, shear or shift of joints, nor turns about axes that a joint
        lacks; compare `decode` with `skinned`.

        Parameters
        ----------
        transforms : (J, 4, 4) or (N, J, 4, 4) finite array of global transforms, as in `Rig.rest`
        shapes : (S,) or (N, S) morph target weights; at rest if None

        Returns
        -------
        codes : (D,) or (N, D) float64 array; some may lie beyond the bounds

        Raises
        ------
        ShapeError : wrong shape, or a number that is not finite.
        """
        given = self._checked(transforms)
        poses = given.reshape(-1, self.n_joints, 4, 4)
        moved = poses @ np.linalg.inv(self.rig.rest)
        numbers = np.zeros((len(poses), 3 + 3 * len(self._bones)))
        is_held = np.zeros(numbers.shape[1], dtype=np.bool_)
        is_held[self._place] = True
        linear = np.empty((len(poses), len(self._bones), 3, 3))
        for bone, joint in enumerate(self._bones.tolist()):
            parent, axes = self._parents[bone], self._bone_axes[bone]
            before = axes if parent < 0 else linear[:, parent] @ axes
            # A virtual root does not move.
            parent_axes = moved[:, joint, :3, :3] if joint >= 0 else np.eye(3)[None]
            if joint >= 0 and parent >= 0:
                # A joint hidden by its scale follows its parent.
                is_hidden = np.linalg.norm(parent_axes, axis=1).min(axis=1) < _HIDDEN
                parent_axes = np.where(is_hidden[:, None, None], linear[:, parent], parent_axes)
            local = _nearest_rotations(np.linalg.inv(before) @ parent_axes @ axes)
            places = slice(3 + 3 * bone, 6 + 3 * bone)
            numbers[:, places] = np.where(is_held[places], rotation_vectors(local), 0.0)
            turned = from_rotation_vectors(numbers[:, places])
            linear[:, bone] = before @ turned @ self._bone_inverses[bone]
        if self._bones[0] >= 0:
            origin = self._bone_origins[0]
            place = moved[:, self._bones[0]] @ np.append(origin * self.body_size, 1.0)
            numbers[:, :3] = (place[:, :3] / self.body_size - origin) @ self.body_axes
        codes = self._by_codes(numbers)
        if shapes is not None:
            codes[:, self.are_shapes] = shapes
        return codes if given.ndim == 4 else codes[0]

    def codes_of_rotations(self, turns: FloatArray, shifts: FloatArray) -> FloatArray:
        """Return the (N, D) codes of joint turns; turns of joints without codes are lost.

        Parameters
        ----------
        turns : (N, J, 3) rotation vectors of the joints against their parents, in the character's
            axes
        shifts : (N, 3) of the root, in the character's unit
        """
        numbers = np.empty((len(turns), 3 + 3 * len(self._bones)))
        numbers[:, :3] = shifts @ self.body_axes / self.body_size
        angles = np.einsum("bxi,nbx->nbi", self._bone_axes, turns[:, self._bones])
        numbers[:, 3:] = angles.reshape(len(turns), -1)
        return self._by_codes(numbers)

    def rotations_of(self, codes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the turns and the shift of a pose, (J, 3) and (3,): see `codes_of_rotations`."""
        turns, shift = self._turns(codes)
        of_joints = np.zeros((self.n_joints, 3))
        of_joints[self._bones] = np.einsum("bxi,bi->bx", self._bone_axes, turns)
        return of_joints, shift * self.body_size

    def unwound(self, codes: FloatArray) -> FloatArray:
        """Return (N, D) codes of a motion with continuous turns from frame to frame.

        Full turns added to the rotation vector of a ball joint give the same pose: choose those
        nearest to the frame before.
        """
        joints = self.joint_of_code[SHIFTS:]
        turned = [SHIFTS + np.flatnonzero(joints == joint) for joint in np.unique(joints)]
        free = [codes_of_one for codes_of_one in turned if len(codes_of_one) == 3]
        free_codes = np.array(free, dtype=np.int64).reshape(-1, 3)
        unwound = codes.copy()
        for at in range(1, len(codes)):
            unwound[at, free_codes] = nearest_winding(
                unwound[at, free_codes], unwound[at - 1, free_codes]
            )
        return unwound

    def holding(
        self, name: str, topology: Topology, points: FloatArray, joint: int
    ) -> RigPoseSpace:
        """Return the same poses of a body that holds a prop, which moves with a joint.

        Parameters
        ----------
        name : of the prop, which becomes a further part without codes
        topology : of the body, followed by the prop
        points : (n, 3) vertices of the prop in the rest pose, in the character's unit
        joint : its index in the rig
        """
        rig, shape = self.rig, (len(points), self.rig.joint_of.shape[1])
        weights = np.zeros(shape)
        weights[:, 0] = 1.0
        holder = replace(
            rig,
            joint_of=np.concatenate([rig.joint_of, np.full(shape, joint, dtype=np.int32)]),
            weights=np.concatenate([rig.weights, weights]),
            points=np.concatenate([rig.points, np.repeat(points[:, None], shape[1], axis=1)]),
        )
        if rig.shapes is not None:
            deltas = rig.shapes.deltas.copy()
            deltas.resize(deltas.shape[0] + 3 * len(points), deltas.shape[1])
            holder = replace(holder, shapes=replace(rig.shapes, deltas=deltas))
        if rig.pose_shapes is not None:
            still = np.zeros((len(points), *rig.pose_shapes.shape[1:]), dtype=np.float32)
            holder = replace(holder, pose_shapes=np.concatenate([rig.pose_shapes, still]))
        other = copy(self)
        for name, value in vars(type(self)).items():
            if isinstance(value, cached_property):
                other.__dict__.pop(name, None)
        other.rig, other.topology = holder, topology
        other.rest_vertices = np.concatenate([self.rest_vertices, points / self.body_size])
        other._set_influences(holder)
        other.part_names, other.group_sizes = (*self.part_names, name), (*self.group_sizes, 0)
        part = np.full(len(points), len(self.part_names))
        other.vertex_domain = np.concatenate([self.vertex_domain, part])
        return other

    def _copy(self) -> RigPoseSpace:
        """Return a copy whose body can be given another shape."""
        other = copy(self)
        other.__dict__.pop("longest_edges", None)
        other._origin = self._origin or self
        return other

    def joint_offsets(self, codes: FloatArray, transforms: npt.ArrayLike) -> JointOffsets:
        """Return the scales and offsets of joints in (N, D) poses that codes do not express.

        Parameters
        ----------
        transforms : (N, J, 4, 4) finite array of global transforms, as in `Rig.rest`

        Raises
        ------
        ShapeError : wrong shape, or a number that is not finite.
        """
        moved = (
            self._checked(transforms)[:, self._bones] @ np.linalg.inv(self.rig.rest)[self._bones]
        )
        if self._bones[0] < 0:
            moved[:, 0] = np.eye(4)
        linear, origins = moved[..., :3, :3], self._bone_origins
        places = (linear @ origins[:, :, None])[..., 0] + moved[..., :3, 3] / self.body_size
        back, above = np.broadcast_to(np.eye(3), linear.shape).copy(), moved[:, self._parents]
        back[:, 1:] = _inverses(linear)[:, self._parents[1:]]
        offsets = places - above[..., :3, 3] / self.body_size
        offsets[:, 0] = places[:, 0]
        numbers = np.zeros((len(codes), 3 + 3 * len(self._bones)))
        numbers[:, self._place] = codes[:, : len(self._place)]
        offsets[:, 0] -= numbers[:, :3] @ self.body_axes.T
        turned = from_rotation_vectors(numbers[:, 3:].reshape(-1, 3))
        turned = turned.reshape(linear.shape)
        return JointOffsets(
            (back @ offsets[..., None])[..., 0] - origins,
            np.swapaxes(turned, 2, 3) @ self._bone_inverses @ back @ linear,
        )

    def with_joint_offsets(
        self, offsets: FloatArray, linear: FloatArray, points: FloatArray | None = None
    ) -> RigPoseSpace:
        """Return the same poses of a body with another scale, stretch or shape at rest.

        Parameters
        ----------
        offsets, linear : of one pose, see `JointOffsets`
        points : (M, 3) as from `influence_points`; by default the body's own
        """
        other = self._copy()
        other._places = self._bone_origins + offsets
        other._own = np.ascontiguousarray(linear)
        other._own_inverses = _inverses(other._own)
        if points is not None:
            other._points = points
        return other

    def interpolated(self, other: RigPoseSpace, share: float) -> RigPoseSpace:
        """Return the poses of a body interpolated towards another one by a share."""

        def between(one: FloatArray, another: FloatArray) -> FloatArray:
            return one if one is another else (1.0 - share) * one + share * another

        return self.with_joint_offsets(
            between(self._places, other._places) - self._bone_origins,
            between(self._own, other._own),
            between(self._points, other._points),
        )

    def shaped_as(self, codes: FloatArray, vertices: FloatArray) -> RigPoseSpace:
        """Return the same poses of a body shaped so that a pose has given vertices.

        The difference moves with the joints, as muscles do: each joint carries it in its local
        frame, by the least change of the influence points.

        Parameters
        ----------
        codes : (D,) of the pose
        vertices : (V, 3) float64 array, normalised
        """
        linear = self._motions(codes)[0]
        # Weights sum to 1 and the maps are nearly rotations, so the matrices are well-conditioned.
        squared = (linear @ np.swapaxes(linear, 1, 2))[self._joints] * self._weights[:, None, None]
        gram = np.add.reduceat(squared, self._first[:-1]) + _TINY * np.eye(3)
        missing = np.linalg.solve(gram, (vertices - self.decode(codes[None])[0])[:, :, None])
        missing = np.repeat(missing, np.diff(self._first), axis=0)
        rest_offsets = np.swapaxes(linear, 1, 2)[self._joints] @ missing
        other = self._copy()
        other._points = np.ascontiguousarray(self._points + rest_offsets[:, :, 0])
        return other

    def skinned(self, transforms: npt.ArrayLike) -> FloatArray:
        """Return the normalised (V, 3) vertices for (J, 4, 4) global transforms.

        Raises
        ------
        ShapeError : wrong shape, or a number that is not finite.
        """
        moved = (self._checked(transforms) @ np.linalg.inv(self.rig.rest))[self._bones]
        linear = np.ascontiguousarray(moved[:, :3, :3])
        first, joints, weights, points = self._influences
        if self._shapes is not None:
            local = np.linalg.inv(linear[self._parents]) @ linear
            offsets = self._shapes.offsets(local, self._everyone)
            points = points + np.repeat(offsets, np.diff(first), axis=0)
        vertices = np.empty((len(first) - 1, 3))
        influences = (first, joints, weights, points)
        rig_kernels.skin(linear, moved[:, :3, 3] / self.body_size, influences, vertices)
        return vertices

    def _checked(self, transforms: npt.ArrayLike) -> FloatArray:
        given = np.asarray(transforms, dtype=np.float64)
        if given.ndim not in (3, 4) or given.shape[-3:] != (self.n_joints, 4, 4):
            raise ShapeError.must_be(
                "transforms of a rig", f"({self.n_joints}, 4, 4) a pose", f"shape {given.shape}"
            )
        if not np.isfinite(given).all():
            raise ShapeError("transforms of a rig have a number that is not finite")
        return given


def _inverses(matrices: FloatArray) -> FloatArray:
    """Return the inverses of (..., 3, 3) matrices, pseudo-inverses of singular ones."""
    flat = np.abs(np.linalg.det(matrices)) < _TINY
    inverses = np.linalg.inv(np.where(flat[..., None, None], np.eye(3), matrices))
    inverses[flat] = np.linalg.pinv(matrices[flat])
    return inverses.astype(np.float64)


def _nearest_rotations(matrices: FloatArray) -> FloatArray:
    """Return the rotations nearest to (N, 3, 3) matrices of successive frames.

    Mirrored ones are all mirrored back along the same direction, as the nearest one may jump.
    """
    mirrored = np.flatnonzero(np.linalg.det(matrices) < 0.0)
    if len(mirrored):
        first = matrices[mirrored[0]]
        _, scales, right = np.linalg.svd(first)
        is_flat = scales[2] < 0.5 * scales[1]
        way = right[2] if is_flat else np.linalg.eigh(first + first.T).eigenvectors[:, 0]
        matrices = matrices.copy()
        matrices[mirrored] -= 2.0 * (matrices[mirrored] @ way)[:, :, None] * way
    left, _, right = np.linalg.svd(matrices)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    rotations: FloatArray = left @ right
    return rotations
