"""The dialog, with its pages, that learns a model from a character or a body in many poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QSize, Qt, Signal, Slot
from PySide6.QtGui import QKeySequence, QShortcut
from PySide6.QtWidgets import (
    QButtonGroup,
    QCheckBox,
    QComboBox,
    QFileDialog,
    QFormLayout,
    QLabel,
    QLineEdit,
    QListWidget,
    QListWidgetItem,
    QRadioButton,
    QStackedWidget,
    QWidget,
)

from app.view.camera import preset_view
from app.view.theme import CLOSE, NORMAL, TIGHT, WIDE
from app.view.thumbnail import thumbnail_pixmap
from app.window.dialogs.learning import STAGE_WORDS
from app.window.dialogs.questions import Dialog, free_model_name, why_no_model_name
from app.window.event_filters import FileDrops
from app.window.widgets import (
    Card,
    NumberBox,
    described,
    dialog_vbox,
    hbox,
    labelled,
    plain_tip,
    push_button,
    restyle,
    screen_of,
    scrolling,
    vbox,
    widget_of,
)
from app.work import learning_runs
from lcollision_core.errors import listed
from lcollision_core.tasks.words import (
    counted,
    duration_text,
    grouped,
    one_line,
    say,
    say_number,
    spent_text,
    with_capital,
)

if TYPE_CHECKING:
    from app.editing.settings import Settings
    from app.work.threads import Failure, LongWork
    from lcollision_core.options import LearningRequest, Quality
    from lcollision_core.tasks.sources import SourcesSummary


_PATH = Qt.ItemDataRole.UserRole
_BY_QUALITY, _NO_POSES, _OWN_NUMBER = "quality", "none", "number"
_MOST_BY_RIG = 2000
_PERCENT = 100.0
_AXES = "xyz"


class Page(QWidget):
    """A page of the dialog: a heading, an explanation, and cards below.

    Signals
    -------
    changed : a value of the page has changed

    Parameters
    ----------
    heading, about : texts at the top
    """

    changed = Signal()

    def __init__(self, heading: str, about: str) -> None:
        super().__init__()
        self.heading = labelled(heading, "headline")
        self.about = labelled(about, "caption", wraps=True)
        self.column = vbox(self.heading, self.about, spacing=NORMAL, margins=(0, 0, CLOSE, 0))
        self.setLayout(self.column)

    def show_summary(self, summary: SourcesSummary) -> None:
        """Update the page for the contents of the files."""

    def values(self) -> dict[str, Any]:
        """Return the fields of `LearningRequest` that the page sets."""
        return {}

    def why_not(self) -> str:
        """Return, as a sentence, what is missing before the next page, "" for nothing."""
        return ""

    def _card(self, title: str, *rows: QWidget) -> Card:
        """Add a card with a title and some rows."""
        card = Card()
        card.add(labelled(title, "title"), *rows)
        self.column.addWidget(card)
        return card


class FilesPage(Page):
    """The page of the files, or folders of meshes, to learn from.

    Signals
    -------
    paths_changed : the list has changed

    Attributes
    ----------
    list : of the files
    add_files, add_folder, remove : buttons; the dialog connects the first two
    contents : label with the contents of the files, or a problem
    """

    paths_changed = Signal()

    def __init__(self) -> None:
        super().__init__(
            "What should the model learn from?",
            "A rigged character (GLB, glTF, VRM, FBX), or one body in many poses: a folder of "
            "meshes, a PC2 or MDD cache beside its mesh, or an .npz pose set. Drop files here, or "
            "add them. Several files of the same body are used together.",
        )
        self.list = described(QListWidget(), "", "Files to learn from")
        self.list.setMinimumHeight(96)
        self.add_files, self.add_folder = push_button("Add files…"), push_button("Add folder…")
        self.remove = push_button("Remove", clicked=self._remove)
        delete = QShortcut(QKeySequence.StandardKey.Delete, self.list)
        delete.setContext(Qt.ShortcutContext.WidgetShortcut)
        delete.activated.connect(self._remove)
        self.remove.setEnabled(False)
        self.list.currentRowChanged.connect(lambda row: self.remove.setEnabled(row >= 0))
        self.contents = labelled("", "caption", wraps=True)
        self.contents.setAlignment(Qt.AlignmentFlag.AlignTop)
        buttons = hbox(self.add_files, self.add_folder, None, self.remove)
        self.column.addWidget(self.list, 1)
        self.column.addLayout(buttons)
        self.column.addWidget(self.contents)
        self._problem = ""

    @property
    def paths(self) -> tuple[Path, ...]:
        """The listed files and folders."""
        rows = range(self.list.count())
        return tuple(Path(self.list.item(row).data(_PATH)) for row in rows)

    def add(self, paths: Sequence[Path]) -> None:
        """List more files, each once."""
        listed_paths = set(self.paths)
        for path in dict.fromkeys(path.absolute() for path in paths):
            if path not in listed_paths:
                kind = " (folder)" if path.is_dir() else ""
                item = QListWidgetItem(f"{path.name}{kind}")
                item.setData(_PATH, str(path))
                item.setToolTip(plain_tip(str(path)))
                self.list.addItem(item)
        if set(self.paths) != listed_paths:
            self.paths_changed.emit()

    def tell(self, text: str, is_problem: bool = False) -> None:
        """Show the contents of the files, or why they cannot be used."""
        self._problem = text if is_problem else ""
        self.contents.setObjectName("refusal" if is_problem else "caption")
        self.contents.setText(text)
        restyle(self.contents)

    def show_summary(self, summary: SourcesSummary) -> None:
        """Show the notes on what was found, and what was changed on reading."""
        self.tell("\n".join(with_capital(note) + "." for note in summary.notes))

    def values(self) -> dict[str, Any]:
        """Return the sources."""
        return {"sources": tuple(map(str, self.paths))}

    def why_not(self) -> str:
        """Return that there are no files, or that one can't be used."""
        if not self.list.count():
            return "Add a file or a folder first."
        return "Remove the file that can't be used." if self._problem else ""

    @Slot()
    def _remove(self) -> None:
        if self.list.currentRow() >= 0:
            self.list.takeItem(self.list.currentRow())
            self.paths_changed.emit()


