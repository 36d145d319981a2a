"""Contact on the linear path between two poses, against shapes with known paths."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.errors import MissingExtraError, ShapeError
from lcollision_core.meshes import FaceGroup
from tests.core.shapes import Mesh, box, join, random_rotation, soup, sphere

APART = [3.0, 0.0, 0.0]


def two_spheres() -> tuple[Mesh, CollisionDetector, int]:
    """Return two unit spheres with centres 3 apart, and the first one's number of vertices."""
    one = sphere()
    both = join(one, one.moved(APART))
    return both, CollisionDetector(both.topology, both.vertices), len(one.vertices)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("aside", "collides"), [(0.0, True), (1.9, True), (2.001, False), (4.0, False)]
)
def test_a_sphere_that_passes_another_hits_it_or_not(aside: float, collides: bool) -> None:
    mesh, detector, n = two_spheres()
    start, end = mesh.vertices.copy(), mesh.vertices.copy()
    start[n:] += [0.0, aside, 0.0]
    end[n:] += [-6.0, aside, 0.0]
    assert not detector.detect(start).colliding
    assert not detector.detect(end).colliding
    assert detector.collide_between(start, end) == collides
    assert detector.collide_between(end, start) == collides
    # Nothing moves, or both move equally.
    assert not detector.collide_between(start, start)
    assert not detector.collide_between(start, start + [5.0, 1.0, -3.0])


@pytest.mark.slow
def test_the_verdict_is_that_of_densely_sampled_poses() -> None:
    rng = np.random.default_rng(4)
    mesh, detector, n = two_spheres()
    verdicts = []
    for _ in range(12):
        poses = []
        for side in (1.0, -1.0):
            pose = mesh.vertices @ random_rotation(rng)
            pose[n:] += side * np.array([0.0, 2.5, rng.uniform(-2.0, 2.0)])
            poses.append(pose)
        start, end = poses
        if detector.are_colliding(np.stack(poses)).any():
            continue
        samples = np.linspace(0.0, 1.0, 200)[:, None, None]
        sampled = detector.are_colliding((1.0 - samples) * start + samples * end).any()
        assert detector.collide_between(start, end) >= sampled
        verdicts.append((sampled, detector.collide_between(start, end)))
    assert {one for one, _ in verdicts} == {True, False}
    # Only grazing contacts may differ.
    assert sum(one != other for one, other in verdicts) <= 1


def test_the_first_triangle_and_all_kinds_of_contact_count() -> None:
    floor = np.array([[-2.0, -2.0, 0.0], [3.0, -2.0, 0.0], [0.0, 3.0, 0.0]])
    falls = {
        "a corner on a face": [[0.0, 0.0, 1.0], [0.5, 0.0, 2.0], [0.0, 0.5, 2.0]],
        "a face on a corner": [[-9.0, -9.0, 1.0], [9.0, -9.0, 1.0], [0.0, 12.0, 1.0]],
        "an edge across an edge": [[0.0, -9.0, 1.0], [0.0, -1.0, 1.0], [0.0, -5.0, 9.0]],
        "beside it": [[-9.0, -9.0, 1.0], [-8.0, -9.0, 1.0], [-9.0, -8.0, 1.0]],
    }
    for kind, corners in falls.items():
        start = soup([floor, np.array(corners)])
        end = start.vertices.copy()
        end[3:, 2] -= 20.0
        detector = CollisionDetector(start.topology, start.vertices)
        assert detector.collide_between(start.vertices, end) == (kind != "beside it"), kind


