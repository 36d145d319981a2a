"""The strip of the timeline: its drawing and its mouse interaction."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QEvent, QLineF, QPoint, QPointF, QRectF, QSize, Qt, Signal
from PySide6.QtGui import (
    QColor,
    QFont,
    QFontInfo,
    QFontMetricsF,
    QHelpEvent,
    QImage,
    QMouseEvent,
    QPainter,
    QPaintEvent,
    QPen,
    QPixmap,
    QPolygonF,
    QResizeEvent,
    QWheelEvent,
)
from PySide6.QtWidgets import QSizePolicy, QToolTip, QWidget

from app.view.shading import FloatArray, ramp, rgb
from app.view.theme import CLOSE, NORMAL, TIGHT, current_theme, mixed
from app.window.panels.collision import EVEN_ODDS
from app.window.widgets import plain_tip
from lcollision_core.tasks.words import counted, grouped, heading, height_text

IndexArray = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Track:
    """The layout of the frames: side by side, in cells of equal width.

    Attributes
    ----------
    left, width : of the visible range, in device-independent pixels
    first, span : of the visible range, in frames
    n_frames : of the motion
    """

    left: float
    width: float
    first: float
    span: float
    n_frames: int

    @property
    def cell(self) -> float:
        """Width of a frame."""
        return self.width / self.span

    def x_of(self, place: float) -> float:
        """Return the left edge of a frame's cell; add 0.5 to the frame for its middle."""
        return self.left + (place - self.first) * self.cell

    def place_of(self, x: float) -> float:
        """Return the frame, with fraction, at `x`: the inverse of `x_of`."""
        return self.first + (x - self.left) / self.cell

    def frames_at(self, x: float) -> range:
        """Return the frames that share the pixel at `x`, clamped to the visible range."""
        last = math.ceil(self.first + self.span - 1e-6) - 1
        inside = min(max(x, self.left), self.left + self.width)
        if self.cell < 1.0:
            inside = math.floor(inside)
        start = min(max(int(self.place_of(inside)), 0), last)
        stop = int(self.place_of(inside + 1.0)) if self.cell < 1.0 else start + 1
        return range(start, min(max(stop, start + 1), last + 1))

    def frame_before(self, x: float, frames: IndexArray, within: float) -> int | None:
        """Return the frame, of `frames`, whose end is nearest to `x`; None if none is `within`."""
        away = np.abs(self.x_of(0.0) + (frames + 1) * self.cell - x)
        return int(frames[away.argmin()]) if away.min(initial=np.inf) <= within else None

    def is_seen(self, place: float) -> bool:
        """Return whether a place is in the visible range, ends included."""
        return -1e-6 <= place - self.first <= self.span + 1e-6

    def columns(self, n_columns: int) -> IndexArray:
        """Return the first frame of each pixel column, and the end of the last column.

        A column narrower than a frame has one frame; otherwise each frame is in one column.

        Returns
        -------
        starts : (n_columns + 1,) array, ascending
        """
        places = self.first + np.arange(n_columns + 1) * (self.span / n_columns)
        starts = np.minimum(places.astype(np.intp), self.n_frames - 1)
        starts[-1] = min(max(math.ceil(places[-1]), starts[-2] + 1), self.n_frames)
        return starts


def by_column(reduce: np.ufunc, values: npt.NDArray[Any], starts: IndexArray) -> npt.NDArray[Any]:
    """Reduce the frames of each column to one value.

    Parameters
    ----------
    reduce : such as `np.fmax`
    values : (T,) array
    starts : (W + 1,) array of `Track.columns`

    Returns
    -------
    reduced : (W,) array
    """
    # If two starts are the same frame, reduceat returns the value of that frame.
    reduced: npt.NDArray[Any] = reduce.reduceat(values[: starts[-1]], starts[:-1])
    return reduced


def round_up(value: float) -> float:
    """Return the smallest of ..., 0.1, 0.2, 0.5, 1, 2, 5, 10, ... not below a value."""
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    # Tolerate rounding: 0.30000000000000004 must not be beyond 0.3.
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * 0.999999)


def known_runs(values: FloatArray) -> Iterator[slice]:
    """Yield the runs of finite values."""
    is_known = np.concatenate([[False], np.isfinite(values), [False]])
    turns = np.flatnonzero(is_known[1:] != is_known[:-1])
    for start, stop in turns.reshape(-1, 2):
        yield slice(start, stop)


