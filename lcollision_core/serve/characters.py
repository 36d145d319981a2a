"""Characters that a client has opened, from a file or from arrays."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import msgspec
import numpy as np

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.errors import LCollisionError
from lcollision_core.files import Character, ClipFrames
from lcollision_core.files.character_reading import character_of
from lcollision_core.files.safe import read_regular
from lcollision_core.files.scene.scene import Part, Scene, ScenePoses
from lcollision_core.meshes import FaceGroup
from lcollision_core.meshes.topology import FloatArray, Int64Array
from lcollision_core.meshes.trees import ancestry
from lcollision_core.serve.messages import Array, MeshPart, Open, OpenMesh

_LEAST_DETERMINANT = 1e-12
_MOST_POSES, _RATE = 300, 10.0
_MAX_FILE_BYTES = 4 << 30


@dataclass(frozen=True, eq=False)
class OpenedCharacter:
    """A character of the engine, and the mapping of its indices to the client's.

    Attributes
    ----------
    body : the character, with its contact rules
    joint_names : J names of the client's joints
    joints : the client's index of each joint of the rig, J for a joint that the client lacks
    n_vertices : number W of the client's vertices, seams not joined
    vertices : (V,) int64 array, one of the client's vertices for each joined vertex
    joined : (W,) int64 array, the joined vertex of each of the client's
    faces : (F,) int64 array, the client's index of each face of the body
    """

    body: RigBody
    joint_names: tuple[str, ...]
    joints: Int64Array
    n_vertices: int
    vertices: Int64Array
    joined: Int64Array
    faces: Int64Array

    def transforms(self, given: Array, *leading: int | None) -> FloatArray:
        """Return the transforms of the rig's joints from the client's (..., J, 4, 4) ones."""
        n = len(self.joint_names)
        values = given.numbers("transforms", (*leading, n, 4, 4))
        return _with_identity(values)[..., self.joints, :, :]

    def joined_vertices(self, given: Array, *leading: int | None) -> FloatArray:
        """Return the client's (..., W, 3) vertices as (..., V, 3) joined ones."""
        return given.numbers("vertices", (*leading, self.n_vertices, 3))[..., self.vertices, :]

    def parts_of(self, joints: list[str]) -> frozenset[int]:
        """Return the body parts that joints belong to; see `joint_indices`."""
        return frozenset(self.body.space.part_of_joint[self.joint_indices(joints)].tolist())

    def joint_indices(self, joints: list[str]) -> Int64Array:
        """Return the rig's indices of joints given by name.

        Raises
        ------
        LCollisionError : there is no such joint.
        """
        numbers = {name: number for number, name in enumerate(self.joint_names)}
        unknown = [name for name in joints if name not in numbers]
        if unknown:
            raise LCollisionError(f"has no joint {unknown[0]!r}", where=self.body.name)
        is_named = np.isin(self.joints, [numbers[name] for name in joints])
        return np.flatnonzero(is_named)

    def turns(self, before: FloatArray, after: FloatArray) -> tuple[Int64Array, FloatArray]:
        """Return how joints turn between the poses `before` and `after`, in their local frames.

        Parameters
        ----------
        before, after : (T, D) codes

        Returns
        -------
        joints : (n,) the client's indices of the joints that turn
        turns : (T, n, 4, 4): a joint's transform relative to its parent, times this, is the new one
        """
        turned = self._turned(before, after)
        limit = _SAME * np.array([1.0, 1.0, 1.0, self.body.body_size])
        does = (np.abs(turned - np.eye(4)) > limit).any(axis=(0, 2, 3))
        joint_codes = np.flatnonzero(does & (self.joints < len(self.joint_names)))
        return self.joints[joint_codes], turned[:, joint_codes]

    def _turned(self, before: FloatArray, after: FloatArray) -> FloatArray:
        """Return the (T, J, 4, 4) turns of all joints of the rig, as `turns` does."""
        space, joint_turns = self.body.space, []
        parents = space.rig.own_parents
        for codes in (before, after):
            moved = np.array([space.transforms(row) for row in codes])
            above = np.where((parents < 0)[:, None, None], np.eye(4), moved[:, parents])
            joint_turns.append(np.linalg.inv(above) @ moved)
        turned: FloatArray = np.linalg.inv(joint_turns[0]) @ joint_turns[1]
        return turned

    def without_small_turns(
        self, before: FloatArray, after: FloatArray, least: float
    ) -> FloatArray:
        """Return `after` without the turns of joints that hardly turn.

        Parameters
        ----------
        before, after : (T, D) codes
        least : normalised, the farthest that the omitted turns together may move any vertex
        """
        if not least:
            return after
        turned = self._turned(before, after)
        # The chord of a turn is the norm of R - I divided by the square root of 2.
        chords = np.linalg.norm(turned[..., :3, :3] - np.eye(3), axis=(2, 3)) / np.sqrt(2.0)
        shifts = np.linalg.norm(turned[..., :3, 3], axis=2) / self.body.body_size
        moves = (chords * self._reaches + shifts).max(axis=0)
        carried, left_out = ancestry(self.body.space.rig.parents), np.zeros(len(moves))
        small: list[int] = []
        for joint in np.argsort(moves).tolist():
            further = left_out + carried[:, joint] * moves[joint]
            if further.max() <= least:
                left_out, small = further, [*small, joint]
        return np.where(self.body.space.codes_of_joints(np.array(small, np.int64)), before, after)

    @cached_property
    def _reaches(self) -> FloatArray:
        """(J,) normalised distance from each joint of the rig to the farthest vertex it carries."""
        rig = self.body.space.rig
        heads, carries = rig.rest[:, :3, 3], rig.weights > 0.0
        away = np.linalg.norm(rig.points - heads[rig.joint_of], axis=2)
        reaches = np.zeros(len(heads))
        np.maximum.at(reaches, rig.joint_of[carries], away[carries])
        for joint in range(len(heads) - 1, 0, -1):
            above = rig.parents[joint]
            if above >= 0:
                length = np.linalg.norm(heads[joint] - heads[above])
                reaches[above] = max(reaches[above], length + reaches[joint])
        normalised: FloatArray = reaches / self.body.body_size
        return normalised


