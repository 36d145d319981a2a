"""Posing by hand: spaces of poses, grips and pins, drags that stay free of collisions."""

from lcollision_core.posing.dragger import DragOptions, DragStep, PoseDragger
from lcollision_core.posing.exact import ExactCheck, exported_vertices
from lcollision_core.posing.grip import (
    GRIP_RADIUS,
    LARGEST_RADIUS,
    LEAST_RADIUS,
    Grip,
    Pin,
    Twist,
    make_grip,
)
from lcollision_core.posing.parts import far_end, frame_round, long_axis
from lcollision_core.posing.pose_space import LatentPoseSpace, PoseSpace
