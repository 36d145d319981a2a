"""What stands on the ground in a motion."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.motion import Motion
from lcollision_core.posing import ExactCheck

NEAR_GROUND = 0.03
"""Normalised: what stands is no higher above the lowest point of the motion."""

STILL = 0.03
"""Normalised lengths a second: what stands moves no faster."""

_AT_ONCE = 64
"""Frames that are decoded together."""


def standing_parts(motion: Motion, check: ExactCheck, up: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Find the body parts that rest near the ground.

    A part stands in a frame where its vertices near the ground hardly move to the frame before or
    after. The ground is level, at the lowest point of the whole motion.

    Parameters
    ----------
    motion : of T frames
    check : decodes poses
    up : (3,) unit vector

    Returns
    -------
    standing : (T, K) bool, which of the K body parts stand in each frame
    """
    domain, n_domains = check.space.vertex_domain, check.space.n_domains
    axis = np.asarray(up, dtype=np.float64)
    ground = min(float((placed @ axis).min()) for placed in placed_frames(motion, check))
    standing = np.zeros((len(motion), n_domains), dtype=np.bool_)
    pairs = pairwise(placed_frames(motion, check))
    for frame, ((before, after), seconds) in enumerate(
        zip(pairs, np.diff(motion.times), strict=True)
    ):
        low = (np.minimum(before @ axis, after @ axis) < ground + NEAR_GROUND).astype(np.float64)
        count = np.bincount(domain, low, n_domains)
        moved = [np.bincount(domain, low * along, n_domains) for along in (after - before).T]
        speed = np.linalg.norm(moved, axis=0) / np.maximum(count, 1.0) / seconds
        standing[frame : frame + 2] |= (count > 0.0) & (speed < STILL)
    return standing


def parts_on_ground(motion: Motion, check: ExactCheck, up: npt.ArrayLike) -> frozenset[int]:
    """Return the body parts that are near the lowest point of a motion's first frame."""
    heights = next(placed_frames(motion, check)) @ np.asarray(up, dtype=np.float64)
    low = heights < heights.min() + NEAR_GROUND
    return frozenset(check.space.vertex_domain[low].tolist())


def placed_frames(motion: Motion, check: ExactCheck) -> Iterator[FloatArray]:
    """Decode a motion's frames one after the other: (V, 3) normalised, where each is placed."""
    for start in range(0, len(motion), _AT_ONCE):
        for frame, decoded in enumerate(
            check.decode(motion.codes[start : start + _AT_ONCE]), start
        ):
            place = motion.placement(frame)
            size = check.body_size
            yield decoded if place is None else place.apply(decoded * size) / (size * place.scale)
