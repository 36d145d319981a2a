"""Ground contact of a motion, measured on a rigidly moved body."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.motion import GroundReport, Motion
from tests.core.motion.swings import swinging
from tests.rigged_shapes import FloatArray

UP = np.array([0.0, 0.0, 1.0])


def report_of(places: FloatArray) -> GroundReport:
    """Report on the resting body shifted by (T, 3), normalised."""
    body, _ = swinging()
    space, size = body.space, body.body_size
    rest = np.array(space.rig.rest)
    transforms = np.repeat(rest[None], len(places), axis=0)
    transforms[..., :3, 3] += places[:, None] * size
    motion = Motion("moved", np.arange(len(places)) / 30.0, space.codes_of_transforms(transforms))
    ground = float((body.reference @ UP).min()) / size
    everything = np.ones(body.n_vertices, np.bool_)
    return GroundReport.of(motion, body.exact_check(), UP, ground, everything)


def test_a_body_that_stands_does_nothing_of_it() -> None:
    found = report_of(np.zeros((6, 3)))
    assert found.standing_frames == 6
    assert max(found.sink, found.gap, found.slide) < 1e-9


def test_what_sinks_floats_and_slides_is_measured() -> None:
    places = np.zeros((12, 3))
    places[:6, 0] = 0.0005 * np.arange(6)
    places[6:, 0] = places[5, 0]
    # In one frame it jumps down, when nothing stands still.
    places[9, 2] = -0.02
    found = report_of(places)
    assert (found.sink, found.sink_frame) == (pytest.approx(0.02), 9)
    assert (found.slide, found.slide_frame) == (pytest.approx(0.0025), 5)
    assert found.gap == pytest.approx(0.0, abs=1e-9)
    assert found.standing_frames == 11
    raised = report_of(np.tile([0.0, 0.0, 0.01], (4, 1)))
    assert (raised.sink, raised.gap) == (0.0, pytest.approx(0.01))
    # Far above the ground, nothing stands.
    assert report_of(np.tile([0.0, 0.0, 0.2], (4, 1))) == GroundReport()
