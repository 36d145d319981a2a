"""The exact check of latent poses: the vertices that a file would hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import CollisionDetector, SelfCollisions
from lcollision_core.embedding import Embedding
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.topology import FloatArray


def exported_vertices(
    vertices: npt.NDArray[Any], placement: RigidTransform | None = None
) -> npt.NDArray[np.float32]:
    """Round vertices to what a file of them holds, and what is proved of them.

    Parameters
    ----------
    vertices : (..., V, 3) array, in the data's unit
    placement : where a decoded pose is exported to; None leaves it where it is

    Returns
    -------
    exported : (..., V, 3) float32 array; a placed pose is rounded as it is drawn, moved, and
        rounded again
    """
    drawn: npt.NDArray[np.float32] = vertices.astype(np.float32)
    return drawn if placement is None else placement.apply(drawn).astype(np.float32)


@dataclass(frozen=True, eq=False)
class ExactCheck:
    """Decodes latent poses and tests them as they are exported; safe to share between threads.

    Attributes
    ----------
    embedding : decodes
    detector : in the data's unit
    height : one height in the data's unit
    placement : where a pose is exported to, None for the reference's frame
    """

    embedding: Embedding
    detector: CollisionDetector
    height: float
    placement: RigidTransform | None = None

    def decode(self, latent: npt.ArrayLike) -> FloatArray:
        """Decode (B, D) latent poses to (B, V, 3) vertices in heights, in the reference's frame."""
        return self.embedding.decode(np.atleast_2d(np.asarray(latent)), n_threads=1)

    def exported(self, decoded: FloatArray) -> npt.NDArray[np.float32]:
        """Return decoded (..., V, 3) vertices, in heights, as they are exported."""
        return exported_vertices(decoded * self.height, self.placement)

    def are_free(self, latent: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Tell which of (B, D) latent poses are exactly free: (B,) bool."""
        return ~self.detector.are_colliding(self.exported(self.decode(latent)), workers=1)

    def is_free(self, latent: npt.ArrayLike) -> bool:
        """Tell whether one (D,) latent pose is exactly free."""
        return bool(self.are_free(latent)[0])

    def find(self, decoded: FloatArray) -> SelfCollisions:
        """Find all colliding pairs of one pose's decoded (V, 3) vertices."""
        return self.detector.detect(self.exported(decoded))
