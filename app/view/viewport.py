"""The viewport: canvas, scene, legend, and the waiting page before the first model."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QEvent, QPoint, QPointF, QSize, Qt, QTimer, Signal, Slot
from PySide6.QtGui import QCloseEvent
from PySide6.QtOpenGLWidgets import QOpenGLWidget
from PySide6.QtWidgets import QLabel, QMenu, QPushButton, QStackedLayout, QVBoxLayout, QWidget

from app.editing.live_pose import domain_of
from app.view.camera import (
    Animation,
    View,
    followed,
    framing,
    interpolated,
    preset_view,
    reframed_if_out_of_view,
)
from app.view.legend import DomainTag, LegendStrip
from app.view.offscreen import Pictures
from app.view.shading import Known, Legend, Shader, Shading
from app.view.theme import NORMAL, Ring, current_theme
from app.work.frames import PoseFrame
from lcollision_core.errors import LCollisionError
from lcollision_core.tasks.words import heading, say, with_capital

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.view.canvas import Canvas, Mouse
    from app.view.scene import Scene
    from app.work.threads import Failure
    from lcollision_core.bodies import Body
    from lcollision_core.resolve import ResolveResult


_RING_SIDE = 38


class WaitingPage(QWidget):
    """Show what is loading below a turning ring, or why loading failed.

    Signals
    -------
    open_wanted : the user wants to open another model

    Parameters
    ----------
    document : followed until its first model is open
    parent : of the widget
    """

    open_wanted = Signal()

    def __init__(self, document: PoseDocument, parent: QWidget) -> None:
        super().__init__(parent)
        self.setObjectName("waiting")
        self.setAttribute(Qt.WidgetAttribute.WA_StyledBackground)
        self._document = document
        self._what, self._reason = "Starting", ""
        self._stopped = False
        self._ring = Ring(_RING_SIDE)
        self._words = QLabel()
        self._words.setWordWrap(True)
        self._words.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self.button = QPushButton("Open another model…")
        self.button.clicked.connect(self.open_wanted)
        column = QVBoxLayout(self)
        column.setSpacing(NORMAL)
        column.addStretch(46)
        column.addWidget(self._ring, alignment=Qt.AlignmentFlag.AlignHCenter)
        column.addWidget(self._words)
        column.addWidget(self.button, alignment=Qt.AlignmentFlag.AlignHCenter)
        column.addStretch(54)
        self._wait()
        document.tasks.busy_changed.connect(self.set_text)
        document.failed.connect(self._on_failed)
        self.set_text(document.tasks.busy)

    @property
    def text(self) -> str:
        """The text shown: what is loading and why it takes long, or the error."""
        return self._words.text()

    @property
    def turns(self) -> bool:
        """Whether something is loading."""
        return self._ring.turns

    @Slot(str)
    def set_text(self, text: str) -> None:
        """Show what is loading; "" changes nothing."""
        if text and not self._stopped:
            self._what = text
            self._wait()

    @Slot(str)
    def explain(self, reason: str) -> None:
        """Show why loading takes long."""
        self._reason = reason
        if self.turns:
            self._wait()

    def stop(self) -> None:
        """Stop the ring for good."""
        self._stopped = True
        self._ring.stop()

    def _wait(self) -> None:
        self._words.setText(f"{self._what}…\n{self._reason}".rstrip())
        self.button.hide()
        self._ring.start()

    @Slot(object)
    def _on_failed(self, failure: Failure) -> None:
        if self._stopped or self._document.has_model:
            return
        self._ring.stop()
        self._words.setText(f"{with_capital(failure.headline)}; open another model.")
        self.button.show()


_GROWTH = 1.15
"""Scale of the first pose's extent for framing, so that other poses stay in view."""

_TRANSITION_MILLISECONDS = 320
"""Duration of the transition to the pose that Resolve found."""

_TURN_MILLISECONDS = 260
"""Duration of the transition from one camera view to another."""

Float32Array = npt.NDArray[np.float32]

_CLOSE_UP = 0.12
"""Half the side of the box framed by a close-up, as a fraction of the body size."""


