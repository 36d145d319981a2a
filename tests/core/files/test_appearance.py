"""The appearance of glTF files, read on request, however it is given."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from lcollision_core.files import read_character
from lcollision_core.files.scene.appearance import Appearance, Wrap
from tests.core.fbx_builder import arm_fbx
from tests.core.gltf_builder import GltfBuilder, tube
from tests.core.textured_cube import (
    BLUE,
    GREEN,
    RED,
    YELLOW,
    add_texture,
    coloured,
    cube,
    png,
    textured_cube,
)

FOUR = np.array([[RED, GREEN], [BLUE, YELLOW]], dtype=np.uint8)


def look_of(builder: GltfBuilder, folder: Path, name: str = "cube.glb") -> Appearance:
    look = read_character(builder.write(folder / name)).look()
    assert look is not None
    return look


def textured(base: dict[str, Any] | None = None, image: bytes | None = None) -> GltfBuilder:
    """Build a cube with a texture of four colours."""
    builder = GltfBuilder()
    texture = add_texture(builder, png(FOUR) if image is None else image)
    base = {"baseColorTexture": {"index": texture}} | (base or {})
    return textured_cube(coloured(**base), builder)


def test_a_look_is_on_points_of_the_joined_vertices(tmp_path: Path) -> None:
    file = textured().write(tmp_path / "cube.glb")
    character = read_character(file)
    look = character.look()
    assert look is not None
    vertices, faces, uv = cube()
    assert len(character.rest_vertices) == 8
    np.testing.assert_array_equal(character.rest_vertices[look.vertices], vertices)
    np.testing.assert_array_equal(look.faces, faces)
    np.testing.assert_array_equal(look.uv, uv)
    assert (look.colours == 255).all()
    assert not look.is_plain
    (material,) = look.materials
    assert material.texture is not None
    np.testing.assert_array_equal(material.texture.pixels[..., :3], FOUR)
    assert (material.texture.pixels[..., 3] == 255).all()
    assert look.notes == ()


def test_materials_are_those_that_trimesh_reads(tmp_path: Path) -> None:
    builder = GltfBuilder()
    material = {
        "alphaMode": "MASK",
        "alphaCutoff": 0.3,
        "doubleSided": True,
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": add_texture(builder, png(FOUR))},
            "baseColorFactor": [0.5, 0.25, 1.0, 0.75],
        },
    }
    look = look_of(textured_cube(material, builder), tmp_path)
    other = trimesh.load(tmp_path / "cube.glb", force="mesh", process=False)
    assert isinstance(other, trimesh.Trimesh)
    expected = other.visual.material
    (ours,) = look.materials
    assert ours.texture is not None
    assert (ours.cutoff, ours.is_double_sided) == (expected.alphaCutoff, expected.doubleSided)
    assert not ours.is_blended
    assert ours.is_lit
    np.testing.assert_array_equal(
        ours.texture.pixels[..., :3], np.asarray(expected.baseColorTexture.convert("RGB"))
    )
    # trimesh counts v from below.
    np.testing.assert_allclose(look.uv * [1, -1] + [0, 1], other.visual.uv, atol=1e-6)
    # Half the light in sRGB.
    np.testing.assert_array_equal(look.colours[0], [188, 137, 255, 191])


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP"])
@pytest.mark.parametrize("place", ["inside", "data", "beside"])
def test_images_are_found_where_files_have_them(tmp_path: Path, kind: str, place: str) -> None:
    pixels = np.kron(FOUR, np.ones((16, 16, 1), dtype=np.uint8))
    data = png(pixels, kind)
    builder = GltfBuilder()
    if place == "inside":
        texture = add_texture(builder, data)
    else:
        (tmp_path / "the skin.img").write_bytes(data)
        uri = "data:image/x;base64," + base64.b64encode(data).decode()
        image = builder.add("images", uri=uri if place == "data" else "the%20skin.img")
        texture = builder.add("textures", source=image)
    base = {"baseColorTexture": {"index": texture}}
    look = look_of(textured_cube(coloured(**base), builder), tmp_path, "cube.gltf")
    assert look.notes == ()
    held = look.materials[0].texture
    assert held is not None
    assert np.abs(held.pixels[8::16, 8::16, :3].astype(int) - FOUR).max() < 16


def test_coordinates_are_those_of_the_set_moved_by_the_material(tmp_path: Path) -> None:
    builder = GltfBuilder()
    texture = add_texture(builder, png(FOUR))
    own = np.random.default_rng(0).random((24, 2)).astype(np.float32)
    second = builder.array(own)
    moved = {"texCoord": 1, "offset": [0.1, 0.2], "rotation": 0.3, "scale": [2.0, 0.5]}
    laid = {"index": texture, "texCoord": 0, "extensions": {"KHR_texture_transform": moved}}
    material = coloured(baseColorTexture=laid)
    look = look_of(textured_cube(material, builder, TEXCOORD_1=second), tmp_path)
    # As in three.js: scaled, rotated counter-clockwise with v down, translated.
    u, v = 2.0 * own[:, 0], 0.5 * own[:, 1]
    cosine, sine = np.cos(0.3), np.sin(0.3)
    expected = np.stack([cosine * u + sine * v + 0.1, cosine * v - sine * u + 0.2], axis=1)
    np.testing.assert_allclose(look.uv, expected, atol=1e-6)


def test_samplers_say_how_images_go_on(tmp_path: Path) -> None:
    builder = GltfBuilder()
    sampler = {"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}
    texture = add_texture(builder, png(FOUR), sampler)
    material = coloured(baseColorTexture={"index": texture})
    held = look_of(textured_cube(material, builder), tmp_path).materials[0].texture
    assert held is not None
    assert held.wrap == (Wrap.CLAMP, Wrap.MIRROR)
    assert not held.is_smooth
    assert held.has_mipmaps


@pytest.mark.parametrize("dtype", ["f4", "u1", "u2"])
@pytest.mark.parametrize("width", [3, 4])
def test_colours_of_vertices_multiply_those_of_the_material(
    tmp_path: Path, dtype: str, width: int
) -> None:
    builder = GltfBuilder()
    rng = np.random.default_rng(1)
    most = 1.0 if dtype == "f4" else float(np.iinfo(dtype).max)
    stored = (rng.random((24, width)) * most).astype(dtype)
    accessor = builder.array(stored, dtype, normalized=dtype != "f4")
    material = coloured(baseColorFactor=[1.0, 0.5, 1.0, 1.0])
    look = look_of(textured_cube(material, builder, COLOR_0=accessor), tmp_path)
    linear = np.ones((24, 4))
    linear[:, :width] = stored / most
    linear[:, 1] *= 0.5
    shown = look.colours / 255.0
    light = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(light[:, :3], linear[:, :3], atol=0.006)
    np.testing.assert_allclose(shown[:, 3], linear[:, 3], atol=0.003)
    assert not look.is_plain


def test_older_materials_of_diffuse_colours_are_read(tmp_path: Path) -> None:
    builder = GltfBuilder()
    diffuse = {
        "diffuseFactor": [0.0, 1.0, 0.0, 1.0],
        "diffuseTexture": {"index": add_texture(builder, png(FOUR))},
    }
    material = {"extensions": {"KHR_materials_pbrSpecularGlossiness": diffuse}}
    look = look_of(textured_cube(material, builder), tmp_path)
    assert look.colours[0].tolist() == [0, 255, 0, 255]
    assert look.materials[0].texture is not None


@pytest.mark.parametrize("material", [None, {"name": "Skin"}])
def test_what_says_nothing_of_its_look_is_plain(
    tmp_path: Path, material: dict[str, Any] | None
) -> None:
    look = look_of(textured_cube(material), tmp_path)
    assert look.is_plain
    assert look.materials[0].texture is None
    assert not look.materials[0].is_double_sided


def test_images_of_any_depth_are_read(tmp_path: Path) -> None:
    grey = np.array([[0x1234, 0xFEDC]], dtype=np.uint16)
    out = textured(image=png_of_16_bits(grey))
    held = look_of(out, tmp_path).materials[0].texture
    assert held is not None
    np.testing.assert_array_equal(held.pixels[0, :, 0], [0x12, 0xFE])
    half = np.array([[[*RED, 128], [*BLUE, 0]]], dtype=np.uint8)
    held = look_of(textured(image=png(half)), tmp_path).materials[0].texture
    assert held is not None
    np.testing.assert_array_equal(held.pixels, half)


def png_of_16_bits(grey: np.ndarray) -> bytes:
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in grey)
    return png_header(grey.shape[1], grey.shape[0], 16) + chunk(b"IDAT", zlib.compress(rows))


def png_without_pixels(width: int, height: int) -> bytes:
    return png_header(width, height, 8) + chunk(b"IDAT", zlib.compress(b""))


def png_header(width: int, height: int, depth: int) -> bytes:
    described = struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", described)


def chunk(kind: bytes, data: bytes) -> bytes:
    checked = kind + data
    return struct.pack(">I", len(data)) + checked + struct.pack(">I", zlib.crc32(checked))


def test_a_large_image_is_shrunk_and_keeps_what_is_transparent(tmp_path: Path) -> None:
    pixels = np.zeros((3, 5000, 4), dtype=np.uint8)
    pixels[:, :2500] = (*RED, 0)
    pixels[:, 2500:] = (*BLUE, 255)
    held = look_of(textured(image=png(pixels)), tmp_path).materials[0].texture
    assert held is not None
    assert held.pixels.shape == (1, 2048, 4)
    np.testing.assert_array_equal(held.pixels[0, [10, -10]], [[*RED, 0], [*BLUE, 255]])


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (b"garbage", "image 0 is damaged or no PNG, JPEG, WEBP, BMP or TGA image"),
        (png(np.kron(FOUR, np.ones((64, 64, 1), np.uint8)))[:200], "image 0 is damaged"),
        (png_without_pixels(20_000, 20_000), "image 0 has more than 64 million pixels"),
        (png_without_pixels(9000, 9000), "image 0 has more than"),
        (png_without_pixels(8000, 8000), "image 0 is damaged"),
        (b"", "image 0 is damaged"),
    ],
    ids=["garbage", "truncated", "bomb", "large", "no pixels", "nothing"],
)
def test_a_damaged_image_leaves_the_colour_and_a_note(
    tmp_path: Path, image: bytes, said: str
) -> None:
    builder = textured({"baseColorFactor": [1.0, 0.0, 0.0, 1.0]}, image)
    file = builder.write(tmp_path / "cube.glb")
    # Code that does not need the appearance does not read it.
    assert read_character(file).notes == ("16 vertices were joined with others at seams",)
    look = look_of(builder, tmp_path)
    assert look.materials[0].texture is None
    assert look.colours[0].tolist() == [255, 0, 0, 255]
    (note,) = look.notes
    assert note.startswith("the material 'Skin' is not shown as it is: ")
    assert said in note


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"images": [{"uri": "gone.png"}]}, "image 0 'gone.png' cannot be read"),
        ({"images": [{"uri": "../secret.png"}]}, "it is not beside the file"),
        ({"images": [{"bufferView": 99}]}, "refers to the buffer view of image 0 99"),
        ({"images": [{}]}, "refers to the buffer view of image 0 None"),
        ({"textures": [{}]}, "refers to an image None"),
        ({"textures": [{"source": 7}]}, "refers to an image 7, but has only 1"),
        ({"textures": []}, "refers to a texture 0, but has only 0"),
    ],
)
def test_a_missing_image_leaves_the_colour_and_a_note(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    builder = textured({"baseColorFactor": [1.0, 0.0, 0.0, 1.0]})
    builder.description |= changes
    look = look_of(builder, tmp_path, "cube.gltf")
    assert look.materials[0].texture is None
    assert look.colours[0].tolist() == [255, 0, 0, 255]
    assert said in look.notes[0]


@pytest.mark.parametrize(
    "material",
    [
        {"pbrMetallicRoughness": 3},
        {"pbrMetallicRoughness": {"baseColorFactor": [1.0, 2.0]}},
        {"pbrMetallicRoughness": {"baseColorFactor": ["red"] * 4}},
        {"pbrMetallicRoughness": {"baseColorTexture": [0]}},
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": "a"}}},
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": {}}}},
        {"alphaMode": "MASK", "alphaCutoff": "half"},
        {"extensions": []},
    ],
)
def test_a_material_that_is_none_is_noted(tmp_path: Path, material: dict[str, Any]) -> None:
    builder = GltfBuilder()
    add_texture(builder, png(FOUR))
    look = look_of(textured_cube(material, builder), tmp_path)
    assert look.is_plain
    assert look.notes[0].startswith("the material 0 is not shown as it is: ")


def test_coordinates_and_colours_that_are_none_are_noted(tmp_path: Path) -> None:
    builder = GltfBuilder()
    texture = add_texture(builder, png(FOUR))
    short, wild = builder.array(np.ones((3, 3))), builder.array(np.full((24, 2), np.nan))
    material = coloured(baseColorTexture={"index": texture, "texCoord": 1})
    cubes = textured_cube(material, builder, COLOR_0=short, TEXCOORD_1=wild)
    look = look_of(cubes, tmp_path)
    assert look.is_plain
    assert look.notes == (
        "mesh 0 is shown without its colours: the colours of mesh 0 have 3 values, 24 are needed",
        "mesh 0 is shown without its texture: the texture coordinates of mesh 0 are not all finite",
    )
    missing = coloured(baseColorTexture={"index": 0, "texCoord": 2})
    builder.description["materials"] = [missing]
    assert "mesh 0 is shown without its texture" in look_of(cubes, tmp_path).notes[-1]


def test_materials_and_textures_are_read_once(tmp_path: Path) -> None:
    builder = textured()
    primitive = builder.description["meshes"][0]["primitives"][0]
    builder.description["materials"] *= 2
    builder.description["meshes"][0]["primitives"] = [primitive, primitive | {"material": 1}]
    first, second = look_of(builder, tmp_path).materials
    assert first.texture is second.texture is not None
    builder.description["meshes"][0]["primitives"] = [primitive] * 2
    look = look_of(builder, tmp_path)
    assert len(look.materials) == 1
    assert len(look.vertices) == 48
    assert look.faces.max() == 47


def test_each_copy_of_an_instanced_mesh_has_its_look(tmp_path: Path) -> None:
    builder = textured()
    node = builder.description["nodes"][2]
    del node["skin"]
    places = builder.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    node["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}}
    builder.description["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    look = look_of(builder, tmp_path)
    _, faces, uv = cube()
    np.testing.assert_array_equal(look.faces, np.concatenate([faces, faces + 24]))
    np.testing.assert_array_equal(look.uv, np.tile(uv, (2, 1)))


def painted_fbx(folder: Path, texture: str | None = None) -> Path:
    """Write a tube with a red material, and separate texture coordinates at each corner."""
    file = arm_fbx(folder / "arm.fbx")
    text = file.read_text()
    _, faces = tube()
    uv = np.arange(2 * faces.size) / 1000.0
    layer = f"""
        LayerElementUV: 0 {{
            Version: 101
            Name: "map1"
            MappingInformationType: "ByPolygonVertex"
            ReferenceInformationType: "Direct"
            UV: *{len(uv)} {{ a: {",".join(map(str, uv))} }}
        }}
        Layer: 0 {{
            LayerElement: {{ Type: "LayerElementUV"
            TypedIndex: 0 }}"""
    text = text.replace("\n        Layer: 0 {", layer)
    diffuse = 'P: "DiffuseColor", "Color", "", "A",1,0,0'
    painted = f'"Material::Skin", "" {{ Properties70: {{ {diffuse}\n }} }}'
    if texture is not None:
        painted += f"""
    Texture: 310, "Texture::skin", "" {{
        Type: "TextureVideoClip"
        RelativeFilename: "{texture}"
    }}"""
        text = text.replace(
            "Connections:  {", 'Connections:  {\n    C: "OP",310,300, "DiffuseColor"'
        )
    file.write_text(text.replace('"Material::Skin", "" { }', painted))
    return file


def test_fbx_has_diffuse_colours(tmp_path: Path) -> None:
    look = read_character(painted_fbx(tmp_path)).look()
    assert look is not None
    assert look.notes == ()
    assert (look.colours == [255, 0, 0, 255]).all()
    assert not look.is_plain


@pytest.mark.parametrize("place", [".", "textures", "arm.fbm"])
def test_fbx_finds_textures_by_their_names(tmp_path: Path, place: str) -> None:
    (tmp_path / place).mkdir(exist_ok=True)
    (tmp_path / place / "skin.png").write_bytes(png(FOUR))
    character = read_character(painted_fbx(tmp_path, r"..\\artist\\skin.png"))
    look = character.look()
    assert look is not None
    assert look.notes == ()
    assert (look.colours == 255).all()
    held = look.materials[look.material_of[0]].texture
    assert held is not None
    np.testing.assert_array_equal(held.pixels[..., :3], FOUR)
    _, faces = tube()
    np.testing.assert_array_equal(look.vertices[look.faces], character.topology.faces)
    expected = np.arange(2 * faces.size).reshape(-1, 3, 2) / 1000.0
    np.testing.assert_allclose(look.uv[look.faces], expected * [1, -1] + [0, 1], atol=1e-6)


def test_fbx_without_its_texture_has_its_colour_and_a_note(tmp_path: Path) -> None:
    look = read_character(painted_fbx(tmp_path, "skin.png")).look()
    assert look is not None
    assert (look.colours == [255, 0, 0, 255]).all()
    assert look.notes == ("the texture 'skin.png' is not beside the file",)