BoolArray = npt.NDArray[np.bool_]

_EXACT, _ESTIMATE, _CURVE = 20, 12, 34
"""Heights of the strips and minimum height of the curve, in device-independent pixels."""

_GRIP = 9
"""Width of the handles of the in and out points, in device-independent pixels."""

_FREE, _TOUCHING = 0.3, 0.5
"""Heights of the bars of a free frame and of the slightest overlap, as fractions of the strip."""

_LEAST_SCALE = 0.005
"""Smallest normalised depth at the top of the scale, for a motion that hardly collides."""

_CLOSEST = 8
"""Number of frames visible at the strongest zoom."""

_ZOOM, _PAN = 1.25, 0.1
"""Zoom factor, and pan as a fraction of the visible range, per notch of the wheel."""

_SEPARATE = 5.0
"""Width of a frame, in device-independent pixels, above which gaps separate the frames."""

_WIDE = 200.0
"""Width of a frame above which the playhead is a line only: a wash would cover too much."""

BETWEEN = "\u25c6"
"""Text symbol for the mark of a pose that collides between two frames."""

_MARK = 4.0
"""Distance from the middle of a mark to its corners, in device-independent pixels."""

_CURVE_LABEL = "Deepest overlap"
"""Label of the whole body's curve; the gutter is wide enough not to elide it."""

Held = Literal["in", "out", "playhead"]


