"""How the meshes of an FBX file look: diffuse colours and textures, and colours of corners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.json_values import quoted
from lcollision_core.meshes.appearance import Appearance, Material, Texture, Wrap
from lcollision_core.meshes.formats.images import ImageReader
from lcollision_core.meshes.formats.polygons import MAX_FILE_BYTES
from lcollision_core.regular_files import read_regular

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Laid:
    """The faces that a look is laid on.

    Attributes
    ----------
    number : of the mesh among those that are shown
    is_used : (C,) bool array, which of the mesh's corners are of polygons
    corners : (c,) int64 array, the vertices of those that are, polygon by polygon
    sizes : corners of each polygon
    faces : (F, 3) int64 array, triangles of vertices
    polygon_of, material_of : (F,) int64 arrays, of each triangle
    """

    number: int
    is_used: npt.NDArray[np.bool_]
    corners: IntArray
    sizes: IntArray
    faces: IntArray
    polygon_of: IntArray
    material_of: IntArray

    def faces_of_corners(self) -> IntArray:
        """Return the (F, 3) triangles as indices into `corners`."""
        n = int(self.corners.max()) + 1
        keys = np.repeat(np.arange(len(self.sizes)), self.sizes) * n + self.corners
        order = np.argsort(keys, kind="stable")
        wanted = self.polygon_of[:, None] * n + self.faces
        return order[np.searchsorted(keys, wanted, sorter=order)]


class FbxLooks:
    """Reads how the meshes of one file look.

    What is missing or damaged is left out, and noted.

    Parameters
    ----------
    ask : returns the arrays of `fbx_worker`
    path : of the file; textures may lie beside it
    """

    def __init__(self, ask: Callable[[], dict[str, Any]], path: Path) -> None:
        self._ask, self._path = ask, path

    @cached_property
    def _found(self) -> dict[str, Any]:
        return self._ask()

    @cached_property
    def _materials(self) -> tuple[list[Material], list[str]]:
        """The materials of the file, and notes."""
        images, notes = ImageReader(), list[str]()
        textures: list[Texture | None] = []
        for number, name in enumerate(self._found["textures"].tolist()):
            wraps = [
                Wrap.CLAMP if clamps else Wrap.REPEAT for clamps in self._found["clamps"][number]
            ]
            try:
                data = self._found[f"content {number}"].tobytes() or self._beside(name)
                # FBX counts v from below.
                pixels = images.read(data, f"the texture {quoted(name)}")
                textures.append(Texture(pixels, (wraps[0], wraps[1]), file=data))
            except MeshFileError as error:
                textures.append(None)
                notes.append(error.headline)
        own = [None if number < 0 else textures[number] for number in self._found["texture_of"]]
        return [Material(texture) for texture in [*own, None]], notes

    def _beside(self, name: str) -> bytes:
        """Read a file that programs look for by its name, wherever the artist had it."""
        file = name.replace("\\", "/").rpartition("/")[2]
        folder = self._path.parent
        for held in (folder, folder / f"{self._path.stem}.fbm", folder / "textures"):
            if file and (held / file).is_file():
                try:
                    return read_regular(held / file, MAX_FILE_BYTES)
                except (OSError, ValueError) as error:
                    raise MeshFileError.unreadable(f"the texture {quoted(name)}", error) from error
        raise MeshFileError("is not beside the file", where=f"the texture {quoted(name)}")

    def appearance(self, laid: Laid, *, shaded: bool = False) -> Appearance:
        """Read how a mesh looks, with its normals if it is `shaded`; those split points too."""
        found, (materials, notes) = self._found, self._materials
        faces = laid.faces_of_corners()
        prefix, n = f"{laid.number} ", len(laid.corners)
        uv = np.zeros((n, 2))
        if prefix + "uv" in found:
            uv = found[prefix + "uv"][laid.is_used] * [1.0, -1.0] + [0.0, 1.0]
        colours = np.ones((n, 4))
        if prefix + "colours" in found:
            colours = found[prefix + "colours"][laid.is_used]
        # The last is for faces without one.
        numbers = np.append(found[prefix + "materials"], len(materials) - 1)
        chosen = np.where(laid.material_of < len(numbers) - 1, laid.material_of, -1)
        material_of = numbers[chosen]
        # All triangles of a polygon have its material.
        of_corner = np.zeros(n, dtype=np.int64)
        of_corner[faces] = material_of[:, None]
        # A texture takes the place of its material's colour.
        base = np.concatenate([found["colours"], np.ones((1, 3))])
        base[[material.texture is not None for material in materials]] = 1.0
        colours[:, :3] = colours[:, :3] * base[of_corner]
        finite = np.isfinite(uv).all() and np.isfinite(colours).all()
        uv, colours = (uv, colours) if finite else (np.zeros_like(uv), np.ones_like(colours))
        painted = np.rint(255.0 * np.clip(colours, 0.0, 1.0))
        normals = np.zeros((n, 0))
        if shaded and prefix + "normals" in found:
            normals = found[prefix + "normals"][laid.is_used]
            normals = normals if np.isfinite(normals).all() else np.zeros((n, 0))
        # What corners have in common is drawn once.
        alike = np.column_stack([laid.corners, uv, painted, normals])
        _, kept, point_of = np.unique(alike, axis=0, return_index=True, return_inverse=True)
        return Appearance(
            laid.corners[kept],
            point_of.reshape(-1)[faces],
            uv[kept].astype(np.float32),
            painted[kept].astype(np.uint8),
            material_of,
            tuple(materials),
            tuple(notes),
            normals[kept].astype(np.float32) if normals.size else None,
        )
