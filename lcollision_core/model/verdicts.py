"""The hybrid verdict: the estimate where it is sure, the exact check where it is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.model.posable_body import PosableBody
from lcollision_core.model.pose_model import PoseModel


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Which of B poses collide.

    Attributes
    ----------
    colliding : (B,) bool array
    exact : (B,) bool array, which were checked exactly; the others are estimates
    """

    colliding: npt.NDArray[np.bool_]
    exact: npt.NDArray[np.bool_]


def judge_poses(
    model: PosableBody,
    latent: npt.ArrayLike,
    error_bound: float = 0.0,
    clearance: float = 0.0,
    n_threads: int | None = None,
) -> Verdicts:
    """Tell which poses collide, exactly or, within an error bound, by the estimate.

    Parameters
    ----------
    model : of the poses
    latent : (B, D) finite array
    error_bound : share of wrong verdicts, measured on samples of the latent box, that may not be
        exceeded; 0 checks every pose exactly, as does a body without a predictor
    clearance : in [0, 1), normalised; with one, no pose is estimated to be free
    n_threads : one for each available core by default

    Raises
    ------
    ShapeError : another shape, a number that is not finite, or a clearance out of its range.
    """
    codes = np.atleast_2d(np.asarray(latent, dtype=np.float64))
    free = colliding = np.zeros(len(codes), dtype=np.bool_)
    if error_bound > 0.0 and isinstance(model, PoseModel) and model.has_predictor:
        predictor = model.require_predictor()
        store = predictor.facts.store
        # By other contact rules, as with a tolerated depth, no estimate is sure.
        if store is None or store.rules == model.rules:
            free, colliding = predictor.sure_verdicts(codes, error_bound)
        if clearance > 0.0:
            free = np.zeros_like(free)
    exact = ~(free | colliding)
    verdict = colliding.copy()
    if exact.any():
        vertices = model.decode(codes[exact], n_threads).astype(np.float32)
        detector = model.detector.with_clearance(clearance)
        verdict[exact] = detector.are_colliding(vertices, workers=n_threads)
    return Verdicts(verdict, exact)
