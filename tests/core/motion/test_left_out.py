"""Pairs left out by contact rules: in all frames of a short motion, every n-th of a long one."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from lcollision_core.contact import CollisionDetector
from lcollision_core.meshes import ContactRules, Topology
from lcollision_core.motion import FrameChecks, screen_frames

_BLADES = np.array(
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -0.5], [0.2, 0.2, 0.1], [0.3, 0.2, 0.1]], float
)
"""Two triangles; the second penetrates the first."""


@pytest.mark.parametrize(("n_frames", "step"), [(64, 1), (65, 2), (640, 10)])
def test_a_search_for_what_does_not_count_stays_short_for_long_motions(
    n_frames: int, step: int
) -> None:
    """It takes several times as long as a search for counting pairs."""
    faces = np.arange(6, dtype=np.int32).reshape(2, 3)
    rules = ContactRules(tolerated_depth=0.5)
    detector = CollisionDetector(Topology(faces, 6), _BLADES, rules)
    n_searched = []

    def find(vertices: np.ndarray, *, counted_only: bool) -> object:
        n_searched.append(not counted_only)
        return detector.detect(vertices, counted_only=counted_only)

    screen = partial(
        screen_frames,
        FrameChecks(lambda frame, share: _BLADES, find),  # noqa: ARG005
        np.arange(n_frames) / 30.0,
        np.zeros(6, dtype=np.intp),
        faces,
        substeps=0,
        workers=1,
    )
    screened = screen(counted_only=False)
    searched = list(range(0, n_frames, step))
    assert sum(n_searched) == len(searched)
    assert [one.frame for one in screened.excluded] == searched
    left_out = screened.left_out
    assert (left_out.counts.tolerated, left_out.frames) == (len(searched), len(searched))
    assert left_out.to_json()["excluded_searched"] == len(searched)
    said = left_out.sentence(rules)
    of = f"in {len(searched)} of {len(searched)} frames that were searched for all pairs "
    assert said.startswith(of if step > 1 else f"in {n_frames} frames ")
    assert screen().excluded == ()
