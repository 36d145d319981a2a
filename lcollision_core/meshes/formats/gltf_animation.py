"""The animations of a glTF file: channels that move nodes and weigh morph targets over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.formats.gltf_document import GltfDocument, as_float, element, numbers
from lcollision_core.meshes.formats.scene import Clip, Part, ScenePoses
from lcollision_core.meshes.formats.transforms import (
    compose,
    decompose,
    global_transforms,
    slerp,
)
from lcollision_core.meshes.numbered_names import numbered_where_equal
from lcollision_core.meshes.topology import FloatArray

_PATHS = {"translation": 3, "rotation": 4, "scale": 3}
_WEIGHTS = "weights"


@dataclass(frozen=True, eq=False)
class _Channel:
    """Values of one property over time.

    Attributes
    ----------
    node, path : what it drives
    interpolation : STEP, LINEAR or CUBICSPLINE
    times : (T,) float64 array, ascending
    values : (T, k) float64 array, for CUBICSPLINE (T, 3, k): tangent in, value, tangent out
    """

    node: int
    path: str
    interpolation: str
    times: FloatArray
    values: FloatArray

    def at(self, times: FloatArray) -> FloatArray:
        """Return the (N, k) values at (N,) times, the first before all keys, the last after."""
        before = np.searchsorted(self.times, times, side="right") - 1
        before = np.clip(before, 0, len(self.times) - 1)
        after = np.minimum(before + 1, len(self.times) - 1)
        step = self.times[after] - self.times[before]
        share = (np.clip(times, self.times[0], self.times[-1]) - self.times[before]) / np.where(
            step > 0.0, step, 1.0
        )
        if self.interpolation == "STEP":
            return self.values[before]
        if self.interpolation == "LINEAR":
            start, end = self.values[before], self.values[after]
            if self.path == "rotation":
                return slerp(start, end, share)
            return start + share[:, None] * (end - start)
        # Hermite, with tangents per second: appendix C of the glTF 2.0 specification.
        t, duration = share[:, None], step[:, None]
        start, leaving = self.values[before, 1], duration * self.values[before, 2]
        end, arriving = self.values[after, 1], duration * self.values[after, 0]
        curve: FloatArray = (
            (2.0 * t**3 - 3.0 * t**2 + 1.0) * start
            + (t**3 - 2.0 * t**2 + t) * leaving
            + (3.0 * t**2 - 2.0 * t**3) * end
            + (t**3 - t**2) * arriving
        )
        return curve


@dataclass(frozen=True, eq=False)
class _GltfClip:
    """Samples an animation.

    Attributes
    ----------
    channels : at most one a node and property
    stored : of each animated node its translation, rotation and scale where no channel drives them
    local : (n, 4, 4) array, the nodes as the file stores them
    parents, order : of the nodes
    part_nodes : of each part the node that shows it
    default_weights : of each part
    """

    channels: tuple[_Channel, ...]
    stored: dict[int, dict[str, FloatArray]]
    local: FloatArray
    parents: npt.NDArray[np.int64]
    order: Sequence[int]
    part_nodes: tuple[int, ...]
    default_weights: tuple[FloatArray, ...]

    def __call__(self, times: FloatArray) -> ScenePoses:
        """Return the poses at (N,) times."""
        n = len(times)
        moved = {
            node: {path: np.tile(value, (n, 1)) for path, value in values.items()}
            for node, values in self.stored.items()
        }
        weights: dict[int, FloatArray] = {}
        for channel in self.channels:
            if channel.path == _WEIGHTS:
                weights[channel.node] = channel.at(times)
            else:
                moved[channel.node][channel.path] = channel.at(times)
        local = np.tile(self.local, (n, 1, 1, 1))
        for node, values in moved.items():
            local[:, node] = compose(values["translation"], values["rotation"], values["scale"])
        transforms = global_transforms(local, self.parents, self.order)
        # Primitives of a mesh may have fewer targets than the first.
        of_parts = tuple(
            weights[node][:, : len(default)] if node in weights else np.tile(default, (n, 1))
            for node, default in zip(self.part_nodes, self.default_weights, strict=True)
        )
        return ScenePoses(transforms, of_parts)


def read_clips(
    document: GltfDocument,
    local: FloatArray,
    parents: npt.NDArray[np.int64],
    order: Sequence[int],
    parts: Sequence[Part],
    default_weights: tuple[FloatArray, ...],
) -> tuple[Clip, ...]:
    """Read the animations that move a node or weigh a morph target.

    Parameters
    ----------
    document : the file
    local : (n, 4, 4) array, the nodes as stored
    parents, order : of the nodes
    parts : what the nodes show
    default_weights : of each part's morph targets

    Raises
    ------
    MeshFileError : an animation is damaged.
    """
    animations = document.description.animations
    names = numbered_where_equal(
        str(one.name or f"animation {i}") for i, one in enumerate(animations)
    )
    n_targets: dict[int, int] = {}
    for part in parts:
        n_targets[part.node] = max(len(part.morphs), n_targets.get(part.node, 0))
    part_nodes = tuple(part.node for part in parts)
    clips = []
    for name, animation in zip(names, animations, strict=True):
        where = f"animation {name!r}"
        channels = _channels(document, animation, where, n_targets)
        if not channels:
            continue
        stored = {
            channel.node: _stored(document.description.nodes[channel.node], channel.node)
            for channel in channels
            if channel.path != _WEIGHTS
        }
        sample = _GltfClip(channels, stored, local, parents, order, part_nodes, default_weights)
        key_times = np.unique(np.concatenate([channel.times for channel in channels]))
        clips.append(Clip(name, key_times, frozenset(stored), sample))
    return tuple(clips)


def _stored(node: Any, number: int) -> dict[str, FloatArray]:
    if node.matrix is not None:
        stored = numbers(node.matrix, f"the matrix of node {number}", 16).reshape(4, 4).T
        return dict(zip(_PATHS, decompose(stored), strict=True))
    return dict(zip(_PATHS, stored_transform(node, f"node {number}"), strict=True))


def stored_transform(node: Any, where: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the stored translation, rotation (x, y, z, w) and scale of a node."""
    given = (node.translation, node.rotation, node.scale)
    absent = ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [1.0, 1.0, 1.0])
    moved, turned, scaled = (
        numbers(default if value is None else value, f"the {path} of {where}", len(default))
        for value, default, path in zip(given, absent, _PATHS, strict=True)
    )
    return moved, turned, scaled


