"""The Blender add-on as a file: its modules, the client, `msgpack`, and where the engine is."""

from __future__ import annotations

import io
import json
import sys
import zipfile
from importlib.metadata import files
from pathlib import Path

from lcollision_core import __version__
from lcollision_core.bundled import bundled_folder
from lcollision_core.errors import LCollisionError

_CODEC = ("__init__.py", "exceptions.py", "ext.py", "fallback.py")
"""Of `msgpack`, what is written in Python."""

_IMPORT = "\nimport msgpack\n"


def addon_zip() -> bytes:
    """Return the extension as Blender installs it.

    Raises
    ------
    LCollisionError : the licence of `msgpack`, which goes with it, is missing.
    """
    folder = bundled_folder("blender") / "lcollision"
    contents = {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts
    }
    contents["client.py"] = _client()
    contents |= {f"msgpack/{name}": data for name, data in _codec().items()}
    engine = {"python": sys.executable, "version": __version__}
    contents["engine.json"] = json.dumps(engine, indent=1).encode() + b"\n"
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in sorted(contents.items()):
            file.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return data.getvalue()


def _client() -> bytes:
    """Return the client, which takes `msgpack` from beside it."""
    from lcollision_core.serve import client

    text = Path(client.__file__).read_text(encoding="utf-8")
    assert text.count(_IMPORT) == 1
    return text.replace(_IMPORT, "\nfrom . import msgpack\n").encode()


def _codec() -> dict[str, bytes]:
    import msgpack

    folder = Path(msgpack.__file__).parent
    sources = {name: (folder / name).read_bytes() for name in _CODEC}
    licences = [path for path in files("msgpack") or () if path.name == "COPYING"]
    if not licences:
        raise LCollisionError("has no licence with it", "install it again", where="msgpack")
    return sources | {"COPYING": Path(str(licences[0].locate())).read_bytes()}
