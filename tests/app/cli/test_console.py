"""Progress of long commands: a bar on a real terminal, occasional lines in a pipe."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

if sys.platform == "win32":
    pytest.skip("there are no pseudo-terminals", allow_module_level=True)

import pty

BARS = {
    "label": (
        "from app.cli.label import bar_content\n"
        "from lcollision_core.labels import LabelStatus\n"
        "status = LabelStatus(30, 200, 15, 28, 10.0)\n"
        "rows = True",
        ("Labelling", "30/200", "3/s, 0:01:01 left, 50.0 % collide"),
    ),
    "embedding": (
        "from app.cli.train import bar_content_of_embedding as bar_content\n"
        "from lcollision_core.embedding.training_run import TrainingStatus\n"
        "status = TrainingStatus('held out', 'level 2', 40, 100, 0.04, 0.01)\n"
        "rows = False",
        ("held out: learning level 2", "40%", "error level 1 4.00 %, both levels 1.00 %"),
    ),
    "predictor": (
        "from app.cli.train import bar_content_of_predictor as bar_content\n"
        "from lcollision_core.predictor import PredictorStatus\n"
        "status = PredictorStatus(1, 30, 20, 100, 0.5, (0.04, None), None)\n"
        "rows = False",
        (
            "epoch 2 of 30",
            "20%",
            "loss 0.500, 4.0 % of free poses called colliding, an unknown share of colliding poses "
            "called free",
        ),
    ),
    "patches": (
        "from app.cli.train import bar_content_of_predictor as bar_content\n"
        "from lcollision_core.predictor import PredictorStatus\n"
        "status = PredictorStatus(0, 30, 0, 100, None, (None, None), 0.25)\n"
        "rows = False",
        ("labelling patches", "25%"),
    ),
}


def draw(code: str, error: int, before: str = "") -> None:
    """Draw one status in another process, whose standard error is `error`."""
    bar = "from app.cli.console import status_bar\nwith status_bar('', bar_content, rows=rows)"
    held = f"{before}\n{code}\n{bar} as show:\n    show.report(status)\n"
    held += "    import time; time.sleep(0.3)"
    environment = {**os.environ, "COLUMNS": "160", "TERM": "xterm"}
    subprocess.run([sys.executable, "-c", held], env=environment, stderr=error, check=True)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "label" else pytest.mark.slow) for name in BARS]
)
def test_on_a_terminal_a_bar_tells_how_far_the_work_is(name: str) -> None:
    code, told = BARS[name]
    ours, theirs = pty.openpty()
    try:
        draw(code, theirs)
        drawn = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", os.read(ours, 100_000).decode())
    finally:
        os.close(theirs)
        os.close(ours)
    for words in told:
        assert words in drawn


def test_in_a_pipe_short_work_says_nothing() -> None:
    ours, theirs = os.pipe()
    draw(BARS["label"][0], theirs)
    os.close(theirs)
    with os.fdopen(ours) as reader:
        assert reader.read() == ""


@pytest.mark.variants
@pytest.mark.parametrize("name", ["label", "predictor"])
def test_in_a_pipe_a_line_comes_every_half_minute(name: str) -> None:
    """The interval is reduced to 0 here."""
    code, told = BARS[name]
    ours, theirs = os.pipe()
    draw(code, theirs, "import app.cli.console as c; c.SECONDS_BETWEEN_LINES = 0.0")
    os.close(theirs)
    with os.fdopen(ours) as reader:
        (line,) = reader.read().splitlines()
    assert line.startswith("lcollision: ")
    for words in told:
        assert words.replace("/200", " of 200").replace("%", " %").replace("  ", " ") in line


LOOP = """\
from lcollision_core.compiled import compiled

@compiled
def triangular(n):
    return n * (n + 1) // 2
"""


@pytest.mark.slow
def test_on_a_terminal_compiling_is_told_once_and_only_where_it_happens(tmp_path: Path) -> None:
    (tmp_path / "loop.py").write_text(LOOP)
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from app.cli.console import tell_what_takes_time\n"
        "tell_what_takes_time()\n"
        "import loop\n"
        "assert (loop.triangular(4), loop.triangular(4.0)) == (10, 10.0)\n"
    )

    def said(opened: Callable[[], tuple[int, int]]) -> bytes:
        ours, theirs = opened()
        subprocess.run([sys.executable, "-c", code], stderr=theirs, check=True)
        os.write(theirs, b".")
        os.close(theirs)
        text = os.read(ours, 100_000)
        os.close(ours)
        return text

    assert said(pty.openpty).count(b"compiling") == 1
    assert said(pty.openpty) == b"."
    shutil.rmtree(tmp_path / "__pycache__")
    assert said(os.pipe) == b"."


def test_closed_streams_change_no_exit_status(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "app", "check", tmp_path / "none.obj"]
    closed = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *map(str, command)]
    assert subprocess.run(closed, check=False).returncode == 2
