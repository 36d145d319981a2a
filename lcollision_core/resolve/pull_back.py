"""Between a collision-free pose and the target: pull back to it, or fall back from it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import ExactCheck
from lcollision_core.posing.contact_constraints import Contacts
from lcollision_core.resolve.problem import ResolveProblem

FIRST_HALVINGS, FURTHER_HALVINGS = 3, 5
SLIDES = 5
_SLIDE_HALVINGS = 1
_SETTLED = 0.01
"""Fraction of the distance that a further slide must gain."""

FALL_BACKS = 6
"""Known free poses that are tried, the nearest ones: the segment to the nearest of all often is
not the one that becomes free soonest."""

FALL_BACK_HALVINGS = 8


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
    CancelledError : the problem's token was set.
    """
    for _ in range(n):
        problem.deadline.poll()
        middle = 0.5 * (free + colliding)
        if check.is_free(middle):
            free = middle
        else:
            colliding = middle
    return free, colliding


def pull_back(check: ExactCheck, problem: ResolveProblem, free: FloatArray) -> FloatArray:
    """Move a free pose as near to Z* as it stays collision-free.

    First straight towards Z* by bisection. Where that is stopped, the contacts become linear
    constraints, and the nearest pose that they allow is the next goal: the pose slides along what
    it touches. Finally each domain that moved is put back alone, where that is free.

    Parameters
    ----------
    check, problem : of the pose
    free : (D,) float64 array, collision-free

    Returns
    -------
    latent : (D,) float64 array, collision-free, no farther from Z* than `free`

    Raises
    ------
    CancelledError : the problem's token was set.
    """
    free, colliding = bisect(check, problem, free, problem.target, FIRST_HALVINGS)
    slid = _slide(check, problem, free, colliding)
    if slid is free:
        slid, _ = bisect(check, problem, free, colliding, FURTHER_HALVINGS)
    return _put_domains_back(check, problem, slid)


def fall_back(
    check: ExactCheck, problem: ResolveProblem, free_latents: FloatArray
) -> FloatArray | None:
    """Bisect the segments from Z* to known free poses, and take the end that is nearest to Z*.

    Locked codes stay, so that a known free pose may collide without them; those are left out.

    Parameters
    ----------
    check, problem : of the pose
    free_latents : (F, D) float64 array

    Returns
    -------
    latent : (D,) float64 array, collision-free, or None if all known poses collide

    Raises
    ------
    CancelledError : the problem's token was set.
    """
    ends = np.where(problem.movable, free_latents, problem.target)
    reached: list[FloatArray] = []
    for end in ends[np.argsort(problem.distance(ends), kind="stable")]:
        problem.deadline.poll()
        if len(reached) == FALL_BACKS or (reached and problem.deadline.expired):
            break
        if check.is_free(end):
            reached.append(bisect(check, problem, end, problem.target, FALL_BACK_HALVINGS)[0])
    return min(reached, key=problem.distance, default=None)


def _slide(
    check: ExactCheck, problem: ResolveProblem, free: FloatArray, colliding: FloatArray
) -> FloatArray:
    contacts = Contacts(check)
    for _ in range(SLIDES):
        problem.deadline.poll()
        if problem.deadline.expired or not contacts.add(colliding):
            break
        contacts.drop_refuted(free)
        goal = problem.nearest(problem.target, contacts)
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

    def put_back(codes: npt.NDArray[np.intp]) -> FloatArray:
        latent = free.copy()
        latent[codes] = problem.target[codes]
        return latent

    groups = np.split(np.arange(len(free)), np.cumsum(check.space.group_sizes)[:-1])
    for codes in sorted(groups, key=lambda codes: float(problem.distance(put_back(codes)))):
        problem.deadline.poll()
        if problem.deadline.expired:
            break
        # Where the metric ties groups to each other, putting one back alone may add to it.
        tried = put_back(codes)
        gain = problem.distance(free) - problem.distance(tried)
        if gain > _SETTLED * problem.distance(free) and check.is_free(tried):
            free = tried
    return free
