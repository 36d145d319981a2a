"""What a store labels, and which of its rows are held out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lcollision_core.embedding import LatentBox
from lcollision_core.labels.labeller import Labeller
from lcollision_core.meshes import STRICT, ContactRules
from lcollision_core.meshes.face_groups import ignored_faces_digest


def is_held_out(index: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Return which samples test a predictor and never train it: those whose index ends in 7, 8, 9.

    A fixed 30 %, so that a row keeps its side when its store grows. Samples are independent, so
    any fixed choice is as random as another.

    Parameters
    ----------
    index : (B,) integer array, the samples' indices in the store
    """
    held_out: npt.NDArray[np.bool_] = np.asarray(index) % 10 >= 7
    return held_out


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
        )

    @property
    def box(self) -> LatentBox:
        """The box that the samples fill."""
        return LatentBox(np.array(self.box_low), np.array(self.box_high))
