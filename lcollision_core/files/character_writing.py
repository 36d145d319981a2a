"""Write a character's glTF file with another pose or clip, and read it back.

A record in `asset.extras` of the glTF file holds the parts of the source's description that the
pose has changed, so that the source character can be read without the source file.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import ValidationError, convert

from lcollision_core.errors import MeshFileError, ShapeError, UnwritablePoseError
from lcollision_core.files.character import (
    IDENTITY,
    Character,
    CharacterFile,
    Rig,
    blended,
)
from lcollision_core.files.character_reading import character_of
from lcollision_core.files.formats import GLTF_SUFFIXES
from lcollision_core.files.gltf.read import read_shown
from lcollision_core.files.gltf.schema import PARTS, GltfDocument, set_parts, stored_parts
from lcollision_core.files.mesh.polygons import MAX_FILE_BYTES
from lcollision_core.files.safe import make_unique, read_regular, write_bytes
from lcollision_core.files.scene.joined import join_parts
from lcollision_core.files.scene.scene import (
    KEYS_ARE_FRAMES,
    LEAST_RATE,
    Primitive,
    ScenePoses,
    by_node,
    left_out_note,
    parents_first,
)
from lcollision_core.files.scene.transforms import compose, decompose, signs_on_one_side
from lcollision_core.files.scene_files import SceneDocument, as_file_error, scene_of
from lcollision_core.json_values import quoted
from lcollision_core.meshes.contact_rules import STRICT, ContactRules
from lcollision_core.meshes.extents import body_size
from lcollision_core.meshes.normals import unit
from lcollision_core.meshes.topology import FloatArray

_KEY, _VERSION = "lcollision", 1
_LONGEST_NAME = 100
_CLIPS, _SHOWING = "animations", ("scale", "weights")
_CHANGED = ("nodes", "meshes", "skins", "scenes", "scene")
"""Entries of a description that a pose changes, apart from animations."""


def add_source_record(
    patch: GltfDocument,
    source: dict[str, Any],
    character: Character,
    shown_by: Sequence[int],
    rules: ContactRules,
) -> None:
    """Record the source's description and the contact rules in a file that holds a pose.

    Parameters
    ----------
    patch : the complete file
    source : description of the source
    character : the source's character, with a rig
    shown_by : for each of its parts, the number of the node that shows it now
    rules : contact rules of the character
    """
    asset = patch.description.get("asset", {})
    extras = asset.get("extras", {}) if isinstance(asset, dict) else None
    if not isinstance(extras, dict):
        # The source uses this entry for something else.
        return
    patch.description["asset"] = asset = {**asset, "extras": {**extras}}
    before = {name: source.get(name) for name in _CHANGED}
    before = {name: value for name, value in before.items() if value != patch.description.get(name)}
    before[_CLIPS] = _brief(source)
    asset["extras"][_KEY] = {
        "format_version": _VERSION,
        "character": character.name,
        "roles": {} if character.rig is None else dict(character.rig.chosen),
        "rules": rules.to_json(),
        "source": before,
        "shown_by": list(shown_by),
        "digest": patch.digest(_KEY),
    }


def _brief(source: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the source's animations without the rotation and translation of joints.

    The rest determines which parts belong to a character and which faces are ever visible.
    """
    joints = {node for skin in source.get("skins", ()) for node in skin["joints"]}
    briefs = []
    for animation in source.get(_CLIPS, ()):
        showing_channels = [
            channel
            for channel in animation.get("channels", ())
            if channel["target"].get("path") in _SHOWING
            or channel["target"].get("node") not in (None, *joints)
        ]
        if showing_channels:
            samplers = [animation["samplers"][channel["sampler"]] for channel in showing_channels]
            channels = [channel | {"sampler": n} for n, channel in enumerate(showing_channels)]
            briefs.append({"channels": channels, "samplers": samplers})
    return briefs


@dataclass(frozen=True)
class _Record:
    """The checked entries of the record: see `add_source_record`."""

    character: str
    roles: dict[str, str]
    source: dict[str, Any]
    shown_by: list[int]


