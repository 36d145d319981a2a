"""Options and result of Resolve."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError


class Solver(StrEnum):
    """What solves the paper's problem; AUGLAG is the paper's method."""

    SQP = "sqp"
    AUGLAG = "auglag"
    SLSQP = "slsqp"
    CCSAQ = "ccsaq"


class Metric(StrEnum):
    """What is kept small: the displacement of the vertices, or of the codes as in the paper."""

    DISPLACEMENT = "eye"
    LATENT = "latent"


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
    NONE = "none"


@dataclass(frozen=True)
class ResolveOptions:
    """How to solve; the defaults are what measured best.

    Attributes
    ----------
    solver : of the paper's problem, the name of a `Solver`
    metric : what is kept small, the name of a `Metric`
    threshold : largest collision probability of a pose that counts as predicted free, in (0, 1)
    margin : >= 0, how far below the threshold's logit the solver is to go at first; by default 0
        with the further margins of the ladder tried beside it
    locked_domains : indices from 0 of domains that keep their codes: Z_k, and the one code of
        Z_0 whose component the domain is. Neighbours may still carry a locked domain along.
    group_weights : 1 + K numbers > 0 for (Z_0, Z_1, ..., Z_K), by which the cost of moving each
        group is multiplied; by default all 1
    time_budget : seconds after which the ladder goes straight to its last step; None for no limit.
        With one, results depend on the machine's speed.
    verify : check exactly and climb the ladder; False returns the solver's result
    seed : >= 0, of the restarts

    Raises
    ------
    LCollisionError : there is no such solver or metric, or a number is out of its range.
    """

    solver: str = Solver.SQP
    metric: str = Metric.DISPLACEMENT
    threshold: float = 0.5
    margin: float | None = None
    locked_domains: frozenset[int] = field(default_factory=frozenset)
    group_weights: tuple[float, ...] | None = None
    time_budget: float | None = None
    verify: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        for name, kind in (("solver", Solver), ("metric", Metric)):
            if getattr(self, name) not in set(kind):
                raise LCollisionError(
                    f"unknown {name} {getattr(self, name)!r}",
                    f"choose one of {', '.join(kind)}",
                )
        if not 0.0 < self.threshold < 1.0:
            raise LCollisionError.must_be(
                "the threshold", "a probability between 0 and 1", f"{self.threshold:g}"
            )
        if self.margin is not None and not 0.0 <= self.margin < math.inf:
            raise LCollisionError.must_be("the margin", "0 or more", f"{self.margin:g}")
        if self.time_budget is not None and not self.time_budget > 0.0:
            raise LCollisionError.must_be(
                "the time budget", "more than 0 seconds", f"{self.time_budget:g}"
            )
        if self.group_weights is not None and not all(
            0.0 < weight < math.inf for weight in self.group_weights
        ):
            raise LCollisionError("a group's weight must be a number above 0")

    @property
    def threshold_logit(self) -> float:
        """The logit of `threshold`, 0 for 0.5."""
        return math.log(self.threshold) - math.log1p(-self.threshold)


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
    exactly_free : by the exact check of the vertices rounded to float32; None without `verify`
    step : of the ladder, the one that resolved the collisions
    energy_before, energy_after : exact penetration energy; None without `verify`
    pairs_before, pairs_after : exact number of colliding pairs; None without `verify`
    latent_distance : ||Z - Z*|| / ||Z*||, or ||Z - Z*|| where Z* is the zero pose; 0 for a pose
        that did not move
    vertex_distance_mean, vertex_distance_max : from the decoded target
    iterations : of the solver at its least margin, for those of NLopt its evaluations; further
        margins and restarts do not count
    evaluations : poses for which the predictor was evaluated
    seconds : spent
    note : a sentence for the user, None if there is nothing to say
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