class PosesPage(Page):
    """The page of the animations, the poses made by the rig, the up axis and the unit.

    Signals
    -------
    up_changed : int, the chosen up axis

    Attributes
    ----------
    clip, rate, by_rig, number, up, scale : fields
    """

    up_changed = Signal(int)

    def __init__(self) -> None:
        super().__init__(
            "Which poses?",
            "The more varied the poses, the more the model can do: it learns how the body bends "
            "from them alone.",
        )
        self._summary: SourcesSummary | None = None
        self.clip = described(QComboBox(minimumContentsLength=12), "", "Animation")
        self.rate = described(
            NumberBox(3, 0, 240, strip_zeros=True), "How many frames per second become poses"
        )
        self.rate.setSpecialValueText("as in the file")
        self._from_clips = labelled("", "caption", wraps=True)
        form = _form(("Animation", self.clip), ("Frames per second", self.rate))
        self._clips = self._card("Animations", form, self._from_clips)
        self.by_rig = described(QComboBox(), "", "Poses made by the rig")
        self.number = described(
            NumberBox(0, 1, _MOST_BY_RIG), "", "Number of poses made by the rig"
        )
        for key, text in (
            (_BY_QUALITY, "As many as the quality needs"),
            (_NO_POSES, "None, only those in the files"),
            (_OWN_NUMBER, "This many:"),
        ):
            self.by_rig.addItem(text, key)
        self.number.setValue(100)
        self._rig = self._card(
            "Poses made by the rig",
            widget_of(hbox(self.by_rig, self.number, None)),
            labelled(
                "The rig bends its joints within human limits, left and right alike, and prefers "
                "poses in which the body doesn't cross itself.",
                "caption",
                wraps=True,
            ),
        )
        self.up = described(QComboBox(), "", "Up axis")
        self.scale = described(NumberBox(6, 1e-6, 1e6), "Model units per file unit")
        self.scale.setValue(1.0)
        self.scale.setStepType(NumberBox.StepType.AdaptiveDecimalStepType)
        self._size = labelled("", "caption", wraps=True)
        form = _form(("Up", self.up), ("Scale by", self.scale))
        self._card("Axis and unit", form, self._size)
        self.column.addStretch()
        for box in (self.clip, self.by_rig):
            box.currentIndexChanged.connect(self._on_edited)
        for field in (self.rate, self.number, self.scale):
            field.valueChanged.connect(self._on_edited)
        self.up.currentIndexChanged.connect(self._on_up)
        self._on_edited()

    def show_summary(self, summary: SourcesSummary) -> None:
        """Offer the clips, rig and axes of the files."""
        self._summary = summary
        total = summary.n_given() - summary.n_poses
        self.clip.clear()
        self.clip.addItem(f"All ({counted(total, 'frame', 'frames')})", None)
        for clip in summary.clips:
            if len(summary.clips) > 1:
                self.clip.addItem(
                    f"{clip.name} ({counted(clip.n_frames, 'frame', 'frames')})", clip.name
                )
        self._clips.setVisible(bool(summary.clips))
        self._rig.setVisible(bool(summary.n_joints))
        axis_source = "As in the file" if summary.up.is_sure else "Guessed"
        file_axis = summary.up.axis
        self.up.clear()
        self.up.addItem(f"{axis_source}: {_AXES[file_axis]}", None)
        for axis in range(3):
            self.up.addItem(f"{_AXES[axis]} is up", axis)
        self._on_edited()

    @property
    def up_axis(self) -> int:
        """The chosen up axis."""
        assert self._summary is not None
        chosen_axis = self.up.currentData()
        return self._summary.up.axis if chosen_axis is None else int(chosen_axis)

    def values(self) -> dict[str, Any]:
        """Return clip, rate, poses by the rig, axis and scale."""
        how = self.by_rig.currentData()
        by_rig = {_BY_QUALITY: None, _NO_POSES: 0, _OWN_NUMBER: int(self.number.value())}[how]
        has_rig = self._summary is not None and self._summary.n_joints > 0
        return {
            "clip": self.clip.currentData(),
            "fps": self.rate.value() or None,
            "by_rig": by_rig if has_rig else None,
            "up": self.up.currentData(),
            "scale": self.scale.value(),
        }

    def n_poses(self, wanted: int) -> int:
        """Return about how many poses there will be, if a quality wants `wanted` with a rig."""
        assert self._summary is not None
        values = self.values()
        given = self._summary.n_given(values["clip"], values["fps"])
        if not self._summary.n_joints:
            return given
        by_rig = values["by_rig"]
        return given + (max(0, wanted - given) if by_rig is None else int(by_rig))

    def why_not(self) -> str:
        """Return that there are too few poses, "" if there are enough."""
        if self._summary is not None and self.n_poses(10) < 2:
            return "One pose is too few: let the rig make more."
        return ""

    @Slot()
    def _on_edited(self) -> None:
        self.number.setEnabled(self.by_rig.currentData() == _OWN_NUMBER)
        summary = self._summary
        if summary is None:
            return
        values = self.values()
        frames = summary.n_given(values["clip"], values["fps"]) - summary.n_poses
        self._from_clips.setText(
            say_number(
                frames,
                "Uses {n} animation frame as a pose.",
                "Uses {n} animation frames as poses.",
            )
        )
        size, scaled = summary.size, summary.size * values["scale"]
        length = f"{size:.4g}"
        if summary.metres is not None:
            length = say("{size} ({metres:.2f} m)", size=length, metres=size * summary.metres)
        text = say("The longest side of the body is {length} in its file.", length=length)
        if values["scale"] != 1.0:
            text = f"{text} {say('In the model it is {size:.4g}.', size=scaled)}"
        self._size.setText(text)
        self.changed.emit()

    @Slot()
    def _on_up(self) -> None:
        if self._summary is not None and self.up.count() == 4:
            self.up_changed.emit(self.up_axis)


