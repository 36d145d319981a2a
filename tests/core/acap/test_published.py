"""Round trips of the published pose sets, if available, within half the required limits."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.files import PoseSet
from lcollision_core.meshes.alignment import align_rigid
from lcollision_core.meshes.extents import body_size
from tests.core.acap.jumps import n_jumps


@pytest.mark.parametrize(
    ("name", "step", "mean_limit", "max_limit", "most_jumps"),
    [("scape", 1, 0.00075, 0.009, 20), ("jumping", 10, 0.00015, 0.003, 10)],
)
def test_round_trip_of_aligned_poses(
    request: pytest.FixtureRequest,
    name: str,
    step: int,
    mean_limit: float,
    max_limit: float,
    most_jumps: int,
) -> None:
    poses: PoseSet = request.getfixturevalue(name)
    reference = poses.vertices[0] / body_size(poses.vertices[0])
    aligned = align_rigid(poses.vertices[::step] / body_size(poses.vertices[0]), reference)
    codec = AcapCodec(poses.topology, reference, aligned.weights)
    features = codec.encode(aligned.vertices)
    # Anchored like the alignment, so that no translation remains to be removed.
    error = np.linalg.norm(codec.decode(features) - aligned.vertices, axis=2)
    assert 0.0 < error.mean() < mean_limit
    assert error.max() < max_limit
    assert sum(n_jumps(features, poses.topology)) < most_jumps
