"""Round trips, consistency and array shapes of deformation features, on analytic shapes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from lcollision_core.acap.codec import BLOCK_POSES, AcapCodec
from lcollision_core.errors import CancelledError, ShapeError
from lcollision_core.jobs import Job
from tests.core.acap.jumps import n_jumps
from tests.core.shapes import Mesh, grid, join, random_rotation, sphere, torus

FloatArray = npt.NDArray[np.float64]

IDENTITY_FEATURE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0)


def straight_tube(radius: float, rings: int, sides: int = 12) -> Mesh:
    """Make an open tube of length 1 along z."""
    angles = 2 * np.pi * np.arange(sides) / sides
    z = np.linspace(0.0, 1.0, rings)
    vertices = np.stack(
        [
            np.tile(radius * np.cos(angles), rings),
            np.tile(radius * np.sin(angles), rings),
            np.repeat(z, sides),
        ],
        axis=1,
    )
    ring, side = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    corner = (ring * sides + side).ravel()
    beside = (ring * sides + (side + 1) % sides).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, beside, beside + sides], axis=1),
            np.stack([corner, beside + sides, corner + sides], axis=1),
        ]
    )
    return Mesh(vertices, faces.astype(np.int32))


def twisted(mesh: Mesh, angle_at: Callable[[FloatArray], FloatArray]) -> FloatArray:
    x, y, z = mesh.vertices.T
    angle = angle_at(z)
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)


def bent(mesh: Mesh, angle: float) -> FloatArray:
    """Bend the tube along z into an arc of `angle` radians about the y axis."""
    x, y, z = mesh.vertices.T
    turn = angle * z
    distance = 1.0 / angle - x
    return np.stack([1.0 / angle - distance * np.cos(turn), y, distance * np.sin(turn)], axis=1)


def codec_of(mesh: Mesh) -> AcapCodec:
    return AcapCodec(mesh.topology, mesh.vertices, np.ones(len(mesh.vertices)))


def round_trip_error(codec: AcapCodec, pose: FloatArray) -> float:
    """Return the largest vertex error up to a translation, in the pose's unit."""
    rebuilt = codec.decode(codec.encode(pose[None]))[0]
    error = (rebuilt - rebuilt.mean(axis=0)) - (pose - pose.mean(axis=0))
    return float(np.linalg.norm(error, axis=1).max())


@pytest.mark.parametrize("mesh", [sphere(n=16), grid(6), torus(1.0, 0.3)])
def test_reference_has_identity_features(mesh: Mesh) -> None:
    features = codec_of(mesh).encode(mesh.vertices[None])
    assert features[0] == pytest.approx(
        np.broadcast_to(IDENTITY_FEATURE, features[0].shape), abs=1e-9
    )


@pytest.mark.parametrize("mesh", [sphere(n=16), grid(6), torus(1.0, 0.3)])
def test_rigid_motion_with_scale_returns_exactly(mesh: Mesh) -> None:
    codec = codec_of(mesh)
    for seed in range(5):
        rotation = random_rotation(np.random.default_rng(seed))
        pose = 1.7 * mesh.vertices @ rotation.T + [3.0, -2.0, 5.0]
        assert round_trip_error(codec, pose) < 1e-9


def test_rigid_motion_gives_every_vertex_the_same_rotation_vector() -> None:
    mesh = sphere(n=16)
    axis, angle = np.array([2.0, -1.0, 2.0]) / 3.0, 2.5
    cross = np.cross(np.eye(3), axis)
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    features = codec_of(mesh).encode((mesh.vertices @ rotation.T)[None])
    expected = np.broadcast_to(angle * axis, (len(mesh.vertices), 3))
    assert features[0, :, :3] == pytest.approx(expected, abs=1e-9)


def test_a_cancelled_job_ends_encoding_after_a_block() -> None:
    mesh = sphere()
    poses = np.repeat(mesh.vertices[None], 10 * BLOCK_POSES, axis=0)
    done: list[int] = []

    def on_report(n_done: int, n_poses: int) -> None:
        assert n_poses == len(poses)
        done.append(n_done)
        job.cancel()

    job = Job(on_report)
    with pytest.raises(CancelledError):
        codec_of(mesh).encode(poses, 1, job)
    assert done == [BLOCK_POSES]


def test_flat_stretch_is_exact_and_is_the_stretch() -> None:
    mesh = grid(6)
    codec = codec_of(mesh)
    pose = mesh.vertices @ np.array([[1.5, 0.2, 0.0], [0.2, 0.8, 0.0], [0.0, 0.0, 1.0]])
    stretch = codec.encode(pose[None])[0]
    assert stretch[:, :3] == pytest.approx(np.zeros((49, 3)), abs=1e-9)
    assert stretch[:, [3, 4, 6]] == pytest.approx(
        np.broadcast_to([1.5, 0.2, 0.8], (49, 3)), abs=1e-9
    )
    assert stretch[:, [5, 7]] == pytest.approx(np.zeros((49, 2)), abs=1e-9)
    assert round_trip_error(codec, pose) < 1e-9


