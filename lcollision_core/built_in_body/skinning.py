"""Dual quaternion skinning with a correction that keeps folds from running into each other."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.spatial.transform import Rotation

from lcollision_core.built_in_body.template import Template, neighbour_average
from lcollision_core.meshes.normals import vertex_normals

FloatArray = npt.NDArray[np.float64]

SMOOTHING_LENGTH = 0.025
"""Metres over which the correction evens the skin; longer ones press the groin into the belly."""


class Skin:
    """The skin of a template, posed by its bones.

    Dual quaternion blending (Kavan et al. 2007), which keeps the volume of a bent or twisted
    limb, then delta mush (Mancewicz et al. 2014): the posed skin is smoothed, and what the
    same smoothing takes away at rest is added back in local frames.

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
        rotations, positions : (J, 3, 3) and (J, 3), as `Skeleton.pose` returns them

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
        """(V, 3, 3) orthonormal frames whose columns turn with the skin."""
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
    """Products of quaternions (…, 4) in the order x, y, z, w."""
    vector = p[:, 3:] * q[:, :3] + q[:, 3:] * p[:, :3] + np.cross(p[:, :3], q[:, :3])
    scalar = p[:, 3] * q[:, 3] - np.einsum("ij,ij->i", p[:, :3], q[:, :3])
    return np.column_stack([vector, scalar])
