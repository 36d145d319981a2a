"""The public names of `lcollision_core.posing`, loaded on first use."""

from lcollision_core.posing.dragger import (
    GRIP_RADIUS,
    LARGEST_RADIUS,
    LEAST_RADIUS,
    DragOptions,
    DragStep,
    Grip,
    Pin,
    PoseDragger,
    Twist,
    make_grip,
)
from lcollision_core.posing.exact import ExactCheck, exported_vertices
from lcollision_core.posing.pose_space import (
    LatentPoseSpace,
    PoseSpace,
    far_end,
    frame_round,
    long_axis,
)
