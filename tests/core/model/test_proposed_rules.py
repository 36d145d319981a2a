"""Contact rules that a character's own poses propose."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.contact import ContactRules
from lcollision_core.errors import CancelledError
from lcollision_core.jobs import CancelToken
from lcollision_core.meshes import part_groups
from lcollision_core.model import RigModel, propose_rules, typical_poses
from tests.rigged_shapes import head_in_torso, rigged_body


@pytest.mark.parametrize("n_frames", [0, 12])
def test_pieces_that_stand_in_each_other_are_proposed(n_frames: int) -> None:
    body = RigModel.of(head_in_torso(n_frames)).with_rules(ContactRules())
    poses = typical_poses(body)
    # Random ones where it came with none but its rest pose.
    assert len(poses) == (n_frames + 1 if n_frames else 41)
    assert len(np.unique(poses, axis=0)) >= len(poses) - 1
    proposed = propose_rules(body)
    assert proposed is not None
    ((first, second),) = proposed.rules.ignored
    assert proposed.rules == ContactRules(ignored=((first, second),))
    assert proposed.n_poses == len(poses)
    assert proposed.n_colliding > 0.9 * len(poses) > 1.2 * proposed.n_colliding_then
    other = body.with_rules(proposed.rules)
    assert other.detector.are_colliding(poses).sum() == proposed.n_colliding_then
    # The pieces are the head and the trunk.
    faces = {group.name: group.faces for group in other.groups}
    parts = part_groups(body.topology, np.array(body.domain_names)[body.space.vertex_domain])
    of_face = {face: part.name for part in parts for face in part.faces.tolist()}
    found = [{of_face[face] for face in faces[name].tolist()} for name in (first, second)]
    assert any("Head" in names for names in found)
    assert any("Torso" in names for names in found)
    # Once they apply there is nothing to propose.
    assert propose_rules(other) is None


def test_nothing_is_proposed_where_most_poses_are_free() -> None:
    assert propose_rules(RigModel.of(rigged_body(n_frames=12))) is None
    # What touches at rest does not count by the rules that a character starts with.
    assert propose_rules(RigModel.of(head_in_torso(12))) is None


def test_looking_for_proposals_can_be_cancelled() -> None:
    cancel = CancelToken()
    cancel.cancel()
    with pytest.raises(CancelledError):
        propose_rules(RigModel.of(head_in_torso(12)).with_rules(ContactRules()), cancel=cancel)
