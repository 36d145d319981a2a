"""Read FBX by ufbx in a separate process: meshes, rigs, clips and appearance."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError, MissingExtraError
from lcollision_core.files.mesh.polygons import (
    MAX_FACES,
    MAX_FILE_BYTES,
    MAX_NUMBERS,
    Polygons,
    require_plausible_count,
    triangulate,
)
from lcollision_core.files.safe import make_unique, read_regular
from lcollision_core.files.scene.appearance import Appearance, ImageReader, Material, Texture, Wrap
from lcollision_core.files.scene.scene import (
    NO_MESH,
    Clip,
    NoMeshError,
    Part,
    Scene,
    ScenePoses,
    bind_pose,
    is_mirrored,
    left_out_note,
)
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.json_values import quoted
from lcollision_core.meshes.topology import FloatArray, Int64Array


@dataclass(frozen=True, eq=False)
class MeshFaces:
    """The faces of a mesh, to which an appearance is applied.

    Attributes
    ----------
    number : index of the mesh among those shown
    is_used : (C,) bool array, which of the mesh's corners belong to polygons
    corners : (c,) int64 array, vertices of those corners, polygon by polygon
    sizes : number of corners of each polygon
    faces : (F, 3) int64 array, triangles of vertices
    polygon_of, material_of : (F,) int64 arrays, polygon and material of each triangle
    """

    number: int
    is_used: npt.NDArray[np.bool_]
    corners: Int64Array
    sizes: Int64Array
    faces: Int64Array
    polygon_of: Int64Array
    material_of: Int64Array

    def faces_of_corners(self) -> Int64Array:
        """Return the (F, 3) triangles as indices into `corners`."""
        n = int(self.corners.max()) + 1
        keys = np.repeat(np.arange(len(self.sizes)), self.sizes) * n + self.corners
        order = np.argsort(keys, kind="stable")
        face_keys = self.polygon_of[:, None] * n + self.faces
        return order[np.searchsorted(keys, face_keys, sorter=order)]


class FbxLooks:
    """Reads the appearance of the meshes of one file.

    Missing or damaged values are left out with a note.

    Parameters
    ----------
    ask : returns the arrays of `fbx_worker`
    path : path of the file, beside which textures may lie
    """

    def __init__(self, ask: Callable[[], dict[str, Any]], path: Path) -> None:
        self._ask, self._path = ask, path

    @cached_property
    def _arrays(self) -> dict[str, Any]:
        return self._ask()

    @cached_property
    def _materials(self) -> tuple[list[Material], list[str]]:
        """The materials of the file, the last without texture, and notes."""
        images, notes = ImageReader(), list[str]()
        textures: list[Texture | None] = []
        for number, name in enumerate(self._arrays["textures"].tolist()):
            wraps = [
                Wrap.CLAMP if clamps else Wrap.REPEAT for clamps in self._arrays["clamps"][number]
            ]
            try:
                data = self._arrays[f"content {number}"].tobytes() or self._beside(name)
                # FBX has v = 0 at the bottom.
                pixels = images.read(data, f"the texture {quoted(name)}")
                textures.append(Texture(pixels, (wraps[0], wraps[1]), file=data))
            except MeshFileError as error:
                textures.append(None)
                notes.append(error.headline)
        material_textures = [
            None if number < 0 else textures[number] for number in self._arrays["texture_of"]
        ]
        return [Material(texture) for texture in [*material_textures, None]], notes

    def _beside(self, name: str) -> bytes:
        """Read a texture file by name, beside the FBX file or in usual folders."""
        file = name.replace("\\", "/").rpartition("/")[2]
        folder = self._path.parent
        for place in (folder, folder / f"{self._path.stem}.fbm", folder / "textures"):
            if file and (place / file).is_file():
                try:
                    return read_regular(place / file, MAX_FILE_BYTES)
                except (OSError, ValueError) as error:
                    raise MeshFileError.unreadable(f"the texture {quoted(name)}", error) from error
        raise MeshFileError("is not beside the file", where=f"the texture {quoted(name)}")

    def appearance(self, laid: MeshFaces, *, shaded: bool = False) -> Appearance:
        """Read the appearance of a mesh; if `shaded`, with normals, which split points too."""
        looks, (materials, notes) = self._arrays, self._materials
        faces = laid.faces_of_corners()
        prefix, n = f"{laid.number} ", len(laid.corners)
        uv = np.zeros((n, 2))
        if prefix + "uv" in looks:
            uv = looks[prefix + "uv"][laid.is_used] * [1.0, -1.0] + [0.0, 1.0]
        colours = np.ones((n, 4))
        if prefix + "colours" in looks:
            colours = looks[prefix + "colours"][laid.is_used]
        # The last material is for faces without one.
        numbers = np.append(looks[prefix + "materials"], len(materials) - 1)
        material_numbers = np.where(laid.material_of < len(numbers) - 1, laid.material_of, -1)
        material_of = numbers[material_numbers]
        # Corners are not shared between polygons, so each has one material.
        of_corner = np.zeros(n, dtype=np.int64)
        of_corner[faces] = material_of[:, None]
        # A texture replaces the colour of its material.
        base = np.concatenate([looks["colours"], np.ones((1, 3))])
        base[[material.texture is not None for material in materials]] = 1.0
        colours[:, :3] = colours[:, :3] * base[of_corner]
        finite = np.isfinite(uv).all() and np.isfinite(colours).all()
        uv, colours = (uv, colours) if finite else (np.zeros_like(uv), np.ones_like(colours))
        painted = np.rint(255.0 * np.clip(colours, 0.0, 1.0))
        normals = np.zeros((n, 0))
        if shaded and prefix + "normals" in looks:
            normals = looks[prefix + "normals"][laid.is_used]
            normals = normals if np.isfinite(normals).all() else np.zeros((n, 0))
        # Merge equal corners into one point.
        alike = np.column_stack([laid.corners, uv, painted, normals])
        _, first_points, point_of = np.unique(alike, axis=0, return_index=True, return_inverse=True)
        return Appearance(
            laid.corners[first_points],
            point_of.reshape(-1)[faces],
            uv[first_points].astype(np.float32),
            painted[first_points].astype(np.uint8),
            material_of,
            tuple(materials),
            tuple(notes),
            normals[first_points].astype(np.float32) if normals.size else None,
        )


_MOST_MEMORY = 1 << 32
"""Limit of the reading process's address space in bytes, if the system supports it."""

