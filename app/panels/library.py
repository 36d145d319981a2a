"""The pose library: training poses and the user's own, as pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QSize, Qt, QTimer, Signal, Slot
from PySide6.QtGui import QIcon, QImage, QPixmap, QShowEvent
from PySide6.QtWidgets import (
    QButtonGroup,
    QHBoxLayout,
    QListWidget,
    QListWidgetItem,
    QPushButton,
    QSizePolicy,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from app.camera import front_direction, preset_view
from app.panels.parts import ElidedLabel, Slider, labelled, silent
from app.panels.thumbnail import draw_pose
from app.theme import CLOSE, NORMAL, TIGHT, current_theme

if TYPE_CHECKING:
    from app.document import PoseDocument
    from app.frames import PoseShower
    from lcollision_core.model import NamedPose

THUMBNAIL = 88
"""Side of a picture, in device-independent pixels."""

_PAUSE = 25
"""Milliseconds between two pictures, so that the window stays live while they are drawn."""

_BLEND_STEPS = 100
_SKIN = {False: (232, 227, 219), True: (214, 210, 205)}
"""By whether the theme is dark."""


class PoseList(QListWidget):
    """Pictures of poses with their names beneath; the wheel scrolls them sideways too.

    Attributes
    ----------
    hint : what would be there, to be shown in an empty list
    """

    def __init__(self) -> None:
        super().__init__()
        self.setViewMode(QListWidget.ViewMode.IconMode)
        self.setFlow(QListWidget.Flow.LeftToRight)
        self.setResizeMode(QListWidget.ResizeMode.Adjust)
        self.setMovement(QListWidget.Movement.Static)
        self.setIconSize(QSize(THUMBNAIL, THUMBNAIL))
        self.setGridSize(QSize(THUMBNAIL + 20, THUMBNAIL + 34))
        self.setUniformItemSizes(True)
        self.setTextElideMode(Qt.TextElideMode.ElideRight)
        self.setVerticalScrollMode(QListWidget.ScrollMode.ScrollPerPixel)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.hint = labelled("The poses that you keep are shown here", "caption")
        self.hint.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self.hint.setWordWrap(True)
        QVBoxLayout(self.viewport()).addWidget(self.hint)

    def sizeHint(self) -> QSize:  # noqa: N802
        """Ask for one row of pictures."""
        return QSize(400, THUMBNAIL + 42)

    def minimumSizeHint(self) -> QSize:  # noqa: N802
        """Manage with one picture."""
        return QSize(THUMBNAIL + 40, THUMBNAIL + 40)


class LibraryPanel(QWidget):
    """Poses to load by a double click, to blend towards, and to keep.

    Signals
    -------
    keep_wanted : the user wants to keep the pose
    chosen_changed : `chosen` or `chosen_own` may be another

    Parameters
    ----------
    document : followed and changed
    """

    keep_wanted = Signal()
    chosen_changed = Signal()

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self._document = document
        self._poses: list[NamedPose] = []
        self._pictures: dict[bytes, QIcon] = {}
        self._shower: PoseShower | None = None
        self._front = np.zeros(3)
        self._may_draw = False
        self._due = QTimer(self)
        self._due.setSingleShot(True)
        self._due.setInterval(_PAUSE)
        self.list = PoseList()
        self.list.setAccessibleName("Pose library")
        self._sources = QButtonGroup(self)
        sources = QHBoxLayout()
        sources.setSpacing(0)
        self.training, self.own = (
            self._source(text, place, tip)
            for text, place, tip in (
                ("Training", "first", "The poses that the model learned from"),
                ("Yours", "last", "The poses that you keep; Save writes them"),
            )
        )
        sources.addWidget(self.training)
        sources.addWidget(self.own)
        self.keep = QPushButton("Keep this pose…")
        self.keep.setToolTip("Put this pose into your library (Ctrl+K)")
        self._target = ElidedLabel("Choose a pose to blend")
        self._target.setObjectName("caption")
        self._share = labelled("", "caption")
        self.blend = Slider()
        self.blend.setRange(0, _BLEND_STEPS)
        self.blend.setEnabled(False)
        self.blend.setAccessibleName("Blend towards the chosen pose")
        self.blend.setToolTip(
            "Drag to blend the pose towards the chosen one; the next begins where this one ends"
        )
        side = QWidget()
        side.setFixedWidth(182)
        column = QVBoxLayout(side)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(CLOSE)
        column.addLayout(sources)
        column.addWidget(self.keep)
        column.addStretch()
        line = QHBoxLayout()
        line.addWidget(self._target, 1)
        line.addWidget(self._share)
        column.addLayout(line)
        column.addWidget(self.blend)
        row = QHBoxLayout(self)
        row.setContentsMargins(NORMAL, TIGHT, NORMAL, CLOSE)
        row.setSpacing(NORMAL)
        row.addWidget(side)
        row.addWidget(self.list, 1)
        self.training.setChecked(True)
        self._due.timeout.connect(self._draw_next)
        self.own.toggled.connect(self._on_source)
        self.keep.clicked.connect(self.keep_wanted)
        self.list.itemDoubleClicked.connect(self._on_double_click)
        self.list.currentRowChanged.connect(self._on_chosen)
        self.list.verticalScrollBar().valueChanged.connect(self._draw_soon)
        self.blend.sliderPressed.connect(self._on_blend_pressed)
        self.blend.valueChanged.connect(self._on_blend)
        self.blend.sliderReleased.connect(self._on_blend_released)
        document.model_changed.connect(self._on_model)
        document.library_changed.connect(self.refresh)
        document.pose_loaded.connect(self._on_pose_loaded)
        if document.has_model:
            self._on_model()

    @property
    def chosen(self) -> NamedPose | None:
        """The pose that is selected, None for none."""
        row = self.list.currentRow()
        return self._poses[row] if 0 <= row < len(self._poses) else None

    @property
    def chosen_own(self) -> NamedPose | None:
        """The user's own pose that is selected, None for none or a training pose."""
        return self.chosen if self.shows_own else None

    @property
    def shows_own(self) -> bool:
        """Whether the user's own poses are shown, not the training poses."""
        return self.own.isChecked()

    def allow_pictures(self) -> None:
        """Start drawing pictures: everything else is on the screen."""
        self._may_draw = True
        self._draw_soon()

    def redraw(self) -> None:
        """Draw all pictures again, as for another theme."""
        self._pictures.clear()
        self.refresh()

    def stop(self) -> None:
        """Draw no more pictures, as the window goes."""
        self._due.stop()
        self._may_draw = False

    def load_chosen(self) -> None:
        """Edit the selected pose."""
        if self.chosen is not None:
            self._document.load_pose(self.chosen)

    def choose_own(self, name: str) -> None:
        """Show the user's own poses, and select the one of this name.

        Raises
        ------
        ValueError : there is none.
        """
        self.own.setChecked(True)
        self.list.setCurrentRow(self._names().index(name))

    @Slot()
    def refresh(self) -> None:
        """Show the poses as they are now."""
        document = self._document
        if not document.has_model:
            return
        before = self.chosen
        if self.shows_own:
            self._poses = list(document.poses)
        else:
            self._poses = [
                document.training_pose(number) for number in range(len(document.model.pose_names))
            ]
        with silent(self.list):
            self.list.clear()
            for pose in self._poses:
                item = QListWidgetItem(pose.name)
                item.setToolTip(f"{pose.name}: double-click to load")
                item.setTextAlignment(Qt.AlignmentFlag.AlignHCenter)
                item.setIcon(self._pictures.get(pose.latent.tobytes(), self._blank()))
                self.list.addItem(item)
            if before is not None and before.name in self._names():
                self.list.setCurrentRow(self._names().index(before.name))
        self.list.hint.setVisible(not self._poses)
        self.own.setText(f"Yours ({len(document.poses)})" if document.poses else "Yours")
        self._on_chosen(self.list.currentRow())
        self._draw_soon()

    def showEvent(self, event: QShowEvent) -> None:  # noqa: N802
        """Go on with the pictures: none is drawn while nobody sees them."""
        super().showEvent(event)
        self._draw_soon()

    def _names(self) -> list[str]:
        return [pose.name for pose in self._poses]

    def _source(self, text: str, place: str, tip: str) -> QToolButton:
        button = QToolButton()
        button.setObjectName("segment")
        button.setProperty("place", place)
        button.setText(text)
        button.setToolTip(tip)
        button.setCheckable(True)
        button.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        button.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self._sources.addButton(button)
        return button

    @staticmethod
    def _blank() -> QIcon:
        blank = QPixmap(THUMBNAIL, THUMBNAIL)
        blank.fill(Qt.GlobalColor.transparent)
        return QIcon(blank)

    @Slot()
    def _on_model(self) -> None:
        self._pictures.clear()
        if self.shows_own and not self._document.poses:
            # Which shows them.
            self.training.setChecked(True)
        else:
            self._on_source()

    @Slot()
    def _on_pose_loaded(self) -> None:
        # Only a file's poses come in without a past.
        if self._document.poses and not self._document.undo_stack.count():
            self.own.setChecked(True)

    @Slot()
    def _on_source(self) -> None:
        # A pose of the other list, or of another model, may have the name of the selected one.
        self.list.setCurrentRow(-1)
        self.refresh()

    @Slot()
    def _draw_soon(self) -> None:
        if self._may_draw and not self._due.isActive():
            self._due.start()

    @Slot()
    def _draw_next(self) -> None:
        """Draw one picture, of those in sight first."""
        if not self.isVisible():
            return
        missing = [
            place
            for place, pose in enumerate(self._poses)
            if pose.latent.tobytes() not in self._pictures
        ]
        if not missing:
            return
        seen = self.list.viewport().rect()
        in_sight = (
            place
            for place in missing
            if self.list.visualItemRect(self.list.item(place)).intersects(seen)
        )
        place = next(in_sight, missing[0])
        pose = self._poses[place]
        picture = self._picture(pose)
        self._pictures[pose.latent.tobytes()] = picture
        self.list.item(place).setIcon(picture)
        self._due.start()

    def _picture(self, pose: NamedPose) -> QIcon:
        from app.frames import PoseShower

        model = self._document.model
        if self._shower is None or self._shower.model is not model:
            self._shower = PoseShower(model)
            self._front = front_direction(model.reference, model.up_axis)
        sharpness = self.devicePixelRatioF()
        side = round(THUMBNAIL * sharpness)
        vertices = model.decode(pose.latent, 1).astype(np.float32)
        pixels = draw_pose(
            vertices,
            self._shower.normals(vertices),
            model.faces,
            preset_view("Three-quarter", vertices, model.up_axis, self._front, 1.0),
            side,
            _SKIN[current_theme().is_dark],
        )
        image = QImage(side, side, QImage.Format.Format_RGBA8888)
        np.frombuffer(image.bits(), dtype=np.uint8)[:] = pixels.ravel()
        image.setDevicePixelRatio(sharpness)
        drawn = QPixmap.fromImage(image)
        picture = QIcon()
        for mode in (QIcon.Mode.Normal, QIcon.Mode.Selected):
            picture.addPixmap(drawn, mode)
        return picture

    @Slot(QListWidgetItem)
    def _on_double_click(self, item: QListWidgetItem) -> None:
        self._document.load_pose(self._poses[self.list.row(item)])

    @Slot(int)
    def _on_chosen(self, row: int) -> None:
        chosen = 0 <= row < len(self._poses)
        self.blend.setEnabled(chosen)
        name = f"Blend towards {self._poses[row].name}" if chosen else "Choose a pose to blend"
        self._target.setText(name)
        self.chosen_changed.emit()

    @Slot()
    def _on_blend_pressed(self) -> None:
        if self.chosen is not None:
            self._document.begin_gesture(f"Blend towards {self.chosen.name}")

    @Slot(int)
    def _on_blend(self, value: int) -> None:
        if self.chosen is None:
            return
        self._document.blend_towards(self.chosen.latent, value / _BLEND_STEPS)
        self._share.setText(f"{value} %")
        if not self.blend.isSliderDown():
            self._rest_blend()

    @Slot()
    def _on_blend_released(self) -> None:
        self._document.end_gesture()
        self._rest_blend()

    def _rest_blend(self) -> None:
        """Back to 0: the next blend begins at the pose that this one ended in."""
        share = self.blend.value()
        if share and self.chosen is not None:
            self._document.message.emit(f"Blended {share} % of the way to {self.chosen.name}")
        with silent(self.blend):
            self.blend.setValue(0)
        self._share.setText("")