class TimelineStrip(QWidget):
    """The frames of a motion with the results of their checks.

    The strip changes nothing itself: it requests a frame or range, and shows what is set.

    Signals
    -------
    frame_wanted : int, the frame clicked or dragged to
    range_wanted : int and int, the first and last frame of the range dragged to
    """

    frame_wanted = Signal(int)
    range_wanted = Signal(int, int)

    def __init__(self) -> None:
        super().__init__()
        self._picture: QPixmap | None = None
        self._held: Held | None = None
        self.setMouseTracking(True)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
        self.setAccessibleName("Timeline")
        self.set_motion(np.empty(0))

    def set_motion(self, times: FloatArray) -> None:
        """Show another motion, with no results yet.

        Parameters
        ----------
        times : (T,) float64 array, in seconds, ascending; empty for no motion
        """
        n_frames = len(times)
        self._times = times
        self._frame: int | None = None
        self._range = 0, max(n_frames - 1, 0)
        self._depths = self._curve = np.full(n_frames, np.nan)
        self._between = self._resolved = np.zeros(n_frames, dtype=np.bool_)
        self._estimate: FloatArray | None = None
        self._curve_name = ""
        self._held = None
        self.zoom_to_fit()

    def set_frame(self, frame: int | None) -> None:
        """Move the playhead, None for none, and scroll to keep it visible."""
        self._frame = frame
        before, span = self._first, self._span
        # Show some frames ahead, but not in a drag, from which the view would run away.
        ahead = 0.0 if self._held else 0.125 * span
        if frame is None:
            pass
        elif frame < before:
            self._look_at(frame - ahead, span)
        elif frame + 1 > before + span:
            self._look_at(frame + 1 - span + ahead, span)
        self._describe()
        self.update()

    def set_range(self, first: int, last: int) -> None:
        """Move the in and out points; both frames belong to the range."""
        self._range = first, last
        self._redraw()

    def set_depths(self, depths: FloatArray) -> None:
        """Show the deepest overlap of each frame.

        Parameters
        ----------
        depths : (T,) float64 array, normalised; 0 if a frame is free, NaN if it is not checked yet
        """
        self._set_shown(_depths=depths.copy())

    def set_between(self, colliding: BoolArray) -> None:
        """Mark the free frames with a colliding pose between them and the next, free, frame."""
        self._set_shown(_between=colliding.copy())

    def set_curve(self, depths: FloatArray, name: str) -> None:
        """Show the curve of the overlap of a body part or the whole body.

        Parameters
        ----------
        depths : (T,) float64 array, as in `set_depths`
        name : of the body part, "" for the whole body
        """
        self._set_shown(_curve=depths.copy(), _curve_name=name)

    def set_estimate(self, probability: FloatArray | None) -> None:
        """Show the estimated probability of a collision.

        Parameters
        ----------
        probability : (T,) float64 array, NaN where it is unknown; None if there is no predictor
        """
        self._set_shown(_estimate=None if probability is None else probability.copy())

    def set_resolved(self, spans: Sequence[range]) -> None:
        """Show spans as free, whatever their overlaps."""
        resolved = np.zeros(len(self._times), dtype=np.bool_)
        for span in spans:
            resolved[span.start : span.stop] = True
        self._set_shown(_resolved=resolved)

    def zoom_to_fit(self) -> None:
        """Show all frames."""
        self._look_at(0.0, len(self._times))

    def frame_at(self, x: float) -> int:
        """Return the frame at `x`; of several in one pixel, the one with the deepest overlap."""
        frames = self._track().frames_at(x)
        overlaps = self._overlaps()[frames.start : frames.stop]
        return frames.start + int(np.nan_to_num(overlaps, nan=-1.0).argmax())

    def _look_at(self, first: float, span: float) -> None:
        n_frames = len(self._times)
        self._span = min(max(span, _CLOSEST), n_frames)
        self._first = min(max(first, 0.0), n_frames - self._span)
        self._redraw()

    def _set_shown(self, **contents: FloatArray | BoolArray | str | None) -> None:
        """Set attributes, and redraw if one of them changes: work reports far more often."""
        changed = False
        for name, value in contents.items():
            before = getattr(self, name)
            # As bytes, NaN equals NaN.
            changed |= np.asarray(before).tobytes() != np.asarray(value).tobytes()
            setattr(self, name, value)
        if changed:
            self._redraw()

    def _redraw(self) -> None:
        self._picture = None
        self._describe()
        self.update()

    def _describe(self) -> None:
        if not len(self._times):
            text = "No motion"
        elif self._frame is None:
            text = f"{counted(len(self._times), 'frame', 'frames')}, none of them shown"
        else:
            which, *facts = self._facts(self._frame)
            text = f"{which}: {', '.join(facts)}"
        self.setAccessibleDescription(text)

    def _facts(self, frame: int) -> list[str]:
        """Describe a frame: its number and time, its checked result and its estimate."""
        facts = [f"Frame {grouped(frame)}, {self._times[frame]:.2f} s"]
        overlap = self._overlaps()[frame]
        if math.isnan(overlap):
            facts.append("not checked yet")
        elif overlap > 0.0:
            facts.append(f"overlaps by {height_text(overlap)} of the body size")
        elif self._marked[frame]:
            facts.append(f"free, but {BETWEEN} a pose between it and the next frame collides")
        else:
            facts.append("free")
        if self._estimate is not None and not math.isnan(self._estimate[frame]):
            percent = 100.0 * self._estimate[frame]
            facts.append(f"estimated probability of a collision: {percent:.0f} %")
        return facts

    def _overlaps(self) -> FloatArray:
        return np.where(self._resolved, 0.0, self._depths)

    # Mouse interaction.

    def mousePressEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Grab a handle, or go to the frame at the pointer."""
        x = event.position().x()
        is_beside = x < self._gutter() - _GRIP
        if event.button() is not Qt.MouseButton.LeftButton or is_beside or not len(self._times):
            event.ignore()
            return
        self._held = self._handle_at(event.position()) or "playhead"
        if self._held == "playhead":
            self.frame_wanted.emit(self.frame_at(x))

    def mouseMoveEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Drag a handle or the playhead, or update the cursor and the tool tip."""
        if not len(self._times):
            return
        if not event.buttons():
            # A dialog may have taken the release event.
            self._held = None
        x = event.position().x()
        first, last = self._range
        edge = round(self._track().place_of(x))
        if self._held == "in":
            first = min(max(edge, 0), last)
        elif self._held == "out":
            last = max(min(edge, len(self._times)) - 1, first)
        elif self._held == "playhead":
            self._drag_playhead(x)
        elif self._handle_at(event.position()):
            self.setCursor(Qt.CursorShape.SizeHorCursor)
        else:
            self.unsetCursor()
            if QToolTip.isVisible():
                self._tell(event.globalPosition().toPoint(), x)
        if (first, last) != self._range:
            self.range_wanted.emit(first, last)

    def _drag_playhead(self, x: float) -> None:
        track = self._track()
        frame = self.frame_at(x)
        # Beyond the visible range, scroll by one frame for each move of the pointer.
        if x < track.left:
            frame = max(frame - 1, 0)
        elif x > track.left + track.width:
            frame = min(frame + 1, track.n_frames - 1)
        if frame != self._frame:
            self.frame_wanted.emit(frame)

    def mouseReleaseEvent(self, event: QMouseEvent) -> None:  # noqa: ARG002, N802
        """Release the handle or the playhead."""
        self._held = None

    def mouseDoubleClickEvent(self, event: QMouseEvent) -> None:  # noqa: N802
        """Show all frames if on the ruler, else treat it as a click."""
        if event.position().y() < self._ruler_height():
            self.zoom_to_fit()
        else:
            self.mousePressEvent(event)

    def wheelEvent(self, event: QWheelEvent) -> None:  # noqa: N802
        """Zoom about the pointer with Ctrl; scroll with Shift or a horizontal wheel."""
        across, along = event.angleDelta().x() / 120.0, event.angleDelta().y() / 120.0
        keys = event.modifiers()
        track = self._track() if len(self._times) else None
        if track and keys & Qt.KeyboardModifier.ControlModifier and along:
            place = track.place_of(event.position().x())
            factor = min(max(_ZOOM**-along * track.span, _CLOSEST), track.n_frames) / track.span
            self._look_at(place - factor * (place - track.first), factor * track.span)
        elif track and (keys & Qt.KeyboardModifier.ShiftModifier or abs(across) > abs(along)):
            # Some systems report the wheel as horizontal while Shift is held.
            self._look_at(track.first - _PAN * track.span * (across or along), track.span)
        else:
            event.ignore()
            return
        event.accept()

    def _handle_at(self, position: QPointF) -> Held | None:
        """Return the handle at a position; the handles are drawn just outside the range."""
        if not len(self._times) or position.y() > self._ruler_height():
            return None
        x = position.x()
        for handle, edge, outwards in self._handles(self._track()):
            if -2.0 <= outwards * (x - edge) <= _GRIP:
                return handle
        return None

    def _handles(self, track: Track) -> Iterator[tuple[Held, float, int]]:
        """Yield the visible handles, their x, and the side outside the range: -1 or 1."""
        if track.is_seen(self._range[0]):
            yield "in", track.x_of(self._range[0]), -1
        if track.is_seen(self._range[1] + 1):
            yield "out", track.x_of(self._range[1] + 1), 1

    def event(self, event: QEvent) -> bool:
        """Show the tool tip of the frame under the pointer."""
        if isinstance(event, QHelpEvent) and event.type() is QEvent.Type.ToolTip:
            self._tell(event.globalPos(), event.pos().x())
            return True
        return super().event(event)

    def _tell(self, position: QPoint, x: float) -> None:
        if not len(self._times):
            text = ""
        elif x < self._gutter():
            # The label may be elided.
            text = f"{_CURVE_LABEL} of {self._curve_name}" if self._curve_name else ""
        elif (frame := self._marked_at(x)) is not None:
            ends = f"frames {grouped(frame)} and {grouped(frame + 1)}"
            text = f"{BETWEEN} A pose between {ends} collides, though both are free"
        else:
            text = "\n".join(self._facts(self.frame_at(x)))
        QToolTip.showText(position, plain_tip(text), self)

    @property
    def _marked(self) -> BoolArray:
        return self._between & ~self._resolved

    def _marked_at(self, x: float) -> int | None:
        """Return the frame before the mark at `x`, None if there is no mark."""
        return self._track().frame_before(x, np.flatnonzero(self._marked), _MARK + 1.0)

    # Drawing.

    def sizeHint(self) -> QSize:  # noqa: N802
        """Ask for a curve that is easy to read."""
        return QSize(640, self.minimumSizeHint().height() + 10)

    def minimumSizeHint(self) -> QSize:  # noqa: N802
        """Ask for all strips, whether or not there is an estimate or a motion."""
        strips = _EXACT + _ESTIMATE + _CURVE + 3 * TIGHT + CLOSE
        return QSize(round(self._gutter()) + 160, self._ruler_height() + strips)

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802
        """Redraw at the new size."""
        super().resizeEvent(event)
        self._redraw()

    def changeEvent(self, event: QEvent) -> None:  # noqa: N802
        """Redraw in the new theme or font."""
        super().changeEvent(event)
        if event.type() in (QEvent.Type.StyleChange, QEvent.Type.FontChange):
            self.updateGeometry()
            self._redraw()

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: ARG002, N802
        """Draw the cached picture, renewed if it has changed, and the playhead over it."""
        if not len(self._times):
            return
        device_pixel_ratio = self.devicePixelRatioF()
        if self._picture is None or self._picture.devicePixelRatio() != device_pixel_ratio:
            self._picture = self._drawn(device_pixel_ratio)
        painter = QPainter(self)
        painter.drawPixmap(0, 0, self._picture)
        self._draw_playhead(painter)
        painter.end()

    def _font(self, bold: bool = False) -> QFont:
        font = QFont(self.font())
        font.setPointSizeF(0.86 * QFontInfo(font).pointSizeF())
        font.setBold(bold)
        return font

    def _gutter(self) -> float:
        """Return the left edge of the frames, right of the labels and the curve's scale."""
        width = QFontMetricsF(self._font()).horizontalAdvance
        # Align with device pixels: images in between are blurred.
        device_pixel_ratio = self.devicePixelRatioF()
        right = NORMAL + width(_CURVE_LABEL) + NORMAL + CLOSE
        return math.ceil(right * device_pixel_ratio) / device_pixel_ratio

    def _ruler_height(self) -> int:
        return math.ceil(QFontMetricsF(self._font()).height()) + 11

    def _track(self) -> Track:
        left = self._gutter()
        width = max(self.width() - left - NORMAL - TIGHT, 1.0)
        return Track(left, width, self._first, self._span, len(self._times))

    def _rows(self, track: Track) -> tuple[QRectF, QRectF, QRectF, QRectF]:
        """Return the areas of the ruler, the two strips and the curve."""
        left, width = track.left, track.width
        ruler = QRectF(left, 0, width, self._ruler_height())
        exact = QRectF(left, ruler.bottom() + TIGHT, width, _EXACT)
        estimate = QRectF(left, exact.bottom() + TIGHT, width, _ESTIMATE)
        top = (exact if self._estimate is None else estimate).bottom() + TIGHT
        return ruler, exact, estimate, QRectF(left, top, width, self.height() - top - CLOSE)

    def _drawn(self, device_pixel_ratio: float) -> QPixmap:
        theme = current_theme()
        picture = QPixmap((self.size() * device_pixel_ratio).expandedTo(QSize(1, 1)))
        picture.setDevicePixelRatio(device_pixel_ratio)
        picture.fill(Qt.GlobalColor.transparent)
        painter = QPainter(picture)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setFont(self._font())
        track = self._track()
        ruler, exact, estimate, curve = self._rows(track)
        starts = track.columns(max(round(track.width * device_pixel_ratio), 1))
        named = [(exact, "Exact check"), (curve, heading(self._curve_name) or _CURVE_LABEL)]
        if self._estimate is not None:
            named.append((estimate, "Estimate"))
        for row, name in named:
            painter.fillRect(row, QColor(theme.card))
            self._draw_label(painter, row, name)
        self._draw_exact(painter, exact, track, starts)
        if self._estimate is not None:
            self._draw_estimate(painter, estimate, track, starts)
        self._draw_curve(painter, curve, track, starts)
        self._draw_range(painter, track, QRectF(exact.topLeft(), curve.bottomRight()))
        self._draw_ruler(painter, track, ruler)
        self._draw_what_is_seen(painter, track)
        painter.end()
        return picture

    def _draw_label(self, painter: QPainter, row: QRectF, name: str) -> None:
        metrics = QFontMetricsF(painter.font())
        width = row.left() - NORMAL - CLOSE
        area = QRectF(NORMAL, row.top(), width, row.height())
        painter.setPen(QColor(current_theme().muted))
        text = metrics.elidedText(name, Qt.TextElideMode.ElideRight, width)
        painter.drawText(area, Qt.AlignmentFlag.AlignVCenter, text)

    def _draw_exact(self, painter: QPainter, row: QRectF, track: Track, starts: IndexArray) -> None:
        """Draw low bars for free frames, high ones for colliding frames, and marks between."""
        theme = current_theme()
        overlaps = self._overlaps()
        deepest = by_column(np.fmax, overlaps, starts)
        collides = deepest > 0.0
        is_known = collides | by_column(np.logical_and, np.isfinite(overlaps), starts)
        fraction = np.nan_to_num(np.minimum(deepest / _scale(overlaps), 1.0))
        scale = ramp((mixed(theme.colliding, theme.card, 0.5).name(), theme.colliding))
        free = rgb(mixed(theme.free, theme.card, 0.25).name())
        colours = np.where(collides[:, None], scale[(255 * fraction).astype(np.intp)], free)
        heights = np.where(collides, _TOUCHING + (1.0 - _TOUCHING) * fraction, _FREE)
        _draw_bars(painter, row, track, starts, np.where(is_known, heights, np.nan), colours)
        columns = by_column(np.logical_or, self._marked, starts)
        frames = np.unique(starts[np.flatnonzero(columns)])
        # A mark is between a frame and the next, or in the column if it holds many frames.
        places = frames + (1.0 if track.cell >= 1.0 else 0.5)
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(QColor(theme.colliding))
        painter.setClipRect(row)
        middle = row.top() + 0.36 * row.height()
        for x in np.unique(np.round([track.x_of(place) for place in places])):
            ends = (-_MARK, 0.0), (0.0, -_MARK), (_MARK, 0.0), (0.0, _MARK)
            corners = [(x + right, middle + down) for right, down in ends]
            painter.drawPolygon(QPolygonF([QPointF(*corner) for corner in corners]))
        painter.setClipping(False)

    def _draw_estimate(
        self, painter: QPainter, row: QRectF, track: Track, starts: IndexArray
    ) -> None:
        """Draw bars of the probability, in another colour where a collision is likely."""
        theme = current_theme()
        assert self._estimate is not None
        probability = by_column(np.fmax, self._estimate, starts)
        likely = probability > EVEN_ODDS
        low, high = mixed(theme.free, theme.card, 0.5), mixed(theme.colliding, theme.card, 0.45)
        colours = np.where(likely[:, None], rgb(high.name()), rgb(low.name()))
        painter.setPen(QPen(QColor(theme.muted), 1.0, Qt.PenStyle.DotLine))
        y = row.bottom() - EVEN_ODDS * row.height()
        painter.drawLine(QLineF(row.left(), y, row.right(), y))
        _draw_bars(painter, row, track, starts, np.maximum(probability, 0.12), colours)

    def _draw_curve(self, painter: QPainter, row: QRectF, track: Track, starts: IndexArray) -> None:
        """Draw the overlap as an area, over a scale in % of the body size."""
        theme = current_theme()
        overlaps = np.where(self._resolved, 0.0, self._curve)
        full = _scale(overlaps)
        self._draw_scale(painter, row, full)
        if track.cell * painter.device().devicePixelRatioF() < 1.0:
            values = by_column(np.fmax, overlaps, starts)
            places = np.linspace(track.first, track.first + track.span, 2 * len(values) + 1)[1::2]
        else:
            frames = np.arange(max(starts[0] - 1, 0), min(starts[-1] + 1, track.n_frames))
            values, places = overlaps[frames], frames + 0.5
        half = 0.5 * (places[1] - places[0]) if len(places) > 1 else 0.5
        painter.setClipRect(row)
        # Draw lines and columns: one path with this many corners takes Qt ten times longer.
        pixel = row.width() / (len(starts) - 1)
        middles = row.left() + pixel * (np.arange(len(starts) - 1) + 0.5)
        columns: list[QRectF] = []
        lines: list[QLineF] = []
        for run in known_runs(values):
            ends = places[run][0] - half, places[run][-1] + half
            xs = row.left() + track.cell * (
                np.array([ends[0], *places[run], ends[1]]) - track.first
            )
            rises = np.pad(values[run], 1, mode="edge") * (0.92 * row.height() / full)
            covered = middles[(xs[0] <= middles) & (middles < xs[-1])]
            for x, rise in zip(covered, np.interp(covered, xs, rises), strict=True):
                columns.append(QRectF(x - 0.5 * pixel, row.bottom() - rise, pixel, rise))
            corners = [QPointF(x, row.bottom() - rise) for x, rise in zip(xs, rises, strict=True)]
            edges = zip(pairwise(corners), pairwise(rises), strict=True)
            lines += [QLineF(*line) for line, both in edges if any(both)]
            painter.fillRect(QRectF(xs[0], row.bottom() - 1, xs[-1] - xs[0], 1), QColor(theme.free))
        fill = QColor(theme.colliding)
        fill.setAlpha(70)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing, False)
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(fill)
        painter.drawRects(columns)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setPen(QPen(QColor(theme.colliding), 1.4, c=Qt.PenCapStyle.FlatCap))
        painter.drawLines(lines)
        painter.setClipping(False)

    def _draw_scale(self, painter: QPainter, row: QRectF, full: float) -> None:
        painter.setPen(QColor(current_theme().muted))
        height = QFontMetricsF(painter.font()).height()
        flags = Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter
        for y, words in ((row.top() + 4, f"{100 * full:g} %"), (row.bottom() - 3, "0")):
            painter.drawText(QRectF(0, y - height / 2, row.left() - CLOSE, height), flags, words)

    def _draw_range(self, painter: QPainter, track: Track, strips: QRectF) -> None:
        """Dim the frames outside the range."""
        veil = QColor(current_theme().window)
        veil.setAlpha(165)
        for area in self._outside(track, strips):
            painter.fillRect(area, veil)

    def _outside(self, track: Track, row: QRectF) -> Iterator[QRectF]:
        first, last = self._range
        right = row.right()
        start = min(max(track.x_of(first), row.left()), right)
        end = min(max(track.x_of(last + 1), row.left()), right)
        yield QRectF(row.left(), row.top(), start - row.left(), row.height())
        yield QRectF(end, row.top(), right - end, row.height())

    def _draw_ruler(self, painter: QPainter, track: Track, row: QRectF) -> None:
        """Draw the range, the ticks with frames and seconds, and the handles."""
        theme = current_theme()
        lit = QColor(theme.accent)
        lit.setAlpha(46 if theme.is_dark else 34)
        painter.fillRect(row.adjusted(0, 3, 0, 0), lit)
        for area in self._outside(track, row):
            painter.fillRect(area.adjusted(0, 3, 0, 0), QColor(theme.window))
        painter.setPen(QPen(QColor(theme.border), 1.0))
        painter.drawLine(QLineF(row.left(), row.bottom() - 0.5, row.right(), row.bottom() - 0.5))
        self._draw_ticks(painter, track, row)
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(QColor(theme.accent))
        for _, x, outwards in self._handles(track):
            painter.drawRect(QRectF(x - 0.75, 3, 1.5, row.height() - 3))
            grip = QRectF(min(x, x + outwards * _GRIP), 3, _GRIP, row.height() - 3)
            painter.drawRoundedRect(grip, 2.5, 2.5)
            notch = QRectF(grip.center().x() - 0.5, 8, 1, grip.height() - 10)
            painter.fillRect(notch, QColor(theme.on_accent))

    def _draw_ticks(self, painter: QPainter, track: Track, row: QRectF) -> None:
        theme = current_theme()
        metrics = QFontMetricsF(painter.font())
        seconds = (self._times[-1] - self._times[0]) / max(track.n_frames - 1, 1)
        widest = f"{grouped(track.n_frames)}  {self._times[-1]:.2f} s"
        needed = metrics.horizontalAdvance(widest) + 2 * NORMAL
        step = int(round_up(max(needed / track.cell, 1.0)))
        decimals = 2 if seconds == 0.0 else 1 - math.floor(math.log10(seconds * step))
        decimals = min(max(decimals, 0), 3)
        fine = next(
            (step // n for n in (10, 5, 2) if step % n == 0 and step // n * track.cell >= 5), step
        )
        first = max(math.floor(track.first) // fine * fine, 0)
        last = min(math.ceil(track.first + track.span), track.n_frames - 1)
        painter.setClipRect(row)
        for frame in range(first, last + 1, fine):
            x = track.x_of(frame + 0.5)
            is_labelled = frame % step == 0
            tick = 9 if is_labelled else 4
            painter.setPen(QPen(QColor(theme.muted), 1.0))
            painter.setOpacity(0.9 if is_labelled else 0.45)
            painter.drawLine(QLineF(x, row.bottom() - tick, x, row.bottom() - 1))
            painter.setOpacity(1.0)
            if is_labelled:
                inside = self._range[0] <= frame <= self._range[1]
                area = QRectF(x + TIGHT, row.top() + 3, needed, row.height() - 7)
                number = grouped(frame)
                painter.setPen(QColor(theme.text if inside else theme.muted))
                painter.drawText(area, Qt.AlignmentFlag.AlignVCenter, number)
                area.adjust(metrics.horizontalAdvance(number) + 7, 0, 0, 0)
                painter.setPen(QColor(theme.muted))
                words = f"{self._times[frame]:.{decimals}f} s"
                painter.drawText(area, Qt.AlignmentFlag.AlignVCenter, words)
        painter.setClipping(False)

    def _draw_what_is_seen(self, painter: QPainter, track: Track) -> None:
        """Show beneath a zoomed motion which part of it is visible."""
        if track.span == track.n_frames:
            return
        theme = current_theme()
        whole = QRectF(track.left, self.height() - 4, track.width, 2)
        painter.fillRect(whole, QColor(theme.track))
        each = track.width / track.n_frames
        left = track.left + track.first * each
        painter.fillRect(
            QRectF(left, whole.top(), max(track.span * each, 3.0), 2), QColor(theme.muted)
        )

    def _draw_playhead(self, painter: QPainter) -> None:
        track = self._track()
        if self._frame is None or not track.is_seen(self._frame + 0.5):
            return
        theme = current_theme()
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        x = track.x_of(self._frame + 0.5)
        bottom = self.height() - CLOSE
        if _SEPARATE < track.cell < _WIDE:
            wash = QColor(theme.accent)
            wash.setAlpha(40)
            top = self._ruler_height()
            painter.fillRect(QRectF(x - track.cell / 2, top, track.cell, bottom - top), wash)
        painter.setFont(self._font(bold=True))
        number = grouped(self._frame)
        width = QFontMetricsF(painter.font()).horizontalAdvance(number) + 10
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(QColor(theme.accent))
        painter.drawRect(QRectF(x - 0.75, 4, 1.5, bottom - 4))
        left = min(max(x - width / 2, 0.0), self.width() - width)
        pill = QRectF(left, 2, width, self._ruler_height() - 9)
        painter.drawRoundedRect(pill, 4, 4)
        painter.setPen(QColor(theme.on_accent))
        painter.drawText(pill, Qt.AlignmentFlag.AlignCenter, number)


def _scale(overlaps: FloatArray) -> float:
    """Return the overlap at the top of a scale that covers `overlaps`."""
    return round_up(max(float(np.fmax.reduce(overlaps, initial=0.0)), _LEAST_SCALE))


def _draw_bars(
    painter: QPainter,
    row: QRectF,
    track: Track,
    starts: IndexArray,
    heights: FloatArray,
    colours: npt.NDArray[np.uint8],
) -> None:
    """Draw a bar in each column, or hatching where its height is NaN.

    Parameters
    ----------
    heights : (W,) float64 array, fractions of the row, or NaN
    colours : (W, 3) uint8 array, red, green, blue
    """
    theme = current_theme()
    device_pixel_ratio = painter.device().devicePixelRatioF()
    n_rows = round(row.height() * device_pixel_ratio)
    above = np.arange(n_rows, 0, -1)[:, None]
    is_bar = above <= np.round(heights * n_rows)
    if track.cell >= _SEPARATE:
        begins = np.diff(starts[:-1], prepend=starts[0]) > 0
        is_bar &= ~begins
    red, green, blue = colours.astype(np.uint32).T
    opaque = np.uint32(0xFF000000)
    pixels = np.where(is_bar, opaque | red << 16 | green << 8 | blue, 0).astype(np.uint32)
    diagonal = (np.arange(len(heights)) + above) // max(round(device_pixel_ratio), 1)
    hatched = np.isnan(heights) & (diagonal % 5 == 0)
    pixels[hatched] = mixed(theme.border, theme.muted, 0.35).rgba()
    image = QImage(
        pixels.tobytes(), len(heights), n_rows, 4 * len(heights), QImage.Format.Format_ARGB32
    )
    image.setDevicePixelRatio(device_pixel_ratio)
    painter.drawImage(row.topLeft(), image)
