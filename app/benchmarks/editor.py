"""Measure the editor: a scripted session, and the times of its events.

The fields of a row; times are medians unless stated otherwise:

model, vertices : the open model and its size
decode_ms, predict_ms : for a single pose; the second is None without a predictor
update_ms : of an event, until drawing begins: slider, document, thread, panels, colours
render_ms : drawing one picture
compose_ms : Qt's composition of the picture and the panels
overhead_p50_ms : of an event, everything but these two
event_p50_ms, event_p95_ms : from a slider's move until the window shows it, with Solid off
burst_lag_seconds : from the last of 250 moves within two seconds to the picture that shows it
drag_event_ms : in a solid drag of 60 events a second, from an event until a picture shows it or a
    later one
drag_lag_ms : age of the event that a picture shows against the newest event, 95th percentile
idle_cpu : fraction of one core while nothing happens, once the library's pictures are drawn
start_seconds : from the command to a window that shows the pose, with warm caches
open_seconds : from dropping a character on an idle window that shows `body` until it shows the
    character dragged, with warm caches; None for models
memory_mb : peak memory of the process
actions : random actions done after the timing
exceptions : raised by them, in the window or in a thread behind it
errors : the texts of the first ones
leak_mb : growth of memory during the actions, after each kind once and the first tenth
mesh_is_right : whether the mesh drawn at the end is bit-identical to the decoded pose

`app.benchmarks.editor` runs this module as a program, so that start and memory are those of a
fresh process.
"""

from __future__ import annotations

import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import rich  # noqa: F401 - loaded by the command before, like the next line
import typer  # noqa: F401
from PySide6.QtCore import QEventLoop, QObject, QTimer, Slot

from app.benchmarks.measures import Row, median_seconds
from app.editing.document import PoseDocument
from app.editing.live_pose import training_pose
from app.editing.settings import Settings
from app.view.camera import CAMERAS
from app.view.shading import Shading
from app.window.editor import make_application, why_no_window
from app.window.main_window import MainWindow
from app.window.start_up import StartUp
from app.work.compile_ahead import AHEAD
from app.work.threads import Failure
from lcollision_core.bodies import find_model
from lcollision_core.errors import LCollisionError
from lcollision_core.files.formats import SCENE_SUFFIXES
from lcollision_core.jobs import UNWATCHED, Job

if TYPE_CHECKING:
    from lcollision_core.posing import Grip


START, DROP = -1, -2
"""Special values for the number of actions: see `_run`."""

_STARTS = 3
"""Runs for each model: the first fills the caches, the last is measured."""

_MOST_SECONDS, _MOST_SECONDS_AN_ACTION = 900.0, 10.0
"""Time until an editor counts as hanging: many times that of a slow machine."""


def time_editor(models: Sequence[str], n_actions: int, job: Job = UNWATCHED) -> list[Row]:
    """Open the editor on each model and use it.

    Parameters
    ----------
    models : files or names
    n_actions : random actions to do with each
    job : reports starts of the editor

    Raises
    ------
    LCollisionError : a model is missing, no window can be opened here, or an editor ended early
        or hangs.
    """
    for model in models:
        find_model(model)
    reason = why_no_window(os.environ, sys.platform)
    if reason is not None:
        raise LCollisionError(
            f"no display is available ({reason})",
            'run it on a desktop, or in xvfb-run -a -s "-screen 0 1600x1000x24"',
        )
    rows = []
    for index, model in enumerate(models):
        for start in range(_STARTS):
            is_last = start == _STARTS - 1
            answer = _run(find_model(model), n_actions if is_last else START)
            job.report(index * _STARTS + start + 1, len(models) * _STARTS)
        is_character = find_model(model).suffix.lower() in SCENE_SUFFIXES
        dropped = _run(find_model(model), DROP)["open_seconds"] if is_character else None
        rows.append(answer | {"open_seconds": dropped})
    return rows


