"""Exact labels of samples of the latent box, and the folder that stores them."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lcollision_core.labels.public import *  # noqa: F403
else:
    from lcollision_core.lazy import public_names

    __getattr__ = public_names(__name__)
