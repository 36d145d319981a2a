"""The outline of a body part: its border on the mesh, for any mask."""

from __future__ import annotations

import numpy as np
import pytest

from app.view.actors import PartShape
from lcollision_core.bodies import LearnedBody


@pytest.mark.parametrize("domain", [0, 1])
def test_a_border_goes_round_where_one_part_hands_over_to_the_other(
    editor_model: LearnedBody, domain: int
) -> None:
    mask, faces = editor_model.attention_mask, editor_model.faces
    shape = PartShape.of(mask, faces, domain)
    assert len(shape.segments) > 0
    # On a closed mesh it has no ends: each point is on two segments.
    assert (np.bincount(shape.segments.ravel()) == 2).all()
    assert (shape.fractions > 0.0).all()
    assert (shape.fractions < 1.0).all()
    leads = mask.argmax(axis=0)
    part = np.flatnonzero(leads == domain)
    # Smoothing moves the border by at most a vertex in places.
    assert np.isin(shape.vertices, part).mean() > 0.9
    assert np.isin(part, shape.vertices).mean() > 0.7
    vertices = editor_model.reference.astype(np.float32)
    border = shape.border(vertices)
    between = vertices[shape.ends]
    assert (border >= between.min(axis=1) - 1e-6).all()
    assert (border <= between.max(axis=1) + 1e-6).all()
    # It follows the pose.
    np.testing.assert_allclose(shape.border(vertices + 1.0), border + 1.0, atol=1e-5)
    np.testing.assert_array_equal(
        np.sort(shape.vertices[shape.faces], axis=1),
        np.sort(faces[np.isin(faces, shape.vertices).all(axis=1)], axis=1),
    )


def test_a_part_that_leads_nowhere_is_where_it_moves_most(editor_model: LearnedBody) -> None:
    weak = 0.4 * editor_model.attention_mask[1:]
    mask = np.concatenate([1.0 - weak, weak])
    shape = PartShape.of(mask, editor_model.faces, 1)
    assert len(shape.segments) > 0
    assert weak[0, shape.vertices].min() > 0.4 * weak.max()


def test_an_only_part_has_no_border(editor_model: LearnedBody) -> None:
    shape = PartShape.of(np.ones((1, editor_model.n_vertices)), editor_model.faces, 0)
    assert len(shape.segments) == len(shape.ends) == 0
    assert len(shape.faces) == len(editor_model.faces)
