"""What a model is to be learned from, and how."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lcollision_core.errors import LCollisionError
from lcollision_core.json_values import from_json, to_json
from lcollision_core.learning.effort import Quality
from lcollision_core.meshes import file_stamp
from lcollision_core.model_file import digest_of


@dataclass(frozen=True)
class LearningRequest:
    """What a model is to be learned from, and how; it is kept with the model.

    Attributes
    ----------
    sources : absolute paths of files of a character, folders of meshes, point caches or pose sets
        of one body
    quality : a `Quality`
    by_rig : poses drawn by the rig; None draws as many as the quality wants beside the clips
    clip, fps : of a character's animations, see `read_pose_set`
    up : 0, 1 or 2 where the files are wrong about the axis or say none; None takes theirs
    scale : brings the poses into the unit that the model is to have
    near_exclusion, rest_exclusion, tolerated_depth : see `ContactRules`; None for what is proposed
    ignored : "A:B", names of groups of faces whose pairs do not count, beside those proposed; None
        for those alone, an empty list for none
    seed : equal seeds, equal models
    licence : under which the model may be used
    stamps : of the sources, so that a file that has changed is not taken for the one that was read:
        see `stamped`
    left_out : names of groups of faces that take no part in the check

    Raises
    ------
    LCollisionError : a value is out of its range.
    """

    sources: tuple[str, ...]
    quality: str = Quality.GOOD
    by_rig: int | None = None
    clip: str | None = None
    fps: float | None = None
    up: int | None = None
    scale: float = 1.0
    near_exclusion: float | None = None
    rest_exclusion: float | None = None
    tolerated_depth: float | None = None
    ignored: tuple[str, ...] | None = None
    seed: int = 0
    licence: str = "unknown"
    stamps: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.sources:
            raise LCollisionError("no files are given to learn from", "name at least one")
        if self.quality not in tuple(Quality):
            raise LCollisionError.must_be("the quality", ", ".join(Quality), self.quality)
        if self.by_rig is not None and self.by_rig < 0:
            raise LCollisionError.must_be(
                "the number of poses by the rig", "0 or more", self.by_rig
            )

        if self.up not in (None, 0, 1, 2):
            raise LCollisionError.must_be("the up axis", "0, 1 or 2", self.up)
        for what, value in (("the scale", self.scale), ("frames a second", self.fps)):
            if value is not None and not 0.0 < value < math.inf:
                raise LCollisionError.must_be(what, "a number above 0", f"{value:g}")
        for what, value in (
            ("the near exclusion", self.near_exclusion),
            ("the rest exclusion", self.rest_exclusion),
            ("the tolerated depth", self.tolerated_depth),
        ):
            if value is not None and not 0.0 <= value < 1.0:
                raise LCollisionError.must_be(what, "from 0 to below 1", f"{value:g}")

    def stamped(self) -> LearningRequest:
        """Return the same request with the sizes and times of its sources as they are now."""
        return replace(self, stamps=tuple(_stamp(Path(source)) for source in self.sources))

    def to_json(self) -> dict[str, Any]:
        """Return the JSON values of `of_json`, lists as they come back from a file."""
        return to_json(self)

    @classmethod
    def of_json(cls, values: Mapping[str, Any]) -> LearningRequest:
        """Read what `to_json` returned.

        Raises
        ------
        ValueError : a value is missing or of another type.
        """
        return from_json(cls, values, "request")


def _stamp(path: Path) -> str:
    """Return what changes with a file, or with the files of a folder; "" if there is none."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    found = [(file.name, *(file_stamp(file) or ())[2:]) for file in files]
    return digest_of(json.dumps(found), {})[:16] if path.exists() else ""
