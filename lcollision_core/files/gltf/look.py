"""Appearance of the primitives of a glTF file: base colours, textures and vertex colours."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.files.gltf.schema import (
    GltfDocument,
    as_float,
    numbers,
    require_element,
    require_finite,
    require_int,
)
from lcollision_core.files.scene.appearance import (
    Appearance,
    ImageReader,
    Material,
    Texture,
    Wrap,
    screen_colours,
)
from lcollision_core.json_values import quoted
from lcollision_core.meshes.topology import FloatArray

_NEAREST, _LINEAR = 9728, 9729
_WRAPS = {10497: Wrap.REPEAT, 33648: Wrap.MIRROR, 33071: Wrap.CLAMP}
_MOST_UV_SETS = 16
_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"


@dataclass(frozen=True, eq=False)
class _Finish:
    """A material of a file, and its values that are stored in the points of a primitive.

    Attributes
    ----------
    material : the material without its colour
    colour : (4,) array, linear
    uv_set : number of its set of texture coordinates
    turned, offset : (2, 2) and (2,) arrays of the transform `turned @ uv + offset`
    notes : sentences on what could not be read
    """

    material: Material
    colour: FloatArray
    uv_set: int
    turned: FloatArray
    offset: FloatArray
    notes: tuple[str, ...] = ()


_NO_FINISH = _Finish(Material(is_double_sided=False), np.ones(4), 0, np.eye(2), np.zeros(2))


@dataclass(eq=False)
class GltfLooks:
    """Reads the appearance of a file's primitives, each image and material once.

    Damaged values are left out with a note.

    Attributes
    ----------
    document : the file
    """

    document: GltfDocument
    _images: ImageReader = field(default_factory=ImageReader)
    _pixels: dict[int, npt.NDArray[np.uint8]] = field(default_factory=dict)
    _textures: dict[int, Texture] = field(default_factory=dict)
    _finishes: dict[int, _Finish] = field(default_factory=dict)

    def appearance(
        self,
        primitive: dict[str, Any],
        faces: npt.NDArray[np.int64],
        n: int,
        n_copies: int,
        where: str,
    ) -> Appearance:
        """Read the appearance of a primitive.

        Parameters
        ----------
        primitive : its description, whose material index has been checked
        faces : (F, 3) array, the triangles of all its copies
        n : number of its vertices, each of which is a point
        n_copies : number of copies shown
        where : name in notes, such as "mesh 3"
        """
        finish = _NO_FINISH
        if "material" in primitive:
            number = primitive["material"]
            if number not in self._finishes:
                self._finishes[number] = self._finish(number)
            finish = self._finishes[number]
        attributes = primitive["attributes"]
        notes, material = list(finish.notes), finish.material
        colours, uv = np.tile(finish.colour, (n, 1)), np.zeros((n, 2))
        with _noted(notes, f"{where} is shown without its colours"):
            if "COLOR_0" in attributes:
                colours *= self._vertex_colours(attributes["COLOR_0"], where, n)
        with _noted(notes, f"{where} is shown without its texture"):
            if material.texture is not None:
                # Keep only the colour unless the coordinates can be read.
                material = replace(material, texture=None)
                what = f"the texture coordinates of {where}"
                given = attributes.get(f"TEXCOORD_{finish.uv_set}")
                stored = as_float(self.document.array(given, what, ("VEC2",), n))
                require_finite(stored, what)
                uv, material = stored @ finish.turned.T + finish.offset, finish.material
            elif "TEXCOORD_0" in attributes:
                # Nothing uses them on screen, but exports keep them.
                what = f"the texture coordinates of {where}"
                given = attributes["TEXCOORD_0"]
                stored = as_float(self.document.array(given, what, ("VEC2",), n))
                uv = stored if np.isfinite(stored).all() else uv
        return Appearance(
            np.arange(n_copies * n),
            faces,
            np.tile(uv.astype(np.float32), (n_copies, 1)),
            np.tile(screen_colours(colours), (n_copies, 1)),
            np.zeros(len(faces), dtype=np.int64),
            (material,),
            tuple(notes),
        )

    def _vertex_colours(self, accessor: object, where: str, n: int) -> FloatArray:
        what = f"the colours of {where}"
        stored = self.document.array(accessor, what, ("VEC3", "VEC4"), n)
        # Some programs do not mark their integers as normalised.
        most = np.iinfo(stored.dtype).max if stored.dtype.kind == "u" else 1.0
        colours = np.ones((n, 4))
        colours[:, : stored.shape[1]] = np.clip(as_float(stored) / most, 0.0, 1.0)
        require_finite(colours, what)
        return colours

    def _finish(self, number: int) -> _Finish:
        described = self.document.objects("materials")[number]
        name = quoted(described.get("name") or number)
        finish, notes = _NO_FINISH, list[str]()
        # Keep the colour even if the texture is damaged.
        with _noted(notes, f"the material {name} is not shown as it is"):
            mode, extensions = described.get("alphaMode"), _inner(described, "extensions")
            cutoff = described.get("alphaCutoff", 0.5) if mode == "MASK" else 0.0
            material = Material(
                cutoff=float(numbers([cutoff], "its alpha cutoff", 1)[0]),
                is_blended=mode == "BLEND",
                is_double_sided=described.get("doubleSided") is True,
                is_lit="KHR_materials_unlit" not in extensions,
            )
            base, kind = _inner(described, "pbrMetallicRoughness"), "baseColor"
            if not base:
                base, kind = _inner(extensions, _GLOSSINESS), "diffuse"
            colour = numbers(base.get(f"{kind}Factor", [1.0] * 4), "its colour", 4)
            finish = replace(finish, material=material, colour=np.clip(colour, 0.0, 1.0))
            laid = _inner(base, f"{kind}Texture")
            if laid:
                finish = self._textured(finish, laid)
        return replace(finish, notes=tuple(notes))

    def _textured(self, finish: _Finish, laid: dict[str, Any]) -> _Finish:
        """Add the texture that a material refers to."""
        moved = _inner(_inner(laid, "extensions"), "KHR_texture_transform")
        uv_set = moved.get("texCoord", laid.get("texCoord", 0))
        angle = float(numbers([moved.get("rotation", 0.0)], "its texture's rotation", 1)[0])
        scale = numbers(moved.get("scale", [1.0, 1.0]), "its texture's scale", 2)
        cosine, sine = np.cos(angle), np.sin(angle)
        return replace(
            finish,
            material=replace(finish.material, texture=self._texture(laid.get("index"))),
            uv_set=require_int(uv_set, "its set of texture coordinates", 0, _MOST_UV_SETS),
            # Counter-clockwise, as v points down.
            turned=np.array([[cosine, sine], [-sine, cosine]]) * scale,
            offset=numbers(moved.get("offset", [0.0, 0.0]), "its texture's offset", 2),
        )

    def _texture(self, index: Any) -> Texture:
        document = self.document
        texture = require_element(document.objects("textures"), index, "a texture")
        if index in self._textures:
            return self._textures[index]
        source: Any = texture.get("source")
        others = _inner(texture, "extensions")
        if source is None:
            # The image may be in a format that an extension adds.
            source = next((_inner(others, name).get("source") for name in others), None)
        image = require_element(document.objects("images"), source, "an image")
        if source not in self._pixels:
            what = f"image {source}"
            self._pixels[source] = self._images.read(document.image(image, what), what)
        sampler: dict[str, Any] = {}
        if "sampler" in texture:
            sampler = require_element(document.objects("samplers"), texture["sampler"], "a sampler")
        u, v = (_WRAPS.get(_code(sampler, key), Wrap.REPEAT) for key in ("wrapS", "wrapT"))
        self._textures[index] = Texture(
            self._pixels[source],
            (u, v),
            is_smooth=_code(sampler, "magFilter") != _NEAREST,
            has_mipmaps=_code(sampler, "minFilter") not in (_NEAREST, _LINEAR),
        )
        return self._textures[index]


def _code(sampler: dict[str, Any], key: str) -> int:
    code = sampler.get(key)
    return code if isinstance(code, int) else 0


def _inner(described: dict[str, Any], key: str) -> dict[str, Any]:
    """Return an object in another one; empty if there is none."""
    value = described.get(key, {})
    if not isinstance(value, dict):
        raise MeshFileError.must_be(f"its {key}", "an object", quoted(value))
    return value


@contextmanager
def _noted(notes: list[str], what: str) -> Iterator[None]:
    """Add a note instead of raising a `MeshFileError`."""
    try:
        yield
    except MeshFileError as error:
        notes.append(f"{what}: {error.headline}")
