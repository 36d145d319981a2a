"""Proposed ignored groups: those in contact in nearly every pose, with their share."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.contact import (
    CollisionDetector,
    ContactRules,
    ProposedPair,
    propose_by_kind,
    touching_patches,
)
from lcollision_core.errors import CancelledError, ShapeError
from lcollision_core.jobs import Job
from lcollision_core.meshes import (
    GROUP_KINDS,
    FaceGroup,
    component_groups,
    groups_by_kind,
    part_groups,
)
from lcollision_core.meshes.face_groups import MAX_GROUPS
from tests.core.shapes import Mesh, join, soup, strip
from tests.independent_check import IndependentRules

FLOOR = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
BLADE = [[1, 1, -1], [1, 1, 1], [2, 1, 1]]
POST = [[0.5, 0.5, -1], [0.5, 0.5, 1], [0.6, 0.5, 1]]
MESH = soup([FLOOR, BLADE, POST])
"""The blade and the post penetrate the floor, but not each other."""
FLOOR_GROUP, BLADE_GROUP, POST_GROUP = (
    FaceGroup(name, np.array([n])) for n, name in enumerate(("floor", "blade", "post"))
)
GROUPS = (FLOOR_GROUP, BLADE_GROUP, POST_GROUP)


def poses() -> np.ndarray:
    """Return 10 poses; in two of them the blade is out of the floor."""
    moved = np.stack([MESH.vertices] * 10)
    moved[:2, 3:6] += [0.0, 0.0, 5.0]
    return moved


def detector(rules: ContactRules | None = None) -> CollisionDetector:
    return CollisionDetector(MESH.topology, MESH.vertices, rules or ContactRules(), GROUPS)


def proposed(
    detector: CollisionDetector, poses: np.ndarray, groups: tuple[FaceGroup, ...], *share: float
) -> tuple[ProposedPair, ...]:
    """Return the proposals among groups of one kind."""
    return propose_by_kind(detector, poses, {"all": groups}, *share)["all"]


def test_contacts_are_proposed_with_their_share() -> None:
    always = ProposedPair(("floor", "post"), 1.0)
    often = ProposedPair(("floor", "blade"), 0.8)
    assert proposed(detector(), poses(), GROUPS) == (always,)
    assert proposed(detector(), poses(), GROUPS, 0.8) == (always, often)
    assert proposed(detector(), poses(), GROUPS, 0.81) == (always,)


def test_what_is_excluded_at_rest_or_ignored_is_in_contact_too() -> None:
    for rules in (ContactRules(rest_exclusion=0.0), ContactRules(ignored=(("post", "floor"),))):
        found = proposed(detector(rules), poses(), GROUPS)
        assert [proposal.groups for proposal in found] == [("floor", "post")]


def test_folds_of_the_skin_are_no_contact() -> None:
    loop = strip(
        [[0, 0], [2, 0], [4, 0], [4, 2], [3, 3], [1.5, 1.5], [0, -1], [0, -2], [0, -3]]
    )  # fmt: skip
    straight = strip([[x, 0.0] for x in range(9)])
    groups = (FaceGroup("start", np.array([0, 1])), FaceGroup("end", np.arange(10, 16)))
    for near, n_found in ((0.0, 1), (2.0, 0)):
        bent = CollisionDetector(straight.topology, straight.vertices, ContactRules(near))
        assert len(proposed(bent, loop.vertices[None], groups)) == n_found


def test_groups_that_overlap_or_are_equal_are_not_proposed() -> None:
    everything = FaceGroup("mesh", np.array([0, 1, 2]))
    again = FaceGroup("post's material", np.array([2]))
    found = proposed(detector(), poses(), (everything, *GROUPS, again))
    assert [proposal.groups for proposal in found] == [("floor", "post")]
    assert proposed(detector(), poses(), (everything,)) == ()


def test_components_and_parts_are_groups() -> None:
    sheet = strip([[x, 0.0] for x in range(4)])
    mesh = Mesh(
        np.concatenate([MESH.vertices, sheet.vertices + 9.0]),
        np.concatenate([MESH.faces, sheet.faces + 9]),
    )
    components = component_groups(mesh.topology)
    assert [group.name for group in components] == [f"component {n}" for n in range(1, 5)]
    assert components[0].faces.tolist() == [3, 4, 5, 6, 7, 8]
    assert [group.faces.tolist() for group in components[1:]] == [[0], [1], [2]]
    parts = part_groups(MESH.topology, np.array(["a", "b", "b", *"acc", *"abc"]))
    assert {group.name: group.faces.tolist() for group in parts} == {"a": [2], "b": [0], "c": [1]}


def test_bad_groups_are_refused_and_cancelling_is_heard() -> None:
    with pytest.raises(ShapeError, match="the group 'far' must be of faces from 0 to 2, got 3"):
        proposed(detector(), poses(), (*GROUPS, FaceGroup("far", np.array([3]))))
    job = Job()
    job.cancel()
    with pytest.raises(CancelledError):
        propose_by_kind(detector(), poses(), {"all": GROUPS}, job=job)


def test_groups_are_told_apart_by_kind_also_where_the_mesh_lists_them() -> None:
    labels = np.array(["left"] * 3 + ["right"] * 6)
    parts, components = part_groups(MESH.topology, labels), component_groups(MESH.topology)
    # A mesh with the name of a body part denotes itself.
    mesh = FaceGroup("left", np.array([2]))
    kinds = groups_by_kind((mesh, parts[1], components[0]), MESH.topology, labels)
    names = {kind: [group.name for group in groups] for kind, groups in kinds.items()}
    assert names == dict(
        zip(GROUP_KINDS, [["left"], ["right"], [g.name for g in components]], strict=True)
    )
    assert groups_by_kind((), MESH.topology)["body parts"] == ()


def test_proposals_of_each_kind_are_those_of_it_alone() -> None:
    kinds = {"meshes": GROUPS, "components": component_groups(MESH.topology), "none": ()}
    steps: list[tuple[int, int]] = []
    found = propose_by_kind(
        detector(), poses(), kinds, 0.8, job=Job(lambda *step: steps.append(step))
    )
    alone = {kind: proposed(detector(), poses(), kinds[kind], 0.8) for kind in kinds}
    assert found == alone
    assert [len(pairs) for pairs in found.values()] == [2, 2, 0]
    assert steps[-1] == (10, 10)


def test_of_very_many_groups_the_first_are_looked_at() -> None:
    many = (*GROUPS, *(FaceGroup(f"copy {n}", np.array([n % 3])) for n in range(MAX_GROUPS)))
    found = propose_by_kind(detector(), poses(), {"meshes": many})
    assert found["meshes"] == (ProposedPair(("floor", "post"), 1.0),)


def sliding(n_poses: int, n_touching: int) -> tuple[Mesh, np.ndarray]:
    """Return a band over a plate, and poses; in some, the band's middle dips into the plate."""
    plate, band = strip([[x, 0.0] for x in range(21)]), strip([[x + 0.1, 0.3] for x in range(21)])
    mesh = join(plate, band)
    poses = np.stack([mesh.vertices] * n_poses)
    of_band = np.arange(len(plate.vertices), len(mesh.vertices))
    dipping = of_band[np.abs(mesh.vertices[of_band, 0] - 10.0) < 1.5]
    poses[:n_touching, dipping, 2] -= 0.6
    return mesh, poses


