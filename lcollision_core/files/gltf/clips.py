"""The animations of a glTF file: channels that move nodes and weight morph targets over time."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.files.gltf.schema import (
    PARTS,
    GltfDocument,
    as_float,
    extension_of,
    inner,
    require_element,
    require_int,
    stored_parts,
)
from lcollision_core.files.safe import make_unique
from lcollision_core.files.scene.scene import KEYS_ARE_FRAMES, Clip, Part, ScenePoses
from lcollision_core.files.scene.transforms import (
    compose,
    global_transforms,
    signs_on_one_side,
    slerp,
    unit_quaternions,
)
from lcollision_core.json_values import quoted
from lcollision_core.meshes.topology import FloatArray


class Nodes(NamedTuple):
    """The n nodes of a file, without their meshes.

    Attributes
    ----------
    parents : (n,) int64 array, -1 for a root
    order : the nodes, parents first
    local, rest : (n, 4, 4) local and global transforms
    """

    parents: npt.NDArray[np.int64]
    order: list[int]
    local: FloatArray
    rest: FloatArray


_WEIGHTS = "weights"

POINTER = "KHR_animation_pointer"
_NODE_POINTER = re.compile(r"/nodes/(\d{1,9})/(translation|rotation|scale|weights)")

_SAME_TIME = 1e-5
"""Tolerance of key times in seconds, as they are stored in single precision."""

_ROUNDED = 1e-6
"""Tolerance of a rotation's length, as a quaternion is stored in single precision."""


@dataclass(frozen=True, eq=False)
class Track:
    """One property of C nodes with the same key times.

    Attributes
    ----------
    nodes, path : the driven nodes and property
    interpolation : STEP, LINEAR or CUBICSPLINE
    times : (T,) float64 array, ascending
    values : (T, C, k) float64 array; for CUBICSPLINE (T, 3, C, k): in-tangent, value, out-tangent
    """

    nodes: tuple[int, ...]
    path: str
    interpolation: str
    times: FloatArray
    values: FloatArray

    def at(self, times: FloatArray) -> FloatArray:
        """Return the (N, C, k) values at (N,) times, clamped to the first and last key."""
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
                return slerp(start, end, share[:, None])
            return start + share[:, None, None] * (end - start)
        # Hermite, with tangents per second: appendix C of the glTF 2.0 specification.
        t, duration = share[:, None, None], step[:, None, None]
        start, leaving = self.values[before, 1], duration * self.values[before, 2]
        end, arriving = self.values[after, 1], duration * self.values[after, 0]
        curve: FloatArray = (
            (2.0 * t**3 - 3.0 * t**2 + 1.0) * start
            + (t**3 - 2.0 * t**2 + t) * leaving
            + (3.0 * t**2 - 2.0 * t**3) * end
            + (t**3 - t**2) * arriving
        )
        return curve

    def with_span(
        self, before: float | None, times: FloatArray, after: float | None, values: FloatArray
    ) -> Track:
        """Return the track with new linear keys in a span of time, unchanged elsewhere.

        The property moves linearly from the frame before the span and to the frame after it. The
        keys of a stepped track become pairs of linear ones.

        Parameters
        ----------
        before, after : times of the frames on either side; None if there is none
        times : (n,) float64 array, ascending, between them
        values : (n, C, k) float64 array, the new values
        """
        track = self._unstepped()
        lead, tail = ([] if track is None else [track] for track in (before, after))
        inner = np.array([*lead, *times, *tail])
        rows = np.concatenate([track.at(np.array(lead)), values, track.at(np.array(tail))])
        kept_before = track.times < inner[0] - _SAME_TIME
        kept_after = track.times > inner[-1] + _SAME_TIME
        later = track.values[kept_after]
        if self.path == "rotation":
            signs = signs_on_one_side(rows)
            rows *= signs[..., None]
            if tail:
                later = later * signs[-1][:, None]
        if self.interpolation == "CUBICSPLINE":
            slopes = np.diff(rows, axis=0) / np.diff(inner)[:, None, None]
            arriving = np.concatenate([track._slope(inner[:1], "left"), slopes])
            last = track._slope(inner[-1:], "right")
            if self.path == "rotation":
                last = last * signs[-1:, :, None]
            leaving = np.concatenate([slopes, last])
            rows = np.stack([arriving, rows, leaving], axis=1)
        return replace(
            track,
            times=np.concatenate([track.times[kept_before], inner, track.times[kept_after]]),
            values=np.concatenate([track.values[kept_before], rows, later]),
        )

    def _unstepped(self) -> Track:
        """Return a stepped track with linear keys, a pair on either side of each step."""
        if self.interpolation != "STEP":
            return self
        just_before = np.nextafter(self.times[1:].astype(np.float32), np.float32(-np.inf))
        return replace(
            self,
            interpolation="LINEAR",
            times=np.sort(np.concatenate([self.times, just_before.astype(np.float64)])),
            values=np.repeat(self.values, 2, axis=0)[:-1],
        )

    def _slope(self, time: FloatArray, side: Literal["left", "right"]) -> FloatArray:
        """Return the one-sided (1, C, k) slope of a cubic curve at a (1,) time."""
        at = np.searchsorted(self.times, time + (_SAME_TIME if side == "right" else -_SAME_TIME))
        start, end = at - 1, at
        if start[0] < 0 or end[0] == len(self.times):
            return np.zeros_like(self.values[:1, 1])
        step = (self.times[end] - self.times[start])[:, None, None]
        t = (time - self.times[start])[:, None, None] / step
        slope: FloatArray = (
            (6.0 * t**2 - 6.0 * t) / step * (self.values[start, 1] - self.values[end, 1])
            + (3.0 * t**2 - 4.0 * t + 1.0) * self.values[start, 2]
            + (3.0 * t**2 - 2.0 * t) * self.values[end, 0]
        )
        return slope


