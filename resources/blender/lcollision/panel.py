# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel in the 3D view's sidebar, and what scenes keep of its settings."""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from . import live
from .scene import HIDDEN, OFF_RIG, Rigged, SceneError


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


class LCOLLISION_PG_settings(bpy.types.PropertyGroup):
    """The panel's settings, and what was found last."""

    live: BoolProperty(
        name="Live Check",
        description="Check the pose whenever it changes",
        update=lambda self, context: live.switch(self.live),
    )
    keep_feet: BoolProperty(
        name="Keep Feet",
        description="In actions, feet stay where they stand on the ground",
        default=True,
    )
    clearance: FloatProperty(
        name="Clearance",
        description="Distance to keep between parts; if near at rest, half their rest distance",
        min=0.0,
        precision=4,
        subtype="DISTANCE",
    )
    ignored: CollectionProperty(type=LCOLLISION_PG_pair)
    first: StringProperty(name="", description="A mesh, material, vertex group or body part")
    second: StringProperty(name="", description="Its pairs with the first group do not count")
    groups: CollectionProperty(type=LCOLLISION_PG_group)
    left_out: StringProperty()
    verdict: StringProperty(default="Not checked yet")
    details: StringProperty()
    rules: StringProperty()
    off_rig: FloatProperty()
    frames: CollectionProperty(type=LCOLLISION_PG_frame)
    frame: IntProperty(name="Colliding Frame", update=lambda self, context: self.jump(context))

    def jump(self, context: bpy.types.Context) -> None:
        """Go to the frame that is chosen in the list."""
        if 0 <= self.frame < len(self.frames):
            context.scene.frame_set(self.frames[self.frame].frame)

    def chosen_rules(self) -> dict:
        """Return the rules that are not the character's own."""
        pairs = [(pair.first, pair.second) for pair in self.ignored]
        return {"ignored": pairs} if pairs else {}

    def kept(self) -> str:
        """Say what holds of a pose that is free."""
        return "The clearance is kept" if self.clearance else "No collisions"

    def checked(self) -> str:
        """Say how much of the character was checked."""
        n = len(self.left_out.split("\n")) if self.left_out else 0
        return f"checked without {n} mesh{'es' if n > 1 else ''}" if n else "checked"

    def show(self, reply: dict) -> None:
        """Keep what a check has found."""
        self.off_rig = reply["off_rig"]
        if not reply["colliding"]:
            self.verdict, self.details = f"{self.kept()} ({self.checked()})", ""
            return
        pairs, least = reply["pairs"], reply["least_distance"]
        what = "Too near" if least is not None and least >= 0.0 else "Colliding"
        deepest = "Short by" if self.clearance else "Deepest"
        self.verdict = f"{what}: {pairs} {'pair' if pairs == 1 else 'pairs'} of faces"
        self.details = "\n".join(
            [
                f"{deepest} {100.0 * reply['deepest']:.2f} % of the body size",
                *(" and ".join(dict.fromkeys(parts)) for parts in reply["parts"][:5]),
            ]
        )


class LCOLLISION_UL_frames(bpy.types.UIList):
    """The colliding frames of an action."""

    def draw_item(
        self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0
    ) -> None:
        """Draw one of them."""
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
            layout.label(text=str(error), icon="INFO")
            return
        layout.label(text=rigged.armature.name, icon="ARMATURE_DATA")
        _draw_meshes(layout, rigged)
        row = layout.row(align=True)
        row.operator("lcollision.check_pose")
        row.prop(settings, "live", toggle=True)
        layout.prop(settings, "clearance")
        layout.operator("lcollision.resolve_pose")
        _draw_verdict(layout, settings)
        layout.separator()
        layout.operator("lcollision.check_action")
        layout.prop(settings, "keep_feet")
        layout.operator("lcollision.resolve_action")
        if len(settings.frames):
            layout.template_list(
                "LCOLLISION_UL_frames", "", settings, "frames", settings, "frame", rows=4
            )
        layout.label(text=where_written(rigged), icon="INFO")
        layout.label(text=f"{len(rigged.locked())} bones keep their rotation (locked)")


class LCOLLISION_PT_rules(bpy.types.Panel):
    """Pairs that do not count."""

    bl_label = "Ignored Pairs"
    bl_parent_id = "LCOLLISION_PT_panel"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel."""
        layout, settings = self.layout, context.scene.lcollision
        if settings.rules:
            layout.label(text=f"Not counted: {settings.rules}")
        for number, pair in enumerate(settings.ignored):
            row = layout.row()
            row.label(text=f"{pair.first} and {pair.second}")
            row.operator("lcollision.count_pair", text="", icon="X").number = number
        layout.prop_search(settings, "first", settings, "groups")
        layout.prop_search(settings, "second", settings, "groups")
        layout.operator("lcollision.ignore_pair")


def _draw_meshes(layout: bpy.types.UILayout, rigged: Rigged) -> None:
    """List the meshes that are checked, and those that are not, each with a tick."""
    hidden = {item for item, why in rigged.left_out if why == HIDDEN}
    ticked = [*rigged.meshes, *(item for item, _ in rigged.left_out if item not in hidden)]
    column = layout.column(align=True)
    for item in sorted(ticked, key=lambda one: one.name):
        column.prop(item, "lcollision_is_checked", text=item.name)
    for item in sorted(hidden, key=lambda one: one.name):
        column.label(text=f"{item.name} (hidden, not checked)", icon="HIDE_ON")


def _draw_verdict(layout: bpy.types.UILayout, settings: LCOLLISION_PG_settings) -> None:
    box = layout.box()
    is_bad = settings.verdict.startswith(("Colliding", "Still", "Too near"))
    box.label(text=settings.verdict, icon="ERROR" if is_bad else "CHECKMARK")
    for line in filter(None, settings.details.split("\n")):
        box.label(text=line)
    for line in filter(None, settings.left_out.split("\n")):
        box.label(text=f"Not checked: {line}")
    if settings.off_rig > OFF_RIG:
        box.label(text="Shape keys, modifiers or constraints move the mesh")
        box.label(text=f"by {100.0 * settings.off_rig:.1f} % beyond its bones; it is checked")
        box.label(text="as shown, and Resolve keeps that offset")


def where_written(rigged: Rigged) -> str:
    """Say where Resolve writes."""
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
    """Take them away."""
    del bpy.types.Object.lcollision_is_checked
    del bpy.types.Scene.lcollision
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
