"""Synthetic characters: a tube on a chain of joints, and a body of tubes on a tree of joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from lcollision_core.errors import LCollisionError
from lcollision_core.files import Character, ClipFrames, Rig
from lcollision_core.meshes import FaceGroup, Topology
from tests.bending_tube import RINGS, SIDES, bent_tube, tube_topology
from tests.core.gltf_builder import GltfBuilder
from tests.core.shapes import circle

FloatArray = npt.NDArray[np.float64]

_LIMB_RINGS = 13

_JOINTS: dict[str, tuple[str, tuple[float, float, float]]] = {
    "Hips": ("", (0.0, 0.0, 1.0)),
    "Spine": ("Hips", (0.0, 0.0, 1.15)),
    "Neck": ("Spine", (0.0, 0.0, 1.52)),
    "Head": ("Neck", (0.0, 0.0, 1.6)),
    "HeadEnd": ("Head", (0.0, 0.0, 1.85)),
    **{
        f"{side}{name}": (parent if parent == "Hips" or parent == "Spine" else side + parent, place)
        for side, sign in (("Left", 1.0), ("Right", -1.0))
        for name, parent, place in (
            ("Arm", "Spine", (0.2 * sign, 0.0, 1.45)),
            ("ForeArm", "Arm", (0.5 * sign, 0.0, 1.45)),
            ("Hand", "ForeArm", (0.75 * sign, 0.0, 1.45)),
            ("HandEnd", "Hand", (0.9 * sign, 0.0, 1.45)),
            ("UpLeg", "Hips", (0.12 * sign, 0.0, 0.9)),
            ("Leg", "UpLeg", (0.12 * sign, 0.0, 0.5)),
            ("Foot", "Leg", (0.12 * sign, 0.0, 0.1)),
            ("ToeEnd", "Foot", (0.12 * sign, -0.2, 0.05)),
        )
    },
}
"""Name, parent and position; z is up, and the body faces -y."""

_LIMBS: tuple[tuple[tuple[str, ...], float, float], ...] = (
    (("Hips", "Spine", "Neck"), 0.13, 0.06),
    (("Head", "HeadEnd"), 0.09, 0.03),
    *(
        (tuple(side + name for name in chain), radius, 0.04)
        for side in ("Left", "Right")
        for chain, radius in (
            (("Arm", "ForeArm", "Hand", "HandEnd"), 0.045),
            (("UpLeg", "Leg", "Foot"), 0.07),
            (("Foot", "ToeEnd"), 0.05),
        )
    ),
)
"""The joints along each tube, its radius, and its gap to the end joints."""


def rigged_tube(
    n_joints: int = 3, scale: float = 1.0, frames: bool = False, differs: bool = False
) -> Character:
    """Rig the straight tube, of length `scale` along y, with a chain of joints along it.

    Parameters
    ----------
    frames : of a clip of random turns
    differs : give the joints separate points, as if the rest pose were not the bind pose
    """
    vertices = bent_tube(0.0, 0.0) * scale
    places = np.linspace(0.1, 0.7, n_joints) if n_joints > 1 else np.array([0.5])
    rest = np.broadcast_to(np.eye(4), (n_joints, 4, 4)).copy()
    rest[:, 1, 3] = places * scale
    # A joint's own axes must not matter.
    rest[:, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    along = vertices[:, 1] / scale
    width = 0.1
    shares = np.clip((along[:, None] - places[None]) / width + 0.5, 0.0, 1.0)
    shares[:, 0] = 1.0
    weights = shares - np.concatenate([shares[:, 1:], np.zeros((len(shares), 1))], axis=1)
    points = np.repeat(vertices[:, None], n_joints, axis=1)
    if differs:
        points = points + 0.02 * scale * np.random.default_rng(4).normal(size=points.shape)
        vertices = (weights[:, :, None] * points).sum(axis=1)
    rig = Rig(
        joint_names=tuple(f"link {joint}" for joint in range(n_joints)),
        parents=np.arange(n_joints) - 1,
        rest=rest,
        nodes=np.arange(n_joints),
        joint_of=np.broadcast_to(np.arange(n_joints, dtype=np.int32), weights.shape).copy(),
        weights=weights,
        points=points,
    )
    return character_of("tube", tube_topology(), vertices, rig, [0.0, 1.0, 0.0], 8 if frames else 0)


def rigged_body(scale: float = 1.0, n_frames: int = 0, girth: float = 0.13) -> Character:
    """Make a body of tubes that do not touch, 1.85 `scale` high, on a tree of 21 joints.

    Parameters
    ----------
    girth : the radius of its trunk
    """
    names = tuple(_JOINTS)
    places = np.array([place for _, place in _JOINTS.values()])
    parents = np.array([names.index(parent) if parent else -1 for parent, _ in _JOINTS.values()])
    vertices, faces, joints, weights, groups, n_vertices = [], [], [], [], [], 0
    for chain, radius, gap in _LIMBS:
        numbers = np.array([names.index(name) for name in chain])
        points, blends = limb(places[numbers], girth if chain[0] == "Hips" else radius, gap)
        held = np.zeros((len(points), len(names)))
        held[:, numbers[:-1]] = blends
        n_faces = sum(map(len, faces))
        faces.append(limb_faces() + n_vertices)
        groups.append(FaceGroup(chain[0], np.arange(n_faces, n_faces + len(faces[-1]))))
        vertices.append(points)
        order = np.argsort(-held, axis=1, kind="stable")[:, :3]
        joints.append(order)
        weights.append(np.take_along_axis(held, order, axis=1))
        n_vertices += len(points)
    rest = np.broadcast_to(np.eye(4), (len(names), 4, 4)).copy()
    rest[:, :3, 3] = places * scale
    rest_vertices = np.concatenate(vertices) * scale
    rig = Rig(
        joint_names=names,
        parents=parents,
        rest=rest,
        nodes=np.arange(len(names)),
        joint_of=np.concatenate(joints).astype(np.int32),
        weights=np.concatenate(weights),
        points=np.repeat(rest_vertices[:, None], 3, axis=1),
    )
    topology = Topology(np.concatenate(faces), n_vertices)
    return character_of(
        "body", topology, rest_vertices, rig, [0.0, 0.0, 1.0], n_frames, tuple(groups)
    )


def head_in_torso(n_frames: int = 0) -> Character:
    """Return the body with its head moved down, so that it is in the trunk in every pose."""
    body = rigged_body(n_frames=n_frames)
    assert body.rig is not None
    (head,) = (group for group in body.groups if group.name == "Head")
    moved = np.zeros_like(body.rest_vertices)
    moved[np.unique(body.topology.faces[head.faces])] = [0.0, 0.0, -0.2]
    rig = replace(body.rig, points=body.rig.points + moved[:, None])
    rest = body.rest_vertices + moved
    return character_of("body", body.topology, rest, rig, [0.0, 0.0, 1.0], n_frames, body.groups)


def sunk_arm(n_frames: int = 10) -> Character:
    """Return the body with a clip in which the left arm stays in the trunk.

    Alternately, the right arm is in the head, or one thigh in the other.
    """
    body = rigged_body()
    rig = body.rig
    assert rig is not None
    turns = np.broadcast_to(np.eye(3), (n_frames, len(rig.parents), 3, 3)).copy()
    times = np.arange(n_frames) / 30.0
    for frame in range(n_frames):
        for name, angle in (("LeftArm", 1.9), (("RightArm", 2.2), ("RightUpLeg", -0.4))[frame % 2]):
            joint = rig.joint_names.index(name)
            turns[frame, joint] = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
    transforms = turned(rig, turns)
    names = tuple(f"moves {frame}" for frame in range(n_frames))
    frames = ClipFrames(
        names, times, transforms, lambda: np.stack([skinned(rig, t) for t in transforms])
    )
    return replace(body, clips={"moves": float(times[-1])}, sample=lambda *_: frames)


def skirted_body() -> Character:
    """Return the body with a skirt, an open cone around its thighs that mostly follows them."""
    body = rigged_body()
    rig, n_rows, n_around = body.rig, 9, 24
    assert rig is not None
    rows = [
        circle(n_around, radius) + [0.0, 0.0, height]
        for radius, height in zip(
            np.linspace(0.24, 0.34, n_rows), np.linspace(1.0, 0.45, n_rows), strict=True
        )
    ]
    skirt = np.concatenate(rows)
    follows = 0.9 * np.clip((1.0 - skirt[:, 2]) / 0.3, 0.0, 1.0)
    left = np.clip(2.5 * skirt[:, 0] + 0.5, 0.0, 1.0)
    weights = np.stack([1.0 - follows, follows * left, follows * (1.0 - left)], axis=1)
    joints = [rig.joint_names.index(name) for name in ("Hips", "LeftUpLeg", "RightUpLeg")]
    at = np.arange(len(skirt) - n_around)
    beside = np.where(at % n_around == n_around - 1, at + 1 - n_around, at + 1)
    quads = np.stack([at, beside, beside + n_around, at + n_around], axis=1)
    faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3) + len(body.rest_vertices)
    vertices = np.concatenate([body.rest_vertices, skirt])
    rig = replace(
        rig,
        joint_of=np.concatenate([rig.joint_of, np.tile(joints, (len(skirt), 1))]).astype(np.int32),
        weights=np.concatenate([rig.weights, weights]),
        points=np.repeat(vertices[:, None], 3, axis=1),
    )
    topology = Topology(np.concatenate([body.topology.faces, faces]), len(vertices))
    return character_of("body", topology, vertices, rig, [0.0, 0.0, 1.0], 0, body.groups)


def turned(rig: Rig, turns: FloatArray) -> FloatArray:
    """Return the (..., J, 4, 4) global transforms of joints turned by (..., J, 3, 3) rotations.

    Each turns about its position, in the character's axes, and carries its descendants.
    """
    places = rig.rest[:, :3, 3]
    moved = np.zeros((*turns.shape[:-2], 4, 4))
    moved[..., :3, :3], moved[..., 3, 3] = turns, 1.0
    moved[..., :3, 3] = places - np.einsum("...jab,jb->...ja", turns, places)
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            moved[..., joint, :, :] = moved[..., parent, :, :] @ moved[..., joint, :, :]
    return moved @ rig.rest


def skinned(rig: Rig, transforms: FloatArray) -> FloatArray:
    """Skin by the formula of `Rig`: (J, 4, 4) global transforms give (V, 3) vertices."""
    moved = (transforms @ np.linalg.inv(rig.rest))[rig.joint_of, :3]
    places = (moved[..., :3] @ rig.points[..., None])[..., 0] + moved[..., 3]
    return (rig.weights[..., None] * places).sum(axis=1)


def character_of(
    name: str,
    topology: Topology,
    vertices: FloatArray,
    rig: Rig,
    up: list[float],
    n_frames: int,
    groups: tuple[FaceGroup, ...] = (),
) -> Character:
    """Wrap a rig, with a clip of `n_frames` frames in which its joints turn smoothly."""

    def sample(clip: str, fps: float | None) -> ClipFrames:  # noqa: ARG001
        if clip != "moves" or not n_frames:
            raise LCollisionError.must_be("a clip", "moves", clip)
        ways = np.random.default_rng(11).normal(size=(len(rig.parents), 3))
        times = np.arange(n_frames) / 30.0
        turns = 0.3 * np.sin(4.0 * times)[:, None, None] * ways
        rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
        transforms = turned(rig, rotations.reshape(*turns.shape, 3))
        names = tuple(f"moves {frame}" for frame in range(n_frames))
        return ClipFrames(
            names,
            times,
            transforms,
            lambda: np.stack([skinned(rig, one) for one in transforms]),
        )

    return Character(
        name=name,
        source=Path(f"{name}.glb"),
        topology=topology,
        rest_vertices=vertices,
        joined=np.arange(len(vertices)),
        up=np.array(up),
        up_is_sure=True,
        metres=1.0,
        groups=groups,
        rig=rig,
        clips={"moves": (n_frames - 1) / 30.0} if n_frames else {},
        sample=sample,
    )


def limb(places: FloatArray, radius: float, gap: float) -> tuple[FloatArray, FloatArray]:
    """Return a tube along (n, 3) points, and its vertices' (V, n - 1) weights by segment."""
    lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    along = np.linspace(gap, ends[-1] - gap, _LIMB_RINGS)
    centres = np.stack([np.interp(along, ends, column) for column in places.T], axis=1)
    way = (places[-1] - places[0]) / np.linalg.norm(places[-1] - places[0])
    across = np.cross(way, np.eye(3)[np.abs(way).argmin()])
    across /= np.linalg.norm(across)
    angles = 2.0 * np.pi * np.arange(SIDES) / SIDES
    circle = np.outer(np.cos(angles), across) + np.outer(np.sin(angles), np.cross(way, across))
    rings = centres[:, None] + radius * circle
    shares = np.clip((along[:, None] - ends[None, :-1]) / (2.0 * radius) + 0.5, 0.0, 1.0)
    shares[:, 0] = 1.0
    shares[:, :-1] -= shares[:, 1:].copy()
    return (
        np.concatenate([rings.reshape(-1, 3), centres[[0, -1]]]),
        np.concatenate([np.repeat(shares, SIDES, axis=0), shares[[0, -1]]]),
    )


