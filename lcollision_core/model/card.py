"""A model's metadata beside its weights: the section ``model`` of its file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from lcollision_core.errors import ModelFileError
from lcollision_core.json_values import from_json, quoted
from lcollision_core.model.naming import MAX_NAME_LENGTH

_LEAST_BODY_SIZE = 1e-12
"""Least body size, in any unit; its inverse is the largest."""

_MAX_TEXT_LENGTH = 1000
_CARD = "the model's card"
_ADVICE = "train or copy the model again"


@dataclass(frozen=True)
class ModelCard:
    """Units, names and origin of a model.

    Attributes
    ----------
    height : the body size, in the data's unit
    up_axis : 0, 1 or 2 for x, y or z
    near_exclusion : pairs of faces this near along the surface, normalised, are counted separately
    domain_names : K different names
    domain_colours : K strings "#rrggbb"
    pose_names : N names of the training poses
    source : what the model was trained on
    licence : of the model
    provenance : how it was made, JSON values by name
    domain_order : all K domains, indices from 0, in listing order; empty for that of the latent

    Raises
    ------
    ModelFileError : an invalid value.
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
    domain_order: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        names, colours, order = self.domain_names, self.domain_colours, self.domain_order
        texts = (*self.pose_names, self.source, self.licence)
        allowed = f"use 1 to {MAX_NAME_LENGTH} printable characters"
        for sound, problem, next_step in (
            (
                _LEAST_BODY_SIZE <= self.height <= 1.0 / _LEAST_BODY_SIZE,
                f"its body size (height) must be from {_LEAST_BODY_SIZE:g} to "
                f"{1.0 / _LEAST_BODY_SIZE:g}",
                "",
            ),
            (self.up_axis in (0, 1, 2), "its up_axis must be 0, 1 or 2", ""),
            (0.0 <= self.near_exclusion < 1.0, "its near_exclusion must be from 0 to below 1", ""),
            (
                all(len(text) <= _MAX_TEXT_LENGTH for text in texts),
                f"its names, source and licence must be at most {_MAX_TEXT_LENGTH} characters",
                "",
            ),
            *((_is_name(name), f"{name[:80]!r} cannot name a domain", allowed) for name in names),
            *(
                (
                    names.count(name) == 1,
                    f"two domains would be called {name!r}",
                    "choose another name",
                )
                for name in names
            ),
            (len(colours) == len(names), "it must have one colour for each domain", ""),
            *(
                (
                    bool(re.fullmatch("#[0-9a-f]{6}", colour)),
                    f"{quoted(colour)} is not a colour",
                    "write it as in #0077bb",
                )
                for colour in colours
            ),
            (
                not order or sorted(order) == list(range(len(names))),
                f"{quoted(list(order))} is not an order of the {len(names)} domains",
                "name each once",
            ),
        ):
            if not sound:
                raise ModelFileError(problem, next_step)

    def to_metadata(self) -> dict[str, Any]:
        """Return JSON values for `from_metadata`."""
        values = asdict(self)
        if not self.domain_order:
            del values["domain_order"]
        return values

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any]) -> ModelCard:
        """Rebuild a card from what `to_metadata` returned.

        Raises
        ------
        ModelFileError : something is missing or invalid.
        """
        try:
            return from_json(cls, metadata, "card")
        except (ValueError, ModelFileError) as error:
            reason = getattr(error, "headline", error)
            raise ModelFileError.because(_CARD, "is damaged", reason, _ADVICE) from error


def _is_name(name: str) -> bool:
    return 0 < len(name) <= MAX_NAME_LENGTH and name.isprintable()
