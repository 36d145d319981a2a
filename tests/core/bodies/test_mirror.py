"""Mirror images of meshes, placements and poses, and the way back."""

from __future__ import annotations

import json
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import (
    LearnedBody,
    MirroredPose,
    NamedPose,
    Symmetry,
    read_poses,
    write_poses,
)
from lcollision_core.bodies.mirror import find_symmetry
from lcollision_core.errors import LCollisionError, ModelFileError, ShapeError
from lcollision_core.jobs import UNWATCHED
from lcollision_core.meshes import RigidTransform, Topology
from lcollision_core.posing import Pin, make_grip
from lcollision_core.resolve import ResolveOptions
from tests.core.shapes import random_rotation

OCTAHEDRON = np.array(
    [[1.0, 0, 0], [-1, 0, 0], [0, 0.8, 0], [0, -0.8, 0], [0, 0, 1.5], [0, 0, -1.5]]
)
OCTAHEDRON_FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
    dtype=np.int32,
)

FREE_THAT_COLLIDES_MIRRORED = 1
"""The free sample of the built-in body's box, generator 0, whose mirror image collides."""


@pytest.fixture(scope="module")
def body() -> LearnedBody:
    return LearnedBody.load("body")


@pytest.fixture(scope="module")
def samples(body: LearnedBody) -> np.ndarray:
    return body.latent_space.sample(6, np.random.default_rng(0))


@pytest.fixture(scope="module")
def resolved(body: LearnedBody, samples: np.ndarray) -> MirroredPose:
    return body.mirror(samples[FREE_THAT_COLLIDES_MIRRORED])


def test_the_two_sides_of_a_symmetric_mesh_are_found() -> None:
    symmetry = find_symmetry(OCTAHEDRON + [3.0, 5.0, 7.0], Topology(OCTAHEDRON_FACES, 6), up_axis=2)
    assert symmetry is not None
    assert symmetry.partner.tolist() == [1, 0, 2, 3, 4, 5]
    assert (symmetry.normal.tolist(), symmetry.offset) == ([1.0, 0.0, 0.0], 3.0)
    # With x up, only front and back (z) or left and right (y) can be exchanged.
    across = find_symmetry(OCTAHEDRON, Topology(OCTAHEDRON_FACES, 6), up_axis=0)
    assert across is not None
    assert across.partner.tolist() == [0, 1, 3, 2, 4, 5]
    assert across.normal.tolist() == [0.0, 1.0, 0.0]


def test_a_vertex_that_no_face_names_is_its_own_partner() -> None:
    stray = np.vstack([OCTAHEDRON, [90.0, 0.0, 0.0]])
    symmetry = find_symmetry(stray, Topology(OCTAHEDRON_FACES, 7), up_axis=2)
    assert symmetry is not None
    assert symmetry.partner.tolist() == [1, 0, 2, 3, 4, 5, 6]
    assert symmetry.offset == 0.0


def test_a_dented_mesh_has_no_two_sides() -> None:
    dented = OCTAHEDRON.copy()
    dented[0] *= 0.9
    dented[2] *= 0.8
    assert find_symmetry(dented, Topology(OCTAHEDRON_FACES, 6), up_axis=2) is None


def test_a_body_with_something_on_one_side_has_two_sides_all_the_same(body: LearnedBody) -> None:
    """A sword shifts the middle of the bounding box, but not that of the body."""
    axis = int(np.abs(find_exact(body).normal).argmax())
    sword = body.reference[:60] * 0.02 + np.eye(3)[axis] * 1.5 * body.body_size
    mesh = np.concatenate([body.reference, sword])
    used = np.arange(len(body.reference), len(mesh) - 2)[:, None] + np.arange(3)
    topology = Topology(np.concatenate([body.faces, used]).astype(np.int32), len(mesh))
    symmetry = find_symmetry(mesh, topology, body.up_axis)
    assert symmetry is not None
    assert symmetry.offset == pytest.approx(find_exact(body).offset, abs=1e-3 * body.body_size)
    n_same = (symmetry.partner[: len(body.reference)] == find_exact(body).partner).sum()
    assert n_same > 0.95 * len(body.reference)


