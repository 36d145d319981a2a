"""What is drawn: canvas, scene, camera, shading, legend, pictures, animation."""

import os

from platformdirs import user_cache_path


def _has_cache() -> bool:
    """Whether the user has a folder for caches, or can have one, as Mesa makes it."""
    try:
        user_cache_path().mkdir(exist_ok=True)
    except OSError:
        return False
    return os.access(user_cache_path(), os.W_OK)


if not _has_cache():
    # Mesa would say so on standard error with every surface.
    os.environ.setdefault("MESA_SHADER_CACHE_DISABLE", "true")
