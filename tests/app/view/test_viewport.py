"""The viewport in a real window: drawing, mouse events, and clean-up."""

from __future__ import annotations

import gc
import threading
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from PySide6.QtCore import QEvent, QObject, Qt, QTimer
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QWidget
from pytestqt.qtbot import QtBot
from shiboken6 import isValid

from app.editing.document import PoseDocument
from app.view.camera import View
from app.view.canvas import Canvas
from app.view.legend import LegendStrip
from app.view.offscreen import PoseRenderer, VideoStyle
from app.view.shading import Shading
from app.view.theme import DARK, LIGHT, apply_theme
from app.view.viewport import Viewport
from app.work.threads import Failure
from lcollision_core.bodies import LearnedBody
from lcollision_core.contact import ContactRules
from lcollision_core.errors import LCollisionError, MeshFileError
from tests.app.views import (
    SIDE,
    changed,
    dispose,
    pixels,
    place_of,
    rest,
    steady_pixels,
)


def test_before_the_model_there_is_a_page_that_says_so(
    qtbot: QtBot, editor_model: LearnedBody
) -> None:
    document = PoseDocument()
    shown = Viewport(document)
    shown.resize(SIDE, SIDE)
    shown.show()
    qtbot.waitExposed(shown)
    document.tasks.busy_changed.emit("Opening body")
    first = pixels(shown)
    qtbot.waitUntil(lambda: changed(first, pixels(shown)).any(), timeout=20_000)
    assert shown.shown_frame is None
    with pytest.raises(LCollisionError, match="not on the screen yet"):
        shown.pictures.screenshot("never.png", 10, 10, transparent=True)
    document.set_model(editor_model)
    rest(qtbot, shown)
    assert shown.shown_frame is not None
    assert document.close()
    dispose(shown)
    document.deleteLater()


def test_where_no_model_could_be_opened_the_page_stands_still_and_offers_another(
    qtbot: QtBot, editor_model: LearnedBody, tmp_path: Path
) -> None:
    (tmp_path / "bad.safetensors").write_text("garbage")
    document = PoseDocument()
    shown = Viewport(document)
    shown.resize(SIDE, SIDE)
    shown.show()
    qtbot.waitExposed(shown)
    page = shown.waiting
    assert page.turns
    assert not page.button.isVisible()
    with qtbot.waitSignal(document.failed, timeout=20_000):
        document.tasks.open_model(tmp_path / "bad.safetensors")
    assert not page.turns
    assert "bad.safetensors" in page.text
    assert page.text.endswith("; open another model.")
    assert page.rect().contains(page.button.geometry())
    assert active_timers(page) == []
    with qtbot.waitSignal(shown.waiting.open_wanted):
        QTest.mouseClick(page.button, Qt.MouseButton.LeftButton)
    editor_model.save(tmp_path / "tube.safetensors")
    document.tasks.open_model(tmp_path / "tube.safetensors")
    assert page.turns
    assert not page.button.isVisible()
    qtbot.waitUntil(lambda: document.has_model, timeout=20_000)
    rest(qtbot, shown)
    assert not page.turns
    document.failed.emit(Failure("later", "no matter"))
    assert shown.shown_frame is not None
    assert not page.isVisible()
    qtbot.waitUntil(lambda: not document.tasks.busy, timeout=60_000)
    assert document.close()
    dispose(shown)
    document.deleteLater()


def test_a_pose_is_drawn_in_place(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport, colliding: npt.NDArray[np.float64]
) -> None:
    assert viewport.scene is not None
    surface = viewport.scene.surface
    arrays = surface.vertices, surface.normals, surface.colours
    before = pixels(viewport)
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, viewport)
    frame = document.motion.frame
    assert frame is not None
    assert (surface.vertices == frame.vertices).all()
    assert (surface.normals == frame.normals).all()
    after = (surface.vertices, surface.normals, surface.colours)
    assert all(a is b for a, b in zip(arrays, after, strict=True))
    moved = changed(before, pixels(viewport))
    assert moved.sum() > 500
    assert not moved[:10].any(), "the sky moved"


