"""Score a predictor's answers against exact labels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.errors import LabelStoreError
from lcollision_core.jobs import UNWATCHED, Job, for_blocks
from lcollision_core.labels import LabelRows
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.predictor.metrics import (
    Counts,
    PredictorMetrics,
    area_under_roc,
    average_precision,
    measure,
    spearman,
    sure_ranges,
)
from lcollision_core.predictor.predictor import BATCH_ROWS, CollisionPredictor

_ROWS_PER_REPORT = 50 * BATCH_ROWS


@dataclass(frozen=True)
class PartScores:
    """Scores of a domain's predicted energy S_k as an indicator of its collisions.

    Attributes
    ----------
    domain : its index, from 0
    colliding : number of rows in which the domain has a penetration energy above 0
    auc : area under the ROC curve of S_k for those rows; None if one class is missing
    average_precision : area under the precision-recall curve; None likewise
    spearman : rank correlation of predicted and true energy over those rows; None if undefined
    """

    domain: int
    colliding: int
    auc: float | None
    average_precision: float | None
    spearman: float | None


@dataclass(frozen=True, eq=False)
class ScoredRows:
    """A predictor's answers for B labelled rows.

    Attributes
    ----------
    predictor : that gave the answers
    rows : the labels
    domain_energy : (B, K) float64 array, scaled S_k, also below 0; (B, 1) without domains
    logit : (B,) float64 array, logit of the collision probability
    """

    predictor: CollisionPredictor
    rows: LabelRows
    domain_energy: FloatArray
    logit: FloatArray

    @cached_property
    def probability(self) -> FloatArray:
        """(B,) the predicted probability of a collision."""
        probability: FloatArray = scipy.special.expit(self.logit)
        return probability

    def called(self, threshold: float = 0.5) -> npt.NDArray[np.bool_]:
        """(B,) whether each row's probability is above the decision threshold."""
        called: npt.NDArray[np.bool_] = self.probability > threshold
        return called

    def counts(self, threshold: float = 0.5) -> Counts:
        """Count correct and wrong verdicts."""
        return Counts.of(self.called(threshold), self.rows.colliding)

    def metrics(self, threshold: float = 0.5) -> PredictorMetrics:
        """Return the scores that a model file stores."""
        config, facts = self.predictor.config, self.predictor.facts
        metrics = measure(
            self.probability,
            self.domain_energy.sum(axis=1),
            self.rows.colliding,
            self.rows.energy / facts.energy_scale,
            facts.margin,
            threshold,
            depth=config.depth_weight > 0.0,
            rank=config.rank_weight > 0.0,
        )
        return replace(metrics, sure=sure_ranges(self.logit, self.rows.colliding))

    @property
    def auc(self) -> float | None:
        """The area under the ROC curve, None if one class is missing."""
        return area_under_roc(self.logit, self.rows.colliding)

    def parts(self) -> tuple[PartScores, ...]:
        """Score each domain; none for a predictor without domains."""
        predicted, truth = self.domain_energy, self.rows.domain_energy
        if predicted.shape != truth.shape:
            return ()
        colliding = truth > 0.0
        return tuple(
            PartScores(
                domain,
                int(there.sum()),
                area_under_roc(values, there),
                average_precision(values, there),
                spearman(values[there], energy[there]),
            )
            for domain, (values, energy, there) in enumerate(
                zip(predicted.T, truth.T, colliding.T, strict=True)
            )
        )


def score_rows(
    predictor: CollisionPredictor,
    rows: LabelRows,
    *,
    job: Job = UNWATCHED,
) -> ScoredRows:
    """Predict labelled rows of the same latent box, to score the predictor by them.

    Parameters
    ----------
    predictor : of the model that the rows label
    rows : at least one, none used to train the predictor
    job : reports rows; polled every few thousand rows

    Raises
    ------
    LabelStoreError : there are no rows.
    ShapeError : the rows are of another latent space, or not finite.
    CancelledError : the job was cancelled.
    """
    if not len(rows):
        raise LabelStoreError(
            "there are no rows to evaluate on", "label more with `lcollision label`"
        )
    n_outputs = predictor.embedding.n_domains if predictor.config.by_domain else 1
    energy, logit = np.empty((len(rows), n_outputs)), np.empty(len(rows))

    def score(start: int, stop: int) -> None:
        energy[start:stop], logit[start:stop] = predictor.scaled_outputs(rows.latent[start:stop])

    for_blocks(score, len(rows), _ROWS_PER_REPORT, 1, job)
    return ScoredRows(predictor, rows, energy, logit)
