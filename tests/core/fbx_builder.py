"""Writes small FBX files as text, and evaluates their frames with ufbx."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lcollision_core.files import Character
from tests.core.gltf_builder import tube

TICKS = 46186158000
"""Ticks per second, FBX's unit of time."""

_REFERENCE = """
import ctypes, gc, io, json, os, sys
import numpy as np
import ufbx
gc.disable()
def kept(item):
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(item))
    return item
path, clip, times = json.loads(sys.argv[1])
scene = kept(ufbx.load_file(path, evaluate_skinning=True))
animation = kept(kept(kept(scene.anim_stacks)[clip]).anim) if clip is not None else None
frames = []
for time in times:
    posed = scene
    if clip is not None:
        posed = kept(ufbx.evaluate_scene(scene, animation, time, evaluate_skinning=True))
    found = []
    nodes = kept(posed.nodes)
    for number in range(len(nodes)):
        node = kept(nodes[number])
        mesh = kept(node.mesh)
        if mesh is not None:
            points = np.array(kept(kept(mesh.skinned_position).values))
            if mesh.skinned_is_local:
                turn = np.array(node.geometry_to_world)
                points = points @ turn[:3] + turn[3]
            found.append(points)
    frames.append(np.concatenate(found))
held = io.BytesIO()
np.save(held, np.stack(frames))
sys.stdout.buffer.write(held.getvalue())
sys.stdout.flush()
os._exit(0)
"""


def ufbx_frames(path: Path, clip: int | None, times: Sequence[float]) -> np.ndarray:
    """Return the (N, W, 3) vertices evaluated by ufbx, meshes in the order of nodes.

    Parameters
    ----------
    path : the file
    clip : number of the animation; None for the stored pose
    times : in seconds
    """
    asked = json.dumps([str(path), clip, list(times)])
    done = subprocess.run(
        [sys.executable, "-c", _REFERENCE, asked], capture_output=True, check=True
    )
    return np.load(io.BytesIO(done.stdout))


def _numbers(values: np.ndarray) -> str:
    flat = np.asarray(values).reshape(-1)
    return f"*{len(flat)} {{ a: {','.join(repr(value) for value in flat.tolist())} }}"


def _moved(y: float) -> np.ndarray:
    """Return a matrix as FBX stores it: row by row, for row vectors."""
    matrix = np.eye(4)
    matrix[3, 1] = y
    return matrix


