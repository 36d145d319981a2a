"""Corrections by hand: eased over neighbouring frames, and across the seam of a cycle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lcollision_core.errors import ShapeError
from lcollision_core.motion.motion import corrected
from tests.core.motion.swings import N_FRAMES, swinging


def test_a_correction_is_whole_at_its_frame_and_fades_over_its_neighbours() -> None:
    _, motion = swinging()
    change = np.linspace(-0.2, 0.3, motion.codes.shape[1])
    edited = corrected(motion, 20, motion.codes[20] + change, easing=5)
    assert edited.codes[20].tobytes() == (motion.codes[20] + change).tobytes()
    share = (edited.codes - motion.codes) @ change / (change @ change)
    assert (np.diff(share[15:21]) > 0.0).all()
    assert (np.diff(share[20:26]) < 0.0).all()
    np.testing.assert_allclose(share[15:20], share[25:20:-1])
    # There is no jump at the start: the first share is small.
    assert 0.0 < share[15] < 0.1
    outside = [frame for frame in range(N_FRAMES) if abs(frame - 20) > 5]
    assert edited.codes[outside].tobytes() == motion.codes[outside].tobytes()
    assert edited.times is motion.times


def test_without_easing_one_frame_changes() -> None:
    _, cycle = swinging()
    assert cycle.is_cycle
    # A cycle's last frame equals its first.
    for motion, frames in ((cycle, [0, N_FRAMES - 1]), (cycle.part(range(40)), [0])):
        edited = corrected(motion, 0, motion.codes[0] + 0.1, easing=0)
        assert np.flatnonzero((edited.codes != motion.codes).any(axis=1)).tolist() == frames


def test_a_cycle_stays_one() -> None:
    _, motion = swinging()
    codes = np.array(motion.codes)
    codes[-1] = codes[0]
    cycle = replace(motion, codes=codes)
    for frame in (0, 2, N_FRAMES - 2, N_FRAMES - 1):
        edited = corrected(cycle, frame, cycle.codes[frame] + 0.1, easing=6)
        assert edited.codes[0].tobytes() == edited.codes[-1].tobytes()
        # Also across the seam.
        assert (edited.codes[1] != cycle.codes[1]).any()
        assert (edited.codes[-2] != cycle.codes[-2]).any()
        assert edited.codes[20].tobytes() == cycle.codes[20].tobytes()


def test_codes_of_another_length_are_refused() -> None:
    _, motion = swinging()
    with pytest.raises(ShapeError, match="corrected frame"):
        corrected(motion, 3, np.zeros(motion.codes.shape[1] + 1), easing=2)


def test_a_motion_is_cut_and_sampled_anew() -> None:
    _, motion = swinging()
    part = motion.part(range(10, 21))
    assert part.times.tobytes() == motion.times[10:21].tobytes()
    assert part.codes.tobytes() == motion.codes[10:21].tobytes()
    assert motion.at_rate(30.0) is motion
    twice = motion.at_rate(60.0)
    assert len(twice) == 2 * N_FRAMES - 1
    np.testing.assert_allclose(twice.codes[::2], motion.codes, atol=1e-12)
    np.testing.assert_allclose(
        twice.codes[1::2], 0.5 * (motion.codes[1:] + motion.codes[:-1]), atol=1e-12
    )
    half = motion.at_rate(15.0)
    np.testing.assert_allclose(half.codes, motion.codes[::2], atol=1e-12)
