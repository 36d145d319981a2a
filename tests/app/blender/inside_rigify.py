"""Tasks with Rigify's human inside Blender: see `inside.py`."""

import math
import os
import sys

import bpy
import inside
import inside_actions
import numpy as np
from mathutils import Vector

FREE, BELLY = (0.5, -0.1, 1.1), (0.02, -0.03, 1.15)
"""Positions of the left hand beside the trunk and in it."""

N_FRAMES = 34

_RADII = {"spine": 0.1, "thigh": 0.07, "shin": 0.055, "foot": 0.05, "toe": 0.04}
_RADII |= {"upper_arm": 0.045, "forearm": 0.04, "hand": 0.035, "shoulder": 0.05}


def human():
    """Generate Rigify's basic human, with tubes around the deforming bones."""
    bpy.ops.preferences.addon_enable(module="rigify")
    bpy.ops.object.armature_basic_human_metarig_add()
    metarig = bpy.context.view_layer.objects.active
    bpy.ops.pose.rigify_generate()
    rig = next(one for one in bpy.data.objects if one.type == "ARMATURE" and one is not metarig)
    metarig.hide_set(True)
    bpy.context.view_layer.objects.active = rig
    points, faces, owners = [], [], []
    n_around, n_along = 8, 4
    around = [2.0 * math.pi * at / n_around for at in range(n_around)]
    for bone in rig.data.bones:
        radius = next((one for name, one in _RADII.items() if name in bone.name), None)
        if not bone.use_deform or radius is None:
            continue
        along, first = bone.tail_local - bone.head_local, len(points)
        turn = along.to_track_quat("Z", "Y")
        for row in range(n_along):
            height = along.length * row / (n_along - 1)
            for angle in around:
                side = Vector((radius * math.cos(angle), radius * math.sin(angle), height))
                points.append(bone.head_local + turn @ side)
        for row in range(n_along - 1):
            for at in range(n_around):
                corners = (at, (at + 1) % n_around)
                low, high = first + row * n_around, first + (row + 1) * n_around
                faces.append(
                    (low + corners[0], low + corners[1], high + corners[1], high + corners[0])
                )
        faces.append(tuple(range(first + n_around - 1, first - 1, -1)))
        faces.append(tuple(range(len(points) - n_around, len(points))))
        owners.append((bone.name, list(range(first, len(points)))))
    mesh = bpy.data.meshes.new("Body")
    mesh.from_pydata(points, [], faces)
    body = bpy.data.objects.new("Body", mesh)
    bpy.context.collection.objects.link(body)
    for name, own in owners:
        body.vertex_groups.new(name=name).add(own, 1.0, "REPLACE")
    body.modifiers.new("Armature", "ARMATURE").object = rig
    bpy.context.view_layer.update()
    return rig


def put_hand(rig, place, frame=None):
    """Move the target of the left arm's IK to a position."""
    hand = rig.pose.bones["hand_ik.L"]
    hand.location = (0.0, 0.0, 0.0)
    bpy.context.view_layer.update()
    matrix = hand.matrix.copy()
    matrix.translation = Vector(place)
    hand.matrix = matrix
    bpy.context.view_layer.update()
    if frame is not None:
        hand.keyframe_insert("location", frame=frame)


def seen(rig):
    """Return the shown rig and its pose."""
    bones = rig.pose.bones
    return {
        "points": inside.world_points(rig),
        "by_fk": sorted(one.name for one in bones if one.get("IK_FK", 0.0) == 1.0),
        "constraints": sum(len(one.constraints) for one in bones),
        "drivers": len(rig.animation_data.drivers),
    }


def changed(before, after):
    return sorted(
        name for name, one in before.items() if not np.allclose(one, after[name], atol=1e-5)
    )


def pose():
    """Resolve a pose of the human by its controls; return the joints that their locks lock."""
    rig = human()
    operators = inside.module("operators")
    answer = {"faces": inside.triangles(rig), "groups": inside.groups_of(rig)}
    put_hand(rig, BELLY)
    answer["panel"] = inside.drawn("LCOLLISION_PT_panel")
    answer["checked"] = inside.check()
    before, turned = seen(rig), inside.rotations(rig)
    answer["pose"] = {
        "before": before,
        "said": inside_actions.reported(operators.LCOLLISION_OT_resolve_pose),
    }
    answer["pose"] |= {
        "after": seen(rig),
        "verdict": inside.settings().verdict,
        "changed": changed(turned, inside.rotations(rig)),
        "active": bpy.context.view_layer.objects.active is rig,
        "again": inside.check()["verdict"],
    }
    # With the left arm's controls locked, the arm stays, whatever the DEF bones' locks.
    for bone in rig.pose.bones:
        bone.matrix_basis.identity()
        if "IK_FK" in bone:
            bone["IK_FK"] = 0.0
    arm = ("hand_ik.L", "upper_arm_fk.L", "forearm_fk.L", "hand_fk.L")
    for name in arm:
        rig.pose.bones[name].lock_rotation = (True, True, True)
    rig.update_tag()
    put_hand(rig, BELLY)
    locked = inside.module("scene").Rigged.of(bpy.context).by_controls().locked()
    answer["locked"] = locked
    return answer


def action():
    """Resolve an action of the human by its controls."""
    rig, answer = human(), {}
    actions = inside.module("actions")
    answer |= {"faces": inside.triangles(rig), "groups": inside.groups_of(rig)}
    n_constraints = seen(rig)["constraints"]
    places = {1: FREE, 15: FREE, 17: BELLY, 19: FREE, N_FRAMES: FREE}
    for frame, place in places.items():
        put_hand(rig, place, frame)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, N_FRAMES
    old = rig.animation_data.action
    keys = inside.keys(old, rig)

    def resolve():
        return inside_actions.reported(actions.LCOLLISION_OT_resolve_action)

    told = inside_actions.spans_of(rig, N_FRAMES, resolve)
    new = rig.animation_data.action
    return (
        answer
        | told
        | {
            "verdict": inside.settings().verdict,
            "old_is_untouched": inside.keys(old, rig) == keys,
            "keyed": sorted(name.rsplit(" ", 1)[0] for name in inside.keys(new, rig)),
            "is_copied": bpy.context.view_layer.objects.active is not rig,
            "constraints": [n_constraints, seen(rig)["constraints"]],
        }
    )


if __name__ == "__main__":
    inside.main(globals())
    sys.stdout.flush()
    sys.stderr.flush()
    # Blender 4.5 as a module never ends by itself once Rigify has generated a rig.
    os._exit(0)