def _run(model: Path, n_actions: int) -> Row:
    """Run one editor with separate settings, log, sessions and library.

    Parameters
    ----------
    n_actions : number of random actions; `START` only starts the editor, `DROP` times a drop
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
                [sys.executable, "-m", "app.benchmarks.editor", str(model), str(n_actions)]
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
        last = (ended.stderr.strip().splitlines() or ["no output"])[-1]
        raise LCollisionError(
            f"the editor ended early on {model} with status {ended.returncode} ({last})",
            f"start it with `lcollision edit --model {model}` to see why",
        ) from error
    assert isinstance(answer, dict)
    return answer


_EVENTS = 60
_BURST_EVENTS, _BURST_SECONDS = 250, 2.0
_DRAG_EVENTS, _EVENTS_A_SECOND = 120, 60
_DRAG_RADIUS = 0.1
"""Radius of the circle that a patch is dragged in, in normalised length."""

_IDLE_SECONDS = 5.0
_IDLE_SHARE = 0.02
_MOST_PICTURE_SECONDS = 60
_TIMEOUT_SECONDS = 180.0
_REPEATS = 30
_MOST_ERRORS = 10
_MOST_KEPT = 20


class Session(QObject):
    """Uses a window as a user would, and measures it.

    Parameters
    ----------
    window : already showing its first pose
    """

    def __init__(self, window: MainWindow) -> None:
        super().__init__()
        self._window = window
        self._document = window.document
        self._code = self._document.model.latent_space.groups[1].codes.start
        self._slider = window.sliders.row_of(self._code).slider
        self._last_paint = (0.0, 0.0)
        self._composing = self._last_swap = 0.0
        self._pictures: list[tuple[float, bytes]] = []
        self._errors: list[str] = []
        canvas = window.viewport.canvas
        assert canvas is not None
        canvas.painted.connect(self._on_painted)
        canvas.aboutToCompose.connect(self._on_composing)
        canvas.frameSwapped.connect(self._on_swapped)
        self._document.failed.connect(self._on_failed)
        sys.excepthook = self._on_exception

    def measure(self, n_actions: int) -> dict[str, Any]:
        """Return the fields of a row except start and memory, see `app.benchmarks.editor`."""
        self.settle()
        idle_cpu = self.idle_cpu()
        self._document.motion.set_solid(False)
        updates, renders, composings, events = map(np.array, zip(*self.events(), strict=True))
        lag = self.burst()
        waits, lags = self.drag()
        errors, leak = self.act(n_actions)
        self.settle()
        return {
            **self._core_times(),
            "update_ms": 1e3 * statistics.median(updates),
            "render_ms": 1e3 * statistics.median(renders),
            "compose_ms": 1e3 * statistics.median(composings),
            "overhead_p50_ms": 1e3 * statistics.median(events - renders - composings),
            "event_p50_ms": 1e3 * statistics.median(events),
            "event_p95_ms": 1e3 * float(np.percentile(events, 95)),
            "burst_lag_seconds": lag,
            "drag_event_ms": 1e3 * statistics.median(waits),
            "drag_lag_ms": 1e3 * float(np.percentile(lags, 95)),
            "idle_cpu": idle_cpu,
            "actions": n_actions,
            "exceptions": len(errors),
            "errors": errors[:_MOST_ERRORS],
            "leak_mb": leak,
            "mesh_is_right": self.mesh_is_right(),
        }

    def events(self) -> list[tuple[float, float, float, float]]:
        """Move a slider repeatedly.

        Returns
        -------
        seconds : for each move: until drawing begins, of drawing, of composing the window, and
            from the move until it is on the screen
        """
        seconds = []
        chance = random.Random(0)
        for _ in range(_EVENTS):
            start = time.perf_counter()
            self._slider.move_to(chance.uniform(*self._slider.value_range))
            self.wait_for(self.is_shown)
            ended, render = self._last_paint
            compose = self._last_swap - self._composing
            seconds.append((ended - render - start, render, compose, self._last_swap - start))
            self.settle()
        return seconds

    def burst(self) -> float:
        """Drag a slider as fast as a user can; return the delay of the last picture."""
        start = last = time.monotonic()
        done = 0
        self._document.motion.begin_gesture("Move slider")
        while done < _BURST_EVENTS:
            due = int(_BURST_EVENTS * (time.monotonic() - start) / _BURST_SECONDS) + 1
            for event in range(done, min(due, _BURST_EVENTS)):
                low, high = self._slider.value_range
                self._slider.move_to(low + (event + 1) / _BURST_EVENTS * (high - low))
            last = time.monotonic()
            done = max(done, min(due, _BURST_EVENTS))
            self.pause()
        self.wait_for(self.is_shown)
        lag = time.monotonic() - last
        self._document.motion.end_gesture()
        return lag

    def drag(self) -> tuple[list[float], list[float]]:
        """Drag the outermost patch of the reference in a circle, with Solid on.

        Returns
        -------
        waits : seconds from each event until a picture shows it or a later one
        lags : for each picture, seconds from the event that it shows to the newest event
        """
        document, model = self._document, self._document.model
        document.motion.set_solid(True)
        document.motion.load_pose(training_pose(document.model, 0))
        self.settle()
        grip, home = self._outermost()
        side, up = np.delete(np.eye(3), model.up_axis, axis=0)[0], np.eye(3)[model.up_axis]
        moved: list[float] = []
        targets: list[npt.NDArray[np.float64]] = []
        start = time.perf_counter()
        document.motion.begin_drag(grip, "Drag")
        for turn in np.linspace(0.1, 6.0, _DRAG_EVENTS):
            while time.perf_counter() < start + len(moved) / _EVENTS_A_SECOND:
                self.pause(0.001)
            way = (np.cos(turn) - 1.0) * side + np.sin(turn) * up
            targets.append(home + _DRAG_RADIUS * model.body_size * way)
            moved.append(time.perf_counter())
            document.motion.drag_to(targets[-1])
        self.wait_for(lambda: self._shows(targets[-1]))
        document.motion.end_drag()
        numbers = {target.tobytes(): number for number, target in enumerate(targets)}
        pictures = [(seen, numbers[target]) for seen, target in self._pictures]
        self._pictures.clear()
        waits = [
            next(seen for seen, shown in pictures if shown >= number) - event
            for number, event in enumerate(moved)
        ]
        newest = np.searchsorted(moved, [seen for seen, _ in pictures]) - 1
        lags = [
            moved[last] - moved[shown] for last, (_, shown) in zip(newest, pictures, strict=True)
        ]
        return waits, lags

    def drop(self, path: Path) -> float:
        """Drop a character on the window; return the seconds until it is shown dragged."""
        document = self._document
        start = time.perf_counter()
        self._window.files.open_dropped([path])
        self.wait_for(lambda: Path(document.history.model_file) == path and self.is_shown())
        grip, home = self._outermost()
        target = home + _DRAG_RADIUS * document.model.body_size * np.eye(3)[document.model.up_axis]
        document.motion.begin_drag(grip, "Drag")
        document.motion.drag_to(target)
        self.wait_for(lambda: self._shows(target))
        seconds = time.perf_counter() - start
        document.motion.end_drag()
        self.settle()
        return seconds

    def _outermost(self) -> tuple[Grip, npt.NDArray[np.float64]]:
        """Return the outermost patch of the reference, and its position in the shown pose."""
        document = self._document
        assert document.motion.frame is not None
        reference = document.model.reference
        outwards = np.linalg.norm(reference - reference.mean(axis=0), axis=1)
        grip = document.motion.grip_at(int(outwards.argmax()))
        return grip, grip.position(document.motion.frame.vertices)

    def _shows(self, target: npt.NDArray[np.float64]) -> bool:
        return bool(self._pictures) and self._pictures[-1][1] == target.tobytes()

    def idle_cpu(self) -> float:
        """Idle for a while and return the fraction of a core used.

        Wait first for the library's pictures, which are drawn one by one while nothing else runs.
        """
        for _ in range(_MOST_PICTURE_SECONDS):
            cpu = time.process_time()
            self.pause(1.0)
            if time.process_time() - cpu < 0.5 * _IDLE_SHARE:
                break
        wall, cpu = time.monotonic(), time.process_time()
        self.pause(_IDLE_SECONDS)
        return (time.process_time() - cpu) / (time.monotonic() - wall)

    def act(self, n_actions: int) -> tuple[list[str], float]:
        """Do random actions, each regardless of the previous one's result.

        Returns
        -------
        errors : one sentence for each failure
        grown : growth of memory in MB, after each kind once and the first tenth, as modules that
            an action loads stay
        """
        self._errors.clear()
        chance = random.Random(1)
        acts = self._actions(chance)
        if n_actions:
            for act in acts:
                self._try(act)
                self.settle()
        before = memory_mb()
        for action in range(n_actions):
            self._try(chance.choices(list(acts), weights=list(acts.values()))[0])
            if action == n_actions // 10:
                self.settle()
                before = memory_mb()
        self.settle()
        return list(self._errors), memory_mb() - before

    def _try(self, act: Callable[[], object]) -> None:
        try:
            act()
        except Exception as error:
            self._on_exception(type(error), error, error.__traceback__)
        self.pause()

    def _actions(self, chance: random.Random) -> dict[Callable[[], object], float]:
        """Return the actions with their weights."""
        document, window = self._document, self._window
        viewport, model = window.viewport, document.model
        n_domains = len(model.domain_names)

        def slide() -> None:
            slider = window.sliders.row_of(chance.randrange(model.latent_size)).slider
            slider.setValue(chance.randint(slider.minimum(), slider.maximum()))

        def drag() -> None:
            vertex = chance.randrange(model.n_vertices)
            document.motion.begin_drag(document.motion.grip_at(vertex), "Drag")
            for _ in range(chance.randrange(1, 5)):
                way = [model.body_size * chance.gauss(0.0, 0.2) for _ in range(3)]
                document.motion.drag_to(model.reference[vertex] + way)
                self.pause(chance.choice([0.0, 0.02]))
            chance.choice(
                [document.motion.end_drag, document.motion.end_drag, document.motion.cancel_drag]
            )()

        def load() -> None:
            document.motion.load_pose(
                training_pose(model, chance.randrange(len(model.card.pose_names)))
            )

        def resolve() -> None:
            if document.model.can_resolve:
                document.tasks.resolve()

        def mirror() -> None:
            if not document.model.why_not_mirrored:
                document.tasks.mirror()

        def keep() -> None:
            if len(document.library.poses) < _MOST_KEPT:
                document.library.add_pose("kept")
            else:
                document.library.remove_poses([document.library.poses[0].name])

        return {
            slide: 50.0,
            drag: 10.0,
            document.history.undo: 10.0,
            document.history.redo: 8.0,
            load: 4.0,
            resolve: 3.0,
            document.tasks.cancel_resolve: 2.0,
            lambda: viewport.set_shading(chance.choice(list(Shading))): 3.0,
            lambda: window.resize(chance.randrange(1100, 1500), chance.randrange(700, 950)): 1.0,
            lambda: viewport.highlight_domain(chance.choice([None, *range(n_domains)])): 3.0,
            lambda: document.motion.set_locked(
                chance.randrange(n_domains), chance.random() < 0.5
            ): 2.0,
            keep: 1.0,
            mirror: 1.0,
            document.motion.reset_all: 1.0,
            lambda: viewport.set_camera(chance.choice(CAMERAS)): 1.0,
            lambda: window.set_theme(chance.choice(["light", "dark"])): 0.5,
            lambda: document.motion.randomise(chance.random(), chance.randrange(1000)): 3.0,
            self.settle: 2.0,
        }

    def mesh_is_right(self) -> bool:
        """Whether the drawn mesh is bit-identical to the decoded pose."""
        scene = self._window.viewport.scene
        decoded = self._document.model.decode(self._document.history.latent).astype(np.float32)
        return scene is not None and scene.surface.vertices.tobytes() == decoded.tobytes()

    def _core_times(self) -> dict[str, Any]:
        model, latent = self._document.model, self._document.history.latent
        predict = None
        if model.has_predictor:
            predict = 1e3 * median_seconds([lambda: model.predict(latent)] * _REPEATS)
        decode = median_seconds([lambda: model.decode(latent, n_threads=1)] * _REPEATS)
        return {
            "model": model.name,
            "vertices": model.n_vertices,
            "decode_ms": 1e3 * decode,
            "predict_ms": predict,
        }

    # Waiting, with events processed.

    def is_shown(self) -> bool:
        """Whether the picture on the screen is of the pose."""
        frame = self._window.viewport.shown_frame
        document = self._document
        return (
            frame is not None
            and frame.latent is document.history.latent
            and not document.motion.moving
        )

    def is_settled(self) -> bool:
        """Whether no work is pending."""
        document = self._document
        return (
            self.is_shown()
            and document.motion.exact is not None
            and not document.tasks.busy
            and self._window.viewport.is_at_rest
        )

    def settle(self) -> None:
        """Wait until no motion, computation or picture is pending."""
        self.wait_for(self.is_settled)

    def wait_for(self, condition: Callable[[], bool]) -> None:
        """Process events until a condition holds."""
        deadline = time.monotonic() + _TIMEOUT_SECONDS
        while not condition():
            if time.monotonic() > deadline:
                busy = self._document.tasks.busy
                raise TimeoutError(f"the window does not come to rest, busy with {busy!r}")
            self.pause(0.001)

    def pause(self, seconds: float = 0.0) -> None:
        """Process events for a while, or one turn, deferred deletions included."""
        loop = QEventLoop()
        QTimer.singleShot(int(1000 * seconds), loop.quit)
        loop.exec()

    @Slot(float)
    def _on_painted(self, seconds: float) -> None:
        self._last_paint = (time.perf_counter(), seconds)

    @Slot()
    def _on_composing(self) -> None:
        self._composing = time.perf_counter()

    @Slot()
    def _on_swapped(self) -> None:
        self._last_swap = time.perf_counter()
        frame = self._window.viewport.shown_frame
        if self._document.motion.dragging and frame is not None and frame.target is not None:
            self._pictures.append((self._last_swap, frame.target.tobytes()))

    @Slot(object)
    def _on_failed(self, failure: Failure) -> None:
        self._errors.append(failure.headline)

    def _on_exception(
        self, error_type: type[BaseException], error: BaseException, trace: Any
    ) -> None:
        self._errors.append(f"{error_type.__name__}: {error}")
        sys.__excepthook__(error_type, error, trace)


def memory_mb(peak: bool = False) -> float:
    """Return the resident memory of this process in MB, or its peak."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        # Outside Linux, only the peak is available without a library.
        import resource

        unit = 1e6 if sys.platform == "darwin" else 1e3
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    lines = dict(line.split(":", 1) for line in status.splitlines())
    return int(lines["VmHWM" if peak else "VmRSS"].split()[0]) / 1e3


