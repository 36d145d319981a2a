"""The built-in body: a sound mesh, human poses, smooth motions."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lcollision_core.built_in_body import BodyKind, body_set, make_body
from lcollision_core.built_in_body.body_set import (
    HalfMesh,
    Skin,
    Template,
    build_template,
    mirror_whole,
)
from lcollision_core.built_in_body.figure import Arm, Figure, Foot, Leg
from lcollision_core.built_in_body.motions import authored_poses
from lcollision_core.built_in_body.skeleton import BONES, Skeleton, limits_of, turn_z
from lcollision_core.contact import CollisionDetector
from lcollision_core.errors import MissingExtraError, ShapeError
from lcollision_core.files import PoseSet, read_pose_set
from lcollision_core.jobs import Job
from lcollision_core.meshes import Topology, body_size
from tests.app.support import Lcollision

pytestmark = pytest.mark.slow  # Only developers build the body; users have the bundled model.

MAX_COLLIDING = 5
MIN_DIFFERENCE = 0.015
"""Mean vertex distance between any two authored poses, normalised."""

MAX_ACCELERATION = {"body-swing": 0.036, "body-jump": 0.026}
"""Limit for any vertex from frame to frame, normalised; a lost frame exceeds it."""

KINDS: tuple[BodyKind, ...] = ("body", "body-swing", "body-jump")


@pytest.fixture(scope="module")
def template() -> Template:
    return build_template(2161)


@pytest.fixture(scope="module")
def skeleton(template: Template) -> Skeleton:
    return template.skeleton


@pytest.fixture(scope="module")
def bodies(template: Template) -> dict[str, PoseSet]:
    """All three kinds on one template of 2161 vertices."""
    return {kind: make_body(kind, n_vertices=len(template.vertices)) for kind in KINDS}


@pytest.fixture(scope="module")
def poses(bodies: dict[str, PoseSet]) -> PoseSet:
    return bodies["body"]


@pytest.fixture(scope="module")
def rest(poses: PoseSet) -> np.ndarray:
    """Return the pose with the arms held away from the body."""
    return poses.vertices[0]


@pytest.fixture(scope="module")
def detector(poses: PoseSet, rest: np.ndarray) -> CollisionDetector:
    return CollisionDetector(poses.topology, rest)


# The sets


def test_sets_have_the_stated_shapes(bodies: dict[str, PoseSet]) -> None:
    for kind, n_poses in (("body", 71), ("body-swing", 150), ("body-jump", 150)):
        body = bodies[kind]
        assert body.vertices.shape == (n_poses, 2161, 3)
        assert body.vertices.dtype == np.float32
        assert body.faces.shape == (2 * 2161 - 4, 3)
        assert body.faces.dtype == np.int32
        assert len(set(body.names)) == n_poses
        assert body.up_axis == 2
    assert bodies["body"].names[0] == "rest"
    assert bodies["body-jump"].names[12] == "frame 12"
    assert body_set.DEFAULT_VERTICES == {"body": 2161, "body-swing": 10001, "body-jump": 10002}


def test_made_body_is_a_pose_set(
    template: Template, lcollision: Lcollision, tmp_path: Path
) -> None:
    """The command is tested here, where the template it needs has been built."""
    assert build_template(2161) is template
    output = tmp_path / "body.npz"
    result = lcollision("dataset", "make", "body", "-o", output)
    assert result.exit_code == 0
    poses = read_pose_set(output)
    assert poses.vertices.shape == (71, 2161, 3)
    assert poses.topology.is_watertight
    report = json.loads(lcollision("dataset", "check", output, "--json").stdout)
    assert report["problems"] == []
    assert report["colliding_poses"] <= 5


def test_progress_counts_every_pose(template: Template) -> None:
    seen: list[tuple[int, int]] = []
    make_body("body", len(template.vertices), job=Job(lambda done, of: seen.append((done, of))))
    assert seen == [(done, 71) for done in range(1, 72)]


def test_every_authored_pose_stands_on_the_floor(poses: PoseSet, rest: np.ndarray) -> None:
    np.testing.assert_allclose(poses.vertices[..., 2].min(axis=1), 0.0, atol=1e-6)
    assert 1.5 < body_size(rest) < 1.8


@pytest.mark.parametrize("n_vertices", [0, 499, 12001])
def test_vertex_count_out_of_range_is_refused(n_vertices: int) -> None:
    with pytest.raises(ShapeError, match=f"vertices must be 500 to 12000, got {n_vertices}"):
        make_body("body", n_vertices)


# The mesh


def test_mesh_is_one_closed_surface_of_genus_0(poses: PoseSet, rest: np.ndarray) -> None:
    topology = poses.topology
    assert topology.is_watertight
    assert topology.n_vertices - len(topology.edges) + topology.n_faces == 2
    assert topology.vertex_components[0] == 1
    assert len(topology.unused_vertices) == 0
    a, b, c = rest[poses.faces].astype(np.float64).transpose(1, 0, 2)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    # A person has about as many litres as kilograms; inward faces would give a negative volume.
    assert 0.045 < volume < 0.085


def test_no_two_vertices_coincide_in_any_pose(poses: PoseSet) -> None:
    for vertices in poses.vertices:
        nearest = cKDTree(vertices).query(vertices, k=2)[0][:, 1]
        assert nearest.min() > 1e-3


def test_triangles_are_no_slivers(poses: PoseSet, rest: np.ndarray) -> None:
    corners = rest[poses.faces].astype(np.float64)
    sides = np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(sides, axis=2)
    cosine = -np.einsum("fij,fij->fi", sides, np.roll(sides, 1, axis=1))
    cosine /= lengths * np.roll(lengths, 1, axis=1)
    smallest_angle = np.degrees(np.arccos(cosine)).min(axis=1)
    assert smallest_angle.min() > 8.0
    assert np.median(smallest_angle) > 40.0


def test_template_is_its_own_mirror_image(template: Template) -> None:
    distance, mirror = cKDTree(template.vertices).query(template.vertices * [-1, 1, 1])
    np.testing.assert_array_equal(mirror[mirror], np.arange(len(mirror)))
    assert distance.max() < 1e-12
    image = np.sort(mirror[template.faces], axis=1)
    assert {tuple(f) for f in image} == {tuple(f) for f in np.sort(template.faces, axis=1)}


def test_left_parts_are_on_the_left(poses: PoseSet, rest: np.ndarray) -> None:
    x, _, z = rest.T
    labels = poses.vertex_labels
    assert labels is not None
    for part in ("forearm", "hand", "thigh", "shin", "foot"):
        assert (x[labels == f"left {part}"] > 0).all()
        assert (x[labels == f"right {part}"] < 0).all()
        assert np.count_nonzero(labels == f"left {part}") > 20
    order = ["left foot", "left shin", "left thigh", "belly", "chest", "head"]
    heights = [z[labels == part].mean() for part in order]
    assert heights == sorted(heights)
    # It faces -y: the toes are in front of the heels.
    assert rest[labels == "left toes", 1].mean() < rest[labels == "left shin", 1].mean() - 0.05


# Contact


def test_few_poses_touch_themselves_and_the_rest_pose_does_not(
    poses: PoseSet, detector: CollisionDetector
) -> None:
    colliding = np.flatnonzero(detector.detect_batch(poses.vertices).colliding)
    assert 0 not in colliding
    assert len(colliding) <= MAX_COLLIDING, [poses.names[pose] for pose in colliding]


def test_an_arm_put_through_the_chest_is_found(
    detector: CollisionDetector, template: Template
) -> None:
    stabbed = Figure(left_arm=Arm(60, plane=135, turn=60, elbow=100))
    angles = body_set.joint_angles(stabbed, template.skeleton)
    pelvis = stabbed.pelvis(template.skeleton)
    vertices = Skin(template).pose(*template.skeleton.pose(angles, *pelvis))
    assert detector.detect(vertices).colliding


@pytest.mark.parametrize("kind", ["body-swing", "body-jump"])
def test_few_frames_touch_themselves(
    bodies: dict[str, PoseSet], detector: CollisionDetector, kind: str
) -> None:
    colliding = detector.detect_batch(bodies[kind].vertices).colliding
    assert np.count_nonzero(colliding) <= 8


# Poses


@pytest.mark.parametrize("kind", KINDS)
def test_authored_joint_angles_are_within_human_limits(kind: BodyKind, skeleton: Skeleton) -> None:
    names, figures = body_set.figures_of(kind, skeleton)
    beyond = [
        (name, angle, round(value, 1))
        for name, figure in zip(names, figures, strict=True)
        for angle, value in figure.angles(skeleton).items()
        if not limits_of(angle)[0] <= value <= limits_of(angle)[1]
    ]
    assert beyond == []


def test_angles_beyond_the_limits_are_held_at_them(skeleton: Skeleton) -> None:
    broken = Figure(left_arm=Arm(230, elbow=-40), right_leg=Leg(-90, knee=170))
    angles = body_set.joint_angles(broken, skeleton)
    assert angles["left arm raise"] == limits_of("left arm raise")[1] == 175.0
    assert angles["left elbow"] == 0.0
    assert angles["right hip flexion"] == -25.0
    assert angles["right knee"] == 140.0


def test_no_two_poses_are_alike(poses: PoseSet, rest: np.ndarray) -> None:
    vertices = poses.vertices.astype(np.float64)
    vertices -= vertices.mean(axis=1, keepdims=True)
    difference = np.array(
        [np.linalg.norm(vertices - pose, axis=2).mean(axis=1) for pose in vertices]
    ) / body_size(rest)
    np.fill_diagonal(difference, np.inf)
    assert difference.min() > MIN_DIFFERENCE


def test_zero_pose_hangs_its_arms_and_stands_straight(skeleton: Skeleton) -> None:
    _, joints = skeleton.pose({}, np.eye(3), skeleton.positions[0])
    at = dict(zip(BONES, joints, strict=True))
    for side, sign in (("left", 1), ("right", -1)):
        for start, end in (("upper arm", "hand"), ("thigh", "foot")):
            along = at[f"{side} {end}"] - at[f"{side} {start}"]
            np.testing.assert_allclose(along / np.linalg.norm(along), [0, 0, -1], atol=0.03)
        assert sign * at[f"{side} hand"][0] > 0.1


@pytest.mark.parametrize(
    ("angles", "start", "end", "direction"),
    [
        ({"left arm raise": 90}, "left upper arm", "left forearm", (1, 0, 0)),
        ({"right arm raise": 90}, "right upper arm", "right forearm", (-1, 0, 0)),
        ({"left arm raise": 90, "left arm plane": 90}, "left upper arm", "left hand", (0, -1, 0)),
        ({"left elbow": 90}, "left forearm", "left hand", (0, -1, 0)),
        ({"left elbow": 90, "left arm turn": 90}, "left forearm", "left hand", (-1, 0, 0)),
        ({"right elbow": 90, "right arm turn": 90}, "right forearm", "right hand", (1, 0, 0)),
        ({"left hip flexion": 90}, "left thigh", "left shin", (0, -1, 0)),
        ({"right hip spread": 45}, "right thigh", "right shin", (-(0.5**0.5), 0, -(0.5**0.5))),
        ({"left knee": 90}, "left shin", "left foot", (0, 1, 0)),
    ],
)
def test_joint_angle_turns_its_limb_the_right_way(
    skeleton: Skeleton,
    angles: dict[str, float],
    start: str,
    end: str,
    direction: tuple[float, float, float],
) -> None:
    _, joints = skeleton.pose(angles, np.eye(3), np.zeros(3))
    along = joints[BONES.index(end)] - joints[BONES.index(start)]
    np.testing.assert_allclose(along / np.linalg.norm(along), direction, atol=1e-9)


def test_spine_angles_add_up(skeleton: Skeleton) -> None:
    for name, axis in (("bend", 0), ("side", 1), ("twist", 2)):
        rotations, _ = skeleton.pose({f"spine {name}": 30}, np.eye(3), np.zeros(3))
        chest = rotations[BONES.index("thorax 2")]
        assert np.degrees(np.arccos((np.trace(chest) - 1) / 2)) == pytest.approx(30)
        assert chest[axis, axis] == pytest.approx(1)


@pytest.mark.parametrize("turn", [0.0, 35.0])
def test_standing_feet_are_where_they_were_put(skeleton: Skeleton, turn: float) -> None:
    figure = Figure(
        left_leg=Foot(0.2, 0.15, heading=20, heel=10),
        right_leg=Foot(0.1, -0.2, heading=5, height=0.1),
        drop=0.2,
        lean=15,
        roll=6,
        turn=turn,
    )
    rotations, joints = skeleton.pose(figure.angles(skeleton), *figure.pelvis(skeleton))
    rest_ankle = skeleton.positions[BONES.index("right foot")]
    ankle = joints[BONES.index("right foot")]
    np.testing.assert_allclose(ankle, [-0.1, 0.2, rest_ankle[2] + 0.1], atol=1e-9)
    ball = joints[BONES.index("left toes")] - joints[BONES.index("left foot")]
    rest_ball = np.subtract(
        *skeleton.positions[[BONES.index(f"left {n}") for n in ("toes", "foot")]]
    )
    assert ball[2] < rest_ball[2] - 0.01
    sole = rotations[BONES.index("right foot")]
    # The ankle has no axis along the shin, so a leaning shin turns the foot a little.
    assert np.degrees(np.arccos((np.trace(sole.T @ turn_z(-5.0)) - 1) / 2)) < 12


def test_skin_at_rest_is_the_template_and_moves_rigidly(template: Template) -> None:
    skin = Skin(template)
    still = np.repeat(np.eye(3)[None], len(BONES), axis=0)
    positions = template.skeleton.positions
    np.testing.assert_allclose(skin.pose(still, positions), template.vertices, atol=1e-9)
    turn = turn_z(70.0)
    turned = skin.pose(np.repeat(turn[None], len(BONES), axis=0), positions @ turn.T + [1, 2, 3])
    np.testing.assert_allclose(turned, template.vertices @ turn.T + [1, 2, 3], atol=1e-9)


def test_hands_stay_rigid_in_every_pose(poses: PoseSet, template: Template) -> None:
    hand = np.flatnonzero(template.weights[:, BONES.index("left hand")] > 0.999)
    assert len(hand) > 30
    pairs = hand[np.random.default_rng(0).integers(len(hand), size=(200, 2))]
    lengths = np.linalg.norm(
        poses.vertices[:, pairs[:, 0]] - poses.vertices[:, pairs[:, 1]], axis=2
    )
    # Fingers without relative motion cannot collide; the rest is the wrist's smoothing.
    assert np.abs(lengths - lengths[0]).max() < 1e-3


# Motions


def acceleration(body: PoseSet, frames: np.ndarray, rest: np.ndarray) -> float:
    vertices = body.vertices[frames].astype(np.float64)
    steps = np.linalg.norm(np.diff(vertices, 2, axis=0), axis=2)
    return float(steps.max() / body_size(rest))


@pytest.mark.parametrize("kind", ["body-swing", "body-jump"])
def test_motion_has_no_pops(bodies: dict[str, PoseSet], rest: np.ndarray, kind: str) -> None:
    body, frames = bodies[kind], np.arange(150)
    assert acceleration(body, frames, rest) < MAX_ACCELERATION[kind]
    step = np.linalg.norm(np.diff(body.vertices, axis=0), axis=2).max(axis=1)
    fastest = int(step.argmax())
    assert acceleration(body, np.delete(frames, fastest + 1), rest) > MAX_ACCELERATION[kind]


def test_a_foot_bears_the_dancer_at_all_times(bodies: dict[str, PoseSet], rest: np.ndarray) -> None:
    body = bodies["body-swing"]
    labels = body.vertex_labels
    assert labels is not None
    slips = []
    for side in ("left", "right"):
        sole = np.flatnonzero((labels == f"{side} foot") & (rest[:, 2] < 0.03))
        assert len(sole) >= 5
        slips.append(np.linalg.norm(np.diff(body.vertices[:, sole], axis=0), axis=2).mean(axis=1))
    assert np.minimum(*slips).max() < 0.02
    assert np.median(np.minimum(*slips)) < 1e-3
    assert np.maximum(*slips).max() > 0.05


def test_the_jump_leaves_the_floor_and_falls_as_bodies_fall(bodies: dict[str, PoseSet]) -> None:
    body = bodies["body-jump"]
    labels = body.vertex_labels
    assert labels is not None
    clearance = body.vertices[..., 2].min(axis=1)
    flight = np.flatnonzero(clearance > 0.03)
    assert 25 <= len(flight) <= 45
    assert (np.diff(flight) == 1).all()
    assert clearance.max() > 0.25
    pelvis = body.vertices[:, labels == "pelvis", 2].mean(axis=1).astype(np.float64)
    gravity = -np.diff(pelvis[flight[3:-3]], 2) * 60**2
    np.testing.assert_allclose(gravity.mean(), 9.81, rtol=0.1)
    standing = np.linalg.norm(body.vertices[-1] - body.vertices[0], axis=1)
    assert standing.max() < 0.02


# Seeds


@pytest.mark.slow
def test_a_seed_decides_the_poses(poses: PoseSet, skeleton: Skeleton) -> None:
    n_vertices = poses.vertices.shape[1]
    one, again, other = (make_body("body", n_vertices, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.vertices, again.vertices)
    np.testing.assert_array_equal(one.vertices[0], poses.vertices[0])
    for first, second in ((one, poses), (other, poses), (one, other)):
        moved = np.linalg.norm(first.vertices - second.vertices, axis=2).max(axis=1)
        assert moved[1:].min() > 5e-3
    authored, varied = (
        [body_set.joint_angles(f, skeleton) for f in body_set.figures_of("body", skeleton, seed)[1]]
        for seed in (0, 1)
    )
    turned = [
        max(abs(new[name] - old[name]) for name in old)
        for old, new in zip(authored, varied, strict=True)
    ]
    assert 0 < np.median(turned) < 15
    for angles in varied:
        assert all(
            low <= angles[name] <= high for name in angles for low, high in [limits_of(name)]
        )


def test_a_varied_motion_stays_smooth(template: Template, rest: np.ndarray) -> None:
    body = make_body("body-swing", len(template.vertices), seed=5)
    assert acceleration(body, np.arange(150), rest) < 1.2 * MAX_ACCELERATION["body-swing"]


# The extra


def test_missing_extra_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "anny", None)
    with pytest.raises(MissingExtraError) as caught:
        build_template(1000)
    assert "\n" not in str(caught.value)
    assert str(caught.value) == (
        "the built-in body needs the package anny, which is not installed; "
        "run: pip install 'lcollision[body]'"
    )


def test_importing_the_body_loads_nothing_heavy() -> None:
    code = (
        "import sys, lcollision_core.built_in_body; "
        "print([m for m in ('anny', 'torch', 'pyvista', 'vtk') if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert result.stdout.strip() == "[]"


@pytest.mark.slow
def test_reading_the_source_shapes_leaves_standard_output_in_its_place() -> None:
    """For example in a notebook, or in a program that has redirected it."""
    # anny imports that module only if its cache is empty.
    code = (
        "import io, sys\n"
        "import anny\n"
        "from lcollision_core.built_in_body.body_set import _read_anny\n"
        "read = anny.Anny\n"
        "def read_as_the_first_time(**options):\n"
        "    import anny.utils.warp_mesh_utils\n"
        "    return read(**options)\n"
        "anny.Anny = read_as_the_first_time\n"
        "mine = sys.stdout = io.StringIO()\n"
        "_read_anny()\n"
        "assert sys.stdout is mine\n"
    )
    subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


# Edge collapse


def hemisphere(n_rings: int, n_sectors: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the half x >= 0 of the unit sphere, its rim exactly at x = 0."""
    vertices, faces = [(1.0, 0.0, 0.0)], []
    for ring in range(1, n_rings + 1):
        tilt = np.pi / 2 * ring / n_rings
        x = 0.0 if ring == n_rings else np.cos(tilt)
        for sector in range(n_sectors):
            turn = 2 * np.pi * sector / n_sectors
            vertices.append((x, np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn)))
    for sector in range(n_sectors):
        after = (sector + 1) % n_sectors
        faces.append((0, 1 + sector, 1 + after))
        for ring in range(n_rings - 1):
            a, b = 1 + ring * n_sectors + sector, 1 + ring * n_sectors + after
            faces += [(a, a + n_sectors, b + n_sectors), (a, b + n_sectors, b)]
    return np.array(vertices), np.array(faces)


