"""Settings, log and symmetry: the small parts under the document."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PySide6.QtCore import QSettings, QtMsgType, qInstallMessageHandler, qWarning

from app import log
from app.engine import Failure
from app.settings import SETTINGS, Settings
from app.start_up import DEFAULT_MODEL, last_model, opening_pose
from app.symmetry import mirror_vertices
from app.tasks import mirror_of, mirrored
from lcollision_core.jobs import CancelToken, no_progress
from lcollision_core.model import PoseModel

OCTAHEDRON = np.array(
    [[1.0, 0, 0], [-1, 0, 0], [0, 0.8, 0], [0, -0.8, 0], [0, 0, 1.5], [0, 0, -1.5]]
)
OCTAHEDRON_FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
    dtype=np.int32,
)


@pytest.fixture
def store(tmp_path: Path) -> QSettings:
    return QSettings(str(tmp_path / "settings.ini"), QSettings.Format.IniFormat)


def test_every_setting_has_its_default_and_comes_back(store: QSettings) -> None:
    settings = Settings(store)
    for key, setting in SETTINGS.items():
        assert settings[key] == setting.default
    settings["theme"] = "dark"
    settings["show_ghost"] = False
    settings["randomise_amount"] = 0.25
    settings["screenshot_width"] = 640
    store.sync()
    again = Settings(QSettings(store.fileName(), QSettings.Format.IniFormat))
    assert again["theme"] == "dark"
    assert again["show_ghost"] is False
    assert again["randomise_amount"] == 0.25
    assert again["screenshot_width"] == 640


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("theme", "mauve"),
        ("show_ghost", "perhaps"),
        ("randomise_amount", "many"),
        ("randomise_amount", 17.0),
        ("screenshot_width", -5),
        # As an older version allowed: more frames than memory may hold.
        ("turntable_seconds", 60.0),
    ],
)
def test_what_cannot_be_reads_as_the_default(store: QSettings, key: str, value: object) -> None:
    store.setValue(key, value)
    assert Settings(store)[key] == SETTINGS[key].default


def test_a_value_beyond_its_limits_is_drawn_back(store: QSettings) -> None:
    settings = Settings(store)
    settings["screenshot_width"] = 10**9
    assert settings["screenshot_width"] == SETTINGS["screenshot_width"].high


def test_recent_files_are_few_and_each_there_once(store: QSettings) -> None:
    settings = Settings(store)
    settings.remember_file("only")
    store.sync()
    # A list of one comes back from an ini file as its item.
    settings = Settings(QSettings(store.fileName(), QSettings.Format.IniFormat))
    assert settings["recent_files"] == ("only",)
    for number in range(20):
        settings.remember_file(f"{number}.json")
    settings.remember_file("15.json")
    assert settings["recent_files"][:3] == ("15.json", "19.json", "18.json")
    assert len(settings["recent_files"]) == len(set(settings["recent_files"])) == 8
    settings.forget_file("19.json")
    assert settings["recent_files"][:2] == ("15.json", "18.json")


def test_a_model_that_is_gone_gives_way_to_the_default(tmp_path: Path) -> None:
    file = tmp_path / "mine.safetensors"
    assert last_model(str(file)) == DEFAULT_MODEL
    file.touch()
    assert last_model(str(file)) == str(file)
    assert last_model("body-swing") == "body-swing"
    assert last_model("") == last_model("no such model") == DEFAULT_MODEL


@pytest.fixture
def logging_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Log into a file of the test's own, and put everything back."""
    path = tmp_path / "logs" / "editor.log"
    monkeypatch.setattr(log, "log_file", lambda: path)
    root = logging.getLogger()
    handlers, level = root.handlers.copy(), root.level
    hooks = sys.excepthook, threading.excepthook
    yield path
    sys.excepthook, threading.excepthook = hooks
    qInstallMessageHandler(None)
    for handler in root.handlers[:]:
        if handler not in handlers:
            root.removeHandler(handler)
            handler.close()
    root.setLevel(level)


