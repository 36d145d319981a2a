"""A small model, trained once."""

from __future__ import annotations

import numpy as np
import pytest

from lcollision_core.bodies import PoseModel
from lcollision_core.meshes import PoseSet
from tests.bending_tube import bending_tube
from tests.core.predictor_rows import colliding_latent


@pytest.fixture(scope="session")
def tube_poses() -> PoseSet:
    """Return 16 poses of a tube whose lower half is a left shin and whose upper half a thigh."""
    return bending_tube(labelled=True)


@pytest.fixture(scope="session")
def tube_model(tube_poses: PoseSet) -> PoseModel:
    """Return a model of them with two domains of three codes."""
    from lcollision_core.embedding.training import train_embedding
    from lcollision_core.embedding.training_run import EmbeddingConfig

    config = EmbeddingConfig(
        n_domains=2,
        n_domain_codes=3,
        level1_epochs=60,
        level2_epochs=20,
        level2_rate=0.01,
        held_out_stride=0,
    )
    return PoseModel.from_training(
        "tube", train_embedding(tube_poses, config), tube_poses, "a tube", "CC0-1.0"
    )


@pytest.fixture(scope="session")
def tube_folds(tube_model: PoseModel) -> np.ndarray:
    """Return the sites where its skin folds."""
    from lcollision_core.predictor.geometric_network import find_fold_sites

    return find_fold_sites(tube_model.embedding, colliding_latent(tube_model))
