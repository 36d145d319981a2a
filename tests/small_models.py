"""The small models and clips of `tests/data`, newly made and stored.

``python -m tests.small_models`` writes the files, except those of `SHAPED`.
"""

from __future__ import annotations

from pathlib import Path

from lcollision_core.bodies import LearnedBody
from tests.bending_tube import bending_tube
from tests.core.motion.swings import swinging_body
from tests.rigged_shapes import write_gltf

DATA = Path(__file__).parent / "data"
SWING = DATA / "swing.glb"
"""The character `swinging_body` with both its clips."""

SHAPED = (DATA / "scale_forearm.glb", DATA / "arm_morph.glb")
"""Characters with a clip that scales a joint, and one that animates a morph target."""

LEVEL2_RATES = {"tube": 0.01, "editor_tube": 0.04}
"""Learning rate of level 2, by the name of a model's file."""


def stored(name: str) -> LearnedBody:
    """Return the model of a file in `DATA`, named "tube", without a predictor."""
    model = LearnedBody.load(DATA / f"{name}.safetensors")
    return LearnedBody("tube", model.embedding, model.card)


def trained(name: str) -> LearnedBody:
    """Train the model: a tube that bends at two joints, with two domains of three codes."""
    from lcollision_core.embedding.training import train_embedding
    from lcollision_core.embedding.training_run import EmbeddingConfig

    poses = bending_tube(labelled=True)
    config = EmbeddingConfig(
        n_domains=2,
        n_domain_codes=3,
        level1_epochs=60,
        level2_epochs=20,
        level2_rate=LEVEL2_RATES[name],
        held_out_stride=0,
    )
    return LearnedBody.from_training(
        "tube", train_embedding(poses, config), poses, "a tube", "CC0-1.0"
    )


if __name__ == "__main__":
    for name in LEVEL2_RATES:
        trained(name).save(DATA / f"{name}.safetensors")
    write_gltf(swinging_body(), SWING)
