"""The nodes, meshes, skins and morph targets that a glTF file shows."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.formats.gltf_animation import read_clips
from lcollision_core.meshes.formats.gltf_appearance import GltfLooks
from lcollision_core.meshes.formats.gltf_document import (
    DRACO,
    GltfDocument,
    as_float,
    compressed,
    element,
    numbers,
    require_finite,
    whole,
)
from lcollision_core.meshes.formats.gltf_extensions import (
    human_bones,
    instances,
    left_out_nodes,
    notes_on_extensions,
    require_readable,
)
from lcollision_core.meshes.formats.gltf_nodes import local_transform
from lcollision_core.meshes.formats.polygons import MAX_FACES, require_plausible_count
from lcollision_core.meshes.formats.scene import (
    NO_MESH,
    Clip,
    Part,
    Primitive,
    Scene,
    ScenePoses,
    is_mirrored,
    parents_first,
)
from lcollision_core.meshes.formats.transforms import global_transforms
from lcollision_core.meshes.topology import FloatArray

_TRIANGLES, _STRIP, _FAN = 4, 5, 6


class Nodes(NamedTuple):
    """The n nodes of a file, without what they show.

    Attributes
    ----------
    parents : (n,) int64 array, -1 for a root
    order : of the nodes, parents first
    local, rest : (n, 4, 4) transforms as stored, and global ones
    clips : that move them
    """

    parents: npt.NDArray[np.int64]
    order: list[int]
    local: FloatArray
    rest: FloatArray
    clips: tuple[Clip, ...] = ()


def read_nodes(document: GltfDocument) -> Nodes:
    """Read the nodes of a glTF file and the clips that move them, whether they show a mesh or not.

    Raises
    ------
    MeshFileError : the file is damaged.
    """
    nodes = _nodes(document)
    clips = read_clips(document, nodes.local, nodes.parents, nodes.order, (), ())
    return nodes._replace(clips=clips)


def _nodes(document: GltfDocument) -> Nodes:
    stored = document.objects("nodes")
    parents = _parents(stored)
    own = [local_transform(node, f"node {number}") for number, node in enumerate(stored)]
    order, local = parents_first(parents), np.reshape(own, (-1, 4, 4))
    return Nodes(parents, order, local, global_transforms(local[None], parents, order)[0])


def read_shown(document: GltfDocument) -> Scene:
    """Read the default scene of a glTF file.

    Raises
    ------
    MeshFileError : the file is damaged, needs an unknown extension, or shows no triangles.
    """
    require_readable(document)
    nodes = document.objects("nodes")
    parents, order, local, rest, _ = _nodes(document)
    shown, notes = _shown_primitives(document, parents)
    if not shown:
        n_meshes = len(document.objects("meshes"))
        if not n_meshes and document.objects("animations"):
            raise MeshFileError(*NO_MESH)
        what = f"it holds {n_meshes} meshes, none of which shows triangles"
        raise MeshFileError(f"{what} ({'; '.join(notes)})" if notes else what)
    looks = GltfLooks(document)
    parts = tuple(_part(document, primitive, rest, looks) for primitive in shown)
    defaults = tuple(
        _default_weights(document, one, part) for one, part in zip(shown, parts, strict=True)
    )
    clips = read_clips(document, local, parents, order, parts, defaults)
    human = human_bones(document)
    return Scene(
        tuple(human.get(number, str(node.get("name", ""))) for number, node in enumerate(nodes)),
        parents,
        ScenePoses(rest[None], tuple(weights[None] for weights in defaults)),
        parts,
        clips,
        # By the standard.
        up=np.array([0.0, 1.0, 0.0]),
        metres=1.0,
        notes=notes,
        document=document,
    )


def _shown_primitives(
    document: GltfDocument, parents: npt.NDArray[np.int64]
) -> tuple[list[Primitive], tuple[str, ...]]:
    """Return the primitives with triangles that the default scene shows, and notes on others.

    They are in the order of the meshes, for each mesh of the nodes that show it, and for each node
    of its primitives: the order of a character's vertices.
    """
    meshes = document.objects("meshes")
    left_out, notes = left_out_nodes(document, parents)
    visible = _visible(document, parents) - left_out
    showing = [
        (whole(node["mesh"], f"the mesh of node {i}", 0, len(meshes) - 1), i)
        for i, node in enumerate(document.objects("nodes"))
        if "mesh" in node and i in visible
    ]
    shown: list[Primitive] = []
    n_vertices = n_others = 0
    for mesh, node in sorted(showing):
        placed = instances(document, node)
        n_instances = 1 if placed is None else len(placed)
        for number, primitive in enumerate(meshes[mesh].get("primitives", ())):
            count = 0
            is_of_triangles = primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN)
            if is_of_triangles and "POSITION" in primitive.get("attributes", {}):
                what = f"positions of mesh {mesh}"
                index = primitive["attributes"]["POSITION"]
                accessor = element(document.objects("accessors"), index, f"the accessor of {what}")
                count = whole(accessor.get("count"), f"the count of {what}", 0, MAX_FACES)
            if not count * n_instances:
                n_others += 1
                continue
            n_vertices += count * n_instances
            require_plausible_count(n_vertices, "vertices")
            shown.append(Primitive(node, mesh, number, count, n_instances))
    if n_others:
        were = "1 part {} was" if n_others == 1 else f"{n_others} parts {{}} were"
        notes.append(f"{were.format('without triangles (points, lines)')} left out")
    return shown, (*notes, *notes_on_extensions(document))


def _parents(nodes: list[dict[str, Any]]) -> npt.NDArray[np.int64]:
    parents = np.full(len(nodes), -1, dtype=np.int64)
    for number, node in enumerate(nodes):
        for child in node.get("children", ()):
            index = whole(child, f"a child of node {number}", 0, len(nodes) - 1)
            if parents[index] >= 0:
                raise MeshFileError(
                    f"is damaged: node {index} (from 0) has two parents", where="it"
                )
            parents[index] = number
    return parents


def _visible(document: GltfDocument, parents: npt.NDArray[np.int64]) -> set[int]:
    """Return the nodes of the default scene; all where the file has no scene."""
    scenes = document.objects("scenes")
    if not scenes:
        return set(range(len(parents)))
    scene = element(scenes, document.description.get("scene", 0), "the scene")
    last = len(parents) - 1
    roots = {whole(node, "a node of the scene", 0, last) for node in scene.get("nodes", ())}
    found: set[int] = set()
    for node in parents_first(parents):
        if node in roots or parents[node] in found:
            found.add(node)
    return found


def _part(document: GltfDocument, shown: Primitive, rest: FloatArray, looks: GltfLooks) -> Part:
    mesh = document.objects("meshes")[shown.mesh]
    primitive = mesh["primitives"][shown.primitive]
    attributes = primitive["attributes"]
    node = document.objects("nodes")[shown.node]
    where = f"mesh {shown.mesh}"
    if DRACO in primitive.get("extensions", ()) and not _has_data(document, attributes):
        raise compressed(DRACO)
    stored = document.array(attributes["POSITION"], f"the positions of {where}", ("VEC3",))
    points = as_float(stored)
    n = len(points)
    bones, bind = np.array([shown.node]), np.eye(4)[None]
    bone_of, weights = np.zeros((n, 1), dtype=np.int32), np.ones((n, 1))
    is_skinned = "skin" in node and "JOINTS_0" in attributes
    if is_skinned:
        bones, bind = _skin(document, node["skin"])
        bone_of, weights = _influences(document, attributes, where, n, len(bones))
    faces = _faces(document, primitive, where, n)
    morphs = _morphs(document, primitive, where, n)
    # Mirrored triangles are wound the other way.
    turned = faces[:, [0, 2, 1]]
    placed = None if is_skinned else instances(document, shown.node)
    if placed is None:
        faces = turned if is_mirrored(rest[bones] @ bind, bone_of, weights) else faces
    else:
        faces = np.concatenate(
            [
                number * n + (turned if is_mirrored(one[None], bone_of, weights) else faces)
                for number, one in enumerate(rest[bones] @ placed)
            ]
        )
        bones, bind = np.repeat(bones, len(placed)), placed
        points, morphs = np.tile(points, (len(placed), 1)), np.tile(morphs, (1, len(placed), 1))
        bone_of = np.repeat(np.arange(len(placed), dtype=np.int32), n)[:, None]
        weights = np.ones((len(points), 1))
    materials: tuple[str, ...] = ()
    if "material" in primitive:
        number = primitive["material"]
        named = element(document.objects("materials"), number, "a material")
        materials = (str(named.get("name") or f"material {number}"),)
    return Part(
        str(node.get("name") or mesh.get("name") or where),
        materials,
        np.zeros(len(faces), dtype=np.int64),
        shown.node,
        points,
        faces,
        bones,
        bind,
        bone_of,
        weights,
        is_skinned,
        morphs,
        is_single=stored.dtype == np.float32,
        look=partial(looks.appearance, primitive, faces, n, len(points) // n, where),
        primitive=shown,
    )


def _has_data(document: GltfDocument, attributes: dict[str, Any]) -> bool:
    """Whether the accessors of a primitive's attributes point to data."""
    accessors = document.objects("accessors")
    return all(
        not {"bufferView", "sparse"}.isdisjoint(element(accessors, index, f"an accessor ({name})"))
        for name, index in attributes.items()
    )


