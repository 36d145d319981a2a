"""Forms that remember their values: pictures, videos, Resolve, exports of poses and motions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PySide6.QtCore import Qt, Slot
from PySide6.QtGui import QColor
from PySide6.QtWidgets import (
    QCheckBox,
    QColorDialog,
    QComboBox,
    QDialog,
    QFileDialog,
    QFormLayout,
    QLabel,
    QPushButton,
    QWidget,
)

from app.editing.settings import SETTINGS, Settings
from app.view.theme import NORMAL, WIDE
from app.window.dialogs.questions import Dialog
from app.window.widgets import NumberBox, labelled, push_button, swatch_icon
from lcollision_core.files.formats import FILES, WRITABLE_SUFFIXES
from lcollision_core.options import ExportRequest, PrintOptions
from lcollision_core.tasks.words import menu_text

if TYPE_CHECKING:
    from app.editing.timeline import Timeline
    from lcollision_core.bodies import Body, ExportForm


_WIDTH, _BORDER = 400, WIDE + 4


class ColourButton(QPushButton):
    """A button that shows a colour, and asks for another when pressed.

    Parameters
    ----------
    colour : "#rrggbb"; anything else is white
    title : of the colour dialog
    """

    def __init__(self, colour: str, title: str) -> None:
        super().__init__()
        self._title = title
        # An auto-default button would be pressed by Enter.
        self.setAutoDefault(False)
        self.setStyleSheet("text-align: left;")
        self._show(QColor(colour) if QColor(colour).isValid() else QColor("#ffffff"))
        self.clicked.connect(self._ask)

    @Slot()
    def _ask(self) -> None:
        colour = QColorDialog.getColor(QColor(self.text()), self, self._title)
        if colour.isValid():
            self._show(colour)

    def _show(self, colour: QColor) -> None:
        self.setIcon(swatch_icon(colour.name(), self.iconSize().height(), self.devicePixelRatioF()))
        self.setText(colour.name())


class Form(Dialog):
    """A dialog of fields that show settings and write them back when accepted.

    Parameters
    ----------
    title : of the dialog
    action : text of the button that accepts
    settings : read and written
    parent : window of the dialog
    """

    def __init__(self, title: str, action: str, settings: Settings, parent: QWidget) -> None:
        super().__init__(title, parent)
        self.setFixedWidth(_WIDTH)
        self._settings = settings
        self._refused = False
        self._fields: dict[str, QWidget] = {}
        self._readers: dict[str, Callable[[], Any]] = {}
        self._form = QFormLayout(horizontalSpacing=WIDE, verticalSpacing=NORMAL)
        self._refusal = labelled("", "refusal", wraps=True)
        self._refusal.hide()
        self.lay_out(self._form, self._refusal, accept=action)

    def accept(self) -> None:
        """Store the fields and close, unless a value has just been refused."""
        for field in self._fields.values():
            if isinstance(field, NumberBox):
                field.interpretText()
        if self._refused:
            self._refused = False
            return
        for key, read in self._readers.items():
            self._settings[key] = read()
        super().accept()

    def add_number(
        self,
        key: str,
        label: str,
        suffix: str = "",
        step: float = 1.0,
        tip: str = "",
        decimals: int = 0,
        strip_zeros: bool = False,
    ) -> NumberBox:
        """Add a field for a number, by default an integer; see `NumberBox`."""
        setting = SETTINGS[key]
        field = NumberBox(
            decimals, setting.low or 0.0, setting.high or 0.0, strip_zeros=strip_zeros
        )
        field.setSingleStep(step)
        field.setSuffix(suffix)
        field.setValue(self._settings[key])
        field.refused.connect(lambda sentence: self._on_refused(label, sentence))
        field.lineEdit().textEdited.connect(self._on_edited)
        self._add(key, label, field, field.value, tip)
        return field

    def add_choice(self, key: str, label: str, names: dict[str, str], tip: str) -> QComboBox:
        """Add a field for one of several values, by their names."""
        field = QComboBox()
        for value, name in names.items():
            field.addItem(name, value)
        # The remembered value may not be offered now.
        field.setCurrentIndex(max(0, field.findData(self._settings[key])))
        self._add(key, label, field, field.currentData, tip)
        return field

    def add_check(self, key: str, label: str, tip: str = "") -> QCheckBox:
        """Add a check box."""
        field = QCheckBox(label)
        field.setChecked(self._settings[key])
        self._add(key, "", field, field.isChecked, tip)
        return field

    def add_colour(self, key: str, label: str) -> ColourButton:
        """Add a button that shows a colour and asks for another."""
        field = ColourButton(self._settings[key], label)
        self._add(key, label, field, field.text)
        return field

    def add_widget(self, label: str, widget: QWidget) -> None:
        """Add a widget without a setting."""
        self._form.addRow(label, widget)

    def add_note(self, text: str) -> QLabel:
        """Add some lines of explanation."""
        note = labelled("", "caption", wraps=True)
        self._form.addRow(note)
        self.explain(note, text)
        return note

    def explain(self, note: QLabel, text: str) -> None:
        """Set the text of a note, and reserve the height that it needs."""
        note.setText(text)
        # A form layout reserves one line for a wrapped label, however narrow.
        note.setFixedHeight(max(0, note.heightForWidth(_WIDTH - 2 * _BORDER)))
        self.adjustSize()

    def _add(
        self, key: str, label: str, field: QWidget, read: Callable[[], Any], tip: str = ""
    ) -> None:
        field.setToolTip(tip)
        self._fields[key], self._readers[key] = field, read
        self._form.addRow(label, field)

    def _on_refused(self, label: str, sentence: str) -> None:
        self._refused = True
        self._refusal.setText(f"{label}: {sentence}")
        self._refusal.show()

    @Slot()
    def _on_edited(self) -> None:
        self._refused = False
        self._refusal.hide()


def screenshot_form(settings: Settings, parent: QWidget) -> Form:
    """Return the form for the size and background of a screenshot."""
    form = Form("Screenshot", "Choose file…", settings, parent)
    form.add_number("screenshot_width", "Width", " px")
    form.add_number("screenshot_height", "Height", " px")
    form.add_check("screenshot_transparent", "Transparent background")
    return form


def video_form(settings: Settings, parent: QWidget, of_motion: bool = False) -> Form:
    """Return the form for duration, size, background and format of a turntable.

    For a motion's video, the duration is that of the motion.
    """
    from app.view.offscreen import FASTEST_GIF

    title = "Video of the motion" if of_motion else "Turntable"
    form = Form(title, "Choose file…", settings, parent)
    formats = {"gif": "GIF", "webp": "WebP", "png": "PNG sequence"}
    kind = form.add_choice("turntable_format", "Format", formats, "What is written")
    if not of_motion:
        form.add_number("turntable_seconds", "Duration", " s", 0.5, decimals=1)
    rate = form.add_number("turntable_rate", "Frames per second")
    form.add_number("turntable_width", "Width", " px")
    form.add_number("turntable_height", "Height", " px")
    backgrounds = {"shown": "As shown", "plain": "One colour", "transparent": "Transparent"}
    behind = form.add_choice(
        "turntable_background", "Background", backgrounds, "What is shown behind the body"
    )
    colour = form.add_colour("turntable_colour", "Colour")
    note = form.add_note("")
    most = rate.maximum()
    meanings = {
        "gif": f"256 colours, at most {FASTEST_GIF} frames per second, never transparent.",
        "webp": "All colours, smaller than a GIF.",
        "png": "Numbered images in a new folder, for example to make an MP4.",
    }

    def follow() -> None:
        is_gif = kind.currentData() == "gif"
        rate.setMaximum(FASTEST_GIF if is_gif else most)
        index = list(backgrounds).index("transparent")
        behind.setItemData(index, 0 if is_gif else None, Qt.ItemDataRole.UserRole - 1)
        if is_gif and behind.currentIndex() == index:
            behind.setCurrentIndex(0)
        what = "One full turn, current shading."
        if of_motion:
            what = "From in to out point, current shading."
        form.explain(note, f"{what} {meanings[kind.currentData()]}")

    def show_colour() -> None:
        colour.setEnabled(behind.currentData() == "plain")

    follow()
    show_colour()
    kind.currentIndexChanged.connect(follow)
    behind.currentIndexChanged.connect(show_colour)
    return form


def resolve_form(settings: Settings, parent: QWidget, has_predictor: bool = True) -> Form:
    """Return the form for the options of Resolve; the threshold only with a predictor."""
    form = Form("Resolve options", "OK", settings, parent)
    metrics = {"vertices": "the look of the pose", "latent": "the slider values"}
    tip = "What Resolve tries to change as little as possible"
    form.add_choice("resolve_metric", "Keep close to", metrics, tip)
    if has_predictor:
        tip = (
            "Below this probability the estimate calls a pose clear; lower is safer but moves "
            "the pose more"
        )
        label = "Decision threshold"
        form.add_number("resolve_threshold", label, "", 0.05, tip, decimals=2)
    tip = (
        "The most that any point may move, in per cent of the body size; if no collision-free pose "
        "is that near, Resolve settles for the least overlap"
    )
    largest = form.add_number("resolve_largest_change", "Largest change", " %", 0.5, tip, 2, True)
    largest.setSpecialValueText("any")
    tip = "After this time Resolve falls back to a known pose without collisions"
    form.add_number("resolve_time_budget", "Time limit", " s", 1.0, tip, decimals=1)
    form.add_note("The exact check decides in any case.")
    return form


def print_form(settings: Settings, parent: QWidget) -> Form:
    """Return the form for the options of an export for 3D printing; see `print_options`."""
    form = Form("Export for 3D printing", "Choose file…", settings, parent)
    tip = "Of the figure, without its base"
    form.add_number("print_height", "Height", " mm", 10.0, tip, 1, strip_zeros=True)
    tip = "Open layers are made this thick; thinner walls of closed parts are reported"
    form.add_number("print_wall", "Least wall", " mm", 0.1, tip, 2, strip_zeros=True)
    ways = {
        "auto": "Close hulls, thicken sheets",
        "close": "Close their holes",
        "thicken": "Thicken them",
    }
    tip = "What is done with meshes that have holes, as clothes and hair"
    form.add_choice("print_open_layers", "Open layers", ways, tip)
    tip = "Loose parts are joined by pins across gaps up to this"
    form.add_number("print_join", "Join across", " mm", 0.5, tip, 1, strip_zeros=True)
    tip = "Thickness of a round plate under the figure"
    base = form.add_number("print_base", "Base", " mm", 0.5, tip, 1, strip_zeros=True)
    base.setSpecialValueText("none")
    form.add_check("print_resolve", "Resolve the pose first")
    form.add_note("One closed solid in millimetres, z up. Hidden meshes are left out.")
    return form


def print_options(settings: Settings, left_out: tuple[str, ...]) -> PrintOptions:
    """Return the options stored by `print_form`, without the meshes in `left_out`."""
    names = "height", "wall", "open_layers", "join", "resolve"
    values = {name: settings[f"print_{name}"] for name in names}
    return PrintOptions(**values, base=settings["print_base"] or None, without=left_out)


EXPORT_NAMES = {
    "model": "Same as the model",
    "y-up": "Y up",
    "blender": "Blender",
    "maya": "Maya",
    "unreal": "Unreal",
}
"""Names of the export axes, by `ExportAxes`."""

CLIP = "clip"
"""The form of a motion in the character's own file."""

