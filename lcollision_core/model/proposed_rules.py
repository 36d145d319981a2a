"""The contact rules that a body's own poses propose, before anybody has chosen any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import (
    LEAST_GAIN,
    MOSTLY,
    CollisionDetector,
    GroupPair,
    propose_ignored,
)
from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.meshes import ContactRules
from lcollision_core.meshes.evenly_spaced import evenly_spaced
from lcollision_core.model.posable_body import PosableBody

_MOST_POSES, _FEWEST_POSES = 40, 8
"""Of a body's poses, evenly spaced, that are looked at, and how many say enough."""


@dataclass(frozen=True)
class ProposedRules:
    """Rules by which more of a body's poses are free.

    Attributes
    ----------
    rules : those that apply, with further pairs of groups to ignore
    n_poses : poses that were looked at
    n_colliding, n_colliding_then : of these, by the rules that apply and by the proposed ones
    """

    rules: ContactRules
    n_poses: int
    n_colliding: int
    n_colliding_then: int


def typical_poses(body: PosableBody) -> npt.NDArray[np.float64]:
    """Return (n, V, 3) poses of a body: some that it came with, or random ones of a bare rig."""
    latent = body.training_latent
    latent = latent[evenly_spaced(len(latent), _MOST_POSES)].astype(np.float64)
    if len(latent) < _FEWEST_POSES and not body.is_trained:
        drawn = body.sample(_MOST_POSES, np.random.default_rng(0))
        latent = np.concatenate([latent, drawn])
    return body.decode(latent)


def propose_rules(
    body: PosableBody, progress: Progress = no_progress, cancel: CancelToken | None = None
) -> ProposedRules | None:
    """Propose pairs of groups to ignore where most poses of a body collide.

    Parameters
    ----------
    body : not one with a predictor, which depends on its rules
    progress : called with (poses looked at, poses in all), for each of up to two kinds of group
    cancel : polled between poses

    Returns
    -------
    proposed : None where most poses are free, or would collide all the same

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    poses = typical_poses(body)

    def n_colliding(detector: CollisionDetector) -> int:
        return int(detector.are_colliding(poses, cancel=cancel).sum())

    before = n_colliding(body.detector)
    if before <= MOSTLY * len(poses):
        return None

    def ignoring(pairs: Sequence[GroupPair]) -> PosableBody:
        return body.with_rules(replace(body.rules, ignored=(*body.rules.ignored, *pairs)))

    pairs = propose_ignored(
        lambda others: ignoring(others).detector, poses, body.groups_by_kind, progress, cancel
    )
    other = ignoring(pairs)
    after = n_colliding(other.detector)
    if before - after < LEAST_GAIN * len(poses):
        return None
    return ProposedRules(other.rules, len(poses), before, after)