def test_faces_that_share_a_vertex_and_excluded_pairs_do_not_count() -> None:
    mesh, detector, n = two_spheres()
    end = mesh.vertices.copy()
    end[n:, 0] -= 6.0
    labels = (mesh.faces[:, 0] >= n).astype(int)
    groups = [FaceGroup(name, np.flatnonzero(labels == k)) for k, name in enumerate("ab")]
    for rules in (ContactRules(ignored=(("a", "b"),)), ContactRules(left_out=("b",))):
        assert not detector.with_rules(rules, groups).collide_between(mesh.vertices, end)
    # Tolerated depths do not apply on the path.
    tolerant = detector.with_rules(ContactRules(tolerated_depth=0.5))
    assert tolerant.collide_between(mesh.vertices, end)
    # All triangles of a tetrahedron share vertices, even when it turns inside out.
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    solid = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    assert not CollisionDetector(solid.topology, corners).collide_between(corners, -corners)


@pytest.mark.slow
def test_what_crosses_at_first_by_an_excluded_pair_alone_does_not_matter() -> None:
    """Two boxes penetrate each other, which is ignored; a third passes both, or hits one."""
    stuck = join(box([0, 0, 0], [1, 1, 1]), box([0.5, 0.2, 0.2], [2, 0.8, 0.8]))
    mesh = join(stuck, box([0, 0, 3], [1, 1, 4]))
    groups = [
        FaceGroup(name, np.flatnonzero(mesh.faces[:, 0] // 8 == k)) for k, name in enumerate("abc")
    ]
    rules = ContactRules(ignored=(("a", "b"),))
    detector = CollisionDetector(mesh.topology, mesh.vertices, rules, groups)
    aside, through = mesh.vertices.copy(), mesh.vertices.copy()
    aside[16:] += [0.0, 5.0, -6.0]
    through[16:] += [0.0, 0.0, -8.0]
    assert not detector.detect(mesh.vertices).colliding
    assert not detector.collide_between(mesh.vertices, aside)
    assert detector.collide_between(mesh.vertices, through)


def test_what_touches_at_first_collides_without_a_word(capfd: pytest.CaptureFixture[str]) -> None:
    mesh = join(box([0, 0, 0], [1, 1, 1]), box([0.1, 0.1, 1], [0.9, 0.9, 2]))
    detector = CollisionDetector(mesh.topology, mesh.vertices)
    parted = mesh.vertices.copy()
    parted[8:, 2] += 1.0
    assert not detector.detect(mesh.vertices).colliding
    assert detector.collide_between(mesh.vertices, parted)
    assert detector.collide_between(mesh.vertices, mesh.vertices)
    assert detector.collide_between(parted, mesh.vertices)
    apart = mesh.vertices.copy()
    apart[8:, 2] += 1e-5
    assert not detector.collide_between(apart, parted)
    assert capfd.readouterr() == ("", "")


def test_units_and_far_places_change_nothing() -> None:
    mesh, detector, n = two_spheres()
    end = mesh.vertices.copy()
    end[n:, 0] -= 6.0
    far = np.array([1e4, -2e4, 3e3])
    assert detector.collide_between(1000.0 * mesh.vertices, 1000.0 * end, unit=0.001)
    assert detector.collide_between(mesh.vertices + far, end + far)
    passing = end + np.where(np.arange(len(end)) < n, 0.0, 3.0)[:, None] * [0.0, 1.0, 0.0]
    start = mesh.vertices + passing - end
    assert not detector.collide_between(start + far, passing + far)


def test_bad_poses_and_a_missing_extra_are_sentences(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, detector, _ = two_spheres()
    broken = mesh.vertices.copy()
    broken[3, 1] = np.nan
    with pytest.raises(ShapeError, match="not finite"):
        detector.collide_between(mesh.vertices, broken)
    with pytest.raises(ShapeError, match="vertex 3 is not finite"):
        detector.collide_between(broken, mesh.vertices)
    with pytest.raises(ShapeError, match="of shape"):
        detector.collide_between(mesh.vertices, mesh.vertices[:4])
    monkeypatch.setitem(sys.modules, "ipctk", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'lcollision\[ccd\]'"):
        CollisionDetector(mesh.topology, mesh.vertices).collide_between(
            mesh.vertices, mesh.vertices
        )