def find_exact(body: LearnedBody) -> Symmetry:
    assert body.symmetry is not None
    return body.symmetry


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_image_of_a_placed_mesh_is_the_placed_image(axis: int) -> None:
    rng = np.random.default_rng(axis)
    symmetry = Symmetry(np.array([1, 0, 2, 3, 4, 5], np.int32), np.eye(3)[axis], 0.7)
    placement = RigidTransform(random_rotation(rng), rng.normal(size=3))
    mesh = rng.normal(size=(6, 3))
    image = symmetry.mirror_vertices(placement.apply(mesh))
    mirrored = symmetry.image_of_placement(placement)
    np.testing.assert_allclose(mirrored.apply(symmetry.mirror_vertices(mesh)), image, atol=1e-12)
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(symmetry.mirror_vertices(image), placement.apply(mesh), atol=1e-12)


def test_a_mirror_image_lies_where_the_mirror_shows_it(
    body: LearnedBody, samples: np.ndarray
) -> None:
    """Without alignment: the rotation that encoding removed amounted to 30 to 50 mm."""
    symmetry = body.symmetry
    assert symmetry is not None
    for latent in samples[[0, 2, 3]]:
        mirrored = body.mirror(latent)
        image = symmetry.mirror_vertices(body.decode(latent))
        distance = np.linalg.norm(body.decode(mirrored.latent) - image, axis=1) / body.body_size
        assert mirrored.placement is None
        assert distance.mean() == pytest.approx(mirrored.fit_error_mean, rel=1e-6)
        assert distance.max() == pytest.approx(mirrored.fit_error_max, rel=1e-6)
        assert distance.mean() < 0.008
        # Even if the original is not remembered.
        again = body.mirror(mirrored.latent)
        assert not again.restored
        back = np.linalg.norm(body.decode(again.latent) - body.decode(latent), axis=1)
        assert back.mean() / body.body_size < 0.006


@pytest.mark.parametrize("name", ["right side lunge", "twist right", "rest"])
def test_mirrored_poses_are_as_near_as_unseen_ones(body: LearnedBody, name: str) -> None:
    """Compared in place, while the held-out error is after the best rigid fit."""
    metrics = body.embedding.metrics
    assert metrics is not None
    assert metrics.held_out_mean is not None
    assert metrics.held_out_max is not None
    latent = body.known_poses[body.card.pose_names.index(name)]
    mirrored = body.mirror(latent)
    assert mirrored.fit_error_mean < 1.5 * metrics.held_out_mean
    assert mirrored.fit_error_max < metrics.held_out_max
    # Mirroring changes the pose unless its sides are equal.
    moved = np.linalg.norm(body.decode(mirrored.latent) - body.decode(latent), axis=1)
    assert (moved.mean() / body.body_size > 10.0 * metrics.held_out_mean) == (name != "rest")


def test_mirroring_twice_gives_pose_and_place_back_to_the_bit(
    body: LearnedBody, samples: np.ndarray
) -> None:
    rng = np.random.default_rng(3)
    placement = RigidTransform(random_rotation(rng), rng.normal(0, 100, 3))
    once = body.mirror(samples[0], placement)
    assert once.placement is not None
    symmetry = body.symmetry
    assert symmetry is not None
    image = symmetry.mirror_vertices(placement.apply(body.decode(samples[0])))
    placed = once.placement.apply(body.decode(once.latent))
    distance = np.linalg.norm(placed - image, axis=1) / body.body_size
    assert distance.mean() == pytest.approx(once.fit_error_mean, rel=1e-6)

    twice = body.mirror(once.latent, once.placement, once.source)
    assert twice.restored
    assert twice.latent.tobytes() == samples[0].tobytes()
    assert twice.placement is not None
    assert twice.placement.rotation.tobytes() == placement.rotation.tobytes()
    assert twice.placement.translation.tobytes() == placement.translation.tobytes()
    # A third mirroring gives the same image again.
    thrice = body.mirror(twice.latent, twice.placement, twice.source)
    assert thrice.restored
    assert thrice.latent.tobytes() == once.latent.tobytes()

    moved = once.latent.copy()
    moved[0] = np.nextafter(moved[0], 1.0)
    assert not body.mirror(moved, once.placement, once.source).restored
    assert not body.mirror(once.latent, None, once.source).restored


def test_a_free_pose_that_collides_mirrored_is_resolved(
    body: LearnedBody, resolved: MirroredPose
) -> None:
    assert resolved.pairs_before == 0 < resolved.pairs_mirrored
    assert resolved.pairs_after == 0
    assert not resolved.collides_newly
    assert resolved.resolution is not None
    np.testing.assert_array_equal(resolved.latent, resolved.resolution.latent)
    vertices = body.exported_vertices(resolved.latent)
    assert not body.detector.detect(vertices).colliding
    symmetry = body.symmetry
    assert symmetry is not None
    # The fit error is that of the returned, resolved pose.
    image = symmetry.mirror_vertices(body.decode(resolved.source.latent))
    distance = np.linalg.norm(body.decode(resolved.latent) - image, axis=1) / body.body_size
    assert resolved.fit_error_mean == pytest.approx(distance.mean(), rel=1e-6)
    assert body.mirror(resolved.latent, None, resolved.source).restored