@dataclass(frozen=True, eq=False)
class ClipTracks:
    """The tracks of one animation, node by node.

    Attributes
    ----------
    number : index of the animation in the file
    document : the file
    driven : see `_GltfClip`
    """

    number: int
    document: GltfDocument
    driven: dict[tuple[int, str], tuple[dict[str, Any], int]]

    @classmethod
    def of(cls, document: GltfDocument, name: str, parts: Sequence[Part] = ()) -> ClipTracks:
        """Find an animation by the name that `read_clips` gives it.

        Parameters
        ----------
        parts : parts whose morph targets it may weight

        Raises
        ------
        MeshFileError : there is no such animation.
        """
        animations = document.objects("animations")
        names = _names(animations)
        if name not in names:
            raise MeshFileError(f"it has no clip {name!r}")
        number = names.index(name)
        n_targets = _target_counts(parts)
        driven = _driven(document, animations[number], f"animation {name!r}", n_targets)
        return cls(number, document, driven)

    def track(
        self, node: int, path: str, start: float = 0.0, at_rest: FloatArray | None = None
    ) -> Track:
        """Return the track of a node's property; if it is not animated, one key at `start`.

        Pass the start of the animation, so that the key does not make it longer.

        Parameters
        ----------
        at_rest : weights of the morph targets at rest, for the property "weights"
        """
        if (node, path) not in self.driven:
            stored = at_rest
            if stored is None:
                stored = _stored(self.document.objects("nodes")[node], node)[path]
            return Track((node,), path, "LINEAR", np.full(1, start), stored[None, None])
        sampler, width = self.driven[node, path]
        what = f"the {path} of node {node}"
        # Changed clips were sampled before, so do not count their numbers again.
        read = partial(self.document.array, again=True)
        times = as_float(read(sampler["input"], what, ("SCALAR",))[:, 0])
        interpolation = sampler.get("interpolation", "LINEAR")
        shape = (len(times), 3) if interpolation == "CUBICSPLINE" else (len(times),)
        kind = "SCALAR" if path == _WEIGHTS else f"VEC{width}"
        values = as_float(read(sampler["output"], what, (kind,)))
        if path == "rotation" and interpolation != "CUBICSPLINE":
            is_unit = np.abs(np.linalg.norm(values, axis=1, keepdims=True) - 1.0) < _ROUNDED
            values = np.where(is_unit, values, unit_quaternions(values))
        return Track((node,), path, interpolation, times, values.reshape(*shape, 1, width))


