"""Turntables: size, rate, background and format, and their form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PySide6.QtWidgets import QApplication, QColorDialog, QDialog, QFileDialog
from pytestqt.qtbot import QtBot

from app.view.offscreen import VideoStyle
from app.view.theme import DARK, LIGHT, apply_theme
from app.window.dialogs.forms import Form, video_form
from app.window.main_window import MainWindow
from lcollision_core.errors import MeshFileError
from tests.app.windows import PATIENCE, answer, choose_file, take_picture

pytestmark = pytest.mark.one_window


def video(qtbot: QtBot, window: MainWindow, path: Path, style: VideoStyle) -> Path:
    """Make a turntable video, and return the path of the written file."""
    written = path.with_suffix("") if path.suffix == ".png" else path
    with qtbot.waitSignal(
        window.document.message,
        timeout=PATIENCE,
        check_params_cb=lambda words: words == f"Saved {written.name}",
    ):
        window.viewport.pictures.film(path, style)
    return written


@pytest.mark.variants
@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_a_video_goes_round_once_in_the_size_and_the_time_asked_for(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"turn{suffix}"
    style = VideoStyle(seconds=0.5, width=72, height=48, rate=30)
    assert video(qtbot, window, path, style) == path
    with Image.open(path) as image:
        assert (image.size, image.n_frames) == ((72, 48), 15)
        lasting, frames = 0, []
        for number in range(image.n_frames):
            image.seek(number)
            frames.append(np.asarray(image.convert("RGB"), dtype=int))
            lasting += image.info["duration"]
    assert lasting == 500
    # All frames differ: the last is not the first again.
    assert min(np.abs(frame - frames[0]).mean() for frame in frames[1:]) > 0
    assert [entry.name for entry in tmp_path.glob("turn*")] == [path.name]


def test_durations_add_up_to_the_turn_in_every_unit() -> None:
    for rate in (7, 24, 25, 30, 48, 60):
        for unit in (1, 10):
            durations = VideoStyle(seconds=3.0, rate=rate).durations(unit)
            assert len(durations) == 3 * rate
            assert sum(durations) == 3000
            assert max(durations) - min(durations) <= unit
            assert all(lasts % unit == 0 for lasts in durations)


def test_a_png_sequence_is_a_folder_of_numbered_pictures(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    style = VideoStyle(seconds=0.4, width=60, height=40, rate=10)
    folder = video(qtbot, window, tmp_path / "turn.png", style)
    assert folder == tmp_path / "turn"
    names = [f"turn_{number:04d}.png" for number in range(1, 5)]
    assert sorted(entry.name for entry in folder.iterdir()) == names
    with Image.open(folder / names[0]) as image:
        assert (image.size, image.mode) == ((60, 40), "RGB")
    kept = (folder / names[0]).read_bytes()
    with pytest.raises(MeshFileError, match="already exists; choose a new name"):
        window.viewport.pictures.film(tmp_path / "turn.png", style)
    assert (folder / names[0]).read_bytes() == kept


def test_a_cancelled_png_sequence_leaves_nothing(
    qtbot: QtBot, window: MainWindow, tmp_path: Path
) -> None:
    before = set(tmp_path.iterdir())
    style = VideoStyle(seconds=8.0, width=60, height=40)
    window.viewport.pictures.film(tmp_path / "turn.png", style)
    pictures = window.viewport.pictures
    qtbot.waitUntil(lambda: pictures._video.n_drawn > 2, timeout=PATIENCE)
    with qtbot.waitSignal(window.document.message) as told:
        pictures.cancel()
    assert told.args == ["The video was cancelled"]
    assert pictures.busy == ""
    assert set(tmp_path.iterdir()) == before


@pytest.mark.variants
@pytest.mark.parametrize("suffix", [".webp", ".png"])
def test_a_transparent_video_shows_nothing_but_the_body(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, suffix: str
) -> None:
    style = VideoStyle(seconds=0.2, width=60, height=60, rate=10, background="transparent")
    written = video(qtbot, window, tmp_path / f"turn{suffix}", style)
    with Image.open(written / "turn_0002.png" if suffix == ".png" else written) as image:
        alpha = np.asarray(image.convert("RGBA"))[:, :, 3]
    assert alpha[0, 0] == 0
    assert alpha.max() == 255


@pytest.mark.variants
@pytest.mark.parametrize("suffix", [".gif", ".webp", ".png"])
def test_one_colour_stands_behind_where_it_is_asked_for(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, suffix: str
) -> None:
    style = VideoStyle(0.2, 60, 60, 10, background="plain", colour="#20a040")
    written = video(qtbot, window, tmp_path / f"turn{suffix}", style)
    with Image.open(written / "turn_0001.png" if suffix == ".png" else written) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    for corner in (pixels[0, 0], pixels[-1, 0], pixels[0, -1], pixels[-1, -1]):
        assert np.abs(corner - [0x20, 0xA0, 0x40]).max() <= 6


@pytest.mark.variants(2)
@pytest.mark.parametrize(
    ("name", "style", "reason"),
    [
        ("turn.gif", VideoStyle(background="transparent"), "transparent background"),
        ("turn.gif", VideoStyle(rate=60), "a GIF has at most 50"),
        ("turn.webp", VideoStyle(20.0, 4096, 4096, 60), "too much for one file"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(
    window: MainWindow, tmp_path: Path, name: str, style: VideoStyle, reason: str
) -> None:
    with pytest.raises(MeshFileError, match=reason):
        window.viewport.pictures.film(tmp_path / name, style)
    assert window.viewport.pictures.busy == ""


def field(form: QDialog, key: str) -> object:
    assert isinstance(form, Form)
    return form._fields[f"turntable_{key}"]


def test_the_form_offers_what_the_format_can_hold(qtbot: QtBot, window: MainWindow) -> None:
    form = video_form(window.settings, window)
    qtbot.addWidget(form)
    kind, behind = field(form, "format"), field(form, "background")
    rate, colour = field(form, "rate"), field(form, "colour")
    last = behind.count() - 1
    assert behind.itemData(last) == "transparent"
    assert not behind.model().item(last).isEnabled()
    assert rate.maximum() == 50
    assert not colour.isEnabled()
    kind.setCurrentIndex(kind.findData("webp"))
    assert behind.model().item(last).isEnabled()
    assert rate.maximum() == 60
    behind.setCurrentIndex(last)
    rate.setValue(60)
    kind.setCurrentIndex(kind.findData("gif"))
    assert behind.currentData() == "shown"
    assert rate.value() == 50
    behind.setCurrentIndex(behind.findData("plain"))
    assert colour.isEnabled()
    asked = answer(pick)
    colour.click()
    assert not asked.isActive()
    assert colour.text() == "#336699"
    form.accept()
    again = video_form(window.settings, window)
    qtbot.addWidget(again)
    assert field(again, "colour").text() == "#336699"
    assert field(again, "background").currentData() == "plain"


def pick(dialog: QDialog) -> None:
    assert isinstance(dialog, QColorDialog)
    dialog.setCurrentColor("#336699")
    dialog.accept()


@pytest.mark.variants
@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_a_video_is_made_as_the_form_says(
    qtbot: QtBot, window: MainWindow, tmp_path: Path, theme: object
) -> None:
    apply_theme(QApplication.instance(), theme)
    path = tmp_path / "turn.webp"

    def fill(dialog: QDialog) -> None:
        field(dialog, "format").setCurrentIndex(1)
        field(dialog, "seconds").setValue(0.5)
        field(dialog, "rate").setValue(10)
        field(dialog, "width").setValue(64)
        field(dialog, "height").setValue(80)
        field(dialog, "background").setCurrentIndex(1)
        QApplication.processEvents()
        take_picture(dialog, f"turntable_{'dark' if theme is DARK else 'light'}")
        timers.append(answer(choose))
        dialog.accept()

    def choose(dialog: QDialog) -> None:
        assert isinstance(dialog, QFileDialog)
        assert dialog.defaultSuffix() == "webp"
        choose_file(dialog, path)

    timers = [answer(fill)]
    window.actions_by_key["turntable"].trigger()
    qtbot.waitUntil(path.is_file, timeout=PATIENCE)
    qtbot.waitUntil(lambda: not window.document.tasks.busy, timeout=PATIENCE)
    with Image.open(path) as image:
        assert (image.size, image.n_frames) == ((64, 80), 5)
    apply_theme(QApplication.instance(), LIGHT)