MESH = "mesh-alone"
"""The form of a plain mesh, not based on a source file."""

_MESHES = {FILES[name].label: name for name in WRITABLE_SUFFIXES if FILES[name].is_offered}
_FOLLOWS = (
    "OBJ: with UVs, normals, meshes as groups and names of materials, where the body came with "
    "them. PLY and STL: faces and positions alone."
)
_STAY = "Axes and unit stay as in that file."


class _FrameForm(Form):
    """A form with fields for the axes and the scale of a file."""

    def _add_frame(self, model: Body) -> tuple[QComboBox, NumberBox]:
        """Add the fields; the scale is stored relative to that of the axes."""
        from lcollision_core.bodies import export_scale

        axes = self.add_choice("export_axes", "Axes", EXPORT_NAMES, "Which way is up in the file")
        tip = "File units per model unit"
        scale = self.add_number("export_rescale", "Scale by", "", 1.0, tip, 6)
        # Let the arrows step adaptively: six decimals are only for typing.
        scale.setStepType(NumberBox.StepType.AdaptiveDecimalStepType)
        scale.setValue(scale.value() * export_scale(model, axes.currentData()))
        self._readers["export_rescale"] = lambda: (
            scale.value() / export_scale(model, axes.currentData())
        )
        axes.currentIndexChanged.connect(
            lambda: scale.setValue(export_scale(model, axes.currentData()))
        )
        return axes, scale


