"""The codes of a body as they are shown: grouped by body part, or the weights of morph targets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

WHOLE_BODY = "Whole body"
SHAPES = "Face and shapes"


@dataclass(frozen=True)
class LatentGroup:
    """Codes that belong together: Z_0, the Z_k of one domain, or the weights of morph targets.

    Attributes
    ----------
    name : "Whole body", the domain's name, or "Face and shapes"
    colour : "#rrggbb" of the domain, None for the others
    codes : slice of the group in the latent
    code_names : name of each code within the group: for the whole body the domain that it moves
        most, for a domain "motion 1" and so on; for a character the joint that it turns
    """

    name: str
    colour: str | None
    codes: slice
    code_names: tuple[str, ...]

    def full_name(self, index: int) -> str:
        """Return the full name of one of the group's codes, as in "arm, motion 3"."""
        name = self.code_names[index]
        return name if self.colour is None else f"{self.name}, {name}"


@dataclass(frozen=True)
class LatentSpace:
    """All of Z_all = (Z_0, Z_1, ..., Z_K).

    Attributes
    ----------
    groups : 1 + K groups in the latent's order, then one of shapes if there are any
    low, high : (D,) float64 arrays, read-only: the bounds of the model's box, below and above 0
    at_rest : (D,) float64 array, read-only: what is displayed for a code of 0, before `shown`; the
        weights at rest of morph targets
    shown : (D,) float64 array > 0, read-only: factors from codes to displayed numbers
    units : D units of the displayed numbers, such as "°"; "" for none
    """

    groups: tuple[LatentGroup, ...]
    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    at_rest: npt.NDArray[np.float64]
    shown: npt.NDArray[np.float64]
    units: tuple[str, ...]

    @property
    def size(self) -> int:
        """D, the number of codes."""
        return len(self.low)

    def sample(self, n_poses: int, generator: np.random.Generator) -> npt.NDArray[np.float64]:
        """Draw poses uniformly from the box between `low` and `high`.

        Returns
        -------
        latent : (n_poses, D) float64 array
        """
        return self.low + (self.high - self.low) * generator.random((n_poses, self.size))