def test_after_many_frames_the_last_is_shown_and_few_are_drawn(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport
) -> None:
    painted, told = viewport.canvas.n_painted, []
    for news in (document.motion.frame_changed, document.motion.exact_changed):
        news.connect(lambda: told.append(1))
    for value in np.linspace(-1.0, 1.0, 200):
        document.motion.set_code(0, float(value))
        QApplication.processEvents()
    rest(qtbot, viewport)
    assert viewport.scene is not None
    expected = document.model.decode(document.history.latent).astype(np.float32)
    assert document.history.latent[0] == 1.0
    assert (viewport.scene.surface.vertices == expected).all()
    assert viewport.canvas.n_painted - painted <= min(len(told) + 2, 201)


@pytest.mark.variants(3)
@pytest.mark.parametrize("shading", Shading)
def test_a_highlight_outlines_its_domain_and_leaves_all_colours_as_they_are(
    qtbot: QtBot,
    document: PoseDocument,
    viewport: Viewport,
    colliding: npt.NDArray[np.float64],
    shading: Shading,
) -> None:
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, viewport)
    qtbot.waitUntil(lambda: document.motion.exact is not None)
    viewport.set_shading(shading)
    rest(qtbot, viewport)
    scene, legend = viewport.scene, viewport.legend
    assert scene is not None
    before, colours = pixels(viewport), scene.surface.colours.copy()
    viewport.highlight_domain(1)
    rest(qtbot, viewport)
    assert scene.outline.is_shown
    assert (scene.surface.colours == colours).all()
    assert viewport.legend == legend
    drawn = changed(before, pixels(viewport))
    assert drawn.sum() > 100
    # An outline, no tint: the part itself is unchanged.
    leads = document.model.attention_mask.argmax(axis=0)
    places = [place_of(viewport, vertex) for vertex in np.flatnonzero(leads == 1)]
    assert np.mean([drawn[place.y(), place.x()] for place in places]) < 0.5
    columns = np.array([place.x() for place in places])
    beyond = np.flatnonzero(drawn.any(axis=0))
    assert columns.min() - 12 <= beyond.min()
    assert beyond.max() <= columns.max() + 12
    viewport.highlight_domain(None)
    rest(qtbot, viewport)
    assert not changed(before, pixels(viewport)).any()


def test_an_outline_follows_the_pose_and_the_camera_in_one_width(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport, colliding: npt.NDArray[np.float64]
) -> None:
    scene = viewport.scene
    assert scene is not None

    def outlined() -> npt.NDArray[np.bool_]:
        pictures = []
        for domain in (None, 1):
            viewport.highlight_domain(domain)
            rest(qtbot, viewport)
            pictures.append(pixels(viewport))
        return changed(*pictures)

    straight = outlined()
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, viewport)
    bent = outlined()
    viewport.set_camera("Back", animated=False)
    rest(qtbot, viewport)
    behind = outlined()
    assert min(straight.sum(), bent.sum(), behind.sum()) > 100
    assert (straight & ~bent).any()
    assert (bent & ~behind).any()
    view = scene.view
    scene.view = View(view.focus + 0.5 * (view.position - view.focus), view.focus, view.up)
    # From half the distance, a line is at most twice as long, and no wider.
    assert outlined().sum() < 2.5 * behind.sum()


def test_each_shading_looks_different_and_explains_itself(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport, colliding: npt.NDArray[np.float64]
) -> None:
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, viewport)
    qtbot.waitUntil(lambda: document.motion.exact is not None)
    seen = []
    told: list[Shading] = []
    viewport.shading_changed.connect(told.append)
    for shading in (Shading.DOMAINS, Shading.PREDICTED, Shading.EXACT, Shading.PLAIN):
        viewport.set_shading(shading)
        rest(qtbot, viewport)
        assert bool(viewport.legend.title) == (shading is not Shading.PLAIN)
        # Without a legend, the picture fills the view.
        filled = viewport.canvas.geometry() == viewport.rect()
        assert filled == (shading is Shading.PLAIN)
        seen.append(pixels(viewport))
    assert told == [Shading.DOMAINS, Shading.PREDICTED, Shading.EXACT, Shading.PLAIN]
    for first in range(4):
        for second in range(first):
            assert changed(seen[first], seen[second]).sum() > 50


