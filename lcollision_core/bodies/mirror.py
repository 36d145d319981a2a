"""Left-right symmetry of a body, and mirrored poses."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.files.scene.transforms import from_rotation_vectors
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import RigidTransform, Topology
from lcollision_core.meshes.joint_kinds import Role, Side
from lcollision_core.meshes.topology import FloatArray, sorted_faces

if TYPE_CHECKING:
    from lcollision_core.bodies.rig_space import RigPoseSpace
    from lcollision_core.posing import ExactCheck, Pin
    from lcollision_core.resolve import ResolveOptions, ResolveResult


_TOLERANCE = 1e-3
"""Normalised: largest distance of a vertex from its partner's mirror image in a symmetric mesh."""

_NEAR, _MOST = 0.01, 0.7
"""Limits for other meshes: that distance, and the least share of vertices within it."""

_STEPS = 4
"""Iterations that find the plane of an asymmetric mesh."""


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The symmetry plane of a mesh, and each vertex's counterpart on the other side.

    Attributes
    ----------
    partner : (V,) int32 array, read-only, each vertex's mirror image: an involution if the mesh is
        symmetric, else the vertex nearest to the image
    normal : (3,) float64 unit vector, from one side to the other
    offset : of the plane along the normal, in the mesh's unit
    """

    partner: npt.NDArray[np.int32]
    normal: FloatArray
    offset: float

    @cached_property
    def flip(self) -> FloatArray:
        """(4, 4) reflection in the plane."""
        flip = np.eye(4)
        flip[:3, :3] -= 2.0 * np.outer(self.normal, self.normal)
        flip[:3, 3] = 2.0 * self.offset * self.normal
        return flip

    def reflect(self, points: npt.ArrayLike) -> FloatArray:
        """Return the mirror images of (..., 3) points."""
        image: FloatArray = np.asarray(points) @ self.flip[:3, :3] + self.flip[:3, 3]
        return image

    def mirror_vertices(self, vertices: npt.NDArray[Any]) -> FloatArray:
        """Reflect (V, 3) vertices and permute them by `partner`: (V, 3)."""
        return self.reflect(np.asarray(vertices, dtype=np.float64)[self.partner])

    def image_of_placement(self, placement: RigidTransform) -> RigidTransform:
        """Return the rigid motion from a mesh's mirror image to that of the placed mesh."""
        flip, shift = self.flip[:3, :3], self.flip[:3, 3]
        moved = self.reflect(placement.apply(shift))
        return RigidTransform(flip @ placement.rotation @ flip, moved, placement.scale)

    def mirror_pin(self, pin: Pin) -> Pin:
        """Return the pin on the partner's patch at the mirrored position."""

        def image(place: tuple[float, float, float]) -> tuple[float, float, float]:
            x, y, z = self.reflect(place).tolist()
            return x, y, z

        return replace(
            pin,
            vertex=int(self.partner[pin.vertex]),
            position=image(pin.position),
            frame=tuple((int(self.partner[at]), image(place)) for at, place in pin.frame),
        )


@dataclass(frozen=True, eq=False)
class MirrorSource:
    """The pose that a mirrored pose was made from.

    Attributes
    ----------
    latent : (D,) float64 array
    placement : where the decoded pose belongs, None for the model's own coordinates
    image : fingerprint of the mirrored pose; any other pose has another source
    """

    latent: FloatArray
    placement: RigidTransform | None
    image: str

    def is_of(self, latent: npt.NDArray[Any], placement: RigidTransform | None) -> bool:
        """Whether a pose is the mirrored pose, bit for bit."""
        return self.image == fingerprint_of_pose(latent, placement)


