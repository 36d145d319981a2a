"""Generate docs/commands.md from `--help`: python -m tests.app.cli.commands_page > FILE."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import typer
from typer.testing import CliRunner

from app.cli.main import app

_HEAD = """# Commands

What `lcollision COMMAND --help` says of each command. `M` is a model or a character: its file, or
the name of a bundled model or of one of yours. Exit status: 0 done; 1 the answer is no; 2 bad
input, said in one sentence; 3 a bug; 130 interrupted. With `--json` a command prints one document
and nothing else.

| command | what it does |
|---|---|
"""
_COLUMNS = {"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"}


def page() -> str:
    """Return the page."""
    paths = list(_paths(typer.main.get_command(app), ()))
    rows = [
        f"| [`lcollision {' '.join(path)}`](#{'-'.join(('lcollision', *path))}) | "
        f"{command.help.strip().splitlines()[0]} |"
        for path, command in paths
    ]
    parts = [_HEAD + "\n".join(rows)]
    for path, _ in paths:
        said = CliRunner().invoke(
            app, [*path, "--help"], prog_name="lcollision", env=_COLUMNS, catch_exceptions=False
        )
        text = "\n".join(line.rstrip() for line in said.output.strip().splitlines())
        parts.append(f"## lcollision {' '.join(path)}\n\n```\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def _paths(command: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the words of each executable command, and the command, in order of names."""
    inner = getattr(command, "commands", None)
    if inner is None:
        yield path, command
        return
    for name in sorted(inner):
        yield from _paths(inner[name], (*path, name))


if __name__ == "__main__":
    sys.stdout.write(page())
