"""Long work around learning a model, for the window's worker thread."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lcollision_core.jobs import Job

if TYPE_CHECKING:
    from lcollision_core.bodies import LearnedBody
    from lcollision_core.tasks.learning import LearnedCard
    from lcollision_core.tasks.sources import SourcesSummary


@dataclass(frozen=True, eq=False)
class LearnedModel:
    """A learned model and its figures."""

    model: LearnedBody
    card: LearnedCard


def load_learning(_: Job) -> None:
    """Import the modules for looking at runs, which takes longer than a frame."""
    import lcollision_core.tasks.learning  # noqa: F401


def look_into_sources(paths: tuple[Path, ...], job: Job) -> SourcesSummary:
    """Summarise the files that a model is to be learned from.

    Raises
    ------
    LCollisionError : nothing can be learned from them.
    """
    from lcollision_core.tasks.sources import summarise_sources

    return summarise_sources(paths, job)


def read_card(model_file: str, _: Job) -> LearnedModel:
    """Read a learned model and its figures."""
    from lcollision_core.bodies import LearnedBody
    from lcollision_core.tasks.learning import card_of

    model = LearnedBody.load(model_file)
    return LearnedModel(model, card_of(model, model_file))
