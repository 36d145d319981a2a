"""Pull a free pose back towards the one that was asked for, as far as it stays exactly free."""

from __future__ import annotations

import numpy as np

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.contacts import Contacts
from lcollision_core.resolve.exact import ExactCheck
from lcollision_core.resolve.problem import ResolveProblem

FIRST_HALVINGS, FURTHER_HALVINGS = 3, 5
SLIDES = 5
_SLIDE_HALVINGS = 1
_SETTLED = 0.01
"""Share of the distance that a further slide must promise."""


def bisect(
    check: ExactCheck, problem: ResolveProblem, free: FloatArray, colliding: FloatArray, n: int
) -> tuple[FloatArray, FloatArray]:
    """Halve a segment `n` times between a free and a colliding pose.

    Along a segment the free set need not be one interval: this finds a boundary of it, not always
    the one that is nearest to the colliding end.

    Parameters
    ----------
    check, problem : of the pose
    free, colliding : (D,) float64 arrays
    n : how often, >= 0

    Returns
    -------
    free, colliding : the ends of what is left

    Raises
    ------
    CancelledError : the problem's watch said so.
    """
    for _ in range(n):
        problem.watch.poll()
        middle = 0.5 * (free + colliding)
        if check.is_free(middle):
            free = middle
        else:
            colliding = middle
    return free, colliding


def shorten(check: ExactCheck, problem: ResolveProblem, free: FloatArray) -> FloatArray:
    """Move a free pose as near to Z* as it stays exactly free.

    First straight towards Z* by bisection. Where that is stopped, the contacts become linear
    constraints, and the nearest pose that they allow is the next goal: the pose slides along what
    it touches. At last each domain that moved is put back alone, where that is free.

    Parameters
    ----------
    check, problem : of the pose
    free : (D,) float64 array, exactly free

    Returns
    -------
    latent : (D,) float64 array, exactly free, no farther from Z* than `free`

    Raises
    ------
    CancelledError : the problem's watch said so.
    """
    free, colliding = bisect(check, problem, free, problem.target, FIRST_HALVINGS)
    slid = _slide(check, problem, free, colliding)
    if slid is free:
        free, _ = bisect(check, problem, free, colliding, FURTHER_HALVINGS)
    else:
        free = slid
    return _put_domains_back(check, problem, free)


def _slide(
    check: ExactCheck, problem: ResolveProblem, free: FloatArray, colliding: FloatArray
) -> FloatArray:
    contacts = Contacts(check, problem)
    for _ in range(SLIDES):
        problem.watch.poll()
        if problem.watch.expired or not contacts.add(colliding):
            break
        contacts.drop_refuted(free)
        goal = contacts.nearest(problem.target)
        if goal is None:
            break
        if problem.distance(goal) >= (1.0 - _SETTLED) ** 2 * problem.distance(free):
            break
        if check.is_free(goal):
            return goal
        nearer, colliding = bisect(check, problem, free, goal, _SLIDE_HALVINGS)
        if problem.distance(nearer) < problem.distance(free):
            free = nearer
    return free


def _put_domains_back(check: ExactCheck, problem: ResolveProblem, free: FloatArray) -> FloatArray:
    """Try for each group of codes, the farthest moved first, whether it may return to Z*."""
    sizes = check.embedding.group_sizes
    stops = np.cumsum(sizes)
    groups = [slice(stop - size, stop) for size, stop in zip(sizes, stops, strict=True)]
    for group in sorted(groups, key=lambda one: -_gain(problem, free, one)):
        problem.watch.poll()
        if problem.watch.expired:
            break
        # Where the metric ties groups to each other, putting one back alone may add to it.
        if _gain(problem, free, group) <= _SETTLED * problem.distance(free):
            continue
        put_back = free.copy()
        put_back[group] = problem.target[group]
        if check.is_free(put_back):
            free = put_back
    return free


def _gain(problem: ResolveProblem, latent: FloatArray, group: slice) -> float:
    """Return by how much the squared distance falls if a group of codes returns to Z*."""
    put_back = latent.copy()
    put_back[group] = problem.target[group]
    return float(problem.distance(latent) - problem.distance(put_back))
