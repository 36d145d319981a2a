"""Which pairs of triangles count as collisions: seen with what they leave out, and changed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from PySide6.QtCore import Qt, Slot
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QDialog,
    QDialogButtonBox,
    QLabel,
    QListWidget,
    QListWidgetItem,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from app.view.legend import with_swatch
from app.view.shading import UNCOUNTED_FACE
from app.view.theme import CLOSE, NORMAL, TIGHT, WIDE
from app.window.number_box import NumberBox
from app.window.widgets import dialog_vbox, hbox, labelled, vbox
from app.wording import counted

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.work.jobs import ContactsAtRest
    from lcollision_core.contact import ContactRules, ProposedPair

_WIDTH, _BORDER = 420, WIDE + 4
_COUNTING = "Counting pairs at rest…"
_PERCENT = 100.0
_MOST = {"near": 50.0, "rest": 50.0, "tolerated": 10.0}
"""Per cent of the body size; beyond it hardly anything would count."""

_DEFAULT_REST = 2.0
"""Per cent that a rest exclusion begins with."""

_LIST_HEIGHT = 84
_PAIR = Qt.ItemDataRole.UserRole
_CHECKED, _UNCHECKED = Qt.CheckState.Checked, Qt.CheckState.Unchecked


class ContactsDialog(QDialog):
    """The contact rules of the body that is open, each with its count of pairs at rest.

    Parameters
    ----------
    document : its model's rules are shown, and changed where no predictor depends on them
    parent : the window that it belongs to

    Attributes
    ----------
    near, rest, tolerated : fields, in per cent of the body size
    at_rest : whether there is a rest exclusion
    ignored : pairs of groups, ticked where they are ignored
    first, second, add, propose : what adds to these
    apply : the button
    total : says how many pairs count at rest
    locked : says why nothing can be changed, where that is so
    counts : labels of the counts by rule, as the fields of `RuleCounts` are called
    """

    def __init__(self, document: PoseDocument, parent: QWidget) -> None:
        super().__init__(parent)
        self.setWindowTitle("Contacts")
        self.setFixedWidth(_WIDTH)
        self._document = document
        self.near, self.rest, self.tolerated = (self._field(name) for name in _MOST)
        self.at_rest = QCheckBox("Touching at rest")
        bold = self.at_rest.font()
        bold.setBold(True)
        self.at_rest.setFont(bold)
        self.counts = {name: labelled("", "caption") for name in _MOST | {"ignored": 0.0}}
        for label in self.counts.values():
            label.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.total = self._note(_COUNTING)
        self._tint = QLabel(with_swatch("On the body: crosses, but isn't counted", UNCOUNTED_FACE))
        self._tint.setObjectName("caption")
        self.locked = labelled("", "caption", wraps=True)
        self._lay_out()
        self.at_rest.toggled.connect(self._on_edited)
        for field in (self.near, self.rest, self.tolerated):
            field.valueChanged.connect(self._on_edited)
        document.model_changed.connect(self._on_model)
        document.busy_changed.connect(self._on_edited)
        document.contacts_counted.connect(self._on_counted)
        document.pairs_proposed.connect(self._on_proposed)
        self._on_model()

    def _lay_out(self) -> None:
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        self.apply = buttons.addButton("Apply", QDialogButtonBox.ButtonRole.ApplyRole)
        self.apply.setToolTip("Check the pose, drag and resolve by these rules from now on")
        self.apply.clicked.connect(self._apply)
        buttons.button(QDialogButtonBox.StandardButton.Close).setAutoDefault(False)
        buttons.rejected.connect(self.reject)
        near, tolerated = (labelled(text, "title") for text in ("Skin folds", "Tolerated depth"))
        page = dialog_vbox(
            self._note("Crossing triangles that a rule leaves out are no collisions."),
            self._row(near, "near", self.near, "Pairs this near along the surface"),
            self._row(
                self.at_rest,
                "rest",
                self.rest,
                "Belts, cloth, eyelids: pairs that touch in the rest pose, and what is this "
                "near to them along the surface",
            ),
            self._row(tolerated, "tolerated", self.tolerated, "Pairs no deeper, for soft bodies"),
            self._ignored_part(),
            self.total,
            self._tint,
            self.locked,
            buttons,
        )
        page.setSpacing(NORMAL)
        self.setLayout(page)
        self.apply.setDefault(True)

    def _row(self, title: QWidget, name: str, field: NumberBox, why: str) -> QVBoxLayout:
        """Return a rule: what it is called, its count and its length, and why it is there."""
        return vbox(hbox(title, None, self.counts[name], field), self._note(why), spacing=TIGHT)

    def _note(self, text: str) -> QLabel:
        note = labelled(text, "caption", wraps=True)
        # A box asks for one line of it, however narrow.
        note.setMinimumHeight(note.heightForWidth(_WIDTH - 2 * _BORDER))
        return note

    def _ignored_part(self) -> QWidget:
        """Return the list of ignored pairs, with what adds to it and takes from it."""
        self.ignored = QListWidget()
        self.ignored.setAccessibleName("Ignored pairs")
        self.ignored.setFixedHeight(_LIST_HEIGHT)
        self.first, self.second = QComboBox(), QComboBox()
        for box, name in ((self.first, "First group"), (self.second, "Second group")):
            box.setAccessibleName(name)
            box.setMinimumContentsLength(8)
            box.setToolTip("Meshes, materials and body parts of the file")
        self.add, self.propose = QPushButton("Ignore"), QPushButton("Propose")
        self.add.setToolTip("Don't count any contact between these two")
        self.propose.setToolTip("List the groups that touch in nearly every pose, to be ticked")
        for button in (self.add, self.propose):
            button.setAutoDefault(False)
        self.add.clicked.connect(self._add_pair)
        self.propose.clicked.connect(self._document.propose_pairs)
        self.ignored.itemChanged.connect(self._on_edited)
        held = QWidget()
        title = hbox(labelled("Ignored pairs", "title"), None, self.counts["ignored"], self.propose)
        choice = hbox(self.first, labelled("and", "caption"), self.second, self.add)
        for box in (self.first, self.second):
            choice.setStretchFactor(box, 1)
        held.setLayout(vbox(title, self.ignored, choice, spacing=CLOSE))
        return held

    def _field(self, name: str) -> NumberBox:
        field = NumberBox(2, 0.0, _MOST[name])
        field.setSuffix(" %")
        field.setSingleStep(0.5)
        field.setToolTip("In per cent of the body size")
        field.setFixedWidth(96)
        return field

    def rules(self) -> ContactRules:
        """Return what the fields say."""
        from lcollision_core.contact import ContactRules

        held = self._document.model.rules
        return ContactRules(
            _length(self.near, held.near_exclusion),
            _length(self.rest, held.rest_exclusion) if self.at_rest.isChecked() else None,
            tuple(item.data(_PAIR) for item in self._items if item.checkState() is _CHECKED),
            _length(self.tolerated, held.tolerated_depth),
        )

    @Slot()
    def _on_model(self) -> None:
        model = self._document.model
        rules = model.rules
        self.near.setValue(_PERCENT * rules.near_exclusion)
        self.at_rest.setChecked(rules.rest_exclusion is not None)
        rest = rules.rest_exclusion
        self.rest.setValue(_DEFAULT_REST if rest is None else _PERCENT * rest)
        self.tolerated.setValue(_PERCENT * rules.tolerated_depth)
        self.ignored.clear()
        for pair in rules.ignored:
            self._list(pair, _CHECKED)
        names = list(dict.fromkeys(group.name for group in model.groups))
        for box in (self.first, self.second):
            box.clear()
            box.addItems(names)
        self.second.setCurrentIndex(min(1, len(names) - 1))
        self.locked.setText(
            f"“{model.name}” has a predictor that was trained by these rules: train a model by "
            "other rules to change them."
        )
        self.locked.setMinimumHeight(self.locked.heightForWidth(_WIDTH - 2 * _BORDER))
        self.locked.setVisible(model.has_predictor)
        for label in self.counts.values():
            label.setText("…")
        self.total.setText(_COUNTING)
        self._document.count_contacts()
        self._on_edited()

    @Slot(object)
    def _on_counted(self, found: ContactsAtRest) -> None:
        """Show how many pairs each rule leaves out of the rest pose."""
        for name, label in self.counts.items():
            label.setText(f"{counted(getattr(found.excluded, name), 'pair')} at rest")
        left = counted(found.n_counted, "pair")
        said = f"At rest {counted(found.excluded.total, 'pair')} not counted, {left} counted."
        if found.n_counted:
            said += " While pairs count at rest no pose is free: widen a rule."
        self.total.setText(said)

    @Slot()
    def _on_edited(self) -> None:
        can_change = not self._document.model.has_predictor
        always: tuple[QWidget, ...] = (self.near, self.at_rest, self.tolerated, self.ignored)
        for widget in always:
            widget.setEnabled(can_change)
        self.rest.setEnabled(can_change and self.at_rest.isChecked())
        several = can_change and self.first.count() > 1
        for choice in (self.first, self.second, self.add, self.propose):
            choice.setEnabled(several)
        self.apply.setEnabled(
            can_change
            and not self._document.changing_rules
            and self.rules() != self._document.model.rules
        )

    @Slot()
    def _apply(self) -> None:
        self._document.set_rules(self.rules())
        self._on_edited()

    @Slot()
    def _add_pair(self) -> None:
        pair = self.first.currentText(), self.second.currentText()
        self._list(pair).setCheckState(_CHECKED)

    @Slot(object)
    def _on_proposed(self, proposals: tuple[ProposedPair, ...]) -> None:
        """List pairs of groups that touch in nearly every pose, for the user to tick."""
        for proposal in proposals:
            share = f"{100 * proposal.share:.0f} % of the poses"
            self._list(proposal.groups).setText(f"{' and '.join(proposal.groups)}: {share}")
        if not proposals:
            self.total.setText("No two groups touch in nearly every pose.")

    def _list(self, pair: tuple[str, str], state: Qt.CheckState = _UNCHECKED) -> QListWidgetItem:
        """Return the item of a pair, which is listed now if it was not."""
        for item in self._items:
            if set(item.data(_PAIR)) == set(pair):
                return item
        item = QListWidgetItem(" and ".join(pair))
        item.setData(_PAIR, pair)
        item.setFlags(item.flags() | Qt.ItemFlag.ItemIsUserCheckable)
        item.setCheckState(state)
        item.setToolTip("Ticked: contacts between these two are not counted")
        self.ignored.addItem(item)
        return item

    @property
    def _items(self) -> list[QListWidgetItem]:
        return [self.ignored.item(row) for row in range(self.ignored.count())]


def _length(field: NumberBox, held: float | None) -> float:
    """Return a field's normalised length: the one that there is, where the field shows that."""
    shown = None if held is None else round(_PERCENT * held, field.decimals())
    return field.value() / _PERCENT if held is None or field.value() != shown else held
