"""What a learned model can do, in a few numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lcollision_core.bodies import LearnedBody
from lcollision_core.learning_state import STAGES
from lcollision_core.predictor import KindScores


@dataclass(frozen=True)
class LearnedCard:
    """The figures of a learned model.

    Attributes
    ----------
    model : path of its file
    name : of the model
    vertices, poses : of what it was learned from
    parts : body parts
    error_mean, error_max : of the poses learned from, normalised
    accuracy, false_positive_rate, false_negative_rate, majority_rate : of the predictor on samples
        that it has not seen; a rate is None where no sample can tell
    samples : that were labelled
    colliding_share : of the latent box
    rules : what is not counted, in words; "" where all pairs count
    seconds : by stage
    notes : sentences on what was changed when the poses were read
    kinds : scores of the predictor on poses of several kinds
    """

    model: str
    name: str
    vertices: int
    poses: int
    parts: int
    error_mean: float
    error_max: float
    accuracy: float
    false_positive_rate: float | None
    false_negative_rate: float | None
    majority_rate: float
    samples: int
    colliding_share: float
    rules: str
    seconds: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    kinds: tuple[KindScores, ...] = ()


def card_of(model: LearnedBody, path: str) -> LearnedCard:
    """Return the card of a model that `learn_model` made, from its file.

    Raises
    ------
    ValueError : it has no predictor, or was not measured.
    """
    record, metrics = model.predictor_record, model.embedding.metrics
    if record is None or record.metrics is None or metrics is None:
        raise ValueError(f"{path} was not trained to its end")
    scores = record.metrics
    spent = model.card.provenance.get("seconds", {})
    return LearnedCard(
        model=path,
        name=model.name,
        vertices=model.n_vertices,
        poses=len(model.card.pose_names),
        parts=len(model.domain_names),
        error_mean=metrics.mean,
        error_max=metrics.max,
        accuracy=scores.accuracy,
        false_positive_rate=scores.false_positive_rate,
        false_negative_rate=scores.false_negative_rate,
        majority_rate=scores.majority_rate,
        samples=record.facts.rows,
        colliding_share=record.facts.colliding_share,
        rules="" if model.rules.exclude_nothing else model.rules.described(),
        seconds={stage: float(spent.get(stage, 0.0)) for stage in STAGES},
        notes=tuple(map(str, model.card.provenance.get("notes", ()))),
        kinds=record.kinds,
    )
