"""Named groups of faces: the meshes, materials and objects of a file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, eq=False)
class FaceGroup:
    """Faces that have a name: those of a mesh, a material, an object or a body part.

    Attributes
    ----------
    name : as in the file
    faces : (n,) int64 array, ascending, indices from 0
    """

    name: str
    faces: npt.NDArray[np.int64]
