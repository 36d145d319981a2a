"""The panel of poses: thumbnails of the pose library and of other poses."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import (
    QItemSelectionModel,
    QModelIndex,
    QObject,
    QPersistentModelIndex,
    QPoint,
    QSize,
    Qt,
    Signal,
    Slot,
)
from PySide6.QtGui import QAction, QIcon
from PySide6.QtWidgets import (
    QAbstractItemView,
    QButtonGroup,
    QLineEdit,
    QListWidget,
    QListWidgetItem,
    QMenu,
    QSizePolicy,
    QStyledItemDelegate,
    QStyleOptionViewItem,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from app.editing.history import Source
from app.editing.live_pose import starter_poses, training_pose
from app.view.camera import preset_view
from app.view.theme import CLOSE, NORMAL, TIGHT
from app.view.thumbnail import thumbnail_pixmap
from app.window.layout import Docking, bring_up
from app.window.widgets import (
    ElidedLabel,
    Slider,
    described,
    hbox,
    labelled,
    plain_tip,
    signals_blocked,
    vbox,
    widget_of,
)
from app.work.threads import single_shot
from lcollision_core.tasks.words import menu_text, one_line

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.bodies import NamedPose


THUMBNAIL = 88
"""Side of a thumbnail, in device-independent pixels."""

_BESIDE = 5
"""Width by which a name extends beyond its thumbnail on either side, in pixels."""
_LINES = 2


class PoseGrid(QListWidget):
    """Thumbnails of poses with their names beneath, from left to right in rows.

    Attributes
    ----------
    delegate : requests thumbnails
    hint : text shown if there are no poses
    """

    def __init__(self) -> None:
        super().__init__()
        self.setViewMode(QListWidget.ViewMode.IconMode)
        self.setFlow(QListWidget.Flow.LeftToRight)
        self.setResizeMode(QListWidget.ResizeMode.Adjust)
        self.setMovement(QListWidget.Movement.Static)
        self.setSelectionMode(QAbstractItemView.SelectionMode.ExtendedSelection)
        self.setIconSize(QSize(THUMBNAIL, THUMBNAIL))
        names = _LINES * self.fontMetrics().lineSpacing()
        self._cell = QSize(THUMBNAIL + 2 * _BESIDE, THUMBNAIL + names + 3 * TIGHT)
        self.setGridSize(self._cell)
        self.setUniformItemSizes(True)
        self.setWordWrap(True)
        self.delegate = _CellDelegate(self._cell, self)
        self.setItemDelegate(self.delegate)
        self.setVerticalScrollMode(QListWidget.ScrollMode.ScrollPerPixel)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setContextMenuPolicy(Qt.ContextMenuPolicy.CustomContextMenu)
        self.hint = labelled("", "caption", wraps=True)
        self.hint.setAlignment(Qt.AlignmentFlag.AlignCenter)
        QVBoxLayout(self.viewport()).addWidget(self.hint)

    def sizeHint(self) -> QSize:  # noqa: N802
        """Ask for one row of thumbnails."""
        return QSize(400, self._cell.height() + CLOSE)

    def minimumSizeHint(self) -> QSize:  # noqa: N802
        """Allow a width of one thumbnail."""
        return QSize(self._cell.width() + 20, self._cell.height() + TIGHT)


class _CellDelegate(QStyledItemDelegate):
    """Draw a thumbnail with its name beneath, on as many lines as fit.

    Parameters
    ----------
    cell : size of both together
    """

    thumbnail_requested = Signal(int)

    def __init__(self, cell: QSize, parent: QObject) -> None:
        super().__init__(parent)
        self._cell = cell

    def initStyleOption(  # noqa: N802
        self, option: QStyleOptionViewItem, index: QModelIndex | QPersistentModelIndex
    ) -> None:
        """Put the name right beneath the thumbnail, and let file names wrap at underscores."""
        super().initStyleOption(option, index)
        option.displayAlignment = Qt.AlignmentFlag.AlignHCenter | Qt.AlignmentFlag.AlignTop
        if option.icon.isNull():
            option.features |= QStyleOptionViewItem.ViewItemFeature.HasDecoration
            self.thumbnail_requested.emit(index.row())
        option.text = option.text.replace("_", "_\u200b")

    def sizeHint(  # noqa: N802
        self,
        option: QStyleOptionViewItem,  # noqa: ARG002
        index: QModelIndex | QPersistentModelIndex,  # noqa: ARG002
    ) -> QSize:
        """Take the whole cell, so that the selection covers the name."""
        return self._cell


_PAUSE = 25
"""Milliseconds between two thumbnails, so that the window responds while they are drawn."""

_HEIGHT_PER_ROW = 480
"""Window height per row of thumbnails, so that the body gets most of it."""

_BLEND_STEPS = 100
_ONLY = QItemSelectionModel.SelectionFlag.ClearAndSelect
_HANDS = 2
"""Most body parts that a pose of hands moves."""

_BUILT_IN_TEXTS = {
    True: ("Training", "The poses that the model learned from"),
    False: ("Rest pose", "The character at rest; its clips are on the timeline"),
}
"""Text and tool tip for the poses stored with a body, by whether it was trained on them."""


class LibraryPanel(QWidget):
    """Poses to load by a double click, to blend towards, to keep and to find again.

    The sources are the training poses of a model or the rest pose of a character, starter poses
    for a character whose joints are known, the user's library, and the open poses file.

    Signals
    -------
    chosen_changed : `chosen`, `chosen_poses` or `source` may have changed
    menu_wanted : QPoint, position of the context menu on the screen

    Parameters
    ----------
    document : followed and changed
    actions : of commands, by key; triggered by the buttons
    """

    chosen_changed = Signal()
    menu_wanted = Signal(object)

    docking = Docking(
        "library",
        "&Poses",
        "Ctrl+Alt+3",
        "Show or hide the pose library",
        Qt.DockWidgetArea.BottomDockWidgetArea,
    )

    def __init__(self, document: PoseDocument, actions: Mapping[str, QAction]) -> None:
        super().__init__()
        self._document = document
        self._poses: list[NamedPose] = []
        self._starters: list[NamedPose] = []
        self._tag = ""
        self._pictures: dict[bytes, QIcon] = {}
        self._hidden: npt.NDArray[np.bool_] | None = None
        self._wanted: list[NamedPose] = []
        self._may_draw = False
        self._thumbnail_timer = single_shot(self, _PAUSE, self._draw_next)
        self.list = PoseGrid()
        self.list.setAccessibleName("Poses")
        self._sources = QButtonGroup(self)
        self.training = self._source_button(*_BUILT_IN_TEXTS[True])
        self.starter = self._source_button(
            "Starter poses",
            "Poses to start from, made by turning joints, and your poses of a scene's bodies",
        )
        self.starter.setProperty("place", "middle")
        self.own = self._source_button("Library", "Your own poses of this model")
        self.of_file = self._source_button("This file", "The poses of the file that is open")
        search = QLineEdit(placeholderText="Find a pose", clearButtonEnabled=True)
        self.search = described(search, "", "Find a pose by name or tag")
        self.search.setMinimumWidth(70)
        self.search.setMaximumWidth(240)
        self.tags = QToolButton(popupMode=QToolButton.ToolButtonPopupMode.InstantPopup)
        self.tags.setObjectName("filter")
        self.tags.setToolTip("Show the poses with one tag only")
        self._tag_menu = QMenu(self.tags)
        self.tags.setMenu(self._tag_menu)
        # There are none of these before the first body.
        for widget in (self.starter, self.of_file, self.tags):
            widget.hide()
        self.keep, self.update_button, self.add_button = (
            _action_button(actions[key]) for key in ("keep", "update", "add")
        )
        self._target = ElidedLabel("Select a pose to blend")
        self._target.setObjectName("caption")
        self._share = labelled("", "caption")
        self.blend = described(
            Slider(),
            "Drag to blend the pose towards the selected one; the next drag starts where this one "
            "ends",
            "Blend towards the selected pose",
        )
        self.blend.setRange(0, _BLEND_STEPS)
        self.blend.setEnabled(False)
        self._lay_out()
        self.training.setChecked(True)
        self._sources.buttonToggled.connect(self._on_source)
        self.search.textChanged.connect(self._filter)
        self._tag_menu.triggered.connect(self._on_tag)
        self.list.itemActivated.connect(self.load_chosen)
        self.list.itemSelectionChanged.connect(self._on_chosen)
        self.list.currentRowChanged.connect(self._on_chosen)
        self.list.customContextMenuRequested.connect(self._on_menu)
        self.list.delegate.thumbnail_requested.connect(self._on_thumbnail_requested)
        self.blend.sliderPressed.connect(self._on_blend_pressed)
        self.blend.valueChanged.connect(self._on_blend)
        self.blend.sliderReleased.connect(self._on_blend_released)
        self.blend.drag_abandoned.connect(self._on_blend_abandoned)
        document.model_changed.connect(self._on_model)
        for changed in (document.library.changed, document.history.file_poses_changed):
            changed.connect(self._on_library)
        document.history.pose_loaded.connect(self._on_pose_loaded)
        if document.has_model:
            self._on_model()

    def _lay_out(self) -> None:
        bar = hbox(hbox(*self._sources.buttons(), spacing=0), self.search, self.tags, None)
        bar.setStretchFactor(self.search, 1)
        target = hbox(self._target, self._share, wide=self._target)
        rows = (self.keep, self.update_button, self.add_button, self.blend)
        side = widget_of(vbox(*rows[:3], None, target, self.blend, spacing=TIGHT))
        side.setFixedWidth(182)
        poses = hbox(side, self.list, wide=self.list, spacing=NORMAL)
        page = vbox(bar, poses, margins=(NORMAL, TIGHT, NORMAL, TIGHT))
        page.setStretchFactor(poses, 1)
        self.setLayout(page)
        order = (*self._sources.buttons(), self.search, self.tags, self.list, *rows)
        for before, after in pairwise(order):
            QWidget.setTabOrder(before, after)

    @property
    def chosen(self) -> NamedPose | None:
        """The selected pose, of several the last selected; None for none."""
        row = self.list.currentRow()
        item = self.list.item(row)
        is_chosen = item is not None and item.isSelected() and row < len(self._poses)
        return self._poses[row] if is_chosen else None

    @property
    def chosen_poses(self) -> tuple[NamedPose, ...]:
        """All selected poses, in the order shown."""
        rows = sorted(index.row() for index in self.list.selectedIndexes())
        return tuple(self._poses[row] for row in rows)

    @property
    def chosen_own(self) -> NamedPose | None:
        """The selected pose if the library is shown; None for none or another source."""
        return self.chosen if self.source is Source.LIBRARY else None

    @property
    def source(self) -> Source:
        """The source of the poses shown."""
        if self.own.isChecked():
            return Source.LIBRARY
        if self.starter.isChecked():
            return Source.STARTER
        return Source.FILE if self.of_file.isChecked() else Source.TRAINING

    def allow_pictures(self) -> None:
        """Start drawing thumbnails, once everything else is on the screen."""
        self._may_draw = True
        self._thumbnail_timer.start()

    def redraw(self) -> None:
        """Draw all thumbnails again, as for another theme."""
        self._pictures.clear()
        self.refresh()

    def hide_faces(self, hidden: npt.NDArray[np.bool_] | None) -> None:
        """Hide faces, a (F,) bool array or None, in thumbnails drawn from now on."""
        self._hidden = hidden

    def stop(self) -> None:
        """Stop drawing thumbnails, as the window closes."""
        self._thumbnail_timer.stop()
        self._may_draw = False

    def load_chosen(self) -> None:
        """Load the selected pose."""
        if self.chosen is not None:
            self._document.motion.load_pose(self.chosen)

    def choose_own(self, name: str) -> None:
        """Show the library and select a pose by name; clear the filters if they hide it.

        Raises
        ------
        ValueError : the library has no pose of this name.
        """
        self.own.setChecked(True)
        row = self._names().index(name)
        if self.list.isRowHidden(row):
            self._tag = ""
            self.search.clear()
            self._filter()
        self.list.setCurrentRow(row, _ONLY)
        self.list.scrollToItem(self.list.item(row))

    def find_pose(self) -> None:
        """Focus the search field, to type the name of a pose."""
        bring_up(self)
        self.search.setFocus(Qt.FocusReason.ShortcutFocusReason)
        self.search.selectAll()

    @Slot()
    def refresh(self) -> None:
        """List the poses of the source again."""
        document = self._document
        if not document.has_model:
            return
        current, chosen_names = self.chosen, {pose.name for pose in self.chosen_poses}
        if self.source is Source.TRAINING:
            # A character's other poses, the frames of its clips, are on the timeline.
            is_trained = document.model.is_trained
            numbers = range(len(document.model.card.pose_names) if is_trained else 1)
            self._poses = [training_pose(document.model, number) for number in numbers]
        elif self.source is Source.STARTER:
            self._poses = list(self._starters)
        else:
            is_library = self.source is Source.LIBRARY
            self._poses = list(
                document.library.poses if is_library else document.history.file_poses
            )
        with signals_blocked(self.list):
            self.list.clear()
            for pose in self._poses:
                item = QListWidgetItem(one_line(pose.name))
                tags = f" ({', '.join(pose.tags)})" if pose.tags else ""
                item.setToolTip(plain_tip(f"{one_line(pose.name + tags)}: double-click to load"))
                item.setIcon(self._pictures.get(pose.latent.tobytes(), QIcon()))
                self.list.addItem(item)
            if current is not None and current.name in self._names():
                self.list.setCurrentRow(self._names().index(current.name), _ONLY)
            for row, pose in enumerate(self._poses):
                self.list.item(row).setSelected(pose.name in chosen_names)
        for button, text, poses in (
            (self.own, "Library", document.library.poses),
            (self.of_file, "This file", document.history.file_poses),
        ):
            button.setText(f"{text} ({len(poses)})" if poses else text)
        self.of_file.setVisible(bool(document.history.file_poses))
        self.add_button.setVisible(self.source is not Source.LIBRARY)
        self.own.setProperty("place", "middle" if document.history.file_poses else "last")
        self.own.style().polish(self.own)
        self._list_tags()
        self._filter()

    def _list_tags(self) -> None:
        tags = sorted({tag for pose in self._poses for tag in pose.tags}, key=str.casefold)
        if self._tag not in tags:
            self._tag = ""
        if [action.data() for action in self._tag_menu.actions()] != ["", *tags]:
            # Not each time: a chosen entry comes here while it is still in use.
            self._tag_menu.clear()
            for tag in ("", *tags):
                action = self._tag_menu.addAction(menu_text(tag) or "All poses")
                action.setData(tag)
                action.setCheckable(True)
        for action in self._tag_menu.actions():
            action.setChecked(action.data() == self._tag)
        self.tags.setVisible(bool(tags))
        self.tags.setText(f"Tag: {menu_text(self._tag)}" if self._tag else "Tags")

    @Slot()
    def _filter(self) -> None:
        """Hide and deselect the poses that do not match the search and the tag."""
        words = self.search.text().casefold().split()
        n_shown = 0
        for row, pose in enumerate(self._poses):
            text = " ".join((pose.name, *pose.tags)).casefold()
            matches = all(word in text for word in words) and self._tag in (*pose.tags, "")
            self.list.setRowHidden(row, not matches)
            n_shown += matches
            if not matches:
                self.list.item(row).setSelected(False)
        hint = (
            "Poses that you add to your library appear here"
            if not self._poses
            else "No pose matches"
        )
        self.list.hint.setText(hint)
        self.list.hint.setVisible(not n_shown)
        self._on_chosen()
        # Drop earlier requests; the repaint requests the visible thumbnails.
        self._wanted.clear()
        self.list.viewport().update()

    def sizeHint(self) -> QSize:  # noqa: N802
        """Ask for one row of thumbnails, and for more in a tall window."""
        one, rows = super().sizeHint(), max(self.window().height() // _HEIGHT_PER_ROW, 1)
        return one + QSize(0, (rows - 1) * self.list.gridSize().height())

    def _names(self) -> list[str]:
        return [pose.name for pose in self._poses]

    def _source_button(self, text: str, tip: str) -> QToolButton:
        button = QToolButton()
        button.setObjectName("segment")
        button.setProperty("place", "last" if self._sources.buttons() else "first")
        button.setText(text)
        button.setToolTip(tip)
        button.setCheckable(True)
        button.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self._sources.addButton(button)
        return button

    @Slot()
    def _on_model(self) -> None:
        text, tip = _BUILT_IN_TEXTS[self._document.model.is_trained]
        self.training.setText(text)
        self.training.setToolTip(tip)
        of_members = self._document.library.of_members()
        self._starters = [*starter_poses(self._document.model), *of_members]
        self.starter.setVisible(bool(self._starters))
        if self.starter.isChecked() and not self._starters:
            self.training.setChecked(True)
        self._pictures.clear()
        self._on_source()

    @Slot()
    def _on_library(self) -> None:
        if self.source is Source.FILE and not self._document.history.file_poses:
            # This refreshes the list.
            self.training.setChecked(True)
        else:
            self.refresh()

    @Slot()
    def _on_pose_loaded(self) -> None:
        # An empty undo stack means that the pose came from opening a file.
        if self._document.history.file_poses and not self._document.history.undo_stack.count():
            self.of_file.setChecked(True)

    @Slot()
    def _on_source(self) -> None:
        # Clear the selection: another source or model may have a pose of the same name.
        self.list.clearSelection()
        self.refresh()

    @Slot(QAction)
    def _on_tag(self, action: QAction) -> None:
        self._tag = action.data()
        self.refresh()

    @Slot(QPoint)
    def _on_menu(self, position: QPoint) -> None:
        if self.list.itemAt(position) is None:
            self.list.clearSelection()
        self.menu_wanted.emit(self.list.viewport().mapToGlobal(position))

    @Slot(int)
    def _on_thumbnail_requested(self, row: int) -> None:
        self._wanted.append(self._poses[row])
        if self._may_draw:
            self._thumbnail_timer.start()

    @Slot()
    def _draw_next(self) -> None:
        """Draw one of the visible thumbnails."""
        # A hidden panel requests its thumbnails again once it is shown.
        if not (self._wanted and self.isVisible()):
            return
        key = self._wanted[0].latent.tobytes()
        if key not in self._pictures:
            self._pictures[key] = self._picture(self._wanted[0])
        # The same pose may be listed under several names.
        self._wanted = [pose for pose in self._wanted if pose.latent.tobytes() != key]
        for row, pose in enumerate(self._poses):
            if pose.latent.tobytes() == key and not self.list.isRowHidden(row):
                self.list.item(row).setIcon(self._pictures[key])
        self._thumbnail_timer.start()

    def _picture(self, pose: NamedPose) -> QIcon:
        model = self._document.model
        device_pixel_ratio = self.devicePixelRatioF()
        vertices = model.decode(pose.latent, 1).astype(np.float32)
        posed_vertices = model.without_ground(vertices)
        faces = model.faces if self._hidden is None else model.faces[~self._hidden]
        moved = () if pose.moves is None else np.flatnonzero(pose.moves).tolist()
        parts = list(dict.fromkeys(model.code_effects[code].domain for code in moved))
        if 0 < len(parts) <= _HANDS:
            # For a hand pose, show one hand, large enough to be seen.
            faces = faces[(model.attention_mask[parts[0]] > 0.5)[faces].all(axis=1)]
            posed_vertices = vertices[np.unique(faces)]
        view = preset_view("Three-quarter", posed_vertices, model.up, model.front, 1.0)
        drawn = thumbnail_pixmap(vertices, faces, view, THUMBNAIL, device_pixel_ratio)
        picture = QIcon()
        for mode in (QIcon.Mode.Normal, QIcon.Mode.Selected):
            picture.addPixmap(drawn, mode)
        return picture

    @Slot()
    def _on_chosen(self) -> None:
        chosen = self.chosen
        self.blend.setEnabled(chosen is not None)
        self._target.setText(
            "Select a pose to blend" if chosen is None else f"Blend towards {chosen.name}"
        )
        self.chosen_changed.emit()

    @Slot()
    def _on_blend_pressed(self) -> None:
        if self.chosen is not None:
            self._document.motion.begin_gesture(f"Blend towards {self.chosen.name}")

    @Slot(int)
    def _on_blend(self, value: int) -> None:
        if self.chosen is None:
            return
        target = self.chosen.applied_to(self._document.history.latent)
        self._document.motion.blend_towards(target, value / _BLEND_STEPS)
        self._share.setText(f"{value} %")
        if not self.blend.isSliderDown():
            self._rest_blend()

    @Slot()
    def _on_blend_released(self) -> None:
        self._document.motion.end_gesture()
        self._rest_blend()

    @Slot()
    def _on_blend_abandoned(self) -> None:
        self._document.motion.cancel_gesture()
        self._clear_blend()

    def _rest_blend(self) -> None:
        """Return the slider to 0: the next blend starts at the pose where this one ended."""
        share = self.blend.value()
        if share and self.chosen is not None:
            self._document.message.emit(f"Blended {share} % of the way to {self.chosen.name}")
        self._clear_blend()

    def _clear_blend(self) -> None:
        with signals_blocked(self.blend):
            self.blend.setValue(0)
        self._share.setText("")


def _action_button(action: QAction) -> QToolButton:
    """Return a text-only button for an action."""
    button = QToolButton()
    button.setObjectName("action")
    button.setDefaultAction(action)
    button.setToolButtonStyle(Qt.ToolButtonStyle.ToolButtonTextOnly)
    button.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
    button.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
    return button
