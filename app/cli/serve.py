"""``lcollision serve`` and ``lcollision blender-addon``: the engine for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.console import note


def serve() -> None:
    """Answer other programs, such as the Blender add-on, on stdin and stdout until stdin closes.

    docs/protocol.md says how.
    """
    from lcollision_core.serve.session import serve_stdio

    serve_stdio()


def blender_addon(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="ZIP", help="Where to write it.")
    ],
) -> None:
    """Write the Blender add-on, with the path of this installation's Python in it.

    Blender 4.2 or later: Edit > Preferences > Get Extensions > Install from Disk.
    """
    from app.blender_addon import addon_zip
    from lcollision_core.files.safe import write_bytes
    from lcollision_core.tasks.exporting import require_output

    require_output(output, ".zip")
    data = addon_zip()
    write_bytes(output, data)
    note(f"wrote {output}; install it in Blender: Preferences > Get Extensions > Install from Disk")
