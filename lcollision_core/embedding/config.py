"""The choices of stage 1, with their defaults."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from lcollision_core.errors import LCollisionError
from lcollision_core.options.field import Limits, require_limits


@dataclass(frozen=True)
class EmbeddingConfig:
    """How a latent space is trained.

    Attributes
    ----------
    n_domains : K = |Z_0|, codes of level 1 and domains
    n_domain_codes : |Z_k|, codes of each domain; fewer where the training poses span less
    level1_epochs, level2_epochs : passes over the poses; without any, level 2 stays as the
        principal components of what level 1 leaves, for a slightly larger error
    level1_rate, level2_rate : Adam's step sizes for the fully connected layers, whose weights
        have a root mean square of 1 here; the second falls to 0 along a cosine
    convolution_rate : Adam's step size for the graph convolutions of both levels
    batch_poses : poses per step of level 2
    locality_weight : of the locality loss, divided by the root of V, beside the squared feature
        error per vertex
    window_overlap : effective domains per vertex of the windows in which level 1's components
        start, at most (K + 1) / 2; the distances of the locality loss follow the windows
    vertex_weight : of the mean squared vertex distance, in squared normalised lengths, beside the
        squared feature error per vertex, in level 2
    encoded_codes : whether the training poses keep the encoders' own codes, as in Tan et al. 2021;
        else these are fitted to the vertices, for a smaller error
    held_out_stride : every n-th pose is left out of a second model that measures how
        unseen poses fare; 0 trains no second model

    Raises
    ------
    LCollisionError : a value is out of its range.
    """

    n_domains: Annotated[int, Limits(low=1)] = 10
    n_domain_codes: Annotated[int, Limits(low=1)] = 10
    level1_epochs: Annotated[int, Limits(low=0)] = 60
    level2_epochs: Annotated[int, Limits(low=0)] = 20
    level1_rate: Annotated[float, Limits(low=0)] = 0.1
    level2_rate: Annotated[float, Limits(low=0)] = 0.04
    convolution_rate: Annotated[float, Limits(low=0)] = 1e-3
    batch_poses: Annotated[int, Limits(low=1)] = 16
    locality_weight: Annotated[float, Limits(low=0)] = 0.03
    window_overlap: Annotated[float, Limits(above=1)] = 3.7
    vertex_weight: Annotated[float, Limits(low=0)] = 15.0
    encoded_codes: bool = False
    held_out_stride: Annotated[int, Limits(low=0)] = 10

    def __post_init__(self) -> None:
        require_limits(self)
        if self.held_out_stride == 1:
            raise LCollisionError(
                "held_out_stride 1 leaves no pose to train on", "use 0 or 2 and up"
            )
