"""Read one FBX file by ufbx, as a process of its own that may crash.

The bindings of ufbx miscount references to a scene's objects and crash when an object is accessed
twice and then released; a hostile file may crash them too, or exhaust the memory. Standard input is
one line of JSON (`clip` and `times` to sample, or `looks` for colours and textures, or neither;
`most_memory` in bytes, `most_elements`), followed by the file. The output is an .npz archive, or a
one-line reason on standard error and status 3.
"""

from __future__ import annotations

import ctypes
import gc
import io
import json
import os
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import ufbx

REFUSED = 3

_ANIMATED = ("Lcl ", "DeformPercent", "Geometric", "RotationPivot", "ScalingPivot")
"""Prefixes of the names of properties that move vertices."""


_TIME_MODE_119_88 = 18
"""A rate that ufbx does not know and reads as 24."""

_BARE = (ufbx.ElementType.UNKNOWN, ufbx.ElementType.EMPTY, ufbx.ElementType.BONE)
"""Types of nodes that show nothing."""

_SMOOTH = (ufbx.SubdivisionDisplayMode.HULL_AND_SMOOTH, ufbx.SubdivisionDisplayMode.SMOOTH)
"""Ways to show a mesh in which its subdivision is seen."""


class _TooLargeError(Exception):
    pass


