"""The editor beyond its main workflow: crashes, themes, keyboard, no display, long use."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QPoint, QPointF, Qt
from PySide6.QtGui import QAction, QColor, QKeySequence, QPalette, QWheelEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QDialog, QMenu, QMessageBox, QWidget
from pytestqt.qtbot import QtBot

from app.benchmarks import editor as editor_benchmark
from app.benchmarks.editor import Session, show_first_pose
from app.editing.document import PoseDocument
from app.editing.live_pose import training_pose
from app.editing.recovery import sessions_folder
from app.view.camera import sees_all
from app.view.shading import Shading
from app.view.theme import DARK, LIGHT, Theme, visible_colour
from app.window.dialogs.questions import FailureDialog
from app.window.editor import why_no_window
from app.window.main_window import MainWindow
from app.window.start_up import StartUp, opening_pose
from app.work.threads import Failure
from lcollision_core.bodies import LearnedBody
from lcollision_core.errors import LCollisionError
from lcollision_core.files import write_mesh
from tests.app.support import Lcollision, export_pose
from tests.app.views import on_screen
from tests.app.windows import (
    PATIENCE,
    answer,
    application,
    close_window,
    decoded,
    dispose,
    open_window,
    rest,
    settings_in,
    shown,
    take_picture,
)

pytestmark = [pytest.mark.one_window, pytest.mark.usefixtures("compiled_body")]

ROOT = Path(__file__).parents[3]
N_ACTIONS = int(os.environ.get("LCOLLISION_RANDOM_ACTIONS", "300"))
THEMES = pytest.mark.parametrize(
    "theme",
    [pytest.param(LIGHT, id="light"), pytest.param(DARK, marks=pytest.mark.slow, id="dark")],
)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep settings, log and sessions of this process and its children in a separate folder."""
    for name in ("XDG_CONFIG_HOME", "XDG_STATE_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(tmp_path / name))
    return tmp_path


@pytest.fixture
def signals() -> Iterator[None]:
    """Restore the signal handlers that an editor replaces."""
    held = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in held.items():
        signal.signal(number, handler)


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start a real editor; kill it if it still runs after the test."""
    started = []

    def run(*arguments: object) -> subprocess.Popen[str]:
        words = [sys.executable, "-m", "app", "edit", *map(str, arguments)]
        editor = subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        started.append(editor)
        return editor

    yield run
    for editor in started:
        editor.kill()
        editor.communicate()


@pytest.fixture(scope="module")
def body() -> LearnedBody:
    return LearnedBody.load("body")


def wait_until(editor: subprocess.Popen[str], happened: Callable[[], bool], what: str) -> None:
    """Wait for an event of a running editor, which may have to compile first."""
    deadline = time.monotonic() + 4 * PATIENCE / 1000
    while not happened():
        if time.monotonic() > deadline or editor.poll() is not None:
            editor.kill()
            raise AssertionError(f"no {what}: {editor.communicate()[1]}")
        time.sleep(0.05)


def wait_for_file(editor: subprocess.Popen[str], pattern: str) -> Path:
    """Wait until an editor has written a file into its session."""
    wait_until(editor, lambda: any(sessions_folder().glob(pattern)), pattern)
    return next(sessions_folder().glob(pattern))


# Crashes and a clean end.


@pytest.mark.slow
@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize(("how", "status"), [(signal.SIGKILL, -9), (signal.SIGTERM, 0)])
def test_a_killed_editor_s_pose_is_offered_at_the_next_start(
    qtbot: QtBot,
    home: Path,
    start: Callable[..., subprocess.Popen[str]],
    editor_model: LearnedBody,
    how: signal.Signals,
    status: int,
) -> None:
    model_file, mesh = home / "tube.safetensors", home / "bent.obj"
    editor_model.save(model_file)
    bent = editor_model.decode(0.4 * editor_model.latent_space.high)
    write_mesh(mesh, bent, editor_model.faces)
    editor = start(mesh, "--model", model_file)
    # An imported mesh is an unsaved change.
    wait_for_file(editor, "*/session.json")
    editor.send_signal(how)
    assert editor.wait(PATIENCE / 1000) == status

    offers = []

    def recover(dialog: QDialog) -> None:
        assert isinstance(dialog, QMessageBox)
        offers.append(dialog.text())
        (button,) = [held for held in dialog.buttons() if held.text().replace("&", "") == "Recover"]
        button.click()

    document = PoseDocument()
    window = MainWindow(document, settings_in(home))
    window.show()
    start_up = StartUp(window, None, str(model_file))
    timer = answer(recover)
    with qtbot.waitSignal(
        document.message, timeout=PATIENCE, check_params_cb=lambda text: "Recovered" in text
    ):
        start_up.begin()
    timer.stop()
    # It looks out for signals until the process ends.
    start_up.setParent(None)
    rest(qtbot, window)
    name = model_file.stem
    assert offers == [
        f"The editor closed unexpectedly while the pose “bent” of “{name}” was not saved."
    ]
    assert document.history.pose.name == "bent"
    assert document.history.modified
    assert np.array_equal(shown(window), decoded(document))
    assert np.abs(shown(window) - bent).max() < 2e-3 * editor_model.body_size
    close_window(window)
    assert list(sessions_folder().iterdir()) == []


@pytest.mark.slow
def test_it_opens_on_the_built_in_body_and_ends_when_told_to(
    home: Path, start: Callable[..., subprocess.Popen[str]]
) -> None:
    editor = start()
    wait_for_file(editor, "*/lock")
    (log,) = home.rglob("editor.log")
    wait_until(editor, lambda: "the first pose is on the screen" in log.read_text(), "first pose")
    editor.send_signal(signal.SIGTERM)
    _, errors = editor.communicate(timeout=PATIENCE / 1000)
    assert editor.returncode == 0, errors
    assert "Error" not in errors
    assert "ERROR" not in log.read_text()
    assert list(sessions_folder().iterdir()) == []


def share_of_height(window: MainWindow) -> float:
    """Return the share of the view's height that the shown pose fills."""
    canvas = window.viewport.canvas
    assert canvas is not None
    places = [on_screen(canvas, vertex).y() for vertex in shown(window)]
    assert 0.0 < min(places) < max(places) < canvas.height()
    return (max(places) - min(places)) / canvas.height()


@pytest.mark.variants
@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("opens_a_mesh", [False, True], ids=["pose", "mesh"])
def test_it_opens_with_the_camera_on_its_first_pose_and_then_steps_back_only(
    qtbot: QtBot, home: Path, body: LearnedBody, opens_a_mesh: bool
) -> None:
    document, settings = PoseDocument(), settings_in(home)
    settings["model"] = str(home / "gone.safetensors")
    window = MainWindow(document, settings)
    window.resize(1280, 800)
    window.show()
    mesh = home / "kneeling.obj"
    kneeling = opening_pose(body)
    if opens_a_mesh:
        write_mesh(mesh, body.decode(kneeling.latent), body.faces)
    start_up = StartUp(window, mesh if opens_a_mesh else None, None)
    with qtbot.waitSignal(document.history.pose_loaded, timeout=4 * PATIENCE):
        start_up.begin()
    start_up.setParent(None)
    rest(qtbot, window)
    assert settings["model"] == "body"
    assert document.history.pose.name == ("kneeling" if opens_a_mesh else kneeling.name)
    # It was half before, framed for the standing body.
    assert 0.62 < share_of_height(window) < 0.85
    view = window.viewport.scene.view
    document.motion.begin_gesture("Drag")
    document.motion.set_code(0, 0.0)
    document.motion.end_gesture()
    document.motion.load_pose(training_pose(document.model, 0))
    rest(qtbot, window)
    after = window.viewport.scene.view
    assert view is not None
    assert after is not None
    # The camera moves back only as far as showing the whole standing body needs.
    assert window.viewport.shown_frame is not None
    vertices = window.viewport.shown_frame.vertices
    aspect = window.viewport.width() / window.viewport.height()
    assert not sees_all(view, vertices, aspect)
    assert sees_all(after, vertices, aspect)
    arms = [one.position - one.focus for one in (view, after)]
    directions = [arm / np.linalg.norm(arm) for arm in arms]
    np.testing.assert_allclose(directions[0], directions[1], atol=1e-6)
    close_window(window)


# No display.


@pytest.mark.parametrize(
    ("environment", "platform", "is_told"),
    [
        ({}, "linux", True),
        ({"DISPLAY": ":6543"}, "linux", False),
        ({"WAYLAND_DISPLAY": "none"}, "linux", False),
        ({"QT_QPA_PLATFORM": "offscreen"}, "linux", False),
        ({}, "win32", False),
        ({}, "darwin", False),
    ],
)
def test_without_any_display_qt_is_not_even_loaded(
    environment: dict[str, str], platform: str, is_told: bool
) -> None:
    reason = "neither DISPLAY nor WAYLAND_DISPLAY is set" if is_told else None
    assert why_no_window(environment, platform) == reason


@pytest.mark.parametrize(
    ("words", "extra", "reason"),
    [
        pytest.param((), {}, "neither DISPLAY nor WAYLAND_DISPLAY is set", id="alone"),
        pytest.param(("edit",), {}, "neither DISPLAY nor", id="edit", marks=pytest.mark.slow),
        pytest.param((), {"DISPLAY": ":6543"}, "could not connect to display :6543", id="x"),
        # An X display, but no Wayland compositor.
        pytest.param(
            (),
            {"DISPLAY": os.environ.get("DISPLAY", ":0"), "QT_QPA_PLATFORM": "wayland"},
            "unset QT_QPA_PLATFORM, which is 'wayland'",
            id="wayland",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            (),
            {"QT_QPA_PLATFORM": "cocoa"},
            "unset QT_QPA_PLATFORM, which is 'cocoa'",
            id="unknown",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_without_a_display_one_sentence_names_what_works_there(
    words: tuple[str, ...], extra: dict[str, str], reason: str
) -> None:
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM")
    environment = {key: value for key, value in os.environ.items() if key not in hidden} | extra
    ended = subprocess.run(
        [sys.executable, "-m", "app", *words],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2
    assert ended.stdout == ""
    (sentence,) = ended.stderr.splitlines()
    assert "no display" in sentence
    assert reason in sentence
    assert "`lcollision resolve`" in sentence


# Themes.


def luminance(colour: QColor) -> float:
    """Return the relative luminance of WCAG 2.1."""
    channels = np.array(colour.getRgbF()[:3])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def contrast(colour: QColor, other: QColor) -> float:
    light, dark = sorted((luminance(colour), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


@THEMES
def test_what_is_read_stands_out_from_what_is_behind_it(theme: Theme) -> None:
    for behind in (theme.window, theme.card, theme.field):
        for ink in (theme.text, theme.muted, theme.free, theme.colliding, theme.waiting):
            assert contrast(QColor(ink), QColor(behind)) >= 4.5, (ink, behind)
    assert contrast(QColor(theme.on_accent), QColor(theme.accent)) >= 4.5
    # The signs and bars beside the words need less contrast.
    assert contrast(QColor(theme.accent), QColor(theme.card)) >= 3.0


def test_the_window_takes_on_both_themes(window: MainWindow) -> None:
    for theme in (LIGHT, DARK):
        window.set_theme(theme.name)
        QApplication.processEvents()
        role = QPalette.ColorRole
        palette = window.palette()
        assert palette.color(role.Window) == QColor(theme.window)
        assert contrast(palette.color(role.WindowText), palette.color(role.Window)) >= 7.0
        picture = window.grab().toImage()
        ratio = picture.devicePixelRatio()
        places = [(3, window.height() - 4), (window.width() // 3, 6)]
        for x, y in places:
            seen = picture.pixelColor(int(x * ratio), int(y * ratio))
            assert contrast(seen, QColor(theme.window)) < 1.1
        lit = [luminance(visible_colour(c)) for c in window.document.model.card.domain_colours]
        if theme.is_dark:
            assert min(lit) > luminance(QColor(theme.track))
    assert window.settings["theme"] == "dark"


# The keyboard.


def menu_actions(menu: QMenu) -> Iterator[QAction]:
    for action in menu.actions():
        held = action.menu()
        if isinstance(held, QMenu):
            yield from menu_actions(held)
        elif not action.isSeparator():
            yield action


def test_every_action_is_in_a_menu_and_has_a_shortcut_of_its_own(window: MainWindow) -> None:
    entries = [action for menu in window.menus.values() for action in menu_actions(menu)]
    without = {action.text() for action in entries if not action.shortcuts()}
    # A slip from Ctrl+U would change the model's file.
    assert without == {"No files yet", "Turn &upright"}
    named = [action for action in entries if action.shortcuts()]
    keyed = {held for key, held in window.actions_by_key.items() if key != "upright"}
    assert keyed <= set(named)
    assert len(named) == len(set(named))
    keys = [key.toString() for action in named for key in action.shortcuts()]
    assert len(keys) > len(window.actions_by_key)
    assert sorted(keys) == sorted(set(keys))
    assert all(action.toolTip() and action.toolTip() != action.text() for action in named)


@pytest.mark.variants(2)
@pytest.mark.parametrize(
    ("key", "share"),
    [
        (Qt.Key.Key_Right, 0.01),
        (Qt.Key.Key_Up, 0.01),
        (Qt.Key.Key_Left, -0.01),
        (Qt.Key.Key_PageUp, 0.1),
        (Qt.Key.Key_PageDown, -0.1),
    ],
)
def test_keys_move_a_focused_slider(
    qtbot: QtBot, window: MainWindow, key: Qt.Key, share: float
) -> None:
    row, space = window.sliders.row_of(1), window.document.model.latent_space
    row.slider.setFocus()
    before = row.slider.number
    QTest.keyClick(row.slider, key)
    width = float(space.high[1] - space.low[1])
    assert window.document.history.latent[1] - before == pytest.approx(share * width)
    rest(qtbot, window)
    assert np.array_equal(shown(window), decoded(window.document))


@pytest.mark.own_window
@pytest.mark.variants
@pytest.mark.parametrize("of_words", [False, True], ids=["number", "words"])
def test_the_window_s_shortcuts_work_while_a_field_has_the_keyboard(
    window: MainWindow, of_words: bool
) -> None:
    row = window.sliders.row_of(0)
    field: QWidget = window.sliders.filter if of_words else row.field
    fired: list[str] = []
    window.document.motion.set_code(1, 0.5)
    for action in window.actions_by_key.values():
        # Only test the key: most actions open a dialog.
        action.triggered.disconnect()
        action.triggered.connect(
            lambda _, action=action: fired.append(action.shortcut().toString())
        )
    field.setFocus()
    for keys in ("Ctrl+E", "Ctrl+R", *(() if of_words else ("Ctrl+K",))):
        pressed = QKeySequence(keys)[0]
        QTest.keyClick(field, pressed.key(), pressed.keyboardModifiers())
        assert fired.pop() == keys
    editing = ["Ctrl+A", "Ctrl+C", "Ctrl+V", "Ctrl+X", "Left", "Right", "Backspace", "Del"]
    editing += ["Ctrl+Backspace", "Ctrl+Del", "Ctrl+Home", "Ctrl+End"]
    for keys in (*editing, *(("Ctrl+K", "Ctrl+U") if of_words else ())):
        pressed = QKeySequence(keys)[0]
        QTest.keyClick(field, pressed.key(), pressed.keyboardModifiers())
    assert fired == []
    QTest.keyClicks(field, "1")
    QTest.keyClick(field, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier)
    assert fired == ([] if of_words else ["Ctrl+Z"])


def test_deleting_a_word_of_a_field_changes_no_pose(window: MainWindow) -> None:
    document, field = window.document, window.library.search
    document.motion.set_code(1, 0.5)
    document.library.add_pose("kept")
    window.library.choose_own("kept")
    window.actions_by_key["find_pose"].trigger()
    QTest.keyClicks(field, "ke pt")
    QTest.keyClick(field, Qt.Key.Key_Backspace, Qt.KeyboardModifier.ControlModifier)
    assert field.text() == "ke "
    field.home(False)
    QTest.keyClick(field, Qt.Key.Key_Delete, Qt.KeyboardModifier.ControlModifier)
    assert field.text() == ""
    assert document.history.latent[1] == 0.5
    assert [pose.name for pose in document.library.poses] == ["kept"]


def turn_wheel(widget: QWidget) -> None:
    place = QPointF(widget.rect().center())
    event = QWheelEvent(
        place,
        widget.mapToGlobal(place),
        QPoint(),
        QPoint(0, 120),
        Qt.MouseButton.NoButton,
        Qt.KeyboardModifier.NoModifier,
        Qt.ScrollPhase.NoScrollPhase,
        False,
    )
    QApplication.sendEvent(widget, event)


def test_the_wheel_moves_only_what_has_the_focus(window: MainWindow) -> None:
    row, before = window.sliders.row_of(0), window.document.history.latent
    for widget in (row.slider, row.field):
        window.viewport.setFocus()
        turn_wheel(widget)
        assert np.array_equal(window.document.history.latent, before)
    row.slider.setFocus()
    turn_wheel(row.slider)
    assert window.document.history.latent[0] > before[0]


def test_tab_goes_through_everything_once_and_row_by_row(window: MainWindow) -> None:
    filter_field = window.sliders.filter
    filter_field.setFocus()
    visited: list[QWidget] = []
    for _ in range(300):
        focused = QApplication.focusWidget()
        assert focused is not None
        if focused in visited:
            break
        visited.append(focused)
        QTest.keyClick(focused, Qt.Key.Key_Tab)
    assert QApplication.focusWidget() is filter_field
    assert all(widget.isVisible() and widget.isEnabled() for widget in visited)
    opened = window.sliders.groups[0]
    expected: list[QWidget] = [filter_field, opened.header.button]
    for row in opened.rows:
        expected += [row.slider, row.field]
    expected += [group.header.button for group in window.sliders.groups[1:]]
    assert visited[: len(expected)] == expected
    assert window.collision.resolve.button in visited
    locks = [row.lock for row in window.collision.prediction.rows]
    assert [widget for widget in visited if widget in locks] == locks


def test_the_layout_is_remembered(
    qtbot: QtBot, document: PoseDocument, editor_model: LearnedBody, tmp_path: Path
) -> None:
    first = open_window(qtbot, document, settings_in(tmp_path))
    first.docks["library"].hide()
    first.resize(1190, 760)
    first.actions_by_key["predicted"].trigger()
    first.set_theme("dark")
    rest(qtbot, first)
    close_window(first)
    again = PoseDocument()
    again.set_model(editor_model)
    second = open_window(qtbot, again, settings_in(tmp_path), size=(1440, 900))
    # As the constructor restored it, before the helper above resized it.
    third = MainWindow(PoseDocument(), settings_in(tmp_path))
    assert (third.width(), third.height()) == (1190, 760)
    third.close()
    dispose(third)
    assert not second.docks["library"].isVisible()
    assert second.docks["sliders"].isVisible()
    assert second.viewport.shading is Shading.PREDICTED
    assert second.palette().color(QPalette.ColorRole.Window) == QColor(DARK.window)
    second.reset_layout()
    assert second.docks["library"].isVisible()


# Long use, and how it looks.


@pytest.mark.slow
def test_random_actions_end_with_the_right_mesh(
    qtbot: QtBot, window: MainWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    errors, grown = Session(window).act(N_ACTIONS)
    rest(qtbot, window)
    assert errors == []
    assert shown(window).tobytes() == decoded(window.document).tobytes()
    assert grown < 50.0
    assert window.document.history.undo_stack.count() > 0


@pytest.mark.slow
def test_random_actions_tell_what_goes_wrong_and_go_on(
    window: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise ValueError("not today")

    def fail_in_a_thread(*_: object) -> None:
        export_pose(window.document, tmp_path / "no such folder" / "pose.obj")

    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    monkeypatch.setattr(window.document.motion, "reset_all", fail)
    monkeypatch.setattr(window.document.motion, "randomise", fail_in_a_thread)
    errors, _ = Session(window).act(1)
    raised, told = errors
    assert raised == "ValueError: not today"
    assert "no folder" in told
    window.findChild(FailureDialog).reject()


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("home")
def test_the_benchmark_measures_a_session_of_its_own(
    lcollision: Lcollision,
    editor_model: LearnedBody,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The caches are warm: no start before the measured one.
    monkeypatch.setattr(editor_benchmark, "_STARTS", 1)
    editor_model.save(tmp_path / "tube.safetensors")
    result = lcollision(
        "benchmark", "editor", "--model", tmp_path / "tube.safetensors", "-n", 3, "--json"
    )
    assert result.exit_code == 0, result.stderr
    (row,) = json.loads(result.stdout)
    assert set(row) == {
        *("model", "vertices", "decode_ms", "predict_ms", "update_ms", "render_ms"),
        *(
            "compose_ms",
            "overhead_p50_ms",
            "event_p50_ms",
            "event_p95_ms",
            "burst_lag_seconds",
            "drag_event_ms",
            "drag_lag_ms",
            "idle_cpu",
            "start_seconds",
            "open_seconds",
        ),
        *("memory_mb", "actions", "exceptions", "errors", "leak_mb", "mesh_is_right"),
    }
    assert (row["model"], row["vertices"]) == ("tube", editor_model.n_vertices)
    assert (row["actions"], row["exceptions"], row["errors"]) == (3, 0, [])
    assert row["mesh_is_right"] is True
    assert np.isfinite(row["leak_mb"])
    numbers = {name: row[name] for name in row if name.endswith(("_ms", "_seconds", "_mb", "_cpu"))}
    del numbers["leak_mb"]
    assert numbers.pop("open_seconds") is None  # only for characters
    assert all(0.0 <= number < np.inf for number in numbers.values()), numbers
    assert 0.0 < row["decode_ms"] < row["event_p95_ms"]
    assert row["event_p50_ms"] <= row["event_p95_ms"]
    # The parts are contained in a move: the medians are over the same moves.
    parts = ("update_ms", "render_ms", "compose_ms", "overhead_p50_ms")
    assert max(row[part] for part in parts) <= row["event_p95_ms"]
    assert min(row[part] for part in parts) > 0.0
    assert row["memory_mb"] > 100.0
    assert row["start_seconds"] > row["event_p50_ms"] / 1e3


def test_the_benchmark_refuses_a_model_that_is_not_there(lcollision: Lcollision) -> None:
    result = lcollision("benchmark", "editor", "--model", "nobody")
    assert result.exit_code == 2
    (sentence,) = result.stderr.splitlines()
    assert "nobody" in sentence


@pytest.mark.usefixtures("qapp", "signals")
def test_the_benchmark_ends_where_a_model_cannot_be_opened(home: Path) -> None:
    broken = home / "broken.safetensors"
    broken.write_text("garbage")
    window = MainWindow(PoseDocument(), settings_in(home))
    with pytest.raises(LCollisionError, match="broken"):
        show_first_pose(window, str(broken))
    # It looks out for signals until the process ends.
    window.findChild(StartUp).setParent(None)
    window.close_unasked()
    dispose(window)


@THEMES
def test_the_built_in_body_from_colliding_to_free(
    qtbot: QtBot, body: LearnedBody, tmp_path: Path, theme: Theme
) -> None:
    document, settings = PoseDocument(), settings_in(tmp_path)
    settings["theme"] = theme.name
    with qtbot.waitSignal(
        document.motion.exact_changed,
        timeout=PATIENCE,
        check_params_cb=lambda: document.motion.exact is not None,
    ):
        document.set_model(body)
    document.motion.load_pose(opening_pose(body))
    document.history.undo_stack.clear()
    window = open_window(qtbot, document, settings)
    qtbot.waitUntil(lambda: document.motion.frame.prediction is not None, timeout=PATIENCE)
    window.viewport.set_shading(Shading.DOMAINS)
    rest(qtbot, window)
    take_picture(window, f"{theme.name}-start")
    assert document.motion.exact is not None
    assert document.motion.exact.colliding
    assert document.motion.frame is not None
    assert document.motion.frame.prediction is not None
    assert document.motion.frame.prediction.collision_probability > 0.5
    window.viewport.set_shading(Shading.EXACT)
    rest(qtbot, window)
    take_picture(window, f"{theme.name}-colliding")
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=PATIENCE):
        window.actions_by_key["resolve"].trigger()
    rest(qtbot, window)
    take_picture(window, f"{theme.name}-resolved")
    assert document.history.state.outcome is not None
    assert document.history.state.outcome.exactly_free
    assert not document.motion.exact.colliding
    assert document.history.ghost is not None
    window.show_failure(
        Failure("bent.obj has 3 vertices", "import a mesh of this model", "details")
    )
    (dialog,) = window.findChildren(FailureDialog)
    qtbot.waitUntil(dialog.isVisible)
    take_picture(window, f"{theme.name}-error")
    dialog.reject()
    assert application().activeModalWidget() is None
