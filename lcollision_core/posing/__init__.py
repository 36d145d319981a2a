"""Pose by hand: spaces of poses, grips and pins, drags that stay collision-free."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lcollision_core.posing.public import *  # noqa: F403
else:
    from lcollision_core.lazy import public_names

    __getattr__ = public_names(__name__)
