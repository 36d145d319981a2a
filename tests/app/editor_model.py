"""A small model with a predictor, for the editor's tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lcollision_core.bodies import LearnedBody, user_models_folder
from tests.small_models import stored


def tube_with_predictor() -> LearnedBody:
    """Return a tube that bends at two joints; its predictor's weights are those before training.

    Training would load triton, which crashes in a process where Mesa draws a window.
    """
    from lcollision_core.predictor import PRESETS, CollisionPredictor, TrainingFacts, score_rows
    from lcollision_core.predictor.paper_network import PaperNetwork

    bare = stored("editor_tube")
    embedding = bare.embedding
    rows = bare.labeller().label_rows(0, range(32))
    network = PaperNetwork(embedding.group_sizes, True, 0)
    arrays = {name: values.numpy() for name, values in network.state_dict().items()}
    facts = TrainingFacts(
        rows=len(rows),
        training_rows=len(rows),
        colliding_share=float(rows.colliding.mean()),
        seed=0,
        energy_scale=float(rows.energy[rows.colliding].mean()),
        margin=1.0,
        store=None,
    )
    predictor = CollisionPredictor(embedding, arrays, PRESETS["paper"], facts)
    predictor = replace(predictor, metrics=score_rows(predictor, rows).metrics())
    return bare.with_predictor(predictor)


def another_model(model: LearnedBody) -> LearnedBody:
    """Store a model of another latent space as the user's "snake", without a predictor."""
    shifted = model.embedding.mean_features + np.float32(1e-3)
    path = user_models_folder() / "snake.safetensors"
    path.parent.mkdir(parents=True, exist_ok=True)
    LearnedBody("snake", replace(model.embedding, mean_features=shifted), model.card).save(path)
    return LearnedBody.load(path)