class LegendWatch(QObject):
    """Records events of a legend while its canvas paints, and at other times."""

    def __init__(self, viewport: Viewport) -> None:
        super().__init__(viewport)
        self.painting = False
        self.meanwhile: list[str] = []
        self.otherwise: list[str] = []
        self.legend = viewport.findChild(LegendStrip)
        self.legend.installEventFilter(self)
        assert viewport.canvas is not None
        viewport.canvas.installEventFilter(self)
        viewport.canvas.painted.connect(self.on_painted)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:  # noqa: N802 - Qt's name
        layout = (QEvent.Type.Show, QEvent.Type.Hide, QEvent.Type.Resize, QEvent.Type.Move)
        if watched is not self.legend:
            # While Qt resizes the canvas, its paint event draws nothing.
            is_paint = event.type() is QEvent.Type.Paint and not watched._resizing
            self.painting = self.painting or is_paint
        elif event.type() in layout:
            (self.meanwhile if self.painting else self.otherwise).append(event.type().name)
        return False

    def on_painted(self) -> None:
        self.painting = False


def test_the_legend_is_laid_out_while_nothing_is_painted(qtbot: QtBot, viewport: Viewport) -> None:
    """A widget shown while the canvas paints may resize it: Qt frees the buffer being drawn."""
    watch = LegendWatch(viewport)
    viewport.resize(SIDE - 60, SIDE)
    for shading in (Shading.EXACT, Shading.PLAIN, Shading.EXACT):
        viewport.set_shading(shading)
        rest(qtbot, viewport)
    assert {"Show", "Hide", "Resize"} <= set(watch.otherwise)
    assert watch.meanwhile == []


@pytest.mark.parametrize(
    "width", [160, 420, *(pytest.param(width, marks=pytest.mark.slow) for width in (300, 900))]
)
def test_the_legend_lies_beneath_the_mesh_and_holds_still_while_a_pose_changes(
    qtbot: QtBot,
    document: PoseDocument,
    viewport: Viewport,
    colliding: npt.NDArray[np.float64],
    width: int,
) -> None:
    legend, canvas = viewport.findChild(LegendStrip), viewport.canvas
    assert canvas is not None
    viewport.resize(width, SIDE)
    rest(qtbot, viewport)
    for shading in Shading:
        viewport.set_shading(shading)
        rest(qtbot, viewport)
        geometries = (legend.geometry(), canvas.geometry())
        if not legend.isVisible():
            assert canvas.geometry() == viewport.rect()
            continue
        assert not legend.geometry().intersects(canvas.geometry())
        assert legend.geometry().united(canvas.geometry()) == viewport.rect()
        blocks = [block.geometry() for block in legend._blocks if block.isVisible()]
        assert max(block.bottom() for block in blocks) <= legend.height()
        assert max(block.right() for block in blocks) <= width
        for latent in (colliding, np.zeros_like(colliding)):
            document.motion.blend_towards(latent, 1.0)
            rest(qtbot, viewport)
            assert (legend.geometry(), canvas.geometry()) == geometries
            qtbot.waitUntil(lambda: document.motion.exact is not None)
            assert (legend.geometry(), canvas.geometry()) == geometries


