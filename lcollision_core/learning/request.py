"""What a model is to be learned from, and how."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from lcollision_core.errors import LCollisionError
from lcollision_core.json_values import from_json
from lcollision_core.learning.effort import Quality


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

    def __post_init__(self) -> None:
        if not self.sources:
            raise LCollisionError("no files are given to learn from", "name at least one")
        if self.quality not in tuple(Quality):
            raise LCollisionError.must_be("the quality", ", ".join(Quality), self.quality)
        if self.by_rig is not None and self.by_rig < 0:
            raise LCollisionError.must_be(
                "the number of poses by the rig", "0 or more", self.by_rig
            )

    def to_json(self) -> dict[str, Any]:
        """Return the JSON values of `of_json`, lists as they come back from a file."""
        values = asdict(self) | {"sources": list(self.sources)}
        return values if self.ignored is None else values | {"ignored": list(self.ignored)}

    @classmethod
    def of_json(cls, values: Mapping[str, Any]) -> LearningRequest:
        """Read what `to_json` returned.

        Raises
        ------
        ValueError : a value is missing or of another type.
        """
        return from_json(cls, values, "request")
