"""Motions: find the frames that collide, and resolve them as smoothly as the motion was."""

from lcollision_core.motion.contacts import ContactReport, KeptContacts
from lcollision_core.motion.frames import (
    FrameChecks,
    FrameCollisions,
    KeptSpan,
    Reason,
    ScreenedMotion,
    colliding_domains,
    contact_report,
    is_worse,
    screen_frames,
    screen_motion,
    worse_spans,
)
from lcollision_core.motion.ground import GroundReport
from lcollision_core.motion.motion import (
    NOMINAL_RATE,
    Motion,
    MotionReport,
    colliding_spans,
    standing_parts,
)
from lcollision_core.motion.resolve_motion import ResolvedMotion, resolve_motion
from lcollision_core.motion.spans import Solved
from lcollision_core.options import MotionOptions
