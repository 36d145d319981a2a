"""The options of stage 2, by preset."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from lcollision_core.errors import LCollisionError
from lcollision_core.options.field import Limits, require_limits

Loss = Literal["full", "no-rank", "no-depth", "entropy"]
"""Table 1 of Tan et al. 2021: Ours, entropy+PD, entropy+rank, entropy."""

Schedule = Literal["constant", "one-cycle"]

LEAST_PASSES = 6
"""Over any number of rows, where `shown_rows` shortens a training."""


@dataclass(frozen=True)
class PredictorConfig:
    """How a collision predictor is trained.

    Attributes
    ----------
    preset : names the network, see `presets.NETWORKS`
    by_domain : whether there is a predictor for each domain; False is the paper's baseline ND
    depth_weight, rank_weight, entropy_weight : of L_PD, L_rank, L_entropy; the entropy's is over
        0; the default preset has its own losses, without ranking
    rate : Adam's step size; the largest one with the schedule "one-cycle"
    schedule : "constant", or "one-cycle": up to `rate` in the first fifth of the steps, then down
        to 0, along cosines
    batch_rows : rows per step, of all processes together; even, for the ranking loss's pairs
    epochs : passes over the training rows, see `passes`
    shown_rows : where not None, passes over many rows end when so many have been shown
    average_passes : time constant, in passes, of the exponential mean of the weights that is
        watched and kept in their place; 0 takes them as they are
    balanced : whether the logit is shifted so that false positive and false negative rates are
        about equal, see `balanced_logit`

    Raises
    ------
    LCollisionError : a value is out of its range.
    """

    preset: str = "default"
    by_domain: bool = True
    depth_weight: Annotated[float, Limits(low=0)] = 5.0
    rank_weight: Annotated[float, Limits(low=0)] = 2.0
    entropy_weight: Annotated[float, Limits(above=0)] = 2.0
    rate: Annotated[float, Limits(above=0)] = 1e-3
    schedule: Schedule = "constant"
    batch_rows: Annotated[int, Limits(low=2)] = 32
    epochs: Annotated[int, Limits(low=1)] = 30
    shown_rows: int | None = None
    average_passes: Annotated[float, Limits(low=0)] = 0.0
    balanced: bool = False

    def __post_init__(self) -> None:
        require_limits(self)
        if self.batch_rows % 2:
            raise LCollisionError.must_be("batch_rows", "even", self.batch_rows)

    def passes(self, n_rows: int) -> int:
        """Return the number of passes over `n_rows` training rows: at most `epochs`.

        Many rows need fewer passes, but no fewer than `LEAST_PASSES`.
        """
        if self.shown_rows is None:
            return self.epochs
        return min(self.epochs, max(LEAST_PASSES, -(-self.shown_rows // n_rows)))

    def with_loss(self, loss: Loss) -> PredictorConfig:
        """Return the same options without some of the loss's terms.

        Raises
        ------
        LCollisionError : the preset's loss is another, without these terms.
        """
        if loss != "full" and self.preset != "paper":
            raise LCollisionError(
                f"only the preset paper can be trained with the loss {loss}", "add --preset paper"
            )
        return replace(
            self,
            depth_weight=0.0 if loss in ("no-depth", "entropy") else self.depth_weight,
            rank_weight=0.0 if loss in ("no-rank", "entropy") else self.rank_weight,
        )


PRESETS = {
    "default": PredictorConfig(
        "default",
        depth_weight=1.0,
        rank_weight=0.0,
        entropy_weight=1.0,
        rate=2e-3,
        schedule="one-cycle",
        batch_rows=128,
        epochs=10,
        shown_rows=2_800_000,
        balanced=True,
    ),
    # Its constant rate never lets the weights settle, and it overfits long before
    # the last pass; a long mean helps against both. The paper does not say which weights it kept.
    "paper": PredictorConfig("paper", average_passes=8.0),
}
"""The presets by name: what measures best, and Tan et al. 2021, section Evaluation."""