def _faces(
    document: GltfDocument, primitive: dict[str, Any], where: str, n_vertices: int
) -> npt.NDArray[np.int64]:
    """Return the (F, 3) triangles of a primitive: a list, a strip or a fan."""
    if "indices" not in primitive:
        corners = np.arange(n_vertices)
    else:
        stored = document.array(primitive["indices"], f"the indices of {where}", ("SCALAR",))[:, 0]
        if stored.dtype.kind != "u":
            raise MeshFileError.must_be(f"the indices of {where}", "whole numbers", stored.dtype)
        corners = stored.astype(np.int64)
    n = len(corners) - 2
    mode = primitive.get("mode", _TRIANGLES)
    if mode in (_STRIP, _FAN):
        step = np.arange(max(n, 0))
        if mode == _FAN:
            picked = np.stack([step + 1, step + 2, np.zeros_like(step)], axis=1)
        else:
            # Every second triangle of a strip is wound the other way.
            odd = step % 2
            picked = np.stack([step, step + 1 + odd, step + 2 - odd], axis=1)
        faces = corners[picked]
        # Strips are joined by triangles without area.
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    else:
        if len(corners) % 3:
            raise MeshFileError(f"have {len(corners)} corners, no multiple of 3", where=where)
        faces = corners.reshape(-1, 3)
    wrong = np.flatnonzero((faces >= n_vertices).any(axis=1))
    if len(wrong):
        raise MeshFileError(
            f"names vertices {faces[wrong[0]].tolist()}",
            where=f"face {wrong[0]}",
            expected=f"0 to {n_vertices - 1}",
        )
    return faces


