# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel in the 3D view's sidebar, and its settings, stored in scenes."""

import json

import blf
import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from . import live, results
from .operators import counted
from .scene import HIDDEN, OFF_RIG, Rigged, SceneError

_NOT_CHECKED = "Not checked yet"

_WIDTH, _MARGINS, _ICON = 220.0, 56.0, 20.0
"""Widths in pixels: Blender's initial sidebar, the margins around text in it, and an icon."""


class LCOLLISION_PG_group(bpy.types.PropertyGroup):
    """A group of faces that pairs may be ignored of: a mesh, a material, a body part."""


class LCOLLISION_PG_pair(bpy.types.PropertyGroup):
    """Two groups whose pairs do not count."""

    first: StringProperty()
    second: StringProperty()


class LCOLLISION_PG_frame(bpy.types.PropertyGroup):
    """A frame of the action that collides."""

    frame: IntProperty()
    pairs: IntProperty()
    deepest: FloatProperty()
    parts: StringProperty()
    why: StringProperty(description="Why it could not be resolved")


class LCOLLISION_PG_settings(bpy.types.PropertyGroup):
    """The panel's settings, and what was found last."""

    looks: BoolProperty(description="Whether the live check was on, as files keep it")
    live: BoolProperty(
        name="Live Check",
        description="Check the pose whenever it changes",
        get=lambda self: live.is_on(),
        set=lambda self, is_on: self.switch(is_on),
    )
    keep_feet: BoolProperty(
        name="Keep Feet",
        description="Feet stay where they stand on the ground",
        default=True,
    )
    only_selected: BoolProperty(
        name="Only Selected Bones",
        description="Resolve turns no other bones than the selected ones that deform",
    )
    use_range: BoolProperty(
        name="Frame Range",
        description="Only check and resolve these frames",
    )
    first_frame: IntProperty(name="Start", default=1)
    last_frame: IntProperty(name="End", default=250)
    tolerated: FloatProperty(
        name="Tolerated",
        description="Pairs of faces up to this deep, in % of the body size, do not count",
        min=0.0,
        max=10.0,
        precision=2,
        subtype="PERCENTAGE",
    )
    clearance: FloatProperty(
        name="Clearance",
        description="Distance to keep between parts; if near at rest, half their rest distance",
        min=0.0,
        precision=4,
        subtype="DISTANCE",
    )
    cloth_gap: FloatProperty(
        name="Contact Gap",
        description="Distance that parts keep: the solver's contact gap, more where cloth lies "
        "between them",
        default=0.003,
        min=0.0,
        precision=4,
        subtype="DISTANCE",
    )
    cloth_subframes: IntProperty(
        name="Subframes",
        description="Poses between two frames that are checked too",
        default=1,
        min=0,
        max=15,
    )
    cloth_output: EnumProperty(
        name="Output",
        items=(
            ("ACTION", "Action", "A copy of the action"),
            ("CACHE", "Mesh Cache", "That, and a point cache of each mesh as it is shown (PC2)"),
        ),
    )
    cloth_folder: StringProperty(
        name="Folder", description="Where caches are written", default="//", subtype="DIR_PATH"
    )
    ignored: CollectionProperty(type=LCOLLISION_PG_pair)
    places: StringProperty(description="Places that do not count, as JSON")
    proposal: StringProperty(description="Places that are proposed not to count, as JSON")
    proposed: StringProperty(description="What they would change")
    first: StringProperty(name="", description="A mesh, material, vertex group or body part")
    second: StringProperty(name="", description="Its pairs with the first group do not count")
    groups: CollectionProperty(type=LCOLLISION_PG_group)
    left_out: StringProperty()
    verdict: StringProperty(default=_NOT_CHECKED)
    is_of_pose: BoolProperty(description="Whether the verdict is of a pose")
    of: StringProperty(description="The armature that the verdict and the frames are of")
    details: StringProperty()
    rules: StringProperty()
    off_rig: FloatProperty()
    frames: CollectionProperty(type=LCOLLISION_PG_frame)
    frame: IntProperty(name="Colliding Frame", update=lambda self, context: self.jump(context))

    def jump(self, context: bpy.types.Context) -> None:
        """Go to the frame chosen in the list."""
        if 0 <= self.frame < len(self.frames):
            context.scene.frame_set(self.frames[self.frame].frame)

    def switch(self, is_on: bool) -> None:
        """Turn the live check on or off, for all scenes."""
        for scene in bpy.data.scenes:
            scene.lcollision.looks = is_on
        live.switch(is_on)

    def chosen_rules(self, rigged: Rigged) -> dict:
        """Return the rules that are not the character's own."""
        rules: dict = {}
        if len(self.ignored):
            rules["ignored"] = [(pair.first, pair.second) for pair in self.ignored]
        if self.tolerated:
            rules["tolerated_depth"] = self.tolerated / 100.0
        places = json.loads(self.places or "{}")
        # Places are face numbers, valid only for this mesh.
        if places.pop("of", "") == repr(rigged.key()):
            rules |= places
        return rules

    def kept(self) -> str:
        """Return the verdict on a free pose."""
        return "The clearance is kept" if self.clearance else "No collisions"

    def checked(self) -> str:
        """Return how much of the character was checked."""
        n = len(self.left_out.split("\n")) if self.left_out else 0
        return f"checked without {n} mesh{'es' if n > 1 else ''}" if n else "checked"

    def forget(self) -> None:
        """Withdraw the verdict."""
        self.verdict, self.details, self.off_rig = _NOT_CHECKED, "", 0.0
        self.is_of_pose, self.left_out = False, ""

    def show(self, reply: dict, armature: str) -> None:
        """Show the result of a check of a pose."""
        self.is_of_pose, self.of = True, armature
        self.off_rig = reply["off_rig"]
        if not reply["colliding"]:
            self.verdict = f"{self.kept()} ({self.checked()})"
            self.details = reply["not_counted"]
            return
        pairs, least = reply["pairs"], reply["least_distance"]
        what = "Too near" if least is not None and least >= 0.0 else "Colliding"
        deepest = "Short by" if self.clearance else "Deepest"
        self.verdict = f"{what}: {counted(pairs, 'pair')} of faces"
        self.details = "\n".join(
            [
                f"{deepest} {100.0 * reply['deepest']:.2f} % of the body size",
                *(" and ".join(dict.fromkeys(parts)) for parts in reply["parts"][:5]),
                *filter(None, [reply["not_counted"]]),
            ]
        )