class ExportDialog(_FrameForm):
    """Ask for the export form, the axes and the unit of a pose.

    Parameters
    ----------
    settings, parent : see `Form`
    model : of the pose; a character offers the forms of its own file

    Attributes
    ----------
    form, axes : fields
    source : button that asks for a source file; missing for a character, which has its own
    like : that file, at first the one that the model was learned from; None for none
    keep_clips : box that keeps a character's clips beside the pose; None without clips
    """

    def __init__(self, settings: Settings, parent: QWidget, model: Body) -> None:
        from lcollision_core.bodies import own_source

        super().__init__("Export mesh", "Choose file…", settings, parent)
        self._meanings = _meanings(model)
        self._own = own_source(model)
        self._character = None if model.character is None else self._own
        self.like = self._own if model.character is None else None
        self._forms: dict[str, ExportForm] = {}
        if self._character is None:
            tip = "Your OBJ or GLB file of this body, whose UVs and groups are kept"
            self.source = push_button("", tip, self._ask_for_source)
            self.add_widget("Write into a copy of", self.source)
        self.form = self.add_choice("export_form", "Format", {MESH: "Mesh"}, "What is written")
        self._readers["export_form"] = self._remembered_form
        self.keep_clips: QCheckBox | None = None
        if model.own_clips:
            tip = "Keep the clips too; the joints then hold the pose"
            self.keep_clips = self.add_check("export_keep_clips", "Keep clips", tip)
            self.keep_clips.toggled.connect(self._explain)
        self.axes, self._scale = self._add_frame(model)
        self._about, self._meaning = self.add_note(""), self.add_note("")
        self._offer()
        for choice in (self.form, self.axes):
            choice.currentIndexChanged.connect(self._explain)

    @property
    def kinds(self) -> dict[str, str]:
        """File extensions of the chosen form, by name."""
        from lcollision_core.bodies import offered_forms

        form = self._forms.get(self.form.currentData())
        if form is not None:
            return {form.suffix.removeprefix(".").upper(): form.suffix}
        # Without a form, leave out formats that the body's own file already offers as forms.
        is_own = self._character is not None
        own_forms = () if self._own is None else offered_forms(self._own, has_rig=is_own)
        own_suffixes = {offered.suffix for offered in own_forms}
        return {kind: suffix for kind, suffix in _MESHES.items() if suffix not in own_suffixes}

    @property
    def export_request(self) -> ExportRequest:
        """The export options in the fields."""
        form = self._forms.get(self.form.currentData())
        key = None if form is None else form.key
        like = None if form is None else self.like
        box = self.keep_clips
        keeps = box is not None and box.isEnabled() and box.isChecked()
        axes, scale = self.axes.currentData(), self._scale.value()
        return ExportRequest(axes, scale, like, key, keep_clips=keeps)

    @Slot()
    def _ask_for_source(self) -> None:
        from lcollision_core.bodies import EXPORT_FORMS

        suffixes = dict.fromkeys(suffix for form in EXPORT_FORMS for suffix in form.of_sources)
        masks = " ".join(f"*{suffix}" for suffix in suffixes)
        folder = self._settings["last_folder"]
        name, _ = QFileDialog.getOpenFileName(
            self, "Write into a copy of", folder, f"Files of this body ({masks})"
        )
        self.like = Path(name) if name else None
        self._offer()

    def _offer(self) -> None:
        """List the forms of the source file, the best first, and the plain mesh."""
        from lcollision_core.bodies import offered_forms

        source = self._character or self.like
        has_rig = self._character is not None
        if not has_rig:
            self.source.setText(
                menu_text(self.like.name) if self.like else "No file (a plain mesh)"
            )
        offered = offered_forms(source, has_rig=has_rig) if source is not None else ()
        self._forms = {form.key: form for form in offered if not form.is_sequence}
        remembered = self._settings["export_form"]
        self.form.clear()
        for key, form in self._forms.items():
            self.form.addItem(form.label, key)
        self.form.addItem("Mesh", MESH)
        self.form.setCurrentIndex(max(0, self.form.findData(remembered)))
        self.form.setEnabled(bool(self._forms))
        self._explain()

    def _remembered_form(self) -> str:
        """Return the chosen form, or the remembered one if there was no choice."""
        form: str = self.form.currentData() if self._forms else self._settings["export_form"]
        return form

    @Slot()
    def _explain(self) -> None:
        form = self._forms.get(self.form.currentData())
        has_axes = form is None or form.has_axes
        self.axes.setEnabled(has_axes)
        self._scale.setEnabled(has_axes)
        about = _GLB if ".glb" in self.kinds.values() else _FOLLOWS
        back = _back_as(self._character or self.like, form)
        if form is not None:
            about = form.explanation + back
        if self.keep_clips is not None:
            self.keep_clips.setEnabled(form is not None and form.needs_rig)
            if self.keep_clips.isEnabled():
                about += _CLIPS_KEPT if self.keep_clips.isChecked() else _CLIPS_LEFT
        self.explain(self._about, about)
        meaning = self._meanings[self.axes.currentData()]
        self.explain(self._meaning, meaning if has_axes else _GLB if back else _STAY)


