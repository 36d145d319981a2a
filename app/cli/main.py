"""The commands, and the handling of errors.

A command's file is imported when the command is asked for, and what it works with when it runs:
``lcollision --help`` loads no array library.
"""

from __future__ import annotations

import errno
import logging
import os
import sys
import traceback
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from app.cli.console import ExitStatus, note, tell_what_takes_time
from lcollision_core import __version__
from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.jobs import limit_library_threads

limit_library_threads()
# PyVista imports Matplotlib, which is not used here but warns if it cannot keep a cache.
logging.getLogger("matplotlib").setLevel(logging.ERROR)

_UsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""Typer's usage error; only this subclass has a public name."""


_COMMANDS = {
    "edit": "edit.edit",
    "new": "new.new",
    "models": "models.models",
    "info": "models.info",
    "domains": "models.domains",
    "upright": "models.upright",
    "contacts": "contacts.contacts",
    "check": "check.check",
    "encode": "poses.encode",
    "decode": "poses.decode",
    "sample": "poses.sample",
    "mirror": "poses.mirror",
    "resolve": "resolve.resolve",
    "label": "label.label",
    "evaluate": "evaluate.evaluate",
    "serve": "serve.serve",
    "blender-addon": "serve.blender_addon",
    "print": "printing.print_figure",
    "dataset": "dataset.app",
    "train": "train.app",
    "benchmark": "benchmark.app",
}
"""The file of `app.cli` and the name in it of each command or group, in the order of the help."""


@cache
def _command(name: str) -> Any:
    """Import a command or a group."""
    file, attribute = _COMMANDS[name].split(".")
    command = getattr(import_module(f"app.cli.{file}"), attribute)
    home = typer.Typer(add_completion=False, rich_markup_mode=None, callback=lambda: None)
    if isinstance(command, typer.Typer):
        home.add_typer(command, name=name)
    else:
        home.command(name)(command)
    group: Any = typer.main.get_command(home)
    return group.commands[name]


class _CommandsByName(Mapping[str, Any]):
    """Imports a command when it is looked up."""

    def __getitem__(self, name: str) -> Any:
        return _command(name)

    def __iter__(self) -> Iterator[str]:
        return iter(_COMMANDS)

    def __len__(self) -> int:
        return len(_COMMANDS)


def _with_height(words: list[str]) -> list[str]:
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


def _with_command(words: list[str]) -> list[str]:
    """Insert "edit" before words that start with a path or with the editor's option `--model`.

    A command's name is not taken as a file.
    """
    first = words[0] if words else ""
    path = Path(first)
    names_file = bool(first) and (path.exists() or bool(path.suffix) or len(path.parts) > 1)
    is_file = names_file and first not in _COMMANDS and not first.startswith("-")
    return ["edit", *words] if is_file or first.partition("=")[0] == "--model" else words


class _Commands(TyperGroup):
    """Prints errors that a user can fix as one sentence."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Any = _CommandsByName()

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Insert "edit" if the words can only be meant for the editor."""
        return super().parse_args(ctx, _with_command(_with_height(args)))

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


_EXPECTED = {
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_parsing": "a number",
    "greater_than_equal": "at least {ge}",
    "less_than_equal": "at most {le}",
}
"""What an option must be, by the type of Pydantic's error."""


def _refuse_usage(error: Any) -> NoReturn:
    sentence = error.format_message().rstrip(".?").replace("Value error, ", "")
    if "\n" in sentence:  # a group without a command: its help, not an error
        raise error
    invalid: dict[str, Any] = next(iter(getattr(error.__cause__, "errors", list)()), {})
    if expected := _EXPECTED.get(invalid.get("type", "")):
        got = invalid["input"]
        if str(got).strip("+-").lower() == "nan":
            expected = "a number"
        limits = {name: f"{limit:.15g}" for name, limit in invalid.get("ctx", {}).items()}
        option = max(error.param.opts, key=len)
        sentence = str(LCollisionError.must_be(option, expected.format(**limits), got))
    program = error.ctx.command_path if error.ctx else "lcollision"
    note(f"{sentence.replace('. Did you mean', ', did you mean')}; see {program} --help")
    raise typer.Exit(ExitStatus.BAD_INPUT)


app = typer.Typer(
    cls=_Commands,
    name="lcollision",
    help="Find a body's self-collisions and resolve them. Without a command: the editor.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"lcollision {__version__}")
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
    if context.invoked_subcommand is None:
        from app.cli.edit import edit

        edit()


def _open_closed_streams() -> None:
    """Replace standard streams that the caller closed; the next file would take their number."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: PTH123, SIM115 - open until the end


def main() -> None:
    """Run the command line and exit with an `ExitStatus`."""
    _open_closed_streams()
    try:
        app()
    except Exception:  # the last resort: a bug must not look like a result
        traceback.print_exc()
        note("this is a bug in lcollision; please report it")
        sys.exit(ExitStatus.BUG)
