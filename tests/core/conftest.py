"""Fixtures of a small model."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody
from lcollision_core.files import PoseSet
from tests.bending_tube import bending_tube
from tests.core.predictor_rows import colliding_latent
from tests.small_models import stored


@pytest.fixture(scope="session")
def tube_poses() -> PoseSet:
    """Return 16 poses of a tube whose lower half is a left shin and whose upper half a thigh."""
    return bending_tube(labelled=True)


@pytest.fixture(scope="session")
def tube_model() -> LearnedBody:
    """Return a model of these poses with two domains of three codes."""
    return stored("tube")


@pytest.fixture(scope="session")
def tube_folds(tube_model: LearnedBody) -> np.ndarray:
    """Return the sites where the tube's skin folds."""
    from lcollision_core.predictor.geometric_network import find_fold_sites

    return find_fold_sites(tube_model.embedding, colliding_latent(tube_model))