def test_locked_domains_keep_what_they_have_in_the_mirror(
    body: LearnedBody, samples: np.ndarray, resolved: MirroredPose
) -> None:
    pose = samples[FREE_THAT_COLLIDES_MIRRORED]
    every = frozenset(range(len(body.domain_names)))
    stuck = body.mirror(pose, options=ResolveOptions(locked_domains=every))
    assert stuck.collides_newly
    assert stuck.pairs_after == stuck.pairs_mirrored == resolved.pairs_mirrored
    assert stuck.resolution is not None
    assert stuck.resolution.exactly_free is False
    codes = body.latent_space.groups[1].codes
    locked = body.mirror(pose, options=ResolveOptions(locked_domains=frozenset({0})))
    assert locked.pairs_after == 0
    np.testing.assert_array_equal(locked.latent[codes], stuck.latent[codes])
    assert not np.array_equal(locked.latent, stuck.latent)


def test_without_a_predictor_a_lost_freedom_is_told(
    body: LearnedBody, samples: np.ndarray, resolved: MirroredPose
) -> None:
    bare = LearnedBody(body.name, body.embedding, body.card)
    mirrored = bare.mirror(samples[FREE_THAT_COLLIDES_MIRRORED])
    assert mirrored.collides_newly
    assert mirrored.resolution is None
    assert mirrored.pairs_after == resolved.pairs_mirrored


def test_a_colliding_pose_is_mirrored_as_it_is(body: LearnedBody, samples: np.ndarray) -> None:
    mirrored = body.mirror(samples[2])
    assert mirrored.pairs_before > 0
    assert mirrored.pairs_after == mirrored.pairs_mirrored > 0
    assert mirrored.resolution is None
    assert not mirrored.collides_newly


def test_a_model_without_two_sides_says_so(tube_model: LearnedBody) -> None:
    curled = copy(tube_model)
    x, y, z = tube_model.reference.T
    size = tube_model.body_size
    curled.reference = np.stack([x + y**2 / size, y, z + 0.5 * x * y / size + y**3 / size**2], 1)
    curled.__dict__.pop("symmetry", None)
    assert curled.symmetry is None
    with pytest.raises(LCollisionError, match="left and right cannot be told apart"):
        curled.mirror(np.zeros(tube_model.latent_size))


def test_a_learned_body_with_something_on_one_side_is_mirrored(
    body: LearnedBody, samples: np.ndarray
) -> None:
    """As if its sides had different triangulations, and one shoulder a plate."""
    plate = body.reference.copy()
    axis = int(np.abs(find_exact(body).normal).argmax())
    high = plate[:, body.up_axis] - plate[:, body.up_axis].min() > 0.75 * body.body_size
    plate[high & (plate[:, axis] > find_exact(body).offset + 0.1 * body.body_size), axis] *= 1.3
    other = copy(body)
    other.reference = plate
    for cached in ("symmetry", "pose_mirror"):
        other.__dict__.pop(cached, None)
    assert not np.array_equal(find_exact(other).partner, find_exact(body).partner)
    found, expected = (one.pose_mirror.mirror_part(samples[0], 0) for one in (other, body))
    assert found.shape == expected.shape
    image, exact = (
        one.pose_mirror.nearest(
            find_exact(one).mirror_vertices(body.decode(samples[0])) / body.body_size, UNWATCHED
        )
        for one in (other, body)
    )
    off = np.linalg.norm(body.decode(image) - body.decode(exact), axis=1) / body.body_size
    assert off.mean() < 0.02


def test_what_is_no_pose_is_refused(body: LearnedBody) -> None:
    for wrong in (np.zeros(3), np.zeros((2, body.latent_size)), np.full(body.latent_size, np.nan)):
        with pytest.raises(ShapeError):
            body.mirror(wrong)


def mirror_image(body: LearnedBody, pose: NamedPose) -> NamedPose:
    image = body.mirror(pose.latent, pose.placement, pose.mirror_of)
    return pose.mirrored(image, body.pose_mirror.symmetry)