def _skin(document: GltfDocument, index: object) -> tuple[npt.NDArray[np.int64], FloatArray]:
    skin = element(document.objects("skins"), index, "the skin")
    last = len(document.objects("nodes")) - 1
    what = f"a joint of skin {index}"
    joints = [whole(joint, what, 0, last) for joint in skin.get("joints", ())]
    if not joints:
        raise MeshFileError("has no joints", where=f"skin {index}")
    bones = np.array(joints, dtype=np.int64)
    if "inverseBindMatrices" not in skin:
        return bones, np.tile(np.eye(4), (len(bones), 1, 1))
    what = f"the inverse bind matrices of skin {index}"
    stored = document.array(skin["inverseBindMatrices"], what, ("MAT4",))
    if len(stored) < len(bones):
        raise MeshFileError(f"have {len(stored)} values, {len(bones)} are needed", where=what)
    # Column by column.
    bind = as_float(stored[: len(bones)].reshape(-1, 4, 4).transpose(0, 2, 1))
    bind[:, 3] = 0.0, 0.0, 0.0, 1.0
    require_finite(bind, what)
    return bones, bind


def _influences(
    document: GltfDocument, attributes: dict[str, Any], where: str, n: int, n_bones: int
) -> tuple[npt.NDArray[np.int32], FloatArray]:
    """Return the bones and the weights of n vertices, from all sets of four that are there."""
    joints: list[npt.NDArray[np.int64]] = []
    weights: list[FloatArray] = []
    while f"JOINTS_{len(joints)}" in attributes:
        name = str(len(joints))
        what = f"the joints {name} of {where}"
        stored = document.array(attributes[f"JOINTS_{name}"], what, ("VEC4",), n)
        if stored.dtype.kind != "u":
            raise MeshFileError.must_be(what, "whole numbers", stored.dtype)
        joints.append(stored.astype(np.int64))
        what = f"the weights {name} of {where}"
        if f"WEIGHTS_{name}" not in attributes:
            raise MeshFileError(f"{where} has joints without weights")
        given = attributes[f"WEIGHTS_{name}"]
        weights.append(as_float(document.array(given, what, ("VEC4",), n)))
    bone_of, shares = np.concatenate(joints, axis=1), np.concatenate(weights, axis=1)
    require_finite(shares, f"the weights of {where}")
    shares = np.maximum(shares, 0.0)
    # A joint without weight may be any number.
    bone_of[shares == 0.0] = 0
    wrong = np.flatnonzero((bone_of >= n_bones).any(axis=1))
    if len(wrong):
        raise MeshFileError(
            f"is moved by joints {bone_of[wrong[0]].tolist()}",
            where=f"vertex {wrong[0]} of {where}",
            expected=f"0 to {n_bones - 1}",
        )
    # Sorted, so that equal shares in another order have the same sum to the bit.
    order = np.argsort(np.where(shares > 0.0, bone_of, n_bones), axis=1, kind="stable")
    bone_of = np.take_along_axis(bone_of, order, axis=1)
    shares = np.take_along_axis(shares, order, axis=1)
    total = shares.sum(axis=1)
    # What nothing moves follows the first joint.
    shares[total == 0.0, 0] = 1.0
    total[total == 0.0] = 1.0
    return bone_of.astype(np.int32), shares / total[:, None]


def _morphs(
    document: GltfDocument, primitive: dict[str, Any], where: str, n: int
) -> npt.NDArray[np.float32]:
    targets = primitive.get("targets", ())
    morphs = np.zeros((len(targets), n, 3), dtype=np.float32)
    for number, target in enumerate(targets):
        if "POSITION" in target:
            what = f"morph target {number} of {where}"
            morphs[number] = as_float(document.array(target["POSITION"], what, ("VEC3",), n))
    require_finite(morphs, f"the morph targets of {where}")
    return morphs


def _default_weights(document: GltfDocument, shown: Primitive, part: Part) -> FloatArray:
    """Return the (M,) weights of the morph targets that the file stores for a node's mesh."""
    mesh = document.objects("meshes")[shown.mesh]
    stored = document.objects("nodes")[shown.node].get("weights") or mesh.get("weights")
    n = len(part.morphs)
    if not stored or not n:
        return np.zeros(n)
    # Primitives of a mesh may have fewer targets than others.
    return numbers(stored[:n], f"the weights of mesh {shown.mesh}", n)
