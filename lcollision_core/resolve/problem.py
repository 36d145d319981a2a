"""The problem that a solver is given: nearest pose, no contact."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.exact import Contacts, nearest_within


class CollisionModel(Protocol):
    """What Resolve needs of a predictor; it must be smooth in the latent pose."""

    def logit_and_gradient(self, latent: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """(B, D) poses to (B,) collision logits and their (B, D) gradients."""


@dataclass
class Deadline:
    """Clock and job of one solve, polled at every evaluation.

    Attributes
    ----------
    budget : seconds, None for no limit
    job : whose cancellation ends the solve
    """

    budget: float | None = None
    job: Job = UNWATCHED
    started: float = field(default_factory=time.perf_counter)

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return time.perf_counter() - self.started

    @property
    def expired(self) -> bool:
        """Whether the budget is spent."""
        return self.budget is not None and self.seconds >= self.budget

    def poll(self) -> None:
        """Raise `CancelledError` once the token is set."""
        self.job.check()


@dataclass(eq=False)
class ResolveProblem:
    """min d(Z, Z*) subject to logit(Z) <= limit - margin and low <= Z <= high.

    Equation 1 of Tan et al. 2021 with the classifier's logit in place of its probability: the same
    set at margin 0, without the vanishing gradient of the sigmoid.

    Attributes
    ----------
    target : (D,) float64 array Z*
    metric : (D, D) float64 array G of d(Z, Z') = (Z - Z')^T G (Z - Z')
    code_weights : (D,) float64 array > 0, of the solvers' own distance
    low, high : (D,) float64 arrays; equal where a code is locked
    limit : the threshold's logit
    model : of the constraint; None without a predictor, and then there is none but the exact check
    deadline : polled before each evaluation
    evaluations : poses evaluated so far

    Notes
    -----
    The solvers keep the plain distance of the codes small, times the user's weights, whatever
    `metric` is: where moves that hardly displace a vertex are cheap, they find poses that the model
    wrongly calls free. What they find is then pulled back in `metric` against the exact check.
    """

    target: FloatArray
    metric: FloatArray
    code_weights: FloatArray
    low: FloatArray
    high: FloatArray
    limit: float
    model: CollisionModel | None
    deadline: Deadline = field(default_factory=Deadline)
    evaluations: int = 0

    @property
    def movable(self) -> npt.NDArray[np.bool_]:
        """(D,) which codes are not locked."""
        free: npt.NDArray[np.bool_] = self.high > self.low
        return free

    def distance(self, latent: FloatArray) -> FloatArray:
        """Measure d of (..., D) poses from Z*: (...)."""
        moved = latent - self.target
        squared: FloatArray = np.einsum("...i,ij,...j->...", moved, self.metric, moved)
        return squared

    def search_distance(self, latent: FloatArray) -> FloatArray:
        """Measure the solvers' squared distance of (..., D) poses from Z*: (...)."""
        squared: FloatArray = (latent - self.target) ** 2 @ self.code_weights
        return squared

    def nearest(self, centre: FloatArray, contacts: Contacts) -> FloatArray | None:
        """Return the pose nearest to a (D,) pose in all half-spaces, None if there is none."""
        return nearest_within(
            self.metric, centre, self.low, self.high, contacts.normals, contacts.offsets
        )

    def excess(self, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Evaluate (B, D) poses: how far the logits are above the limit, (B,), and (B, D) slopes.

        Raises
        ------
        CancelledError : the token was set.
        RuntimeError : there is no predictor.
        """
        if self.model is None:
            raise RuntimeError("there is no predictor to evaluate")
        self.deadline.poll()
        self.evaluations += len(latent)
        logit, gradient = self.model.logit_and_gradient(latent)
        return logit - self.limit, np.where(self.movable, gradient, 0.0)


@dataclass(frozen=True, eq=False)
class SolverOutcome:
    """The best iterate of a solver.

    Attributes
    ----------
    latent : (D,) float64 array: of the poses that satisfy the constraint the nearest, else the
        one that violates it least
    status : the solver's own, in a word or two
    converged : it ended by its tolerances
    feasible : the constraint holds, margin included
    iterations : of the solver
    """

    latent: FloatArray
    status: str
    converged: bool
    feasible: bool
    iterations: int


FEASIBLE = 1e-3
"""Tolerance of the constraint, in the logit."""


def rank(distance: float, violation: float) -> tuple[float, float]:
    """Order iterates: feasible ones by distance, before all others, those by violation."""
    return (0.0, distance) if violation <= FEASIBLE else (violation, distance)


_guard = Lock()
_inside = 0
_before = 1


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Keep torch to the calling thread, and give it its threads back after the last solve.

    A predictor's gradients of a few poses take a millisecond; on a busy machine threads that
    shared them would wait for each other up to fifty times as long.
    """
    global _inside, _before
    torch = sys.modules.get("torch")
    if torch is None:  # a predictor that needs none
        yield
        return
    with _guard:
        if _inside == 0:
            _before = torch.get_num_threads()
        _inside += 1
        # In each calling thread: torch keeps the number thread by thread.
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _guard:
            _inside -= 1
            if _inside == 0:
                torch.set_num_threads(_before)
