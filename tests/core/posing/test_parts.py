"""Shapes of body parts: long axes and far ends."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody
from lcollision_core.posing import far_end, long_axis
from tests.core.shapes import random_rotation


def test_the_long_axis_is_that_of_a_box_however_it_lies() -> None:
    generator = np.random.default_rng(4)
    box = generator.uniform(-1.0, 1.0, (500, 3)) * [0.5, 3.0, 0.4]
    box = np.concatenate([box, -box])
    for _ in range(10):
        rotation = random_rotation(generator)
        axis = long_axis((box @ rotation.T).astype(np.float32))
        assert abs(axis @ rotation[:, 1]) > 0.99
        assert np.linalg.norm(axis) == pytest.approx(1.0)
        assert axis[np.abs(axis).argmax()] > 0.0


def test_feet_are_low_and_hands_far_out() -> None:
    body = LearnedBody.load("body")
    space, names = body.space, body.domain_names
    rest, up = space.rest_vertices, body.up_axis
    height = np.ptp(rest[:, up])
    for name in ("left shin & foot", "right shin & foot"):
        end = rest[far_end(space, names.index(name))]
        assert end[up] < rest[:, up].min() + 0.08 * height
    for name in ("left hand & forearm", "right hand"):
        domain = names.index(name)
        vertex = far_end(space, domain)
        assert space.vertex_domain[vertex] == domain
        away = np.linalg.norm(rest - rest.mean(axis=0), axis=1)
        assert away[vertex] > np.quantile(away[space.vertex_domain == domain], 0.6)
