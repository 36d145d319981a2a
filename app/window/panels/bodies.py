"""The bodies of a scene: which are seen, locked, and in the check; there for several alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QSignalBlocker, Qt, Signal, Slot
from PySide6.QtWidgets import (
    QAbstractItemView,
    QHeaderView,
    QPushButton,
    QTreeWidget,
    QTreeWidgetItem,
    QVBoxLayout,
    QWidget,
)

from app.window.panels.dock import Docking

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.bodies import SceneBody

_NAME, _SEEN, _LOCKED, _COUNTED = range(4)
_HEADER = ("Body", "Shown", "Locked", "Checked")
_TIPS = (
    "",
    "Draw this body",
    "Keep this body where it is: drags, Resolve and random poses move the others",
    "Count the collisions of this body",
)


class BodiesPanel(QWidget):
    """Lists the bodies of a scene.

    Parameters
    ----------
    document : its model is followed, its locks and rules are changed

    Attributes
    ----------
    tree : a row for each body
    save : the button that keeps the scene

    Signals
    -------
    hidden_changed : (F,) bool array, the faces of bodies that are not drawn, or None
    save_wanted : the scene is to be kept in a file
    """

    hidden_changed = Signal(object)
    save_wanted = Signal()
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
        self.tree = QTreeWidget()
        self.tree.setHeaderLabels(_HEADER)
        self.tree.setRootIsDecorated(False)
        self.tree.setSelectionMode(QAbstractItemView.SelectionMode.NoSelection)
        header = self.tree.header()
        header.setStretchLastSection(False)
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(_NAME, QHeaderView.ResizeMode.Stretch)
        self.save = QPushButton("Save scene…")
        self.save.setToolTip("Keep which files the scene is made of, and where they stand")
        self.save.clicked.connect(self.save_wanted)
        layout = QVBoxLayout(self)
        layout.addWidget(self.tree)
        layout.addWidget(self.save)
        self.tree.itemChanged.connect(self._on_changed)
        document.model_changed.connect(self._follow)
        document.motion.locks_changed.connect(self._follow)
        self._follow()

    @property
    def scene(self) -> SceneBody | None:
        """The scene that is open, None for one body."""
        from lcollision_core.bodies import as_scene

        return as_scene(self._document.model) if self._document.has_model else None

    @Slot()
    def _follow(self) -> None:
        scene = self.scene
        if scene is None:
            self.tree.clear()
            return
        if scene.fingerprint != self._fingerprint:
            self._fingerprint = scene.fingerprint
            self._hidden.clear()
            if scene.fixed_domains:
                # Rows follow the locks.
                self._lock(scene.fixed_domains, locked=True)
        with QSignalBlocker(self.tree):
            # Qt still holds the row whose box was clicked: rows stay, their states follow.
            if [row.text(_NAME) for row in self._rows()] != [one.name for one in scene.members]:
                self.tree.clear()
                self.tree.addTopLevelItems([_row_of(member.name) for member in scene.members])
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
        self._draw(scene)

    def _rows(self) -> list[QTreeWidgetItem]:
        rows = map(self.tree.topLevelItem, range(self.tree.topLevelItemCount()))
        return [row for row in rows if row is not None]

    def _draw(self, scene: SceneBody) -> None:
        hidden: npt.NDArray[np.bool_] | None = None
        if self._hidden:
            hidden = np.zeros(len(scene.faces), dtype=np.bool_)
            for name in self._hidden:
                hidden[scene.faces_of[name]] = True
        self.hidden_changed.emit(hidden)

    def _lock(self, domains: frozenset[int], *, locked: bool) -> None:
        for domain in sorted(domains):
            self._document.motion.set_locked(domain, locked)

    @Slot(QTreeWidgetItem, int)
    def _on_changed(self, row: QTreeWidgetItem, column: int) -> None:
        scene = self.scene
        if scene is None or column == _NAME:
            return
        name, is_on = row.text(_NAME), row.checkState(column) is Qt.CheckState.Checked
        change: dict[int, Callable[[], None]] = {
            _SEEN: lambda: self._show(scene, name, shown=is_on),
            _LOCKED: lambda: self._lock(frozenset(scene.domains_of_member(name)), locked=is_on),
            _COUNTED: lambda: self._count(scene, name, counted=is_on),
        }
        change[column]()

    def _show(self, scene: SceneBody, name: str, *, shown: bool) -> None:
        (self._hidden.discard if shown else self._hidden.add)(name)
        self._draw(scene)

    def _count(self, scene: SceneBody, name: str, *, counted: bool) -> None:
        others = [one for one in scene.rules.left_out if one != name]
        left_out = (*others, *(name,) * (not counted))
        self._document.tasks.set_rules(replace(scene.rules, left_out=left_out))


def _row_of(name: str) -> QTreeWidgetItem:
    row = QTreeWidgetItem([name])
    row.setFlags(Qt.ItemFlag.ItemIsEnabled | Qt.ItemFlag.ItemIsUserCheckable)
    for column, tip in enumerate(_TIPS):
        row.setToolTip(column, tip)
    return row