def test_what_resolve_has_moved_is_drawn_and_explained(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport, colliding: npt.NDArray[np.float64]
) -> None:
    scene = viewport.scene
    assert scene is not None
    viewport.set_shading(Shading.MOVEMENT)
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, viewport)
    assert viewport.legend.note == "shown after Resolve"
    plain = scene.surface.colours.copy()
    assert (plain == plain[0]).all()
    before = scene.surface.vertices.copy()
    # It is reported whether or not the ghost is drawn.
    document.history.show_ghost(False)
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=20_000):
        document.tasks.resolve()
    rest(qtbot, viewport)
    moved = np.linalg.norm(scene.surface.vertices - before, axis=1) / document.model.body_size
    assert viewport.legend.ticks[-1][1] == f"{100 * moved.max():.2g}"
    brightness = scene.surface.colours.astype(int).sum(axis=1)
    assert brightness[moved.argmax()] == brightness.min()
    assert np.corrcoef(moved, brightness)[0, 1] < -0.8
    document.history.undo()
    rest(qtbot, viewport)
    assert viewport.legend.note == "shown after Resolve"
    assert (scene.surface.colours == plain).all()
    document.history.redo()
    rest(qtbot, viewport)
    assert viewport.legend.ticks[-1][1] == f"{100 * moved.max():.2g}"
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=20_000):
        document.tasks.resolve()
    rest(qtbot, viewport)
    assert viewport.legend.note == "nothing moved"
    assert (scene.surface.colours == plain).all()


def test_intersecting_faces_are_red_while_the_truth_is_known(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport, colliding: npt.NDArray[np.float64]
) -> None:
    viewport.set_shading(Shading.EXACT)
    document.motion.blend_towards(colliding, 1.0)
    qtbot.waitUntil(lambda: document.motion.exact is not None)
    rest(qtbot, viewport)
    exact, scene = document.motion.exact, viewport.scene
    assert exact is not None
    assert scene is not None
    assert scene.crossing.n_faces == len(np.unique(exact.pairs)) > 0

    def n_red() -> int:
        colours = pixels(viewport)
        red, green, blue = np.moveaxis(colours, 2, 0)
        return int(((red > 110) & (green < 0.45 * red) & (blue < 0.45 * red)).sum())

    n_while_colliding = n_red()
    document.history.undo_stack.undo()
    rest(qtbot, viewport)
    qtbot.waitUntil(lambda: document.motion.exact is not None)
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    rest(qtbot, viewport)
    assert scene.crossing.n_faces == 0
    assert n_red() < n_while_colliding - 20


def test_resolve_transitions_to_the_new_pose_and_leaves_a_ghost(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport, colliding: npt.NDArray[np.float64]
) -> None:
    document.motion.blend_towards(colliding, 1.0)
    rest(qtbot, viewport)
    scene = viewport.scene
    assert scene is not None
    start = scene.surface.vertices.copy()
    between: list[npt.NDArray[np.float32]] = []
    # Long enough for pictures of it on a busy machine.
    viewport._transition.setDuration(400)
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=20_000):
        document.tasks.resolve()
    viewport.canvas.painted.connect(lambda _: between.append(scene.surface.vertices.copy()))
    rest(qtbot, viewport)
    assert document.motion.frame is not None
    end = document.motion.frame.vertices
    assert (scene.surface.vertices == end).all()
    assert not (start == end).all()
    gone = [np.abs(pose - start).max() / np.abs(end - start).max() for pose in between]
    assert sum(0.01 < share < 0.99 for share in gone) >= 2
    assert gone == sorted(gone)
    assert scene.ghost_shown
    with_ghost = pixels(viewport)
    document.history.show_ghost(False)
    rest(qtbot, viewport)
    assert not scene.ghost_shown
    assert changed(with_ghost, pixels(viewport)).any()
    document.history.undo_stack.undo()
    rest(qtbot, viewport)
    assert scene.surface.vertices.tobytes() == start.tobytes()


