"""A character posed by its joints."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.bodies.anatomy import ROLE_NAMES, joint_parts
from lcollision_core.bodies.body import Body, read_only
from lcollision_core.bodies.card import ModelCard
from lcollision_core.bodies.latent_space import WHOLE_BODY, LatentSpace
from lcollision_core.bodies.mirror import (
    JointSides,
    PoseMirror,
    RigMirror,
    Symmetry,
    find_joint_sides,
)
from lcollision_core.bodies.names import (
    MAX_NAME_LENGTH,
    MAX_POSE_NAME_LENGTH,
    CodeEffect,
    domain_colours,
    unique_names,
    way_in_words,
    with_regions,
)
from lcollision_core.bodies.rig_poses import HumanDraws, StarterPose, random_codes, starter_poses
from lcollision_core.bodies.rig_space import ROOT_CODES, SHIFTS, RigPoseSpace
from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.contact.exclusions import near_pairs_estimate
from lcollision_core.contact.propose import patches_about
from lcollision_core.devices import block_size
from lcollision_core.embedding.bilevel import LatentFit
from lcollision_core.errors import (
    LCollisionError,
    MeshFileError,
    PoseSetError,
    ShapeError,
)
from lcollision_core.files import PoseSet
from lcollision_core.files.character import Character, Rig
from lcollision_core.files.pose_set_reading import require_usable_reference
from lcollision_core.files.safe import MAX_ITEMS
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import fit_rigid, part_groups
from lcollision_core.meshes.contact_rules import (
    CHARACTER_REST_EXCLUSION,
    MAX_GROUP_NAME_LENGTH,
    TOUCHING_RADIUS,
)
from lcollision_core.meshes.extents import body_size
from lcollision_core.meshes.face_groups import MAX_GROUPS, FaceGroup
from lcollision_core.meshes.joint_kinds import Role, Side
from lcollision_core.meshes.topology import FloatArray, evenly_spaced
from lcollision_core.model_file import digest_of

if TYPE_CHECKING:
    from lcollision_core.files.scene.appearance import Appearance
    from lcollision_core.resolve import PoseResolver


_FITTED_VERTICES = 3000
_FIT_STEPS = 20
_SETTLED = 1e-6
"""Relative gain in squared distance at which the fit stops."""

_LEAST_VERTICES, _FLAT = 4, 1e-3
"""Least vertices that determine a joint's turn, and their least spread across a line relative to
that along it."""

_DAMPING = 1e-4
"""Initial damping, relative to the mean diagonal of the normal equations."""


def fit_rig(
    space: RigPoseSpace,
    vertices: FloatArray,
    job: Job = UNWATCHED,
    *,
    in_place: bool = False,
) -> LatentFit:
    """Find the codes whose mesh is nearest to a given one.

    Each joint first takes the turn that brings its own vertices nearest; then the
    Levenberg-Marquardt method refines all codes.

    Parameters
    ----------
    space : of the poses
    vertices : (V, 3) float64 array, normalised
    job : polled before each step
    in_place : whether the mesh is aligned with the reference; else it is aligned first

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    used = space.topology.used_vertices.astype(np.int64)
    rotation, translation = np.eye(3), np.zeros(3)
    if not in_place:
        rotation, translation = fit_rigid(vertices[used], space.rest_vertices[used])
    aligned: FloatArray = vertices @ rotation.T + translation
    sample = used[:: max(1, len(used) // _FITTED_VERTICES)]
    starts = [space.codes_of_transforms(_turned_joints(space, aligned)), np.zeros_like(space.low)]
    missing = [aligned[sample] - space.decode(codes[None])[0, sample] for codes in starts]
    codes, missing_now = min(
        zip(starts, missing, strict=True), key=lambda start: float((start[1] ** 2).sum())
    )
    damping = _DAMPING
    for _ in range(_FIT_STEPS):
        job.check()
        by_codes = space.tangents(codes, sample).reshape(len(codes), -1)
        # Faces are ambiguous, so shapes stay at rest.
        by_codes[space.are_shapes] = 0.0
        normal = by_codes @ by_codes.T
        normal[np.diag_indices_from(normal)] += damping * np.trace(normal) / len(normal)
        tried = codes + np.linalg.solve(normal, by_codes @ missing_now.ravel())
        left = aligned[sample] - space.decode(tried[None])[0, sample]
        before, after = float((missing_now**2).sum()), float((left**2).sum())
        if after >= before:
            damping *= 10.0
            continue
        codes, missing_now, damping = tried, left, 0.1 * damping
        if before - after <= _SETTLED * before:
            break
    distances = np.linalg.norm(aligned[used] - space.decode(codes[None])[0, used], axis=1)
    return LatentFit(codes, rotation, translation, float(distances.mean()), float(distances.max()))


def _turned_joints(space: RigPoseSpace, vertices: FloatArray) -> FloatArray:
    """Return the (J, 4, 4) transforms that bring each joint's vertices nearest to given ones.

    A joint with too few vertices moves with its parent.
    """
    rig, size = space.rig, space.body_size
    moved = np.broadcast_to(np.eye(4), rig.rest.shape).copy()
    for joint, parent in enumerate(rig.parents):
        vertex, influence = np.nonzero((rig.joint_of == joint) & (rig.weights > 0.5))
        points = rig.points[vertex, influence]
        if len(vertex) >= _LEAST_VERTICES:
            spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
            if spread[1] > _FLAT * spread[0]:
                turn, shift = fit_rigid(points, vertices[vertex] * size)
                moved[joint, :3, :3], moved[joint, :3, 3] = turn, shift
                continue
        if parent >= 0:
            moved[joint] = moved[parent]
    return moved @ rig.rest


_WHOLE_BODY = ("move left", "move up", "move forward", "tilt forward", "turn left", "lean right")

_HINGES = {Role.FOREARM, Role.SHIN, Role.FINGER, Role.THUMB, Role.TOE}


def motion_names(space: RigPoseSpace) -> list[str]:
    """Name the motion of each raised code: D names.

    Hinges bend. Other joints are named by the motion of their far end: up, down, forward, back or,
    away from the middle, out and in. In a body part with several joints, their names come first,
    without words of the part's name.
    """
    names, words = list(_WHOLE_BODY), [_words(name) for name in space.rig.joint_names]
    ends = np.cumsum(space.group_sizes)
    for part, start, end in zip(space.part_names, ends[:-1], ends[1:], strict=True):
        joints = space.joint_of_code[start:end]
        several = len(np.unique(joints)) > 1
        for code, joint in enumerate(joints.tolist(), start):
            motion = _motion(space, code)
            if several:
                joint_words = [word for word in words[joint] if word not in _words(part)]
                if joint_words and not any(map(str.isalpha, joint_words)):
                    joint_words.insert(0, "joint")
                motion = " ".join((*joint_words, motion))
            names.append(motion)
    return names


def _words(name: str) -> list[str]:
    """Return a joint's name in words, without its prefix: "left", "hand", "index", "1"."""
    last = re.split("[:|]", name)[-1]
    words = re.findall(r"[A-Z]?[^\W\dA-Z_]+|[A-Z]+(?![a-z])|\d+", last)
    return [word.lower() for word in words]


def _motion(space: RigPoseSpace, code: int) -> str:
    joint, axis = int(space.joint_of_code[code]), int(space.axis_of_code[code])
    if axis == 1:
        return "twist"
    if space.roles[joint] in _HINGES:
        return "sideways" if axis else "bend"
    left = np.cross(space.up, space.front)
    way = np.cross(space.axes[joint][:, axis], space.axes[joint][:, 1])
    side = {Side.LEFT: 1.0, Side.RIGHT: -1.0}.get(space.sides[joint], 0.0)
    return way_in_words(np.array([way @ space.up, way @ space.front, way @ left]), side)


NEAR_EXCLUSIONS = (0.1, 0.05, 0.02)
"""Normalised near exclusions for the folds of skin at bent joints; the first that fits is used.

Linear blend skinning presses the inside of an elbow into itself long before limbs meet. With the
mannequin's joints turned to their limits one at a time, 67 % of poses are free with 0, 84 % with
0.02, 85 % with 0.05 and 93 % with 0.1. Separate shells, as X Bot's, have no folds and are
unaffected. Places farther apart at rest than a limb is thick, such as fingertip and palm, are not
folds: `ContactRules.near_by_limb`.
"""

MOST_NEAR_PAIRS = 100_000_000
"""Most near pairs of vertices: 400 MB. The mannequin (14 442 vertices) has 7 million within 0.1."""

_MOST_TOUCHING = 50_000
"""Pairs at rest above which only these are excluded, without their surroundings."""


def default_rules(character: Character, groups: Sequence[FaceGroup] = ()) -> ContactRules:
    """Return rules by which a character's rest pose is free.

    Pairs that touch at rest, and their surroundings within 0.02 along the surface, do not count.
    With X Bot's joints turned half way to their limits one at a time, all poses collide if only the
    pairs are excluded, 30 % with surroundings of 0.01, and 27 % with 0.02 or 0.03.

    Parameters
    ----------
    groups : of the character; if there are joints among them, pairs at joints do not count

    Raises
    ------
    ShapeError : the rest pose has no extent.
    """
    topology, rest = character.topology, character.rest_vertices
    strict = CollisionDetector(topology, rest)
    at_rest = strict.summarise(rest, n_deepest=0)
    few = at_rest.n_pairs + at_rest.n_coincident_pairs <= _MOST_TOUCHING
    near = 0.0
    if character.rig is not None:
        fitting = (
            length
            for length in NEAR_EXCLUSIONS
            if near_pairs_estimate(topology, rest, length * strict.body_size) <= MOST_NEAR_PAIRS
        )
        near = next(fitting, 0.0)
    has_joints = any(group.about_joint for group in groups)
    return ContactRules(
        near_exclusion=near,
        near_by_limb=near > 0.0 and has_joints,
        rest_exclusion=CHARACTER_REST_EXCLUSION if few else 0.0,
        joint_exclusion=has_joints,
    )


_SHAPE_SHARES = (0.25, 0.5, 0.75, 1.0)
"""Shares of a morph target's range at which contact is looked for."""


def shape_patches(space: RigPoseSpace, detector: CollisionDetector) -> tuple[tuple[int, int], ...]:
    """Find patches of a body part that a morph target brings into contact, such as lids and lashes.

    Contact between parts counts, as joints can move these apart.

    Parameters
    ----------
    space : with morph targets
    detector : by the other default rules

    Returns
    -------
    pairs of faces in the middle of two patches, for `ContactRules.shape_touching`
    """
    reference, faces = detector.reference, detector.topology.faces
    lowest, highest = (edge(reference[faces], axis=1).T.copy() for edge in (np.min, np.max))
    touching = [np.empty((0, 2), dtype=np.int32)]
    for end in (space.low, space.high):
        for shape in np.flatnonzero(space.are_shapes & (end != 0.0)):
            codes = np.zeros((1, len(end)))
            codes[0, shape] = end[shape]
            change = space.decode(codes)[0] * space.body_size - reference
            moves = np.unique(np.flatnonzero(np.abs(change) > _SAME * detector.body_size) // 3)
            if not len(moves):
                continue
            places = np.concatenate([reference[moves] + change[moves], reference[moves]])
            is_far = np.zeros(len(faces), dtype=np.bool_)
            for axis, (low, high) in enumerate(zip(places.min(0), places.max(0), strict=True)):
                is_far |= (highest[axis] < low) | (lowest[axis] > high)
            near = detector.without(is_far)
            for share in _SHAPE_SHARES:
                pose = (reference + share * change).astype(np.float32)
                touching.append(near.detect(pose, counted_only=True).pairs)
    pairs = np.concatenate(touching)
    parts = space.vertex_domain[faces[pairs][:, :, 0]]
    return patches_about(detector, [pairs[parts[:, 0] == parts[:, 1]]], TOUCHING_RADIUS)


_STEPS = 3
"""Levels up the tree that are linked: from an upper arm via the collar bone to the chest."""

_END = 1 / 3
"""Share of a bone along which faces determine the limb's radius at its joint."""

_WITHIN = 75.0
"""Percentile of the faces' distances taken as radius; the rest are folds of clothes."""

_MOST_THICK = 0.3
"""Largest thickness, normalised: a worm, a plump thigh; limbs are never taken as thicker."""

_ON_BONE = 0.25
"""Distance from its bone, as a share of the thickness, within which a twist joint lies."""

_BETWEEN = 0.8
"""Share of the thickness: faces within it of both joints lie between two limbs that branch. X Bot's
thighs meet within 0.78 when it steps, and cross from 1.3 on."""

_SAME_PLACE = 1e-3
"""Normalised distance within which joints coincide."""


def joint_groups(character: Character) -> tuple[FaceGroup, ...]:
    """Return the faces about each joint: those of the parts it links, within the limb's thickness.

    A joint links its part with those of its ancestors, up to three levels, and of twist joints
    along their bone. Two limbs that branch off one part, such as thighs and fingers, are linked
    near both of their joints: in the crotch, between knuckles. The thickness is twice the smaller
    radius of the part and its parent's part at the joint, at most 0.3 in normalised length. Faces
    are measured at their centres.

    Returns
    -------
    groups : named after their joints, one for each joint with a parent and each branching pair;
        empty without a rig
    """
    rig = character.rig
    if rig is None:
        return ()
    topology, rest = character.topology, character.rest_vertices
    size, centres = body_size(rest, topology), rig.rest[:, :3, 3]
    # Use numbers, as names may be truncated.
    faces_of = {
        int(part.name): part.faces for part in part_groups(topology, rig.heaviest.astype(np.str_))
    }
    parents = _linked_parents(rig, set(faces_of), _SAME_PLACE * size)
    middles = rest[topology.faces].mean(axis=1)
    thickness: dict[int, float] = {}
    groups: list[FaceGroup] = []

    def add(faces: list[int], joints: tuple[int, ...], share: float) -> None:
        about = np.sort(np.concatenate([faces_of[joint] for joint in faces]))
        for joint in joints:
            away = np.linalg.norm(middles[about] - centres[joint], axis=1)
            about = about[away <= share * thickness[joint]]
        if len(about) > 1:
            names = "".join(filter(str.isprintable, ", ".join(rig.joint_names[j] for j in joints)))
            name = names.strip()[:MAX_GROUP_NAME_LENGTH] or f"joint {joints[0]}"
            groups.append(FaceGroup(name, about, about_joint=True))

    linked = [joint for joint in faces_of if parents[joint] >= 0]
    for joint in linked:
        children = [child for child in linked if parents[child] == joint]
        joint_faces, above, centre = faces_of[joint], parents[joint], centres[joint]
        end = centres[children].mean(axis=0) if children else middles[joint_faces].mean(axis=0)
        radius = min(
            _radius(middles[joint_faces] - centre, end - centre),
            _radius(middles[faces_of[above]] - centre, centres[above] - centre),
        )
        thickness[joint] = min(2.0 * radius, _MOST_THICK * size)
        add(_linked(joint, parents, centres, _ON_BONE * thickness[joint]), (joint,), 1.0)
    for first, other in combinations(linked, 2):
        if parents[first] == parents[other]:
            apart = float(np.linalg.norm(centres[first] - centres[other]))
            if apart < thickness[first] + thickness[other]:
                add([first, other], (first, other), _BETWEEN)
    # Where there are that many, the small ones are strands of hair.
    return tuple(sorted(groups, key=lambda group: -len(group.faces))[:MAX_GROUPS])


def _linked_parents(rig: Rig, moving: set[int], tolerance: float) -> dict[int, int]:
    """Return the nearest ancestor with faces of each joint with faces, -1 for none.

    A joint without faces is represented by a child at its position: some rigs attach all deforming
    joints to control joints.
    """
    centres, parents = rig.rest[:, :3, 3], rig.parents.tolist()
    stand_in = {joint: joint for joint in moving}
    for joint in sorted(moving):
        parent = parents[joint]
        if parent >= 0 and np.linalg.norm(centres[joint] - centres[parent]) <= tolerance:
            stand_in.setdefault(parent, joint)
    linked = {}
    for joint in sorted(moving):
        above = parents[joint]
        while above >= 0 and stand_in.get(above, joint) == joint:
            above = parents[above]
        linked[joint] = stand_in[above] if above >= 0 else -1
    return linked


def _linked(
    joint: int, parents: dict[int, int], centres: FloatArray, tolerance: float
) -> list[int]:
    """Return the joints whose parts a joint links, including itself."""
    linked = [joint]
    while len(linked) <= _STEPS and parents[linked[-1]] >= 0:
        linked.append(parents[linked[-1]])
    start = centres[linked[1]]
    bone = centres[joint] - start
    for other, parent in parents.items():
        beside = linked[1] in (parent, parents.get(parent)) and joint not in (other, parent)
        if beside and other not in linked:
            from_start = centres[other] - start
            share = np.clip(from_start @ bone / max(float(bone @ bone), 1e-300), 0.0, 1.0)
            if np.linalg.norm(from_start - share * bone) <= tolerance:
                linked.append(other)
    return linked


def _radius(middles: FloatArray, bone: FloatArray) -> float:
    """Return the radius of a limb at a joint at the origin.

    Parameters
    ----------
    middles : (n, 3) float64 array, the centres of its faces
    bone : (3,) float64 array, from the joint
    """
    length = float(np.linalg.norm(bone))
    axis = bone / max(length, 1e-300)
    along = middles @ axis
    away = np.linalg.norm(middles - along[:, None] * axis, axis=1)
    near = np.abs(along) <= _END * length
    return float(np.percentile(away[near] if near.any() else away, _WITHIN))


REST = "rest"
"""The name of the rest pose."""

_MOST_FRAMES, _MOST_RATE = 300, 10.0
"""Most clip frames that are used as poses, and most per second: enough to know the motions."""

_SAME = 1e-5
"""Normalised tolerance within which rigs are the same."""

_MOST_FREE = 32
"""Number of the character's poses, evenly spaced, that Resolve may start from."""


class RigBody(Body):
    """A character posed by its joints; for the codes see `RigPoseSpace`.

    Lengths are in the unit of the character's file. Build one with `of`.

    Parameters
    ----------
    character : one with a rig
    space : its poses
    card : its units, names and origin
    poses : (N, D) float64 array, the rest pose and frames of the clips

    Attributes
    ----------
    character : as given
    joints : the pose space of the rig
    own_card : the card from its file, before any choices of the user
    notes : sentences about changes made on reading, and other differences from the file
    """

    no_predictor = "the character {name!r} has no predictor", "train a model of its poses"
    has_unit = True
    character: Character
    joints: RigPoseSpace
    own_card: ModelCard

    def __init__(
        self, character: Character, space: RigPoseSpace, card: ModelCard, poses: FloatArray
    ) -> None:
        super().__init__(
            character.name,
            card,
            character.topology,
            character.topology.gathered(character.rest_vertices),
            space.attention_mask,
            poses,
        )
        self.character, self.joints = character, space
        self.shape_names = () if space.rig.shapes is None else space.rig.shapes.names
        self.own_card, self.notes = card, (*character.notes, *space.anatomy.notes)

    @classmethod
    def of(cls, character: Character, parts: Sequence[str] | None = None) -> RigBody:
        """Make a body from a rigged character.

        Parameters
        ----------
        character : one with a rig
        parts : body part names by joint: see `RigPoseSpace`

        Raises
        ------
        LCollisionError : the character has no rig.
        """
        names, frames, shapes, rate = [REST], [], [], _frame_rate(character)
        for clip in character.clips if character.rig is not None else ():
            try:
                clip_frames = character.sample(clip, rate)
            except MeshFileError:
                continue  # A damaged clip raises when it is used.
            if clip_frames.transforms is not None:
                names += clip_frames.names
                frames.append(clip_frames.transforms)
                shapes += [] if clip_frames.shapes is None else [clip_frames.shapes]
        transforms, numbers = (
            np.concatenate(rows)[:_MOST_FRAMES] if rows else None for rows in (frames, shapes)
        )
        space = RigPoseSpace(character, parts, transforms, numbers)
        poses = np.concatenate([np.zeros((1, len(space.low))), space.frame_codes])
        printable = ("".join(filter(str.isprintable, name)) for name in space.part_names)
        parts_of_faces = part_groups(character.topology, joint_parts(character, space.anatomy))
        groups = (*character.groups, *parts_of_faces, *joint_groups(character))
        domain_names = [name.strip()[:MAX_NAME_LENGTH] or "part" for name in printable]
        card = ModelCard(
            height=space.body_size,
            up_axis=int(np.abs(character.up).argmax()),
            domain_names=tuple(unique_names(domain_names, MAX_NAME_LENGTH)),
            domain_colours=domain_colours(space.attention_mask),
            pose_names=tuple(name[:MAX_POSE_NAME_LENGTH] for name in names[: len(poses)]),
            source=character.source.name,
            licence="unknown",
            rules=default_rules(character, groups),
            metres=character.metres,
            groups=groups,
        )
        body = cls(character, space, card, poses)
        patches = shape_patches(space, body.detector) if space.n_shapes else ()
        return body.with_rules(replace(card.rules, shape_touching=patches)) if patches else body

    def with_roles(self, chosen: Mapping[str, str]) -> RigBody:
        """Return the character with other joint roles, and its default rules.

        Parameters
        ----------
        chosen : `anatomy.ROLE_NAMES` entries by joint name

        Raises
        ------
        LCollisionError : an unknown joint or role.
        """
        rig = self.space.rig
        for name, role in chosen.items():
            if name not in rig.joint_names:
                raise LCollisionError(
                    f"has no joint {name!r}", "domains lists its joints", where=self.name
                )
            if role not in ROLE_NAMES:
                raise LCollisionError(
                    "is not known", f"choose one of {', '.join(ROLE_NAMES)}", where=f"role {role!r}"
                )
        return RigBody.of(replace(self.character, rig=replace(rig, chosen=dict(chosen))))

    def with_choices_of(self, other: RigBody) -> RigBody:
        """Return this body with the contact rules and body parts of a differently shaped one."""
        card, others_card = self.card, other.card
        if len(others_card.domain_names) == len(card.domain_names):
            kept = ("domain_names", "domain_colours", "domain_order")
            card = replace(card, **{name: getattr(others_card, name) for name in kept})
        body = self.with_card(card)
        if others_card.rules != card.rules:
            body = body.with_rules(others_card.rules)
        touching = other.detector.may_touch
        if not touching:
            return body
        return body._with_detector(body.card, body.detector.with_touching(touching))

    @cached_property
    def appearance(self) -> Appearance | None:
        """Appearance of the character; large textures take long to read."""
        return self.character.look()

    @property
    def space(self) -> RigPoseSpace:
        """The pose space of the rig, which dragging and Resolve use."""
        return self.joints

    @cached_property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the rig, its skin and its codes."""
        space, rig = self.space, self.space.rig
        measures = {
            "points": rig.points / space.body_size,
            "weights": rig.weights,
            "origins": space.origins,
            "axes": space.axes,
        }
        if rig.stretch is not None:
            measures["stretch"] = rig.stretch
        if rig.pose_shapes is not None:
            measures["pose shapes"] = rig.pose_shapes.astype(np.float64) / space.body_size
        # Round, so that it does not depend on the machine's rounding.
        arrays: dict[str, npt.NDArray[Any]] = {
            name: np.round(values / _SAME).astype(np.int64) for name, values in measures.items()
        }
        arrays |= {"faces": self.topology.faces, "joint_of": rig.joint_of, "parents": rig.parents}
        arrays["codes"] = np.stack([space.joint_of_code, space.axis_of_code])
        names = {"joints": rig.joint_names, "parts": space.part_names}
        return digest_of(json.dumps(names), arrays)[:16]

    def _vertex_labels(self) -> npt.NDArray[np.str_]:
        return joint_parts(self.character, self.joints.anatomy)

    @cached_property
    def free_latent(self) -> FloatArray:
        """(F, D) collision-free poses among those that came with the character, read-only."""
        poses = self.known_poses[evenly_spaced(len(self.known_poses), _MOST_FREE)]
        return read_only(poses[self.exact_check().are_free(poses)])

    @cached_property
    def resolver(self) -> PoseResolver:
        """Resolves the self-collisions of this character's poses."""
        from lcollision_core.resolve import PoseResolver

        return PoseResolver(self.exact_check(), None, self.free_latent)

    def _fit(self, vertices: FloatArray, job: Job, *, in_place: bool) -> LatentFit:
        return fit_rig(self.space, vertices, job, in_place=in_place)

    @property
    def up(self) -> tuple[float, float, float]:
        """Unit vector along the up axis, which points down it if the file says so."""
        x, y, z = self.space.up.tolist()
        return x, y, z

    @cached_property
    def front(self) -> FloatArray:
        """(3,) unit vector along an axis: the direction that the character faces."""
        axis = int(np.abs(self.space.front).argmax())
        return read_only(np.sign(self.space.front[axis]) * np.eye(3)[axis])

    @cached_property
    def latent_space(self) -> LatentSpace:
        """The groups, names, colours and ranges of the codes; angles are displayed in degrees."""
        shapes = self.space.are_shapes
        angles = (np.arange(self.latent_size) >= SHIFTS) & ~shapes
        names = [
            WHOLE_BODY.lower() if joint < 0 else self.space.rig.joint_names[joint]
            for joint in self.space.joint_of_code.tolist()
        ]
        names += self.shape_names
        space, at_rest = super().latent_space, np.zeros(self.latent_size)
        if (rig_shapes := self.space.rig.shapes) is not None:
            at_rest[shapes] = rig_shapes.at_rest
        return replace(
            space,
            at_rest=read_only(at_rest),
            groups=tuple(
                replace(group, code_names=tuple(names[group.codes])) for group in space.groups
            ),
            shown=read_only(np.where(angles, np.degrees(1.0), 100.0)),
            units=tuple("°" if angle else " %" for angle in angles),
        )

    def _drawn(self, n_poses: int, generator: np.random.Generator) -> FloatArray:
        """Draw (n_poses, D) human poses; the whole body stays in place."""
        if self.latent_size == ROOT_CODES:
            return np.zeros((n_poses, ROOT_CODES))
        return random_codes(self.space, n_poses, generator)

    no_sides = (
        "its joint names do not say left and right, and its joints are not symmetric",
        "name them, for example, LeftArm and RightArm",
    )

    @cached_property
    def _sides(self) -> JointSides | None:
        return find_joint_sides(self.space)

    @cached_property
    def starter_poses(self) -> tuple[StarterPose, ...]:
        """Starter poses of the rig: see `starter_poses`."""
        return starter_poses(self.space)

    @cached_property
    def symmetry(self) -> Symmetry | None:
        """Symmetry of the rig; None if its joints have no two sides.

        The mesh need not be symmetric: a vertex's partner is the one nearest to its image.
        """
        sides = self._sides
        if sides is None:
            return None
        everyone = np.arange(self.n_vertices, dtype=np.int32)
        plane = Symmetry(everyone, sides.normal, sides.offset * self.body_size)
        partner = scipy.spatial.cKDTree(self.reference).query(plane.reflect(self.reference))[1]
        return replace(plane, partner=read_only(partner.astype(np.int32)))

    @cached_property
    def pose_mirror(self) -> PoseMirror:
        """Mirrors this character's poses, joint by joint.

        Raises
        ------
        LCollisionError : the rig is not symmetric.
        """
        parts = self._mirror_parts()
        assert self._sides is not None
        return RigMirror(*parts, self.space, self._sides)

    @cached_property
    def code_effects(self) -> tuple[CodeEffect, ...]:
        """The body part that each code turns, and its motion by the joints' axes."""
        groups = np.repeat(np.arange(len(self.space.group_sizes)), self.space.group_sizes)
        root = int(np.bincount(self.space.vertex_domain).argmax())
        domains = [int(group) - 1 if group else root for group in groups]
        domains += self.space.domains_of_shapes
        return tuple(map(CodeEffect, domains, self.code_names))

    @cached_property
    def code_names(self) -> tuple[str, ...]:
        """D names of the codes, unique within each group: "bend", "index 1 sideways"."""
        names = motion_names(self.space)
        ends = np.cumsum(self.space.group_sizes)
        joints = (
            name
            for start, end in zip((0, *ends[:-1]), ends, strict=True)
            for name in unique_names(names[start:end])
        )
        return *joints, *self.shape_names

    @cached_property
    def code_words(self) -> tuple[str, ...]:
        """D search texts with the joints' roles and sides, whatever the language of their names."""
        kinds = [
            f"{role.name.lower().replace('_', ' ')} {side.value}"
            for role, side in zip(self.space.roles, self.space.sides, strict=True)
        ]
        joints = [*self.space.joint_of_code.tolist(), *[-1] * self.space.n_shapes]
        return tuple(
            words if joint < 0 else with_regions(f"{words} {kinds[joint]}")
            for words, joint in zip(super().code_words, joints, strict=True)
        )


def _frame_rate(character: Character) -> float:
    """Return the frame rate at which all clips together have at most `_MOST_FRAMES` frames."""
    seconds = sum(character.clips.values())
    most = max(1, _MOST_FRAMES - len(character.clips))
    return min(_MOST_RATE, most / seconds) if seconds > 0.0 else _MOST_RATE


_DRAWS = (1.0, 1.0, 0.75, 0.5)
"""Scale of the turns in each draw of a pose; it is drawn again while it collides."""

_FULL = 2
"""Number of full-scale draws. A pose that never becomes free keeps one of them: otherwise, poses
of a character that nearly always collides would all be near rest."""

_AT_ONCE = 64
"""Poses decoded and checked at once."""


def poses_by_rig(
    body: RigBody,
    n_poses: int,
    seed: int = 0,
    job: Job = UNWATCHED,
) -> PoseSet:
    """Pose a character at random by its joints, within human limits.

    Each pose turns between one and all limbs, by little or much; the body stays in place. A pose
    that collides by the body's rules is drawn again, with smaller turns at last. If all draws
    collide, the full-scale one of least energy is kept.

    Parameters
    ----------
    body : the character
    n_poses : number of poses to draw
    seed : equal seeds give equal poses, on any number of threads
    job : reports (poses done, n_poses); polled between poses

    Returns
    -------
    poses : n_poses + 1 of them in the character's unit, the rest pose first; rules, groups, labels
        and axis as in a set read from the character's file. Its provenance, `by_rig`, holds the
        seed, the numbers of poses drawn and free, and the limits.

    Raises
    ------
    ShapeError : n_poses is below 1.
    PoseSetError : a face of the rest pose has no area, or there are too many poses.
    CancelledError : the job was cancelled.
    """
    if n_poses < 1:
        raise ShapeError.must_be("the number of poses by the rig", "1 or more", n_poses)
    n_items = n_poses * body.n_vertices * 3
    if n_items > MAX_ITEMS:
        raise PoseSetError(
            f"would have {n_items} coordinates, at most {MAX_ITEMS} can be read",
            "ask for fewer poses",
            where=body.character.source,
        )
    rest, draws = rest_pose_set(body.character), HumanDraws(body.space)
    generator = np.random.default_rng(seed)
    extents = draws.extents(n_poses, generator)
    tried = np.zeros((len(_DRAWS), n_poses, body.latent_size))
    best_try = np.zeros(n_poses, dtype=np.int64)
    waiting = np.arange(n_poses)
    for number, size in enumerate(_DRAWS):
        tried[number, waiting] = size * extents[waiting] * draws.codes(len(waiting), generator)
        colliding = np.ones(len(waiting), dtype=np.bool_)
        at_once = block_size(len(waiting), body.topology.n_faces, _AT_ONCE)
        for start in range(0, len(waiting), at_once):
            some = slice(start, start + at_once)
            vertices = body.decode(tried[number, waiting[some]]).astype(np.float32)
            colliding[some] = body.detector.are_colliding(vertices, job=job.part())
            n_free = int((~colliding).sum())
            job.report(n_poses - len(waiting) + n_free, n_poses)
        best_try[waiting] = number
        waiting = waiting[colliding]
    for start in range(0, len(waiting), _AT_ONCE // _FULL):
        group = waiting[start : start + _AT_ONCE // _FULL]
        vertices = body.decode(tried[:_FULL, group].reshape(-1, body.latent_size)).astype(
            np.float32
        )
        collisions = body.detector.detect_batch(vertices, counted_only=True, job=job.part())
        energy = collisions.vertex_energy.sum(axis=1)
        best_try[group] = energy.reshape(_FULL, -1).argmin(axis=0)
        job.report(n_poses - len(waiting) + start + len(group), n_poses)
    codes = tried[best_try, np.arange(n_poses)]
    provenance = {
        "seed": seed,
        "drawn": n_poses,
        "free": n_poses - len(waiting),
        "limits_degrees": draws.limits_in_degrees,
    }
    return replace(
        rest,
        vertices=np.concatenate([rest.vertices, body.decode(codes)]),
        notes=(*rest.notes, *body.space.anatomy.notes),
        names=(*rest.names, *(f"rig {number}" for number in range(1, n_poses + 1))),
        provenance={"by_rig": provenance},
    )


def rest_pose_set(character: Character) -> PoseSet:
    """Return the rest pose of a rigged character, as in a set read from its file.

    Raises
    ------
    LCollisionError : the character has no rig.
    PoseSetError : a face has no area.
    """
    labels = joint_parts(character)
    poses = PoseSet(
        character.rest_vertices[None],
        character.topology,
        (REST,),
        character.source,
        character.notes,
        ContactRules(rest_exclusion=CHARACTER_REST_EXCLUSION),
        character.groups,
        int(np.abs(character.up).argmax()) if character.up_is_sure else None,
        labels,
        metres=character.metres,
    )
    require_usable_reference(poses)
    return poses