def test_stretched_sphere_returns_closely() -> None:
    mesh = sphere(n=24)
    pose = mesh.vertices * [1.3, 1.0, 0.8]
    assert round_trip_error(codec_of(mesh), pose) < 5e-3


def test_pose_turned_inside_out_returns_closely() -> None:
    mesh = sphere(n=24)
    # Edges are negated but normals are not: half a turn about the normal at every vertex.
    pose = -mesh.vertices
    codec = codec_of(mesh)
    angles = np.linalg.norm(codec.encode(pose[None])[0, :, :3], axis=1)
    assert np.median(angles) == pytest.approx(np.pi, abs=0.05)
    assert round_trip_error(codec, pose) < 0.1


@pytest.mark.parametrize("degrees", [90, 170, 179, 180, 181, 190, 270, 350])
def test_bent_tube_goes_right_through_half_a_turn(degrees: float) -> None:
    tube = straight_tube(0.05, 60)
    pose = bent(tube, np.radians(degrees))
    codec = codec_of(tube)
    features = codec.encode(pose[None])
    assert n_jumps(features, tube.topology) == [0]
    logs = features[0, :, :3].reshape(60, 12, 3)
    bend = logs[..., 1].mean(axis=1)
    assert bend[-1] - bend[0] == pytest.approx(np.radians(degrees), rel=0.03)
    assert (np.diff(bend) > 0.0).all()
    assert np.abs(logs[..., [0, 2]]).max() < 0.3
    assert round_trip_error(codec, pose) < 1e-3


@pytest.mark.parametrize("turns", [0.5, 1.0, 1.5, 1.9])
def test_tube_rolled_at_its_end_keeps_its_axis(turns: float) -> None:
    """Like a forearm: most of the tube stays, and the last third is twisted."""
    tube = straight_tube(0.01, 81)
    pose = twisted(tube, lambda z: 2 * np.pi * turns * np.clip((z - 0.6) / 0.3, 0.0, 1.0))
    codec = codec_of(tube)
    features = codec.encode(pose[None])
    logs = features[0, :, :3].reshape(81, 12, 3)
    assert np.abs(logs[:40]).max() < 1e-5
    # At exactly a full turn, the rolled end's axis is undetermined, so it is not compared.
    if turns != 1.0:
        assert logs[-5:] == pytest.approx(
            np.broadcast_to([0.0, 0.0, 2 * np.pi * turns], (5, 12, 3)), abs=1e-2
        )
    assert round_trip_error(codec, pose) < 1e-3


def test_tube_twisted_twice_is_wound_all_the_way() -> None:
    tube = straight_tube(0.03, 80)
    pose = twisted(tube, lambda z: 4 * np.pi * z)
    codec = codec_of(tube)
    features = codec.encode(pose[None])
    wound = features[0, :, 2].reshape(80, 12).mean(axis=1)
    # At both rims the angle exceeds a full turn, and the surface's shear determines the axis.
    inner = slice(6, -6)
    expected = 4 * np.pi * np.linspace(0.0, 1.0, 80)[inner]
    offset = wound[inner] - expected
    assert np.ptp(offset) < 0.5
    assert np.ptp(features[0, :, 2].reshape(80, 12)[inner], axis=1).max() < 0.2
    assert round_trip_error(codec, pose) < 1e-3


def test_half_the_features_of_a_twist_are_half_the_twist() -> None:
    tube = straight_tube(0.01, 80)
    codec = codec_of(tube)
    whole = codec.encode(twisted(tube, lambda z: 3 * np.pi * (z - 0.5))[None])
    middle = 0.5 * (whole + codec.encode(tube.vertices[None]))
    half = twisted(tube, lambda z: 1.5 * np.pi * (z - 0.5))
    error = codec.decode(middle)[0] - half
    error -= error.mean(axis=0)
    assert np.linalg.norm(error, axis=1).max() < 1e-3


def test_features_do_not_depend_on_where_the_pose_lies() -> None:
    tube = straight_tube(0.1, 20)
    codec = codec_of(tube)
    pose = bent(tube, 1.0)
    near, far = codec.encode(np.stack([pose, pose + [5.0, -7.0, 2.0]]))
    assert far == pytest.approx(near, abs=1e-9)


def test_scaling_pose_and_reference_together_changes_nothing() -> None:
    tube = straight_tube(0.1, 20)
    pose = bent(tube, 1.0)
    small = codec_of(Mesh(1e-3 * tube.vertices, tube.faces)).encode(1e-3 * pose[None])
    large = codec_of(Mesh(1e3 * tube.vertices, tube.faces)).encode(1e3 * pose[None])
    assert small == pytest.approx(large, abs=1e-8)


