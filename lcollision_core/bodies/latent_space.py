"""The entries of a latent pose: groups, names, colours and ranges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

WHOLE_BODY = "Whole body"


@dataclass(frozen=True)
class LatentGroup:
    """Codes that belong together: Z_0, or the Z_k of one domain.

    Attributes
    ----------
    name : "Whole body", or the domain's name
    colour : "#rrggbb" of the domain, None for the whole body
    codes : slice of the group in the latent
    code_names : what each code is called within the group: for the whole body the domain that it
        moves most, for a domain "motion 1" and so on; of a character the joint that it turns
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
    groups : 1 + K groups in the latent's order
    low, high : (D,) float64 arrays, read-only: the ends of the model's box, below 0 and above
    shown : (D,) float64 array > 0, read-only: people are shown the codes times this
    units : D texts, what the shown numbers are in, as "°"; "" for none
    """

    groups: tuple[LatentGroup, ...]
    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
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
