"""The latent space of poses: bilevel autoencoder, attention masks, stage 1 of the training."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lcollision_core.embedding.public import *  # noqa: F403
else:
    from lcollision_core.lazy import public_names

    __getattr__ = public_names(__name__)
