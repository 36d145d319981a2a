"""Read the nodes, meshes, skins and morph targets of a glTF file, and its extensions."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.files.gltf.clips import (
    POINTER,
    Nodes,
    pointed_node,
    pointer_of,
    read_clips,
)
from lcollision_core.files.gltf.look import GltfLooks
from lcollision_core.files.gltf.packed import unpack
from lcollision_core.files.gltf.schema import (
    COMPRESSIONS,
    GltfDocument,
    as_float,
    extension_of,
    inner,
    local_transform,
    numbers,
    require_element,
    require_finite,
    require_int,
)
from lcollision_core.files.mesh.polygons import MAX_FACES, require_plausible_count
from lcollision_core.files.safe import make_unique
from lcollision_core.files.scene.scene import (
    NO_MESH,
    NoMeshError,
    Part,
    Primitive,
    Scene,
    ScenePoses,
    bind_pose,
    is_mirrored,
    left_out_note,
    parents_first,
)
from lcollision_core.files.scene.transforms import compose, global_transforms
from lcollision_core.json_values import quoted
from lcollision_core.meshes.topology import FloatArray, name_twice

_INSTANCING, _VISIBILITY = "EXT_mesh_gpu_instancing", "KHR_node_visibility"
_LEVELS, _CONSTRAINT = "MSFT_lod", "VRMC_node_constraint"
_READ = {
    *(_INSTANCING, _VISIBILITY, _LEVELS, _CONSTRAINT, POINTER),
    *("KHR_mesh_quantization", "VRM", "VRMC_vrm"),
}
_POINTED = re.compile(
    r"^/(nodes|meshes)/(\d{1,9})/.*?\b(visible|translation|rotation|scale|weights)\b"
)
_APPEARANCE = re.compile(
    "materials?_|_materials?|texture|light|metadata|xmp|audio|camera|feature|packing|image|outline|"
    "interactivity|selectability|hoverability|environment|background|node_names|techniques|"
    "single_root|ngon|manifold",
    re.IGNORECASE,
)
"""Words in the names of extensions that neither shape nor move the meshes."""

_MOTION = re.compile("physics|spring|collider|rigid|jiggle", re.IGNORECASE)
"""Words in the names of extensions that only move meshes in a simulation."""


def require_readable(document: GltfDocument) -> None:
    """Refuse a file that requires an unsupported extension which may change its shape.

    Raises
    ------
    MeshFileError : the file requires such an extension, which the message names.
    """
    readable = _READ | COMPRESSIONS
    for name in document.description.get("extensionsRequired", ()):
        if name not in readable and not (_APPEARANCE.search(name) or _MOTION.search(name)):
            raise MeshFileError(
                f"it needs the extension {quoted(name)}, which may change its shape and is not "
                "read",
                "export it without that extension",
            )


def notes_on_extensions(document: GltfDocument) -> Iterator[str]:
    """Yield notes on unsupported extensions that affect shape or pose."""
    for name, key, problem in (
        (_CONSTRAINT, "", "constraints of nodes ({}) are not followed"),
        (_INSTANCING, "skin", "instances of skinned meshes ({}) are shown once"),
    ):
        named = [
            _called(document, "nodes", number)
            for number, node in enumerate(document.objects("nodes"))
            if extension_of(node, name) and (not key or key in node)
        ]
        if named:
            yield left_out_note(problem.format(name), named)
    targets = [
        channel.get("target", {})
        for animation in document.objects("animations")
        for channel in animation.get("channels", ())
    ]
    shaping = [
        f"{name.replace('visible', 'visibility')} of {_called(document, kind, int(number))}"
        for target in targets
        if pointed_node(target) is None
        for kind, number, name in _POINTED.findall(pointer_of(target))
    ]
    if shaping:
        yield left_out_note("its clips animate unsupported properties", shaping)
    readable = _READ | COMPRESSIONS
    for name in dict.fromkeys(document.description.get("extensionsUsed", ())):
        if name not in readable and not _APPEARANCE.search(name):
            yield f"its extension {quoted(name)}, which may change its shape or pose, is not read"


def left_out_nodes(
    document: GltfDocument, parents: npt.NDArray[np.int64]
) -> tuple[set[int], list[str]]:
    """Return the nodes whose meshes are not shown, and notes on those meshes.

    These are hidden nodes (KHR_node_visibility) and lower levels of detail (MSFT_lod), each with
    its descendants, and meshes that only the wearer of a VRM avatar sees.
    """
    nodes = document.objects("nodes")
    hidden = [
        number
        for number, node in enumerate(nodes)
        if extension_of(node, _VISIBILITY).get("visible") is False
    ]
    levels = [level for node in nodes for level in _listed(extension_of(node, _LEVELS).get("ids"))]
    first_person = set(_first_person(document))
    left_out: set[int] = set()
    notes = []
    for hidden_nodes, why in (
        (_with_all_below(hidden, parents), "as its file hides it"),
        (_with_all_below(levels, parents), "as a lower level of detail"),
        (first_person, "as only the wearer of the avatar sees it"),
    ):
        hidden_meshes = sorted(
            number for number in hidden_nodes - left_out if "mesh" in nodes[number]
        )
        if hidden_meshes:
            names = (_called(document, "nodes", number) for number in hidden_meshes)
            notes.append(left_out_note(f"left out, {why}", names))
        left_out |= hidden_nodes
    return left_out, notes


def _with_all_below(chosen: Iterable[object], parents: npt.NDArray[np.int64]) -> set[int]:
    numbers = {number for number in chosen if type(number) is int}
    for node in parents_first(parents) if numbers else ():
        if parents[node] in numbers:
            numbers.add(node)
    return numbers


def _first_person(document: GltfDocument) -> Iterator[int]:
    """Yield the nodes that VRM 1.0, or VRM 0.x by their meshes, shows to the wearer only."""
    for extension, key, kind in (("VRMC_vrm", "node", "type"), ("VRM", "mesh", "firstPersonFlag")):
        first_person = inner(extension_of(document.description, extension), "firstPerson")
        for annotation in _listed(first_person.get("meshAnnotations")):
            if (
                isinstance(annotation, dict)
                and str(annotation.get(kind)).lower() == "firstpersononly"
            ):
                for number, node in enumerate(document.objects("nodes")):
                    if annotation.get(key) == (number if key == "node" else node.get("mesh")):
                        yield number


def instances(document: GltfDocument, number: int) -> FloatArray | None:
    """Return the (n, 4, 4) transforms of the instances of a mesh, relative to its node.

    Returns
    -------
    None without EXT_mesh_gpu_instancing, or with a skin: the mesh is shown once

    Raises
    ------
    MeshFileError : the transforms are damaged, or their counts differ.
    """
    node = document.objects("nodes")[number]
    attributes = extension_of(node, _INSTANCING).get("attributes")
    if not isinstance(attributes, dict) or not attributes or "skin" in node:
        return None
    where = f"the instances of node {number}"
    arrays: dict[str, FloatArray] = {}
    for name, kind in (("TRANSLATION", "VEC3"), ("ROTATION", "VEC4"), ("SCALE", "VEC3")):
        if name in attributes:
            count = next((len(values) for values in arrays.values()), None)
            what = f"the {name.lower()}s of {where}"
            arrays[name] = as_float(document.array(attributes[name], what, (kind,), count))
            require_finite(arrays[name], what)
    if not arrays:
        # Custom attributes do not move anything, but give the number of instances.
        kinds = ("SCALAR", "VEC2", "VEC3", "VEC4")
        arrays["custom"] = document.array(next(iter(attributes.values())), where, kinds)
    n = len(next(iter(arrays.values())))
    return compose(
        arrays.get("TRANSLATION", np.zeros((n, 3))),
        arrays.get("ROTATION", np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))),
        arrays.get("SCALE", np.ones((n, 3))),
    )


def _called(document: GltfDocument, kind: str, number: int) -> str:
    """Return the name of a node or mesh for messages."""
    objects = document.objects(kind)[number : number + 1]
    named = objects[0].get("name") if objects else None
    return str(named or f"{'node' if kind == 'nodes' else 'mesh'} {number}")


def human_bones(document: GltfDocument) -> dict[int, str]:
    """Return the humanoid bones of a VRM avatar, such as "leftUpperArm", by node.

    Reads the extensions VRMC_vrm 1.0, VRM 0.x and, for animations, VRMC_vrm_animation; invalid
    entries are ignored.
    """
    for name in ("VRMC_vrm", "VRM", "VRMC_vrm_animation"):
        bones = inner(extension_of(document.description, name), "humanoid").get("humanBones")
        if isinstance(bones, dict):
            named = [(bone, entry) for bone, entry in bones.items() if isinstance(entry, dict)]
        else:
            named = [(bone.get("bone"), bone) for bone in _listed(bones) if isinstance(bone, dict)]
        bone_of_node = {
            entry["node"]: bone
            for bone, entry in named
            if isinstance(entry.get("node"), int) and isinstance(bone, str)
        }
        if bone_of_node:
            return bone_of_node
    return {}


def _listed(values: object) -> list[Any]:
    return values if isinstance(values, list) else []


_TRIANGLES, _STRIP, _FAN = 4, 5, 6

_LIGHT = "KHR_lights_punctual"
_UP = np.array([0.0, 1.0, 0.0])
"""Defined by the standard."""


def read_nodes(document: GltfDocument) -> Scene:
    """Read the nodes of a glTF file and the clips that move them, with or without meshes.

    Raises
    ------
    MeshFileError : the file is damaged.
    """
    unpack(document)
    nodes, stored = _nodes(document), document.objects("nodes")
    skins = [_skin(document, number) for number in range(len(document.objects("skins")))]
    return Scene(
        _node_names(document),
        nodes.parents,
        ScenePoses(nodes.rest[None], ()),
        (),
        read_clips(document, nodes),
        up=_UP,
        metres=1.0,
        showing=frozenset(
            number
            for number, node in enumerate(stored)
            if "mesh" in node or "camera" in node or extension_of(node, _LIGHT)
        ),
        bound=bind_pose(skins),
        document=document,
    )


def _nodes(document: GltfDocument) -> Nodes:
    stored = document.objects("nodes")
    parents = _parents(stored)
    local_transforms = [
        local_transform(node, f"node {number}") for number, node in enumerate(stored)
    ]
    order, local = parents_first(parents), np.reshape(local_transforms, (-1, 4, 4))
    return Nodes(parents, order, local, global_transforms(local[None], parents, order)[0])


def _node_names(document: GltfDocument) -> tuple[str, ...]:
    human, nodes = human_bones(document), document.objects("nodes")
    return tuple(human.get(number, str(node.get("name", ""))) for number, node in enumerate(nodes))


def read_shown(document: GltfDocument) -> Scene:
    """Read the default scene of a glTF file.

    Raises
    ------
    MeshFileError : the file is damaged, needs an unknown extension, or shows no triangles.
    """
    require_readable(document)
    unpack(document)
    nodes = _nodes(document)
    primitives, notes = _shown_primitives(document, nodes.parents)
    if not primitives:
        if not document.objects("meshes") and document.objects("animations"):
            raise NoMeshError(*NO_MESH)
        what = "it shows no triangles"
        raise MeshFileError(f"{what} ({'; '.join(notes)})" if notes else what)
    looks = GltfLooks(document)
    parts = tuple(_part(document, primitive, nodes.rest, looks) for primitive in primitives)
    defaults = tuple(
        _default_weights(document, shown_mesh, part)
        for shown_mesh, part in zip(primitives, parts, strict=True)
    )
    return Scene(
        _node_names(document),
        nodes.parents,
        ScenePoses(nodes.rest[None], tuple(weights[None] for weights in defaults)),
        parts,
        read_clips(document, nodes, parts, defaults),
        up=_UP,
        metres=1.0,
        notes=notes,
        document=document,
    )


def _shown_primitives(
    document: GltfDocument, parents: npt.NDArray[np.int64]
) -> tuple[list[Primitive], tuple[str, ...]]:
    """Return the primitives with triangles that the default scene shows, and notes on others.

    They are ordered by mesh, then by the node that shows it, then by primitive: the order of a
    character's vertices.
    """
    meshes = document.objects("meshes")
    left_out, notes = left_out_nodes(document, parents)
    visible = _visible(document, parents) - left_out
    showing = [
        (require_int(node["mesh"], f"the mesh of node {i}", 0, len(meshes) - 1), i)
        for i, node in enumerate(document.objects("nodes"))
        if "mesh" in node and i in visible
    ]
    primitives: list[Primitive] = []
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
                accessor = require_element(
                    document.objects("accessors"), index, f"the accessor of {what}"
                )
                count = require_int(accessor.get("count"), f"the count of {what}", 0, MAX_FACES)
            if not count * n_instances:
                n_others += 1
                continue
            n_vertices += count * n_instances
            require_plausible_count(n_vertices, "vertices")
            primitives.append(Primitive(node, mesh, number, count, n_instances))
    if n_others:
        were = "1 part {} was" if n_others == 1 else f"{n_others} parts {{}} were"
        notes.append(f"{were.format('without triangles (points, lines)')} left out")
    return primitives, (*notes, *notes_on_extensions(document))


def _parents(nodes: list[dict[str, Any]]) -> npt.NDArray[np.int64]:
    parents = np.full(len(nodes), -1, dtype=np.int64)
    for number, node in enumerate(nodes):
        for child in node.get("children", ()):
            index = require_int(child, f"a child of node {number}", 0, len(nodes) - 1)
            if parents[index] >= 0:
                raise MeshFileError(
                    f"is damaged: node {index} (from 0) has two parents", where="it"
                )
            parents[index] = number
    return parents


def _visible(document: GltfDocument, parents: npt.NDArray[np.int64]) -> set[int]:
    """Return the nodes of the default scene; all if the file has no scene."""
    scenes = document.objects("scenes")
    if not scenes:
        return set(range(len(parents)))
    scene = require_element(scenes, document.description.get("scene", 0), "the scene")
    last = len(parents) - 1
    roots = {require_int(node, "a node of the scene", 0, last) for node in scene.get("nodes", ())}
    visible: set[int] = set()
    for node in parents_first(parents):
        if node in roots or parents[node] in visible:
            visible.add(node)
    return visible


def _part(document: GltfDocument, shown: Primitive, rest: FloatArray, looks: GltfLooks) -> Part:
    mesh = document.objects("meshes")[shown.mesh]
    primitive = mesh["primitives"][shown.primitive]
    attributes = primitive["attributes"]
    node = document.objects("nodes")[shown.node]
    where = f"mesh {shown.mesh}"
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
    # Mirrored triangles have opposite winding.
    turned = faces[:, [0, 2, 1]]
    placed = instances(document, shown.node)
    if placed is None:
        faces = turned if is_mirrored(rest[bones] @ bind, bone_of, weights) else faces
    else:
        faces = np.concatenate(
            [
                number * n + (turned if is_mirrored(transform[None], bone_of, weights) else faces)
                for number, transform in enumerate(rest[bones] @ placed)
            ]
        )
        bones, bind = np.repeat(bones, len(placed)), placed
        points, morphs = np.tile(points, (len(placed), 1)), np.tile(morphs, (1, len(placed), 1))
        bone_of = np.repeat(np.arange(len(placed), dtype=np.int32), n)[:, None]
        weights = np.ones((len(points), 1))
    materials: tuple[str, ...] = ()
    if "material" in primitive:
        number = primitive["material"]
        named = require_element(document.objects("materials"), number, "a material")
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
        _sliders(document, shown, len(morphs)),
        is_single=stored.dtype == np.float32,
        look=partial(looks.appearance, primitive, faces, n, len(points) // n, where),
        primitive=shown,
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
            # Every second triangle of a strip has opposite winding.
            odd = step % 2
            picked = np.stack([step, step + 1 + odd, step + 2 - odd], axis=1)
        faces = corners[picked]
        # Degenerate triangles join strips.
        faces = faces[~name_twice(faces)]
    else:
        if len(corners) % 3:
            raise MeshFileError(f"has {len(corners)} corners, not a multiple of 3", where=where)
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
    skin = require_element(document.objects("skins"), index, "the skin")
    last = len(document.objects("nodes")) - 1
    what = f"a joint of skin {index}"
    joints = [require_int(joint, what, 0, last) for joint in skin.get("joints", ())]
    if not joints:
        raise MeshFileError("has no joints", where=f"skin {index}")
    bones = np.array(joints, dtype=np.int64)
    if "inverseBindMatrices" not in skin:
        return bones, np.tile(np.eye(4), (len(bones), 1, 1))
    what = f"the inverse bind matrices of skin {index}"
    stored = document.array(skin["inverseBindMatrices"], what, ("MAT4",))
    if len(stored) < len(bones):
        raise MeshFileError(f"have {len(stored)} values, {len(bones)} are needed", where=what)
    # Column-major.
    bind = as_float(stored[: len(bones)].reshape(-1, 4, 4).transpose(0, 2, 1))
    bind[:, 3] = 0.0, 0.0, 0.0, 1.0
    require_finite(bind, what)
    return bones, bind


def _influences(
    document: GltfDocument, attributes: dict[str, Any], where: str, n: int, n_bones: int
) -> tuple[npt.NDArray[np.int32], FloatArray]:
    """Return the bones and weights of n vertices, from all sets of four in the file."""
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
    # A joint without weight may have any number.
    bone_of[shares == 0.0] = 0
    wrong = np.flatnonzero((bone_of >= n_bones).any(axis=1))
    if len(wrong):
        raise MeshFileError(
            f"is moved by joints {bone_of[wrong[0]].tolist()}",
            where=f"vertex {wrong[0]} of {where}",
            expected=f"0 to {n_bones - 1}",
        )
    # Sort by bone, so that equal weights in another order have exactly the same sum.
    order = np.argsort(np.where(shares > 0.0, bone_of, n_bones), axis=1, kind="stable")
    bone_of = np.take_along_axis(bone_of, order, axis=1)
    shares = np.take_along_axis(shares, order, axis=1)
    total = shares.sum(axis=1)
    # Vertices without weights follow the first joint.
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


def _sliders(document: GltfDocument, shown: Primitive, n: int) -> dict[str, FloatArray]:
    """Return `Part.sliders`: expressions of a VRM avatar, then the n morph targets."""
    if not n:
        return {}
    mesh, node = document.objects("meshes")[shown.mesh], document.objects("nodes")[shown.node]
    stored = _listed(inner(mesh, "extras").get("targetNames"))
    called = f"{mesh.get('name') or node.get('name') or 'shape'} "
    names = [
        str(stored[target]) if target < len(stored) and stored[target] else f"{called}{target + 1}"
        for target in range(n)
    ]
    expressions = _expressions(document, shown, n)
    alone = dict(zip(make_unique(names), np.eye(n), strict=True))
    return expressions | {name: own for name, own in alone.items() if name not in expressions}


def _expressions(document: GltfDocument, shown: Primitive, n: int) -> dict[str, FloatArray]:
    """Return the weights that expressions of VRM 1.0 or 0.x add to a mesh's n morph targets."""
    vrm, old = (extension_of(document.description, name) for name in ("VRMC_vrm", "VRM"))
    weights_of_expression: dict[str, FloatArray] = {}
    kinds = (inner(inner(vrm, "expressions"), kind) for kind in ("preset", "custom"))
    named = [
        (name, _listed(inner(kind, name).get("morphTargetBinds")), ("node", shown.node), 1.0)
        for kind in kinds
        for name in kind
    ]
    named += [
        (group["name"], _listed(group.get("binds")), ("mesh", shown.mesh), 0.01)
        for group in _listed(inner(old, "blendShapeMaster").get("blendShapeGroups"))
        if isinstance(group, dict) and isinstance(group.get("name"), str)
    ]
    for name, binds, (key, number), unit in named:
        weights = np.zeros(n)
        for bind in binds:
            if isinstance(bind, dict) and bind.get(key) == number:
                target, weight = bind.get("index"), bind.get("weight")
                if type(target) is int and 0 <= target < n and isinstance(weight, int | float):
                    weights[target] += unit * weight
        if weights.any() and np.isfinite(weights).all():
            weights_of_expression[name] = weights
    return weights_of_expression


def _default_weights(document: GltfDocument, shown: Primitive, part: Part) -> FloatArray:
    """Return the (M,) morph target weights that the file stores for a node's mesh."""
    mesh = document.objects("meshes")[shown.mesh]
    stored = document.objects("nodes")[shown.node].get("weights") or mesh.get("weights")
    n = len(part.morphs)
    if not stored or not n:
        return np.zeros(n)
    # Primitives of a mesh may have fewer targets than others.
    return numbers(stored[:n], f"the weights of mesh {shown.mesh}", n)
