# SPDX-License-Identifier: GPL-3.0-or-later
"""Contact rules: ignored pairs of groups, and places that touch in nearly every pose."""

import json

import bpy
import numpy as np

from . import drawing, results
from .actions import action_of, frame_range
from .link import Steps, wait_for
from .operators import counted, open_character
from .results import Shown, array
from .scene import Rigged
from .steps import ModalOperator

_FEWEST_POSES, _MOST_POSES = 8, 40
"""Limits of the number of evenly spaced frames in which touching places are looked for."""


class LCOLLISION_OT_ignore_pair(bpy.types.Operator):
    """Do not count pairs of faces of these two groups"""

    bl_idname = "lcollision.ignore_pair"
    bl_label = "Ignore These Pairs"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set:
        """Add the pair."""
        settings = context.scene.lcollision
        if not settings.first or not settings.second:
            self.report({"ERROR"}, "Choose two groups; Check Pose lists them")
            return {"CANCELLED"}
        pair = settings.ignored.add()
        pair.first, pair.second = settings.first, settings.second
        return {"FINISHED"}


class LCOLLISION_OT_count_pair(bpy.types.Operator):
    """Count these pairs of faces again"""

    bl_idname = "lcollision.count_pair"
    bl_label = "Count Again"
    bl_options = {"REGISTER", "UNDO"}

    number: bpy.props.IntProperty()

    def execute(self, context: bpy.types.Context) -> set:
        """Remove the pair."""
        context.scene.lcollision.ignored.remove(self.number)
        return {"FINISHED"}


class LCOLLISION_OT_propose(ModalOperator, bpy.types.Operator):
    """Find places that touch in nearly every pose, as a belt and a jacket do, and show them"""

    bl_idname = "lcollision.propose"
    bl_label = "Propose Places"
    bl_options = {"REGISTER"}

    def steps(self, context, settings) -> Steps:
        """Read poses of the motion, if there is one, and request proposals."""
        rigged, scene = Rigged.of(context), context.scene
        character = yield from open_character(rigged, settings)
        poses, before = [], scene.frame_current
        if action_of(rigged) is not None or rigged.is_driven:
            numbers = frame_range(rigged, scene)
            try:
                for number in numbers[:: -(-len(numbers) // _MOST_POSES)]:
                    yield f"Reading frame {number}"
                    scene.frame_set(number)
                    poses.append(rigged.shown().astype(np.float32))
                    character.require_same_meshes(rigged, len(poses[-1]))
            finally:
                scene.frame_set(before)
        progress: list[int] = []
        request = character.send(
            "propose_rules",
            lambda *told: progress.extend(told),
            vertices=np.array(poses) if len(poses) >= _FEWEST_POSES else None,
        )
        reply = yield from wait_for(character.engine, request, "Looking at poses", progress)
        if not reply["touching"]:
            settings.proposal = settings.proposed = ""
            return "No places touch in nearly every pose"
        kept = {name: reply[name] for name in ("touching", "touching_radius")}
        settings.proposal = json.dumps({"of": repr(rigged.key()), **kept})
        settings.proposed = (
            f"{reply['colliding']} of {counted(reply['poses'], 'pose')} "
            f"collide{'s' if reply['colliding'] == 1 else ''}; without "
            f"{counted(len(reply['touching']), 'place')} that nearly always touch, "
            f"{reply['colliding_then'] or 'none'}"
        )
        faces = np.unique(array(reply["faces"]))
        colours = np.tile(drawing.PROPOSED, (len(faces), 1))
        results.tint(rigged, faces, colours, Shown.of(rigged))
        return settings.proposed


class LCOLLISION_OT_ignore_places(bpy.types.Operator):
    """Do not count the proposed places"""

    bl_idname = "lcollision.ignore_places"
    bl_label = "Ignore These Places"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set:
        """Add them to the places that already do not count."""
        settings = context.scene.lcollision
        if not settings.proposal:
            self.report({"ERROR"}, "Propose Places first")
            return {"CANCELLED"}
        proposal = json.loads(settings.proposal)
        before = json.loads(settings.places or "{}")
        if before.get("of") == proposal["of"]:
            proposal["touching"] += before["touching"]
        settings.places = json.dumps(proposal)
        settings.proposal = settings.proposed = ""
        results.clear()
        return {"FINISHED"}


class LCOLLISION_OT_count_places(bpy.types.Operator):
    """Count contacts at these places again"""

    bl_idname = "lcollision.count_places"
    bl_label = "Count Again"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set:
        """Clear the places."""
        context.scene.lcollision.places = ""
        results.clear()
        return {"FINISHED"}


_CLASSES = (
    LCOLLISION_OT_ignore_pair,
    LCOLLISION_OT_count_pair,
    LCOLLISION_OT_propose,
    LCOLLISION_OT_ignore_places,
    LCOLLISION_OT_count_places,
)

register, unregister = bpy.utils.register_classes_factory(_CLASSES)