def arm_fbx(
    path: Path,
    *,
    up: int = 1,
    metres: float = 0.01,
    is_long: bool = True,
    skinning: str = "Linear",
    others: Sequence[str] = (),
) -> Path:
    """Write a tube in a scene of two bones, with a blend shape and the clip "wave".

    Parameters
    ----------
    path : a .fbx file
    up : 0, 1 or 2
    metres : the unit
    is_long : whether the clip's stated length is that of its curves, else 0
    skinning : Linear, Rigid, DualQuaternion, or Blend, which varies towards the upper vertices
    others : names of further, unmoved meshes: "hidden ..." are invisible, "level ..." are levels
        of detail of one group
    """
    vertices, faces = tube()
    corners = faces.copy()
    corners[:, 2] = ~corners[:, 2]
    upper = np.clip((vertices[:, 1] - 1.0) / 1.0, 0.0, 1.0).astype(float)
    # Vertices that neither bone moves follow the mesh.
    shares = {
        "Lower": (np.flatnonzero((upper < 1.0) & (vertices[:, 1] > 0.0)), 1.0 - upper),
        "Upper": (np.flatnonzero(upper > 0.0), upper),
    }
    changed = np.flatnonzero(vertices[:, 1] > 1.2)
    offsets = np.tile([0.0, 0.1, 0.3], (len(changed), 1))
    shares_of_dual = ""
    if skinning == "Blend":
        rows = np.arange(len(vertices))
        shares_of_dual = f"Indexes: {_numbers(rows)}\n        BlendWeights: {_numbers(upper)}"
    objects = f"""
    Geometry: 100, "Geometry::Tube", "Mesh" {{
        Vertices: {_numbers(vertices.astype(float))}
        PolygonVertexIndex: {_numbers(corners)}
        GeometryVersion: 124
        LayerElementMaterial: 0 {{
            Version: 101
            MappingInformationType: "AllSame"
            ReferenceInformationType: "IndexToDirect"
            Materials: *1 {{ a: 0 }}
        }}
        Layer: 0 {{
            LayerElement: {{ Type: "LayerElementMaterial"
            TypedIndex: 0 }}
        }}
    }}
    Geometry: 101, "Geometry::Longer", "Shape" {{
        Version: 100
        Indexes: {_numbers(changed)}
        Vertices: {_numbers(offsets)}
    }}
    Model: 200, "Model::Body", "Mesh" {{
        Properties70: {{
            P: "Lcl Translation", "Lcl Translation", "", "A",0.5,0.25,0
            P: "Lcl Rotation", "Lcl Rotation", "", "A",0,20,0
            P: "GeometricTranslation", "Vector3D", "Vector", "",0,0,0.125
        }}
    }}
    Model: 201, "Model::Lower", "LimbNode" {{
        Properties70: {{
            P: "Lcl Translation", "Lcl Translation", "", "A",0,0.2,0
            P: "RotationPivot", "Vector3D", "Vector", "",0,0.5,0
            P: "PreRotation", "Vector3D", "Vector", "",0,0,10
            P: "RotationActive", "bool", "", "",1
        }}
    }}
    Model: 202, "Model::Upper", "LimbNode" {{
        Properties70: {{
            P: "InheritType", "enum", "", "",2
            P: "Lcl Translation", "Lcl Translation", "", "A",0,1.5,0
            P: "Lcl Scaling", "Lcl Scaling", "", "A",1,1.25,1
        }}
    }}
    Material: 300, "Material::Skin", "" {{ }}
    Deformer: 400, "Deformer::", "Skin" {{
        SkinningType: "{skinning}"
        {shares_of_dual}
    }}
    Deformer: 403, "Deformer::", "BlendShape" {{ }}
    Deformer: 404, "SubDeformer::Longer", "BlendShapeChannel" {{
        DeformPercent: 50
        FullWeights: *1 {{ a: 100 }}
    }}
    """
    for number, (name, (moved, share)) in enumerate(shares.items()):
        objects += f"""
    Deformer: {401 + number}, "SubDeformer::{name}", "Cluster" {{
        Indexes: {_numbers(moved)}
        Weights: {_numbers(share[moved])}
        Transform: {_numbers(_moved(-1.5 * number))}
        TransformLink: {_numbers(_moved(1.5 * number))}
    }}
    """
    links = ["100,200", "200,0", "201,0", "202,201", "300,200", "400,100", "401,400", "402,400"]
    links += ["201,401", "202,402", "403,100", "404,403", "101,404", "501,500"]
    if any(name.startswith("level") for name in others):
        objects += """
    NodeAttribute: 690, "NodeAttribute::Levels", "LodGroup" { }
    Model: 691, "Model::Levels", "LodGroup" { }
    """
        links += ["690,691", "691,0"]
    for number, name in enumerate(others, 600):
        seen = 0 if name.startswith("hidden") else 1
        objects += f"""
    Geometry: {number}, "Geometry::{name}", "Mesh" {{
        Vertices: {_numbers(vertices + 5.0)}
        PolygonVertexIndex: {_numbers(corners)}
    }}
    Model: {50 + number}, "Model::{name}", "Mesh" {{
        Properties70: {{
            P: "Visibility", "Visibility", "", "A",{seen}
        }}
    }}
    """
        above = 691 if name.startswith("level") else 0
        links += [f"{number},{50 + number}", f"{50 + number},{above}"]
    properties = []
    curves = (
        (510, 201, "Lcl Rotation", "XYZ", (10.0, 0.0, -30.0), (-50.0, 40.0, 60.0)),
        (520, 202, "Lcl Translation", "XYZ", (0.0, 1.5, 0.0), (0.5, 1.75, -0.25)),
        (530, 404, "DeformPercent", None, (0.0,), (100.0,)),
        (540, 202, "Lcl Rotation", "XYZ", (0.0, 0.0, 0.0), (20.0, 110.0, -40.0)),
    )
    for first, target, name, axes, start, end in curves:
        objects += f'\n    AnimationCurveNode: {first}, "AnimCurveNode::", "" {{ }}'
        links.append(f"{first},501")
        properties.append(f'{first},{target}, "{name}"')
        channels = [f"d|{axis}" for axis in axes] if axes else [f"d|{name}"]
        for index, (channel, a, b) in enumerate(zip(channels, start, end, strict=True)):
            number = first + 1 + index
            objects += f"""
    AnimationCurve: {number}, "AnimCurve::", "" {{
        KeyTime: *2 {{ a: 0,{TICKS} }}
        KeyValueFloat: *2 {{ a: {a},{b} }}
        KeyAttrFlags: *1 {{ a: 8456 }}
        KeyAttrDataFloat: *4 {{ a: 0,0,0,0 }}
        KeyAttrRefCount: *1 {{ a: 2 }}
    }}"""
            properties.append(f'{number},{first}, "{channel}"')
    objects += f"""
    AnimationStack: 500, "AnimStack::wave", "" {{
        Properties70: {{
            P: "LocalStart", "KTime", "Time", "",0
            P: "LocalStop", "KTime", "Time", "",{TICKS if is_long else 0}
        }}
    }}
    AnimationLayer: 501, "AnimLayer::Base", "" {{ }}
    """
    return _write(path, objects, links, properties, up, metres)