class SceneExportDialog(_FrameForm):
    """Ask for the format, the axes and the unit of the files of a scene's bodies.

    Parameters
    ----------
    settings, parent : see `Form`
    scene : of the pose
    """

    def __init__(self, settings: Settings, parent: QWidget, scene: Body) -> None:
        super().__init__("Export each body", "Choose folder…", settings, parent)
        formats = {suffix.removeprefix("."): name for name, suffix in _MESHES.items()}
        formats = {"own": "The body's own file", **formats}
        self.form = self.add_choice("scene_form", "Format", formats, "What is written of each body")
        self.axes, self._scale = self._add_frame(scene)
        self._about = self.add_note("")
        self.form.currentIndexChanged.connect(self._explain)
        self._explain()

    @property
    def export_request(self) -> ExportRequest:
        """The export options in the fields."""
        form = self.form.currentData()
        if form == "own":
            return ExportRequest()
        return ExportRequest(self.axes.currentData(), self._scale.value(), mesh_format=form)

    @Slot()
    def _explain(self) -> None:
        form = self.form.currentData()
        for field in (self.axes, self._scale):
            field.setEnabled(form not in ("own", "glb"))
        own = "Each file keeps its textures, rig, axes and unit."
        about = own if form == "own" else _GLB if form == "glb" else _FOLLOWS
        self.explain(self._about, about)