class ContactsPage(Page):
    """The page of the contact rules.

    Attributes
    ----------
    experts : box that shows the fields below
    near, rest, tolerated : fields in per cent of the body size, each used if its box is ticked
    count_groups : box that counts pairs of groups that touch in nearly every pose
    """

    def __init__(self) -> None:
        super().__init__(
            "What doesn't count?",
            "Most characters touch themselves before they move. What a rule leaves out doesn't "
            "count as a collision: every check says so, and the finished model lists it under "
            "Contacts.",
        )
        self._near = _Rule(
            "Skin folds",
            "At elbows and knees the skin presses into itself. How far along the surface is "
            "measured from the rig or, without one, from the poses.",
            50.0,
            5.0,
        )
        self._rest = _Rule(
            "Touching at rest",
            "Belts, cloth, eyelids: what touches in the rest pose, and what lies close to it.",
            50.0,
            2.0,
        )
        self._tolerated = _Rule(
            "Tolerated depth", "Everything counts, however shallow.", 10.0, 1.0, "Up to"
        )
        self.near, self.rest, self.tolerated = (
            rule.field for rule in (self._near, self._rest, self._tolerated)
        )
        self.count_groups = QCheckBox("Count them anyway")
        self._groups = _ExplainedCard(
            "Pieces that always touch",
            "Hair on a head, a shoe on a foot: pairs of pieces in contact in nearly every pose.",
        )
        self._groups.add(self.count_groups)
        for rule in (self._rest, self._near, self._groups, self._tolerated):
            self.column.addWidget(rule)
        self.experts = QCheckBox("Choose the limits myself")
        self.column.addWidget(self.experts)
        self.column.addStretch()
        self.experts.toggled.connect(self._on_experts)
        self._on_experts()

    def show_summary(self, summary: SourcesSummary) -> None:
        """Hide the rest exclusion if the files have no rest pose."""
        self._rest.setVisible(bool(summary.n_joints or summary.clips) or self.experts.isChecked())

    def values(self) -> dict[str, Any]:
        """Return the chosen rules, None for those to be proposed."""
        mine = self.experts.isChecked()
        return {
            "near_exclusion": self._near.value() if mine else None,
            "rest_exclusion": self._rest.value() if mine else None,
            "tolerated_depth": self._tolerated.value() if mine else None,
            "ignored": () if mine and self.count_groups.isChecked() else None,
        }

    @Slot()
    def _on_experts(self) -> None:
        mine = self.experts.isChecked()
        for rule in (self._near, self._rest, self._tolerated):
            rule.choice.setVisible(mine)
        self.count_groups.setVisible(mine)
        if mine:
            self._rest.show()