def _kept(item: Any) -> Any:
    """Add a reference, so that an object of ufbx lives as long as the process."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(item))
    return item


def _items(items: Any) -> Iterator[Any]:
    item_list = _kept(items)
    for index in range(len(item_list)):
        yield _kept(item_list[index])


def _array(items: Any, dtype: type, width: int | None = None) -> np.ndarray:
    """Copy a list of numbers; an empty list of ufbx has no type."""
    item_list = _kept(items)
    if not len(item_list):
        return np.empty((0,) if width is None else (0, width), dtype)
    return np.array(item_list, dtype=dtype)


def _matrix(matrix: Any) -> np.ndarray:
    result = np.eye(4)
    # Column-major.
    result[:3] = np.array(matrix).T
    return result


def _described(scene: Any, most_elements: int) -> dict[str, np.ndarray]:
    nodes = list(_items(scene.nodes))
    parents = [_kept(node.parent) for node in nodes]
    settings = _kept(scene.settings)
    shown_meshes = list(_shown(nodes))
    if sum(mesh.num_vertices + mesh.num_indices for _, mesh in shown_meshes) > most_elements:
        raise _TooLargeError(f"its meshes have more than {most_elements} vertices and corners")
    arrays: dict[str, np.ndarray] = {
        "names": np.array([node.name for node in nodes], dtype=np.str_),
        "parents": np.array(
            [-1 if parent is None else parent.typed_id for parent in parents], dtype=np.int64
        ),
        "transforms": np.stack([_matrix(node.node_to_world) for node in nodes]),
        "unscaled": np.array([node.inherit_mode != ufbx.InheritMode.NORMAL for node in nodes]),
        "showing": np.array([node.attrib_type not in _BARE for node in nodes]),
        "up": np.array(int(settings.axes.up)),
        "metres": np.array(settings.unit_meters),
        "fps": np.array(_frames_per_second(settings)),
        "shown": np.array([node.typed_id for node, _ in shown_meshes], dtype=np.int64),
        "unseen": np.array(_unseen(nodes, shown_meshes), dtype=np.str_),
        # Moved by a geometry cache beside the file.
        "cached": np.array(
            [node.name for node, mesh in shown_meshes if len(_kept(mesh.cache_deformers))],
            dtype=np.str_,
        ),
        "smoothed": np.array(
            [node.name for node, mesh in shown_meshes if _is_smoothed(mesh)], dtype=np.str_
        ),
    }
    for number, (node, mesh) in enumerate(shown_meshes):
        part = _part(node, mesh, most_elements)
        arrays |= {f"{number} {name}": value for name, value in part.items()}
    clips = list(_clips(scene))
    arrays["clips"] = np.array([stack.name for stack, _ in clips], dtype=np.str_)
    arrays["spans"] = np.array([_span(stack) for stack, _ in clips], np.float64).reshape(-1, 2)
    for number, (_, moved) in enumerate(clips):
        arrays[f"moved {number}"] = np.array(sorted(moved), dtype=np.int64)
    return arrays


def _is_smoothed(mesh: Any) -> bool:
    """Whether a mesh is shown or rendered subdivided."""
    levels = max(mesh.subdivision_preview_levels, mesh.subdivision_render_levels)
    return levels > 0 and mesh.subdivision_display_mode in _SMOOTH


def _frames_per_second(settings: Any) -> float:
    if _kept(settings.props).find_int("TimeMode", 0) == _TIME_MODE_119_88:
        return 120.0 / 1.001
    return float(settings.frames_per_second)


def _shown(nodes: list[Any]) -> Iterator[tuple[Any, Any]]:
    """Yield the visible nodes with a mesh, at the finest level of detail, and their meshes.

    If all meshes of a file are hidden, all count as visible.
    """
    node_meshes = [(node, mesh) for node in nodes if (mesh := _kept(node.mesh)) is not None]
    visible_meshes = [pair for pair in node_meshes if pair[0].visible] or node_meshes
    for node, mesh in visible_meshes:
        parent = _kept(node.parent)
        if parent is not None and parent.attrib_type == ufbx.ElementType.LOD_GROUP:
            levels = [child.typed_id for child in _items(parent.children)]
            if levels.index(node.typed_id) > 0:
                continue
        yield node, mesh


def _unseen(nodes: list[Any], shown: list[tuple[Any, Any]]) -> list[str]:
    """Return the names of the nodes with a mesh that are not shown."""
    shown_ids = {node.typed_id for node, _ in shown}
    return [
        node.name
        for node in nodes
        if _kept(node.mesh) is not None and node.typed_id not in shown_ids
    ]


def _clips(scene: Any) -> Iterator[tuple[Any, set[int]]]:
    """Yield the animations that move vertices, with the nodes that they move."""
    for stack in _items(scene.anim_stacks):
        moved: set[int] = set()
        is_moving = False
        for layer in _items(stack.layers):
            for anim_prop in _items(layer.anim_props):
                if anim_prop.prop_name.startswith(_ANIMATED):
                    is_moving = True
                    element = _kept(anim_prop.element)
                    if isinstance(element, ufbx.Node):
                        moved.add(element.typed_id)
        if is_moving:
            yield stack, moved


def _span(stack: Any) -> tuple[float, float]:
    """Return the start and end of an animation; those of its curves if the file lacks them."""
    if stack.time_end > stack.time_begin:
        return stack.time_begin, stack.time_end
    curves = [
        curve
        for layer in _items(stack.layers)
        for value in _items(layer.anim_values)
        for curve in value.curves
        if _kept(curve) is not None
    ]
    if not curves:
        return stack.time_begin, stack.time_end
    return min(curve.min_time for curve in curves), max(curve.max_time for curve in curves)


def _part(node: Any, mesh: Any, most_elements: int) -> dict[str, np.ndarray]:
    part = {
        "name": np.array(node.name or mesh.name),
        "points": _array(mesh.vertices, np.float64, 3).reshape(-1, 3),
        "corners": _array(mesh.vertex_indices, np.int64),
        "faces": _array(mesh.faces, np.int64, 2).reshape(-1, 2),
        "material_of": _array(mesh.face_material, np.int64),
        "materials": np.array(
            [material.name for material in _items(mesh.materials)], dtype=np.str_
        ),
        "bind": _matrix(node.geometry_to_node)[None],
        "bones": np.array([node.typed_id], dtype=np.int64),
    }
    skins = list(_items(mesh.skin_deformers))
    part["skins"] = np.array(len(skins))
    for skin in skins[:1]:
        if skin.skinning_method != ufbx.SkinningMethod.LINEAR or skin.num_dq_weights:
            # Columns: first weight, number of weights, and share of dual quaternions.
            part["dual"] = np.clip(_array(skin.vertices, np.float64, 3)[:, 2], 0.0, 1.0)
        clusters = [
            (bone, cluster)
            for cluster in _items(skin.clusters)
            if (bone := _kept(cluster.bone_node)) is not None
        ]
        bind = [_matrix(cluster.geometry_to_bone)[None] for _, cluster in clusters]
        part["bind"] = np.concatenate([part["bind"], *bind])
        joints = np.array([bone.typed_id for bone, _ in clusters], dtype=np.int64)
        part["bones"] = np.concatenate([part["bones"], joints])
        moved = [_array(cluster.vertices, np.int64) for _, cluster in clusters]
        shares = [_array(cluster.weights, np.float64) for _, cluster in clusters]
        part["moved"] = np.concatenate([np.empty(0, np.int64), *moved])
        part["shares"] = np.concatenate([np.empty(0), *shares])
        counts = [len(some) for some in moved]
        part["movers"] = np.repeat(np.arange(len(counts)) + 1, counts)
    shapes = list(_shapes(mesh))
    if len(shapes) * len(part["points"]) > most_elements:
        raise _TooLargeError(f"its blend shapes have more than {most_elements} vertices")
    for number, shape in enumerate(shapes):
        part[f"changed {number}"] = _array(shape.offset_vertices, np.int64)
        offsets = _array(shape.position_offsets, np.float64, 3).reshape(-1, 3)
        # Blender stores the vertex group that masks a shape key as weights.
        mask = _array(shape.offset_weights, np.float64)
        part[f"offsets {number}"] = offsets * mask[:, None] if len(mask) else offsets
    part["weights"] = _weights(mesh)
    part["shapes"] = np.array(_shape_names(mesh), dtype=str)
    return part


def _looks(scene: Any) -> dict[str, np.ndarray]:
    """Return the materials, their textures, and the UVs, colours and normals of the corners."""
    colours: list[np.ndarray] = []
    texture_of: list[int] = []
    names: list[str] = []
    clamps: list[list[bool]] = []
    arrays: dict[str, np.ndarray] = {}
    number_of_material: dict[int, int] = {}
    for material in _items(scene.materials):
        maps = _kept(material.pbr)
        base, factor = _kept(maps.base_color), _kept(maps.base_factor)
        colour = np.array(list(base.value_vec4)[:3]) if base.has_value else np.ones(3)
        colour = colour * (factor.value_vec4.x if factor.has_value else 1.0)
        texture = _kept(base.texture)
        files = [] if texture is None else list(_items(texture.file_textures))
        number = -1
        if files:
            texture = files[0]
            number = number_of_material.setdefault(texture.typed_id, len(number_of_material))
            if number == len(names):
                names.append(texture.relative_filename or texture.filename)
                clamps.append([int(texture.wrap_u) == 1, int(texture.wrap_v) == 1])
                content = np.frombuffer(texture.content, dtype=np.uint8)
                arrays[f"content {number}"] = content
        colours.append(colour)
        texture_of.append(number)
    arrays["colours"] = np.array(colours, dtype=np.float64).reshape(-1, 3)
    arrays["texture_of"] = np.array(texture_of, dtype=np.int64)
    arrays["textures"] = np.array(names, dtype=np.str_)
    arrays["clamps"] = np.array(clamps, dtype=bool).reshape(-1, 2)
    for number, (_, mesh) in enumerate(_shown(list(_items(scene.nodes)))):
        materials = [material.typed_id for material in _items(mesh.materials)]
        arrays[f"{number} materials"] = np.array(materials, dtype=np.int64)
        for name, width, given in (
            ("uv", 2, _kept(mesh.vertex_uv)),
            ("colours", 4, _kept(mesh.vertex_color)),
            ("normals", 3, _kept(mesh.vertex_normal)),
        ):
            if given.exists:
                values = _array(given.values, np.float64, width).reshape(-1, width)
                arrays[f"{number} {name}"] = values[_array(given.indices, np.int64)]
    return arrays


def _keyframes(mesh: Any) -> Iterator[Any]:
    for deformer in _items(mesh.blend_deformers):
        for channel in _items(deformer.channels):
            yield from _items(channel.keyframes)


def _shapes(mesh: Any) -> Iterator[Any]:
    for keyframe in _keyframes(mesh):
        yield _kept(keyframe.shape)


def _shape_names(mesh: Any) -> list[str]:
    """Return the names of the channels; for one with in-between shapes, the shapes' names."""
    names: list[str] = []
    for deformer in _items(mesh.blend_deformers):
        for channel in _items(deformer.channels):
            shapes = [str(_kept(one.shape).name) for one in _items(channel.keyframes)]
            names += shapes if len(shapes) != 1 else [str(channel.name)]
    return names


