"""Output that all commands share: progress, one JSON document, notes on standard error."""

from __future__ import annotations

import json
import logging
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import Annotated, Any

import typer

from lcollision_core.jobs import UNWATCHED, Job, at_most_every
from lcollision_core.tasks.words import one_line

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document.")]

BarContent = tuple[float, float, str, list[str]]
"""The content of a progress bar: done, total, description, and facts beside it."""

SECONDS_BETWEEN_LINES = 30.0
"""Time between progress notes in a file or a pipe."""


class ExitStatus(IntEnum):
    """Exit statuses; scripts depend on these numbers."""

    DONE = 0
    ANSWER_IS_NO = 1
    BAD_INPUT = 2
    BUG = 3
    INTERRUPTED = 130


def print_json(document: Any) -> None:
    """Print one JSON document, the only standard output of ``--json``."""
    typer.echo(json.dumps(document, indent=2, allow_nan=False))


def tell(line: str) -> None:
    """Print a line of the answer; line breaks in names are escaped."""
    typer.echo(one_line(line))


def note(sentence: str) -> None:
    """Print a note for the user on standard error; line breaks in names are escaped."""
    typer.echo(f"lcollision: {one_line(sentence)}", err=True)


class _Notes(logging.Handler):
    """Prints log records as notes, each once."""

    def __init__(self) -> None:
        super().__init__()
        self._told: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        sentence = record.getMessage()
        if sentence not in self._told:
            self._told.add(sentence)
            note(sentence)


def tell_what_takes_time() -> None:
    """Show the core's log of implicit work, such as compiling, on a terminal."""
    core = logging.getLogger("lcollision_core")
    if sys.stderr.isatty() and not core.handlers:
        core.addHandler(_Notes())
        core.setLevel(logging.INFO)


@contextmanager
def progress_bar(task: str, job: Job | None = None) -> Iterator[Job]:
    """Yield a part of a job whose progress is a bar on a terminal, and nothing in a pipe."""
    job = job or Job(note=note)
    if not sys.stderr.isatty():
        yield job.part()
        return
    with _bar(task, "count", "time") as show:
        yield job.part(lambda done, total: show(done, total, task, []))


@contextmanager
def cancel_on_interrupt() -> Iterator[Job]:
    """Yield a job that the first Ctrl-C or SIGTERM cancels; a second one acts at once."""
    job = Job(note=note)
    previous: dict[signal.Signals, Any] = {}

    def stop(number: int, frame: object) -> None:  # noqa: ARG001
        job.cancel()
        signal.signal(number, previous[signal.Signals(number)])

    for caught in (signal.SIGINT, signal.SIGTERM):
        previous[caught] = signal.signal(caught, stop)
    try:
        yield job
    finally:
        for caught, handler in previous.items():
            signal.signal(caught, handler)


@contextmanager
def cancellable_bar(task: str) -> Iterator[Job]:
    """Yield a job with a progress bar, which the first Ctrl-C or SIGTERM cancels."""
    with cancel_on_interrupt() as job, progress_bar(task, job) as part:
        yield part


@contextmanager
def status_bar(
    task: str,
    bar_content: Callable[[Any], BarContent],
    job: Job = UNWATCHED,
    *,
    rows: bool = False,
    estimates: bool = True,
    seconds: float | None = None,
) -> Iterator[Job]:
    """Yield a part of a job whose progress is a bar on a terminal, and occasional notes in a pipe.

    Parameters
    ----------
    task : the description until the first status
    bar_content : converts a reported status to the content of the bar
    rows : show the done and total counts, not the percentage and the time left
    estimates : whether the bar estimates the time left, if the facts do not contain it
    seconds : least time between notes in a file or a pipe; `SECONDS_BETWEEN_LINES` if None
    """
    if sys.stderr.isatty():
        amounts = ("count",) if rows else ("share", "time") if estimates else ("share",)
        with _bar(task, *amounts) as show:
            yield job.part(lambda status: show(*bar_content(status)))
        return

    def tell_status(status: Any) -> None:
        done, total, description, facts = bar_content(status)
        amount = f"{done:.0f} of {total:.0f}" if rows else f"{100.0 * done / total:.0f} %"
        note(", ".join([f"{description}: {amount}", *facts]))

    pause = SECONDS_BETWEEN_LINES if seconds is None else seconds
    yield job.part(at_most_every(pause, tell_status, at_once=False))


@contextmanager
def _bar(task: str, *amounts: str) -> Iterator[Callable[[float, float, str, list[str]], None]]:
    """Draw a bar that vanishes at the end; `amounts` are "count", "share" or "time"."""
    from rich import progress
    from rich.console import Console

    kinds: dict[str, type[progress.ProgressColumn]] = {
        "count": progress.MofNCompleteColumn,
        "share": progress.TaskProgressColumn,
        "time": progress.TimeRemainingColumn,
    }
    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        *(kinds[amount]() for amount in amounts),
        progress.TextColumn("{task.fields[facts]}"),
    )
    with progress.Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        bar = bars.add_task(task, total=None, facts="")

        def show(done: float, total: float, description: str, facts: list[str]) -> None:
            text = ", ".join(facts)
            bars.update(bar, completed=done, total=total, description=description, facts=text)

        yield show