def show_first_pose(window: MainWindow, model: str) -> None:
    """Show a window and wait until it shows the first pose of a model.

    Raises
    ------
    LCollisionError : the model cannot be opened.
    """
    loop = QEventLoop()
    failures: list[Failure] = []
    window.ready.connect(loop.quit)
    window.document.failed.connect(failures.append)
    window.document.failed.connect(loop.quit)
    window.show()
    StartUp(window, None, model).begin()
    loop.exec()
    if failures:
        raise LCollisionError(failures[0].headline, failures[0].next_step)


def run(model: str, n_actions: int, started: float) -> None:
    """Open the editor, run the session, and print one line of JSON.

    Parameters
    ----------
    model : the model's file
    n_actions : random actions after measuring, `START` for neither, or `DROP` to start with the
        bundled body and drop the model's file on it
    started : when the command was given, in seconds since 1970
    """
    AHEAD.begin()
    settings = Settings()
    # Qt needs the application for as long as there is a window.
    _application = make_application(settings)
    window = MainWindow(PoseDocument(), settings)
    try:
        show_first_pose(window, "body" if n_actions == DROP else model)
    except LCollisionError as error:
        window.close_unasked()
        sys.exit(str(error))
    answer: dict[str, Any] = {"start_seconds": time.time() - started}
    session = Session(window)
    if n_actions >= 0:
        answer = session.measure(n_actions) | answer
        answer["memory_mb"] = memory_mb(peak=True)
    else:
        # Finish compiling for the first prediction: the next start uses the cache.
        session.settle()
    if n_actions == DROP:
        answer["open_seconds"] = session.drop(Path(model).absolute())
    # Close without a question, and keep nothing.
    window.document.history.mark_saved()
    window.close()
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    run(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