class MotionDialog(_FrameForm):
    """Ask for the export form, the frame rate, the axes and the unit of frames.

    Parameters
    ----------
    settings, parent : see `Form`
    model : of the poses; a character's may be written into its own file
    rate : frames per second of the motion, None for poses that are not a motion
    timeline : whose motion is written, instead of poses

    Attributes
    ----------
    form, rate, axes, range : fields; the range only for a timeline's motion
    """

    def __init__(
        self,
        settings: Settings,
        parent: QWidget,
        model: Body,
        rate: float | None = None,
        timeline: Timeline | None = None,
    ) -> None:
        from lcollision_core.bodies import offered_forms

        super().__init__("Export motion", "Choose file…", settings, parent)
        self._meanings = _meanings(model)
        self._source = source = model.own_file
        offered = offered_forms(source, has_rig=source is not None)
        self._forms = {form.key: form for form in offered if form.is_sequence}
        names = {key: form.label for key, form in self._forms.items()}
        self.form = self.add_choice("motion_form", "Format", names, "What is written")
        remembered, own = self._settings["motion_form"], ""
        if timeline is not None and timeline.file is not None and not timeline.is_of_character:
            own = timeline.file.suffix.lower().removeprefix(".")
        if own in names and remembered == CLIP:
            # By default, write a motion of another skeleton in its own file format.
            self.form.setCurrentIndex(self.form.findData(own))
        if remembered not in names or self.form.currentData() != remembered:
            # Keep the remembered form if it is not offered, or not the one preselected.
            del self._readers["motion_form"]
        tip = "One pose is one frame"
        self.rate = self.add_number(
            "export_rate", "Frames per second", "", 1.0, tip, 3, strip_zeros=True
        )
        if rate is not None:
            self.rate.setValue(rate)
            self._readers["export_rate"] = self._remembered_rate
            own = self.rate.textFromValue(rate)
            self.add_note(f"The clip's own rate is {own} frames per second.")
        self._own_rate = None if rate is None else self.rate.value()
        self._timeline, self.range = timeline, QComboBox()
        if timeline is not None and timeline.motion is not None:
            self.range.addItem(f"All {len(timeline.motion)} frames", range(len(timeline.motion)))
            points = range(timeline.first, timeline.last + 1)
            if len(points) < len(timeline.motion):
                self.range.addItem(f"Frames {points.start} to {points.stop - 1}", points)
            self.add_widget("Frames", self.range)
        self.axes, self._scale = self._add_frame(model)
        self._about, self._meaning = self.add_note(""), self.add_note("")
        for choice in (self.form, self.axes):
            choice.currentIndexChanged.connect(self._explain)
        self._explain()

    @property
    def kinds(self) -> dict[str, str]:
        """File extension of the chosen form, by name."""
        suffix = self._forms[self.form.currentData()].suffix
        return {suffix.removeprefix(".").upper(): suffix}

    @property
    def is_clip(self) -> bool:
        """Whether the motion is written into its source file, which keeps its frames and axes."""
        form, timeline = self._forms[self.form.currentData()], self._timeline
        if timeline is None or timeline.file is None:
            return False
        if form.key == CLIP:
            # Only a character's own motion changes its clip; another becomes a new clip.
            return timeline.is_of_character
        return form.suffix == timeline.file.suffix.lower() == ".bvh"

    @property
    def frames(self) -> range:
        """The frames of a timeline's motion to write."""
        frames: range = self.range.currentData()
        return frames

    @property
    def export_request(self) -> ExportRequest:
        """The export options in the fields."""
        return ExportRequest(self.axes.currentData(), self._scale.value(), fps=self.rate.value())

    def _remembered_rate(self) -> float:
        """Return the rate to remember: the clip's own rate does not replace the stored one."""
        rate = self.rate.value()
        return float(self._settings["export_rate"]) if rate == self._own_rate else rate

    @Slot()
    def _explain(self) -> None:
        form = self._forms[self.form.currentData()]
        for field in (self.axes, self._scale):
            field.setEnabled(form.has_axes)
        for field in (self.rate, self.range) if self._timeline is not None else ():
            field.setEnabled(not self.is_clip)
        if self._timeline is not None and self.is_clip:
            back, about = _back_as(self._timeline.file, form), _CLIP if form.key == CLIP else _OWN
            self.explain(self._about, f"{about} Each frame is checked.{back}")
            self.explain(self._meaning, _GLB if back else _STAY)
            return
        order = " It has your mesh's vertex order: keep it beside the mesh." * form.has_axes
        back = _back_as(self._source, form)
        self.explain(self._about, f"{form.explanation}{order} Each frame is checked.{back}")
        meaning = _SKELETONS.get(form.key) or (_GLB if back else _STAY)
        if form.has_axes:
            meaning = self._meanings[self.axes.currentData()]
        self.explain(self._meaning, meaning)