class QualityPage(Page):
    """The page of the quality, the name and the licence.

    Parameters
    ----------
    why_no_name : called with a name; returns, as a sentence, why a model cannot have it, "" if it
        can

    Attributes
    ----------
    choices : buttons by quality
    name, licence : fields
    """

    def __init__(self, why_no_name: Callable[[str], str]) -> None:
        from lcollision_core.options import Quality

        super().__init__(
            "How good, and under which name?",
            "The work runs in the background with low priority. You can go on posing, or close "
            "the editor.",
        )
        self._why_no_name = why_no_name
        self._group = QButtonGroup(self)
        self.choices: dict[Quality, QRadioButton] = {}
        self._meanings: dict[Quality, QLabel] = {}
        rows = vbox(spacing=TIGHT)
        for quality in Quality:
            button = self.choices[quality] = QRadioButton(quality.capitalize())
            meaning = self._meanings[quality] = labelled("", "caption", wraps=True)
            meaning.setContentsMargins(WIDE + TIGHT, 0, 0, TIGHT)
            self._group.addButton(button)
            rows.addWidget(button)
            rows.addWidget(meaning)
        self.choices[Quality.GOOD].setChecked(True)
        self._card("Quality", widget_of(rows))
        self.name = QLineEdit(maxLength=60)
        self.licence = described(
            QLineEdit(placeholderText="unknown"),
            "The licence of the character, stored in the model",
        )
        self._card("Model", _form(("Name", self.name), ("Licence", self.licence)))
        self.column.addStretch()
        self.name.textEdited.connect(lambda _: self.changed.emit())
        self._group.buttonClicked.connect(lambda _: self.changed.emit())

    @property
    def quality(self) -> Quality:
        """The chosen quality."""
        return next(quality for quality, choice in self.choices.items() if choice.isChecked())

    def estimate(self, n_vertices: int, n_poses: Callable[[int], int]) -> None:
        """Show the time and the numbers of poses of each quality.

        Parameters
        ----------
        n_vertices : of the body
        n_poses : returns about how many poses there will be for the number that a quality wants
        """
        from lcollision_core.options import Quality
        from lcollision_core.tasks.learning import EFFORTS, estimated_seconds

        aims = {
            Quality.QUICK: "A first try",
            Quality.GOOD: "For daily work",
            Quality.BEST: "For final use",
        }
        for quality, label in self._meanings.items():
            effort = EFFORTS[quality]
            number = n_poses(effort.n_poses)
            stages = estimated_seconds(n_vertices, number, quality)
            spent = listed(f"{STAGE_WORDS[stage]} {spent_text(s)}" for stage, s in stages.items())
            time = duration_text(sum(stages.values()))
            name = quality.capitalize()
            self.choices[quality].setText(
                say("{quality}: {time} on this computer", quality=name, time=time)
            )
            sentence = say(
                "{aim}: {poses}, {samples} random ones.\n{spent}.",
                aim=aims[quality],
                poses=counted(number, "pose", "poses"),
                samples=grouped(effort.n_samples),
                spent=with_capital(spent),
            )
            label.setText(sentence)

    def values(self) -> dict[str, Any]:
        """Return quality and licence."""
        return {
            "quality": str(self.quality),
            "licence": self.licence.text().strip() or "unknown",
        }

    def why_not(self) -> str:
        """Return why a model cannot have the name, "" if it can."""
        return self._why_no_name(self.name.text().strip())