@dataclass(frozen=True, eq=False)
class _GltfClip:
    """Samples an animation, whose arrays are read on first use.

    Attributes
    ----------
    document : the file
    where : name of the animation in error messages
    driven : the sampler, and its numbers per key, by node and property
    stored : returns the translation, rotation and scale of a node in the file
    nodes : of the file
    parts : parts that the nodes show
    default_weights : weights of each part's morph targets in the file
    """

    document: GltfDocument
    where: str
    driven: dict[tuple[int, str], tuple[dict[str, Any], int]]
    stored: Callable[[int], dict[str, FloatArray]]
    nodes: Nodes
    parts: Sequence[Part]
    default_weights: tuple[FloatArray, ...]

    @property
    def moved(self) -> frozenset[int]:
        """The nodes that the animation moves."""
        return frozenset(node for node, path in self.driven if path != _WEIGHTS)

    @cached_property
    def _times(self) -> dict[int, FloatArray]:
        """The (T,) key times by accessor; equal times share an array."""
        what = f"the times of {self.where}"
        times_of: dict[int, FloatArray] = {}
        times_of_bytes: dict[bytes, FloatArray] = {}
        last = len(self.document.objects("accessors")) - 1
        for sampler, _ in self.driven.values():
            index = require_int(sampler.get("input"), f"the accessor of {what}", 0, last)
            if index not in times_of:
                times = as_float(self.document.array(index, what, ("SCALAR",))[:, 0])
                times_of[index] = times_of_bytes.setdefault(times.tobytes(), times)
        for times in times_of_bytes.values():
            if not len(times):
                raise MeshFileError(f"{self.where} has no keys")
            broken = np.flatnonzero(~np.isfinite(times) | (np.diff(times, prepend=times[0]) < 0.0))
            if len(broken):
                key = f"{times[broken[0]]:g} as key {broken[0]} (from 0)"
                raise MeshFileError.must_be(what, "finite and ascending", key)
        return times_of

    def key_times(self) -> FloatArray:
        """Return the (T,) times of all keys, ascending."""
        return np.unique(np.concatenate(list(self._times.values())))

    @cached_property
    def _tracks(self) -> list[Track]:
        alike: dict[Any, tuple[FloatArray, list[int], list[npt.NDArray[Any]]]] = {}
        for (node, path), (sampler, width) in self.driven.items():
            interpolation = sampler.get("interpolation", "LINEAR")
            if interpolation not in ("STEP", "LINEAR", "CUBICSPLINE"):
                raise MeshFileError.must_be(
                    f"the interpolation of {self.where}",
                    "STEP, LINEAR or CUBICSPLINE",
                    quoted(interpolation),
                )
            times = self._times[sampler["input"]]
            kind, per_value = ("SCALAR", width) if path == _WEIGHTS else (f"VEC{width}", 1)
            shape = (len(times), 3) if interpolation == "CUBICSPLINE" else (len(times),)
            what = f"the {path} values of {self.where}"
            count = int(np.prod(shape)) * per_value
            values = self.document.array(sampler.get("output"), what, (kind,), count)
            key = path, interpolation, id(times), width
            _, nodes, stored = alike.setdefault(key, (times, [], []))
            nodes.append(node)
            stored.append(values.reshape(*shape, width))
        return [
            Track(tuple(nodes), path, interpolation, times, self._checked(stored, path))
            for (path, interpolation, _, _), (times, nodes, stored) in alike.items()
        ]

    def _checked(self, stored: list[npt.NDArray[Any]], path: str) -> FloatArray:
        """Stack the values of a track's nodes, with rotations normalised."""
        values = as_float(np.stack(stored, axis=-2))
        broken = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
        if len(broken):
            what = f"the {path} values of {self.where}"
            raise MeshFileError(f"key {broken[0]} (from 0) of {what} is not finite")
        if path == "rotation" and values.ndim == 3:
            values = unit_quaternions(values)
        return values

    def __call__(self, times: FloatArray) -> ScenePoses:
        """Return the poses at (N,) times."""
        n, nodes = len(times), sorted(self.moved)
        row = {node: number for number, node in enumerate(nodes)}
        stored = {
            path: np.tile(
                np.reshape([self.stored(node)[path] for node in nodes], (-1, len(part))), (n, 1, 1)
            )
            for path, part in PARTS.items()
        }
        weights: dict[int, FloatArray] = {}
        for track in self._tracks:
            values = track.at(times)
            if track.path == _WEIGHTS:
                weights |= {node: values[:, i] for i, node in enumerate(track.nodes)}
            else:
                stored[track.path][:, [row[node] for node in track.nodes]] = values
        local = np.tile(self.nodes.local, (n, 1, 1, 1))
        local[:, nodes] = compose(stored["translation"], stored["rotation"], stored["scale"])
        transforms = global_transforms(local, self.nodes.parents, self.nodes.order)
        # Primitives of a mesh may have fewer targets than the first.
        of_parts = tuple(
            weights[part.node][:, : len(default)]
            if part.node in weights
            else np.tile(default, (n, 1))
            for part, default in zip(self.parts, self.default_weights, strict=True)
        )
        return ScenePoses(transforms, of_parts)