def test_patches_that_touch_in_nearly_every_pose_are_found_and_nothing_else() -> None:
    mesh, poses = sliding(20, 19)
    detector = CollisionDetector(mesh.topology, mesh.vertices)
    # In one pose, the band also dips far from there.
    poses[3, 42 + 2 * 3 : 42 + 2 * 5, 2] -= 0.6
    pairs = touching_patches(detector, poses, 0.1)
    assert 0 < len(pairs) < 6
    middle = mesh.vertices[mesh.faces][:, :, 0].mean(axis=1)
    assert (np.abs(middle[np.array(pairs)] - 10.0) < 4.0).all()
    rules = ContactRules(touching=pairs, touching_radius=0.1)
    ruled = detector.with_rules(rules)
    assert ruled.are_colliding(poses).tolist() == [pose == 3 for pose in range(20)]
    # By independent code, each patch is in contact in 19 of 20 poses.
    applied = IndependentRules(mesh.vertices, mesh.faces, [], rules.to_json(), {})
    radius = 0.1 * detector.body_size
    for pair in pairs:
        one, two = (applied._faces_around(face, radius) for face in pair)
        in_contact = [
            any((a in one and b in two) or (b in one and a in two) for a, b in found.pairs.tolist())
            for found in map(detector.detect, poses)
        ]
        assert sum(in_contact) == 19
    # Rarer contacts are not proposed, nor those that a rule already excludes.
    assert touching_patches(detector, sliding(20, 18)[1], 0.1) == ()
    assert touching_patches(ruled, np.delete(poses, 3, axis=0), 0.1) == ()
    with pytest.raises(ShapeError, match="must be of faces of this mesh, got 500"):
        detector.with_rules(ContactRules(touching=((0, 500),)))