def limb_faces() -> npt.NDArray[np.int32]:
    """Return the faces of a tube like that of `tests.bending_tube`, with fewer rings."""
    faces = tube_topology().faces
    first_dropped = _LIMB_RINGS * SIDES
    removed = (RINGS - _LIMB_RINGS) * SIDES
    last = (RINGS - 1) * SIDES
    wall = (faces < first_dropped).all(axis=1)
    bottom = (faces == RINGS * SIDES).any(axis=1)
    top = ((faces >= last) | (faces == RINGS * SIDES + 1)).all(axis=1) & ~bottom
    kept = faces[wall | bottom | top].copy()
    kept[kept >= last] -= removed
    return kept


def write_gltf(
    character: Character,
    path: Path,
    interpolation: str = "LINEAR",
    shifts: Mapping[str, FloatArray] | None = None,
) -> Path:
    """Write a z-up character as glTF, which is y up, with its rig and its clips.

    Clips have rotations of the joints and translations of the root. Cubic keys have zero tangents.
    `shifts` are (T, 3) translations of further joints, by name.
    """
    rig = character.rig
    assert rig is not None
    builder = GltfBuilder()
    upright = np.eye(4)
    upright[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    vertices = character.rest_vertices @ upright[:3, :3].T
    columns = [np.pad(values, ((0, 0), (0, 1))) for values in (rig.joint_of, rig.weights)]
    attributes = {
        "POSITION": builder.array(vertices),
        "JOINTS_0": builder.array(columns[0], "u1"),
        "WEIGHTS_0": builder.array(columns[1]),
    }
    faces = builder.array(character.topology.faces.ravel(), "u4")
    builder.add("meshes", name="Body", primitives=[{"attributes": attributes, "indices": faces}])
    first = 2
    builder.add("nodes", name="Body", mesh=0, skin=0)
    roots = np.flatnonzero(rig.parents < 0) + first
    builder.add("nodes", name="Up", matrix=upright.T.ravel().tolist(), children=roots.tolist())
    for joint, (name, parent) in enumerate(zip(rig.joint_names, rig.parents, strict=True)):
        place = rig.rest[joint, :3, 3] - (rig.rest[parent, :3, 3] if parent >= 0 else 0.0)
        children = (np.flatnonzero(rig.parents == joint) + first).tolist()
        own = {"children": children} if children else {}
        builder.add("nodes", name=name, translation=place.tolist(), **own)
    joints = [first + joint for joint in range(len(rig.joint_names))]
    bind = np.linalg.inv(upright @ rig.rest)
    builder.add("skins", joints=joints, inverseBindMatrices=builder.matrices(bind))
    for clip in character.clips:
        frames = character.sample(clip, None)
        assert frames.transforms is not None
        moved = frames.transforms @ np.linalg.inv(rig.rest)
        channels = []
        for joint, parent in enumerate(rig.parents):
            above = np.linalg.inv(moved[:, parent]) if parent >= 0 else np.eye(4)
            turns = Rotation.from_matrix((above @ moved[:, joint])[:, :3, :3]).as_quat()
            if interpolation == "CUBICSPLINE":
                turns = np.stack([0.0 * turns, turns, 0.0 * turns], axis=1).reshape(-1, 4)
            channel = {"node": first + joint, "path": "rotation", "values": turns}
            channels.append(channel | {"times": frames.times, "interpolation": interpolation})
            moves = (shifts or {}).get(rig.joint_names[joint])
            if moves is not None:
                own = rig.rest[joint, :3, 3] - rig.rest[parent, :3, 3]
                way = {"node": first + joint, "path": "translation", "values": own + moves}
                channels.append(way | {"times": frames.times})
            places = frames.transforms[:, joint, :3, 3]
            # Linear, whatever the interpolation of the turns.
            if parent < 0 and np.ptp(places, axis=0).any():
                way = {"node": first + joint, "path": "translation", "values": places}
                channels.append(way | {"times": frames.times})
        builder.animation(clip, *channels)
    return builder.write(path)