def character_fbx(
    character: Character, path: Path, *, texture: str = "", stretched: str = ""
) -> Path:
    """Write a character, z up, in centimetres, with its rig and its clips' turns.

    The first half of its faces has the material "Red", the rest "Painted"; texture coordinates
    have a seam at x = 0, and each face has its own normal.

    Parameters
    ----------
    texture : the name of an image beside the file, for "Painted"
    stretched : the name of a joint with scale 1.5 along z, which its children do not inherit
    """
    rig = character.rig
    assert rig is not None
    vertices, faces = character.rest_vertices, character.topology.faces
    corners = faces.copy()
    corners[:, 2] = ~corners[:, 2]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    on_left = vertices[faces].mean(axis=1)[:, 0] < 0.0
    uv = vertices[faces][..., [0, 2]] / np.ptp(vertices) + 0.5 * on_left[:, None, None]
    objects = f"""
    Geometry: 1, "Geometry::Body", "Mesh" {{
        Vertices: {_numbers(vertices)}
        PolygonVertexIndex: {_numbers(corners)}
        GeometryVersion: 124
        LayerElementMaterial: 0 {{
            MappingInformationType: "ByPolygon"
            ReferenceInformationType: "IndexToDirect"
            Materials: {_numbers((np.arange(len(faces)) >= len(faces) // 2).astype(int))}
        }}
        LayerElementNormal: 0 {{
            MappingInformationType: "ByPolygonVertex"
            ReferenceInformationType: "Direct"
            Normals: {_numbers(np.repeat(normals, 3, axis=0))}
        }}
        LayerElementUV: 0 {{
            MappingInformationType: "ByPolygonVertex"
            ReferenceInformationType: "IndexToDirect"
            UV: {_numbers(uv)}
            UVIndex: {_numbers(np.arange(3 * len(faces)))}
        }}
        Layer: 0 {{
            LayerElement: {{ Type: "LayerElementMaterial"
            TypedIndex: 0 }}
            LayerElement: {{ Type: "LayerElementNormal"
            TypedIndex: 0 }}
            LayerElement: {{ Type: "LayerElementUV"
            TypedIndex: 0 }}
        }}
    }}
    Model: 2, "Model::Body", "Mesh" {{ }}
    Material: 3, "Material::Red", "" {{
        Properties70: {{
            P: "DiffuseColor", "Color", "", "A",1,0,0
        }}
    }}
    Material: 4, "Material::Painted", "" {{ }}
    Deformer: 5, "Deformer::", "Skin" {{
        SkinningType: "Linear"
    }}"""
    links, properties = ["1,2", "2,0", "3,2", "4,2", "5,1"], []
    if texture:
        objects += f"""
    Texture: 6, "Texture::Paint", "" {{
        RelativeFilename: "{texture}"
    }}"""
        properties.append('6,4, "DiffuseColor"')
    n = len(rig.joint_names)
    for joint, (name, parent) in enumerate(zip(rig.joint_names, rig.parents, strict=True)):
        model, cluster = 100 + joint, 100 + n + joint
        place = rig.rest[joint, :3, 3] - (rig.rest[parent, :3, 3] if parent >= 0 else 0.0)
        share = (rig.weights * (rig.joint_of == joint)).sum(axis=1)
        moved = np.flatnonzero(share)
        objects += f"""
    Model: {model}, "Model::{name}", "LimbNode" {{
        Properties70: {{
            P: "Lcl Translation", "Lcl Translation", "", "A",{",".join(map(repr, place.tolist()))}
            P: "Lcl Scaling", "Lcl Scaling", "", "A",1,1,{1.5 if name == stretched else 1.0}
            P: "InheritType", "enum", "", "",{2 if stretched else 1}
        }}
    }}
    Deformer: {cluster}, "SubDeformer::{name}", "Cluster" {{
        Indexes: {_numbers(moved)}
        Weights: {_numbers(share[moved])}
        Transform: {_numbers(np.linalg.inv(rig.rest[joint]).T)}
        TransformLink: {_numbers(rig.rest[joint].T)}
    }}"""
        links += [f"{model},{100 + parent if parent >= 0 else 0}", f"{cluster},5"]
        links.append(f"{model},{cluster}")
    number = 1000
    for clip in character.clips:
        frames = character.sample(clip, None)
        assert frames.transforms is not None
        ticks = np.rint(frames.times * TICKS).astype(np.int64)
        objects += f"""
    AnimationStack: {number}, "AnimStack::{clip}", "" {{
        Properties70: {{
            P: "LocalStart", "KTime", "Time", "",{ticks[0]}
            P: "LocalStop", "KTime", "Time", "",{ticks[-1]}
        }}
    }}
    AnimationLayer: {number + 1}, "AnimLayer::{clip}", "" {{ }}"""
        layer = number + 1
        links.append(f"{layer},{number}")
        number += 2
        moved_by = frames.transforms @ np.linalg.inv(rig.rest)
        for joint, parent in enumerate(rig.parents):
            above = np.linalg.inv(moved_by[:, parent]) if parent >= 0 else np.eye(4)
            turns = Rotation.from_matrix((above @ moved_by[:, joint])[:, :3, :3])
            angles = np.degrees(np.unwrap(turns.as_euler("xyz"), axis=0))
            objects += f'\n    AnimationCurveNode: {number}, "AnimCurveNode::", "" {{ }}'
            links.append(f"{number},{layer}")
            properties.append(f'{number},{100 + joint}, "Lcl Rotation"')
            for axis in range(3):
                curve = number + 1 + axis
                objects += f"""
    AnimationCurve: {curve}, "AnimCurve::", "" {{
        KeyTime: {_numbers(ticks)}
        KeyValueFloat: {_numbers(angles[:, axis])}
        KeyAttrFlags: *1 {{ a: 4 }}
        KeyAttrDataFloat: *4 {{ a: 0,0,0,0 }}
        KeyAttrRefCount: *1 {{ a: {len(ticks)} }}
    }}"""
                properties.append(f'{curve},{number}, "d|{"XYZ"[axis]}"')
            number += 4
    return _write(path, objects, links, properties, up=2, metres=0.01)