@dataclass(frozen=True, eq=False)
class OwnFile:
    """A file that this program wrote with a pose in it.

    Attributes
    ----------
    character : the character in its rest pose, without clips
    vertices : (V, 3) float64 array, the pose
    rules : contact rules of the character
    roles : roles of its joints set by the user, by joint name
    """

    character: Character
    vertices: FloatArray
    rules: ContactRules
    roles: dict[str, str]


def read_own_file(document: SceneDocument) -> OwnFile | None:
    """Read a file that this program wrote with a pose in it; None for any other.

    Raises
    ------
    MeshFileError : another program has changed it since, or it is damaged or of another version.
    """
    if not isinstance(document, GltfDocument):
        return None
    path = document.path
    with as_file_error(path, "can't be checked by the rules that it was exported with"):
        asset = document.description.get("asset")
        extras = asset.get("extras") if isinstance(asset, dict) else None
        description = extras.get(_KEY) if isinstance(extras, dict) else None
        if not isinstance(description, dict):
            return None
        if (version := description.get("format_version")) != _VERSION:
            raise MeshFileError.must_be(
                "its version", _VERSION, quoted(version), "update LCollision"
            )
        if description.get("digest") != document.digest(_KEY):
            raise MeshFileError("another program has changed it since", "export it again")
        try:
            record = convert(description, _Record)
        except ValidationError as error:
            what = "what it says of its source is damaged"
            raise MeshFileError(what, "export it again") from error
        rules = ContactRules.from_json(description.get("rules"))
        posed = read_shown(document)
        before = {key: record.source[key] for key in (*_CHANGED, _CLIPS) if key in record.source}
        source_document = document.described(document.description | before)
        character = character_of(scene_of(source_document), path)
        name = "".join(filter(str.isprintable, record.character))[:_LONGEST_NAME]
        character = replace(character, name=name or character.name, clips={})
        mesh = join_parts(posed)
        places = mesh.posed(posed.rest)[0][mesh.joined]
        rows: dict[int, list[FloatArray]] = {}
        for part, own in zip(posed.parts, posed.rows, strict=True):
            rows.setdefault(part.node, []).append(places[own])
        in_order = [rows[node].pop(0) for node in record.shown_by if rows.get(node)]
        points = np.concatenate(in_order) if in_order else np.empty((0, 3))
        if points.shape != (len(character.joined), 3):
            raise MeshFileError("its vertices are not those of its source", "export it again")
        vertices = np.empty_like(character.rest_vertices)
        vertices[character.joined] = points
        return OwnFile(character, vertices, rules, record.roles)


_SAME = 1e-6
"""Largest displacement, normalised, of a vertex that counts as unmoved."""

_LARGEST_ERROR = 1e-5
"""Largest error, normalised, of the vertices in a written pose."""

_SAME_TRANSFORM = 1e-9
"""Largest change of a joint's transform, relative to its largest entry, that is rounding error."""

_SAME_NUMBER = 1e-6
"""Largest relative change of a translation or scale for which the file's numbers are kept."""

_OTHER_FORM = "write a point cache (.pc2), or each pose in a file of its own"

_WRITTEN_SUFFIXES = (".glb", ".vrm")


class CharacterForm(StrEnum):
    """Export form of a pose in a character's file.

    JOINTS turns the joints of its skins. MESH is a static mesh without skin. MORPH adds a morph
    target of weight 1 and keeps the shape of the source as the base.
    """

    JOINTS = "joints"
    MESH = "mesh"
    MORPH = "morph"


@dataclass(frozen=True, eq=False)
class PosedFile:
    """A file that holds a pose.

    Attributes
    ----------
    vertices : (V, 3) float64 array, the character's vertices as readers of the file see them
    notes : sentences on what was left out
    """

    vertices: FloatArray
    notes: tuple[str, ...]