def test_the_log_holds_what_nobody_caught_and_what_qt_says(logging_into: Path) -> None:
    told: list[Failure] = []
    log.start_logging(told.append)
    log.start_logging(told.append)
    try:
        raise KeyError("missing bone")
    except KeyError as error:
        sys.excepthook(KeyError, error, error.__traceback__)
    qWarning("a timer of another thread")
    thread = threading.Thread(target=lambda: 1 / 0, name="worker")
    thread.start()
    thread.join()
    # As Qt's threads do with what their slots raise.
    slot = threading.Thread(target=sys.excepthook, args=(OSError, OSError("lost disk"), None))
    slot.start()
    slot.join()
    text = logging_into.read_text()
    assert text.count("nobody caught this\n") == 2
    assert "lost disk" in text
    assert "missing bone" in text
    assert "test_editor_parts" in text
    assert "a timer of another thread" in text
    assert "ZeroDivisionError" in text
    (failure,) = told
    assert "missing bone" in failure.sentence
    assert "Traceback" in failure.details
    assert len(log._QT_LEVELS) == len(QtMsgType)


def test_no_log_file_is_no_reason_not_to_start(logging_into: Path) -> None:
    logging_into.parent.write_text("a file, where the folder should be")
    log.start_logging()
    logging.getLogger("app").error("into the void")
    assert logging_into.parent.is_file()


def test_the_two_sides_of_a_symmetric_mesh_are_found() -> None:
    mirror = mirror_vertices(OCTAHEDRON, OCTAHEDRON_FACES, up_axis=2)
    assert mirror is not None
    assert mirror.tolist() == [1, 0, 2, 3, 4, 5]
    # With x up, front and back of z or left and right of y are what is left to exchange.
    across = mirror_vertices(OCTAHEDRON, OCTAHEDRON_FACES, up_axis=0)
    assert across is not None
    assert across.tolist() == [0, 1, 3, 2, 4, 5]


def test_a_dented_mesh_has_no_two_sides() -> None:
    dented = OCTAHEDRON.copy()
    dented[0] *= 0.9
    dented[2] *= 0.8
    assert mirror_vertices(dented, OCTAHEDRON_FACES, up_axis=2) is None


def test_symmetric_points_with_other_faces_have_no_two_sides() -> None:
    turned = OCTAHEDRON_FACES.copy()
    turned[0] = turned[0, ::-1]
    assert mirror_vertices(OCTAHEDRON, turned, up_axis=2) is None


@pytest.fixture(scope="module")
def body() -> PoseModel:
    return PoseModel.load("body")


def mesh_distance(
    model: PoseModel, vertices: npt.NDArray[np.float64], others: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return the vertices' distances in heights, at the rigid motion that makes them least."""
    a, b = vertices - vertices.mean(axis=0), others - others.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    u[:, -1] *= np.sign(np.linalg.det(u @ vt))
    return np.linalg.norm(a @ u @ vt - b, axis=1) / model.height


@pytest.mark.parametrize("name", ["kneeling guard", "rest", "right side lunge", "twist right"])
def test_the_mirror_image_of_the_body_is_as_near_as_an_unseen_pose(
    body: PoseModel, name: str
) -> None:
    """Mirrored poses are unseen ones: the model's held-out error is what it may be off by."""
    if name in body.pose_names:
        latent = body.training_latent[body.pose_names.index(name)]
    else:
        opening = opening_pose(body)
        assert opening.name == name
        latent = opening.latent
    mirror, metrics = mirror_of(body), body.metrics
    assert mirror is not None
    assert metrics is not None
    assert metrics.held_out_mean is not None
    assert metrics.held_out_max is not None
    once = mirrored(body, latent, mirror)(no_progress, CancelToken())
    twice = mirrored(body, once, mirror)(no_progress, CancelToken())
    posed = body.decode(latent)
    image = posed[mirror] * np.array([-1.0, 1.0, 1.0])
    for found, wanted in ((body.decode(once), image), (body.decode(twice), posed)):
        distance = mesh_distance(body, found, wanted)
        assert distance.mean() < metrics.held_out_mean
        assert distance.max() < metrics.held_out_max
    # The first mirroring did something, unless the pose has two equal sides.
    moved = mesh_distance(body, body.decode(once), posed).mean()
    assert (moved > 10.0 * metrics.held_out_mean) == (name != "rest")
