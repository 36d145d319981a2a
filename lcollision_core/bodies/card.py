"""The card of a model: its units, names, contact rules and origin."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from lcollision_core.bodies.names import MAX_NAME_LENGTH
from lcollision_core.errors import ModelFileError
from lcollision_core.json_values import from_json, quoted
from lcollision_core.meshes import STRICT, ContactRules, FaceGroup
from lcollision_core.meshes.face_groups import faces_to_runs, require_groups, runs_to_faces

LEAST_BODY_SIZE = 1e-12
"""Least body size, in any unit; its inverse is the largest."""

_MAX_TEXT_LENGTH = 1000
_CARD = "the model's card"
_ADVICE = "train or copy the model again"


@dataclass(frozen=True)
class _StoredGroup:
    name: str
    runs: tuple[int, ...]
    about_joint: bool = False


@dataclass(frozen=True)
class _StoredRules:
    """Contact rules in a card's JSON; older cards have the near exclusion only."""

    near_exclusion: Annotated[float, Meta(ge=0.0, lt=1.0)]
    rules: ContactRules = STRICT
    groups: tuple[_StoredGroup, ...] = ()


@dataclass(frozen=True)
class ModelCard:
    """Units, names and origin of a model.

    Attributes
    ----------
    height : the body size, in the data's unit
    up_axis : 0, 1 or 2 for x, y or z
    domain_names : K unique names
    domain_colours : K strings "#rrggbb"
    pose_names : N names of the training poses
    source : the data that the model was trained on
    licence : of the model
    provenance : how it was made, JSON values by name
    domain_order : all K domains, indices from 0, in listing order; empty for the latent's order
    rules : which pairs of faces do not count
    groups : named groups of faces, pairs of which the rules may ignore
    metres : length of the data's unit, 1 if unknown

    Raises
    ------
    ModelFileError : an invalid value.
    """

    height: float
    up_axis: int
    domain_names: tuple[str, ...]
    domain_colours: tuple[str, ...]
    pose_names: tuple[str, ...]
    source: str
    licence: str
    provenance: Mapping[str, Any] = field(default_factory=dict)
    domain_order: tuple[int, ...] = ()
    rules: ContactRules = STRICT
    groups: tuple[FaceGroup, ...] = ()
    metres: float = 1.0

    def __post_init__(self) -> None:
        names, order, largest = self.domain_names, self.domain_order, 1.0 / LEAST_BODY_SIZE
        if not LEAST_BODY_SIZE <= self.height <= largest:
            raise ModelFileError(
                f"its body size (height) must be from {LEAST_BODY_SIZE:g} to {largest:g}"
            )
        if not 0.0 < self.metres < np.inf:
            raise ModelFileError("its unit (metres) must be a number above 0")
        if self.up_axis not in (0, 1, 2):
            raise ModelFileError("its up_axis must be 0, 1 or 2")
        if max(map(len, (*self.pose_names, self.source, self.licence))) > _MAX_TEXT_LENGTH:
            raise ModelFileError(
                f"its names, source and licence must be at most {_MAX_TEXT_LENGTH} characters"
            )
        for name in names:
            if not 0 < len(name) <= MAX_NAME_LENGTH or not name.isprintable():
                allowed = f"use 1 to {MAX_NAME_LENGTH} printable characters"
                raise ModelFileError(f"{name[:80]!r} cannot name a domain", allowed)
            if names.count(name) > 1:
                raise ModelFileError(f"two domains would be called {name!r}", "choose another name")
        if len(self.domain_colours) != len(names):
            raise ModelFileError("it must have one colour for each domain")
        for colour in self.domain_colours:
            if not re.fullmatch("#[0-9a-f]{6}", colour):
                raise ModelFileError(f"{quoted(colour)} is not a colour", "write it as in #0077bb")
        if order and sorted(order) != list(range(len(names))):
            what = f"{quoted(list(order))} is not an order of the {len(names)} domains"
            raise ModelFileError(what, "name each once")

    @property
    def near_exclusion(self) -> float:
        """Normalised distance along the surface within which pairs of faces do not count."""
        return self.rules.near_exclusion

    def to_metadata(self) -> dict[str, Any]:
        """Return JSON values for `from_metadata`."""
        values = asdict(replace(self, groups=()))
        del values["rules"], values["groups"]
        if not self.domain_order:
            del values["domain_order"]
        if self.metres == 1.0:
            del values["metres"]
        values["near_exclusion"] = self.near_exclusion
        if self.rules != ContactRules(self.near_exclusion):
            values["rules"] = self.rules.to_json()
        if self.groups:
            values["groups"] = [
                {"name": group.name, "runs": faces_to_runs(group.faces).tolist()}
                | ({"about_joint": True} if group.about_joint else {})
                for group in self.groups
            ]
        return values

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any], n_faces: int) -> ModelCard:
        """Rebuild a card from the result of `to_metadata`.

        Parameters
        ----------
        n_faces : of the model

        Raises
        ------
        ModelFileError : a value is missing or invalid.
        """
        try:
            stored = from_json(_StoredRules, metadata, "card")
            groups = tuple(
                FaceGroup(
                    group.name,
                    runs_to_faces(np.array(group.runs, dtype=np.int64), n_faces),
                    group.about_joint,
                )
                for group in stored.groups
            )
            rules = replace(stored.rules, near_exclusion=stored.near_exclusion)
            require_groups(rules, groups, n_faces)
            others = {name: metadata[name] for name in metadata if name not in ("rules", "groups")}
            return replace(from_json(cls, others, "card"), rules=rules, groups=groups)
        except (ValueError, ModelFileError) as error:
            reason = getattr(error, "headline", error)
            raise ModelFileError.because(_CARD, "is damaged", reason, _ADVICE) from error