@dataclass(frozen=True, eq=False)
class MirroredPose:
    """A pose with left and right exchanged. Lengths are normalised.

    Attributes
    ----------
    latent : (D,) float64 array
    placement : where the decoded pose belongs, None for the model's own coordinates
    fit_error_mean, fit_error_max : distance of the decoded vertices from the exact mirror image
    restored : whether this is the pose that the given one was mirrored from, bit for bit
    pairs_before : colliding pairs of faces of the given pose, by the exact check
    pairs_mirrored : of the pose nearest to the mirror image
    pairs_after : of this pose
    resolution : the Resolve of collisions that mirroring caused, None if none was needed
    source : the given pose
    """

    latent: FloatArray
    placement: RigidTransform | None
    fit_error_mean: float
    fit_error_max: float
    restored: bool
    pairs_before: int
    pairs_mirrored: int
    pairs_after: int
    resolution: ResolveResult | None
    source: MirrorSource

    @property
    def collides_newly(self) -> bool:
        """Whether a collision-free pose became a colliding one."""
        return self.pairs_before == 0 < self.pairs_after


def pose_bytes(latent: npt.NDArray[Any], placement: RigidTransform | None) -> bytes:
    """Return bytes that are equal only for equal poses with equal placements.

    Parameters
    ----------
    latent : (D,) array
    placement : None for the model's own coordinates
    """
    arrays: list[npt.ArrayLike] = [latent]
    if placement is not None:
        arrays += [placement.rotation, placement.translation]
        if placement.scale != 1.0:
            arrays.append(placement.scale)
    return b"".join(np.asarray(array, dtype="<f8").tobytes() for array in arrays)


