"""Bodies by file or name, whatever their pose space."""

from __future__ import annotations

import os

from lcollision_core.model.posable_body import PosableBody
from lcollision_core.model.pose_model import PoseModel


def open_body(name_or_path: str | os.PathLike[str]) -> PosableBody:
    """Read a body that can take poses.

    Parameters
    ----------
    name_or_path : a model's file, or the name of a bundled or user model

    Raises
    ------
    ModelFileError : see `PoseModel.load`.
    """
    return PoseModel.load(name_or_path)
