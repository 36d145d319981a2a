"""The hybrid verdict: the estimate where it is sure, the exact check where it is not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.posable_body import PosableBody
from lcollision_core.bodies.pose_model import PoseModel
from lcollision_core.contact import CollisionDetector

if TYPE_CHECKING:
    from lcollision_core.motion import Motion


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
    detector: CollisionDetector | None = None,
) -> Verdicts:
    """Tell which poses collide, exactly or, within an error bound, by the estimate.

    Parameters
    ----------
    model : of the poses
    latent : (B, D) finite array
    error_bound : share of wrong verdicts, measured on samples of the latent box, that may not be
        exceeded; 0 checks every pose exactly, as does a body without a predictor
    detector : the model's, or that with a clearance, by which no pose is estimated to be free

    Raises
    ------
    ShapeError : another shape, or a number that is not finite.
    """
    codes = np.atleast_2d(np.asarray(latent, dtype=np.float64))
    chosen = detector or model.detector
    free, colliding = _sure_verdicts(model, codes, error_bound, chosen.clearance)
    exact = ~(free | colliding)
    verdict = colliding.copy()
    if exact.any():
        vertices = model.decode(codes[exact]).astype(np.float32)
        verdict[exact] = chosen.are_colliding(vertices)
    return Verdicts(verdict, exact)


def estimated_free(
    model: PosableBody, motion: Motion, error_bound: float, clearance: float = 0.0
) -> npt.NDArray[np.bool_]:
    """Tell which frames of a motion are free by the estimate: (T,) bool.

    None of them where the codes do not hold all of a frame.

    Parameters
    ----------
    error_bound : see `judge_poses`
    clearance : normalised; with one, no frame is
    """
    bound = error_bound if motion.displacement is None else 0.0
    return _sure_verdicts(model, motion.codes, bound, clearance)[0]


def _sure_verdicts(
    model: PosableBody, codes: npt.NDArray[np.float64], error_bound: float, clearance: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return which poses are surely free, and which surely collide, by the estimate."""
    nothing = np.zeros(len(codes), dtype=np.bool_)
    if error_bound <= 0.0 or not isinstance(model, PoseModel) or not model.has_predictor:
        return nothing, nothing
    predictor = model.require_predictor()
    store = predictor.facts.store
    # By other contact rules, as with a tolerated depth, no estimate is sure.
    if store is not None and store.rules != model.rules:
        return nothing, nothing
    free, colliding = predictor.sure_verdicts(codes, error_bound)
    return (nothing if clearance > 0.0 else free), colliding