def fingerprint_of_pose(latent: npt.NDArray[Any], placement: RigidTransform | None) -> str:
    """Return 16 hexadecimal digits that identify a pose and its placement exactly."""
    return hashlib.sha256(pose_bytes(latent, placement)).hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class PoseMirror:
    """Mirrors the poses of one body; immutable and thread-safe.

    Attributes
    ----------
    attention_mask : (K, V) float32 array
    symmetry : of the mesh, in the body's unit
    check : the exact check of the body's poses
    nearest : finds the codes of (V, 3) normalised vertices, in place
    resolve : `Body.resolve`, for collisions that mirroring causes; None leaves them
    """

    attention_mask: npt.NDArray[np.float32]
    symmetry: Symmetry
    check: ExactCheck
    nearest: Callable[[FloatArray, Job], FloatArray]
    resolve: Callable[..., ResolveResult] | None

    def mirror(
        self,
        latent: npt.NDArray[Any],
        placement: RigidTransform | None = None,
        source: MirrorSource | None = None,
        options: ResolveOptions | None = None,
        job: Job = UNWATCHED,
    ) -> MirroredPose:
        """Find the pose nearest to the mirror image of a pose, with the mirrored placement.

        The plane is the reference's, for a placed pose too. A mirrored pose that collides is
        resolved if the given pose is collision-free.

        Parameters
        ----------
        latent : (D,) finite array
        placement : where the decoded pose belongs, None for the model's own coordinates
        source : what the pose was mirrored from, or None; if the pose is still that mirror image,
            the source itself is returned
        options : of the Resolve; its locked domains keep their mirrored codes
        job : reports (Resolve steps done, all steps); polled between the steps

        Raises
        ------
        ShapeError, LCollisionError, CancelledError : as in `Body.resolve`.
        """
        pose, size = np.array(latent, dtype=np.float64), self.check.body_size
        check = replace(self.check, placement=placement)
        decoded = check.decode(pose)[0]
        pairs_before = len(check.find(check.exported(decoded)).pairs)
        image = self.symmetry.mirror_vertices(decoded * size) / size
        image_placement = None if placement is None else self.symmetry.image_of_placement(placement)
        restored = source is not None and source.is_of(pose, placement)
        if source is not None and restored:
            image_latent, image_placement = source.latent, source.placement
        else:
            # The placement stays fixed: a fitted rigid motion would have to be undone, and the
            # codes represent it nearly as well.
            image_latent = self.codes_of_image(pose, image, job)
        check = replace(check, placement=image_placement)
        mirrored = check.decode(image_latent)[0]
        pairs_mirrored = pairs_after = len(check.find(check.exported(mirrored)).pairs)
        resolution = None
        if not restored and pairs_before == 0 < pairs_mirrored and self.resolve is not None:
            resolution = self.resolve(image_latent, options, job, image_placement)
            if resolution.exactly_free:
                image_latent, pairs_after = resolution.latent, 0
                mirrored = check.decode(image_latent)[0]
        distances = self.misfit(pose, image_latent, mirrored - image)
        return MirroredPose(
            latent=image_latent,
            placement=image_placement,
            fit_error_mean=float(distances.mean()),
            fit_error_max=float(distances.max()),
            restored=restored,
            pairs_before=pairs_before,
            pairs_mirrored=pairs_mirrored,
            pairs_after=pairs_after,
            resolution=resolution,
            source=MirrorSource(
                pose, placement, fingerprint_of_pose(image_latent, image_placement)
            ),
        )

    def misfit(
        self,
        latent: FloatArray,  # noqa: ARG002 - used by `RigMirror`
        mirrored: FloatArray,  # noqa: ARG002
        off: FloatArray,
    ) -> FloatArray:
        """Return the (n,) normalised distances of a mirrored pose's points from the mirror image.

        Parameters
        ----------
        latent, mirrored : (D,) codes of a pose and of its mirrored pose
        off : (V, 3) offsets from the mirror image's vertices to the mirrored pose's
        """
        distances: FloatArray = np.linalg.norm(off[self.check.space.topology.used_index], axis=1)
        return distances

    def codes_of_image(
        self,
        latent: FloatArray,  # noqa: ARG002 - used by `RigMirror`
        image: FloatArray,
        job: Job,
    ) -> FloatArray:
        """Return the (D,) codes of a pose's mirror image, given the image's (V, 3) vertices."""
        return self.nearest(image, job)

    def partner(self, domain: int) -> int | None:
        """Return the domain on the other side; None if it is in the middle or has no match."""
        mask = self.attention_mask

        def image(of: int) -> int:
            return int((mask @ mask[of, self.symmetry.partner]).argmax())

        other = image(domain)
        return other if other != domain == image(other) else None

    def mirror_part(
        self,
        latent: npt.NDArray[Any],
        domain: int,
        job: Job = UNWATCHED,
    ) -> FloatArray:
        """Give the domain on the other side its codes from the mirror image.

        All other codes stay. As neighbouring domains share their borders, the other side only
        approximates the mirror image.

        Parameters
        ----------
        latent : (D,) finite array
        domain : one that has a `partner`

        Returns
        -------
        latent : (D,) float64 array
        """
        size = self.check.body_size
        image = self.symmetry.mirror_vertices(self.check.decode(latent)[0] * size) / size
        mirrored = self.codes_of_image(latent, image, job)
        other = self.partner(domain)
        other_codes = self.check.space.codes_of([] if other is None else [other])
        return np.where(other_codes, mirrored, latent)


def find_symmetry(reference: npt.NDArray[Any], topology: Topology, up_axis: int) -> Symmetry | None:
    """Find each vertex's partner on the other side of a mesh.

    Where the mesh is its own mirror image, faces map onto faces. Otherwise, as with a sword in
    one hand or armour on one shoulder, a vertex's partner is the vertex nearest to its image, and
    most vertices must have a near one.

    Parameters
    ----------
    reference : (V, 3) array, a pose whose limbs lie symmetrically
    topology : of the mesh; vertices that no face uses are their own partners
    up_axis : 0, 1 or 2; left and right are along one of the other two

    Returns
    -------
    symmetry : None if there is none
    """
    used, faces = topology.used_vertices, topology.faces
    vertices = np.asarray(reference, dtype=np.float64)[used]
    size = float(np.ptp(vertices, axis=0).max())
    tree = scipy.spatial.cKDTree(vertices)
    everyone = np.arange(len(vertices), dtype=np.int32)
    best: tuple[float, Symmetry] | None = None
    for axis in (axis for axis in range(3) if axis != up_axis):
        across = vertices[:, axis]
        for offset in (0.5 * (across.min() + across.max()), np.median(across)):
            for _ in range(_STEPS):
                plane = Symmetry(everyone, np.eye(3)[axis], float(offset))
                distance, nearest = tree.query(plane.reflect(vertices))
                partner = np.arange(topology.n_vertices, dtype=np.int32)
                partner[used] = used[nearest]
                partner.flags.writeable = False
                symmetry = replace(plane, partner=partner)
                is_exchange = (
                    distance.max() < _TOLERANCE * size and (nearest[nearest] == everyone).all()
                )
                if is_exchange and np.array_equal(
                    sorted_faces(partner[faces[:, ::-1]]), sorted_faces(faces)
                ):
                    return symmetry
                share = float((distance < _NEAR * size).mean())
                if share >= _MOST and (best is None or share > best[0]):
                    best = share, symmetry
                # Correct for parts on one side only, which had shifted the plane.
                offset = np.median(0.5 * (across + across[nearest]))
    return None if best is None else best[1]


