"""Read and write mesh files (OBJ, PLY, OFF, STL and scenes) in vertex order; find defects."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError, ShapeError
from lcollision_core.files.formats import (
    FILES,
    READABLE_SUFFIXES,
    SCENE_SUFFIXES,
    WRITABLE_SUFFIXES,
    function_of,
)
from lcollision_core.files.mesh.obj import ObjDetail
from lcollision_core.files.mesh.obj import encode as encode_obj
from lcollision_core.files.mesh.polygons import (
    Polygons,
    first_at_each_position,
    require_plausible_count,
    triangulate,
    with_order_of,
)
from lcollision_core.files.safe import write_bytes
from lcollision_core.files.scene.joined import join_parts
from lcollision_core.files.scene.scene import Scene
from lcollision_core.files.scene_files import as_file_error, document_of, opened, scene_of
from lcollision_core.meshes.precision import (
    LARGEST_RATIO,
    first_not_finite,
    rounding_step,
)
from lcollision_core.meshes.topology import FloatArray, Topology, degenerate_faces
from lcollision_core.sentences import say, say_number

SINGLE_PRECISION = tuple(suffix for suffix, kind in FILES.items() if kind.is_single)
"""Formats that hold only float32; the others hold either precision."""


def as_stored(
    path: str | os.PathLike[str], vertices: npt.NDArray[Any], topology: Topology
) -> npt.NDArray[Any]:
    """Round vertices to the precision of a mesh file.

    Parameters
    ----------
    path : its extension determines the format
    vertices : (V, 3) finite array
    topology : topology of the mesh

    Returns
    -------
    stored : (V, 3) float32 array for formats of single precision, else of the type of `vertices`

    Raises
    ------
    MeshFileError : the rounding steps exceed `LARGEST_RATIO` of a short edge, or a coordinate
        exceeds the format.
    """
    suffix = Path(path).suffix.lower()
    dtype = np.float32 if suffix in SINGLE_PRECISION else np.float64
    if float(np.abs(vertices).max()) > float(np.finfo(dtype).max):
        raise MeshFileError.unwritable(
            path, f"a coordinate exceeds float32, which {suffix} stores", "write .ply or .obj"
        )
    stored = np.asarray(vertices, dtype) if dtype is np.float32 else np.asarray(vertices)
    # float32 vertices in a float32 format are not rounded again.
    if stored.dtype != vertices.dtype or stored.dtype == np.float64:
        step, ratio = rounding_step(vertices, topology, dtype)
        if ratio > LARGEST_RATIO:
            advice = "write .obj, .ply or .off, or move" if dtype is np.float32 else "move"
            raise MeshFileError.unwritable(
                path,
                f"so far from the origin {suffix} rounds coordinates to "
                f"steps of {step:.2g}, {ratio:.0%} of a short edge",
                f"{advice} the mesh nearer to the origin",
            )
    return stored


_REORDERED = "vertices that had been split were put back into the set's vertex order"

KEEP_PRECISION = "export it nearer to the origin, or with double precision"
"""Advice for a mesh that `coarseness_of` reports."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """One triangle mesh as stored in its file.

    Attributes
    ----------
    vertices : (V, 3) float64 array, read-only, in the file's order and unit
    topology : its faces
    source : its file
    notes : sentences on changes made on reading, such as the triangulation of quads
    coarseness : the loss, as a sentence, if single precision is too coarse so far from the origin;
        else None
    """

    vertices: npt.NDArray[np.float64]
    topology: Topology
    source: Path
    notes: tuple[str, ...] = ()
    coarseness: str | None = None

    @property
    def faces(self) -> npt.NDArray[np.int32]:
        """(F, 3) int32 array, vertex indices from 0, read-only."""
        return self.topology.faces


def read_mesh(path: str | os.PathLike[str], *, topology: Topology | None = None) -> Mesh:
    """Read one triangle mesh; the extension, in any case, determines the format.

    No vertex is merged, moved, reordered or dropped, with two exceptions. STL stores no shared
    vertices: corners at equal coordinates become one vertex, numbered by first appearance. A scene
    of several meshes, or of one that joints or morph targets move, is read in its rest pose and
    joined at its seams. Polygons are triangulated (see `triangulate`), with a note in
    `Mesh.notes`.

    Parameters
    ----------
    path : an .obj, .ply, .off, .stl, .glb, .gltf, .vrm or .fbx file
    topology : the expected connectivity, such as that of its set or model. Polygons are
        triangulated as in it. The triangles of an STL file, or of a glTF file with other vertices,
        are put into its vertex order if they match. A mesh with the same faces shares the object.

    Returns
    -------
    the mesh

    Raises
    ------
    MeshFileError : the file is missing, empty, truncated, damaged or not a mesh, holds more than
        `MAX_FACES` faces or vertices, a coordinate is not finite, or a face uses a vertex that
        does not exist. The message names the file and the element.
    """
    source = Path(path)
    with as_file_error(path):
        polygons = _read_polygons(source, topology)
        vertices = np.ascontiguousarray(polygons.vertices)
        faces, _, notes = triangulate(polygons, topology)
        _require_usable(vertices, faces)
        own_topology = Topology(faces, len(vertices))
    vertices.flags.writeable = False
    own_topology = topology if own_topology == topology else _shared(own_topology)
    coarseness = coarseness_of(vertices, own_topology) if polygons.is_single else None
    notes = polygons.notes + notes
    if coarseness:
        notes += (f"{coarseness}; {KEEP_PRECISION}",)
    return Mesh(vertices, own_topology, source, notes, coarseness)


@lru_cache(maxsize=1)
def _shared(topology: Topology) -> Topology:
    """Return the last topology that was read if it is equal, with what was derived from it."""
    return topology


def coarseness_of(vertices: npt.NDArray[Any], topology: Topology) -> str | None:
    """Describe the precision that a mesh lost by being stored in float32; None if it is enough."""
    step, ratio = rounding_step(vertices, topology, np.float32)
    if ratio <= LARGEST_RATIO:
        return None
    return (
        f"so far from the origin its coordinates are stored in steps of {step:.2g}, {ratio:.0%} of "
        f"a short edge"
    )


def _read_polygons(path: Path, topology: Topology | None) -> Polygons:
    suffix = path.suffix.lower()
    with opened(path, READABLE_SUFFIXES, "mesh format") as file:
        if suffix in SCENE_SUFFIXES:
            return _rest_pose(scene_of(document_of(file, path)), topology)
        polygons: Polygons = function_of(FILES[suffix].reader)(file, topology)
        return polygons


def _rest_pose(scene: Scene, topology: Topology | None) -> Polygons:
    """Return the rest pose of a scene, in the vertex order of `topology` if that matches."""
    part = scene.parts[0]
    is_plain = len(scene.parts) == len(part.bones) == 1 and not part.is_skinned
    is_plain = is_plain and not part.morphs.size
    notes: tuple[str, ...] = ()
    # A node may move float32 vertices far away; the float64 product keeps their precision.
    is_single = False
    if is_plain:
        vertices, faces, notes = part.points, part.faces, scene.notes
        cut_of = part.cut_of
        transform = scene.rest.transforms[0, part.node] @ part.bind[0]
        is_single = part.is_single and np.array_equal(transform, np.eye(4))
        if not is_single:
            # Coordinates that are not finite are refused later.
            with np.errstate(all="ignore"):
                vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
    else:
        mesh = join_parts(scene)
        vertices, faces = mesh.posed(scene.rest)[0], mesh.topology.faces.astype(np.int64)
        notes, cut_of = mesh.notes, mesh.cut_of
    if topology is not None and len(vertices) != topology.n_vertices:
        reordered = with_order_of(vertices[faces.reshape(-1)], topology, _REORDERED, is_single)
        if reordered is not None:
            return reordered
    return Polygons.triangles(vertices, faces, notes, is_single, cut_of)


def _require_usable(vertices: npt.NDArray[np.float64], faces: npt.NDArray[np.int64]) -> None:
    if len(vertices) == 0:
        raise MeshFileError("it contains no vertices")
    require_plausible_count(len(faces), "faces")
    require_plausible_count(len(vertices), "vertices")
    vertex = first_not_finite(vertices)
    if vertex is not None:
        raise MeshFileError(
            f"vertex {vertex} (from 0) is at {vertices[vertex].tolist()}, which is not finite"
        )
    if len(faces) == 0:
        raise MeshFileError("it contains vertices but no faces", "export it as a triangle mesh")


def write_mesh(
    path: str | os.PathLike[str],
    vertices: npt.NDArray[Any],
    faces: npt.NDArray[Any],
    *,
    up: FloatArray | None = None,
    detail: ObjDetail | None = None,
) -> None:
    """Write one triangle mesh atomically; the extension, in any case, determines the format.

    OBJ and OFF are written with the shortest decimals that read back as the same numbers, PLY in
    binary with the precision of `vertices`; STL and GLB only store float32.

    Parameters
    ----------
    path : an .obj, .ply, .off, .stl or .glb file in an existing folder
    vertices : (V, 3) array; float32 is written as such, anything else as float64
    faces : (F, 3) integer array, indices from 0
    up : (3,) up direction, if known: for a format with a fixed up axis, such as glTF, the mesh is
        turned by right angles so that the axis nearest to it becomes that one
    detail : further content of an OBJ file; other formats ignore it

    Raises
    ------
    ShapeError : an array has the wrong shape, or a vertex is not finite.
    PoseSetError : a face uses a vertex that does not exist.
    MeshFileError : the extension is unknown, the file cannot be written, or the mesh is too far
        from the origin for the format: see `as_stored`.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITABLE_SUFFIXES:
        raise MeshFileError.unwritable(
            path,
            f"{suffix or 'a name without extension'} is not a known mesh format",
            f"use one of {', '.join(WRITABLE_SUFFIXES)}",
        )
    points = np.asarray(vertices)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ShapeError.must_be("vertices", "a (V, 3) array with V > 0", points.shape)
    if points.dtype != np.float32:
        points = points.astype(np.float64)
    points = points.astype(points.dtype.newbyteorder("="), copy=False)
    vertex = first_not_finite(points)
    if vertex is not None:
        raise ShapeError(
            f"is at {points[vertex].tolist()}, which is not finite", where=f"vertex {vertex}"
        )
    topology = Topology(faces, len(points))
    points = as_stored(path, points, topology)
    if suffix == ".glb" and up is not None:
        points = points @ turn_to_y(up).astype(points.dtype).T
    if suffix == ".obj":
        data = encode_obj(points, topology.faces, detail)
    else:
        data = function_of(FILES[suffix].writer)(points, topology.faces)
    write_bytes(path, data)


