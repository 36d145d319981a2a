"""Synthetic clothed characters: open shells that lie on a body, one cut at a seam.

``python -m tests.clothed FILE.glb`` writes the large one.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from trimesh.remesh import subdivide

from lcollision_core.bodies import LearnedBody
from lcollision_core.files import Character, PoseSet, Rig
from lcollision_core.meshes import FaceGroup, Topology
from lcollision_core.meshes.normals import vertex_normals
from tests.bending_tube import LENGTH_IN_FILES, bending_tube
from tests.rigged_shapes import FloatArray, character_of, write_gltf

_JOINTS: dict[str, tuple[str, tuple[float, float, float]]] = {
    "Hips": ("", (0.0, 0.0, 0.88)),
    "Spine": ("Hips", (0.0, -0.01, 1.0)),
    "Spine1": ("Spine", (0.0, -0.005, 1.13)),
    "Neck": ("Spine1", (0.0, 0.0, 1.34)),
    "Head": ("Neck", (0.0, -0.02, 1.42)),
    "HeadEnd": ("Head", (0.0, -0.04, 1.62)),
    **{
        f"{side}{name}": (
            parent if parent in ("Hips", "Spine1") else side + parent,
            (sign * x, y, z),
        )
        for side, sign in (("Left", 1.0), ("Right", -1.0))
        for name, parent, (x, y, z) in (
            ("Shoulder", "Spine1", (0.03, 0.0, 1.3)),
            ("Arm", "Shoulder", (0.165, 0.0, 1.27)),
            ("ForeArm", "Arm", (0.34, -0.035, 1.1)),
            ("Hand", "ForeArm", (0.46, -0.12, 0.95)),
            ("HandEnd", "Hand", (0.54, -0.18, 0.84)),
            ("UpLeg", "Hips", (0.095, -0.01, 0.86)),
            ("Leg", "UpLeg", (0.138, -0.025, 0.46)),
            ("Foot", "Leg", (0.172, 0.005, 0.075)),
            ("ToeBase", "Foot", (0.188, -0.1, 0.025)),
            ("ToeEnd", "ToeBase", (0.19, -0.175, 0.015)),
        )
    },
}
"""Name, parent and position in the rest pose of the built-in body, in metres."""

_THICK = {"Hips": 0.14, "Spine": 0.13, "Spine1": 0.13, "Head": 0.1, "UpLeg": 0.08}
"""Radii in metres around the bones from these joints; 0.05 for others."""

_SWEEPS = 10
"""Number of smoothing sweeps, which blend the weights of neighbouring bones."""


def clothed_woman() -> Character:
    """Return the built-in body in shirt, trousers, jacket, skirt, belt, hair and shoes, z up."""
    model = LearnedBody.load("body")
    skin, topology = model.reference, model.topology
    names = tuple(_JOINTS)
    parents = np.array([names.index(parent) if parent else -1 for parent, _ in _JOINTS.values()])
    places = np.array([place for _, place in _JOINTS.values()])
    bone_of = _nearest_bones(skin, places, parents, names)
    held = np.zeros((len(skin), len(names)))
    held[np.arange(len(skin)), bone_of] = 1.0
    ring = topology.adjacency / np.maximum(topology.adjacency.sum(axis=1), 1.0)
    for _ in range(_SWEEPS):
        held = 0.5 * (held + ring @ held)
    order = np.argsort(-held, axis=1, kind="stable")[:, :3]
    weights = np.take_along_axis(held, order, axis=1)
    rest = np.broadcast_to(np.eye(4), (len(names), 4, 4)).copy()
    rest[:, :3, 3] = places
    rig = Rig(
        joint_names=names,
        parents=parents,
        rest=rest,
        nodes=np.arange(len(names)),
        joint_of=order.astype(np.int32),
        weights=weights / weights.sum(axis=1, keepdims=True),
        points=np.repeat(skin[:, None], 3, axis=1),
    )
    body = character_of("clothed", topology, skin, rig, [0.0, 0.0, 1.0], 0)
    (x, y, z), bone = skin.T, np.array(names)[bone_of]
    arm = np.char.find(bone, "Arm") >= 0
    hand, head = np.char.find(bone, "Hand") >= 0, bone == "Head"
    trunk = ~(arm | hand | head)
    leg = trunk & (z < 0.9)
    sleeve = np.char.endswith(bone, "Arm") & ~np.char.endswith(bone, "ForeArm")
    size = np.ptp(skin, axis=0).max()
    layers = {
        "shirt": ((trunk & (z > 0.84) & (z < 1.34)) | sleeve, 0.009),
        "trousers": (trunk & (z > 0.12) & (z < 1.0), 0.006),
        "jacket": (
            ((trunk & (z > 0.9) & (z < 1.32)) | arm) & ~((np.abs(x) < 0.03) & (y < 0.0)),
            0.016,
        ),
        "hair": (head & (z > 1.46) & ((y > -0.07) | (z > 1.58)), 0.006),
        "left shoe": (leg & (z < 0.11) & (x > 0.0), 0.006),
        "right shoe": (leg & (z < 0.11) & (x < 0.0), 0.006),
    }
    clothed = with_shells(body, {name: (on, away * size) for name, (on, away) in layers.items()})
    still = trunk & (np.abs(x) < 0.25)
    clothed = _with_ring(clothed, skin[still], np.flatnonzero(still), "skirt", (0.8, 0.94), 0.035)
    return _with_ring(clothed, skin[still], np.flatnonzero(still), "belt", (0.97, 1.0), 0.03)


def sleeved_tube() -> tuple[PoseSet, npt.NDArray[np.intp]]:
    """Return poses of a bending tube with an open sleeve around its middle, 0.01 away from it.

    Returns
    -------
    poses : of 840 vertices of the tube and those of the sleeve
    covered : (n,) the vertices of the tube under those of the sleeve
    """
    tube = bending_tube()
    finer = [subdivide(pose.astype(np.float64), tube.faces) for pose in tube.vertices]
    skin, faces = np.stack([vertices for vertices, _ in finer]), finer[0][1]
    along = (skin[0, :, 1] - skin[0, :, 1].min())[faces] / np.ptp(skin[0, :, 1])
    inside = ((along > 0.15) & (along < 0.85)).all(axis=1)
    covered, local = np.unique(faces[inside], return_inverse=True)
    sleeve = [
        pose[covered] + 0.01 * LENGTH_IN_FILES * vertex_normals(pose, faces)[covered]
        for pose in skin
    ]
    n_vertices = skin.shape[1]
    together = np.concatenate([faces, local.reshape(-1, 3) + n_vertices])
    topology = Topology(together, n_vertices + len(covered))
    return PoseSet(np.concatenate([skin, sleeve], axis=1), topology, tube.names), covered


def with_shells(
    body: Character, layers: dict[str, tuple[npt.NDArray[np.bool_], float]]
) -> Character:
    """Add shells to a character: copies of parts of its skin, moved outwards, with weights.

    Parameters
    ----------
    layers : by name, a (V,) mask of the covered vertices, and the distance from them
    """
    normals = vertex_normals(body.rest_vertices, body.topology.faces)
    n_body = len(body.rest_vertices)
    for name, (on, away) in layers.items():
        faces = body.topology.faces[: body.topology.n_faces]
        inside = faces[(faces < n_body).all(axis=1)]
        inside = inside[on[np.minimum(inside, n_body - 1)].all(axis=1)]
        own, local = np.unique(inside, return_inverse=True)
        moved = body.rest_vertices[own] + away * normals[own]
        body = _joined(body, moved, local.reshape(-1, 3), own, name)
    return body


def _with_ring(
    body: Character,
    skin: FloatArray,
    vertex: npt.NDArray[np.intp],
    name: str,
    heights: tuple[float, float],
    away: float,
) -> Character:
    """Add a ring around a body, open above and below, with the weights of the nearest skin."""
    n_sides, n_rings = 36, max(3, round(np.ptp(heights) / 0.04))
    angle = 2.0 * np.pi * np.arange(n_sides) / n_sides
    points, reach, depth = [], 0.0, np.zeros(2)
    for z in np.linspace(heights[1], heights[0], n_rings):
        near = skin[np.abs(skin[:, 2] - z) < 0.03]
        # It never narrows downwards.
        reach = max(reach, float(np.abs(near[:, 0]).max()))
        depth = np.maximum(depth, [-near[:, 1].min(), near[:, 1].max()])
        wide, deep, middle = reach + away, 0.5 * depth.sum() + away, 0.5 * (depth[1] - depth[0])
        # A superellipse, so that no corner of the hips sticks out.
        round_ = np.maximum(np.abs(np.cos(angle)) ** 3 + np.abs(np.sin(angle)) ** 3, 1e-9) ** (
            -1 / 3
        )
        ring = np.stack([wide * np.cos(angle) * round_, middle + deep * np.sin(angle) * round_], 1)
        points.append(np.column_stack([ring, np.full(n_sides, z)]))
    low = np.arange(n_sides * (n_rings - 1)).reshape(-1, n_sides)
    right = np.roll(low, -1, axis=1)
    quads = np.stack([low, low + n_sides, right + n_sides, right], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices = np.concatenate(points)
    return _joined(body, vertices, faces, vertex[cKDTree(skin).query(vertices)[1]], name)


def _joined(
    body: Character,
    vertices: FloatArray,
    faces: npt.NDArray[np.integer],
    skin: npt.NDArray[np.integer],
    name: str,
) -> Character:
    """Add a mesh to a character, with the weights of the given vertices of its skin."""
    rig = body.rig
    assert rig is not None
    n_vertices, n_faces = len(body.rest_vertices), body.topology.n_faces
    together = np.concatenate([body.rest_vertices, vertices])
    group = FaceGroup(name, np.arange(n_faces, n_faces + len(faces)))
    return replace(
        body,
        topology=Topology(np.concatenate([body.topology.faces, faces + n_vertices]), len(together)),
        rest_vertices=together,
        joined=np.arange(len(together)),
        groups=(*body.groups, group),
        rig=replace(
            rig,
            joint_of=np.concatenate([rig.joint_of, rig.joint_of[skin]]),
            weights=np.concatenate([rig.weights, rig.weights[skin]]),
            points=np.concatenate(
                [rig.points, np.repeat(vertices[:, None], rig.points.shape[1], axis=1)]
            ),
        ),
    )


def cut_at_a_seam(body: Character, name: str) -> Character:
    """Cut a layer at x = 0, as at a UV seam: duplicate the vertices there."""
    (faces,) = (group.faces for group in body.groups if group.name == name)
    corners = body.topology.faces[faces]
    on_right = body.rest_vertices[corners].mean(axis=1)[:, 0] < 0.0
    twice = np.intersect1d(corners[on_right], corners[~on_right])
    n_vertices = len(body.rest_vertices)
    copy_of = np.arange(n_vertices)
    copy_of[twice] = n_vertices + np.arange(len(twice))
    cut = body.topology.faces.copy()
    cut[faces[on_right]] = copy_of[corners[on_right]]
    whole = _joined(body, body.rest_vertices[twice], np.empty((0, 3), np.int32), twice, "none")
    return replace(whole, groups=body.groups, topology=Topology(cut, n_vertices + len(twice)))


def _nearest_bones(
    points: FloatArray, places: FloatArray, parents: npt.NDArray[np.int64], names: tuple[str, ...]
) -> npt.NDArray[np.intp]:
    """Return, for each point, the joint with the nearest bone to one of its children."""
    away = np.full((len(points), len(names)), np.inf)
    for joint, parent in enumerate(parents):
        if parent < 0:
            continue
        way = places[joint] - places[parent]
        along = np.clip((points - places[parent]) @ way / (way @ way), 0.0, 1.0)
        distance = np.linalg.norm(points - places[parent] - along[:, None] * way, axis=1)
        kind = names[parent].removeprefix("Left").removeprefix("Right")
        scaled = distance / _THICK.get(kind, 0.05)
        away[:, parent] = np.minimum(away[:, parent], scaled)
    return away.argmin(axis=1)


if __name__ == "__main__":
    write_gltf(cut_at_a_seam(clothed_woman(), "shirt"), Path(sys.argv[1]))
