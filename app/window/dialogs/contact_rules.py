"""Show and change the contact rules, with the number of pairs that each excludes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from PySide6.QtCore import QSize, Qt, Signal, Slot
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QDialogButtonBox,
    QLabel,
    QTreeWidget,
    QTreeWidgetItem,
    QVBoxLayout,
    QWidget,
)

from app.view.legend import with_swatch
from app.view.shading import UNCOUNTED_FACE
from app.view.theme import CLOSE, NORMAL, TIGHT, WIDE
from app.window.dialogs.questions import Dialog
from app.window.widgets import (
    NumberBox,
    described,
    dialog_vbox,
    hbox,
    labelled,
    push_button,
    screen_of,
    vbox,
    widget_of,
)
from lcollision_core.errors import ShapeError
from lcollision_core.tasks.words import counted, with_capital

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from lcollision_core.contact import ContactRules, ProposedPair, SelfCollisions
    from lcollision_core.meshes import FaceGroup

_WIDTH, _BORDER = 400, WIDE + 4
_COUNTING = "Counting pairs at rest…"
_FOLDS = {
    False: "Pairs this close along the surface",
    True: "Pairs this close along the surface, less at thin limbs",
}
_PERCENT = 100.0
_MOST = {"near": 50.0, "rest": 50.0, "tolerated": 10.0}
"""Upper limits in per cent of the body size; beyond them hardly any pair would count."""

_DEFAULT_REST, _DEFAULT_DEPTH = 2.0, 1.0
"""Initial rest exclusion and tolerated depth of a pair, in per cent."""

_FEWEST_PARTS = 2
"""Smallest number of parts of which one can be left out."""

_LIST_HEIGHT, _SCREEN_SHARE = 64, 0.75
_ROW = QSize(0, 20)
_OTHERS = "other pairs"
_MEANINGS = {
    "meshes and materials": "As named in the file",
    "body parts": "Such as an upper arm and its forearm, which cross at the elbow",
    "components": "Connected pieces of the surface, such as shells and buttons",
    _OTHERS: "Groups of two kinds",
}
_TINT = "Crosses in the pose shown, but isn't counted"
_CHECKED, _UNCHECKED = Qt.CheckState.Checked, Qt.CheckState.Unchecked


class ContactsDialog(Dialog):
    """The contact rules of the open body, each with its count of pairs at rest.

    Parameters
    ----------
    document : its model's rules are shown, and changed unless a predictor depends on them
    parent : window of the dialog

    Attributes
    ----------
    near, rest, tolerated : fields, in per cent of the body size
    at_rest, at_joints : boxes of the rest exclusion and the joint exclusion
    ignored : tree of pairs of groups by kind, ticked if ignored, and of meshes, materials and
        body parts, ticked if left out whole
    first, second, add, propose : widgets that add to the tree
    own_depth, tolerate : set a tolerated depth, in per cent, for the two chosen groups
    apply, restore : buttons; the latter restores the character's default rules
    total : label with the number of pairs that count at rest
    kept : label that says where changes are stored, or why nothing can be changed
    counts : labels of the counts by rule, keyed by the fields of `RuleCounts`
    always, in_shapes : boxes that exclude places that touch in nearly every pose, and places that a
        morph target brings into contact; the latter only for bodies with such places

    Signals
    -------
    faces_selected : indices of the faces of the groups selected in the tree or the boxes below it
    """

    faces_selected = Signal(object)

    def __init__(self, document: PoseDocument, parent: QWidget) -> None:
        super().__init__("Contacts", parent)
        self.setMinimumWidth(_WIDTH)
        self._document = document
        self._notes: list[QLabel] = []
        self.near, self.rest, self.tolerated = (self._field(name) for name in _MOST)
        self.at_rest, self.at_joints = QCheckBox("Touching at rest"), QCheckBox("Creases at joints")
        self.always = QCheckBox("Always touching")
        self.in_shapes = QCheckBox("Touching in shapes")
        self.in_shapes.setToolTip(
            "Closed lids, lashes, lips: places that a shape brings into contact"
        )
        bold = self.at_rest.font()
        bold.setBold(True)
        boxes = self.at_rest, self.at_joints, self.always, self.in_shapes
        for box in boxes:
            box.setFont(bold)
        names = (*_MOST, "joint", "touching", "shape", "ignored")
        self.counts = {name: labelled("", "caption") for name in names}
        for label in self.counts.values():
            label.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.folds, self.total = self._note(_FOLDS[False]), self._note(_COUNTING)
        self._tint = QLabel(with_swatch(_TINT, UNCOUNTED_FACE))
        self._tint.setObjectName("caption")
        self.kept = self._note("")
        self._lay_out()
        for box in boxes:
            box.toggled.connect(self._on_edited)
        for field in (self.near, self.rest, self.tolerated):
            field.valueChanged.connect(self._on_edited)
        document.model_changed.connect(self._on_model)
        document.tasks.busy_changed.connect(self._on_edited)
        document.tasks.contacts_counted.connect(self._on_counted)
        document.tasks.pairs_proposed.connect(self._on_proposed)
        document.tasks.rules_proposed.connect(self._on_edited)
        self._on_model()

    def _lay_out(self) -> None:
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        self.apply = buttons.addButton("Apply", QDialogButtonBox.ButtonRole.ApplyRole)
        self.apply.setToolTip("Use these rules from now on to check, drag and resolve")
        self.apply.clicked.connect(self._apply)
        self.restore = buttons.addButton("Defaults", QDialogButtonBox.ButtonRole.ResetRole)
        self.restore.setToolTip("Restore the character's default rules")
        self.restore.clicked.connect(self._restore)
        for button in (self.restore, buttons.button(QDialogButtonBox.StandardButton.Close)):
            button.setAutoDefault(False)
        buttons.rejected.connect(self.reject)
        near, tolerated = (labelled(text, "title") for text in ("Skin folds", "Tolerated depth"))
        near.setBuddy(self.near)
        tolerated.setBuddy(self.tolerated)
        page = dialog_vbox(
            self._note("Crossing triangles that a rule leaves out don't count as collisions."),
            vbox(hbox(near, None, self.counts["near"], self.near), self.folds, spacing=TIGHT),
            self._row(
                self.at_rest,
                "rest",
                self.rest,
                "Belts, cloth, eyelids: pairs that touch in the rest pose, and pairs this close "
                "to them along the surface",
            ),
            self._row(
                tolerated, "tolerated", self.tolerated, "Pairs up to this deep, for soft bodies"
            ),
            hbox(self.at_joints, None, self.counts["joint"]),
            hbox(self.always, None, self.counts["touching"]),
            hbox(self.in_shapes, None, self.counts["shape"]),
            self._ignored_part(),
            self.total,
            self._tint,
            self.kept,
            buttons,
        )
        page.setSpacing(NORMAL)
        self.setLayout(page)
        # The tree is as tall as the screen allows; the dialog may be resized.
        most = round(_SCREEN_SHARE * screen_of(self).height())
        self.resize(_WIDTH, min(self.sizeHint().height(), most))
        self.apply.setDefault(True)

    def _row(self, title: QWidget, name: str, field: NumberBox, why: str) -> QVBoxLayout:
        """Return the rows of a rule: title, count and field, and its explanation."""
        return vbox(hbox(title, None, self.counts[name], field), self._note(why), spacing=TIGHT)

    def _note(self, text: str) -> QLabel:
        note = labelled("", "caption", wraps=True)
        self._notes.append(note)
        self._write(note, text)
        return note

    def _write(self, note: QLabel, text: str) -> None:
        """Set the text of a note, and reserve the height that it needs."""
        note.setText(text)
        # A box layout reserves one line for a wrapped label, however narrow.
        width = max(self.width(), _WIDTH) if self.isVisible() else _WIDTH
        note.setMinimumHeight(max(0, note.heightForWidth(width - 2 * _BORDER)))

    def resizeEvent(self, event: QResizeEvent) -> None:  # noqa: N802 - Qt's name
        """Fit the notes to the new width; the tree gets the rest."""
        super().resizeEvent(event)
        for note in self._notes:
            self._write(note, note.text())

    def _ignored_part(self) -> QWidget:
        """Return the tree of ignored pairs with the widgets that add to it."""
        self.ignored = described(QTreeWidget(), "", "Ignored pairs")
        self.ignored.setHeaderHidden(True)
        self.ignored.setUniformRowHeights(True)
        self.ignored.setIndentation(NORMAL + TIGHT)
        self._pairs: dict[tuple[str, str], QTreeWidgetItem] = {}
        self._kinds: dict[str, QTreeWidgetItem] = {}
        self._left_out: dict[str, QTreeWidgetItem] = {}
        self._tolerated: dict[tuple[str, str, float], QTreeWidgetItem] = {}
        self.ignored.setMinimumHeight(_LIST_HEIGHT)
        tip = "Meshes, materials and body parts of the file"
        self.first, self.second = (
            described(QComboBox(minimumContentsLength=8), tip, name)
            for name in ("First group", "Second group")
        )
        tip = "Don't count any contact between these two"
        self.add = push_button("Ignore", tip, self._add_pair)
        tip = "List the groups that touch in nearly every pose: tick pairs, or a whole kind"
        self.propose = push_button("Propose", tip, self._document.tasks.propose_pairs)
        self.own_depth = self._field("tolerated")
        self.own_depth.setValue(_DEFAULT_DEPTH)
        tip = "Count contact between these two only beyond this depth"
        self.tolerate = push_button("Set", tip, self._add_tolerated)
        for box in (self.first, self.second):
            box.textActivated.connect(self._name_choice)
            # Long names are cut.
            box.currentTextChanged.connect(box.setToolTip)
        self.ignored.currentItemChanged.connect(self._name_item)
        self.ignored.itemChanged.connect(self._on_edited)
        called = labelled("Ignored pairs and parts", "title")
        title = hbox(called, None, self.counts["ignored"], self.propose)
        choice = hbox(self.first, labelled("and", "caption"), self.second, self.add)
        for box in (self.first, self.second):
            choice.setStretchFactor(box, 1)
        beyond = labelled("or count only deeper than", "caption")
        deeper = hbox(beyond, None, self.own_depth, self.tolerate)
        return widget_of(vbox(title, self.ignored, choice, deeper, spacing=CLOSE))

    def _field(self, name: str) -> NumberBox:
        field = described(NumberBox(2, 0.0, _MOST[name]), "In per cent of the body size")
        field.setSuffix(" %")
        field.setSingleStep(0.5)
        field.setFixedWidth(96)
        return field

    def rules(self) -> ContactRules:
        """Return the rules in the fields."""
        from lcollision_core.contact import ContactRules

        rules = self._document.model.rules
        return ContactRules(
            _length(self.near, rules.near_exclusion),
            _length(self.rest, rules.rest_exclusion) if self.at_rest.isChecked() else None,
            tuple(pair for pair, item in self._pairs.items() if item.checkState(0) is _CHECKED),
            _length(self.tolerated, rules.tolerated_depth),
            self.at_joints.isChecked(),
            *(self._patches() if self.always.isChecked() else ((), 0.0)),
            tuple(name for name, item in self._left_out.items() if item.checkState(0) is _CHECKED),
            tuple(
                entry for entry, item in self._tolerated.items() if item.checkState(0) is _CHECKED
            ),
            self._near_by_limb(),
            self._shape_patches() if self.in_shapes.isChecked() else (),
        )

    def _near_by_limb(self) -> bool:
        """Whether near exclusion shrinks at thin limbs; not if the user typed a value."""
        rules = self._document.model.rules
        return (
            rules.near_by_limb and _length(self.near, rules.near_exclusion) == rules.near_exclusion
        )

    def _patches(self) -> tuple[tuple[tuple[int, int], ...], float]:
        """Return the patches that touch in nearly every pose, from the rules or the proposal."""
        proposed, rules = self._document.tasks.proposed_rules, self._document.model.rules
        if not rules.touching and proposed is not None:
            rules = proposed.rules
        return rules.touching, rules.touching_radius

    def _shape_patches(self) -> tuple[tuple[int, int], ...]:
        """Return the patches that a morph target brings into contact."""
        model = self._document.model
        return model.rules.shape_touching or model.own_rules.shape_touching

    def _where_kept(self) -> str:
        """Return where changes are stored, or why none are possible; "" if in the model's file."""
        model = self._document.model
        if model.has_predictor:
            return (
                f"“{model.name}” has a predictor that was trained with these rules: to change "
                f"them, train a model with other rules."
            )
        if not model.is_trained:
            return "The rules are remembered for this character; its file isn't changed."
        return ""

    @Slot()
    def _on_model(self) -> None:
        from lcollision_core.meshes.face_groups import without_joints

        model = self._document.model
        rules = model.rules
        self.near.setValue(_PERCENT * rules.near_exclusion)
        self.at_rest.setChecked(rules.rest_exclusion is not None)
        self.at_joints.setChecked(rules.joint_exclusion)
        self.always.setChecked(bool(rules.touching))
        self.in_shapes.setChecked(bool(rules.shape_touching))
        for widget in (self.in_shapes, self.counts["shape"]):
            widget.setVisible(bool(self._shape_patches()))
        rest = rules.rest_exclusion
        self.rest.setValue(_DEFAULT_REST if rest is None else _PERCENT * rest)
        self.tolerated.setValue(_PERCENT * rules.tolerated_depth)
        # Clear these before the tree: adding items already reads which are ticked.
        for items in (self._pairs, self._kinds, self._left_out, self._tolerated):
            items.clear()
        self.ignored.clear()
        for pair in rules.ignored:
            self._list(pair, _CHECKED)
        self._name_kinds()
        self._list_parts(rules)
        for entry in rules.tolerated_pairs:
            self._list_tolerated(entry)
        groups = without_joints(model.groups)
        materials = dict.fromkeys(group.name for group in groups if group.is_material)
        others = dict.fromkeys(group.name for group in groups if group.name not in materials)
        for box in (self.first, self.second):
            box.clear()
            box.addItems(list(others))
            if others and materials:
                box.insertSeparator(box.count())
            box.addItems(list(materials))
        self.second.setCurrentIndex(min(1, len(others) - 1))
        store_text = self._where_kept()
        self._write(self.kept, store_text)
        self.kept.setVisible(bool(store_text))
        self.restore.setVisible(not model.is_trained)
        for label in self.counts.values():
            label.setText("…")
        self._write(self.total, _COUNTING)
        self._document.tasks.count_contacts()
        self._on_edited()

    @Slot(object)
    def _on_counted(self, at_rest: SelfCollisions) -> None:
        """Show how many pairs of the rest pose each rule excludes."""
        for name, label in self.counts.items():
            label.setText(f"{counted(getattr(at_rest.excluded, name), 'pair', 'pairs')} at rest")
        left = counted(len(at_rest.pairs), "pair", "pairs")
        left_out = counted(at_rest.excluded.total, "pair", "pairs")
        count_text = f"At rest {left_out} not counted, {left} counted."
        if at_rest.colliding:
            count_text += " Pairs that collide at rest collide in every pose: widen a rule."
        self._write(self.total, count_text)

    @Slot()
    def _on_edited(self) -> None:
        model = self._document.model
        self._write(self.folds, _FOLDS[self._near_by_limb()])
        can_change = not model.has_predictor
        for widget in (self.near, self.at_rest, self.tolerated, self.ignored, self.propose):
            widget.setEnabled(can_change)
        self.in_shapes.setEnabled(can_change)
        self.rest.setEnabled(can_change and self.at_rest.isChecked())
        self.at_joints.setEnabled(can_change and model.has_joints)
        tip = "Pairs of parts linked by a joint, within a limb's thickness of it"
        if not model.has_joints:
            tip = "For rigged characters, and models learned from them"
        self.at_joints.setToolTip(tip)
        n_patches = len(self._patches()[0])
        self.always.setEnabled(can_change and n_patches > 0)
        tip = (
            f"{counted(n_patches, 'place', 'places')} found that touch in nearly every pose, with "
            "the faces close to them"
        )
        self.always.setToolTip(
            tip if n_patches else "No place is known to touch in nearly every pose"
        )
        several = can_change and self.first.count() > 1
        for choice in (self.first, self.second, self.add, self.own_depth, self.tolerate):
            choice.setEnabled(several)
        free = can_change and not self._document.tasks.changing_model
        self.restore.setEnabled(free and model.rules_are_chosen)
        self.apply.setEnabled(free and self._differ())

    def _differ(self) -> bool:
        """Whether the fields hold valid rules that differ from the model's."""
        try:
            return self.rules() != self._document.model.rules
        except ShapeError as error:
            self._write(self.total, with_capital(str(error)))
            return False

    @Slot()
    def _apply(self) -> None:
        self._document.tasks.set_rules(self.rules())

    @Slot()
    def _restore(self) -> None:
        self._document.tasks.set_rules(self._document.model.own_rules)

    @Slot()
    def _add_pair(self) -> None:
        item = self._list((self.first.currentText(), self.second.currentText()))
        item.setCheckState(0, _CHECKED)
        self._name_kinds()
        self.ignored.scrollToItem(item)

    @Slot()
    def _add_tolerated(self) -> None:
        names = self.first.currentText(), self.second.currentText()
        self.ignored.scrollToItem(self._list_tolerated((*names, self.own_depth.value() / _PERCENT)))

    def _list_tolerated(self, entry: tuple[str, str, float]) -> QTreeWidgetItem:
        """Add the ticked item of a pair and its tolerated depth, replacing an earlier entry."""
        from lcollision_core.meshes.contact_rules import pair_in_words

        for known in [known for known in self._tolerated if {*known[:2]} == {*entry[:2]}]:
            self.ignored.invisibleRootItem().removeChild(self._tolerated.pop(known))
        text = f"{pair_in_words(entry[:2])}: up to {_PERCENT * entry[2]:g} %"
        tip = "Ticked: contact between these two counts only beyond this depth"
        item = self._tolerated[entry] = _ticked_item(self.ignored, text, _CHECKED, tip)
        self._on_edited()
        return item

    @Slot(object)
    def _on_proposed(self, proposals: dict[str, tuple[ProposedPair, ...]]) -> None:
        """List pairs of groups that touch in nearly every pose, for the user to tick."""
        from lcollision_core.meshes.contact_rules import pair_in_words

        for pair in (pair for kind in proposals.values() for pair in kind):
            share = f"{100 * pair.share:.0f} % of the poses"
            self._list(pair.groups).setText(0, f"{pair_in_words(pair.groups)}: {share}")
        self._name_kinds()
        for name, pairs in proposals.items():
            kind, least = self._kinds.get(name), min((pair.share for pair in pairs), default=0.0)
            # Only if no other pairs are listed under this kind.
            if kind is not None and kind.childCount() == len(pairs):
                share = "all" if least == 1.0 else f"{int(100 * least)} % or more"
                kind.setText(0, f"{kind.text(0)}: in {share} of the poses")
        if not any(proposals.values()):
            self._write(self.total, "No two groups touch in nearly every pose.")
            return
        size = {group.name: len(group.faces) for group in self._groups()}

        def left_out(kind: str) -> int:
            return sum(size[pair.groups[0]] * size[pair.groups[1]] for pair in proposals[kind])

        first = min((kind for kind in proposals if proposals[kind]), key=left_out)
        start = f"Start with {first}, which excludes the fewest pairs; the selection is tinted."
        self._write(self.total, start)

    def _groups(self) -> list[FaceGroup]:
        return [group for kind in self._document.model.groups_by_kind.values() for group in kind]

    def _name(self, *names: str) -> None:
        """Tint the faces of the named groups in the view."""
        faces = [group.faces for group in self._groups() if group.name in names]
        self.faces_selected.emit(np.concatenate(faces) if faces else None)

    @Slot()
    def _name_choice(self) -> None:
        self._name(self.first.currentText(), self.second.currentText())

    @Slot(QTreeWidgetItem)
    def _name_item(self, item: QTreeWidgetItem | None) -> None:
        pairs = [pair for pair, own in self._pairs.items() if item in (own, own.parent())]
        whole = [name for name, own in self._left_out.items() if item is own]
        pairs += [entry[:2] for entry, own in self._tolerated.items() if item is own]
        self._name(*whole, *(name for pair in pairs for name in pair))

    def _list(self, pair: tuple[str, str], state: Qt.CheckState = _UNCHECKED) -> QTreeWidgetItem:
        """Return the item of a pair; add it if it is not listed."""
        from lcollision_core.meshes.contact_rules import pair_in_words

        for known in (pair, pair[::-1]):
            if known in self._pairs:
                return self._pairs[known]
        kind = self._kind(pair)
        tip = "Ticked: contacts between these two are not counted"
        item = self._pairs[pair] = _ticked_item(kind, pair_in_words(pair), state, tip)
        return item

    def _list_parts(self, rules: ContactRules) -> None:
        """List the meshes, materials and body parts that can be left out whole."""
        from lcollision_core.meshes.face_groups import GROUP_KINDS

        model = self._document.model
        file_groups, parts = (model.groups_by_kind[kind] for kind in GROUP_KINDS[:2])
        named = {
            # A learned model does not tell meshes from materials.
            "meshes and materials" if model.is_trained else "meshes": [
                group.name for group in file_groups if not group.is_material
            ],
            "materials": [group.name for group in file_groups if group.is_material],
            "body parts": [group.name for group in parts],
        }
        known_names = {name for names in named.values() for name in names}
        named["others"] = [name for name in rules.left_out if name not in known_names]
        if len({*known_names, *named["others"]}) < _FEWEST_PARTS:
            return
        for kind, names in named.items():
            self._list_kind(f"Leave out {kind}", names, rules)

    def _list_kind(self, title: str, names: list[str], rules: ContactRules) -> None:
        """List the parts of one kind that are not listed yet, under a title."""
        names = [name for name in dict.fromkeys(names) if name not in self._left_out]
        if not names:
            return
        parts = QTreeWidgetItem(self.ignored, [f"{title} ({len(names)})"])
        parts.setToolTip(0, "Ticked: left out of the check; still posed and exported")
        parts.setSizeHint(0, _ROW)
        for name in names:
            state = _CHECKED if name in rules.left_out else _UNCHECKED
            self._left_out[name] = _ticked_item(parts, name, state)
        parts.setExpanded(any(name in rules.left_out for name in names))

    def _kind(self, pair: tuple[str, str]) -> QTreeWidgetItem:
        """Return the parent item for the kind of group of a pair; add it if missing."""
        kinds = self._document.model.groups_by_kind
        names = {kind: {group.name for group in groups} for kind, groups in kinds.items()}
        name = next((kind for kind, known in names.items() if set(pair) <= known), _OTHERS)
        if name in self._kinds:
            return self._kinds[name]
        order = [*kinds, _OTHERS]
        place = sum(order.index(known) < order.index(name) for known in self._kinds)
        kind = self._kinds[name] = QTreeWidgetItem()
        self.ignored.insertTopLevelItem(place, kind)
        tick = Qt.ItemFlag.ItemIsUserCheckable | Qt.ItemFlag.ItemIsAutoTristate
        kind.setFlags(kind.flags() | tick)
        kind.setSizeHint(0, _ROW)
        kind.setToolTip(0, f"{_MEANINGS[name]}. Ticked: none of these pairs is counted")
        return kind

    def _name_kinds(self) -> None:
        """Show how many pairs each kind has; expand it if it is the only one."""
        for name, kind in self._kinds.items():
            kind.setText(0, f"{with_capital(name)} ({kind.childCount()})")
            kind.setExpanded(len(self._kinds) == 1)


def _ticked_item(
    parent: QTreeWidget | QTreeWidgetItem, text: str, state: Qt.CheckState, tip: str = ""
) -> QTreeWidgetItem:
    """Return an item of a tree that the user ticks."""
    # An item made with its parent takes part in the parent's tristate tick.
    item = QTreeWidgetItem(parent, [text])
    item.setFlags(item.flags() | Qt.ItemFlag.ItemIsUserCheckable)
    item.setCheckState(0, state)
    item.setSizeHint(0, _ROW)
    item.setToolTip(0, tip)
    return item


def _length(field: NumberBox, current: float | None) -> float:
    """Return a field's normalised length, or `current` unrounded while the field still shows it."""
    percentage = None if current is None else round(_PERCENT * current, field.decimals())
    return field.value() / _PERCENT if current is None or field.value() != percentage else current
