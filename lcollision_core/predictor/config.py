"""A predictor's architectures, presets and training options; the split of its rows, its files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, auto
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError, listed
from lcollision_core.labels.labeller import measures
from lcollision_core.options import Limits, SampleDistribution, require_limits

Loss = Literal["full", "no-rank", "no-depth", "entropy"]
"""Table 1 of Tan et al. 2021: Ours, entropy+PD, entropy+rank, entropy."""

Schedule = Literal["constant", "one-cycle"]

LEAST_PASSES = 6
"""Least number of passes if `shown_rows` shortens a training."""


class Architecture(Enum):
    """The kinds of networks. mypy names the places that build and check a further one."""

    GEOMETRIC = auto()
    PAPER = auto()


@dataclass(frozen=True)
class PredictorConfig:
    """Options for training a collision predictor.

    Attributes
    ----------
    preset : name of the network, of `PRESETS`
    by_domain : whether there is a predictor for each domain; False is the paper's baseline ND
    depth_weight, rank_weight, entropy_weight : of L_PD, L_rank, L_entropy; the entropy's is above
        0; the default preset has its own losses, without ranking
    rate : Adam's step size; the largest one with the schedule "one-cycle"
    schedule : "constant", or "one-cycle": up to `rate` in the first fifth of the steps, then down
        to 0, along cosines
    batch_rows : rows per step, of all processes together; even, for the ranking loss's pairs
    epochs : passes over the training rows, see `passes`
    shown_rows : number of rows to show in all, which shortens training on many rows; or None
    average_passes : time constant, in passes, of the exponential mean of the weights, which is
        evaluated and stored in their place; 0 uses the weights themselves
    balanced : whether the logit is shifted so that false positive and false negative rates are
        about equal, see `balanced_logit`

    Raises
    ------
    LCollisionError : a value is out of range.
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

    @property
    def architecture(self) -> Architecture:
        """The kind of the preset's network."""
        return ARCHITECTURES[self.preset]

    @property
    def described(self) -> str:
        """The preset, and what was left out of it."""
        usual = PRESETS[self.preset]
        parts = {
            "domains": not self.by_domain,
            "the depth loss": self.depth_weight < usual.depth_weight,
            "the ranking loss": self.rank_weight < usual.rank_weight,
        }
        left_out = listed([part for part, is_left_out in parts.items() if is_left_out])
        return f"{self.preset} without {left_out}" if left_out else self.preset

    def with_loss(self, loss: Loss) -> PredictorConfig:
        """Return the same options without some of the loss's terms.

        Raises
        ------
        LCollisionError : the preset's loss lacks these terms.
        """
        if loss != "full" and self.architecture is not Architecture.PAPER:
            raise LCollisionError(
                f"only the preset paper can be trained with the loss {loss}", "add --preset paper"
            )
        return replace(
            self,
            depth_weight=0.0 if loss in ("no-depth", "entropy") else self.depth_weight,
            rank_weight=0.0 if loss in ("no-rank", "entropy") else self.rank_weight,
        )


_DEFAULT = PredictorConfig(
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
)

PRESETS = {
    "default": _DEFAULT,
    "large": replace(_DEFAULT, preset="large"),
    # With a constant rate the weights never settle, and the network overfits long before the last
    # pass; a long mean helps against both. The paper does not say which weights it kept.
    "paper": PredictorConfig("paper", average_passes=8.0),
}
"""The presets by name: the best by measurement for its time, a larger one of the same kind, and
Tan et al. 2021, section Evaluation."""

ARCHITECTURES = {
    "default": Architecture.GEOMETRIC,
    "large": Architecture.GEOMETRIC,
    "paper": Architecture.PAPER,
}
"""The kind of each preset's network."""


_EVERY = 10
"""Every n-th held-out row chooses the decision threshold."""

LEAST_BALANCING = 5000
"""Least number of rows to choose a decision threshold: the noise of fewer costs more than the
gain."""


@dataclass(frozen=True, eq=False)
class RowSplit:
    """The roles of rows: three disjoint, ascending int64 arrays of indices.

    Attributes
    ----------
    training : rows that train
    validation : rows that choose the decision threshold, or none
    held_out : rows that measure the result
    """

    training: npt.NDArray[np.int64]
    validation: npt.NDArray[np.int64]
    held_out: npt.NDArray[np.int64]


def split_rows(
    n_rows: int, config: PredictorConfig, draws: SampleDistribution = SampleDistribution.BOX
) -> RowSplit:
    """Split the samples 0, 1, ... of a store, drawn in one way.

    If there are many held-out rows, a tenth of them choose the decision threshold.
    """
    is_out = measures(np.arange(n_rows), draws)
    rest, held_out = np.flatnonzero(~is_out), np.flatnonzero(is_out)
    choosing = slice(None, None, _EVERY)
    if config.balanced and len(held_out[choosing]) >= LEAST_BALANCING:
        return RowSplit(rest, held_out[choosing], np.delete(held_out, choosing))
    return RowSplit(rest, rest[:0], held_out)


def held_out_index(
    n_rows: int,
    config: PredictorConfig,
    n_given: int,
    draws: SampleDistribution = SampleDistribution.BOX,
) -> npt.NDArray[np.int64]:
    """Return the ascending indices of the rows that neither trained nor chose the threshold.

    Parameters
    ----------
    n_rows : number of rows of the store now
    config : how the predictor was trained
    n_given : number of rows that the training was given, including held-out ones
    draws : how the store's samples are drawn
    """
    held_out = np.flatnonzero(measures(np.arange(n_rows), draws))
    return np.setdiff1d(held_out, split_rows(n_given, config, draws).validation)


@dataclass(frozen=True)
class PredictorStatus:
    """Progress of a training run.

    Attributes
    ----------
    epoch, epochs : passes over the rows, finished and in total
    done, total : steps of the whole run
    loss : mean over the steps of this epoch so far, None before the first
    held_out_errors : false positive and false negative rate on some held-out rows after the last
        epoch; None before that, and if a class has no rows
    preparing : fraction of the training rows whose patches are labelled; None once training began
    """

    epoch: int
    epochs: int
    done: int
    total: int
    loss: float | None
    held_out_errors: tuple[float | None, float | None]
    preparing: float | None = None


def patches_path(checkpoint: Path) -> Path:
    """Return the file beside a checkpoint that stores the labelled patches."""
    return checkpoint.with_name(f"{checkpoint.name}.patches")


def has_begun(checkpoint: Path) -> bool:
    """Whether a stopped run has left a checkpoint, or at least its patches."""
    return checkpoint.exists() or patches_path(checkpoint).exists()