_JOINT_TOLERANCE = 0.02
"""Normalised: largest distance of a joint from its partner's image if names do not match."""

_NEARER = 1e-4
"""Normalised distance that adjacent roles add between joints in one position."""

_ALONG_AXIS = 0.99
"""Cosine above which the direction from right to left counts as an axis."""

_ALIKE = np.radians(10.0)
"""Largest angle between a bone at rest and its partner's mirror image."""

_MIDDLE = {Role.SPINE, Role.NECK, Role.HEAD}
_LOOSE = {Role.OTHER, Role.FACE}

_SIDES = (
    *(("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("左", "右")),
    *(("links", "rechts"), ("gauche", "droite"), ("izquierda", "derecha")),
)
"""Words for the sides, anywhere in a name."""

_SHORT_SIDES = (("l", "r"), ("lf", "rt"), ("lt", "rt"), ("lft", "rgt"))
"""Abbreviations, which stand alone: "arm.L", "l_arm", "ArmL", "lArm", "Bip01 L Arm"."""


@dataclass(frozen=True, eq=False)
class JointSides:
    """Left and right of a rig. Lengths are normalised.

    Attributes
    ----------
    partner : (J,) each joint's mirror image, an involution; -1 for a joint without one, such as a
        sword's, which keeps its rotation
    normal : (3,) unit vector, from one side to the other
    offset : of the plane between them along the normal
    between : (J, 3, 3) rotation at rest from the partner's mirror image to the joint: the identity
        unless the rest pose is asymmetric, as with one arm raised
    """

    partner: npt.NDArray[np.intp]
    normal: FloatArray
    offset: float
    between: FloatArray


def named_pairs(names: Sequence[str]) -> npt.NDArray[np.intp]:
    """Return the (n, 2) left and right joints or shapes whose names differ only in the side."""
    number = {name: joint for joint, name in enumerate(names)}
    pairs = []
    for joint, name in enumerate(names):
        partners = (
            partner for partner in _on_the_right(name) if partner != name and partner in number
        )
        other = next(partners, None)
        if other is not None:
            # A name belongs to one pair.
            pairs.append((joint, number.pop(other)))
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def _on_the_right(name: str) -> list[str]:
    """Return possible names on the right for a joint on the left."""
    names = [name.replace(left, right) for left, right in _SIDES]
    for left, right in _SHORT_SIDES:
        for a, b in ((left, right), (left.capitalize(), right.capitalize())):
            names.append(re.sub(rf"(?<![A-Za-z]){a}(?=[A-Z][a-z]|[^A-Za-z]|$)", b, name))
        a, b = left.upper(), right.upper()
        names.append(re.sub(rf"(?<![A-Z]){a}(?![A-Za-z])", b, name))
    return names


def find_joint_sides(space: RigPoseSpace) -> JointSides | None:
    """Find each joint's partner on the other side, by name, else by position at rest.

    The plane between the sides is the median of the joints of spine, neck and head, else of the
    pairs, else of all joints, so that a sword or a plait does not move it.

    Returns
    -------
    sides : None if no joint has a partner and some joint lies off the plane
    """
    pairs = named_pairs(space.rig.joint_names)
    normal = _normal(space, pairs)
    counted = np.unique(space.joint_of_code[space.joint_of_code >= 0])
    across = space.origins @ normal
    in_middle = [joint for joint in counted if space.roles[joint] in _MIDDLE]
    in_middle = [joint for joint in in_middle if joint not in pairs] or in_middle
    of_pairs = across[pairs].mean(axis=1) if len(pairs) else across[counted]
    offset = float(np.median(across[in_middle] if in_middle else of_pairs))
    partner = np.full(space.n_joints, -1)
    partner[pairs[:, 0]], partner[pairs[:, 1]] = pairs[:, 1], pairs[:, 0]
    others = counted[partner[counted] < 0]
    if len(others):
        partners = _by_place(space, others, normal, offset)
        partner[others[partners >= 0]] = others[partners[partners >= 0]]
        for left, right in _by_role(space, others[partners < 0]):
            partner[left], partner[right] = right, left
    has_pairs = bool((partner != np.arange(len(partner)))[partner >= 0].any())
    carries = partner >= 0
    for joint in range(space.n_joints - 1, 0, -1):
        carries[space.rig.parents[joint]] |= carries[joint] and space.rig.parents[joint] >= 0
    alone = partner < 0
    if not has_pairs and alone[counted].any():
        return None
    # Joints that carry both sides lie in the middle.
    in_trunk = np.isin(np.arange(space.n_joints), in_middle) | carries
    partner[alone & in_trunk] = np.flatnonzero(alone & in_trunk)
    between = _between(space, partner, normal)
    return JointSides(partner, normal, offset, between)


def _normal(space: RigPoseSpace, pairs: npt.NDArray[np.intp]) -> FloatArray:
    """Return the unit vector from right to left, snapped to an axis if nearly along it."""
    left = np.cross(space.up, space.front)
    ways = space.origins[pairs[:, 0]] - space.origins[pairs[:, 1]]
    way = ways.sum(axis=0)
    way -= (way @ space.up) * space.up
    length = float(np.linalg.norm(way))
    normal: FloatArray = way / length if length > _JOINT_TOLERANCE else left
    axis = int(np.abs(normal).argmax())
    is_axis = length <= _JOINT_TOLERANCE or abs(normal[axis]) > _ALONG_AXIS
    return np.eye(3)[axis] if is_axis else normal


def _by_place(
    space: RigPoseSpace, joints: npt.NDArray[np.intp], normal: FloatArray, offset: float
) -> npt.NDArray[np.intp]:
    """Return the index, among the given joints, of each one's mirror image; -1 for none."""
    # Of two joints in one position, such as a hand and its prop, prefer the one of the same role.
    kinds = [list(Role).index(space.roles[joint]) for joint in joints]
    places = np.column_stack([space.origins[joints], _NEARER * np.array(kinds)])
    image = places.copy()
    image[:, :3] -= 2.0 * np.outer(space.origins[joints] @ normal - offset, normal)
    distance, nearest = scipy.spatial.cKDTree(places).query(image)
    # Joints in one position, such as twist joints, are matched in order.
    for place in np.unique(nearest):
        same = np.flatnonzero(np.linalg.norm(places - places[place], axis=1) < 1e-6)
        at = np.flatnonzero(np.isin(nearest, same))
        if len(at) == len(same):
            nearest[at] = same
    alone = (distance > _JOINT_TOLERANCE) | (nearest[nearest] != np.arange(len(joints)))
    partner: npt.NDArray[np.intp] = np.where(alone, -1, nearest)
    return partner


def _by_role(
    space: RigPoseSpace, joints: npt.NDArray[np.intp]
) -> list[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]]:
    """Return the left and right joints of each role with equally many on both sides."""
    sides, roles = np.array(space.sides)[joints], np.array(space.roles)[joints]
    pairs = []
    for role in dict.fromkeys(roles.tolist()):
        left, right = (
            joints[(roles == role) & (sides == side)] for side in (Side.LEFT, Side.RIGHT)
        )
        if role not in _MIDDLE | _LOOSE and len(left) == len(right):
            pairs.append((left, right))
    return pairs


def _between(space: RigPoseSpace, partner: npt.NDArray[np.intp], normal: FloatArray) -> FloatArray:
    """Return `JointSides.between`, from the bones to children that are partners themselves."""
    parents = space.rig.parents
    flip = np.eye(3) - 2.0 * np.outer(normal, normal)
    between = np.broadcast_to(np.eye(3), (len(partner), 3, 3)).copy()
    for joint, other in enumerate(partner.tolist()):
        if other in (joint, -1):
            continue
        ends = np.flatnonzero(parents == joint)
        ends = ends[(partner[ends] >= 0) & (parents[partner[ends]] == other)]
        mean_bone = (space.origins[ends] - space.origins[joint]).sum(axis=0)
        image = flip @ (space.origins[partner[ends]] - space.origins[other]).sum(axis=0)
        lengths = np.linalg.norm(mean_bone) * np.linalg.norm(image)
        parent = int(parents[joint])
        if lengths <= _NEARER**2:
            # The end of a limb takes its parent's rotation.
            between[joint] = between[parent] if parent >= 0 else np.eye(3)
        elif np.arccos(np.clip(mean_bone @ image / lengths, -1.0, 1.0)) > _ALIKE:
            axis = np.cross(image, mean_bone)
            sine = float(np.linalg.norm(axis))
            if sine > _NEARER * lengths:
                angle = np.arctan2(sine, image @ mean_bone)
                between[joint] = from_rotation_vectors(angle * axis / sine)
    return between


@dataclass(frozen=True, eq=False)
class RigMirror(PoseMirror):
    """Mirrors a character's poses: each joint moves as its partner's image.

    The mesh need not be symmetric.

    Attributes
    ----------
    space : of the poses
    sides : of its joints
    """

    space: RigPoseSpace
    sides: JointSides

    def codes_of_image(
        self,
        latent: FloatArray,
        image: FloatArray,  # noqa: ARG002 - joints are more reliable than vertices
        job: Job,  # noqa: ARG002 - a single step
    ) -> FloatArray:
        """Return the codes of the mirrored joints."""
        flip, sides = self.symmetry.flip, self.sides
        moved = self.space.transforms(latent) @ np.linalg.inv(self.space.rig.rest)
        mirrored = flip @ moved[sides.partner] @ flip
        mirrored[:, :3, :3] @= np.swapaxes(sides.between, 1, 2)
        shapes = latent[self.space.are_shapes].copy()
        if self.space.rig.shapes is not None:
            pairs = named_pairs(self.space.rig.shapes.names)
            shapes[pairs] = shapes[pairs[:, ::-1]]
        codes = self.space.codes_of_transforms(mirrored @ self.space.rig.rest, shapes)
        joints = self.space.joint_of_code
        stays = np.flatnonzero((joints >= 0) & (sides.partner[joints] < 0))
        codes[stays] = latent[stays]
        return codes

    def misfit(
        self,
        latent: FloatArray,
        mirrored: FloatArray,
        off: FloatArray,
    ) -> FloatArray:
        """Measure at the joints, as the sides of the mesh may differ."""
        places = self.space.transforms(latent)[self.sides.partner, :3, 3]
        off = self.space.transforms(mirrored)[:, :3, 3] - self.symmetry.reflect(places)
        distances: FloatArray = np.linalg.norm(off[self.sides.partner >= 0], axis=1)
        return distances / self.space.body_size

    def partner(self, domain: int) -> int | None:
        """Return the body part on the other side; None if it has none."""
        part_of_joint, partner = self.space.part_of_joint, self.sides.partner

        def image(of: int) -> int:
            mates = partner[np.flatnonzero(part_of_joint == of)]
            mates = mates[mates >= 0]
            return int(np.bincount(part_of_joint[mates]).argmax()) if len(mates) else of

        other = image(domain)
        return other if other != domain == image(other) else None
