"""Creases of joints, which do not count, and contacts beside them, which do."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import open_body
from lcollision_core.bodies.motions import body_of_motion, read_motions
from lcollision_core.bodies.rig_body import default_rules, joint_groups
from lcollision_core.contact import CollisionDetector, ContactRules, SelfCollisions
from lcollision_core.files import Character, Rig
from lcollision_core.meshes import Topology
from tests.rigged_shapes import FloatArray, character_of, skinned, turned
from tests.smpl_files import write_model

_SIDES, _RINGS = 16, 41

_FINGERS = ("Index", "Middle", "Ring", "Pinky")


def _loft(rings: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the vertices and faces of a closed surface on (N, S, 3) rings."""
    n, sides = rings.shape[:2]
    vertices = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)])
    own = np.arange(n * sides).reshape(n, sides)
    after = np.roll(own, -1, axis=1)
    walls = [
        np.stack([own[:-1], own[1:], after[:-1]], axis=-1),
        np.stack([after[:-1], own[1:], after[1:]], axis=-1),
    ]
    first, last = np.full(sides, n * sides), np.full(sides, n * sides + 1)
    ends = [
        np.stack([first, own[0], after[0]], axis=-1),
        np.stack([last, after[-1], own[-1]], axis=-1),
    ]
    return vertices, np.concatenate([part.reshape(-1, 3) for part in (*walls, *ends)])


def _character(
    vertices: FloatArray,
    faces: FloatArray,
    weights: FloatArray,
    joints: dict[str, tuple[str, tuple[float, float, float]]],
) -> Character:
    names = list(joints)
    rest = np.broadcast_to(np.eye(4), (len(names), 4, 4)).copy()
    rest[:, :3, 3] = [place for _, place in joints.values()]
    rig = Rig(
        joint_names=tuple(names),
        parents=np.array([names.index(up) if up else -1 for up, _ in joints.values()]),
        rest=rest,
        nodes=np.arange(len(names)),
        joint_of=np.tile(np.arange(len(names), dtype=np.int32), (len(vertices), 1)),
        weights=weights,
        points=np.repeat(vertices[:, None], len(names), axis=1),
    )
    topology = Topology(faces.astype(np.int32), len(vertices))
    return character_of("made", topology, vertices, rig, [0.0, 1.0, 0.0], 0)


@cache
def thick_tube(radius: float) -> Character:
    """Return a tube of length 1 along y, bent by one joint at its middle."""
    angles = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    rings = np.empty((_RINGS, _SIDES, 3))
    rings[..., 0], rings[..., 2] = radius * np.cos(angles), radius * np.sin(angles)
    rings[..., 1] = np.linspace(0.0, 1.0, _RINGS)[:, None]
    vertices, faces = _loft(rings)
    share = np.clip((vertices[:, 1] - 0.5) / radius + 0.5, 0.0, 1.0)
    joints = {"Base": ("", (0.0, 0.0, 0.0)), "Bend": ("Base", (0.0, 0.5, 0.0))}
    return _character(vertices, faces, np.stack([1.0 - share, share], axis=1), joints)


def found_in(character: Character, turns: dict[str, float], rules: ContactRules) -> SelfCollisions:
    """Check a pose with joints turned about x, by angles in degrees."""
    rig = character.rig
    assert rig is not None
    angles = [np.radians(turns.get(name, 0.0)) for name in rig.joint_names]
    turned_by = Rotation.from_rotvec(np.outer(angles, [1.0, 0.0, 0.0])).as_matrix()
    groups, rest = joint_groups(character), character.rest_vertices
    detector = CollisionDetector(character.topology, rest, rules, groups)
    return detector.detect(skinned(rig, turned(rig, turned_by)))


@pytest.mark.parametrize("radius", [0.05, 0.07, 0.1, 0.15])
def test_a_thick_limb_bends_without_colliding_and_folds_onto_itself(radius: float) -> None:
    """Two straight halves that meet at a bend cross up to radius * tan(angle / 2) from its joint.

    Up to a limb's thickness, that is a crease; at 150 degrees one half lies in the other.
    """
    tube = thick_tube(radius)
    rules = default_rules(tube, joint_groups(tube))
    middles = tube.rest_vertices[tube.topology.faces].mean(axis=1)
    from_joint = np.linalg.norm(middles - [0.0, 0.5, 0.0], axis=1)
    for angle in (60.0, 90.0, 110.0):
        crossing = found_in(tube, {"Bend": angle}, ContactRules()).pairs
        assert from_joint[crossing].max(initial=0.0) < 2.0 * radius
        assert not found_in(tube, {"Bend": angle}, rules).colliding
    assert len(crossing) > 0
    folded = found_in(tube, {"Bend": 150.0}, rules)
    assert from_joint[folded.pairs].max() > 3.0 * radius


