"""Numbers as people read them."""

from __future__ import annotations

import math

_FAR = 0.03
"""Heights by which a mesh is hardly ever off the pose nearest to it, unless it is another body."""


def overlap_text(energy: float) -> str:
    """Write an energy in squared heights as the depth that it stands for, as in "1.1 %"."""
    return "none" if energy == 0.0 else height_text(math.sqrt(energy))


def height_text(distance: float) -> str:
    """Write a distance in heights as a share of the height, as in "1.1 %"."""
    percent = 100.0 * distance
    if 0.0 < percent < 0.05:
        return "below 0.1 %"
    return f"{percent:.1f} %"


def counted(number: int, noun: str, nouns: str | None = None) -> str:
    """Write a number with its noun, "1 pair" or "2 pairs"."""
    return f"{number} {noun if number == 1 else nouns or noun + 's'}"


def heading(name: str) -> str:
    """Give a domain's name the capital of a heading."""
    return name[:1].upper() + name[1:]


def seconds_text(seconds: float) -> str:
    """Write a duration as in "90 ms" or "1.4 s"."""
    return f"{1000 * seconds:.0f} ms" if seconds < 0.95 else f"{seconds:.1f} s"


def fit_error(mean: float | None, most: float | None) -> str:
    """Say how far off the nearest pose of a mesh is, in heights; None is not off at all."""
    mean, most = mean or 0.0, most or 0.0
    far = ", which is far: is it this body, in the model's vertex order?" if mean > _FAR else ""
    return f"fit error of {100.0 * mean:.3f} % of the height, at most {100.0 * most:.2f} %{far}"