def write_character(
    path: str | os.PathLike[str],
    character: Character,
    vertices: npt.NDArray[Any],
    form: CharacterForm | str,
    transforms: FloatArray | None = None,
    rules: ContactRules = STRICT,
    *,
    shapes: FloatArray | None = None,
    keep_clips: bool = False,
) -> PosedFile:
    """Write the character's own .glb, .gltf or .vrm file with a pose, atomically.

    Textures, UVs, materials, extras and extensions stay byte for byte, and so do the number and
    order of vertices. Clips that move the character are left out unless `keep_clips`, because
    viewers would show them instead of the pose; clips of cameras and lights stay.

    Parameters
    ----------
    path : a .glb file, or a .vrm file if the character is from one
    character : read from such a file, or converted by `as_gltf`
    vertices : (V, 3) finite array, in its frame and unit
    form : export form of the pose
    transforms : (J, 4, 4) global transforms of the joints, for the form JOINTS
    rules : contact rules of the character, stored in the file: see `read_own_file`
    shapes : (S,) sliders of its morph targets, for the form JOINTS; at rest if None
    keep_clips : whether clips stay and play as before; for the form JOINTS only

    Returns
    -------
    the written file; check its `vertices`

    Raises
    ------
    ShapeError : a shape is wrong, or `transforms` are missing.
    MeshFileError : the format of the source or of `path` cannot be written, the source cannot be
        read or has changed, or the file would be too large.

    Notes
    -----
    If a form cannot hold the pose, for example because the matrix of a joint's node has shear, MESH
    is written instead, with a note.
    """
    require_written(path, character)
    form = CharacterForm(form)
    if vertices.shape != character.rest_vertices.shape:
        expected = f"of shape {character.rest_vertices.shape}"
        raise ShapeError.must_be(f"vertices of {character.name}", expected, vertices.shape)
    if form is CharacterForm.JOINTS and (character.rig is None or transforms is None):
        raise ShapeError.must_be("a pose in joints", "of a rig, with transforms", "none")
    if keep_clips and form is not CharacterForm.JOINTS:
        raise ShapeError.must_be("a pose with clips", f"of the form {CharacterForm.JOINTS}", form)
    file = _file_of(character)
    pose = np.asarray(vertices, dtype=np.float64)
    notes: list[str] = []
    with as_file_error(character.source, "cannot be written with this pose"):
        source = _Source(character, file)
        try:
            if form is CharacterForm.JOINTS:
                assert character.rig is not None
                assert transforms is not None
                stored = source.turn_joints(character.rig, transforms, shapes)
            elif form is CharacterForm.MORPH:
                stored = source.add_morph(pose)
            else:
                stored = source.bake(pose)
            source.require_near(stored, pose)
        except UnwritablePoseError as error:
            source, keep_clips = _Source(character, file), False
            stored = source.bake(pose)
            notes.append(f"{error.what}, so it is written as a static mesh")
        clips: list[str] = []
        if keep_clips:
            source.hold_clips()
        else:
            clips = source.drop_clips()
        data = source.signed(rules)
    if clips:
        notes.append(left_out_note("clips left out, as they would hide the pose", clips))
    write_bytes(path, data)
    return PosedFile(stored, (*source.patch.notes, *notes))


@dataclass(frozen=True, eq=False)
class NewClip:
    """A new clip of the joints for a character's file.

    Attributes
    ----------
    name : name of the clip; numbered if the file has one of that name
    fps : frames per second
    transforms : (N, J, 4, 4) global transforms of the joints
    vertices : N arrays (V, 3) that the joints must reproduce, in the character's frame and unit
    shapes : (N, S) sliders of its morph targets; at rest if None
    """

    name: str
    fps: float
    transforms: FloatArray
    vertices: Iterable[npt.NDArray[Any]]
    shapes: FloatArray | None = None


def write_character_clips(
    path: str | os.PathLike[str],
    character: Character,
    clips: Sequence[NewClip],
    seen: Callable[[int, FloatArray], object],
    rules: ContactRules = STRICT,
    *,
    keep_clips: bool = False,
) -> tuple[str, ...]:
    """Write the character's own file with new clips of its joints before any others.

    Parameters
    ----------
    path, rules : see `write_character`
    character : see `write_character`; it must have a rig
    clips : at least one clip
    seen : called in order for each frame of each clip with the clip's number and the (V, 3)
        vertices that readers of the file see
    keep_clips : whether its other clips stay, after these

    Returns
    -------
    notes : sentences on what was left out

    Raises
    ------
    MeshFileError : see `write_character`; or the joints cannot reproduce a frame.
    """
    require_written(path, character)
    file = _file_of(character)
    assert character.rig is not None
    with as_file_error(character.source, "cannot be written with these poses"):
        source = _Source(character, file)
        left_out = [] if keep_clips else source.drop_clips()
        clip_names = [
            str(animation.get("name") or "") for animation in source.patch.objects("animations")
        ]
        names = make_unique([*clip_names, *(clip.name for clip in clips)])[len(clip_names) :]
        for number, (clip, name) in enumerate(zip(clips, names, strict=True)):
            stored = source.animate(character.rig, clip, name, number)
            for track, frame_vertices in zip(stored, clip.vertices, strict=True):
                source.require_near(track, frame_vertices)
                seen(number, track)
        data = source.signed(rules)
    notes = source.patch.notes
    if left_out:
        notes = (*notes, left_out_note("clips left out", left_out))
    write_bytes(path, data)
    return notes