_SAME = 1e-7
"""Tolerance for a joint that does not turn: entries of its rotation matrix, and its shift in body
sizes."""


def character_id(message: Open | OpenMesh) -> str:
    """Return the id of a character: a hash of its file, or of its arrays.

    Raises
    ------
    LCollisionError : the file cannot be read.
    """
    if isinstance(message, OpenMesh):
        made_of = msgspec.msgpack.encode(msgspec.structs.replace(message, id=0))
    else:
        try:
            made_of = read_regular(Path(message.file), _MAX_FILE_BYTES)
        except (OSError, ValueError) as error:
            raise LCollisionError.unreadable(message.file, error) from error
    return hashlib.sha256(made_of).hexdigest()[:16]


def open_file(path: str) -> OpenedCharacter:
    """Open a character's file.

    Raises
    ------
    LCollisionError : it cannot be read, or has no joints.
    """
    body = open_body(path)
    if not isinstance(body, RigBody):
        raise LCollisionError("has no joints", "name the file of a character", where=path)
    return _opened(body, body.space.rig.joint_names, np.arange(body.space.n_joints))


def open_arrays(message: OpenMesh) -> OpenedCharacter:
    """Make a character from a client's arrays.

    Raises
    ------
    LCollisionError : an array has a wrong shape or invalid values, or no face is left.
    """
    n = len(message.joints)
    if n == 0:
        raise LCollisionError.must_be("joints", "at least one", 0)
    parents = message.parents.indices("parents", (n,), n, first=-1)
    late = np.flatnonzero(parents >= np.arange(n))
    if len(late):
        raise LCollisionError(
            f"joint {message.joints[late[0]]!r} comes before its parent", "sort the joints"
        )
    rest = message.rest.numbers("rest", (n, 4, 4))
    flat = np.flatnonzero(np.abs(np.linalg.det(rest[:, :3, :3])) < _LEAST_DETERMINANT)
    if len(flat):
        raise LCollisionError(f"joint {message.joints[flat[0]]!r} has no size at rest")
    # Add a joint for vertices that nothing moves.
    all_rest = np.concatenate([rest, np.eye(4)[None]])
    parts = tuple(_part(given, all_rest) for given in message.parts)
    scene = Scene(
        node_names=(*message.joints, "unmoved"),
        parents=np.append(parents, -1),
        rest=ScenePoses(all_rest[None], tuple(np.zeros((1, 0)) for _ in parts)),
        parts=parts,
        clips=(),
        up=np.eye(3)["xyz".index(message.up[-1])] * (-1.0 if message.up[0] == "-" else 1.0),
        metres=message.metres,
    )
    character = character_of(scene, Path(f"{message.name or 'mesh'}"))
    character = replace(character, groups=(*character.groups, *_further(message, character)))
    assert character.rig is not None
    nodes = character.rig.nodes
    if message.poses is not None:
        poses = message.poses.numbers("poses", (None, n, 4, 4))[:_MOST_POSES]
        unmoved = tuple(np.zeros((len(poses), 0)) for _ in parts)
        character = _with_poses(character, ScenePoses(_with_identity(poses), unmoved))
    body = open_body(character)
    assert isinstance(body, RigBody)
    return _opened(body, tuple(message.joints), nodes)