class _ExplainedCard(Card):
    """A card with a title and an explanation."""

    def __init__(self, title: str, about: str) -> None:
        super().__init__()
        self.add(labelled(title, "title"), labelled(about, "caption", wraps=True))


class _Rule(_ExplainedCard):
    """A rule in plain words, with an optional length for experts."""

    def __init__(
        self, title: str, about: str, most: float, default: float, words: str = "Within"
    ) -> None:
        super().__init__(title, about)
        self.own, self.field = QCheckBox(words), NumberBox(2, 0.0, most)
        self.field.setSuffix(" % of the body size")
        self.field.setSingleStep(0.5)
        self.field.setValue(default)
        self.field.setAccessibleName(title)
        self.field.setEnabled(False)
        self.own.toggled.connect(self.field.setEnabled)
        self.choice = widget_of(hbox(self.own, self.field, None))
        self.add(self.choice)

    def value(self) -> float | None:
        """Return the normalised length, None if its box is not ticked."""
        return self.field.value() / _PERCENT if self.own.isChecked() else None


def _form(*rows: tuple[str, QWidget]) -> QWidget:
    """Return a widget of labelled fields."""
    form = QFormLayout(horizontalSpacing=WIDE, verticalSpacing=CLOSE)
    for label, field in rows:
        form.addRow(label, field)
    return widget_of(form)


_SIZE, _MARGIN = QSize(900, 640), QSize(20, 60)
_PREVIEW_WIDTH, _NEXT_WIDTH = 236, 124
_STEPS = ("Files", "Poses", "Contacts", "Quality and name")
_EMPTY = "Your character appears here"


class BodyPicture(QLabel):
    """A small preview of a body read from the files, or a text.

    Attributes
    ----------
    has_body : whether a body is shown
    """

    def __init__(self) -> None:
        super().__init__(wordWrap=True, alignment=Qt.AlignmentFlag.AlignCenter)
        self.setObjectName("preview")
        self.setAccessibleName("Preview of the body")
        self.has_body = False

    def tell(self, text: str) -> None:
        """Show a text instead of a body."""
        self.has_body = False
        self.setText(text)

    def show_body(
        self, vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.int32], up_axis: int
    ) -> None:
        """Show (V, 3) vertices with an axis up; y-up files face +z, others -y."""
        self.has_body = True
        front = np.array([0.0, 0.0, 1.0] if up_axis == 1 else [0.0, -1.0, 0.0])
        view = preset_view("Three-quarter", vertices, np.eye(3)[up_axis], front, 1.0)
        self.setPixmap(
            thumbnail_pixmap(vertices, faces, view, _PREVIEW_WIDTH, self.devicePixelRatioF())
        )


