"""Extensions of glTF that change what a file shows: which are read, refused, or only named."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.json_values import quoted
from lcollision_core.meshes.formats.gltf_document import (
    COMPRESSIONS,
    GltfDocument,
    as_float,
    compressed,
    require_finite,
)
from lcollision_core.meshes.formats.scene import left_out_note, parents_first
from lcollision_core.meshes.formats.transforms import compose
from lcollision_core.meshes.topology import FloatArray

_INSTANCING, _VISIBILITY = "EXT_mesh_gpu_instancing", "KHR_node_visibility"
_LEVELS, _CONSTRAINT = "MSFT_lod", "VRMC_node_constraint"
_POINTER = "KHR_animation_pointer"
_READ = {
    *(_INSTANCING, _VISIBILITY, _LEVELS, _CONSTRAINT, _POINTER),
    *("KHR_mesh_quantization", "VRM", "VRMC_vrm"),
}
_NODE_POINTER = re.compile(r"/nodes/(\d{1,9})/(translation|rotation|scale|weights)")
_POINTED = re.compile(
    r"^/(nodes|meshes)/(\d{1,9})/.*?\b(visible|translation|rotation|scale|weights)\b"
)
_APPEARANCE = re.compile(
    "materials?_|_materials?|texture|light|metadata|xmp|audio|camera|feature|packing|image|outline|"
    "interactivity|selectability|hoverability|environment|background|node_names|techniques|"
    "single_root|ngon|manifold",
    re.IGNORECASE,
)
"""Words in the names of extensions that neither shape nor move what a file shows."""

_MOTION = re.compile("physics|spring|collider|rigid|jiggle", re.IGNORECASE)
"""Words in the names of those that only move it while it is played."""


def require_readable(document: GltfDocument) -> None:
    """Refuse a file that needs an extension that may change its shape and is not read.

    Raises
    ------
    MeshFileError : it does; the sentence names the extension.
    """
    for name in document.description.get("extensionsRequired", ()):
        if name in COMPRESSIONS:
            raise compressed(name)
        if name not in _READ and not (_APPEARANCE.search(name) or _MOTION.search(name)):
            raise MeshFileError(
                f"it needs the extension {quoted(name)}, which may change its shape and is not "
                "read",
                "export it without that extension",
            )


def notes_on_extensions(document: GltfDocument) -> Iterator[str]:
    """Yield sentences on what extensions would do to shape or pose, and is left out."""
    nodes = document.objects("nodes")
    constrained = [
        _called(document, "nodes", number)
        for number, node in enumerate(nodes)
        if _extension(node, _CONSTRAINT)
    ]
    if constrained:
        yield left_out_note(f"constraints of nodes ({_CONSTRAINT}) are not followed", constrained)
    targets = [
        channel.get("target", {})
        for animation in document.objects("animations")
        for channel in animation.get("channels", ())
    ]
    shaping = [
        f"{name.replace('visible', 'visibility')} of {_called(document, kind, int(number))}"
        for target in targets
        if pointed_node(target) is None
        for kind, number, name in _POINTED.findall(_pointer(target))
    ]
    if shaping:
        yield left_out_note("its clips animate what is not supported", shaping)
    known = _READ | COMPRESSIONS.keys()
    for name in dict.fromkeys(document.description.get("extensionsUsed", ())):
        if name not in known and not _APPEARANCE.search(name):
            yield f"its extension {quoted(name)}, which may change its shape or pose, is not read"


def pointed_node(target: dict[str, Any]) -> tuple[int, str] | None:
    """Return the node, and which of its own properties, that a channel names by a pointer."""
    found = _NODE_POINTER.fullmatch(_pointer(target))
    return (int(found[1]), found[2]) if found else None


def _pointer(target: dict[str, Any]) -> str:
    pointer = _extension(target, _POINTER).get("pointer")
    return pointer if target.get("path") == "pointer" and isinstance(pointer, str) else ""


def left_out_nodes(
    document: GltfDocument, parents: npt.NDArray[np.int64]
) -> tuple[set[int], list[str]]:
    """Return the nodes whose meshes are not shown, and sentences on those meshes.

    They are hidden (KHR_node_visibility), lower levels of detail (MSFT_lod), with all below them,
    or what only the wearer of a VRM avatar sees.
    """
    nodes = document.objects("nodes")
    hidden = [
        number
        for number, node in enumerate(nodes)
        if _extension(node, _VISIBILITY).get("visible") is False
    ]
    levels = [level for node in nodes for level in _listed(_extension(node, _LEVELS).get("ids"))]
    first_person = set(_first_person(document))
    found: set[int] = set()
    notes = []
    for chosen, why in (
        (_with_all_below(hidden, parents), "as its file hides it"),
        (_with_all_below(levels, parents), "as a lower level of detail"),
        (first_person, "as only the wearer of the avatar sees it"),
    ):
        shown = sorted(number for number in chosen - found if "mesh" in nodes[number])
        if shown:
            names = (_called(document, "nodes", number) for number in shown)
            notes.append(left_out_note(f"left out, {why}", names))
        found |= chosen
    return found, notes


def _with_all_below(chosen: Iterable[object], parents: npt.NDArray[np.int64]) -> set[int]:
    found = {number for number in chosen if type(number) is int}
    for node in parents_first(parents) if found else ():
        if parents[node] in found:
            found.add(node)
    return found


def _first_person(document: GltfDocument) -> Iterator[int]:
    """Yield the nodes that VRM 1.0, or by their meshes VRM 0.x, shows to the wearer alone."""
    for extension, key, kind in (("VRMC_vrm", "node", "type"), ("VRM", "mesh", "firstPersonFlag")):
        seen = _inner(_extension(document.description, extension), "firstPerson")
        for one in _listed(seen.get("meshAnnotations")):
            if isinstance(one, dict) and str(one.get(kind)).lower() == "firstpersononly":
                for number, node in enumerate(document.objects("nodes")):
                    if one.get(key) == (number if key == "node" else node.get("mesh")):
                        yield number


def instances(document: GltfDocument, number: int) -> FloatArray | None:
    """Return the (n, 4, 4) transforms, relative to a node, at which its mesh is shown.

    Returns
    -------
    None without EXT_mesh_gpu_instancing: it is shown once, at the node

    Raises
    ------
    MeshFileError : the transforms are damaged, or not equally many.
    """
    attributes = _extension(document.objects("nodes")[number], _INSTANCING).get("attributes")
    if not isinstance(attributes, dict) or not attributes:
        return None
    where = f"the instances of node {number}"
    found: dict[str, FloatArray] = {}
    for name, kind in (("TRANSLATION", "VEC3"), ("ROTATION", "VEC4"), ("SCALE", "VEC3")):
        if name in attributes:
            count = next((len(values) for values in found.values()), None)
            what = f"the {name.lower()}s of {where}"
            found[name] = as_float(document.array(attributes[name], what, (kind,), count))
            require_finite(found[name], what)
    if not found:
        # Custom attributes alone move nothing, but say how many there are.
        kinds = ("SCALAR", "VEC2", "VEC3", "VEC4")
        found["custom"] = document.array(next(iter(attributes.values())), where, kinds)
    n = len(next(iter(found.values())))
    return compose(
        found.get("TRANSLATION", np.zeros((n, 3))),
        found.get("ROTATION", np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))),
        found.get("SCALE", np.ones((n, 3))),
    )


def _called(document: GltfDocument, kind: str, number: int) -> str:
    """Return what a sentence calls a node or a mesh."""
    held = document.objects(kind)[number : number + 1]
    named = held[0].get("name") if held else None
    return str(named or f"{'node' if kind == 'nodes' else 'mesh'} {number}")


def human_bones(document: GltfDocument) -> dict[int, str]:
    """Return what the nodes of a VRM avatar are, as "leftUpperArm", whatever they are called.

    By the extensions VRMC_vrm 1.0, VRM 0.x and, of animations, VRMC_vrm_animation; what they do not
    say as specified is left out.
    """
    for name in ("VRMC_vrm", "VRM", "VRMC_vrm_animation"):
        bones = _inner(_extension(document.description, name), "humanoid").get("humanBones")
        if isinstance(bones, dict):
            named = [(bone, entry) for bone, entry in bones.items() if isinstance(entry, dict)]
        else:
            named = [(one.get("bone"), one) for one in _listed(bones) if isinstance(one, dict)]
        found = {
            entry["node"]: bone
            for bone, entry in named
            if isinstance(entry.get("node"), int) and isinstance(bone, str)
        }
        if found:
            return found
    return {}


def _extension(holder: dict[str, Any], name: str) -> dict[str, Any]:
    """Return an extension of an object; empty where it has none."""
    return _inner(_inner(holder, "extensions"), name)


def _inner(holder: dict[str, Any], key: str) -> dict[str, Any]:
    """Return an object in another one; empty where there is none."""
    found = holder.get(key)
    return found if isinstance(found, dict) else {}


def _listed(values: object) -> list[Any]:
    return values if isinstance(values, list) else []
