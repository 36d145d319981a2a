"""The editor as its user experiences it, model by model, each in a separate process.

The fields of a row; times are medians unless they say otherwise:

model, vertices : what was open
decode_ms, predict_ms : one pose alone; the second is None without a predictor
update_ms : of an event, all until drawing begins: slider, document, thread, panels, colours
render_ms : drawing one picture
compose_ms : that Qt takes to put the window together of the picture and the panels
overhead_p50_ms : of an event, everything but these two
event_p50_ms, event_p95_ms : from a slider's move until the window shows it, with Solid off
burst_lag_seconds : from the last of 250 moves within two seconds to the picture that shows it
drag_event_ms : in a solid drag of 60 events a second, from one until a picture shows it or a later
drag_lag_ms : by how much what a picture shows is older than the newest event, 95th percentile
idle_cpu : fraction of one core while nothing happens, once the library's pictures are drawn
start_seconds : from the command to a window that shows the pose, with warm caches
open_seconds : from dropping a character on a window that shows `body`, where nothing is to do, to
    one that shows it dragged, with warm caches; None for models
memory_mb : the most that the process held at once
actions : random actions done after that
exceptions : that they raised, in the window or in a thread behind it
errors : the text of the first
leak_mb : memory after them, less that after each kind once and the first tenth
mesh_is_right : whether the mesh drawn at the end is, to the bit, the model's of that pose
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from app.benchmarks.timing import Row
from app.window.editor import why_no_window
from lcollision_core.bodies import find_model
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import Progress, no_progress
from lcollision_core.meshes.scene_files import SCENE_SUFFIXES

START, DROP = -1, -2
"""In the place of a number of actions."""

_STARTS = 3
"""Runs for each model: the first fills the caches, the last is the one that is measured."""

_MOST_SECONDS, _MOST_SECONDS_AN_ACTION = 900.0, 10.0
"""Seconds until an editor counts as hanging: many times what a slow machine needs."""


def time_editor(
    models: Sequence[str], n_actions: int, progress: Progress = no_progress
) -> list[Row]:
    """Open the editor on each model and use it.

    Parameters
    ----------
    models : files or names
    n_actions : random actions to do with each
    progress : in starts of the editor

    Raises
    ------
    LCollisionError : a model is not there, no window can be opened here, or an editor ended early
        or hangs.
    """
    for model in models:
        find_model(model)
    reason = why_no_window(os.environ, sys.platform)
    if reason is not None:
        raise LCollisionError(
            f"there is no display to open a window on ({reason})",
            'run it on a desktop, or in xvfb-run -a -s "-screen 0 1600x1000x24"',
        )
    rows = []
    for index, model in enumerate(models):
        for start in range(_STARTS):
            is_last = start == _STARTS - 1
            answer = _run(find_model(model), n_actions if is_last else START)
            progress(index * _STARTS + start + 1, len(models) * _STARTS)
        is_character = find_model(model).suffix.lower() in SCENE_SUFFIXES
        dropped = _run(find_model(model), DROP)["open_seconds"] if is_character else None
        rows.append(answer | {"open_seconds": dropped})
    return rows


def _run(model: Path, n_actions: int) -> Row:
    """Run one editor with separate settings, log, sessions and library.

    Parameters
    ----------
    n_actions : random actions; `START` only starts it, `DROP` times a drop
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = {
            **os.environ,
            "XDG_CONFIG_HOME": str(Path(folder, "config")),
            "XDG_STATE_HOME": str(Path(folder, "state")),
            "XDG_DATA_HOME": str(Path(folder, "data")),
        }
        started = time.time()
        try:
            ended = subprocess.run(
                [sys.executable, "-m", "app.benchmarks.editor_session", str(model), str(n_actions)]
                + [repr(started)],
                env=environment,
                capture_output=True,
                text=True,
                check=False,
                timeout=_MOST_SECONDS + _MOST_SECONDS_AN_ACTION * max(n_actions, 0),
            )
        except subprocess.TimeoutExpired as error:
            raise LCollisionError(
                f"the editor hangs on {model}: no answer in {error.timeout:.0f} s",
                f"start it with `lcollision edit --model {model}` to see why",
            ) from error
    try:
        answer = json.loads(ended.stdout.splitlines()[-1])
    except (IndexError, ValueError) as error:
        last = (ended.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise LCollisionError(
            f"the editor ended early on {model} with status {ended.returncode} ({last})",
            f"start it with `lcollision edit --model {model}` to see why",
        ) from error
    assert isinstance(answer, dict)
    return answer
