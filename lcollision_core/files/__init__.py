"""Read and write files: meshes, scenes, characters, motions and pose sets."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lcollision_core.files.public import *  # noqa: F403
else:

    def __getattr__(name: str) -> Any:
        """Load the readers, and SciPy with them, only when they are needed."""
        from importlib import import_module

        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(import_module("lcollision_core.files.public"), name)
