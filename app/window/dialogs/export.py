"""What a pose is exported as: the user's own file in one of its forms, or a mesh; axes and unit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtCore import Slot
from PySide6.QtWidgets import QCheckBox, QComboBox, QFileDialog, QPushButton, QWidget

from app.editing.settings import Settings
from app.window.dialogs.forms import Form
from app.window.widgets import NumberBox
from lcollision_core.files.table import MESH_FORMATS
from lcollision_core.options import ExportRequest
from lcollision_core.tasks.words import menu_text

if TYPE_CHECKING:
    from app.editing.timeline import Timeline
    from lcollision_core.bodies import Body, ExportForm

EXPORT_NAMES = {
    "model": "Same as the model",
    "y-up": "Y up",
    "blender": "Blender",
    "maya": "Maya",
    "unreal": "Unreal",
}
"""Names of the export's axes, by `ExportAxes`."""

CLIP = "clip"
"""The form of a motion in the character's own file."""

MESH = "mesh-alone"
"""The form of a mesh of the body's own: no file of the user's is kept."""

_MESHES = {name.upper(): f".{name}" for name, held in MESH_FORMATS.items() if held.is_offered}
_FOLLOWS = (
    "OBJ: with UVs, normals, meshes as groups and names of materials, where the body came with "
    "them. PLY and STL: faces and positions alone."
)
_STAY = "Axes and unit stay as in that file."


class _FrameForm(Form):
    """A form with the axes and the unit of a file."""

    def _add_frame(self, model: Body) -> tuple[QComboBox, NumberBox]:
        """Add their fields; the unit is remembered relative to that of the axes."""
        from lcollision_core.bodies import export_scale

        axes = self.add_choice("export_axes", "Axes", EXPORT_NAMES, "Which way is up in the file")
        tip = "File units per model unit"
        scale = self.add_number("export_rescale", "Scale by", "", 1.0, tip, 6)
        # Six decimals are for those who type them.
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
    """Asks for the form, the axes and the unit of a pose to write.

    Parameters
    ----------
    settings, parent : see `Form`
    model : of the pose; a character offers the forms of its own file

    Attributes
    ----------
    form, axes : fields
    source : the button that asks for a file of the user's; not of a character, which has its own
    like : that file, at first the one that the model was learned from; None for none
    keep_clips : whether a character's clips stay beside the pose; None of one without clips
    """

    def __init__(self, settings: Settings, parent: QWidget, model: Body) -> None:
        from lcollision_core.bodies import RigBody, own_source

        super().__init__("Export mesh", "Choose file…", settings, parent)
        self._meanings = _meanings(model)
        self._own = own_source(model)
        self._character = self._own if isinstance(model, RigBody) else None
        self.like = None if isinstance(model, RigBody) else self._own
        self._forms: dict[str, ExportForm] = {}
        if self._character is None:
            self.source = QPushButton()
            self.source.setAutoDefault(False)
            self.source.setToolTip(
                "Your OBJ or GLB file of this body, whose UVs and groups are kept"
            )
            self.source.clicked.connect(self._ask_for_source)
            self.add_widget("Write into a copy of", self.source)
        self.form = self.add_choice("export_form", "Format", {MESH: "Mesh"}, "What is written")
        self._readers["export_form"] = self._remembered_form
        self.keep_clips: QCheckBox | None = None
        if isinstance(model, RigBody) and model.character.clips:
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
        """The file formats of the chosen form, extensions by name."""
        from lcollision_core.bodies import offered_forms

        form = self._forms.get(self.form.currentData())
        if form is not None:
            return {form.suffix.removeprefix(".").upper(): form.suffix}
        # Without a form, the file that the body came from is kept where it has the extension.
        is_own = self._character is not None
        own = () if self._own is None else offered_forms(self._own, has_rig=is_own)
        taken = {offered.suffix for offered in own}
        return {kind: suffix for kind, suffix in _MESHES.items() if suffix not in taken}

    @property
    def export_request(self) -> ExportRequest:
        """What the fields say."""
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
        """List the forms of the user's file, the best first, and the mesh alone."""
        from lcollision_core.bodies import offered_forms

        source = self._character or self.like
        has_rig = self._character is not None
        if not has_rig:
            self.source.setText(
                menu_text(self.like.name) if self.like else "No file (a plain mesh)"
            )
        offered = offered_forms(source, has_rig=has_rig) if source is not None else ()
        self._forms = {form.key: form for form in offered if not form.is_sequence}
        wanted = self._settings["export_form"]
        self.form.clear()
        for key, form in self._forms.items():
            self.form.addItem(form.label, key)
        self.form.addItem("Mesh", MESH)
        self.form.setCurrentIndex(max(0, self.form.findData(wanted)))
        self.form.setEnabled(bool(self._forms))
        self._explain()

    def _remembered_form(self) -> str:
        """Return the form that was chosen, where there was a choice."""
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


