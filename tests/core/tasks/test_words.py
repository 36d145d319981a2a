"""Numbers in sentences for people."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lcollision_core.bodies.mirror import MirroredPose
from lcollision_core.tasks.words import fit_error, height_text, mirrored_text


@pytest.mark.parametrize(
    ("distance", "digits", "text"),
    [
        (0.0, 2, "0.00 %"),
        (1e-9, 2, "below 0.01 %"),
        (0.0112, 2, "1.12 %"),
        (0.0004, 1, "below 0.1 %"),
        (0.0112, 1, "1.1 %"),
    ],
)
def test_a_depth_above_zero_is_never_written_as_zero(
    distance: float, digits: int, text: str
) -> None:
    assert height_text(distance, digits) == text


def test_a_mirror_image_far_off_does_not_doubt_the_body() -> None:
    unused: Any = None
    far = MirroredPose(np.zeros(1), None, 0.06, 0.2, False, 0, 0, 0, None, unused)
    assert mirrored_text(far) == (
        "mirrored with a fit error of 6.000 % of the body size, at most 20.00 %, which is large: "
        "the body is not symmetric, or cannot take this pose, free"
    )
    assert fit_error(0.06, 0.2).endswith("is it this body, in the model's vertex order?")
