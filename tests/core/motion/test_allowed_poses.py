"""Colliding poses that the contacts of a frame allow."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from lcollision_core.motion.frames import Frames
from lcollision_core.motion.motion import runs
from lcollision_core.motion.span_program import SpanProgram
from lcollision_core.options import ResolveOptions
from tests.core.motion.swings import swinging


def test_a_pose_that_contacts_allow_is_cut_off_from_the_free_one() -> None:
    body, motion = swinging()
    with ThreadPoolExecutor(1) as pool:
        frames = Frames(motion, body.resolver, ResolveOptions(), pool)
        was_free = frames.are_free(range(len(motion)))
        span = runs(~was_free)[0]
        target = motion.codes[span.start]
        free_pose = frames.near(span.start, target)
        assert free_pose is not None
        start = np.zeros((len(span), len(target)))
        start[0] = free_pose - target
        program = SpanProgram(
            frames,
            span,
            start,
            np.arange(len(span)) == 0,
            None,
            None,
            300.0,
            [np.empty(0)] * len(span),
            np.ones(len(span), dtype=np.bool_),
            cuts_off=True,
        )
        program._cut_off(0, target)
        ((_, normals, offsets),) = program._half_spaces({})
    # They are relative to the target.
    assert (offsets < 0.0).all()
    middle = 0.5 * (target + free_pose)
    assert (normals @ (middle - target) > offsets).all()
    assert (normals @ (free_pose - target) <= offsets + 1e-9).all()
    # A pose without a known free one is left to its contacts.
    program._cut_off(1, motion.codes[span.start + 1])
    assert len(program._half_spaces({})) == 1