@pytest.mark.parametrize("n_vertices", [500, 501, 120, 61])
def test_collapse_gives_exactly_as_many_vertices_and_a_closed_whole(n_vertices: int) -> None:
    vertices, faces = hemisphere(20, 40)
    half = HalfMesh(vertices, faces, np.ones(len(vertices)))
    half.collapse_to(n_vertices)
    whole, whole_faces, mirror = mirror_whole(*half.arrays())
    assert len(whole) == n_vertices
    topology = Topology(whole_faces, n_vertices)
    assert topology.is_watertight
    assert topology.n_vertices - len(topology.edges) + topology.n_faces == 2
    np.testing.assert_array_equal(whole[mirror], whole * [-1, 1, 1])
    assert np.linalg.norm(whole, axis=1).min() > 0.95
    a, b, c = whole[whole_faces].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert 0.75 * 4 / 3 * np.pi < volume < 4 / 3 * np.pi


def test_collapse_refuses_what_it_cannot_do() -> None:
    vertices, faces = hemisphere(6, 12)
    half = HalfMesh(vertices, faces, np.ones(len(vertices)))
    with pytest.raises(ValueError, match="cannot be reduced to 3"):
        half.collapse_to(3)


def test_there_are_71_authored_poses() -> None:
    assert len(authored_poses()) == 71