def test_a_screenshot_has_its_size_and_is_cut_out(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport, tmp_path: Path
) -> None:
    path = tmp_path / "cut out.png"
    with qtbot.waitSignal(document.message, timeout=20_000) as told:
        viewport.pictures.screenshot(path, 300, 200, transparent=True)
    assert told.args == ["Saved cut out.png"]
    cut_out = np.asarray(Image.open(path)).astype(int)
    alpha = cut_out[:, :, 3]
    assert alpha.shape == (200, 300)
    assert alpha[0].max() == alpha[:, 0].max() == 0
    assert 0.01 < (alpha == 255).mean() < 0.5
    inside, rim = (cut_out[where, :3].sum(axis=1) for where in (alpha == 255, alpha % 255 > 0))
    assert np.median(rim) > 0.6 * np.median(inside), "the rim is mixed with what is not there"
    opaque = tmp_path / "opaque.png"
    with qtbot.waitSignal(document.message, timeout=20_000):
        viewport.pictures.screenshot(opaque, 800, 600, transparent=False)
    with Image.open(opaque) as image:
        assert (image.size, image.mode) == ((800, 600), "RGB")
    with qtbot.waitSignal(document.failed, timeout=20_000) as failed:
        viewport.pictures.screenshot(tmp_path / "missing" / "x.png", 30, 20, transparent=True)
    assert "missing" in failed.args[0].headline
    with pytest.raises(MeshFileError, match="8192 by 8192 pixels, which takes too much memory"):
        viewport.pictures.screenshot(path, 8192, 8192, transparent=True)


