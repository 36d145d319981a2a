"""The way out of shallow contact by a small move."""

from __future__ import annotations

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import ExactCheck
from lcollision_core.posing.contact_constraints import Contacts
from lcollision_core.resolve.problem import ResolveProblem

POLISH_ROUNDS = 6


def polish(check: ExactCheck, problem: ResolveProblem, start: FloatArray) -> FloatArray | None:
    """Leave shallow contact by a small move.

    Newton's method on the depths of the contacts: each round takes the smallest move that separates
    all contacts seen so far. Depths of pairs of faces saturate where bodies are deep within each
    other, and then give no direction: such poses fail.

    Parameters
    ----------
    check, problem : of the pose
    start : (D,) float64 array

    Returns
    -------
    latent : (D,) float64 array, collision-free, or None

    Raises
    ------
    CancelledError : the problem's token was set.
    """
    contacts = Contacts(check)
    latent = start
    for _ in range(POLISH_ROUNDS):
        problem.deadline.poll()
        if not contacts.add(latent):
            return latent
        goal = problem.nearest(start, contacts)
        if goal is None or problem.deadline.expired:
            return None
        latent = goal
    return latent if check.is_free(latent) else None
