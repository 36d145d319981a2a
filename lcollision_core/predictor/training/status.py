"""Progress of a training run, and the files beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class PredictorStatus:
    """Progress of a training run.

    Attributes
    ----------
    epoch, epochs : passes over the rows, finished and in all
    done, total : steps of the whole run
    loss : mean over the steps of this epoch so far, None before the first
    held_out_errors : false positive and false negative rate on some held-out rows after the last
        epoch; None before that, and where no row is of the kind
    preparing : fraction of the training rows whose patches are labelled; None once training began
    """

    epoch: int
    epochs: int
    done: int
    total: int
    loss: float | None
    held_out_errors: tuple[float | None, float | None]
    preparing: float | None = None


StatusCallback = Callable[[PredictorStatus], None]


def patches_path(checkpoint: Path) -> Path:
    """Return the file beside a checkpoint that keeps the labelled patches."""
    return checkpoint.with_name(f"{checkpoint.name}.patches")


def has_begun(checkpoint: Path) -> bool:
    """Whether a stopped run goes on from a checkpoint, or at least from its patches."""
    return checkpoint.exists() or patches_path(checkpoint).exists()