def test_a_turntable_that_is_cancelled_as_it_is_packed_leaves_no_file(
    qtbot: QtBot,
    document: PoseDocument,
    viewport: Viewport,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    save, packing, cancelled = Image.Image.save, threading.Event(), threading.Event()

    def save_slowly(*arguments: object, **options: object) -> None:
        save(*arguments, **options)
        packing.set()
        assert cancelled.wait(120.0)

    monkeypatch.setattr(Image.Image, "save", save_slowly)
    viewport.pictures.film(tmp_path / "turn.gif", VideoStyle(seconds=0.08, width=60, height=60))
    qtbot.waitUntil(packing.is_set, timeout=20_000)
    document.tasks.cancel_all()
    cancelled.set()
    qtbot.waitUntil(lambda: list(tmp_path.iterdir()) == [], timeout=20_000)
    assert not document.tasks.busy


@pytest.mark.variants
@pytest.mark.parametrize(
    ("owner", "act", "error"),
    [
        (PoseRenderer, "drawn", MemoryError("no room for a picture")),
        (Image.Image, "save", KeyError("WEBP")),
    ],
    ids=["drawing", "packing"],
)
def test_a_turntable_that_fails_ends_and_tells_so_once(
    qtbot: QtBot,
    document: PoseDocument,
    viewport: Viewport,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    owner: type,
    act: str,
    error: Exception,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(owner, act, fail)
    told: list[Failure] = []
    document.failed.connect(told.append)
    viewport.pictures.film(tmp_path / "turn.webp", VideoStyle(seconds=0.08, width=60, height=60))
    assert "turn.webp" in viewport.pictures.busy
    qtbot.waitUntil(lambda: bool(told) and not document.tasks.busy, timeout=20_000)
    (failure,) = told
    assert failure.headline.startswith("Making turn.webp failed")
    assert type(error).__name__ in failure.details
    assert viewport.pictures.busy == ""
    assert list(tmp_path.iterdir()) == []


def test_a_turntable_of_another_kind_is_refused(viewport: Viewport, tmp_path: Path) -> None:
    with pytest.raises(MeshFileError, match=r"turn\.avi .* \.gif, \.webp, \.png"):
        viewport.pictures.film(tmp_path / "turn.avi", VideoStyle())


def test_the_theme_changes_what_is_behind_and_not_the_pose(
    qtbot: QtBot, viewport: Viewport
) -> None:
    light = pixels(viewport)
    apply_theme(QApplication.instance(), DARK)
    rest(qtbot, viewport)
    dark = pixels(viewport)
    assert light[3, 3].mean() > 200
    assert dark[3, 3].mean() < 90
    apply_theme(QApplication.instance(), LIGHT)
    rest(qtbot, viewport)
    assert not changed(light, pixels(viewport)).any()


def test_another_model_takes_the_place_of_the_first(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport
) -> None:
    document.set_model(document.model)
    rest(qtbot, viewport)
    old, picture = viewport.scene, steady_pixels(qtbot, viewport)
    viewport.highlight_domain(1)
    document.set_model(document.model)
    rest(qtbot, viewport)
    assert viewport.scene is not old
    assert len(viewport.findChildren(Canvas)) == 1
    assert not changed(picture, steady_pixels(qtbot, viewport)).any()


def test_nothing_is_drawn_at_rest(qtbot: QtBot, viewport: Viewport) -> None:
    painted = viewport.canvas.n_painted
    qtbot.waitUntil(lambda: active_timers(viewport) == [])
    QApplication.processEvents()
    assert viewport.canvas.n_painted == painted


def active_timers(widget: QWidget) -> list[QTimer]:
    return [timer for timer in widget.findChildren(QTimer) if timer.isActive()]


def vtk_objects() -> list[str]:
    gc.collect()
    return sorted(
        type(thing).__name__
        for thing in gc.get_objects()
        if str(type(thing).__module__).startswith(("vtkmodules", "pyvista")) and not callable(thing)
    )


@pytest.mark.slow
def test_a_closed_viewport_leaves_no_vtk_object_no_timer_and_no_thread(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    def show_and_close() -> int:
        shown = Viewport(document)
        shown.resize(SIDE, SIDE)
        shown.show()
        rest(qtbot, shown)
        shown.pictures.screenshot(tmp_path / "shot.png", 50, 50, transparent=True)
        shown.pictures.film(tmp_path / "cut.gif", VideoStyle(width=50, height=50))
        shown.set_camera("Back")
        n_alive = len(vtk_objects())
        dispose(shown)
        assert not isValid(shown)
        return n_alive

    # The first window creates objects that all windows share.
    show_and_close()
    before = vtk_objects()
    assert show_and_close() > len(before) + 20
    assert vtk_objects() == before


def test_pairs_that_do_not_count_have_a_colour_of_their_own(
    qtbot: QtBot, document: PoseDocument, viewport: Viewport, colliding: npt.NDArray[np.float64]
) -> None:
    strict = document.model
    assert isinstance(strict, LearnedBody)
    bare = LearnedBody("bare", strict.embedding, strict.card)
    document.set_model(bare.with_rules(ContactRules(tolerated_depth=1.0)))
    viewport.set_shading(Shading.EXACT)
    document.motion.blend_towards(colliding, 1.0)
    qtbot.waitUntil(lambda: document.motion.exact is not None)
    rest(qtbot, viewport)
    exact, scene = document.motion.exact, viewport.scene
    assert exact is not None
    assert scene is not None
    assert not exact.colliding
    assert exact.excluded.tolerated == len(exact.excluded_pairs) > 0
    assert (scene.crossing.n_faces, viewport.legend.uncounted) == (0, "not counted")
    assert scene.uncounted.n_faces == len(np.unique(exact.excluded_pairs))
    red, green, blue = np.moveaxis(pixels(viewport), 2, 0)
    assert ((red > 1.3 * green) & (blue > 1.3 * red) & (blue > 90)).sum() > 20
    viewport.set_shading(Shading.PLAIN)
    rest(qtbot, viewport)
    assert scene.uncounted.n_faces == 0


def test_nothing_stands_for_the_surface_of_a_context_that_is_gone(
    qtbot: QtBot, document: PoseDocument
) -> None:
    viewport = Viewport(document)
    viewport.show()
    rest(qtbot, viewport)
    assert viewport.canvas is not None
    context = viewport.canvas.context()
    surface = context.surface()
    held = []
    context.aboutToBeDestroyed.connect(lambda: held.append(isValid(surface)))
    assert isValid(surface)
    dispose(viewport)
    # It was released before Qt deleted it.
    assert held == [False]