@pytest.fixture
def images(body: LearnedBody, samples: np.ndarray) -> list[NamedPose]:
    placement = RigidTransform(random_rotation(np.random.default_rng(8)), np.ones(3))
    poses = [
        NamedPose("here", samples[0], tags=("kept",)),
        NamedPose("there", samples[4], placement, 0.01, 0.02),
    ]
    return [mirror_image(body, pose) for pose in poses]


def test_a_file_of_poses_remembers_what_they_were_mirrored_from(
    body: LearnedBody, samples: np.ndarray, images: list[NamedPose], tmp_path: Path
) -> None:
    path = tmp_path / "images.json"
    write_poses(path, body, images)
    read = read_poses(path, body)
    assert read[0].tags == ("kept",)
    assert read[1].fit_error_mean == images[1].fit_error_mean
    for pose, latent in zip(read, samples[[0, 4]], strict=True):
        back = mirror_image(body, pose)
        assert back.latent.tobytes() == latent.tobytes()
        assert back.fit_error_mean is None
        assert (back.placement is None) == (pose.placement is None)


def test_pins_are_mirrored_to_the_other_side(body: LearnedBody, samples: np.ndarray) -> None:
    symmetry, vertices = body.pose_mirror.symmetry, body.decode(samples[0])
    grips = [make_grip(body.space, vertex) for vertex in (5, 1200)]
    pose = NamedPose(
        "pinned", samples[0], pins=tuple(Pin.of(grip, vertices, [7]) for grip in grips)
    )
    image = mirror_image(body, pose)
    assert {pin.frame[0][0] for pin in image.pins} == {int(symmetry.partner[7])}
    reflected = symmetry.mirror_vertices(vertices)
    for pin, grip in zip(image.pins, grips, strict=True):
        partner = make_grip(body.space, pin.vertex, pin.radius)
        assert pin.vertex == symmetry.partner[grip.vertex] != grip.vertex
        np.testing.assert_allclose(
            pin.position, partner.position(reflected), atol=1e-3 * body.body_size
        )
    assert [pin.vertex for pin in mirror_image(body, image).pins] == [5, 1200]


def test_a_pose_that_was_changed_forgets_it(
    body: LearnedBody, images: list[NamedPose], tmp_path: Path
) -> None:
    path = tmp_path / "images.json"
    write_poses(path, body, [replace(images[0], latent=np.zeros(body.latent_size)), images[1]])
    document = json.loads(path.read_text())
    assert "mirror_of" not in document["poses"][0]
    document["poses"][1]["latent"][3] += 0.25
    path.write_text(json.dumps(document))
    assert all(pose.mirror_of is None for pose in read_poses(path, body))


@pytest.mark.variants(2)
@pytest.mark.parametrize(
    "damage",
    [
        lambda entry: entry.update(mirror_of=[]),
        lambda entry: entry["mirror_of"].pop("latent"),
        lambda entry: entry["mirror_of"].update(latent=[1.0]),
        lambda entry: entry["mirror_of"].update(image=7),
        lambda entry: entry["mirror_of"].update(placement={"rotation": [], "translation": []}),
    ],
)
def test_a_damaged_source_is_refused(
    body: LearnedBody, images: list[NamedPose], tmp_path: Path, damage: object
) -> None:
    path = tmp_path / "images.json"
    write_poses(path, body, images)
    document = json.loads(path.read_text())
    assert callable(damage)
    damage(document["poses"][0])
    path.write_text(json.dumps(document))
    with pytest.raises(ModelFileError, match="damaged at pose 0"):
        read_poses(path, body)


def test_a_part_on_the_other_side_becomes_like_the_mirror_image(body: LearnedBody) -> None:
    mirror, names = body.pose_mirror, body.domain_names
    left, right = names.index("left shin & foot"), names.index("right shin & foot")
    assert (mirror.partner(left), mirror.partner(right)) == (right, left)
    assert mirror.partner(names.index("head")) is None
    pose = body.known_poses[np.abs(body.known_poses).sum(axis=1).argmax()].astype(float)
    after = mirror.mirror_part(pose, left)
    changed = after != pose
    assert changed.any()
    assert not changed[~body.embedding.codes_of([right])].any()
    inside = body.space.vertex_domain == right
    image = mirror.symmetry.mirror_vertices(body.decode(pose))
    shapes = [vertices[inside] for vertices in (body.decode(pose), body.decode(after), image)]
    before, now, wanted = (shape - shape.mean(axis=0) for shape in shapes)
    assert np.linalg.norm(now - wanted) < 0.4 * np.linalg.norm(before - wanted)
