"""Options of labelling."""

from __future__ import annotations

from enum import StrEnum


class Draws(StrEnum):
    """What samples are drawn from: the latent box alone, as in the paper, or mixed.

    Half of mixed samples are of the box; a quarter are blends of training poses with noise and
    parts of different ones put together, and a quarter lies near the border of the free set.
    """

    BOX = "box"
    MIXED = "mixed"