_SKELETONS = {
    "bvh": "y is up, front is +z, in the unit of the character.",
    "vrma": "y is up, front is +z, in metres, as VRM requires. Fingers are written where the "
    "character has those of VRM; its face is not.",
}
_CLIP = (
    "Your own file with its clip changed where the motion was: the other clips, and the keys of "
    "untouched frames, stay as they are."
)
_OWN = (
    "Your own file with new rotations where the motion was changed; everything else is unchanged."
)
_CLIPS_LEFT = " Its clips are left out: a playing clip would hide the pose."
_CLIPS_KEPT = " Its clips stay; programs that play a clip on opening show that first."
_GLB = "A GLB file is always y up and in metres, as its standard requires."


def _back_as(source: Path | None, form: ExportForm | None) -> str:
    """Return a note if an FBX source file is written as GLB, else ""."""
    if source is None or form is None or form.suffix != ".glb" or source.suffix.lower() != ".fbx":
        return ""
    return (
        " FBX can't be written: this is a GLB with its meshes, joints, base colours and textures."
    )


def run_form(form: QDialog) -> bool:
    """Show a form until it is closed; return whether it was accepted.

    The form is deleted once the caller returns to the event loop; read its fields before.
    """
    is_accepted = form.exec() == QDialog.DialogCode.Accepted
    form.deleteLater()
    return is_accepted


def _meanings(model: Body) -> dict[str, str]:
    """Return explanations of the axis presets for a body."""
    from lcollision_core.bodies import ExportAxes

    looks = int(abs(model.front).argmax())
    sign = "-" if model.front[looks] < 0.0 else "+"
    up = ("-" if min(model.up) < 0.0 else "") + "xyz"[model.up_axis]
    model_axes = f"{up} is up, front is {sign}{'xyz'[looks]}"
    return {
        ExportAxes.MODEL: f"Same as the model: {model_axes}.",
        ExportAxes.Y_UP: "y is up, front is +z, in the model's unit.",
        ExportAxes.BLENDER: "Upright and facing you in Blender's front view, with its "
        "importers' default settings, in metres.",
        ExportAxes.MAYA: "y is up, front is +z, in centimetres.",
        ExportAxes.UNREAL: "z is up, front is +x once imported, in centimetres.",
    }