class LCOLLISION_UL_frames(bpy.types.UIList):
    """The colliding frames of an action."""

    def draw_item(
        self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0
    ) -> None:
        """Draw one frame of the list."""
        row = layout.row()
        row.label(text=f"{item.frame}")
        row.label(text=f"{100.0 * item.deepest:.2f} %")
        row.label(text=item.parts)


class LCOLLISION_PT_panel(bpy.types.Panel):
    """Self-collisions of the active character."""

    bl_label = "LCollision"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "LCollision"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel."""
        layout, settings = self.layout, context.scene.lcollision
        try:
            rigged = Rigged.of(context)
        except SceneError as error:
            _say(layout, str(error), icon="INFO")
            return
        layout.label(text=rigged.armature.name, icon="ARMATURE_DATA")
        _draw_meshes(layout, rigged)
        row = layout.row(align=True)
        row.operator("lcollision.check_pose")
        row.prop(settings, "live", toggle=True)
        is_known = settings.of == rigged.armature.name
        _draw_verdict(layout, settings, is_known)
        layout.operator("lcollision.resolve_pose")
        for name in ("keep_feet", "only_selected", "clearance", "tolerated"):
            layout.prop(settings, name)
        _say(layout, where_written(rigged), icon="INFO")
        n_locked = len(rigged.locked())
        if n_locked:
            verb = "keeps its" if n_locked == 1 else "keep their"
            _say(layout, f"{counted(n_locked, 'bone')} {verb} rotation (locked)")
        layout.separator()
        layout.prop(settings, "use_range")
        if settings.use_range:
            row = layout.row(align=True)
            row.prop(settings, "first_frame")
            row.prop(settings, "last_frame")
        layout.operator("lcollision.check_action")
        layout.operator("lcollision.resolve_action")
        if is_known and len(settings.frames):
            layout.template_list(
                "LCOLLISION_UL_frames", "", settings, "frames", settings, "frame", rows=4
            )
            row = layout.row(align=True)
            row.operator("lcollision.jump", text="Previous", icon="PREV_KEYFRAME").is_back = True
            row.operator("lcollision.jump", text="Next", icon="NEXT_KEYFRAME").is_back = False
            if settings.frame < len(settings.frames) and settings.frames[settings.frame].why:
                _say(layout, settings.frames[settings.frame].why, icon="INFO")


class _ClosedPart:
    """Placement of the panel's sub-panels that are closed at first."""

    bl_parent_id = "LCOLLISION_PT_panel"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_options = {"DEFAULT_CLOSED"}


