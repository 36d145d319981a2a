"""Decode codes and check their poses on a GPU, if the space decodes there."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import CollisionDetector
from lcollision_core.contact.kernels import COUNTED
from lcollision_core.devices import uses_gpu
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.pose_space import PosesOnGpu, PoseSpace


@lru_cache(maxsize=2)
def _decoder_of(space: Any, body_size: float) -> PosesOnGpu | None:
    """Return a space's decoder; only a few are kept, as each holds tables on the GPU."""
    decoder: PosesOnGpu | None = space.gpu_decoder(body_size)
    return decoder


def colliding_on_gpu(
    detector: CollisionDetector, space: PoseSpace, body_size: float, codes: FloatArray
) -> npt.NDArray[np.bool_] | None:
    """Decode and check (B, D) codes on a GPU, and return which poses collide.

    Parameters
    ----------
    detector : in the data's unit
    space, body_size : decode to float32 vertices in that unit

    Returns
    -------
    colliding : (B,) bool; None if the check is left to the CPU
    """
    if detector.clearance > 0.0 or not uses_gpu(len(codes), space.topology.n_faces):
        return None
    if codes[:, codes.shape[1] - space.n_shapes :].any():
        return None
    posed_space: Any = space
    decoder = _decoder_of(posed_space, body_size)
    if decoder is None:
        return None
    from lcollision_core.on_gpu import GPU_LOCK

    colliding, start = np.zeros(len(codes), dtype=np.bool_), 0
    search = detector.gpu_search()
    while start < len(codes):
        part = slice(start, start + min(decoder.at_once, search.at_once))
        with GPU_LOCK:
            collisions = search.search(
                decoder.decode(codes[part]), first_only=True, uncounted=detector.uncounted_nodes()
            )
            colliding[part] = collisions.n_by_rule.copy_to_host()[:, COUNTED] > 0
        for number in collisions.left:
            vertices = body_size * space.decode(codes[start + number][None])
            colliding[start + number] = detector.are_colliding(vertices.astype(np.float32))[0]
        start = part.stop
    return colliding
