"""Scenes of several bodies, stored as a small file that refers to the bodies' files."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from lcollision_core.bodies.body import Body
from lcollision_core.bodies.mesh_body import MeshBody
from lcollision_core.bodies.names import unique_names
from lcollision_core.bodies.remembered import open_body, open_character
from lcollision_core.bodies.rig_body import RigBody
from lcollision_core.bodies.scene_body import SceneBody, SceneFile, SceneMember, ScenePart
from lcollision_core.errors import LCollisionError, ModelFileError, listed
from lcollision_core.files import Character, ClipFrames, Rig, read_character, read_mesh
from lcollision_core.files.formats import READABLE_SUFFIXES, SCENE_SUFFIXES, SMPL_SUFFIX
from lcollision_core.files.safe import read_regular, write_bytes
from lcollision_core.files.scene.transforms import from_rotation_vectors
from lcollision_core.json_values import from_json, parse_document, parse_json
from lcollision_core.meshes import RigidTransform, Topology
from lcollision_core.meshes.alignment import fit_rigid
from lcollision_core.meshes.extents import guess_up
from lcollision_core.meshes.topology import FloatArray

SCENE_FORMAT, _VERSION = "lcollision-scene", 1
_MAX_BYTES = 10_000_000

_IN_HAND = 0.15
"""Normalised distance from its joint within which a held prop stays in place."""

_RIGID = 1e-6
"""Deviation from a rigid motion, by the size of a prop, that is ignored."""

_GROUND_SIDE = 10.0
"""Normalised margin of the ground around the bodies."""

_BELOW = 1e-4
"""Normalised gap between the bodies and the ground, so that they do not touch."""

_BETWEEN = 0.1
"""Normalised gap between bodies that are opened together."""

GROUND = "ground"


def is_scene_file(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a scene file; never raises."""
    target = Path(path)
    if target.suffix.lower() != ".json":
        return False
    try:
        document = parse_json(read_regular(target, _MAX_BYTES))
    except (OSError, ValueError):
        return False
    return isinstance(document, dict) and document.get("format") == SCENE_FORMAT


def read_scene_file(path: str | os.PathLike[str]) -> SceneFile:
    """Read a scene file and resolve the paths of its bodies.

    A body is looked up at the path in the file, relative to the file, then beside the file.

    Raises
    ------
    ModelFileError : it is damaged or of a later version, or a body's file is missing.
    """
    target = Path(path)
    try:
        content = read_regular(target, _MAX_BYTES)
        document = parse_document(content, SCENE_FORMAT, _VERSION, target)
        scene = from_json(SceneFile, document, "the scene")
    except FileNotFoundError as error:
        raise ModelFileError.unreadable(target, "there is no such file", "name a scene") from error
    except (OSError, ValueError) as error:
        raise ModelFileError.unreadable(target, error, "save the scene again") from error
    parts = tuple(replace(part, file=_path_of_part(part, target)) for part in scene.bodies)
    return replace(scene, bodies=parts, path=str(target))


def _path_of_part(part: ScenePart, scene: Path) -> str:
    """Return the path of a body's file, or a model's name."""
    given = Path(part.file)
    if len(given.parts) == 1 and not given.suffix:
        return part.file
    for candidate in (scene.parent / given, scene.parent / given.name):
        if candidate.is_file():
            return str(candidate)
    raise ModelFileError(
        f"names {part.file}, which is neither there nor beside it",
        f"put {given.name} into {scene.parent.absolute()}",
        where=scene,
    )


def write_scene_file(path: str | os.PathLike[str], scene: SceneFile) -> None:
    """Write a scene file, with paths relative to it.

    Raises
    ------
    MeshFileError : it cannot be written.
    """
    folder = Path(path).absolute().parent
    bodies = []
    for part in scene.bodies:
        stored: dict[str, Any] = {"file": part.file}
        if len(Path(part.file).parts) > 1 or Path(part.file).suffix:
            absolute = Path(part.file).absolute()
            try:
                stored["file"] = Path(os.path.relpath(absolute, folder)).as_posix()
            except ValueError:  # On another drive.
                stored["file"] = absolute.as_posix()
        default = ScenePart("")
        stored |= {
            name: value
            for name, value in vars(part).items()
            if name != "file" and value != getattr(default, name)
        }
        bodies.append(stored)
    document = {
        "format": SCENE_FORMAT,
        "format_version": _VERSION,
        "bodies": bodies,
        **({} if scene.ground is None else {"ground": scene.ground}),
    }
    write_bytes(path, json.dumps(document, indent=1, ensure_ascii=False).encode() + b"\n")


