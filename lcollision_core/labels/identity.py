"""What a store labels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lcollision_core.embedding import LatentBox
from lcollision_core.labels.labeller import Labeller
from lcollision_core.meshes import STRICT, ContactRules
from lcollision_core.meshes.face_groups import ignored_faces_digest
from lcollision_core.options.labels import Draws


@dataclass(frozen=True)
class StoreIdentity:
    """What a store labels; rows of two stores with one identity are interchangeable.

    Attributes
    ----------
    model : fingerprint of the model
    seed : of the samples
    n_domains : K
    height : the body size, in the data's unit, whose float32 values the vertices are rounded to
    near_exclusion : normalised
    box_low, box_high : D numbers each
    rules : which pairs of faces do not count; older stores have the near exclusion only
    ignored_faces : digest of the groups that the rules ignore pairs of, empty if none
    draws : what the samples are drawn from; older stores have samples of the box

    Raises
    ------
    ValueError : there is no box or no domain.
    """

    model: str
    seed: int
    n_domains: int
    height: float
    near_exclusion: float
    box_low: tuple[float, ...]
    box_high: tuple[float, ...]
    rules: ContactRules = STRICT
    ignored_faces: str = ""
    draws: Draws = Draws.BOX

    def __post_init__(self) -> None:
        rules = replace(self.rules, near_exclusion=self.near_exclusion)
        object.__setattr__(self, "rules", rules)
        if not 0 < len(self.box_low) == len(self.box_high) or self.n_domains < 1:
            raise ValueError("there is no latent box, or no domain")

    @classmethod
    def of(cls, labeller: Labeller, seed: int) -> StoreIdentity:
        """Return the identity of the samples of a model drawn with a seed."""
        return cls(
            model=labeller.fingerprint,
            seed=seed,
            n_domains=labeller.embedding.n_domains,
            height=labeller.body_size,
            near_exclusion=labeller.rules.near_exclusion,
            box_low=tuple(labeller.embedding.box.low.tolist()),
            box_high=tuple(labeller.embedding.box.high.tolist()),
            rules=labeller.rules,
            ignored_faces=ignored_faces_digest(labeller.rules, labeller.groups),
            draws=labeller.draws,
        )

    @property
    def box(self) -> LatentBox:
        """The latent box."""
        return LatentBox(np.array(self.box_low), np.array(self.box_high))
