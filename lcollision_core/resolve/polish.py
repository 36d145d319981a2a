"""Leave shallow contact by the exact depths, through the decoder."""

from __future__ import annotations

from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.contacts import Contacts
from lcollision_core.resolve.exact import ExactCheck
from lcollision_core.resolve.problem import ResolveProblem

ROUNDS = 6


def polish(check: ExactCheck, problem: ResolveProblem, start: FloatArray) -> FloatArray | None:
    """Move a pose by little until it is exactly free.

    Newton's method on the depths of the contacts: each round asks for the smallest move that parts
    all contacts seen so far. Depths of pairs of faces saturate where bodies are deep within each
    other, and then point no way out: such poses are given up.

    Parameters
    ----------
    check, problem : of the pose
    start : (D,) float64 array

    Returns
    -------
    latent : (D,) float64 array, exactly free, or None

    Raises
    ------
    CancelledError : the problem's watch said so.
    """
    contacts = Contacts(check, problem)
    latent = start
    for _ in range(ROUNDS):
        problem.watch.poll()
        if not contacts.add(latent):
            return latent
        goal = contacts.nearest(start)
        if goal is None or problem.watch.expired:
            return None
        latent = goal
    return latent if check.is_free(latent) else None