def test_places_of_pieces_that_touch_in_nearly_every_pose_are_found_where_asked() -> None:
    """The band touches the plate in every pose, at changing places, like a shield in a hand."""
    mesh, poses = sliding(20, 20)
    detector = CollisionDetector(mesh.topology, mesh.vertices)
    # In 8 poses it dips in elsewhere, but at each place in too few of them.
    straight = mesh.vertices[42:]
    for pose in range(8):
        poses[pose, 42:] = straight
        poses[pose, 42 + 2 * (2 * pose) : 42 + 2 * (2 * pose + 2), 2] -= 0.6
    assert detector.are_colliding(poses).all()
    assert touching_patches(detector, poses, 0.1) == ()
    pairs = touching_patches(detector, poses, 0.1, of_pieces=True)
    middle = mesh.vertices[mesh.faces][:, :, 0].mean(axis=1)
    assert len(pairs) > 0
    assert (np.abs(middle[np.array(pairs)] - 10.0) < 5.0).all()
    # On the reference, the band is away from the plate: it touches only in poses.
    raised = mesh.vertices.copy()
    raised[42 + 2 * 8 : 42 + 2 * 14, 2] += 7.0
    apart = CollisionDetector(mesh.topology, raised)
    assert touching_patches(apart, poses, 0.1, of_pieces=True) == ()
    # Nor are places of pieces that are apart in a fifth of the poses.
    poses[:4] = mesh.vertices
    assert touching_patches(detector, poses, 0.1, of_pieces=True) == ()


def test_looking_for_patches_is_cancelled() -> None:
    job = Job()
    job.cancel()
    with pytest.raises(CancelledError):
        touching_patches(detector(), poses(), 0.1, job=job)


def test_a_detector_by_other_rules_finds_what_a_new_one_does() -> None:
    strict = detector()
    for rules in (
        ContactRules(ignored=(("floor", "post"),)),
        ContactRules(tolerated_depth=0.3),
        ContactRules(rest_exclusion=0.0),
        ContactRules(near_exclusion=0.2),
        ContactRules(touching=((0, 2),)),
    ):
        other, new = strict.with_rules(rules, GROUPS), detector(rules)
        assert other.rules == rules
        for pose in poses():
            np.testing.assert_array_equal(other.detect(pose).pairs, new.detect(pose).pairs)
            assert other.detect(pose).excluded == new.detect(pose).excluded
        back = other.with_rules(ContactRules())
        assert len(back.detect(MESH.vertices).pairs) == len(strict.detect(MESH.vertices).pairs) == 2
    with pytest.raises(ShapeError, match="'hat'"):
        strict.with_rules(ContactRules(ignored=(("hat", "floor"),)))