@cache
def coarse_hand() -> Character:
    """Return an arm along y, 1.4 m long, that ends in a hand of boxes with four fingers.

    A finger is one cell of 12 mm wide, two thick and six long; the palm is seven by seven.
    """
    cell = 0.012
    cells = [(column, row) for row in range(-110, -8) for column in range(2, 5)]
    cells += [(column, row) for row in range(-8, -1) for column in range(7)]
    cells += [(column, row) for row in range(-1, 6) for column in range(0, 7, 2)]
    filled = {(*at, layer) for at in cells for layer in range(2)}
    sides = []
    for at in sorted(filled):
        for axis in range(3):
            for way in (0, 1):
                beside = list(at)
                beside[axis] += 2 * way - 1
                if tuple(beside) not in filled:
                    one, other = (axis + 1) % 3, (axis + 2) % 3
                    corner = np.array(at)
                    corner[axis] += way
                    steps = np.eye(3, dtype=int)
                    ring = [corner, corner + steps[one], corner + steps[one] + steps[other]]
                    ring.append(corner + steps[other])
                    sides.append(ring if way else ring[::-1])
    corners, quads = np.unique(np.array(sides).reshape(-1, 3), axis=0, return_inverse=True)
    quads = quads.reshape(-1, 4)
    vertices = corners * cell
    joints = {"Arm": ("", (0.04, -1.3, 0.012)), "Hand": ("Arm", (0.04, -0.096, 0.012))}
    bones = [-0.012, 0.012, 0.036]
    for finger, column in zip(_FINGERS, range(0, 7, 2), strict=True):
        for part, along in enumerate(bones, start=1):
            above = "Hand" if part == 1 else f"{finger}{part - 1}"
            joints[f"{finger}{part}"] = (above, (cell * (column + 0.5), along, 0.012))
    weights = np.zeros((len(vertices), len(joints)))
    shares = [np.clip((vertices[:, 1] - at) / cell + 0.5, 0.0, 1.0) for at in (-0.096, *bones)]
    weights[:, 0] = 1.0 - shares[0]
    weights[:, 1] = shares[0] - shares[1]
    for number, column in enumerate(range(0, 7, 2)):
        own = (vertices[:, 0] > cell * (column - 0.5)) & (vertices[:, 0] < cell * (column + 1.5))
        for part, (share, after) in enumerate(zip(shares[1:], (*shares[2:], 0.0), strict=True)):
            weights[own, 2 + 3 * number + part] = (share - after)[own]
    return _character(vertices, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), weights, joints)


def curled(*angles: float) -> dict[str, float]:
    """Return the angles of all fingers, of the joint at the palm first."""
    return {f"{finger}{part}": to for finger in _FINGERS for part, to in enumerate(angles, start=1)}


def test_the_fingers_of_a_fist_count_against_the_palm() -> None:
    """Although the whole hand lies within the body's near exclusion."""
    hand = coarse_hand()
    rules = default_rules(hand, joint_groups(hand))
    rig, faces = hand.rig, hand.topology.faces
    assert rig is not None
    led_by = np.array([name[:-1] for name in rig.joint_names])[rig.weights.argmax(axis=1)]
    fist = found_in(hand, curled(80.0, 100.0, 80.0), rules)
    of_pairs = {tuple(sorted({led_by[faces[a][0]], led_by[faces[b][0]]})) for a, b in fist.pairs}
    assert of_pairs >= {("Han", finger) for finger in _FINGERS}
    for angles in ((0.0, 0.0, 0.0), (30.0, 30.0, 30.0), (80.0, 0.0, 0.0), (0.0, 90.0, 0.0)):
        assert not found_in(hand, curled(*angles), rules).colliding
    for wrist in (-60.0, 60.0):
        assert not found_in(hand, {"Hand": wrist}, rules).colliding


def test_the_fingers_of_a_fused_hand_count_as_they_close(tmp_path: Path) -> None:
    # In SMPL-X's layout, with fingers that share their skin.
    turns = np.zeros((10, 55, 3))
    turns[:, 25:40] = np.linspace(0.0, 1.0, 10)[:, None, None] * [0.4, 0.8, -1.333]
    path = tmp_path / "fist.npz"
    np.savez(path, poses=turns.reshape(10, -1), trans=np.zeros((10, 3)), betas=np.zeros(10))
    body, _ = body_of_motion(open_body(write_model(tmp_path / "body.npz")), path)
    (motion,) = read_motions(body, path)
    check = body.exact_check()
    found = [body.detector.detect(motion.vertices(frame, check)) for frame in range(10)]
    assert not found[0].colliding
    assert any(one.colliding for one in found)