def turn_to_y(up: FloatArray) -> FloatArray:
    """Return the rotation by right angles that takes the axis nearest to a direction to +y."""
    axis = int(np.abs(up).argmax())
    towards = np.eye(3)[axis] * np.sign(up[axis])
    y = np.array([0.0, 1.0, 0.0])
    if axis == 1:
        # If upside down, turn about x.
        return np.eye(3) if up[1] > 0.0 else np.diag([1.0, -1.0, -1.0])
    aside = np.cross(towards, y)
    turn: FloatArray = np.outer(y, towards) - np.outer(towards, y) + np.outer(aside, aside)
    return turn


def audit_mesh(topology: Topology, vertices: npt.NDArray[Any]) -> tuple[str, ...]:
    """Find the defects that make a collision check, or a deformation, unreliable.

    Parameters
    ----------
    topology : the faces
    vertices : (V, 3) array, one pose

    Returns
    -------
    problems : a sentence for each kind of defect; having several components is no defect

    Raises
    ------
    ShapeError : `vertices` does not fit `topology`.
    """
    points = np.asarray(vertices)
    if points.shape != (topology.n_vertices, 3):
        raise ShapeError.must_be("vertices", f"({topology.n_vertices}, 3)", points.shape)
    first = first_at_each_position(points)
    duplicates = np.flatnonzero(first != np.arange(len(first)))
    open_edges, crowded_edges = topology.boundary_edges, topology.non_manifold_edges
    pinched, unused = topology.pinched_vertices, topology.unused_vertices
    flat = degenerate_faces(topology, points)
    start, end = crowded_edges[0] if len(crowded_edges) else (0, 0)
    defects = (
        (
            open_edges,
            say_number(
                len(open_edges),
                "the mesh is open: {n} edge has one face",
                "the mesh is open: {n} edges have one face",
            ),
        ),
        (
            crowded_edges,
            say_number(
                len(crowded_edges),
                "the mesh is not manifold: {n} edge has more than two faces, the first between "
                "vertices {start} and {end}",
                "the mesh is not manifold: {n} edges have more than two faces, the first between "
                "vertices {start} and {end}",
                start=start,
                end=end,
            ),
        ),
        (
            pinched,
            say_number(
                len(pinched),
                "the mesh is not manifold: {n} vertex joins parts of the surface that share no "
                "edge there, the first is vertex {first}",
                "the mesh is not manifold: {n} vertices join parts of the surface that share no "
                "edge there, the first is vertex {first}",
                first=next(iter(pinched), 0),
            ),
        ),
        (
            unused,
            say_number(
                len(unused),
                "{n} vertex is in no face, the first is vertex {first}",
                "{n} vertices are in no face, the first is vertex {first}",
                first=next(iter(unused), 0),
            ),
        ),
        (
            flat,
            say_number(
                len(flat),
                "{n} face has no area, the first is face {first}",
                "{n} faces have no area, the first is face {first}",
                first=next(iter(flat), 0),
            ),
        ),
        (
            duplicates,
            say_number(
                len(duplicates),
                "{n} vertex lies exactly on an earlier vertex, the first is vertex {first}",
                "{n} vertices lie exactly on an earlier vertex, the first is vertex {first}",
                first=next(iter(duplicates), 0),
            ),
        ),
    )
    problems = [sentence for defect, sentence in defects if len(defect)]
    if not (topology.is_watertight or len(open_edges) or len(crowded_edges)):
        problems.append(say("the mesh has neighbouring faces that are wound in opposite senses"))
    return tuple(problems)