class LCOLLISION_PT_cloth(_ClosedPart, bpy.types.Panel):
    """A motion that cloth solvers take."""

    bl_label = "Cloth"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel."""
        layout, settings = self.layout, context.scene.lcollision
        layout.prop(settings, "cloth_gap")
        layout.prop(settings, "cloth_subframes")
        layout.row().prop(settings, "cloth_output", expand=True)
        if settings.cloth_output == "CACHE":
            layout.prop(settings, "cloth_folder")
        layout.operator("lcollision.prepare_cloth")


class LCOLLISION_PT_rules(_ClosedPart, bpy.types.Panel):
    """Pairs that do not count."""

    bl_label = "Ignored Pairs"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel."""
        layout, settings = self.layout, context.scene.lcollision
        if settings.rules:
            _say(layout, f"Not counted: {settings.rules}")
        for number, pair in enumerate(settings.ignored):
            row = layout.row()
            _say(row.column(), f"{pair.first} and {pair.second}")
            row.operator("lcollision.count_pair", text="", icon="X").number = number
        layout.prop_search(settings, "first", settings, "groups")
        layout.prop_search(settings, "second", settings, "groups")
        layout.operator("lcollision.ignore_pair")
        layout.separator()
        if settings.places:
            row = layout.row()
            _say(row.column(), f"{counted(_n_places(settings.places), 'place')} not counted")
            row.operator("lcollision.count_places", text="", icon="X")
        layout.operator("lcollision.propose")
        if settings.proposal:
            _say(layout, settings.proposed)
            layout.operator("lcollision.ignore_places")


def _draw_meshes(layout: bpy.types.UILayout, rigged: Rigged) -> None:
    """List the visible meshes, each with a tick, and the hidden ones."""
    hidden = {item for item, why in rigged.left_out if why == HIDDEN}
    ticked = [*rigged.meshes, *(item for item, _ in rigged.left_out if item not in hidden)]
    column = layout.column(align=True)
    for item in sorted(ticked, key=lambda one: one.name):
        column.prop(item, "lcollision_is_checked", text=item.name)
    for item in sorted(hidden, key=lambda one: one.name):
        _say(column, f"{item.name} (hidden, not checked)", icon="HIDE_ON")


def _n_places(places: str) -> int:
    return len(json.loads(places)["touching"])


def _draw_verdict(
    layout: bpy.types.UILayout, settings: LCOLLISION_PG_settings, is_known: bool
) -> None:
    box = layout.box()
    if not is_known:
        box.label(text=_NOT_CHECKED)
        return
    column = box.column()
    column.active = not (settings.is_of_pose and results.is_stale)
    is_bad = settings.verdict.startswith(("Colliding", "Still", "Too near"))
    is_good = "(checked" in settings.verdict
    icon = "ERROR" if is_bad else "CHECKMARK" if is_good else "NONE"
    _say(column, settings.verdict, icon=icon)
    for line in filter(None, settings.details.split("\n")):
        _say(column, line)
    for line in filter(None, settings.left_out.split("\n")):
        _say(column, f"Not checked: {line}")
    if settings.off_rig > OFF_RIG:
        _say(
            column,
            "Shape keys, modifiers or constraints move the mesh by "
            f"{100.0 * settings.off_rig:.1f} % beyond its bones; it is checked as shown, and "
            "Resolve keeps that offset",
        )
    if settings.verdict != _NOT_CHECKED:
        box.operator("lcollision.clear")


def _say(layout: bpy.types.UILayout, text: str, icon: str = "NONE") -> None:
    """Draw a sentence, wrapped to the sidebar's width."""
    style, region = bpy.context.preferences.ui_styles[0].widget, bpy.context.region
    scale = bpy.context.preferences.system.ui_scale
    blf.size(0, style.points * scale)
    room = (region.width if region is not None else _WIDTH * scale) - _MARGINS * scale
    room -= 0.0 if icon == "NONE" else _ICON * scale
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".lstrip()
        if lines[-1] and blf.dimensions(0, longer)[0] > room:
            lines.append(word)
        else:
            lines[-1] = longer
    column = layout.column(align=True)
    column.label(text=lines[0], icon=icon)
    for line in lines[1:]:
        column.label(text=line, icon="NONE" if icon == "NONE" else "BLANK1")


def where_written(rigged: Rigged) -> str:
    """Return a sentence on where Resolve writes."""
    if rigged.is_driven and rigged.may_have_controls:
        return "Writes to the controls if they can resolve it, else to a baked copy"
    if rigged.is_driven:
        return "Writes to a baked copy: bones have constraints or drivers"
    return "Writes to the deforming bones"


_CLASSES = (
    LCOLLISION_PG_group,
    LCOLLISION_PG_pair,
    LCOLLISION_PG_frame,
    LCOLLISION_PG_settings,
    LCOLLISION_UL_frames,
    LCOLLISION_PT_panel,
    LCOLLISION_PT_cloth,
    LCOLLISION_PT_rules,
)


def register() -> None:
    """Add the panel and the settings."""
    for one in _CLASSES:
        bpy.utils.register_class(one)
    bpy.types.Scene.lcollision = PointerProperty(type=LCOLLISION_PG_settings)
    bpy.types.Object.lcollision_is_checked = BoolProperty(
        name="Check This Mesh",
        description="Whether LCollision checks this mesh as part of its character",
        default=True,
        override={"LIBRARY_OVERRIDABLE"},
    )


def unregister() -> None:
    """Remove the panel and the settings."""
    del bpy.types.Object.lcollision_is_checked
    del bpy.types.Scene.lcollision
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
