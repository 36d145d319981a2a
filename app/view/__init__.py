"""The 3D view: canvas, scene, camera, shading, legend, pictures and videos."""

import os

from platformdirs import user_cache_path


def _has_cache() -> bool:
    """Whether the user's cache folder, which Mesa needs, exists or can be made, and is writable."""
    try:
        user_cache_path().mkdir(exist_ok=True)
    except OSError:
        return False
    return os.access(user_cache_path(), os.W_OK)


if not _has_cache():
    # Without a cache folder, Mesa warns on standard error for every surface.
    os.environ.setdefault("MESA_SHADER_CACHE_DISABLE", "true")