def open_scene_file(path: str | os.PathLike[str]) -> SceneBody:
    """Read a scene and its bodies: see `read_scene_file` and `body_of_scene`."""
    return body_of_scene(read_scene_file(path))


def body_of_scene(
    scene: SceneFile, opened: Sequence[Body | None] = (), *, as_posed: bool = False
) -> SceneBody:
    """Open the bodies of a scene.

    Parameters
    ----------
    opened : bodies that are open already, for the first entries
    as_posed : whether the bodies are posed meshes, which stay in place

    Raises
    ------
    LCollisionError : a file cannot be read, or a holder or its joint is unknown.
    """
    known_bodies = [*opened, *[None] * (len(scene.bodies) - len(opened))]
    pairs = list(zip(scene.bodies, known_bodies, strict=True))
    # Two members of one file are one body, which lists its near faces once.
    open_once = cache(open_member)
    bodies = [body or open_once(part.file) for part, body in pairs]
    names = unique_names(part.name or Path(part.file).stem for part in scene.bodies)
    first = bodies[0]
    members: list[SceneMember] = []
    for part, name, body in zip(scene.bodies, names, bodies, strict=True):
        place = _place(part, body, first)
        member = SceneMember(name, body, place, part.fixed)
        if part.held_by:
            member = _in_hand(member, part, members, bring=not as_posed)
        members.append(member)
    if scene.ground is not None:
        members.append(_ground(scene.ground, members))
    path = Path(scene.path)
    # Scenes not named by the user get their name from their bodies.
    is_named = scene.path and not re.search(r" [0-9a-f]{8}$", path.stem)
    scene_body = SceneBody(members, path.stem if is_named else "", scene)
    uncounted = [name for part, name in zip(scene.bodies, names, strict=True) if not part.counts]
    if not uncounted:
        return scene_body
    return scene_body.with_rules(
        replace(scene_body.rules, left_out=(*scene_body.rules.left_out, *uncounted))
    )


def beside(scene: SceneFile, file: Path) -> SceneFile:
    """Return a scene with one more body, beside the others.

    Raises
    ------
    LCollisionError : the file cannot be read.
    """
    more = replace(scene, bodies=(*scene.bodies, ScenePart(str(file))), ground=None)
    body = body_of_scene(more)
    up, axis = np.array(body.up), np.asarray(body.front, dtype=np.float64)
    left = np.cross(up, axis)
    along = [body.reference[rows] @ left for rows in body.vertices_of.values()]
    others = max(float(item.max()) for item in along[:-1])
    way = (others - float(along[-1].min()) + _BETWEEN * body.body_size) * left
    at = float(way[0]), float(way[1]), float(way[2])
    return replace(scene, bodies=(*scene.bodies, ScenePart(str(file), at=at)))


def _place(part: ScenePart, body: Body, first: Body) -> RigidTransform:
    """Return the transform from a body's coordinates to the scene's."""
    turn = np.eye(3)
    if body.up != first.up:
        turn = scipy.spatial.transform.Rotation.align_vectors(
            [np.array(first.up)], [np.array(body.up)]
        )[0].as_matrix()
        turn = np.round(turn)
    about = from_rotation_vectors(np.radians(part.turn) * np.array(first.up))
    scale = body.card.metres / first.card.metres
    return RigidTransform(about @ turn, np.array(part.at, dtype=np.float64), scale)


def _in_hand(
    member: SceneMember, part: ScenePart, members: Sequence[SceneMember], *, bring: bool
) -> SceneMember:
    """Return a held body, moved to the joint that holds it unless already near it."""
    holder = next((member for member in members if member.name == part.held_by), None)
    joints = None if holder is None else holder.body.joints
    if holder is None or joints is None:
        what = f"is held by {part.held_by!r}, but no character of that name is listed before it"
        raise LCollisionError(what, "name a character of the scene", where=member.name)
    number = joint_named(holder.body, part.joint)
    joint = holder.place.apply(joints.rig.rest[number, :3, 3])
    near = float(np.linalg.norm(member.reference - joint, axis=1).min())
    size = holder.body.body_size * holder.place.scale
    place = member.place
    if bring and near > _IN_HAND * size:
        place = replace(place, translation=place.translation + joint)
    return replace(member, place=place, holder=holder.name, joint=number)


