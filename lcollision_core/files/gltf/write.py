"""Write a mesh, or a scene read from another format, as glTF."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.files.gltf.schema import INDICES, PARTS, GltfDocument
from lcollision_core.files.scene.appearance import (
    Appearance,
    Material,
    Texture,
    Wrap,
    linear_colours,
)
from lcollision_core.files.scene.joined import sample_clip
from lcollision_core.files.scene.scene import (
    Part,
    Scene,
    is_mirrored,
    left_out_note,
    parents_first,
)
from lcollision_core.files.scene.transforms import (
    are_regular,
    compose,
    decompose,
    signs_on_one_side,
)
from lcollision_core.meshes.normals import unit
from lcollision_core.meshes.topology import FloatArray, Int64Array


def encode(vertices: npt.NDArray[Any], faces: npt.NDArray[np.int32]) -> bytes:
    """Write triangles as GLB, float32, with smooth normals.

    Parameters
    ----------
    vertices : (V, 3) float32 or float64 array; glTF keeps float32 only
    faces : (F, 3) int32 array, indices from 0
    """
    import trimesh

    mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    return bytes(trimesh.Scene(mesh).export(file_type="glb", include_normals=True))


_WRAPS = {Wrap.REPEAT: 10497, Wrap.MIRROR: 33648, Wrap.CLAMP: 33071}

_SHEAR = 1e-6
"""Largest shear of a node's local matrix, relative to its largest entry, that is ignored."""

_STILL = 1e-9
"""Largest change, relative to the size of the scene, a rotation or a scale, that is rounding
error."""

_MOST_SHORT = 1 << 16
"""Number of vertices from which indices need more than two bytes."""


@dataclass(frozen=True, eq=False)
class MadeGltf:
    """A glTF file made from a scene.

    Attributes
    ----------
    data : the file as GLB
    vertices : (W,) int64 array, the vertex of the original scene's parts for each vertex of the
        file, in the order in which the file is read
    delays : seconds by which each clip begins later, as glTF has no negative times
    notes : sentences on what could not be kept
    """

    data: bytes
    vertices: Int64Array
    delays: dict[str, float]
    notes: tuple[str, ...]


def gltf_of(scene: Scene, place: FloatArray, name: str, path: Path) -> MadeGltf:
    """Make a glTF file of a scene with all its nodes, in the same order, parts, skins and clips.

    Points keep their order, except where materials, texture coordinates or normals split them.
    Clips get linear keys at their rate. A node that its parent would shear, which glTF cannot
    store, is moved to the root, where it moves as before.

    Parameters
    ----------
    scene : from any format
    place : (4, 4) similarity from the scene's coordinates to metres with y up
    name : name for roots that have none
    path : path of the scene's file

    Raises
    ------
    MeshFileError : a clip is damaged or has too many frames, or the file would be too large.
    """
    return _Maker(scene, place, name, path).made()