def _channels(
    document: GltfDocument, animation: Any, where: str, n_targets: dict[int, int]
) -> tuple[_Channel, ...]:
    nodes = document.description.nodes
    found: dict[tuple[int, str], _Channel] = {}
    for channel in animation.channels or ():
        target = channel.target
        if target is None or target.node is None:
            continue  # Driven by an extension.
        element(nodes, target.node, f"a node of {where}")
        width = _PATHS.get(target.path, n_targets.get(target.node, 0))
        if not width or (target.path not in _PATHS and target.path != _WEIGHTS):
            continue  # Weights of nothing, or the property of an extension.
        sampler = element(animation.samplers, channel.sampler, f"a sampler of {where}")
        found[target.node, target.path] = _channel(
            document, sampler, target.node, target.path, width, where
        )
    return tuple(found.values())


def _channel(
    document: GltfDocument, sampler: Any, node: int, path: str, width: int, where: str
) -> _Channel:
    interpolation = sampler.interpolation or "LINEAR"
    if interpolation not in ("STEP", "LINEAR", "CUBICSPLINE"):
        raise MeshFileError.must_be(
            f"the interpolation of {where}", "STEP, LINEAR or CUBICSPLINE", interpolation
        )
    what = f"the times of {where}"
    times = as_float(document.array(sampler.input, what, ("SCALAR",))[:, 0])
    if not len(times) or not np.isfinite(times).all() or (np.diff(times) < 0.0).any():
        raise MeshFileError.must_be(what, "finite and ascending", f"{len(times)} others")
    what = f"the {path} values of {where}"
    types = {3: ("VEC3",), 4: ("VEC4",)}.get(width) if path in _PATHS else ("SCALAR",)
    per_key = 3 if interpolation == "CUBICSPLINE" else 1
    n_values = len(times) * per_key * (1 if path in _PATHS else width)
    values = as_float(document.array(sampler.output, what, types or ("SCALAR",), n_values))
    if not np.isfinite(values).all():
        raise MeshFileError("are not all finite", where=what)
    shape = (len(times), 3, width) if per_key == 3 else (len(times), width)
    values = values.reshape(shape)
    if path == "rotation" and interpolation != "CUBICSPLINE":
        lengths = np.linalg.norm(values, axis=-1, keepdims=True)
        values = values / np.where(lengths > 0.0, lengths, 1.0)
    return _Channel(node, path, interpolation, times, values)