def joint_named(body: Body, name: str) -> int:
    """Return the index of a body's joint by its name, without prefix or case if necessary.

    Raises
    ------
    LCollisionError : it has no such joint.
    """
    assert body.joints is not None
    names = body.joints.rig.joint_names
    plain = [joint.rsplit(":", 1)[-1].lower() for joint in names]
    for given, names_known in ((name, list(names)), (name.rsplit(":", 1)[-1].lower(), plain)):
        if given in names_known:
            return names_known.index(given)
    raise LCollisionError(
        f"has no joint {name!r}", f"its joints are {listed(names)}", where=body.name
    )


def _ground(height: float | str, members: Sequence[SceneMember]) -> SceneMember:
    """Return the ground: a horizontal square below all bodies."""
    first = members[0]
    up, size = np.array(first.body.up), first.body.body_size * first.place.scale
    standing = [member.reference for member in members if member.moves and member.holder is None]
    points = np.concatenate(standing or [member.reference for member in members])
    if isinstance(height, str):
        height = float((points @ up).min()) - _BELOW * size
    across = [axis for axis in np.eye(3) if axis @ up == 0.0]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    half = _GROUND_SIDE * size + 0.5 * float(np.ptp(points, axis=0).max())
    middle += (height - middle @ up) * up
    corners = [middle + half * (a * across[0] + b * across[1]) for a, b in _CORNERS]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    if np.cross(across[0], across[1]) @ up < 0.0:
        faces = faces[:, ::-1]
    vertices = np.array(corners)
    body = MeshBody(vertices[None], Topology(faces, 4), vertices)
    body.name = GROUND
    here = RigidTransform(np.eye(3), np.zeros(3), 1.0)
    return SceneMember(GROUND, body, here, is_fixed=True, is_ground=True)


_CORNERS = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))


def open_member(source: str) -> Body:
    """Open a body of a scene: a character, a model, or a mesh as a prop with one joint.

    Raises
    ------
    LCollisionError : the file cannot be read.
    """
    path = Path(source)
    suffix = path.suffix.lower()
    if suffix in SCENE_SUFFIXES:
        character = read_character(source)
        if character.rig is not None:
            return open_character(character)
        return RigBody.of(_prop(character))
    if suffix in READABLE_SUFFIXES and suffix != SMPL_SUFFIX:
        return RigBody.of(_prop(_character_of_mesh(path)))
    return open_body(source)


def _character_of_mesh(path: Path) -> Character:
    mesh = read_mesh(path)
    guess = guess_up(mesh.topology, mesh.vertices[None])
    up, vertices = np.eye(3)[guess.axis if guess.is_sure else 1], np.array(mesh.vertices)
    return Character.without_clips(
        path, mesh.topology, vertices, up, None, up_is_sure=guess.is_sure, notes=mesh.notes
    )


def _prop(character: Character) -> Character:
    """Give a mesh one joint at its centre that moves all of it, also in its clips."""
    vertices = character.rest_vertices
    rest = np.eye(4)[None].copy()
    rest[0, :3, 3] = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    n = len(vertices)
    rig = Rig(
        (character.name or "prop",),
        np.array([-1]),
        rest,
        np.array([0]),
        np.zeros((n, 1), dtype=np.int32),
        np.ones((n, 1)),
        vertices[:, None].copy(),
    )

    def sample(clip: str, fps: float | FloatArray | None) -> ClipFrames:
        frames = character.sample(clip, fps)
        times, n_frames = frames.times, len(frames.times)

        def fit(frame: int) -> tuple[FloatArray, FloatArray]:
            """Return how a frame is moved as a whole, and its vertices moved back."""
            posed = character.sample(clip, times[frame : frame + 1]).vertices[0]
            back = RigidTransform(*fit_rigid(posed, vertices))
            return back.inverse().matrix @ rest[0], back.apply(posed)[:, None]

        def points(frame: int) -> FloatArray:
            return fit(frame)[1]

        transforms, deforms = np.empty((n_frames, 1, 4, 4)), np.zeros(n_frames, dtype=np.bool_)
        for frame in range(n_frames):
            transforms[frame, 0], shape = fit(frame)
            deforms[frame] = (
                np.abs(shape - rig.points).max() > _RIGID * np.ptp(vertices, axis=0).max()
            )
        own_points = {frame: partial(points, frame) for frame in np.flatnonzero(deforms).tolist()}
        return replace(frames, transforms=transforms, points=own_points)

    return replace(character, rig=rig, sample=sample)