class _Maker:
    """The glTF file of a scene while it is made: see `gltf_of`."""

    def __init__(self, scene: Scene, place: FloatArray, name: str, path: Path) -> None:
        self._scene, self._name = scene, name
        self._file = GltfDocument.empty(path)
        self._parents = scene.parents.copy()
        self._notes: list[str] = []
        self._hung: list[str] = []
        self._materials: dict[tuple[Any, ...], int] = {}
        self._textures: dict[int, int] = {}
        self._times: dict[str, FloatArray] = {}
        # The rest pose, then each clip: wanted transforms, and those that glTF can store.
        self._poses = [scene.rest]
        for clip in scene.clips:
            times, poses = sample_clip(scene, clip.name, clip.rate)
            self._times[clip.name] = times
            self._poses.append(poses)
        self._wanted = [place @ poses.transforms for poses in self._poses]
        self._placed = [np.empty_like(wanted) for wanted in self._wanted]
        hung = {node: self._hang(node) for node in parents_first(scene.parents)}
        self._tracks = [hung[node] for node in range(len(hung))]

    def made(self) -> MadeGltf:
        description = self._file.description
        description["nodes"] = self._nodes()
        roots = np.flatnonzero(self._parents < 0).tolist()
        description |= {"scene": 0, "scenes": [{"nodes": roots}], "meshes": []}
        pairs = zip(self._scene.parts, self._scene.rows, strict=True)
        vertices = [rows.start + self._add_part(n, part) for n, (part, rows) in enumerate(pairs)]
        delays = {name: max(0.0, -float(times[0])) for name, times in self._times.items()}
        animations = [
            self._animation(number, clip.name, clip.moved, delays[clip.name])
            for number, clip in enumerate(self._scene.clips, 1)
        ]
        if animations:
            description["animations"] = animations
        data = self._file.encoded()
        if self._hung:
            why = "moved to the root, as glTF would stretch them with their parents"
            self._notes.append(left_out_note(why, self._hung))
        notes = (*self._file.notes, *dict.fromkeys(self._notes))
        return MadeGltf(data, np.concatenate(vertices), delays, notes)

    def _hang(self, node: int) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """Return a node's translations, rotations and scales in each pose, below the best parent.

        Call it for ancestors first.
        """
        parent = int(self._parents[node])
        transform, missed = self._below(node, parent)
        name = self._scene.node_names[node] or f"node {node}"
        top = parent
        while top >= 0 and self._parents[top] >= 0:
            top = int(self._parents[top])
        if missed > _SHEAR and top != parent:
            other, left = self._below(node, top)
            if left < missed:
                transform, missed, parent, self._parents[node] = other, left, top, top
                self._hung.append(name)
        if missed > _SHEAR:
            self._notes.append(f"{name} is sheared, which glTF cannot hold: the shear is left out")
        for placed, parts in zip(self._placed, transform, strict=True):
            placed[:, node] = self._above(placed, parent) @ compose(*parts)
        return transform

    def _below(
        self, node: int, parent: int
    ) -> tuple[list[tuple[FloatArray, FloatArray, FloatArray]], float]:
        """Return a node's transform parts below `parent`, and the shear that they lose."""
        transforms, missed = [], 0.0
        for wanted, placed in zip(self._wanted, self._placed, strict=True):
            above = self._above(placed, parent)
            local = np.tile(np.eye(4), (len(wanted), 1, 1))
            regular = are_regular(above)
            local[regular] = np.linalg.solve(above[regular], wanted[regular, node])
            parts = decompose(local)
            lost = np.abs(compose(*parts) - local)[:, :3, :3].max(axis=(1, 2))
            size = np.abs(local[:, :3, :3]).max(axis=(1, 2))
            missed = max(missed, float((lost / np.where(size > 0.0, size, 1.0)).max()))
            transforms.append(parts)
        return transforms, missed

    @staticmethod
    def _above(placed: FloatArray, parent: int) -> FloatArray:
        if parent >= 0:
            return placed[:, parent]
        return np.broadcast_to(np.eye(4), (len(placed), 4, 4))

    def _nodes(self) -> list[dict[str, Any]]:
        nodes: list[dict[str, Any]] = []
        for number, name in enumerate(self._scene.node_names):
            node: dict[str, Any] = {}
            if name or self._parents[number] < 0:
                node["name"] = name or self._name
            rest = self._tracks[number][0]
            for (path, default), part in zip(PARTS.items(), rest, strict=True):
                if tuple(part[0].tolist()) != default:
                    node[path] = part[0].tolist()
            children = np.flatnonzero(self._parents == number).tolist()
            if children:
                node["children"] = children
            nodes.append(node)
        return nodes

    def _add_part(self, number: int, part: Part) -> Int64Array:
        """Add the mesh of a part, and return the part's vertex for each one in the file."""
        look = _ordered(_look(part), len(part.points))
        self._notes += look.notes
        node = self._file.description["nodes"][part.node]
        bind, bones, bone_of = part.bind, part.bones, part.bone_of
        turn = np.eye(4)
        if not part.is_skinned:
            # The node itself moves it.
            turn, bind = part.bind[0], np.eye(4)[None]
        rest = self._placed[0][0]
        faces = look.faces
        if is_mirrored(rest[bones] @ bind, bone_of, part.weights):
            # Readers flip them.
            faces = faces[:, [0, 2, 1]]
        attributes = {
            "POSITION": self._file.add_vertex_data(
                part.points[look.vertices] @ turn[:3, :3].T + turn[:3, 3], has_bounds=True
            )
        }
        if look.normals is not None:
            normals = unit(look.normals @ np.linalg.pinv(turn[:3, :3]))
            normals[~normals.any(axis=1), 1] = 1.0
            attributes["NORMAL"] = self._file.add_vertex_data(normals)
        if look.uv.any():
            attributes["TEXCOORD_0"] = self._file.add_vertex_data(look.uv)
        if part.is_skinned:
            attributes |= self._influences(part, look.vertices)
            inverse = self._file.add_array(bind.transpose(0, 2, 1).reshape(-1, 16))
            skins = self._file.description.setdefault("skins", [])
            skins.append({"joints": bones.tolist(), "inverseBindMatrices": inverse})
            node["skin"] = len(skins) - 1
        targets = [
            {
                "POSITION": self._file.add_vertex_data(
                    morph[look.vertices] @ turn[:3, :3].T, has_bounds=True
                )
            }
            for morph in part.morphs
        ]
        mesh: dict[str, Any] = {
            "name": part.mesh,
            "primitives": self._primitives(part, look, faces, attributes),
        }
        if targets:
            for primitive in mesh["primitives"]:
                primitive["targets"] = targets
            mesh["weights"] = self._poses[0].weights[number][0].tolist()
            if len(part.sliders) == len(targets):
                mesh["extras"] = {"targetNames": list(part.sliders)}
        meshes = self._file.description["meshes"]
        meshes.append(mesh)
        node["mesh"] = len(meshes) - 1
        return np.tile(look.vertices, len(mesh["primitives"]))

    def _primitives(
        self, part: Part, look: Appearance, faces: Int64Array, attributes: dict[str, int]
    ) -> list[dict[str, Any]]:
        """Return a primitive for each material, all on the same vertices to keep their order."""
        kinds, kind_of = np.unique(
            np.stack([part.material_of, look.material_of], axis=1), axis=0, return_inverse=True
        )
        colours, primitives = linear_colours(look.colours), []
        colour_accessor: int | None = None
        for kind, (named, drawn) in enumerate(kinds.tolist()):
            kind_faces = faces[kind_of.reshape(-1) == kind]
            dtype = np.uint16 if len(look.vertices) < _MOST_SHORT else np.uint32
            indices = self._file.add_array(kind_faces.reshape(-1, 1).astype(dtype), target=INDICES)
            kind_attributes, colour = dict(attributes), colours[kind_faces[0, 0]]
            if (colours[kind_faces] != colour).any():
                colour = np.ones(4)
                if colour_accessor is None:
                    colour_accessor = self._file.add_vertex_data(colours)
                kind_attributes["COLOR_0"] = colour_accessor
            name = part.materials[named] if 0 <= named < len(part.materials) else ""
            primitive: dict[str, Any] = {"attributes": kind_attributes, "indices": indices}
            material = look.materials[drawn]
            if name or material.texture is not None or (colour != 1.0).any():
                primitive["material"] = self._material(name, material, colour)
            primitives.append(primitive)
        return primitives

    def _influences(self, part: Part, vertices: Int64Array) -> dict[str, int]:
        """Return joints and weights of vertices in sets of four, strongest first."""
        strongest = np.argsort(-part.weights, axis=1, kind="stable")
        width = -(-max(int((part.weights > 0.0).sum(axis=1).max()), 1) // 4) * 4
        weights, joints = np.zeros((2, len(part.points), width))
        for pair, given in ((weights, part.weights), (joints, part.bone_of)):
            sorted_ = np.take_along_axis(given, strongest, axis=1)[:, :width]
            pair[:, : sorted_.shape[1]] = sorted_
        joints[weights == 0.0] = 0
        accessors = {}
        for first in range(0, width, 4):
            columns = slice(first, first + 4)
            numbers = joints[vertices, columns].astype(np.uint16)
            accessors[f"JOINTS_{first // 4}"] = self._file.add_vertex_data(numbers)
            accessors[f"WEIGHTS_{first // 4}"] = self._file.add_vertex_data(
                weights[vertices, columns]
            )
        return accessors

    def _material(self, name: str, material: Material, colour: FloatArray) -> int:
        key = name, id(material.texture), *colour.tolist()
        if key not in self._materials:
            surface: dict[str, Any] = {"metallicFactor": 0.0}
            if (colour != 1.0).any():
                surface["baseColorFactor"] = colour.tolist()
            if material.texture is not None:
                surface["baseColorTexture"] = {"index": self._texture(material.texture)}
            described = {"pbrMetallicRoughness": surface, "doubleSided": material.is_double_sided}
            materials = self._file.description.setdefault("materials", [])
            materials.append({"name": name, **described} if name else described)
            self._materials[key] = len(materials) - 1
        return self._materials[key]

    def _texture(self, texture: Texture) -> int:
        if id(texture) not in self._textures:
            image = self._file.add_image(texture.file)
            if image is None:
                image = self._file.add_image(_png(texture.pixels))
            description = self._file.description
            samplers = description.setdefault("samplers", [])
            wrap_s, wrap_t = (_WRAPS[wrap] for wrap in texture.wrap)
            samplers.append({"wrapS": wrap_s, "wrapT": wrap_t})
            textures = description.setdefault("textures", [])
            textures.append({"source": image, "sampler": len(samplers) - 1})
            self._textures[id(texture)] = len(textures) - 1
        return self._textures[id(texture)]

    def _animation(
        self, number: int, name: str, moved: frozenset[int], delay: float
    ) -> dict[str, Any]:
        times = self._file.add_array((self._times[name] + delay)[:, None], has_bounds=True)
        animation: dict[str, Any] = {"name": name, "channels": [], "samplers": []}
        add = partial(self._file.add_channel, animation, times)
        size = float(np.abs(self._wanted[0][..., :3, 3]).max())
        for node, tracks in enumerate(self._tracks):
            for path, rest, values in zip(PARTS, tracks[0], tracks[number], strict=True):
                if path == "rotation":
                    signs = signs_on_one_side(np.concatenate([rest, values]))
                    values = signs[1:, None] * values
                extent = size if path == "translation" else float(np.abs(values).max())
                # Readers take a node that a clip moves for a joint, even if it stays in place.
                is_named = path == "translation" and node in moved
                if is_named or np.abs(values - rest).max() > _STILL * extent:
                    add(node, path, values)
        for index, part in enumerate(self._scene.parts):
            rest, values = (self._poses[pose].weights[index] for pose in (0, number))
            if values.size and (values != rest).any():
                add(part.node, "weights", values.reshape(-1, 1))
        if not animation["channels"]:
            # A clip needs at least one channel.
            add(0, "translation", self._tracks[0][number][0])
        return animation


def _look(part: Part) -> Appearance:
    read = part.shaded_look or part.look
    if read is not None:
        return read()
    return Appearance.plain(len(part.points), part.faces)


def _ordered(look: Appearance, n_vertices: int) -> Appearance:
    """Return an appearance with points in the order of all vertices, including unused ones."""
    unused = np.setdiff1d(np.arange(n_vertices), look.vertices)
    vertices = np.concatenate([look.vertices, unused])
    order = np.argsort(vertices, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))

    def padded(values: npt.NDArray[Any], filling: float) -> npt.NDArray[Any]:
        more = np.full((len(unused), values.shape[1]), filling, values.dtype)
        return np.concatenate([values, more])[order]

    return replace(
        look,
        vertices=vertices[order],
        faces=place[look.faces],
        uv=padded(look.uv, 0),
        colours=padded(look.colours, 255),
        normals=None if look.normals is None else padded(look.normals, 0),
    )


def _png(pixels: npt.NDArray[np.uint8]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()