_MOST_SECONDS = 300
_POLL_SECONDS = 0.1
_REFUSED = 3
_WORKER = Path(__file__).with_name("fbx_worker.py")
_UNKNOWN_AXIS = 6
_MOST_FRAMES = 1_000_000
_USUAL_RATE = 24.0
_SAME_FRAME = 0.01
"""Largest difference, in frames, of a clip's length from a whole number of frames: times are stored
in ticks, rates with three digits, and a clip may have a thousand frames."""

_NTSC_ROUNDING = 2e-4
"""Relative difference of 23.98 from 24/1.001; 24 differs five times as much."""


def read_shown(source: FbxDocument) -> Scene:
    """Read the scene of the file.

    Vertices are the file's control points, in the order of its nodes. A clip's own frames are at
    the file's frame rate.

    Raises
    ------
    CancelledError : the job of `source` was cancelled.
    MissingExtraError : the extra `fbx` is not installed.
    MeshFileError : the file is damaged or too large, or shows no faces.
    """
    answer = source.request()
    looks = FbxLooks(partial(source.request, looks=True), source.path)
    unseen = answer["unseen"].tolist()
    why = "left out, as its file hides it or shows a finer level of detail"
    notes = [left_out_note(why, unseen)] if unseen else []
    if cached := answer["cached"].tolist():
        why = "not animated, as their geometry cache is not read (export PC2 or MDD instead)"
        notes.append(left_out_note(why, cached))
    if smoothed := answer["smoothed"].tolist():
        why = "not subdivided, as their levels are not read (apply them before the export)"
        notes.append(left_out_note(why, smoothed))
    shown_nodes = answer["shown"].tolist()
    numbers, parts = [], []
    for number, node in enumerate(shown_nodes):
        part = _part(_of_mesh(answer, number), number, node, answer["transforms"], looks, notes)
        if part is not None:
            numbers.append(number)
            parts.append(part)
    if not shown_nodes and len(answer["clips"]):
        raise NoMeshError(*NO_MESH)
    if not parts:
        raise MeshFileError("it shows no triangles")
    require_plausible_count(sum(len(part.points) for part in parts), "vertices")
    weights = tuple(answer[f"{number} weights"][None] for number in numbers)
    return Scene(
        tuple(answer["names"].tolist()),
        answer["parents"],
        ScenePoses(answer["transforms"][None], weights),
        tuple(parts),
        tuple(_clips(source, answer, tuple(numbers))),
        **_frame(answer),
        notes=tuple(dict.fromkeys(notes)),
        unscaled=frozenset(np.flatnonzero(answer["unscaled"]).tolist()),
    )


