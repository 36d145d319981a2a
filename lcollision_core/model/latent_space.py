"""What the numbers of a latent pose are: groups, names, colours and ranges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.labels.box import BOX_SCALE

WHOLE_BODY = "Whole body"


@dataclass(frozen=True)
class LatentGroup:
    """Codes that belong together: Z_0, or the Z_k of one domain.

    Attributes
    ----------
    name : "Whole body", or the domain's name
    colour : "#rrggbb" of the domain, None for the whole body
    codes : where the group stands in the latent
    code_names : one for each code; those of the whole body are the domains that they move most
    """

    name: str
    colour: str | None
    codes: slice
    code_names: tuple[str, ...]


@dataclass(frozen=True)
class LatentSpace:
    """All of Z_all = (Z_0, Z_1, ..., Z_K).

    Attributes
    ----------
    groups : 1 + K groups in the latent's order
    minimum, maximum : (D,) float64 arrays, read-only: the training poses' range of each code,
        the first below 0 and the second above
    """

    groups: tuple[LatentGroup, ...]
    minimum: npt.NDArray[np.float64]
    maximum: npt.NDArray[np.float64]

    @property
    def size(self) -> int:
        """D, the number of codes."""
        return len(self.minimum)

    def sample(self, n_poses: int, generator: np.random.Generator) -> npt.NDArray[np.float64]:
        """Draw poses uniformly from the box of `BOX_SCALE` times the training range.

        Returns
        -------
        latent : (n_poses, D) float64 array
        """
        low, high = BOX_SCALE * self.minimum, BOX_SCALE * self.maximum
        return low + (high - low) * generator.random((n_poses, self.size))
