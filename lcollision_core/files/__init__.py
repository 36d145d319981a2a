"""Read and write files: meshes, scenes, characters, motions and pose sets, by `formats.FILES`."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lcollision_core.files.public import *  # noqa: F403
else:
    from lcollision_core.lazy import public_names

    __getattr__ = public_names(__name__)
