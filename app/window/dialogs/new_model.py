"""The dialog that makes a new model of a character, or of a body in many poses."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import QSize, Qt, Signal, Slot
from PySide6.QtWidgets import QDialog, QFileDialog, QLabel, QPushButton, QStackedWidget, QWidget

from app.view.body_preview import BodyPreview
from app.view.theme import CLOSE, NORMAL, WIDE
from app.window.dialogs.names import free_model_name, why_no_model_name
from app.window.dialogs.new_model_pages import (
    ContactsPage,
    FilesPage,
    Page,
    PosesPage,
    QualityPage,
)
from app.window.widgets import (
    FileDrops,
    Mnemonics,
    dialog_vbox,
    hbox,
    labelled,
    screen_of,
    scrolling,
    vbox,
)
from app.work import learning_jobs
from lcollision_core.tasks.words import counted, one_line, with_capital

if TYPE_CHECKING:
    from app.editing.settings import Settings
    from app.work.learning_jobs import LookedInto
    from app.work.long_work import LongWork
    from app.work.threads import Failure
    from lcollision_core.learning import LearningRequest
    from lcollision_core.learning.summary import SourcesSummary

_SIZE, _MARGIN = QSize(900, 640), QSize(20, 60)
_PREVIEW_WIDTH, _NEXT_WIDTH = 236, 124
_STEPS = ("Files", "Poses", "Contacts", "Quality and name")
_EMPTY = "Your character appears here"


class NewModelDialog(QDialog):
    """Asks page by page what a model is learned from, and how.

    Signals
    -------
    started : LearningRequest and str, the name of the model

    Parameters
    ----------
    work : reads the files
    settings : remembers the last folder
    parent : the window that it belongs to

    Attributes
    ----------
    files, poses, contacts, quality : the pages
    preview : of the body
    back, next : the buttons
    refusal : says why there is no next page
    """

    started = Signal(object, str)

    def __init__(self, work: LongWork, settings: Settings, parent: QWidget) -> None:
        super().__init__(parent)
        self.setWindowTitle("New model")
        Mnemonics(self)
        FileDrops(self).dropped.connect(self.add)
        self.resize(_SIZE.boundedTo(screen_of(parent).size() - _MARGIN))
        self._work, self._settings = work, settings
        self._reading = 0
        self._summary: SourcesSummary | None = None
        self.files, self.poses, self.contacts = FilesPage(), PosesPage(), ContactsPage()
        self.quality = QualityPage(why_no_model_name)
        self.preview, self._facts = BodyPreview(), labelled("", "caption", wraps=True)
        self.preview.clear(_EMPTY)
        self._lay_out()
        self.files.paths_changed.connect(self._read)
        self.files.add_files.clicked.connect(self._ask_for_files)
        self.files.add_folder.clicked.connect(self._ask_for_folder)
        self.poses.up_changed.connect(self.preview.set_up)
        for page in self.pages:
            page.changed.connect(self._on_changed)
        self._go_to(0)

    @property
    def pages(self) -> tuple[Page, ...]:
        """All pages, in their order."""
        return self.files, self.poses, self.contacts, self.quality

    @property
    def page(self) -> Page:
        """The page that is shown."""
        return self.pages[self._stack.currentIndex()]

    def request(self) -> LearningRequest:
        """Return what the pages ask for."""
        from lcollision_core.learning import LearningRequest

        values = {key: value for page in self.pages for key, value in page.values().items()}
        return LearningRequest(**values)

    def add(self, paths: Sequence[Path]) -> None:
        """List more files, on the first page."""
        self._go_to(0)
        self.files.add(paths)

    def done(self, result: int) -> None:
        """Stop what goes on, and close."""
        self._work.cancel(self._reading)
        self.preview.clear("")
        super().done(result)

    def _lay_out(self) -> None:
        self._steps = [labelled(f"{number}  {name}") for number, name in enumerate(_STEPS, 1)]
        steps = hbox(*self._steps, None, spacing=WIDE + CLOSE)
        self._stack = QStackedWidget()
        for page in self.pages:
            self._stack.addWidget(scrolling(page))
        side = QWidget()
        side.setFixedWidth(_PREVIEW_WIDTH)
        column = vbox(self.preview, self._facts, spacing=CLOSE)
        column.setStretchFactor(self.preview, 1)
        side.setLayout(column)
        self.refusal = labelled("", "refusal", wraps=True)
        cancel = QPushButton("Cancel")
        self.back, self.next = QPushButton("Back"), QPushButton("Next")
        for button in (cancel, self.back):
            button.setAutoDefault(False)
        self.next.setDefault(True)
        # Its bold letters take more than Qt reckons with.
        self.next.setMinimumWidth(_NEXT_WIDTH)
        cancel.clicked.connect(self.reject)
        self.back.clicked.connect(lambda: self._go_to(self._stack.currentIndex() - 1))
        self.next.clicked.connect(self._go_on)
        buttons = hbox(cancel, self.refusal, self.back, self.next, wide=self.refusal)
        self.refusal.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        middle = hbox(self._stack, side, wide=self._stack, spacing=WIDE)
        column = dialog_vbox(steps, middle, buttons)
        column.setStretchFactor(middle, 1)
        column.setSpacing(NORMAL)
        self.setLayout(column)

    def _go_to(self, number: int) -> None:
        self._stack.setCurrentIndex(number)
        for index, label in enumerate(self._steps):
            _mark(label, "here" if index == number else "done" if index < number else "later")
        self.back.setEnabled(number > 0)
        is_last = number == len(self.pages) - 1
        self.next.setText("Start learning" if is_last else "Next")
        self.refusal.clear()
        if is_last and self._summary is not None:
            self.quality.estimate(self._summary.topology.n_vertices, self.poses.n_poses)
            self.quality.name.setFocus()
            self.quality.name.selectAll()
        self._on_changed()

    @Slot()
    def _on_changed(self) -> None:
        if self.refusal.text():
            self.refusal.setText(self._why_not())

    def _why_not(self) -> str:
        """Say why there is no next page, "" if there is one."""
        unread = "" if self._summary is not None else "Wait for the files to be read."
        return self.page.why_not() or unread

    @Slot()
    def _go_on(self) -> None:
        reason = self._why_not()
        self.refusal.setText(reason)
        if reason:
            return
        number = self._stack.currentIndex()
        if number + 1 < len(self.pages):
            self._go_to(number + 1)
            return
        self.started.emit(self.request(), self.quality.name.text().strip())

    @Slot()
    def _read(self) -> None:
        """Read the files anew, in the other thread."""
        self._work.cancel(self._reading)
        self._summary = None
        self._facts.clear()
        paths = self.files.paths
        self.files.tell("")
        self.preview.clear(f"Reading {counted(len(paths), 'file')}…" if paths else _EMPTY)
        self._on_changed()
        if paths:
            work = partial(learning_jobs.look_into_sources, paths)
            self._reading = self._work.start("Reading files", work, self._on_read, self._on_unread)

    def _on_unread(self, failure: Failure) -> None:
        """Say why the files cannot be used."""
        sentence = "; ".join(filter(None, (failure.headline, failure.next_step)))
        self.files.tell(f"{with_capital(one_line(sentence))}.", is_problem=True)
        self._on_changed()
        self.preview.clear("These files can't be learned from")

    def _on_read(self, looked: LookedInto) -> None:
        summary = self._summary = looked.summary
        for page in self.pages:
            page.show_summary(summary)
        self.preview.show_body(
            summary.topology.faces, summary.shown, looked.normals, self.poses.up_axis
        )
        self._facts.setText(_facts(summary))
        if not self.quality.name.text():
            path = self.files.paths[0]
            self.quality.name.setText(free_model_name(path.name if path.is_dir() else path.stem))
        self._on_changed()

    @Slot()
    def _ask_for_files(self) -> None:
        from lcollision_core.files.scene_files import SCENE_SUFFIXES

        masks = " ".join(f"*{suffix}" for suffix in (*SCENE_SUFFIXES, ".pc2", ".mdd", ".npz"))
        folder = self._settings["last_folder"]
        names, _ = QFileDialog.getOpenFileNames(
            self, "Files to learn from", folder, f"Characters, caches, pose sets ({masks})"
        )
        self.files.add([Path(name) for name in names])

    @Slot()
    def _ask_for_folder(self) -> None:
        folder = self._settings["last_folder"]
        name = QFileDialog.getExistingDirectory(self, "Folder of meshes to learn from", folder)
        if name:
            self.files.add([Path(name)])


def _facts(summary: SourcesSummary) -> str:
    """Describe what files hold, in a few lines."""
    lines = [f"{counted(summary.topology.n_vertices, 'vertex', 'vertices')}"]
    lines.append(f"{counted(summary.n_given(), 'pose')} in the files")
    lines.append(f"rig of {summary.n_joints} joints" if summary.n_joints else "no rig")
    if not summary.up.is_sure:
        lines.append(f"Probably {'xyz'[summary.up.axis]} up: check the preview")
    return "\n".join(map(with_capital, lines))


def _mark(label: QLabel, place: str) -> None:
    """Show a step as done, as the one that is here, or as a later one."""
    label.setObjectName("title" if place == "here" else "" if place == "done" else "caption")
    label.style().unpolish(label)
    label.style().polish(label)
