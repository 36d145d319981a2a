"""``lcollision serve`` and ``lcollision blender-addon``: the engine for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.cli.console import note


def serve(
    port: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=0,
            max=65535,
            help="Listen on a port of this machine alone, 0 for any, and print it and the token "
            "that clients must say.",
        ),
    ] = None,
) -> None:
    """Answer other programs, as Blender's add-on: on standard input and output, until that ends.

    docs/protocol.md says how.
    """
    import json
    import secrets

    from lcollision_core.serve.server import serve_port, serve_stdio

    if port is None:
        serve_stdio()
        return
    token = secrets.token_hex(32)

    def started(at: int) -> None:
        typer.echo(json.dumps({"port": at, "token": token}))

    serve_port(port, token, started)


def blender_addon(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="ZIP", help="Where to write it.")
    ],
) -> None:
    """Write the Blender add-on, with the path of this installation's Python in it.

    Blender 4.2 or later: Edit > Preferences > Get Extensions > Install from Disk.
    """
    from app.blender_addon import addon_zip
    from lcollision_core.meshes.atomic import atomic_write

    data = addon_zip()
    with atomic_write(output) as file:
        file.write(data)
    note(f"wrote {output}; install it in Blender: Preferences > Get Extensions > Install from Disk")
