"""The choices of stage 1, with their defaults."""

from __future__ import annotations

from dataclasses import dataclass

from lcollision_core.errors import LCollisionError


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
    held_out_stride : every n-th pose is left out of a second model that measures how
        unseen poses fare; 0 trains no second model

    Raises
    ------
    LCollisionError : a value is out of its range.
    """

    n_domains: int = 10
    n_domain_codes: int = 10
    level1_epochs: int = 60
    level2_epochs: int = 20
    level1_rate: float = 0.1
    level2_rate: float = 0.04
    convolution_rate: float = 1e-3
    batch_poses: int = 16
    locality_weight: float = 0.03
    window_overlap: float = 3.7
    vertex_weight: float = 15.0
    held_out_stride: int = 10

    def __post_init__(self) -> None:
        least = {
            "n_domains": 1,
            "n_domain_codes": 1,
            "level1_epochs": 0,
            "level2_epochs": 0,
            "batch_poses": 1,
            "held_out_stride": 0,
        }
        for name, low in least.items():
            if getattr(self, name) < low:
                raise LCollisionError.must_be(name, f"at least {low}", getattr(self, name))
        rates = ("level1_rate", "level2_rate", "convolution_rate")
        for name in (*rates, "locality_weight", "vertex_weight"):
            if not getattr(self, name) >= 0.0:
                raise LCollisionError.must_be(name, "at least 0", getattr(self, name))
        if not self.window_overlap > 1.0:
            raise LCollisionError.must_be("window_overlap", "over 1", self.window_overlap)
        if self.held_out_stride == 1:
            raise LCollisionError(
                "held_out_stride 1 leaves no pose to train on", "use 0 or 2 and up"
            )
