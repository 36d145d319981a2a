"""What a character's file holds, from reading it to writing it with poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.meshes.appearance import Appearance
from lcollision_core.meshes.formats.gltf_document import GltfDocument, as_float
from lcollision_core.meshes.formats.gltf_nodes import PARTS, local_transform
from lcollision_core.meshes.formats.scene import Part, Primitive, Scene
from lcollision_core.meshes.formats.transforms import decompose, is_regular
from lcollision_core.meshes.joined import JoinedMesh, look_of
from lcollision_core.meshes.normals import moved_normals, unit
from lcollision_core.meshes.topology import FloatArray

IDENTITY = np.eye(4)


@dataclass(frozen=True, eq=False)
class CharacterFile:
    """The content of a character's file, read once.

    What writing needs beyond it is made when it is asked for, of a .glb, .gltf or .vrm file alone;
    it raises `MeshFileError` where the file is damaged.

    Attributes
    ----------
    scene : without scenery
    mesh : of its parts
    """

    scene: Scene
    mesh: JoinedMesh

    @cached_property
    def appearance(self) -> Appearance | None:
        """How it looks; None where the file does not say that."""
        return look_of(self.scene, self.mesh)

    @cached_property
    def rest(self) -> FloatArray:
        """(V, 3) float64 array, the rest pose."""
        vertices: FloatArray = self.mesh.posed(self.scene.rest)[0]
        return vertices

    @property
    def document(self) -> GltfDocument:
        """The file itself."""
        if self.scene.document is None:
            raise MeshFileError("is no glTF file", where="it")
        return self.scene.document

    @cached_property
    def editable(self) -> GltfDocument:
        """The file to be written, in the rest pose of the scene; copies of it are changed."""
        found = self.document.editable()
        rest = self.scene.rest.transforms[0]
        for number in self.scene.revealed:
            parent = int(self.scene.parents[number])
            above = rest[parent] if parent >= 0 else IDENTITY
            if is_regular(above):
                node = found.description["nodes"][number]
                node.pop("matrix", None)
                held = decompose(np.linalg.solve(above, rest[number]))
                node |= {name: part.tolist() for name, part in zip(PARTS, held, strict=True)}
        return found

    @cached_property
    def locals(self) -> list[FloatArray]:
        """The (4, 4) local transform of each node."""
        return [local_transform(node) for node in self.editable.objects("nodes")]

    @cached_property
    def parts(self) -> list[tuple[Part, Primitive, slice]]:
        """Each part, what it is in the file, and its rows of the file's vertices."""
        found, start = [], 0
        for part in self.scene.parts:
            if part.primitive is not None:
                found.append((part, part.primitive, slice(start, start + len(part.points))))
            start += len(part.points)
        return found

    @cached_property
    def stored_normals(self) -> list[FloatArray | None]:
        """The normals that the file stores for the vertices of each part, (n, 3)."""
        return list(self._stored_normals())

    def _stored_normals(self) -> Iterator[FloatArray | None]:
        for _, shown, _ in self.parts:
            mesh = self.document.objects("meshes")[shown.mesh]
            number = mesh["primitives"][shown.primitive]["attributes"].get("NORMAL")
            if number is None:
                yield None
                continue
            what = f"the normals of mesh {shown.mesh}"
            stored = self.document.array(number, what, ("VEC3",), shown.n_vertices)
            yield np.tile(as_float(stored), (shown.n_instances, 1))

    def normals(self, vertices: FloatArray) -> FloatArray:
        """Return the unit normals of the file's W vertices in a pose; 0 where it has none."""
        return moved_normals(*self._normals_at_rest, self.rest, vertices)

    @cached_property
    def _normals_at_rest(
        self,
    ) -> tuple[FloatArray, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        joined = self.mesh.joined
        rest = np.zeros((len(joined), 3))
        transforms = self.scene.rest.transforms[0]
        for (part, _, rows), stored in zip(self.parts, self.stored_normals, strict=True):
            if stored is not None:
                turns = np.linalg.pinv(blended(part, transforms)[:, :, :3])
                rest[rows] = unit(np.einsum("vij,vi->vj", turns, stored))
        # All triangles of the joined vertex, so that the copies at a seam move alike.
        faces = self.mesh.topology.faces.astype(np.int64)
        corners = np.concatenate([np.roll(faces, -side, axis=1) for side in range(3)])
        corners = corners[np.argsort(corners[:, 0], kind="stable")]
        first = np.searchsorted(corners[:, 0], np.arange(len(self.rest) + 1))
        counts = np.diff(first)[joined]
        owners = np.repeat(np.arange(len(counts)), counts)
        within = np.arange(len(owners)) - np.repeat(np.cumsum(counts) - counts, counts)
        return rest, owners, corners[np.repeat(first[joined], counts) + within]


def blended(part: Part, transforms: FloatArray) -> FloatArray:
    """Return the (n, 3, 4) affine map of each vertex of a part, for (nodes, 4, 4) transforms."""
    turns = (transforms[part.bones] @ part.bind)[:, :3]
    maps = np.zeros((len(part.points), 3, 4))
    for bone, weight in zip(part.bone_of.T, part.weights.T, strict=True):
        maps += weight[:, None, None] * turns[bone]
    return maps
