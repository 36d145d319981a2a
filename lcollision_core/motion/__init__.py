"""Motions: which frames collide, and the same motion free of collisions and as smooth as before."""

from lcollision_core.motion.guard import KeptSpan, Reason, is_worse, worse_spans
from lcollision_core.motion.motion import NOMINAL_RATE, Motion
from lcollision_core.motion.report import MotionReport
from lcollision_core.motion.resolve_motion import ResolvedMotion, Solved, resolve_motion
from lcollision_core.motion.screening import (
    FrameCollisions,
    ScreenedMotion,
    colliding_domains,
    screen_frames,
    screen_motion,
)
from lcollision_core.motion.spans import colliding_spans
from lcollision_core.motion.standing import standing_parts
from lcollision_core.options.motion import MotionOptions