def test_batches_and_threads_change_no_bit() -> None:
    tube = straight_tube(0.1, 20)
    codec = codec_of(tube)
    poses = np.stack([bent(tube, angle) for angle in np.linspace(0.1, 3.0, 19)])
    features = codec.encode(poses, n_threads=1)
    vertices = codec.decode(features, n_threads=1)
    assert np.array_equal(codec.encode(poses, n_threads=3), features)
    assert np.array_equal(codec.decode(features, n_threads=3), vertices)
    for pose in range(len(poses)):
        one = slice(pose, pose + 1)
        assert np.array_equal(codec.encode(poses[one])[0], features[pose])
        assert np.array_equal(codec.decode(features[one])[0], vertices[pose])
    assert codec.encode(poses[:0]).shape == (0, 240, 9)
    assert codec.decode(features[:0]).shape == (0, 240, 3)


def test_inputs_are_left_alone_and_other_dtypes_accepted() -> None:
    tube = straight_tube(0.1, 20)
    codec = codec_of(tube)
    pose = bent(tube, 1.0)[None].astype(np.float32)
    pose.flags.writeable = False
    features = codec.encode(pose)
    assert features.dtype == np.float64
    features = features.astype(np.float32)
    features.flags.writeable = False
    assert codec.decode(features)[0] == pytest.approx(codec.decode(features)[0], abs=1e-5)


def test_weighted_mean_vertex_stays_where_the_reference_has_it() -> None:
    tube = straight_tube(0.1, 20)
    weights = np.where(tube.vertices[:, 2] < 0.3, 1.0, 0.0)
    features = codec_of(tube).encode(bent(tube, 1.0)[None])
    even = codec_of(tube).decode(features)[0]
    led = AcapCodec(tube.topology, tube.vertices, weights).decode(features)[0]
    assert even.mean(axis=0) == pytest.approx(tube.vertices.mean(axis=0), abs=1e-12)
    assert np.average(led, axis=0, weights=weights) == pytest.approx(
        np.average(tube.vertices, axis=0, weights=weights), abs=1e-12
    )
    shift = led - even
    assert np.ptp(shift, axis=0).max() < 1e-12
    assert np.abs(shift).max() > 0.01


def test_loose_parts_follow_the_body() -> None:
    body = sphere(n=16)
    left = sphere(0.1, 8).moved([1.15, 0.3, 0.0])
    right = sphere(0.1, 8).moved([1.15, -0.3, 0.0])
    mesh = join(left, body, right)
    codec = codec_of(mesh)
    pose = mesh.vertices @ random_rotation(np.random.default_rng(3)).T
    features = codec.encode(pose[None])
    assert n_jumps(features, mesh.topology) == [0]
    rebuilt = codec.decode(features)[0]
    moved = pose + (rebuilt - pose).mean(axis=0)
    assert rebuilt == pytest.approx(moved, abs=1e-9)


def test_vertex_in_no_face_is_decoded_amid_the_others() -> None:
    mesh = sphere(n=12)
    vertices = np.concatenate([[[9.0, 9.0, 9.0]], mesh.vertices, [[7.0, 7.0, 7.0]]])
    codec = codec_of(Mesh(vertices, mesh.faces + 1))
    pose = 1.2 * vertices @ random_rotation(np.random.default_rng(1)).T
    features = codec.encode(pose[None])
    assert features[0, [0, -1]] == pytest.approx(np.array([IDENTITY_FEATURE] * 2), abs=0.0)
    rebuilt = codec.decode(features)[0]
    assert rebuilt[[0, -1]] == pytest.approx(np.tile(mesh.vertices.mean(axis=0), (2, 1)), abs=1e-12)
    inner = rebuilt[1:-1] - rebuilt[1:-1].mean(axis=0)
    assert inner == pytest.approx(pose[1:-1] - pose[1:-1].mean(axis=0), abs=1e-9)


def test_single_triangle_returns_exactly() -> None:
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.2, 0.7, 0.0]])
    codec = codec_of(Mesh(vertices, np.array([[0, 1, 2]], np.int32)))
    pose = np.array([[0.0, 0.0, 1.0], [1.3, 0.1, 0.0], [0.0, 0.5, 0.4]])
    assert round_trip_error(codec, pose) < 1e-9


def test_degenerate_reference_and_pose_stay_finite() -> None:
    mesh = sphere(n=12)
    collapsed = mesh.vertices.copy()
    collapsed[5] = collapsed[6]
    codec = codec_of(Mesh(collapsed, mesh.faces))
    features = codec.encode(mesh.vertices[None])
    assert np.isfinite(features).all()
    assert np.isfinite(codec.decode(features)).all()
    point = codec_of(mesh).encode(np.zeros((1, *mesh.vertices.shape)))
    assert np.isfinite(point).all()
    assert np.ptp(codec_of(mesh).decode(point), axis=1).max() < 1e-9


def test_huge_coordinates_do_no_harm() -> None:
    tube = straight_tube(0.1, 20)
    codec = codec_of(tube)
    assert codec.encode(1e300 * tube.vertices[None]).shape == (1, 240, 9)


@pytest.mark.parametrize("shape", [(240, 3), (1, 239, 3), (1, 240, 9)])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    codec = codec_of(straight_tube(0.1, 20))
    with pytest.raises(ShapeError, match=r"vertices must be of shape \(B, 240, 3\)"):
        codec.encode(np.zeros(shape))
