"""Bodies that take poses: rigs, trained models, bare meshes, and scenes of several."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lcollision_core.bodies.public import *  # noqa: F403
else:
    from lcollision_core.lazy import public_names

    __getattr__ = public_names(__name__)