def _weights(mesh: Any) -> np.ndarray:
    return np.array([keyframe.effective_weight for keyframe in _keyframes(mesh)], dtype=np.float64)


def _sampled(scene: Any, clip: int, times: list[float]) -> dict[str, np.ndarray]:
    stack, _ = list(_clips(scene))[clip]
    animation = _kept(stack.anim)
    shown_ids = [node.typed_id for node, _ in _shown(list(_items(scene.nodes)))]
    transforms, weights = [], []
    for time in times:
        posed = _kept(ufbx.evaluate_scene(scene, animation, time))
        nodes = list(_items(posed.nodes))
        transforms.append(np.stack([_matrix(node.node_to_world) for node in nodes]))
        weights.append([_weights(_kept(nodes[number].mesh)) for number in shown_ids])
        posed.free()
    arrays = {"transforms": np.stack(transforms)}
    for number in range(len(weights[0])):
        arrays[f"{number} weights"] = np.stack([frame[number] for frame in weights])
    return arrays


def _limit_memory(n_bytes: int) -> None:
    try:
        import resource
    except ImportError:  # Windows
        return
    resource.setrlimit(resource.RLIMIT_AS, (n_bytes, n_bytes))
    # Some files are expected to crash ufbx, so write no core dumps.
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main() -> int:
    """Read standard input, write standard output, and return the exit status."""
    gc.disable()
    request = json.loads(sys.stdin.buffer.readline())
    _limit_memory(request["most_memory"])
    try:
        scene = _kept(
            ufbx.load_memory(
                sys.stdin.buffer.read(),
                ignore_embedded=not request["looks"],
                load_external_files=False,
                clean_skin_weights=True,
                skip_mesh_parts=True,
                # Accept only FBX, whatever the content looks like.
                file_format=ufbx.FileFormat.FBX,
            )
        )
        if request["looks"]:
            arrays = _looks(scene)
        elif request["times"] is None:
            arrays = _described(scene, request["most_elements"])
        else:
            arrays = _sampled(scene, request["clip"], request["times"])
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
    except (ufbx.UfbxError, _TooLargeError) as error:
        print(" ".join(str(error).split()) or type(error).__name__, file=sys.stderr)  # noqa: T201
        return REFUSED
    except MemoryError:
        print("it needs too much memory", file=sys.stderr)  # noqa: T201
        return REFUSED
    sys.stdout.buffer.write(buffer.getvalue())
    return 0


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    # Releasing the objects of ufbx would crash.
    os._exit(status)
