"""The result of encoding a mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes import RigidTransform


@dataclass(frozen=True)
class EncodedPose:
    """A mesh as a latent pose.

    Attributes
    ----------
    latent : (D,) float64 array
    placement : takes the decoded pose to where the mesh was, and into its unit
    fit_error_mean, fit_error_max : distance of the decoded vertices from the mesh's, normalised
    """

    latent: npt.NDArray[np.float64]
    placement: RigidTransform
    fit_error_mean: float
    fit_error_max: float
