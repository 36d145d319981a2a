"""The commands, and the handling of errors.

Every command imports its modules when it runs: ``lcollision --help`` loads no array library.
"""

from __future__ import annotations

import errno
import logging
import os
import sys
import traceback
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from app.cli import (
    benchmark,
    check,
    contacts,
    dataset,
    edit,
    evaluate,
    label,
    models,
    new,
    poses,
    printing,
    resolve,
    serve,
    train,
)
from app.cli.console import ExitStatus, note, tell_what_takes_time
from lcollision_core.errors import CancelledError, LCollisionError

# Small matrix products take microseconds; on a busy machine, distributing them takes longer.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# PyVista imports Matplotlib, which is not used here but warns if it cannot keep a cache.
logging.getLogger("matplotlib").setLevel(logging.ERROR)

_UsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""Typer's usage error; only this subclass has a public name."""


def with_height(words: list[str]) -> list[str]:
    """Allow `--ground` without a height: it means the height at which the bodies rest."""
    following = [*words, ""][1:]

    def is_height(word: str) -> bool:
        try:
            return bool(float(word)) or True
        except ValueError:
            return False

    return [
        "--ground=rest" if word == "--ground" and not is_height(after) else word
        for word, after in zip(words, following, strict=True)
    ]


class _Commands(TyperGroup):
    """Prints errors that a user can fix as one sentence."""

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Insert "edit" if the words can only be meant for the editor."""
        return super().parse_args(ctx, edit.with_command(with_height(args), self.commands))

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        try:
            return super().make_context(*args, **kwargs)
        except _UsageError as error:
            _refuse_usage(error)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except _UsageError as error:
            _refuse_usage(error)
        except (CancelledError, KeyboardInterrupt, BrokenPipeError) as error:
            if isinstance(error, KeyboardInterrupt):
                note("interrupted")
            if isinstance(error, BrokenPipeError):
                # The reader closed the pipe, as `head` does; Typer's status 1 would mean a result.
                _drop_what_is_buffered()
            raise typer.Exit(ExitStatus.INTERRUPTED) from None
        except LCollisionError as error:
            sentence = str(error)
        except MemoryError:
            sentence = "out of memory; use smaller meshes or fewer poses"
        except OSError as error:
            sentence = f"{error.filename}: {error.strerror}; choose another name or folder"
            if error.errno == errno.ENOSPC:
                _drop_what_is_buffered()
                sentence = "can't write the output: the disk is full"
            elif error.filename is None:
                raise
        note(sentence)
        raise typer.Exit(ExitStatus.BAD_INPUT)


def _drop_what_is_buffered() -> None:
    """Keep standard output from failing again at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _refuse_usage(error: Any) -> NoReturn:
    sentence = error.format_message().rstrip(".").replace("Value error, ", "")
    if "\n" in sentence:  # a group without a command: its help, not an error
        raise error
    program = error.ctx.command_path if error.ctx else "lcollision"
    note(f"{sentence}; see {program} --help")
    raise typer.Exit(ExitStatus.BAD_INPUT)


app = typer.Typer(
    cls=_Commands,
    name="lcollision",
    help="Find a body's self-collisions and resolve them. Without a command: the editor.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (
    edit.edit,
    new.new,
    *(models.models, models.info, models.domains, models.upright),
    contacts.contacts,
    check.check,
    *(poses.encode, poses.decode, poses.sample, poses.mirror),
    *(resolve.resolve, label.label, evaluate.evaluate),
    *(serve.serve, serve.blender_addon),
):
    app.command()(command)
app.command("print")(printing.print_figure)
app.add_typer(dataset.app, name="dataset")
app.add_typer(train.app, name="train")
app.add_typer(benchmark.app, name="benchmark")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"lcollision {version('lcollision')}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _global_options(
    context: typer.Context,
    version: Annotated[  # noqa: ARG001 - its eager callback acts
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    tell_what_takes_time()
    edit.edit_without_command(context)


def main() -> None:
    """Run the command line and exit with an `ExitStatus`."""
    try:
        app()
    except Exception:  # the last resort: a bug must not look like a result
        traceback.print_exc()
        note("this is a bug in lcollision; please report it")
        sys.exit(ExitStatus.BUG)
