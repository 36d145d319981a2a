"""What all commands share: progress on a terminal, one JSON document, notes on standard error."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import Any

import typer

from lcollision_core.jobs import Progress, no_progress


class ExitStatus(IntEnum):
    """What the command's exit status says; scripts depend on these numbers."""

    DONE = 0
    ANSWER_IS_NO = 1
    BAD_INPUT = 2
    BUG = 3
    INTERRUPTED = 130


def print_json(document: Any) -> None:
    """Print one JSON document, the only thing that ``--json`` puts on standard output."""
    typer.echo(json.dumps(document, indent=2, allow_nan=False))


def note(sentence: str) -> None:
    """Tell the user something beside the answer, on standard error."""
    typer.echo(f"lcollision: {sentence}", err=True)


def counted(number: int, noun: str, nouns: str | None = None) -> str:
    """Return the number with its noun, "1 pose" or "2 poses"."""
    return f"{number} {noun if number == 1 else nouns or noun + 's'}"


@contextmanager
def progress_bar(task: str) -> Iterator[Progress]:
    """Give a `Progress` that draws a bar on a terminal, and nothing in a pipe."""
    if not sys.stderr.isatty():
        yield no_progress
        return
    from rich import progress as rich_progress
    from rich.console import Console

    columns = (
        rich_progress.TextColumn(task),
        rich_progress.BarColumn(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with rich_progress.Progress(*columns, console=console, transient=True) as bars:
        bar = bars.add_task(task, total=None)

        def show(done: int, total: int) -> None:
            bars.update(bar, completed=done, total=total)

        yield show