class MotionDialog(_FrameForm):
    """Asks for the form, the frame rate, the axes and the unit of poses to write as frames.

    Parameters
    ----------
    settings, parent : see `Form`
    model : of the poses; those of a character may go into its own file
    rate : frames a second that the poses came from, None if they are no motion's
    timeline : whose motion is written, instead of poses

    Attributes
    ----------
    form, rate, axes, range : fields; a range only of a timeline's motion
    """

    def __init__(
        self,
        settings: Settings,
        parent: QWidget,
        model: Body,
        rate: float | None = None,
        timeline: Timeline | None = None,
    ) -> None:
        from lcollision_core.bodies import RigBody, offered_forms

        super().__init__("Export motion", "Choose file…", settings, parent)
        self._meanings = _meanings(model)
        self._source = source = model.character.source if isinstance(model, RigBody) else None
        offered = offered_forms(source, has_rig=source is not None)
        # A clip goes back into the file that it is from.
        has_file = timeline is None or timeline.is_of_character
        self._forms = {
            form.key: form
            for form in offered
            if form.is_sequence and (has_file or form.key != CLIP)
        }
        names = {key: form.label for key, form in self._forms.items()}
        self.form = self.add_choice("motion_form", "Format", names, "What is written")
        if self._settings["motion_form"] not in names:
            # What is not offered now stays remembered.
            del self._readers["motion_form"]
        tip = "One pose is one frame"
        self.rate = self.add_number("export_rate", "Frames per second", "", 1.0, tip, 3, trims=True)
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
        """The file format of the chosen form, extension by name."""
        suffix = self._forms[self.form.currentData()].suffix
        return {suffix.removeprefix(".").upper(): suffix}

    @property
    def is_clip(self) -> bool:
        """Whether the motion goes back into its own file, which has its own frames and axes."""
        form, timeline = self._forms[self.form.currentData()], self._timeline
        if timeline is None or timeline.file is None:
            return False
        return form.key == CLIP or form.suffix == timeline.file.suffix.lower() == ".bvh"

    @property
    def frames(self) -> range:
        """The frames of a timeline's motion to write."""
        chosen: range = self.range.currentData()
        return chosen

    @property
    def export_request(self) -> ExportRequest:
        """What the fields say."""
        return ExportRequest(self.axes.currentData(), self._scale.value(), fps=self.rate.value())

    def _remembered_rate(self) -> float:
        """Return the rate for poses of no motion, which that of a clip does not change."""
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
_OWN = "Your own file with other turns where the motion was changed; all else stays as it is."
_CLIPS_LEFT = " Its clips are left out, as they would hide the pose."
_CLIPS_KEPT = " Its clips stay; programs that play a clip on opening show that first."
_GLB = "A GLB file is always y up and in metres, as its standard requires."


def _back_as(source: Path | None, form: ExportForm | None) -> str:
    """Say it where a file comes back in another format than its own; "" where it does not."""
    if source is None or form is None or form.suffix != ".glb" or source.suffix.lower() != ".fbx":
        return ""
    return (
        " FBX can't be written: this is a GLB with its meshes, joints, base colours and textures."
    )


def _meanings(model: Body) -> dict[str, str]:
    """Say what the presets of axes mean for a body."""
    from lcollision_core.bodies import ExportAxes

    looks = int(abs(model.front).argmax())
    sign = "-" if model.front[looks] < 0.0 else "+"
    own = f"{'xyz'[model.up_axis]} is up, front is {sign}{'xyz'[looks]}"
    return {
        ExportAxes.MODEL: f"Same as the model: {own}.",
        ExportAxes.Y_UP: "y is up, front is +z, in the model's unit.",
        ExportAxes.BLENDER: "Upright and facing you in Blender's front view, with its "
        "importers' default settings, in metres.",
        ExportAxes.MAYA: "y is up, front is +z, in centimetres.",
        ExportAxes.UNREAL: "z is up, front is +x once imported, in centimetres.",
    }
