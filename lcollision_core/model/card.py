"""What a model says of itself beside its weights: the section ``model`` of its file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lcollision_core.errors import ModelFileError
from lcollision_core.model.naming import MAX_NAME_LENGTH


@dataclass(frozen=True)
class ModelCard:
    """Units, names and origin of a model.

    Attributes
    ----------
    height : one height in the data's unit
    up_axis : 0, 1 or 2 for x, y or z
    near_exclusion : pairs of faces this near along the surface, in heights, are counted apart
    domain_names : K different names
    domain_colours : K strings "#rrggbb"
    pose_names : N names of the training poses
    source : what the model was trained on
    licence : under which the model may be used
    provenance : how it was made, JSON values by name

    Raises
    ------
    ModelFileError : a value that cannot be.
    """

    height: float
    up_axis: int
    near_exclusion: float
    domain_names: tuple[str, ...]
    domain_colours: tuple[str, ...]
    pose_names: tuple[str, ...]
    source: str
    licence: str
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = self.domain_names
        sound = (
            _is_number(self.height)
            and 0.0 < self.height < float("inf")
            and self.up_axis in (0, 1, 2)
            and _is_number(self.near_exclusion)
            and 0.0 <= self.near_exclusion < 1.0
            and all(
                isinstance(text, str) for text in (*names, *self.pose_names, *self.domain_colours)
            )
            and all(0 < len(name) <= MAX_NAME_LENGTH for name in names)
            and len(set(names)) == len(names) == len(self.domain_colours)
            and all(re.fullmatch("#[0-9a-f]{6}", colour) for colour in self.domain_colours)
            and isinstance(self.source, str)
            and isinstance(self.licence, str)
            and isinstance(self.provenance, Mapping)
        )
        if not sound:
            raise ModelFileError(
                "the model's names, colours or units are unusable; train or copy the model again"
            )

    def to_metadata(self) -> dict[str, Any]:
        """Return JSON values from which `from_metadata` builds the same card."""
        return {
            "height": self.height,
            "up_axis": self.up_axis,
            "near_exclusion": self.near_exclusion,
            "domain_names": list(self.domain_names),
            "domain_colours": list(self.domain_colours),
            "pose_names": list(self.pose_names),
            "source": self.source,
            "licence": self.licence,
            "provenance": dict(self.provenance),
        }

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any]) -> ModelCard:
        """Rebuild a card from what `to_metadata` returned.

        Raises
        ------
        ModelFileError : something is missing or cannot be.
        """
        values: dict[str, Any] = {name: metadata.get(name) for name in cls.__dataclass_fields__}
        for name in ("domain_names", "domain_colours", "pose_names"):
            if not isinstance(values[name], list):
                raise ModelFileError(
                    f"the model lacks its {name.replace('_', ' ')}; train or copy the model again"
                )
            values[name] = tuple(values[name])
        return cls(**values)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
