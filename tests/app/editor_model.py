"""A small model with a predictor, for the editor's tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lcollision_core.bodies import LearnedBody, user_models_folder
from tests.small_models import stored


def trained_tube() -> LearnedBody:
    """Return a model of a tube that bends at two joints, with two domains of three codes."""
    from lcollision_core.predictor import PRESETS, train_predictor

    bare = stored("editor_tube")
    labeller = bare.labeller()
    rows = labeller.label_rows(0, range(32))
    # Averaged weights would lag behind after only two epochs.
    quick = replace(PRESETS["paper"], epochs=2, average_passes=0.0)
    predictor = train_predictor(rows, bare.embedding, quick)
    return bare.with_predictor(predictor)


def another_model(model: LearnedBody) -> LearnedBody:
    """Store a model of another latent space as the user's "snake", without a predictor."""
    shifted = model.embedding.mean_features + np.float32(1e-3)
    path = user_models_folder() / "snake.safetensors"
    path.parent.mkdir(parents=True, exist_ok=True)
    LearnedBody("snake", replace(model.embedding, mean_features=shifted), model.card).save(path)
    return LearnedBody.load(path)
