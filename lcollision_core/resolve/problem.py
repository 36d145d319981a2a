"""The optimisation problem of Resolve: the nearest pose without contact."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from threading import Lock
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from lcollision_core.compiled import working_seconds
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing.exact import Contacts, least_step


class CollisionModel(Protocol):
    """The interface that Resolve needs of a predictor, smooth in the latent pose."""

    def logit_and_gradient(self, latent: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Return (B,) collision logits of (B, D) poses, and their (B, D) gradients."""


@dataclass
class Deadline:
    """Clock and job of one solve, polled at every evaluation.

    Attributes
    ----------
    budget : seconds, None for no limit
    job : its cancellation ends the solve
    """

    budget: float | None = None
    job: Job = UNWATCHED
    started: float = field(default_factory=working_seconds)

    @property
    def seconds(self) -> float:
        """Seconds so far, without those spent compiling."""
        return working_seconds() - self.started

    @property
    def expired(self) -> bool:
        """Whether the budget is spent."""
        return self.budget is not None and self.seconds >= self.budget

    def poll(self) -> None:
        """Raise `CancelledError` if the job is cancelled."""
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
    low, high : (D,) float64 arrays; equal for a locked code
    limit : the threshold's logit
    model : of the constraint; None without a predictor, where only the exact check constrains
    deadline : polled before each evaluation
    evaluations : number of poses evaluated so far

    Notes
    -----
    Whatever `metric` is, the solvers minimise the plain distance of the codes, times the user's
    weights: if moves that hardly displace a vertex are cheap, they find poses that the model
    wrongly calls free. Their results are then pulled back in `metric` against the exact check.
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
        """(D,) whether each code is not locked."""
        free: npt.NDArray[np.bool_] = self.high > self.low
        return free

    def distance(self, latent: FloatArray) -> FloatArray:
        """Return the (...) distances d of (..., D) poses from Z*."""
        moved = latent - self.target
        squared: FloatArray = np.einsum("...i,ij,...j->...", moved, self.metric, moved)
        return squared

    def search_distance(self, latent: FloatArray) -> FloatArray:
        """Return the solvers' (...) squared distances of (..., D) poses from Z*."""
        squared: FloatArray = (latent - self.target) ** 2 @ self.code_weights
        return squared

    def nearest_first(self, latents: FloatArray) -> FloatArray:
        """Return (F, D) poses with the locked codes of Z*, ordered by distance from it."""
        kept = np.where(self.movable, latents, self.target)
        ordered: FloatArray = kept[np.argsort(self.distance(kept), kind="stable")]
        return ordered

    def nearest(self, centre: FloatArray, contacts: Contacts) -> FloatArray | None:
        """Return the pose within all half-spaces nearest to a (D,) pose, None if there is none."""
        half_spaces = contacts.normals, contacts.offsets
        gradient = np.zeros_like(centre)
        return least_step(self.metric, gradient, centre, self.low, self.high, *half_spaces)

    def excess(self, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how far the logits of (B, D) poses exceed the limit, (B,), and (B, D) slopes.

        Raises
        ------
        CancelledError : the job was cancelled.
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
    latent : (D,) float64 array: the nearest pose that satisfies the constraint, else the pose that
        violates it least
    status : the solver's status, in a word or two
    converged : whether it ended by its tolerances
    feasible : whether the constraint holds, including the margin
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
    """Return a sort key of iterates: feasible ones by distance, then the others by violation."""
    return (0.0, distance) if violation <= FEASIBLE else (violation, distance)


_guard = Lock()
_inside = 0
_before = 1


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Restrict torch to the calling thread, and restore its threads after the last solve.

    A predictor's gradients of a few poses take a millisecond; on a busy machine, threads that
    shared them would wait for each other up to fifty times as long.
    """
    global _inside, _before
    if "torch" not in sys.modules:  # a predictor that needs none
        yield
        return
    # Wait if another thread is importing it.
    torch: Any = import_module("torch")
    with _guard:
        if _inside == 0:
            _before = torch.get_num_threads()
        _inside += 1
        # In each calling thread: torch's setting is per thread.
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _guard:
            _inside -= 1
            if _inside == 0:
                torch.set_num_threads(_before)
