"""The motion of the working pose that goes on, towards the newest target."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from app.work.frames import PoseFrame
    from app.work.pose_worker import CodeTarget, GripTarget, MotionStart
    from lcollision_core.posing import Grip

_MOST_IDLE = 12
"""Events towards one target, none of which came nearer, after which a motion counts as settled: a
straight arm that is to bend needs some to begin."""

_NEARER = 0.999
"""A miss that is less than this fraction of the least one before is nearer."""


@dataclass(eq=False)
class Moving:
    """The motion that goes on.

    Attributes
    ----------
    start : what the worker begins with
    target : the newest one; None before the first
    pin : index and patch of the pin that comes along, None if none does
    has_ended : the hand has let go; the step is made when the pose has settled
    least_miss, n_idle : the nearest to the target so far, and events since
    """

    start: MotionStart
    target: CodeTarget | GripTarget | None = None
    pin: tuple[int, Grip] | None = None
    has_ended: bool = False
    least_miss: float = field(default=np.inf)
    n_idle: int = 0

    def leads_on(self, frame: PoseFrame) -> bool:
        """Whether the same target is worth another event, after this one."""
        self.n_idle += 1
        if frame.miss < _NEARER * self.least_miss:
            self.least_miss, self.n_idle = frame.miss, 0
        return not frame.settled and self.n_idle < _MOST_IDLE
