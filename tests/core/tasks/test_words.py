"""Numbers in sentences for people."""

from __future__ import annotations

import pytest

from lcollision_core.tasks.words import height_text


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
