"""The least overlap within a largest change, where no collision-free pose is so near."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lcollision_core.contact import SelfCollisions
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import ExactCheck
from lcollision_core.posing.contact_constraints import ContactRegions, least_step
from lcollision_core.posing.depth_slopes import add_slopes
from lcollision_core.resolve.problem import ResolveProblem
from lcollision_core.resolve.pull_back import pull_back

_WAYS = 4
"""Poses that are headed for, in the order given."""

_STAGES = (0.5, 1.0)
"""Shares of the largest change, each of which begins with what the one before found."""

_ROUNDS, _HALVINGS = 12, 4
_LEAST_GAIN = 0.01
_DAMPING = 1e-2
"""Share of the mean curvature that a step adds in all directions."""

_BOUNDED, _NEARLY = 8, 0.8
"""Body parts whose farthest vertex a step bounds, from this share of the bound on."""

_SHRINKS, _WITHIN = 10, 1.0 - 1e-4


@dataclass(frozen=True, eq=False)
class _Seen:
    """A pose that was checked: (D,) codes, (V, 3) decoded vertices, and how it collides."""

    latent: FloatArray
    decoded: FloatArray
    found: SelfCollisions


def _energy(seen: _Seen) -> float:
    return seen.found.energy


class LeastOverlap:
    """Finds poses of little overlap of which no vertex moves farther than a bound.

    Parameters
    ----------
    check, problem : of the pose
    largest_change : > 0, of a vertex from its place in the decoded Z*, in normalised length
    """

    def __init__(self, check: ExactCheck, problem: ResolveProblem, largest_change: float) -> None:
        self._check, self._problem = check, problem
        self._most = self._bound = largest_change
        self._start = self._look(problem.target)

    def is_within(self, latent: FloatArray) -> bool:
        """Whether a (D,) pose moves no vertex farther than the bound."""
        return self._change(self._check.decode(latent)[0]) <= self._most

    def find(self, ends: Sequence[FloatArray]) -> FloatArray:
        """Return the pose of least exact energy that is found within the bound.

        From Z* and from the best place on the ways to some poses, by Gauss-Newton steps on the
        depths of the contacts, while the bound grows.

        Parameters
        ----------
        ends : (D,) arrays within the problem's bounds, such as free poses beyond the bound

        Returns
        -------
        latent : (D,) float64 array; it has no more energy, no more pairs and none deeper than Z*

        Raises
        ------
        CancelledError : the problem's token was set.
        """
        best = self._start
        for share in _STAGES:
            self._bound = share * self._most
            ways = [self._look(self._within(end)) for end in ends[:_WAYS]]
            starts = {
                id(seen): seen for seen in (self._start, best, *sorted(ways, key=_energy)[:1])
            }
            ends_of = [*map(self._descend, starts.values()), best]
            better = (one for one in ends_of if not one.found.exceeds(self._start.found))
            best = min(better, key=_energy)
            if not best.found.colliding:
                break
        if not best.found.colliding:
            nearer = pull_back(self._check, self._problem, best.latent)
            return nearer if self.is_within(nearer) else best.latent
        return best.latent

    def _look(self, latent: FloatArray) -> _Seen:
        self._problem.deadline.poll()
        decoded = self._check.decode(latent)[0]
        return _Seen(latent, decoded, self._check.find(self._check.exported(decoded)))

    def _change(self, decoded: FloatArray) -> float:
        return float(np.linalg.norm(decoded - self._start.decoded, axis=1).max())

    def _within(self, latent: FloatArray) -> FloatArray:
        """Return the pose towards a (D,) pose at which the bound is reached."""
        share, target = 1.0, self._problem.target
        for _ in range(_SHRINKS):
            here = target + share * (latent - target)
            change = self._change(self._check.decode(here)[0])
            if change <= self._bound:
                return here
            share *= _WITHIN * self._bound / change
        return target

    def _descend(self, here: _Seen) -> _Seen:
        """Return the last pose of a descent that exceeds Z* in no way, or where it begins."""
        last = here
        for _ in range(_ROUNDS):
            if not here.found.colliding or self._problem.deadline.expired:
                break
            goal = self._goal(here)
            if goal is None:
                break
            for halving in range(_HALVINGS):
                way = 0.5**halving * (goal - here.latent)
                trial = self._look(self._within(here.latent + way))
                if _energy(trial) < (1.0 - _LEAST_GAIN) * _energy(here):
                    break
            else:
                break
            here = trial
            if not here.found.exceeds(self._start.found):
                last = here
        return last

    def _goal(self, here: _Seen) -> FloatArray | None:
        """Return the codes at which the contacts are least, to first order.

        Each contact, of two body parts, is one residual: the root of its energy.
        """
        space, found, problem = self._check.space, here.found, self._problem
        regions = ContactRegions.of(space, found)
        residuals = np.sqrt(regions.squared_depth)
        weights = found.penetration_depth / residuals[regions.of_pair]
        moved = here.decoded - self._start.decoded
        lengths = np.linalg.norm(moved, axis=1)
        order = np.argsort(-lengths, kind="stable")
        _, first = np.unique(space.vertex_domain[order], return_index=True)
        farthest = order[np.sort(first)[:_BOUNDED]]
        farthest = farthest[lengths[farthest] > _NEARLY * self._bound]
        by_vertices = np.zeros((len(residuals) + len(farthest), *moved.shape))
        faces, apart = space.topology.faces[found.pairs], self._check.clearance > 0.0
        add_slopes(by_vertices, regions.of_pair, faces, here.decoded, weights, may_be_apart=apart)
        bounds = np.arange(len(residuals), len(by_vertices))
        by_vertices[bounds, farthest] = moved[farthest] / lengths[farthest, None]
        by_codes = space.pull_back(here.latent, by_vertices)
        rows, normals = np.split(by_codes, [len(residuals)])
        hessian, metric = rows.T @ rows, problem.metric
        if not np.trace(hessian) > 0.0:
            return None
        hessian += _DAMPING * np.trace(hessian) / np.trace(metric) * metric
        offsets = normals @ here.latent + self._bound - lengths[farthest]
        return least_step(
            hessian,
            rows.T @ residuals,
            here.latent,
            problem.low,
            problem.high,
            normals,
            offsets,
        )