def _write(
    path: Path,
    objects: str,
    links: Sequence[str],
    properties: Sequence[str],
    up: int,
    metres: float,
) -> Path:
    """Write a file of objects, and of connections between them and to their properties."""
    front, right = (up + 1) % 3, (up + 2) % 3
    connected = [f'    C: "OO",{link}' for link in links]
    connected += [f'    C: "OP",{link}' for link in properties]
    path.write_text(
        "; FBX 7.4.0 project file\n"
        "FBXHeaderExtension:  {\n    FBXVersion: 7400\n}\n"
        "GlobalSettings:  {\n    Properties70:  {\n"
        f'        P: "UpAxis", "int", "Integer", "",{up}\n'
        '        P: "UpAxisSign", "int", "Integer", "",1\n'
        f'        P: "FrontAxis", "int", "Integer", "",{front}\n'
        '        P: "FrontAxisSign", "int", "Integer", "",1\n'
        f'        P: "CoordAxis", "int", "Integer", "",{right}\n'
        '        P: "CoordAxisSign", "int", "Integer", "",1\n'
        f'        P: "UnitScaleFactor", "double", "Number", "",{100.0 * metres}\n'
        '        P: "TimeMode", "enum", "", "",6\n'
        "    }\n}\n"
        f"Objects:  {{{objects}\n}}\n"
        "Connections:  {\n" + "\n".join(connected) + "\n}\n"
    )
    return path
