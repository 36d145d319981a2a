"""The panel of a scene's bodies: which are shown, locked and checked."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QSignalBlocker, Qt, Signal, Slot
from PySide6.QtWidgets import (
    QAbstractItemView,
    QComboBox,
    QDoubleSpinBox,
    QHeaderView,
    QTreeWidget,
    QTreeWidgetItem,
    QVBoxLayout,
    QWidget,
)

from app.view.theme import TIGHT
from app.window.layout import Docking
from app.window.widgets import described, hbox, labelled, plain_tip, push_button, widget_of
from lcollision_core.tasks.words import say

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.bodies import SceneBody

_NAME, _SEEN, _LOCKED, _COUNTED = range(4)
_HEADER = ("Body", "Show", "Lock", "Check")
_TIPS = (
    "Draw this body",
    "Keep this body where it is: drags, Resolve and random poses move the others",
    "Count the collisions of this body",
)


class BodiesPanel(QWidget):
    """List the bodies of a scene.

    Parameters
    ----------
    document : its model is followed, its locks and rules are changed

    Attributes
    ----------
    tree : a row for each body
    playing, clip, start : row with the selected body's clip and its start; shown if it has clips
    save : button that saves the scene
    remove : button that takes the selected body out of the scene

    Signals
    -------
    hidden_changed : (F,) bool array, the faces of bodies that are not drawn, or None
    save_wanted : the scene is to be saved to a file
    clip_wanted : str, str, float: a body, the clip for it to play, and the start in seconds
    removal_wanted : str: a body to take out of the scene
    """

    hidden_changed = Signal(object)
    save_wanted = Signal()
    clip_wanted = Signal(str, str, float)
    removal_wanted = Signal(str)
    docking = Docking(
        "bodies",
        "&Bodies",
        "Ctrl+Alt+5",
        "Show or hide the bodies of the scene",
        Qt.DockWidgetArea.LeftDockWidgetArea,
    )

    def __init__(self, document: PoseDocument) -> None:
        super().__init__()
        self._document = document
        self._hidden: set[str] = set()
        self._fingerprint = ""
        self.tree = described(QTreeWidget(), "", "Bodies")
        self.tree.setHeaderLabels(_HEADER)
        # Names of similar bodies differ at their ends.
        self.tree.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.tree.setRootIsDecorated(False)
        self.tree.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
        # Otherwise the arrow keys do not reach the boxes.
        self.tree.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectItems)
        header = self.tree.header()
        header.setStretchLastSection(False)
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(_NAME, QHeaderView.ResizeMode.Stretch)
        tip = "Save the scene: its files and their positions"
        self.save = push_button("Save scene…", tip)
        self.save.clicked.connect(self.save_wanted)
        tip = "Take the chosen body out of the scene; its file stays"
        self.remove = push_button("Remove", tip)
        self.remove.clicked.connect(self._want_removal)
        self.clip = described(QComboBox(), "Which of its clips the chosen body plays", "Clip")
        self.start = described(
            QDoubleSpinBox(suffix=" s", decimals=2, maximum=3600.0, singleStep=0.1),
            "When the clip of the chosen body begins",
            "Start of the clip",
        )
        row = hbox(labelled("Plays"), self.clip, labelled("at"), self.start, spacing=TIGHT)
        self.playing = widget_of(row)
        layout = QVBoxLayout(self)
        layout.addWidget(self.tree)
        layout.addWidget(self.playing)
        layout.addLayout(hbox(self.save, self.remove, spacing=TIGHT))
        self.tree.itemChanged.connect(self._on_changed)
        self.tree.currentItemChanged.connect(self._show_clip)
        self.clip.activated.connect(self._want_clip)
        self.start.editingFinished.connect(self._want_clip)
        document.model_changed.connect(self._follow)
        document.motion.locks_changed.connect(self._follow)
        self._follow()

    @property
    def n_bodies(self) -> int:
        """Number of bodies of the scene, not counting the ground; 1 without a scene."""
        members = () if self._document.scene is None else self._document.scene.members
        return max(1, sum(not member.is_ground for member in members))

    @Slot()
    def _follow(self) -> None:
        scene = self._document.scene
        if scene is None:
            return
        if scene.fingerprint != self._fingerprint:
            self._fingerprint = scene.fingerprint
            # Hide the ground at first: the view has its own floor.
            self._hidden = {member.name for member in scene.members if member.is_ground}
            if scene.fixed_domains:
                # The rows are updated by the change of locks.
                self._lock(scene.fixed_domains, locked=True)
        with QSignalBlocker(self.tree):
            # Qt still refers to the row that was clicked: keep the rows and update their states.
            if [row.text(_NAME) for row in self._rows()] != [
                member.name for member in scene.members
            ]:
                self.tree.clear()
                self.tree.addTopLevelItems([_row_of(member.name) for member in scene.members])
                self.tree.setCurrentItem(self._rows()[0])
            for row, member in zip(self._rows(), scene.members, strict=True):
                domains = set(scene.domains_of_member(member.name))
                states = {
                    _SEEN: member.name not in self._hidden,
                    _LOCKED: bool(domains) and domains <= self._document.motion.locked_domains,
                    _COUNTED: member.name not in scene.rules.left_out,
                }
                for column, is_on in states.items():
                    if column == _LOCKED and not member.moves:
                        row.setData(column, Qt.ItemDataRole.CheckStateRole, None)
                        continue
                    on, off = Qt.CheckState.Checked, Qt.CheckState.Unchecked
                    row.setCheckState(column, on if is_on else off)
        self._show_clip()
        self.hidden_changed.emit(self.hidden_faces)

    @Slot()
    def _show_clip(self) -> None:
        """Show the clip of the selected body."""
        scene, row = self._document.scene, self.tree.currentItem()
        name = "" if row is None else row.text(_NAME)
        played = None if scene is None else scene.plays.get(name)
        self.playing.setVisible(played is not None)
        may_go = scene is not None and name and not scene.member(name).is_ground
        self.remove.setEnabled(bool(may_go))
        if scene is None or played is None:
            return
        with QSignalBlocker(self.clip), QSignalBlocker(self.start):
            self.clip.clear()
            self.clip.addItems(scene.member(name).body.own_clips)
            self.clip.setCurrentText(played[0])
            self.start.setValue(played[1])

    @Slot()
    def _want_clip(self) -> None:
        scene, row = self._document.scene, self.tree.currentItem()
        if scene is None or row is None:
            return
        name, choice = row.text(_NAME), (self.clip.currentText(), self.start.value())
        if scene.plays.get(name, choice) != choice:
            self.clip_wanted.emit(name, *choice)

    @Slot()
    def _want_removal(self) -> None:
        if self._document.scene is not None and (row := self.tree.currentItem()) is not None:
            self.removal_wanted.emit(row.text(_NAME))

    def _rows(self) -> list[QTreeWidgetItem]:
        rows = map(self.tree.topLevelItem, range(self.tree.topLevelItemCount()))
        return [row for row in rows if row is not None]

    @property
    def hidden_faces(self) -> npt.NDArray[np.bool_] | None:
        """(F,) mask of the faces of hidden bodies, None if all are drawn."""
        scene = self._document.scene
        if scene is None or not self._hidden:
            return None
        hidden = np.zeros(len(scene.faces), dtype=np.bool_)
        for name in self._hidden:
            hidden[scene.faces_of[name]] = True
        return hidden

    @Slot(QTreeWidgetItem, int)
    def _on_changed(self, row: QTreeWidgetItem, column: int) -> None:
        scene = self._document.scene
        if scene is None or column == _NAME:
            return
        name, is_on = row.text(_NAME), row.checkState(column) is Qt.CheckState.Checked
        if column == _SEEN:
            (self._hidden.discard if is_on else self._hidden.add)(name)
            self.hidden_changed.emit(self.hidden_faces)
        elif column == _LOCKED:
            self._lock(scene.domains_of_member(name), locked=is_on)
        else:
            self._count(scene, name, counted=is_on)

    def _lock(self, domains: Iterable[int], *, locked: bool) -> None:
        for domain in sorted(domains):
            self._document.motion.set_locked(domain, locked)

    def _count(self, scene: SceneBody, name: str, *, counted: bool) -> None:
        rules = scene.rules.leaving_out(name, not counted)
        text = say("{body} is checked", body=name)
        if not counted:
            text = say("{body} is not checked: its collisions don't count", body=name)
        self._document.tasks.set_rules(rules, text)


def _row_of(name: str) -> QTreeWidgetItem:
    row = QTreeWidgetItem([name])
    flags = Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsSelectable
    row.setFlags(flags | Qt.ItemFlag.ItemIsUserCheckable)
    # A long name is elided.
    for column, tip in enumerate((plain_tip(name), *_TIPS)):
        row.setToolTip(column, tip)
    return row