def read_nodes(source: FbxDocument) -> Scene:
    """Read the nodes and the clips that move them, with or without meshes.

    Raises
    ------
    CancelledError : the job of `source` was cancelled.
    MissingExtraError : the extra `fbx` is not installed.
    MeshFileError : the file is damaged or too large.
    """
    answer = source.request()
    skins = [
        (own["bones"][1:], own["bind"][1:])
        for own in (_of_mesh(answer, number) for number in range(len(answer["shown"])))
    ]
    return Scene(
        tuple(answer["names"].tolist()),
        answer["parents"],
        ScenePoses(answer["transforms"][None], ()),
        (),
        tuple(_clips(source, answer, ())),
        **_frame(answer),
        showing=frozenset(np.flatnonzero(answer["showing"]).tolist()),
        bound=bind_pose(skins),
    )


def _frame(arrays: dict[str, Any]) -> dict[str, Any]:
    """Return `up` and `metres` of a scene."""
    up, metres = int(arrays["up"]), float(arrays["metres"])
    return {
        "up": None if up == _UNKNOWN_AXIS else (1.0 - 2.0 * (up % 2)) * np.eye(3)[up // 2],
        "metres": metres if 0.0 < metres < np.inf else 0.01,
    }


@dataclass(frozen=True, eq=False)
class FbxDocument:
    """The bytes of an FBX file, which ufbx reads in a process that the job can cancel.

    Attributes
    ----------
    data : bytes of the file
    path : its path, beside which images may lie
    job : polled while it is read and its clips are sampled
    """

    data: bytes
    path: Path
    job: Job = UNWATCHED

    @property
    def has_skin(self) -> bool:
        """Whether it has clusters of a skin; names of objects are never compressed."""
        return b"Cluster" in self.data

    def request(
        self, clip: int | None = None, times: FloatArray | None = None, looks: bool = False
    ) -> dict[str, Any]:
        """Return the arrays of `fbx_worker` for a request."""
        if find_spec("ufbx") is None:
            raise MissingExtraError(
                "reading FBX needs the package ufbx, which is not installed",
                "run: pip install 'lcollision[fbx]'",
            )
        request = {
            "clip": clip,
            "times": None if times is None else times.tolist(),
            "looks": looks,
            "most_memory": _MOST_MEMORY,
            "most_elements": 4 * MAX_FACES,
        }
        code, answer, errors = self._run(json.dumps(request).encode() + b"\n" + self.data)
        if code == _REFUSED:
            reason = errors.decode(errors="replace").strip()[-200:]
            raise MeshFileError(f"it is a damaged or unsupported FBX file ({reason})")
        try:
            with np.load(io.BytesIO(answer), allow_pickle=False) as arrays:
                return dict(arrays)
        except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
            raise MeshFileError("it is a damaged FBX file: the reader crashed on it") from error

    def _run(self, request: bytes) -> tuple[int, bytes, bytes]:
        """Return the exit status, output and error output of the reading process."""
        with subprocess.Popen(
            [sys.executable, "-P", str(_WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            # Each thread of OpenBLAS reserves address space.
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        ) as process:
            ended = threading.Event()

            def stop_when_cancelled() -> None:
                while not ended.wait(_POLL_SECONDS):
                    if self.job.cancelled:
                        process.kill()

            watcher = threading.Thread(target=stop_when_cancelled)
            watcher.start()
            try:
                output, errors = process.communicate(request, timeout=_MOST_SECONDS)
            except subprocess.TimeoutExpired as error:
                raise MeshFileError(f"reading it took more than {_MOST_SECONDS} s") from error
            finally:
                process.kill()
                ended.set()
                watcher.join()
        self.job.check()
        return process.returncode, output, errors


def _sample(
    source: FbxDocument, clip: int, parts: tuple[int, ...], times: FloatArray
) -> ScenePoses:
    """Return the poses of an animation at (N,) times; `parts` are the meshes that have faces."""
    answer = source.request(clip, times)
    weights = tuple(answer[f"{number} weights"] for number in parts)
    return ScenePoses(answer["transforms"], weights)


def _clips(source: FbxDocument, arrays: dict[str, Any], parts: tuple[int, ...]) -> list[Clip]:
    names = make_unique([name or "clip" for name in arrays["clips"].tolist()])
    clips = []
    for number, (name, (start, end)) in enumerate(zip(names, arrays["spans"], strict=True)):
        key_times = partial(_frame_times, name, float(start), float(end), float(arrays["fps"]))
        moved = frozenset(arrays[f"moved {number}"].tolist())
        clips.append(Clip(name, moved, key_times, partial(_sample, source, number, parts)))
    return clips


def _frame_times(name: str, start: float, end: float, said: float) -> FloatArray:
    """Return the times of a clip's frames, the last at its end if that is a frame.

    Files store 29.97 for 30/1.001 frames per second: the rate that better fits the clip's length is
    used. The rounded rate would drift away from the frames of a long clip.

    Raises
    ------
    MeshFileError : there would be too many frames, or the times are not finite.
    """
    said = said if 0.0 < said < np.inf else _USUAL_RATE
    ntsc = round(1.001 * said) / 1.001
    rates = [ntsc, said] if ntsc and abs(said - ntsc) < _NTSC_ROUNDING * said else [said]
    if not (np.isfinite([start, end]).all() and 0.0 <= (end - start) * said < _MOST_FRAMES):
        what = f"its clip {name!r}, from {start:g} to {end:g} s at {said:g} frames a second,"
        raise MeshFileError(
            f"{what} must have 1 to {_MOST_FRAMES} frames", "export fewer frames of it"
        )
    steps = (end - start) * np.array(rates)
    off = np.abs(steps - np.rint(steps))
    best = int(np.argmin(off))
    if off[best] > _SAME_FRAME or steps[best] < 0.5:
        return start + np.arange(int(steps[best]) + 1) / rates[best]
    return np.linspace(start, end, round(steps[best]) + 1)


def _of_mesh(arrays: dict[str, Any], number: int) -> dict[str, Any]:
    """Return the arrays of one mesh, without their prefix."""
    prefix = f"{number} "
    return {name[len(prefix) :]: arrays[name] for name in arrays if name.startswith(prefix)}


def _part(
    arrays: dict[str, Any],
    number: int,
    node: int,
    transforms: FloatArray,
    looks: FbxLooks,
    notes: list[str],
) -> Part | None:
    """Return the part for a mesh shown by a node; None if it has no faces."""
    sizes, is_face = arrays["faces"][:, 1], arrays["faces"][:, 1] >= 3
    is_used = np.repeat(is_face, sizes)
    corners = arrays["corners"][is_used]
    points = arrays["points"]
    if not is_face.all():
        notes.append("edges and points without faces were left out")
    if not is_face.any():
        return None
    faces, cut_of, sentences = triangulate(Polygons(points, sizes[is_face], corners))
    notes += sentences
    material_of = arrays["material_of"]
    if not len(material_of):
        material_of = np.zeros(len(sizes), dtype=np.int64)
    bones, bind = arrays["bones"], arrays["bind"]
    bone_of, weights = _influences(arrays, len(points))
    if len(bones) > 1 and bone_of[weights > 0.0].all():
        # No vertex follows the node itself, so drop it.
        bones, bind, bone_of = bones[1:], bind[1:], np.maximum(bone_of - 1, 0)
    if int(arrays["skins"]) > 1:
        notes.append("of the several skins of a mesh only the first was read")
    if is_mirrored(transforms[bones] @ bind, bone_of, weights):
        faces = faces[:, [0, 2, 1]]
    material_of = material_of[is_face][cut_of]
    laid = MeshFaces(number, is_used, corners, sizes[is_face], faces, cut_of, material_of)
    return Part(
        str(arrays["name"]),
        tuple(arrays["materials"].tolist()),
        material_of,
        node,
        points,
        faces,
        bones,
        bind,
        bone_of,
        weights,
        is_skinned="shares" in arrays,
        morphs=_morphs(arrays, len(points)),
        sliders=_sliders(arrays),
        dual=arrays.get("dual"),
        look=partial(looks.appearance, laid),
        shaded_look=partial(looks.appearance, laid, shaded=True),
        cut_of=cut_of,
    )


def _influences(
    arrays: dict[str, Any], n_vertices: int
) -> tuple[npt.NDArray[np.int32], FloatArray]:
    """Return the bones and weights of each vertex; unweighted ones follow the node, bone 0."""
    if "shares" not in arrays:
        return np.zeros((n_vertices, 1), dtype=np.int32), np.ones((n_vertices, 1))
    vertices, movers, shares = arrays["moved"], arrays["movers"], arrays["shares"]
    used = (shares > 0.0) & np.isfinite(shares) & (vertices >= 0) & (vertices < n_vertices)
    vertices, movers, shares = vertices[used], movers[used], shares[used]
    order = np.argsort(vertices, kind="stable")
    vertices, movers, shares = vertices[order], movers[order], shares[order]
    counts = np.bincount(vertices, minlength=n_vertices)
    width = max(int(counts.max(initial=0)), 1)
    if n_vertices * width > MAX_NUMBERS:
        raise MeshFileError(f"a vertex has {width} bone influences", "limit them to 8")
    column = np.arange(len(vertices)) - np.repeat(np.cumsum(counts) - counts, counts)
    bone_of, weights = np.zeros((n_vertices, width), np.int32), np.zeros((n_vertices, width))
    bone_of[vertices, column], weights[vertices, column] = movers, shares
    weights[counts == 0, 0] = 1.0
    return bone_of, weights / weights.sum(axis=1, keepdims=True)


def _sliders(arrays: dict[str, Any]) -> dict[str, FloatArray]:
    """Return `Part.sliders`, one for each blend shape."""
    names = [name or f"shape {n}" for n, name in enumerate(arrays["shapes"].tolist(), 1)]
    return dict(zip(make_unique(names), np.eye(len(names)), strict=True))


def _morphs(arrays: dict[str, Any], n_vertices: int) -> npt.NDArray[np.float32]:
    n_shapes = len(arrays["weights"])
    morphs = np.zeros((n_shapes, n_vertices, 3), dtype=np.float32)
    for number in range(n_shapes):
        changed, offsets = arrays[f"changed {number}"], arrays[f"offsets {number}"]
        inside = (changed >= 0) & (changed < n_vertices)
        np.add.at(morphs[number], changed[inside], offsets[inside])
    return morphs
