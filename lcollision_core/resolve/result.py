"""Result of Resolve."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt


class Step(StrEnum):
    """The step of the ladder that a result comes from.

    After each the pose is pulled back towards the target: see `pull_back`.
    """

    UNCHANGED = "unchanged"
    NEIGHBOUR = "neighbour"
    SOLVER = "solver"
    MARGIN = "margin"
    POLISH = "polish"
    RESTART = "start"
    TOWARDS = "towards"
    FALL_BACK = "walk-back"
    SOFT = "soft"
    NONE = "none"


@dataclass(frozen=True, eq=False)
class ResolveResult:
    """Where Resolve ended. Lengths are normalised, energies in squared normalised length.

    Three facts are kept separately: that the solver converged, that the predictor calls the pose
    free, and that it is free by the exact check.

    Attributes
    ----------
    latent : (D,) float64 array, read-only
    vertices : (V, 3) array, read-only, in the data's unit: what the exact check saw, and what is to
        be written; float32 in the model's coordinates, or float64 where the pose is placed
    solver_status : the status of the solver of the paper's problem at its least margin, "not run"
        where none ran, "no predictor" where the steps did without
    converged : that it ended by its own tolerances
    predicted_free : the collision probability of `latent` is at most the threshold; None of a body
        without a predictor
    exactly_free : by the exact check of the vertices rounded to float32, with the clearance; None
        without `verify`
    step : of the ladder, the one that resolved the collisions
    energy_before, energy_after : exact penetration energy; None without `verify`. With a clearance,
        depths are what pairs lack.
    pairs_before, pairs_after : exact number of colliding pairs; None without `verify`
    latent_distance : ||Z - Z*|| / ||Z*||, or ||Z - Z*|| where Z* is the zero pose; 0 for a pose
        that did not move
    vertex_distance_mean, vertex_distance_max : from the decoded target
    iterations : of the solver at its least margin, for those of NLopt its evaluations; further
        margins and restarts do not count
    evaluations : poses for which the predictor was evaluated
    seconds : spent
    note : a sentence for the user, None if there is nothing to say
    clearance : that was asked for, normalised
    largest_change : of a vertex that was asked for, normalised; None if any was allowed
    deepest_after : the largest depth of a colliding pair, 0 of a free pose; None without `verify`
    least_distance : where a clearance was asked for, the least signed distance between parts; None
        where it is at least both `DISTANCE_BOUND` and the clearance
    """

    latent: npt.NDArray[np.float64]
    vertices: npt.NDArray[np.floating]
    solver_status: str
    converged: bool
    predicted_free: bool | None
    exactly_free: bool | None
    step: Step
    energy_before: float | None
    energy_after: float | None
    pairs_before: int | None
    pairs_after: int | None
    latent_distance: float
    vertex_distance_mean: float
    vertex_distance_max: float
    iterations: int
    evaluations: int
    seconds: float
    note: str | None = None
    clearance: float = 0.0
    least_distance: float | None = None
    largest_change: float | None = None
    deepest_after: float | None = None