class Viewport(QWidget):
    """The 3D view of a document, which draws its newest frame.

    It is cheap to construct: a thread imports VTK, and until the first model is open the page
    `waiting` is shown. Call `shut_down` before the window closes.

    Parameters
    ----------
    document : may have no model yet

    Attributes
    ----------
    shading : meaning of the colours; see `set_shading`
    shown_frame : the frame that the last picture shows, or is animated towards
    follows : whether the camera moves along with the body from frame to frame of a motion
    canvas : widget that draws and gets the mouse events; None before the first model is open
    mouse : interaction with the body and the camera; likewise
    scene : the scene drawn; likewise
    hovered_domain : the domain under the pointer, or None
    pictures : makes screenshots and videos
    waiting : the page shown before the first model is open

    Signals
    -------
    domain_hovered : int, the domain under the pointer, or None
    shading_changed : Shading
    pointed : `pointed_vertex` may have changed
    menu_wanted : int or None, int or None and QPoint: the right-clicked domain and vertex, and the
        position on the screen
    hinted : str, hint for the current drag; "" as it ends
    """

    domain_hovered = Signal(object)
    shading_changed = Signal(object)
    pointed = Signal()
    menu_wanted = Signal(object, object, QPoint)
    hinted = Signal(str)

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self._document = document
        self.shading, self.follows = Shading.PLAIN, True
        self._moment: tuple[str, int] | None = None
        self._highlight: int | None = None
        self._hidden: npt.NDArray[np.bool_] | None = None
        self.hovered_domain: int | None = None
        self.canvas: Canvas | None = None
        self.mouse: Mouse | None = None
        self.scene: Scene | None = None
        self._shader: Shader | None = None
        self._model: Body | None = None
        self.shown_frame: PoseFrame | None = None
        self._pose_stale = self._colours_stale = self._crossing_stale = False
        self._place_camera = False
        self._framed: npt.NDArray[np.float64] | None = None
        self._transition_to: npt.NDArray[np.float64] | None = None
        self._loaded: npt.NDArray[np.float64] | None = None

        self._layout = QStackedLayout()
        self._layout.setStackingMode(QStackedLayout.StackingMode.StackOne)
        self.waiting = WaitingPage(document, self)
        self._layout.addWidget(self.waiting)
        self._legend = LegendStrip(self)
        # Put the legend below the canvas, so that it never covers the mesh.
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(0)
        column.addLayout(self._layout, 1)
        column.addWidget(self._legend)
        self._tag = DomainTag(self)
        # Qt recreates a window, which flickers, if its first OpenGL widget is added after it is
        # shown.
        self._first_gl_widget = QOpenGLWidget(self)
        self._first_gl_widget.resize(1, 1)
        self._first_gl_widget.lower()

        self._transition = Animation(_TRANSITION_MILLISECONDS, self)
        self._transition.moved.connect(self._on_pose_moved)
        self._turn = Animation(_TURN_MILLISECONDS, self)
        self._turn.moved.connect(self._on_turned)
        self.pictures = Pictures(document, self.scene_now, self)
        # VTK takes a second to import; the window responds meanwhile.
        self._importer = Thread(target=import_module, args=("app.view.canvas",), name="import VTK")
        self._importer.start()

        document.model_changed.connect(self._on_model_changed)
        document.motion.frame_changed.connect(self._on_frame_changed)
        document.motion.exact_changed.connect(self._on_exact_changed)
        document.history.ghost_changed.connect(self._on_ghost_changed)
        document.history.outcome_changed.connect(self._on_outcome_changed)
        document.tasks.solve_finished.connect(self._on_solve_finished)
        document.timeline.onion_changed.connect(self._on_motion_marks)
        document.timeline.trail_changed.connect(self._on_motion_marks)
        document.timeline.opened.connect(self._on_motion_marks)
        document.timeline.opened.connect(self._set_ground)
        document.history.pose_loaded.connect(self._on_pose_loaded)
        if document.has_model:
            # Wait until the window is on the screen.
            QTimer.singleShot(0, self, self._on_model_changed)

    # Public operations.

    @property
    def legend(self) -> Legend:
        """The current legend of the colours."""
        return self._legend.legend

    @property
    def is_at_rest(self) -> bool:
        """Whether the newest pose is drawn, anti-aliased, and nothing moves."""
        return (
            self.canvas is not None
            and self.shown_frame is not None
            and self.shown_frame.latent is self._document.history.latent
            and not self._document.motion.moving
            and not self._transition.is_running
            and not self._turn.is_running
            and self.canvas.is_settled
        )

    @property
    def pointed_vertex(self) -> int | None:
        """The vertex under the pointer."""
        return None if self.mouse is None else self.mouse.vertex

    @property
    def has_arrows(self) -> bool:
        """Whether a patch has arrows to drag."""
        return self.mouse is not None and self.mouse.arrows is not None

    def follow_menu(self, menu: QMenu) -> None:
        """Keep the last patch while a menu is open, although the pointer leaves the body."""

        def on_open() -> None:
            if self.mouse is not None:
                self.mouse.keep_patch()

        def on_close() -> None:
            # The delay lets the menu run the chosen command first.
            if self.mouse is not None:
                self.mouse.rehover()

        menu.aboutToShow.connect(on_open)
        menu.aboutToHide.connect(on_close)

    def toggle_pin(self, oriented: bool = False) -> None:
        """Pin the patch under the pointer, optionally with its orientation, or unpin it."""
        if self.mouse is not None:
            self.mouse.toggle_pin(oriented)

    def toggle_arrows(self) -> None:
        """Show or hide arrows to drag on the patch under the pointer."""
        if self.mouse is not None:
            self.mouse.toggle_arrows()

    def set_shading(self, shading: Shading) -> None:
        """Choose what the colours show."""
        if shading is self.shading:
            return
        self.shading = shading
        self._recolour(crossing=True)
        self.shading_changed.emit(shading)

    def highlight_domain(self, domain: int | None) -> None:
        """Outline a domain, or none; the colours keep their meaning.

        Parameters
        ----------
        domain : index from 0
        """
        if domain != self._highlight:
            self._highlight = domain
            if self.scene is not None:
                self.scene.outline_domain(domain)
                self._redraw()

    def hide_faces(self, hidden: npt.NDArray[np.bool_] | None) -> None:
        """Hide faces, a (F,) bool array or None, until another model is opened."""
        self._hidden = hidden
        if self.scene is not None:
            self.scene.hide_faces(hidden)
            self._recolour(crossing=True)

    # The camera.

    def tint_faces(self, faces: npt.NDArray[np.integer] | None) -> None:
        """Tint the faces with these indices; None for none."""
        if self.scene is not None:
            self.scene.selection.show(faces)
            self._redraw()

    def set_camera(self, name: str, animated: bool = True) -> None:
        """Look at the whole pose from a preset side.

        Parameters
        ----------
        name : one of `app.view.camera.CAMERAS`
        animated : False jumps there

        Raises
        ------
        KeyError : `name` is not a preset.
        """
        if self.scene is None or self.shown_frame is None:
            return
        end = self._preset(name, self.shown_frame.vertices)
        if not animated:
            self._on_camera_moved(end)
            return
        self._turn.begin(partial(interpolated, self.scene.view, end))

    def look_at(self, places: npt.NDArray[np.floating]) -> None:
        """Look closely at two points, from a direction in which the gap between them shows.

        Parameters
        ----------
        places : (2, 3) array, in the data's unit and the model's coordinates
        """
        if self.scene is None or self.shown_frame is None:
            return
        view, middle = self.scene.view, places.mean(axis=0)
        towards, gap = view.position - view.focus, places[1] - places[0]
        width = float(np.linalg.norm(gap))
        if width > 0.0:
            across = gap / width
            along = towards - (towards @ across) * across
            if np.linalg.norm(along) > 0.1 * np.linalg.norm(towards):
                towards = along
        around = _CLOSE_UP * self._document.model.body_size * np.array([[-1.0], [1.0]])
        end = framing(middle + around, towards, view.up, self._aspect)
        self._turn.begin(partial(interpolated, view, end))

    def show_whole(self) -> None:
        """Look at the whole pose from the same side."""
        if self.scene is None or self.shown_frame is None:
            return
        view = self.scene.view
        vertices = self._document.model.without_ground(self.shown_frame.vertices)
        end = framing(vertices, view.position - view.focus, view.up, self._aspect)
        self._turn.begin(partial(interpolated, view, end))

    @Slot()
    def frame_pose(self) -> None:
        """Frame the document's pose like a model's first pose, once it is drawn."""
        self._framed = self._document.history.latent

    def scene_now(self) -> Scene:
        """Return the scene, updated for the next picture.

        Raises
        ------
        LCollisionError : no pose is on the screen yet.
        """
        if self.scene is None or self.shown_frame is None:
            raise LCollisionError("the mesh is not on the screen yet", "try again in a moment")
        self._bring_up_to_date()
        return self.scene

    def shut_down(self) -> None:
        """Stop all animations and free VTK's memory; the widget stays empty."""
        self._transition.stop()
        self._turn.stop()
        self.waiting.stop()
        self._importer.join()
        self.pictures.cancel()
        if self.canvas is not None:
            self.canvas.shut_down()
            self._layout.removeWidget(self.canvas)
            self.canvas.deleteLater()
        self.canvas = self.scene = self.mouse = None

    # Overridden from Qt.

    def sizeHint(self) -> QSize:  # noqa: N802 - Qt's name
        """Ask for a size that shows a body well."""
        return QSize(720, 720)

    def changeEvent(self, event: QEvent) -> None:  # noqa: N802 - Qt's name
        """Follow the theme."""
        super().changeEvent(event)
        if event.type() is QEvent.Type.PaletteChange and self.scene is not None:
            self.scene.set_theme(current_theme())
            self._shader = self._new_shader()
            self._recolour()

    def closeEvent(self, event: QCloseEvent) -> None:  # noqa: N802 - Qt's name
        """Free VTK's memory."""
        self.shut_down()
        super().closeEvent(event)

    # Following the document.

    @Slot()
    def _on_model_changed(self) -> None:
        self._importer.join()
        from app.view.canvas import Canvas, Mouse
        from app.view.scene import Scene

        self._transition.stop()
        self._turn.stop()
        model = self._document.model
        if self.canvas is None:
            self.canvas = Canvas(self._bring_up_to_date, self)
            self.canvas.menu_wanted.connect(self._on_menu_wanted)
            self.mouse = Mouse(self._document, self.canvas)
            self.mouse.pointed.connect(self._on_pointed)
            self.mouse.whole_body_dragged.connect(self._show_tag)
            self.mouse.hinted.connect(self.hinted)
            self.mouse.camera_moved.connect(self._on_camera_moved)
            self.mouse.redraw_wanted.connect(self._redraw)
        view = None
        if self.scene is not None:
            # Keep the camera if only names or colours of the same body have changed.
            is_same = self._model is not None and self._model.topology is model.topology
            view = self.scene.view if is_same else None
        self.scene = Scene(self.canvas, model, current_theme())
        if self._hidden is not None and len(self._hidden) == model.topology.n_faces:
            # Chosen before there was a scene, as of a body that is open from the start.
            self.scene.hide_faces(self._hidden)
        self._model = model
        self._legend.set_legend(Legend())
        self._shader = self._new_shader()
        self.shown_frame = None
        self._highlight = None
        assert self.mouse is not None
        self.mouse.reset(self.scene)
        self._place_camera = view is None
        if view is not None:
            self.scene.view = view
        self._set_ground()
        if self._document.motion.frame is not None:
            self._on_frame_changed()
        self._on_ghost_changed()
        self._on_motion_marks()

    @Slot()
    def _on_frame_changed(self) -> None:
        if self.canvas is None or self._document.motion.frame is None:
            return
        if self._layout.currentWidget() is not self.canvas:
            self._layout.addWidget(self.canvas)
            self._layout.setCurrentWidget(self.canvas)
            self.waiting.stop()
            self._tag.raise_()
        self._pose_stale = True
        self._recolour()

    @Slot()
    def _on_exact_changed(self) -> None:
        if self.shading in (Shading.EXACT, Shading.PREDICTED):
            self._recolour(crossing=True)

    @Slot()
    def _on_ghost_changed(self) -> None:
        if self.scene is not None:
            ghost = self._document.history.ghost
            self.scene.show_ghost(ghost, None if ghost is None else self._normals(ghost))
            self._redraw()

    @Slot()
    def _set_ground(self) -> None:
        """Put the floor at the lowest point of the rest pose, or of the motion so far.

        Poses of a learned model have no position of their own; the floor follows them.
        """
        if self.scene is not None:
            model = self._document.model
            is_moving = self._document.timeline.motion is not None
            level = float((model.reference[model.topology.used_vertices] @ model.up).min())
            has_place = not model.is_trained
            self.scene.set_ground(
                level if has_place and not is_moving else None, sinks=has_place and is_moving
            )
            self._redraw()

    @Slot()
    def _on_motion_marks(self) -> None:
        if self.scene is not None:
            timeline = self._document.timeline
            self.scene.motion.show_skins(timeline.onion_frames())
            self.scene.motion.show_path(timeline.trail_points)
            self._redraw()

    @Slot()
    def _on_outcome_changed(self) -> None:
        if self.shading is Shading.MOVEMENT:
            self._recolour()

    @Slot(object)
    def _on_solve_finished(self, result: ResolveResult | None) -> None:
        self._transition_to = result.latent if result is not None else None

    @Slot()
    def _on_pose_loaded(self) -> None:
        self._loaded = self._document.history.latent

    # Drawing.

    def _recolour(self, crossing: bool = False) -> None:
        self._colours_stale = True
        self._crossing_stale = self._crossing_stale or crossing
        if self.canvas is not None:
            self._explain_colours()
            self.canvas.redraw()

    def _bring_up_to_date(self) -> None:
        """Write the newest pose and its colours to the scene, just before a picture.

        Of several frames between two pictures, only the last is written.
        """
        frame, scene = self._document.motion.frame, self.scene
        if scene is None or frame is None:
            return
        if self._pose_stale:
            self._pose_stale = False
            self._put(scene, frame)
        if self._colours_stale:
            self._colours_stale = False
            assert self._shader is not None
            scene.show_textured(self.shading is Shading.TEXTURED)
            scene.paint(self._shader.colours(self.shading, self._known_of(frame)))
        if self._crossing_stale:
            self._crossing_stale = False
            exact = self._document.motion.exact if self.shading is Shading.EXACT else None
            scene.crossing.show(None if exact is None else exact.pairs)
            # In a drag, excluded pairs are only counted: keep those of the previous check.
            if exact is None or not exact.counted_only:
                scene.uncounted.show(None if exact is None else exact.excluded_pairs)
        if self.mouse is not None:
            self.mouse.mark(frame.vertices)
        scene.show_contacts(frame)
        scene.fit_to_screen(self.devicePixelRatioF())

    def _put(self, scene: Scene, frame: PoseFrame) -> None:
        before, self.shown_frame = self.shown_frame, frame
        at = self._document.history.state.moment
        moment = None if at is None else (at.motion.name, at.frame)
        self._transition.stop()
        is_framed = frame.latent is self._framed
        if is_framed:
            self._framed = None
        if self._place_camera or is_framed:
            self._place_camera = False
            self._turn.stop()
            scene.show(frame.vertices, frame.normals)
            middle = self._document.model.without_ground(frame.vertices).mean(axis=0)
            scene.view = self._preset("Three-quarter", middle + _GROWTH * (frame.vertices - middle))
        elif self._transition_to is not None and np.array_equal(self._transition_to, frame.latent):
            visible_points = np.array(scene.surface.vertices)
            self._transition.begin(partial(_between_poses, visible_points, frame.vertices))
        else:
            scene.show(frame.vertices, frame.normals)
            is_followed = self.follows and moment != self._moment
            is_loaded = frame.latent is self._loaded
            if before is not None and (is_followed or is_loaded):
                model = self._document.model
                old, new = (model.without_ground(one.vertices) for one in (before, frame))
                if is_followed:
                    scene.view = followed(scene.view, old, new, model.up_axis, self._aspect)
                if is_loaded:
                    view = reframed_if_out_of_view(scene.view, old, new, self._aspect)
                    if view is not None:
                        self._turn.begin(partial(interpolated, scene.view, view))
        self._transition_to = self._loaded = None
        self._moment = moment
        if self.shading is Shading.EXACT:
            self._crossing_stale = True

    def _normals(self, vertices: Float32Array) -> Float32Array:
        from lcollision_core.meshes.normals import vertex_normals

        return vertex_normals(vertices, self._document.model.faces)

    def _new_shader(self) -> Shader:
        model = self._document.model
        return Shader(model.attention_mask, model.card.domain_colours, current_theme().skin)

    def _known_of(self, frame: PoseFrame) -> Known:
        document = self._document
        predicted, exact, before = (
            frame.prediction,
            document.motion.exact,
            document.history.state.ghost,
        )
        outcome, moved = document.history.state.outcome, None
        if outcome is not None and outcome.latent_distance == 0.0:
            moved = np.zeros(len(frame.vertices))
        elif before is not None and frame.latent is document.history.latent:
            away = frame.vertices.astype(np.float64) - before
            moved = np.linalg.norm(away, axis=1) / document.model.body_size
        return Known(
            predicted.domain_energy if predicted is not None else None,
            exact.vertex_energy if exact is not None else None,
            moved,
        )

    def _explain_colours(self) -> None:
        """Update the legend; not to be called in `before_paint`, see `Canvas`."""
        frame = self._document.motion.frame
        if self._shader is None or frame is None:
            return
        model = self._document.model
        self._legend.set_legend(
            self._shader.legend(
                self.shading,
                self._known_of(frame),
                model.has_predictor,
                not model.rules.exclude_nothing,
            )
        )

    def _preset(self, name: str, vertices: npt.NDArray[Any]) -> View:
        model = self._document.model
        vertices = model.without_ground(vertices)
        return preset_view(name, vertices, model.up, model.front, self._aspect)

    @property
    def _aspect(self) -> float:
        widget = self if self.canvas is None else self.canvas
        return widget.width() / max(1, widget.height())

    # Animation.

    @Slot(object)
    def _on_pose_moved(self, vertices: Float32Array) -> None:
        frame = self.shown_frame
        if self.scene is not None and frame is not None:
            arrived = vertices is frame.vertices
            self.scene.show(vertices, frame.normals if arrived else self._normals(vertices))
            self._redraw()

    @Slot(object)
    def _on_turned(self, view: View) -> None:
        if self.scene is not None:
            self.scene.view = view
            self._redraw()

    @Slot(object)
    def _on_camera_moved(self, view: View) -> None:
        self._turn.stop()
        self._on_turned(view)

    # The pointer.

    @Slot()
    def _redraw(self) -> None:
        if self.canvas is not None:
            self.canvas.redraw()

    @Slot(QPointF)
    def _on_menu_wanted(self, position: QPointF) -> None:
        if self.canvas is not None and self.mouse is not None:
            self.mouse.point_at(position)
            where = self.canvas.mapToGlobal(position.toPoint())
            vertex = self.mouse.vertex
            self.menu_wanted.emit(self._domain_of(vertex), vertex, where)

    def _domain_of(self, vertex: int | None) -> int | None:
        return None if vertex is None else domain_of(self._document.model, vertex)

    @Slot(object)
    def _on_pointed(self, position: QPointF | None) -> None:
        domain = self._show_tag(position)
        if domain != self.hovered_domain:
            self.hovered_domain = domain
            self.domain_hovered.emit(domain)
        self.pointed.emit()

    @Slot(object)
    def _show_tag(self, position: QPointF | None) -> int | None:
        """Show the name of the domain under the pointer in the tag, and return the domain."""
        domain = self._domain_of(self.mouse.vertex) if self.mouse is not None else None
        if domain is None or position is None or self.mouse is None:
            self._tag.hide()
            return domain
        model = self._document.model
        name = heading(model.domain_names[domain])
        if self.mouse.whole_body_drag or self._document.motion.whole_body:
            name = say("{part}, whole body", part=name)
        self._tag.point_at(position, name, model.card.domain_colours[domain])
        return domain


def _between_poses(start: Float32Array, end: Float32Array, fraction: float) -> Float32Array:
    """Interpolate (V, 3) vertices linearly between two poses; at the end return `end` itself."""
    moved: Float32Array = start + np.float32(fraction) * (end - start)
    return end if fraction >= 1.0 else moved