class NewModelDialog(Dialog):
    """Ask page by page what to learn a model from, and how.

    Signals
    -------
    started : LearningRequest and str, the name of the model

    Parameters
    ----------
    work : reads the files
    settings : has the last folder
    parent : window of the dialog

    Attributes
    ----------
    files, poses, contacts, quality : the pages
    preview : of the body
    back, next : the buttons
    refusal : label that says why there is no next page
    """

    started = Signal(object, str)

    def __init__(self, work: LongWork, settings: Settings, parent: QWidget) -> None:
        super().__init__("New model", parent)
        FileDrops(self).dropped.connect(self.add)
        self.resize(_SIZE.boundedTo(screen_of(parent).size() - _MARGIN))
        self._work, self._settings = work, settings
        self._summary: SourcesSummary | None = None
        self.files, self.poses, self.contacts = FilesPage(), PosesPage(), ContactsPage()
        self.quality = QualityPage(why_no_model_name)
        self.preview, self._facts = BodyPicture(), labelled("", "caption", wraps=True)
        self.preview.tell(_EMPTY)
        self._lay_out()
        self.files.paths_changed.connect(self._read)
        self.files.add_files.clicked.connect(self._ask_for_files)
        self.files.add_folder.clicked.connect(self._ask_for_folder)
        self.poses.up_changed.connect(self._show_body)
        for page in self.pages:
            page.changed.connect(self._on_changed)
        self._go_to(0)

    @property
    def pages(self) -> tuple[Page, ...]:
        """All pages, in order."""
        return self.files, self.poses, self.contacts, self.quality

    @property
    def page(self) -> Page:
        """The current page."""
        return self.pages[self._stack.currentIndex()]

    def request(self) -> LearningRequest:
        """Return the request that the pages describe."""
        from lcollision_core.options import LearningRequest

        values = {key: value for page in self.pages for key, value in page.values().items()}
        return LearningRequest(**values)

    def add(self, paths: Sequence[Path]) -> None:
        """Go to the first page and list more files."""
        self._go_to(0)
        self.files.add(paths)

    def done(self, result: int) -> None:
        """Cancel reading, and close."""
        self._work.cancel(self)
        super().done(result)

    def _lay_out(self) -> None:
        self._steps = [labelled(f"{number}  {name}") for number, name in enumerate(_STEPS, 1)]
        steps = hbox(*self._steps, None, spacing=WIDE + CLOSE)
        self._stack = QStackedWidget()
        for page in self.pages:
            self._stack.addWidget(scrolling(page))
        column = vbox(self.preview, self._facts, spacing=CLOSE)
        column.setStretchFactor(self.preview, 1)
        side = widget_of(column)
        side.setFixedWidth(_PREVIEW_WIDTH)
        self.refusal = labelled("", "refusal", wraps=True)
        cancel = push_button("Cancel", clicked=self.reject)
        self.back = push_button("Back", clicked=lambda: self._go_to(self._stack.currentIndex() - 1))
        self.next = push_button("Next", clicked=self._go_on)
        self.next.setDefault(True)
        # Qt's size hint is too small for the bold text.
        self.next.setMinimumWidth(_NEXT_WIDTH)
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
        """Return why there is no next page, "" if there is one."""
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
        """Read the files again, in a worker thread."""
        self._work.cancel(self)
        self._summary = None
        self._facts.clear()
        paths = self.files.paths
        self.files.tell("")
        self.preview.tell(f"Reading {counted(len(paths), 'file', 'files')}…" if paths else _EMPTY)
        self._on_changed()
        if paths:
            work = partial(learning_runs.look_into_sources, paths)
            self._work.start("Reading files", work, self._on_read, self._on_unread, self)

    @Slot()
    def _show_body(self) -> None:
        if self._summary is not None:
            rest, faces = self._summary.rest, self._summary.topology.faces
            self.preview.show_body(rest, faces, self.poses.up_axis)

    def _on_unread(self, failure: Failure) -> None:
        """Show why the files cannot be used."""
        sentence = "; ".join(filter(None, (failure.headline, failure.next_step)))
        self.files.tell(f"{with_capital(one_line(sentence))}.", is_problem=True)
        self._on_changed()
        self.preview.tell("A model can't be learned from these files")

    def _on_read(self, summary: SourcesSummary) -> None:
        self._summary = summary
        for page in self.pages:
            page.show_summary(summary)
        self._show_body()
        self._facts.setText(_facts(summary))
        if not self.quality.name.text():
            path = self.files.paths[0]
            self.quality.name.setText(free_model_name(path.name if path.is_dir() else path.stem))
        self._on_changed()

    @Slot()
    def _ask_for_files(self) -> None:
        from lcollision_core.files.formats import LEARNED_FROM, SCENE_SUFFIXES

        masks = " ".join(f"*{suffix}" for suffix in (*SCENE_SUFFIXES, *LEARNED_FROM))
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
    """Describe the contents of the files in a few lines."""
    poses = counted(summary.n_given(), "pose", "poses")
    rig = say_number(summary.n_joints, "rig of {n} joint", "rig of {n} joints")
    lines = [
        counted(summary.topology.n_vertices, "vertex", "vertices"),
        say("{poses} in the files", poses=poses),
        rig if summary.n_joints else say("no rig"),
    ]
    if not summary.up.is_sure:
        axis = "xyz"[summary.up.axis]
        lines.append(say("Probably {axis} up: check the preview", axis=axis))
    return "\n".join(map(with_capital, lines))


def _mark(label: QLabel, place: str) -> None:
    """Style the label of a step as "done", "here" or "later"."""
    label.setObjectName("title" if place == "here" else "" if place == "done" else "caption")
    restyle(label)