def require_written(path: str | os.PathLike[str], character: Character) -> None:
    """Refuse a format in which the character's own file cannot be written.

    Raises
    ------
    MeshFileError : the extension of `path` is not one of its formats.
    """
    suffix, target = Path(character.source).suffix.lower(), Path(path).suffix.lower()
    if target not in _WRITTEN_SUFFIXES or (target == ".vrm" and suffix != ".vrm"):
        raise MeshFileError.unwritable(
            path, f"the character of a {suffix} file is written as .glb", "rename it"
        )


def _file_of(character: Character) -> CharacterFile:
    """Return the file to write: as it was read, or as it is now if the mesh is unchanged.

    Raises
    ------
    MeshFileError : the file cannot be read, or no longer has the character's mesh.
    """
    path, file = Path(character.source), character.file
    with as_file_error(path):
        if file is not None and path.suffix.lower() not in GLTF_SUFFIXES:
            # `as_gltf` made it from the original.
            return file
        data = read_regular(path, MAX_FILE_BYTES)
        if file is None or file.document.sha256 != hashlib.sha256(data).digest():
            scene = scene_of(GltfDocument(data, path))
            file = CharacterFile(scene, join_parts(scene))
            if not (
                np.array_equal(file.mesh.joined, character.joined)
                and np.array_equal(file.rest, character.rest_vertices)
            ):
                raise MeshFileError(
                    "it is not the file that the character was read from", "open it again"
                )
        _ = file.editable, file.stored_normals
    return file