def _further(message: OpenMesh, character: Character) -> list[FaceGroup]:
    """Return the parts' groups of vertices as groups of faces, merged by name."""
    assert character.file is not None
    corners, faces_of_group, first = [], dict[str, list[Int64Array]](), 0
    for part in message.parts:
        n = part.vertices.shape[0]
        corners.append(part.faces.indices("faces", (None, 3), n) + first)
        for group in part.groups:
            vertices = group.vertices.indices(f"vertices of {group.name!r}", (None,), n)
            faces_of_group.setdefault(group.name, []).append(vertices + first)
        first += n
    faces = np.concatenate(corners)[character.file.mesh.cut_of]
    group_names = {group.name for group in character.groups}
    inside = {
        name: np.isin(faces, np.concatenate(own)).all(axis=1)
        for name, own in faces_of_group.items()
    }
    return [
        FaceGroup(name, np.flatnonzero(own))
        for name, own in inside.items()
        if own.any() and name not in group_names and name.strip()
    ]


def _with_identity(transforms: FloatArray) -> FloatArray:
    """Append an identity transform to (..., J, 4, 4) transforms."""
    still = np.broadcast_to(np.eye(4), (*transforms.shape[:-3], 1, 4, 4))
    return np.concatenate([transforms, still], axis=-3)


def _with_poses(character: Character, poses: ScenePoses) -> Character:
    """Return a character with poses of all nodes as the frames of its only clip."""
    assert character.file is not None
    assert character.rig is not None
    names = tuple(f"pose {number}" for number in range(len(poses.transforms)))
    skin = partial(character.file.mesh.posed, poses)
    of_joints = poses.transforms[:, character.rig.nodes]
    frames = ClipFrames(names, np.arange(len(names)) / _RATE, of_joints, skin)
    clips = {"poses": len(names) / _RATE} if names else {}
    return replace(character, clips=clips, sample=lambda clip, fps: frames)  # noqa: ARG005


def _opened(body: RigBody, names: tuple[str, ...], joints: Int64Array) -> OpenedCharacter:
    joined = body.character.joined
    vertices = np.zeros(body.n_vertices, dtype=np.int64)
    # Of joined vertices, the first.
    vertices[joined[::-1]] = np.arange(len(joined))[::-1]
    file = body.character.file
    faces = np.arange(len(body.faces)) if file is None else file.mesh.cut_of
    return OpenedCharacter(body, names, joints, len(joined), vertices, joined, faces)


def _part(given: MeshPart, rest: FloatArray) -> Part:
    where = f"of {given.name!r}"
    points = given.vertices.numbers(f"vertices {where}", (None, 3))
    n, n_joints = len(points), len(rest) - 1
    faces = given.faces.indices(f"faces {where}", (None, 3), n)
    joint_of = given.joint_of.indices(f"joint_of {where}", (n, None), n_joints)
    weights = given.weights.numbers(f"weights {where}", (n, joint_of.shape[1]))
    if (weights < 0.0).any():
        raise LCollisionError.must_be(f"weights {where}", "0 or more", weights.min())
    material_of = np.full(len(faces), -1)
    if given.material_of is not None:
        material_of = given.material_of.indices(
            f"material_of {where}", (len(faces),), len(given.materials), first=-1
        )
    total = weights.sum(axis=1, keepdims=True)
    bones = np.arange(n_joints)
    if not (total > 0.0).all():
        bones = np.arange(n_joints + 1)
        joint_of = np.append(joint_of, np.full((n, 1), n_joints), axis=1)
        weights = np.append(weights, total == 0.0, axis=1)
        total = weights.sum(axis=1, keepdims=True)
    return Part(
        mesh=given.name,
        materials=tuple(given.materials),
        material_of=material_of,
        node=n_joints,
        points=points,
        faces=faces,
        bones=bones,
        bind=np.linalg.inv(rest[bones]).astype(np.float64),
        bone_of=joint_of.astype(np.int32),
        weights=weights / total,
        is_skinned=True,
        morphs=np.zeros((0, n, 3), dtype=np.float32),
    )