def read_clips(
    document: GltfDocument,
    nodes: Nodes,
    parts: Sequence[Part] = (),
    default_weights: tuple[FloatArray, ...] = (),
) -> tuple[Clip, ...]:
    """Return the animations that move a node or weight a morph target; arrays are read later.

    Parameters
    ----------
    document : the file
    nodes : of the file
    parts : parts that the nodes show
    default_weights : weights of each part's morph targets in the file

    Raises
    ------
    MeshFileError : an animation refers to an unknown node or sampler. Damaged arrays raise it when
        they are read.
    """
    animations = document.objects("animations")
    names = _names(animations)
    n_targets = _target_counts(parts)
    described = document.objects("nodes")
    stored = cache(lambda number: _stored(described[number], number))
    clips = []
    for name, animation in zip(names, animations, strict=True):
        where = f"animation {name!r}"
        driven = _driven(document, animation, where, n_targets)
        if driven:
            sample = _GltfClip(document, where, driven, stored, nodes, parts, default_weights)
            is_baked = inner(animation, "extras").get(KEYS_ARE_FRAMES) is True
            clips.append(Clip(name, sample.moved, sample.key_times, sample, is_baked))
    return tuple(clips)


def _target_counts(parts: Sequence[Part]) -> dict[int, int]:
    """Return the number of morph targets of each node."""
    counts: dict[int, int] = {}
    for part in parts:
        counts[part.node] = max(len(part.morphs), counts.get(part.node, 0))
    return counts


def _names(animations: Sequence[dict[str, Any]]) -> list[str]:
    return make_unique(
        str(animation.get("name") or f"animation {i}") for i, animation in enumerate(animations)
    )


def _stored(node: dict[str, Any], number: int) -> dict[str, FloatArray]:
    return dict(zip(PARTS, stored_parts(node, f"node {number}"), strict=True))


def driven_property(channel: dict[str, Any]) -> tuple[Any, Any]:
    """Return the node and the property that a channel drives; None if it names none."""
    target = channel.get("target", {})
    return pointed_node(target) or (target.get("node"), target.get("path"))


def _driven(
    document: GltfDocument, animation: dict[str, Any], where: str, n_targets: dict[int, int]
) -> dict[tuple[int, str], tuple[dict[str, Any], int]]:
    """Return `_GltfClip.driven`."""
    nodes = document.objects("nodes")
    driven: dict[tuple[int, str], tuple[dict[str, Any], int]] = {}
    for channel in animation.get("channels", ()):
        node, path = driven_property(channel)
        if node is None:
            continue  # An extension defines the target.
        require_element(nodes, node, f"a node of {where}")
        if path not in (*PARTS, _WEIGHTS):
            continue  # An extension defines the property.
        width = n_targets.get(node, 0) if path == _WEIGHTS else len(PARTS[path])
        if width:
            samplers = animation.get("samplers")
            sampler = require_element(samplers, channel.get("sampler"), f"a sampler of {where}")
            driven[node, path] = sampler, width
    return driven


def pointed_node(target: dict[str, Any]) -> tuple[int, str] | None:
    """Return the node and the property that a channel's pointer refers to, if it does."""
    match = _NODE_POINTER.fullmatch(pointer_of(target))
    return (int(match[1]), match[2]) if match else None


def pointer_of(target: dict[str, Any]) -> str:
    """Return the pointer of a channel; empty if it names a node instead."""
    pointer = extension_of(target, POINTER).get("pointer")
    return pointer if target.get("path") == "pointer" and isinstance(pointer, str) else ""