class _Source:
    """The file of a character, to be written with a pose or clips.

    Attributes
    ----------
    patch : the file to write
    size : body size
    """

    def __init__(self, character: Character, file: CharacterFile) -> None:
        self._character, self._file = character, file
        self.patch = file.editable.copy()
        self.size = body_size(character.rest_vertices, character.topology)
        self._nodes: list[dict[str, Any]] = self.patch.description["nodes"]
        self._scene, self._rest, self._joined = file.scene, file.rest, character.joined
        self._parts = file.parts
        self._shown_by = [part.node for part, _, _ in file.parts]

    def signed(self, rules: ContactRules) -> bytes:
        """Return the bytes of the file, with the record of its source."""
        character, source = self._character, self._file.editable.description
        if character.rig is not None:
            add_source_record(self.patch, source, character, self._shown_by, rules)
        return self.patch.encoded()

    def require_near(self, stored: FloatArray, wanted: npt.NDArray[Any]) -> None:
        """Refuse a form that does not reproduce the wanted vertices."""
        error = float(np.abs(stored - wanted).max()) / self.size
        if not error <= _LARGEST_ERROR:
            raise UnwritablePoseError(
                "its joints cannot reproduce this pose (vertices would be off by "
                f"{error:.2g} of the body size)",
                _OTHER_FORM,
            )

    def turn_joints(
        self, rig: Rig, transforms: FloatArray, shapes: FloatArray | None
    ) -> FloatArray:
        """Set the global transforms of the joints' nodes, and return the vertices.

        Set the weights of morph targets too, from (S,) sliders, if they differ from those at rest.
        """
        weights = self._weights(rig, shapes)
        for number, own in self._reweighed(weights).items():
            self._nodes[number]["weights"] = own[0].tolist()

        def hold(number: int, local: FloatArray) -> FloatArray:
            node = self._nodes[number]
            kept = _parts_to_store(node, local)
            for name, stored, new in zip(PARTS, stored_parts(node), kept, strict=True):
                if "matrix" in node or not np.array_equal(stored, new):
                    node[name] = new.tolist()
            node.pop("matrix", None)
            return compose(*kept)

        return self._posed(rig, transforms, hold, weights)

    def _weights(self, rig: Rig, shapes: FloatArray | None) -> tuple[FloatArray, ...]:
        """Return the (N, M) weights of each part's morph targets for (N, S) or (S,) sliders."""
        at_rest = self._scene.rest.weights
        if rig.shapes is None or shapes is None:
            return at_rest
        return rig.shapes.weights(np.atleast_2d(shapes), at_rest)

    def _reweighed(self, weights: tuple[FloatArray, ...]) -> dict[int, FloatArray]:
        """Return the (N, M) weights of the nodes whose weights differ from those at rest."""
        parts, at_rest = self._scene.parts, by_node(self._scene.parts, self._scene.rest.weights)
        weights_of_node = by_node(parts, weights)
        return {node: own for node, own in weights_of_node.items() if (own != at_rest[node]).any()}

    def animate(self, rig: Rig, clip: NewClip, name: str, place: int) -> Iterator[FloatArray]:
        """Add a clip of the joints' nodes and morph targets, and yield each frame's vertices.

        The clip is added once all frames have been consumed.

        Parameters
        ----------
        place : index of the clip among the file's
        """
        transforms, weights = clip.transforms, self._weights(rig, clip.shapes)
        keys: dict[int, list[FloatArray]] = {}
        for frame, pose in enumerate(transforms):

            def hold(number: int, local: FloatArray, frame: int = frame) -> FloatArray:
                node = self._nodes[number]
                if number not in keys:
                    keys[number] = [
                        np.tile(part, (len(transforms), 1)) for part in stored_parts(node)
                    ]
                kept = _parts_to_store(node, local)
                for key, part in zip(keys[number], kept, strict=True):
                    key[frame] = part
                return compose(*kept)

            frame_weights = (one[min(frame, len(one) - 1)][None] for one in weights)
            yield self._posed(rig, pose, hold, tuple(frame_weights))
        seconds = np.arange(len(transforms)) / clip.fps
        times = self.patch.add_array(seconds[:, None], has_bounds=True)
        animation: dict[str, Any] = {"name": name, "samplers": [], "channels": []}
        if clip.fps < LEAST_RATE:
            animation["extras"] = {KEYS_ARE_FRAMES: True}
        for number, tracks in keys.items():
            node = self._nodes[number]
            for part, stored, values in zip(PARTS, stored_parts(node), tracks, strict=True):
                if "matrix" not in node and (values == stored).all():
                    continue
                if part == "rotation":
                    values *= signs_on_one_side(values)[:, None]
                self.patch.add_channel(animation, times, number, part, values)
            if "matrix" in node:
                # Animated nodes must not have a matrix.
                set_parts(node, [track[0] for track in tracks])
        for number, values in self._reweighed(weights).items():
            self.patch.add_channel(animation, times, number, "weights", values.reshape(-1, 1))
        still = [number for number in rig.nodes.tolist() if "matrix" not in self._nodes[number]]
        if still and not animation["channels"]:
            # A clip needs at least one channel.
            moved = np.tile(stored_parts(self._nodes[still[0]])[0], (len(transforms), 1))
            self.patch.add_channel(animation, times, still[0], "translation", moved)
        if animation["channels"]:
            self.patch.description.setdefault("animations", []).insert(place, animation)

    def _posed(
        self,
        rig: Rig,
        transforms: FloatArray,
        hold: Callable[[int, FloatArray], FloatArray],
        weights: tuple[FloatArray, ...],
    ) -> FloatArray:
        """Return the vertices with these global transforms of the joints' nodes.

        Parameters
        ----------
        hold : stores a new local transform of a node, by its number, and returns it as rounded by
            the file
        weights : (1, M) weights of each part's morph targets
        """
        parents, rest = self._scene.parents, self._scene.rest.transforms[0]
        joints = set(rig.nodes.tolist())
        wanted_transforms, placed = rest.copy(), rest.copy()
        wanted_transforms[rig.nodes] = transforms
        for number in parents_first(parents):
            parent, local = int(parents[number]), self._file.locals[number]
            above, wanted_above = (
                (placed[parent], wanted_transforms[parent]) if parent >= 0 else (IDENTITY, IDENTITY)
            )
            if number in joints:
                new = _relative(wanted_above, wanted_transforms[number])
                if np.abs(new - local).max() > _SAME_TRANSFORM * np.abs(new).max():
                    # Relative to the parent as stored, so that rounding errors do not add up.
                    local = hold(number, _relative(above, wanted_transforms[number]))
            else:
                wanted_transforms[number] = wanted_above @ local
            placed[number] = above @ local
        posed: FloatArray = self._file.mesh.posed(ScenePoses(placed[None], weights))[0]
        return posed

    def bake(self, vertices: FloatArray) -> FloatArray:
        """Make the parts that move static meshes in scene coordinates, and return the vertices."""
        stored = vertices.astype(np.float32).astype(np.float64)
        normals = self._file.normals(vertices)
        skinned = {part.node for part, _, _ in self._parts if part.is_skinned}
        moves = np.abs(vertices - self._rest).max(axis=1) > _SAME * self.size
        moving = {part.node for part, _, rows in self._parts if moves[self._joined[rows]].any()}
        had_morphs = False
        for part, shown_part, rows in self._parts:
            joined = self._joined[rows]
            if part.node not in skinned | moving:
                stored[joined] = self._rest[joined]
                continue
            primitive = self._own_mesh(shown_part)["primitives"][shown_part.primitive]
            attributes = primitive["attributes"]
            attributes["POSITION"] = self.patch.add_vertex_data(stored[joined], has_bounds=True)
            if "NORMAL" in attributes:
                attributes["NORMAL"] = self.patch.add_vertex_data(normals[rows])
            # Readers compute tangents from the normals and UVs.
            for name in [name for name in attributes if name.startswith(("JOINTS_", "WEIGHTS_"))]:
                del attributes[name]
            attributes.pop("TANGENT", None)
            had_morphs |= bool(primitive.pop("targets", None))
        for node in sorted(skinned | moving):
            mesh = self.patch.description["meshes"][self._nodes[node]["mesh"]]
            mesh.pop("weights", None)
            if isinstance(mesh.get("extras"), dict):
                mesh["extras"].pop("targetNames", None)
            self._move_to_root(node)
        if had_morphs:
            self._drop_binds()
            self.patch.notes += ("its morph targets are left out of the static mesh",)
        if not any("skin" in node for node in self._nodes):
            self.patch.description.pop("skins", None)
        return stored

    def _drop_binds(self) -> None:
        """Remove the weights of missing morph targets from the expressions of a VRM."""
        meshes = [
            number
            for number, mesh in enumerate(self.patch.description["meshes"])
            if any("targets" in primitive for primitive in mesh.get("primitives", ()))
        ]
        nodes = [number for number, node in enumerate(self._nodes) if node.get("mesh") in meshes]
        # VRM 0 refers to the mesh, VRM 1 to its node.
        kinds = (("binds", "mesh", meshes), ("morphTargetBinds", "node", nodes))
        left: list[Any] = [self.patch.description.get("extensions")]
        while left:
            one = left.pop()
            for name, key, fitting in kinds if isinstance(one, dict) else ():
                if isinstance(one.get(name), list):
                    one[name] = [
                        bind
                        for bind in one[name]
                        if not isinstance(bind, dict) or key not in bind or bind[key] in fitting
                    ]
            if isinstance(one, dict | list):
                left += one.values() if isinstance(one, dict) else one

    def add_morph(self, vertices: FloatArray) -> FloatArray:
        """Add a morph target of weight 1 to each mesh, and return the vertices."""
        stored = np.empty_like(vertices)
        normals = self._file.normals(vertices)
        rest = self._scene.rest.transforms[0]
        for (part, shown_part, rows), weights, own_normals in zip(
            self._parts, self._scene.rest.weights, self._file.stored_normals, strict=True
        ):
            turns = blended(part, rest)
            base = part.points + np.tensordot(weights[0], part.morphs, axes=1)
            target_offsets = vertices[self._joined[rows]] - turns[:, :, 3]
            try:
                offsets = np.linalg.solve(turns[:, :, :3], target_offsets[:, :, None])[:, :, 0]
            except np.linalg.LinAlgError as error:
                raise UnwritablePoseError(
                    "its joints flatten vertices at rest, which a morph target cannot undo"
                ) from error
            deltas = (offsets - base).astype(np.float32)
            moved = np.einsum("vij,vj->vi", turns[:, :, :3], base + deltas)
            stored[self._joined[rows]] = moved + turns[:, :, 3]
            mesh = self._file.editable.description["meshes"][shown_part.mesh]
            primitive = self._own_mesh(shown_part)["primitives"][shown_part.primitive]
            target = {"POSITION": self.patch.add_vertex_data(deltas, has_bounds=True)}
            if own_normals is not None:
                # Readers transform normals by the inverse transpose.
                turned = np.einsum("vij,vi->vj", turns[:, :, :3], normals[rows])
                target["NORMAL"] = self.patch.add_vertex_data(unit(turned) - own_normals)
            most = max(len(primitive.get("targets", ())) for primitive in mesh["primitives"])
            self._fill_targets(primitive, most)
            primitive["targets"].append(target)
        for node in {part.node for part, _, _ in self._parts}:
            self._weigh_morph(self._nodes[node])
        return stored

    def _weigh_morph(self, node: dict[str, Any]) -> None:
        """Set the weight of the last morph target of a node's mesh, and a name if all have one."""
        mesh = self.patch.description["meshes"][node["mesh"]]
        n_targets = max(len(primitive.get("targets", ())) for primitive in mesh["primitives"])
        for primitive in mesh["primitives"]:
            # Primitives of lines and points too.
            self._fill_targets(primitive, n_targets)
        for owner in (mesh, node):
            if owner is mesh or "weights" in owner:
                given = list(owner.get("weights", ()))[: n_targets - 1]
                owner["weights"] = given + [0.0] * (n_targets - 1 - len(given)) + [1.0]
        extras = mesh.setdefault("extras", {}) if n_targets == 1 else mesh.get("extras")
        if isinstance(extras, dict):
            names = extras.get("targetNames", [])
            if isinstance(names, list) and len(names) == n_targets - 1:
                extras["targetNames"] = [*names, "pose"]

    def _fill_targets(self, primitive: dict[str, Any], n_targets: int) -> None:
        """Add empty morph targets, as all primitives of a mesh must have the same number."""
        position = primitive["attributes"].get("POSITION")
        while position is not None and len(primitive.setdefault("targets", [])) < n_targets:
            zeros = np.zeros((self.patch.description["accessors"][position]["count"], 3))
            primitive["targets"].append(
                {"POSITION": self.patch.add_vertex_data(zeros, has_bounds=True)}
            )

    def drop_clips(self) -> list[str]:
        """Remove the animations that move the character, and return their names."""
        animations = self.patch.description.pop("animations", [])
        hiding = self._hiding(animations)
        kept_animations = [
            animation for number, animation in enumerate(animations) if number not in hiding
        ]
        if kept_animations:
            self.patch.description["animations"] = kept_animations
        return [str(animations[number].get("name", f"animation {number}")) for number in hiding]

    def hold_clips(self) -> None:
        """Add constant channels for the old values that the pose changed and no channel drives."""
        before = self._file.editable.objects("nodes")
        changed = [
            (number, path, old)
            for number, (node, was) in enumerate(zip(self._nodes, before, strict=True))
            for path, old, new in zip(PARTS, stored_parts(was), stored_parts(node), strict=True)
            if not np.array_equal(old, new)
        ]
        changed += [
            (number, "weights", at_rest[0])
            for number, at_rest in by_node(self._scene.parts, self._scene.rest.weights).items()
            if self._nodes[number].get("weights") != before[number].get("weights")
        ]
        animations = self.patch.description.get("animations", [])
        for number in self._hiding(animations):
            samplers = [*animations[number].get("samplers", ())]
            channels = [*animations[number].get("channels", ())]
            # Use existing times of the animation: others might make it longer.
            times = samplers[channels[0]["sampler"]]["input"]
            n_times = self.patch.description["accessors"][times]["count"]
            driven = {
                (channel["target"].get("node"), channel["target"].get("path"))
                for channel in channels
            }
            for node, path, old in changed:
                if (node, path) in driven:
                    continue
                channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
                width = 1 if path == "weights" else len(old)
                still = self.patch.add_array(np.tile(old, n_times).reshape(-1, width))
                samplers.append({"input": times, "output": still})
            animation = {"samplers": samplers, "channels": channels}
            animations[number] = animations[number] | animation

    def _hiding(self, animations: list[dict[str, Any]]) -> list[int]:
        """Return the numbers of the animations that move the character."""
        parents = self._scene.parents
        shaping = {part.node for part, _, _ in self._parts}
        for part, _, _ in self._parts:
            shaping |= set(part.bones[np.unique(part.bone_of[part.weights > 0.0])].tolist())
        for node in reversed(parents_first(parents)):
            if node in shaping and parents[node] >= 0:
                shaping.add(int(parents[node]))

        def shows_pose(animation: dict[str, Any]) -> bool:
            targets = [channel["target"] for channel in animation.get("channels", ())]
            # A target without node may point to anything, by an extension.
            return all("node" in target and target["node"] not in shaping for target in targets)

        return [number for number, animation in enumerate(animations) if not shows_pose(animation)]

    def _own_mesh(self, shown: Primitive) -> dict[str, Any]:
        """Return the mesh of a node, copied first if other nodes show it too."""
        meshes: list[dict[str, Any]] = self.patch.description["meshes"]
        node = self._nodes[shown.node]
        if shown.n_instances > 1:
            raise MeshFileError(
                f"its node {node.get('name', shown.node)} shows a mesh {shown.n_instances} times, "
                "which cannot take as many shapes",
                f"choose {CharacterForm.JOINTS}, or a file of meshes",
            )
        if sum(other.get("mesh") == node["mesh"] for other in self._nodes) > 1:
            meshes.append(deepcopy(meshes[node["mesh"]]))
            node["mesh"] = len(meshes) - 1
        mesh: dict[str, Any] = meshes[node["mesh"]]
        return mesh

    def _move_to_root(self, number: int) -> None:
        """Remove a node's skin, and move its mesh to where local coordinates are the scene's."""
        node = self._nodes[number]
        node.pop("skin", None)
        node.pop("weights", None)
        if np.array_equal(self._scene.rest.transforms[0, number], IDENTITY):
            return
        description = self.patch.description
        if not node.keys() <= {*PARTS, "matrix", "name", "mesh", "extras"}:
            # The node has further uses, such as children, so move only its mesh.
            self._nodes.append({"name": node.get("name", "mesh"), "mesh": node.pop("mesh")})
            new = len(self._nodes) - 1
            self._shown_by = [new if shown == number else shown for shown in self._shown_by]
            number = new
        else:
            for name in (*PARTS, "matrix"):
                node.pop(name, None)
            for other in self._nodes:
                if number in other.get("children", ()):
                    other["children"].remove(number)
                    if not other["children"]:
                        del other["children"]
        if description.get("scenes"):
            roots = description["scenes"][description.get("scene", 0)].setdefault("nodes", [])
            if number not in roots:
                roots.append(number)


def _relative(above: FloatArray, transform: FloatArray) -> FloatArray:
    """Return a global transform relative to that of its parent."""
    try:
        return np.linalg.solve(above, transform).astype(np.float64)
    except np.linalg.LinAlgError as error:
        raise UnwritablePoseError("a joint's parent has zero scale", _OTHER_FORM) from error


def _parts_to_store(
    node: dict[str, Any], local: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the translation, rotation and scale that a file stores for a local transform.

    An unchanged translation or scale, as of a joint that only turns, is that of the node.
    """
    old_translation, _, old_scale = stored_parts(node)
    # Axes that the node reflects.
    signs = np.where(old_scale < 0.0, -1.0, 1.0)
    translation, rotation, scale = decompose(local * np.append(signs, 1.0))
    return (
        _kept(old_translation, translation),
        rotation.astype(np.float32).astype(np.float64),
        _kept(old_scale, signs * scale),
    )


def _kept(old: FloatArray, new: FloatArray) -> FloatArray:
    if np.abs(new - old).max() <= _SAME_NUMBER * np.abs(new).max():
        return old
    return new.astype(np.float32).astype(np.float64)
