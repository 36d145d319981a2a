"""Tasks that tests run inside Blender: each function is one, and returns JSON."""

import json
import math
import os
import signal
import subprocess
import sys
import time

import bpy
import numpy as np
from mathutils import Matrix, Vector


def load(path, clip=None, fps=30):
    """Import a file with Blender's own importer; make its character active, mute its clips."""
    scene = bpy.context.scene
    scene.render.fps = fps
    bpy.ops.import_scene.gltf(filepath=path)
    armature = next(item for item in bpy.data.objects if item.type == "ARMATURE")
    bpy.context.view_layer.objects.active = armature
    data = armature.animation_data
    if data is not None:
        for track in data.nla_tracks:
            track.mute = True
        data.action = None
        if clip is not None:
            data.action = bpy.data.actions[clip]
            data.action_slot = data.action.slots[0]
    for bone in armature.pose.bones:
        bone.matrix_basis.identity()
    scene.frame_set(0)
    bpy.context.view_layer.update()
    return armature


def meshes_of(armature, props=False):
    """Return the meshes that an armature deforms, and those parented to its bones if asked."""
    return sorted(
        (
            item
            for item in bpy.data.objects
            if item.type == "MESH"
            and (
                any(one.type == "ARMATURE" and one.object == armature for one in item.modifiers)
                or (props and item.parent == armature and item.parent_type == "BONE")
            )
        ),
        key=lambda item: item.name,
    )


def world_points(armature, props=False):
    """Return the evaluated vertices in world coordinates, as given by Blender."""
    graph = bpy.context.evaluated_depsgraph_get()
    points = []
    for item in meshes_of(armature, props):
        one = item.evaluated_get(graph)
        points += [list(one.matrix_world @ vertex.co) for vertex in one.to_mesh().vertices]
        one.to_mesh_clear()
    return points


def triangles(armature, props=False):
    found, first = [], 0
    for item in meshes_of(armature, props):
        item.data.calc_loop_triangles()
        found += [[first + at for at in one.vertices] for one in item.data.loop_triangles]
        first += len(item.data.vertices)
    return found


def groups_of(armature, props=False):
    """Return the name of the bone with the largest weight at each vertex."""
    names = []
    for item in meshes_of(armature, props):
        for vertex in item.data.vertices:
            if item.parent_type == "BONE":
                names.append(item.parent_bone)
                continue
            most = max(vertex.groups, key=lambda group: group.weight)
            names.append(item.vertex_groups[most.group].name)
    return names


def lower_arm(armature, degrees=105.0, name="LeftArm"):
    """Turn an arm down about the axis from back to front, into the trunk."""
    bone = next(one for one in armature.pose.bones if one.name.endswith(name))
    turned(bone, armature, degrees)
    bpy.context.view_layer.update()


def turned(bone, armature, degrees):
    place = bone.matrix.to_translation()
    back = armature.matrix_world.inverted().to_3x3() @ Vector((0.0, 1.0, 0.0))
    turn = Matrix.Rotation(math.radians(degrees), 4, back.normalized())
    bone.matrix = Matrix.Translation(place) @ turn @ Matrix.Translation(-place) @ bone.matrix


def settings():
    return bpy.context.scene.lcollision


def told():
    """Return the panel's content."""
    one = settings()
    return {"verdict": one.verdict, "details": one.details.split("\n"), "off_rig": one.off_rig}


def check():
    assert bpy.ops.lcollision.check_pose() == {"FINISHED"}
    return told()


def rotations(armature):
    return {bone.name: [list(row) for row in bone.matrix_basis] for bone in armature.pose.bones}


def resolve_pose(path, degrees):
    """Lower an arm into the trunk, resolve, and undo."""
    armature = load(path)
    at_rest = check()
    lower_arm(armature, float(degrees))
    before, points = check(), world_points(armature)
    moved = rotations(armature)
    bpy.ops.ed.undo_push(message="pose")
    begin = time.perf_counter()
    assert bpy.ops.lcollision.resolve_pose("EXEC_DEFAULT", True) == {"FINISHED"}
    seconds = time.perf_counter() - begin
    after = told()
    answer = {
        "rest": at_rest,
        "before": before,
        "after": after,
        "again": check(),
        "points_before": points,
        "points": world_points(armature),
        "faces": triangles(armature),
        "groups": groups_of(armature),
        "seconds": seconds,
        "changed": rotations(armature) != moved,
    }
    assert bpy.ops.ed.undo() == {"FINISHED"}
    armature = next(item for item in bpy.data.objects if item.type == "ARMATURE")
    answer["undone"] = rotations(armature) == moved
    return answer


def scales(path):
    """Check and resolve the same pose in centimetres and mirrored."""
    found = {}
    for name, size, shown in (
        ("as it is", 1.0, (1.0, 1.0, 1.0)),
        ("centimetres", 100.0, (0.01, 0.01, 0.01)),
        ("mirrored", 1.0, (-1.0, 1.0, 1.0)),
        ("large", 0.001, (1000.0, 1000.0, 1000.0)),
    ):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
        armature = load(path)
        armature.scale = (size, size, size)
        bpy.ops.object.select_all(action="DESELECT")
        for item in (armature, *meshes_of(armature)):
            item.select_set(True)
        bpy.ops.object.transform_apply(location=False, rotation=False, scale=True)
        armature.scale = shown
        bpy.context.view_layer.update()
        at_rest = check()
        lower_arm(armature)
        armature.matrix_world = Matrix.Rotation(0.3, 4, (1.0, 2.0, 3.0)) @ armature.matrix_world
        bpy.context.view_layer.update()
        before = check()
        assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
        found[name] = {
            "rest": at_rest["verdict"],
            "before": before["verdict"],
            "after": check()["verdict"],
            "points": world_points(armature),
            "faces": triangles(armature),
            "groups": groups_of(armature),
        }
    return found


def keys(action, armature):
    from bl_ext.user_default.lcollision.actions import curves_of

    return {
        f"{curve.data_path} {curve.array_index}": [
            [*key.co, *key.handle_left, *key.handle_right, key.interpolation]
            for key in curve.keyframe_points
        ]
        for curve in curves_of(action, armature)
    }


def every_frame(armature, last):
    found = []
    for frame in range(last):
        bpy.context.scene.frame_set(frame)
        found.append(world_points(armature))
    return found


def resolve_action(path, clip, n_frames, folder):
    """Check an action, resolve it, and undo; write the points of all frames to files."""
    armature = load(path, clip)
    n_frames, scene = int(n_frames), bpy.context.scene
    old = armature.animation_data.action
    before = keys(old, armature)
    np.save(f"{folder}/before.npy", every_frame(armature, n_frames))
    scene.frame_set(3)
    bpy.ops.ed.undo_push(message="action")
    assert bpy.ops.lcollision.check_action() == {"FINISHED"}
    first, left_out = [item.frame for item in settings().frames], settings().details
    markers = sorted(one.frame for one in scene.timeline_markers)
    settings().frame = 1
    jumped = scene.frame_current
    scene.frame_set(3)
    begin = time.perf_counter()
    assert bpy.ops.lcollision.resolve_action("EXEC_DEFAULT", True) == {"FINISHED"}
    seconds = time.perf_counter() - begin
    new = armature.animation_data.action
    answer = {
        "colliding": first,
        "left_out": left_out,
        "markers": markers,
        "jumped": jumped,
        "frame": scene.frame_current,
        "colliding_after": [item.frame for item in settings().frames],
        "verdict": settings().verdict,
        "old": old.name,
        "new": new.name,
        "old_is_untouched": keys(old, armature) == before,
        "seconds": seconds,
        "faces": triangles(armature),
        "groups": groups_of(armature),
    }
    np.save(f"{folder}/after.npy", every_frame(armature, n_frames))
    assert bpy.ops.ed.undo() == {"FINISHED"}
    armature = next(item for item in bpy.data.objects if item.type == "ARMATURE")
    action = armature.animation_data.action
    answer["undone"] = action.name == answer["old"] and keys(action, armature) == before
    answer["actions"] = sorted(bpy.data.actions.keys())
    return answer


def held_by(armature, kind):
    """Let an empty hold the left arm; return a function that moves it into the trunk or out."""
    target = bpy.data.objects.new("target", None)
    bpy.context.collection.objects.link(target)
    target.rotation_mode = "QUATERNION"
    bones = armature.pose.bones
    at_rest = (armature.matrix_world @ bones["LeftArm"].matrix).to_quaternion()
    constraint = bones["LeftHand" if kind == "IK" else "LeftArm"].constraints.new(kind)
    constraint.target = target
    if kind == "IK":
        constraint.chain_count = 3

    def turn(degrees, frame=None):
        lowered = Matrix.Rotation(math.radians(degrees), 4, (0.0, 1.0, 0.0)).to_quaternion()
        target.rotation_quaternion = lowered @ at_rest
        target.location = (-0.1, -0.1, 1.2) if degrees > 90.0 else (0.6, -0.1, 1.2)
        if frame is not None:
            target.keyframe_insert("rotation_quaternion", frame=frame)
            target.keyframe_insert("location", frame=frame)
        bpy.context.view_layer.update()

    return turn


def constrained(path, kind):
    """Resolve a pose and an action that result from a constraint."""
    armature = load(path)
    turn = held_by(armature, kind)
    turn(105.0)
    before, moved = check(), rotations(armature)
    panel = sys.modules["bl_ext.user_default.lcollision.panel"]
    scene = sys.modules["bl_ext.user_default.lcollision.scene"]
    said = panel.where_written(scene.Rigged.of(bpy.context))
    points = world_points(armature)
    assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
    copy = bpy.context.view_layer.objects.active
    answer = {
        "before": before,
        "said": said,
        "after": told(),
        "copy": copy.name,
        "is_hidden": armature.hide_get(),
        "original": rotations(armature) == moved
        and sum(len(bone.constraints) for bone in armature.pose.bones) == 1
        and world_points(armature) == points,
        "constraints": sum(len(bone.constraints) for bone in copy.pose.bones),
        "meshes": [item.name for item in meshes_of(copy)],
        "points": world_points(copy),
        "faces": triangles(copy),
        "groups": groups_of(copy),
    }
    # The same target as a motion, on the original.
    for item in (armature, *meshes_of(armature)):
        item.hide_set(False)
    bpy.context.view_layer.objects.active = armature
    for item in (copy, *meshes_of(copy)):
        item.hide_set(True)
    bpy.context.view_layer.update()
    for frame, degrees in ((1, 60.0), (6, 105.0), (11, 60.0)):
        turn(degrees, frame)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 11
    assert bpy.ops.lcollision.check_action() == {"FINISHED"}
    answer["frames"] = [item.frame for item in settings().frames]
    assert bpy.ops.lcollision.resolve_action() == {"FINISHED"}
    answer["action"] = settings().verdict
    answer["baked"] = bpy.context.view_layer.objects.active.name
    return answer


def driven(path):
    """Resolve a pose in which a driver turns a bone."""
    armature = load(path)
    bone = armature.pose.bones["LeftArm"]
    bone.rotation_mode = "XYZ"
    lower_arm(armature)
    lowered = [*bone.matrix_basis.to_euler("XYZ")]
    bone.matrix_basis.identity()
    armature["lowered"] = 0.0
    for axis, angle in enumerate(lowered):
        driver = bone.driver_add("rotation_euler", axis).driver
        variable = driver.variables.new()
        variable.name = "lowered"
        variable.targets[0].id, variable.targets[0].data_path = armature, '["lowered"]'
        driver.expression = f"{angle} * lowered"

    def lower(share):
        armature["lowered"] = share
        armature.update_tag()
        bpy.context.view_layer.update()

    lower(0.0)
    answer = {"raised": check()}
    lower(1.0)
    answer |= {"lowered": check(), "panel": drawn("LCOLLISION_PT_panel")}
    points = world_points(armature)
    assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
    copy = bpy.context.view_layer.objects.active
    answer |= {
        "after": told(),
        "copy": copy.name,
        "drivers": [
            0 if one.animation_data is None else len(one.animation_data.drivers)
            for one in (armature, copy)
        ],
        "original": world_points(armature) == points,
        "points_before": points,
        "points": world_points(copy),
        "faces": triangles(copy),
        "groups": groups_of(copy),
    }
    return answer


def clearance(path, clip, metres):
    """Check and resolve a pose and an action with a clearance."""
    armature = load(path)
    # In a unit other than the scene's.
    armature.scale = (0.5, 0.5, 0.5)
    lower_arm(armature)
    assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
    answer = {"touching": told()}
    settings().clearance = float(metres)
    answer |= {"near": check(), "panel": drawn("LCOLLISION_PT_panel")}
    assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
    answer |= {
        "kept": told(),
        "points": world_points(armature),
        "faces": triangles(armature),
        "groups": groups_of(armature),
    }
    data = armature.animation_data
    data.action = bpy.data.actions[clip]
    data.action_slot = data.action.slots[0]
    assert bpy.ops.lcollision.check_action() == {"FINISHED"}
    answer["action"] = settings().verdict
    assert bpy.ops.lcollision.resolve_action() == {"FINISHED"}
    answer["resolved"] = settings().verdict
    return answer


def shape_keys(path):
    """Check and resolve a mesh that a shape key makes wider, and one with a modifier after."""
    armature = load(path)
    (mesh,) = meshes_of(armature)
    mesh.shape_key_add(name="Basis")
    wider = mesh.shape_key_add(name="wider")
    for point in wider.data:
        point.co.x *= 1.1
    wider.value = 0.0
    lower_arm(armature)
    plain = check()
    wider.value = 1.0
    by_key = check()
    cast = mesh.modifiers.new("wave", "DISPLACE")
    cast.strength = 0.01
    by_modifier = check()
    assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
    return {
        "plain": plain,
        "key": by_key,
        "modifier": by_modifier,
        "after": told(),
        "again": check(),
        "points": world_points(armature),
        "faces": triangles(armature),
        "groups": groups_of(armature),
    }


def several_meshes(path):
    """Split the mesh into its tubes, on one armature."""
    armature = load(path)
    lower_arm(armature)
    whole = check()
    (mesh,) = meshes_of(armature)
    bpy.ops.object.select_all(action="DESELECT")
    mesh.select_set(True)
    bpy.context.view_layer.objects.active = mesh
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.separate(type="LOOSE")
    bpy.ops.object.mode_set(mode="OBJECT")
    split = check()
    assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
    return {
        "meshes": len(meshes_of(armature)),
        "whole": whole,
        "split": split,
        "after": check(),
        "groups": [group.name for group in settings().groups],
    }


def carried(armature, name, bone, centre, sides):
    """Parent a box to a bone, in the rest pose, given its position and sides in the world."""
    mesh = bpy.data.meshes.new(name)
    corners = [[(at >> axis & 1) - 0.5 for axis in range(3)] for at in range(8)]
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    mesh.from_pydata(corners, [], faces)
    item = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(item)
    item.parent, item.parent_type, item.parent_bone = armature, "BONE", bone
    bpy.context.view_layer.update()
    item.matrix_world = Matrix.LocRotScale(Vector(centre), None, Vector(sides))
    bpy.context.view_layer.update()
    return item


def carried_meshes(path):
    """Check and resolve with a staff and a hat that bones carry, with and without them."""
    armature = load(path)
    hand = armature.matrix_world @ armature.pose.bones["LeftHand"].bone.matrix_local
    palm = hand @ Vector((0.0, 0.05, 0.0))
    staff = carried(armature, "Staff", "LeftHand", palm + Vector((0.0, 0.0, -0.1)), (0.02, 0.02, 1))
    hat = carried(armature, "Hat", "Head", (0.0, 0.0, 1.8), (0.3, 0.3, 0.1))
    lantern = bpy.data.objects.new("Lantern", bpy.data.lights.new("Lantern", "POINT"))
    bpy.context.collection.objects.link(lantern)
    lantern.parent, lantern.parent_type, lantern.parent_bone = armature, "BONE", "LeftHand"
    answer = {"rest": check(), "panel": drawn("LCOLLISION_PT_panel")}
    lower_arm(armature, 72.0)

    def seen(armature):
        return {
            "points": world_points(armature, True),
            "faces": triangles(armature, True),
            "groups": groups_of(armature, True),
        }

    answer |= {"lowered": check(), "before": seen(armature)}
    found = module("results")._reply
    answer["counts"] = {"pairs": found["pairs"], "left_out": found["excluded_pairs"]}
    staff.lcollision_is_checked = False
    answer |= {"unticked": check(), "panel_without": drawn("LCOLLISION_PT_panel")}
    staff.lcollision_is_checked = True
    hat.hide_set(True)
    staff.hide_set(True)
    answer["hidden"] = check()
    hat.hide_set(False)
    staff.hide_set(False)
    bpy.ops.ed.undo_push(message="pose")
    assert bpy.ops.lcollision.resolve_pose("EXEC_DEFAULT", True) == {"FINISHED"}
    answer |= {"resolved": told(), "after": seen(armature)}
    assert bpy.ops.ed.undo() == {"FINISHED"}
    # The same when a copy is written, with an unchecked prop and one that is not a mesh.
    armature = next(item for item in bpy.data.objects if item.type == "ARMATURE")
    armature.pose.bones["Head"].constraints.new("LIMIT_ROTATION")
    bpy.data.objects["Hat"].lcollision_is_checked = False
    bpy.context.view_layer.update()
    assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
    copy = bpy.context.view_layer.objects.active
    names = ["Hat", "Lantern", "Staff", armature.name, *(one.name for one in meshes_of(armature))]
    answer |= {
        "baked": told(),
        "carried": sorted([one.name, one.parent_bone] for one in copy.children if one.parent_bone),
        "left": [name for name in names if bpy.data.objects[name].visible_get()],
        "rendered": [name for name in names if not bpy.data.objects[name].hide_render],
        "copies": [
            f"{name}.free"
            for name in names
            if bpy.data.objects[f"{name}.free"].visible_get()
            and not bpy.data.objects[f"{name}.free"].hide_render
        ],
        "baked_after": seen(copy),
    }
    return answer


def mirror(mesh):
    """Keep the left half of a mesh, and show the other by a modifier after the armature."""
    # Available only after `bpy`.
    import bmesh

    half = bmesh.new()
    half.from_mesh(mesh.data)
    parts = [*half.verts, *half.edges, *half.faces]
    bmesh.ops.bisect_plane(
        half, geom=parts, plane_co=(0, 0, 0), plane_no=(1, 0, 0), clear_inner=True
    )
    half.to_mesh(mesh.data)
    half.free()
    # Otherwise, a hand that reaches the plane would be merged with the other one.
    mesh.modifiers.new("Mirror", "MIRROR").use_mirror_merge = False
    bpy.context.view_layer.update()


def moved_besides(path):
    """Resolve, twice, a mesh that modifiers and bones move by more than turns."""
    answer = {}
    for kind in ("Subdivision", "Smooth", "Mirror", "Preserve Volume", "scaled", "not inherited"):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
        armature = load(path)
        (mesh,) = meshes_of(armature)
        if kind == "Subdivision":
            mesh.modifiers.new(kind, "SUBSURF").levels = 1
        elif kind == "Smooth":
            mesh.modifiers.new(kind, "CORRECTIVE_SMOOTH").iterations = 10
        elif kind == "Mirror":
            mirror(mesh)
        elif kind == "Preserve Volume":
            mesh.modifiers[0].use_deform_preserve_volume = True
        elif kind == "scaled":
            armature.pose.bones["LeftArm"].scale = (1.2, 1.2, 1.2)
            armature.pose.bones["Spine"].scale = (1.1, 1.0, 1.05)
        else:
            for name in ("LeftArm", "RightArm", "Head"):
                armature.data.bones[name].use_inherit_rotation = False
        bpy.context.view_layer.update()
        lower_arm(armature)
        before = check()
        presses = []
        for _ in range(2):
            assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
            presses.append(told())
        scene = module("scene")
        rigged = scene.Rigged.of(bpy.context)
        answer[kind] = {
            "before": before,
            "presses": presses,
            "besides": rigged.moved_besides(),
        }
    return answer


def forest(path):
    """Resolve with an arm parented to a control, and with unparented limbs and trunk."""
    answer = {}
    for kind in ("control", "between", "roots"):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
        armature = load(path)
        bpy.ops.object.mode_set(mode="EDIT")
        bones = armature.data.edit_bones
        for bone in bones:
            bone.use_connect = False
        if kind == "control":
            control = bones.new("control")
            control.head, control.tail = bones["Spine"].head, bones["Spine"].tail
            control.use_deform, bones["LeftArm"].parent = False, control
        elif kind == "between":
            link = bones.new("link")
            link.head, link.tail, link.parent = (0.1, 0.1, 1.3), (0.1, 0.1, 1.5), bones["Spine"]
            link.use_deform, bones["LeftArm"].parent = False, link
        else:
            for name in ("LeftArm", "RightArm", "Head", "LeftUpLeg", "RightUpLeg"):
                bones[name].parent = None
        bpy.ops.object.mode_set(mode="OBJECT")
        rigged = module("scene").Rigged.of(bpy.context)
        parents = {
            name: rigged.bones[above] if above >= 0 else None
            for name, above in zip(rigged.bones, rigged.parents.tolist(), strict=True)
        }
        lower_arm(armature, 85.0)
        # Arm and thigh cross and are locked, so that the trunk has to turn.
        lower_arm(armature, -60.0, "LeftUpLeg")
        spine, arm = armature.pose.bones["Spine"], armature.pose.bones["LeftArm"]
        for bone in (arm, armature.pose.bones["LeftUpLeg"]):
            bone.lock_rotation = True, True, True
        before = check()

        def shoulder(spine=spine, arm=arm):
            return spine.matrix.inverted() @ arm.matrix.to_translation()

        at, turned_before = shoulder(), spine.matrix.copy()
        assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
        answer[kind] = {
            "parents": parents,
            "before": before,
            "after": check(),
            "apart": (shoulder() - at).length,
            "trunk_turns": spine.matrix != turned_before,
            "points": world_points(armature),
            "faces": triangles(armature),
            "groups": groups_of(armature),
        }
    return answer


def module(name):
    return sys.modules[f"bl_ext.user_default.lcollision.{name}"]


def looked(seconds=60.0):
    """Wait for the live check of the newest pose; return the verdict."""
    until = time.monotonic() + seconds
    while time.monotonic() < until and not module("live").look():
        time.sleep(0.01)
    return settings().verdict


def live(path, folder):
    """Pose with the live check on, and wait for its answers; load a file, and continue."""
    armature = load(path)
    settings().live = True
    verdicts, shown = [], []
    for degrees in (0.0, 105.0, -105.0):
        # Posed in steps: the newest wins.
        for _ in range(5):
            lower_arm(armature, degrees / 5.0)
            module("live").look()
        verdicts.append(looked())
        shown.append(len(module("drawing").shown()))
    lower_arm(armature)
    looked()
    bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/live.blend")
    bpy.ops.wm.open_mainfile(filepath=f"{folder}/live.blend")
    loaded = {"shown": len(module("drawing").shown()), "handlers": handlers()}
    loaded["timer"] = bpy.app.timers.is_registered(module("live")._look)
    loaded["verdict"] = looked()
    loaded["shown_again"] = len(module("drawing").shown())
    settings().live = False
    loaded["shown_off"] = len(module("drawing").shown())
    return {"verdicts": verdicts, "shown": shown, "handlers": handlers(), "loaded": loaded}


def handlers():
    found = [one.__name__ for one in bpy.app.handlers.depsgraph_update_post]
    # The handler that withdraws outdated results is always there.
    found.remove("_on_change")
    return found


def changed_character(path):
    """Change rules and meshes while the live check is on."""
    link = module("link")
    armature = load(path)
    (mesh,) = meshes_of(armature)
    lower_arm(armature)
    settings().live = True
    answer = {"first": looked()}
    # The character's own ignored pairs stay beside the panel's.
    (known,) = link._opened.values()
    own = link._own_rules[known.answer["character"]]
    own["ignored"] = [["LeftFoot", "RightFoot"]]
    pair = settings().ignored.add()
    pair.first, pair.second = "Body", "Body"
    answer["ignored"] = looked()
    known = link._opened[armature.name]
    rules = link.engine().ask("rules", character=known.answer["character"])["rules"]
    answer["rules"] = rules["ignored"]
    settings().ignored.clear()
    answer["counted"] = looked()
    # This modifier changes the number of shown vertices.
    divided = mesh.modifiers.new("divided", "SUBSURF")
    divided.levels = 1
    bpy.context.view_layer.update()
    answer["divided"] = looked()
    answer["is_on"] = settings().live
    mesh.modifiers.remove(divided)
    # The same number of vertices, moved: the live check uses the character that Check Pose opened.
    for vertex in mesh.data.vertices:
        vertex.co *= 1.5
    check()
    answer["off_rig"] = settings().off_rig
    armature.update_tag()
    bpy.context.view_layer.update()
    looked()
    answer["off_rig_live"] = settings().off_rig
    answer["open"] = len(link._own_rules), len(link._opened)
    settings().live = False
    return answer


TOO_WIDE = []
"""Drawn texts that a sidebar of Blender's initial width cuts off."""


class Recorder:
    """Records what a panel draws, as a layout does; joins the lines of a sentence."""

    def __init__(self, lines, is_sentence=False):
        self._lines, self._is_sentence, self._is_begun = lines, is_sentence, False

    def __getattr__(self, name):
        # Available only after `bpy`.
        import blf

        def record(*arguments, **named):
            if name in ("row", "box", "column"):
                return Recorder(self._lines, is_sentence=named.get("align", False))
            line = named.get("text") or " ".join(map(str, arguments))
            # 220 pixels minus the tabs, the margins and the icon.
            blf.size(0, bpy.context.preferences.ui_styles[0].widget.points)
            room = 170.0 - 20.0 * (named.get("icon", "NONE") != "NONE")
            if name == "label" and blf.dimensions(0, line)[0] > room:
                TOO_WIDE.append(line)
            if self._is_sentence and self._is_begun and name == "label":
                self._lines[-1] += f" {line}"
            else:
                self._lines.append(f"{name}: {line}")
            self._is_begun = True
            return type("Properties", (), {})()

        return record


def drawn(name):
    lines = []
    panel = sys.modules["bl_ext.user_default.lcollision.panel"]
    stand_in = type("Panel", (), {"layout": Recorder(lines)})()
    getattr(panel, name).draw(stand_in, bpy.context)
    return lines


def panel(path):
    """Run the draw functions in all states."""
    answer = {"empty": drawn("LCOLLISION_PT_panel")}
    assert "LCollision" in {one.bl_label for one in bpy.types.Panel.__subclasses__()}
    armature = load(path)
    answer["new"] = drawn("LCOLLISION_PT_panel")
    lower_arm(armature)
    check()
    armature.pose.bones["Head"].lock_rotation = (True, True, True)
    # A group without a bone of its name: it deforms nothing.
    (mesh,) = meshes_of(armature)
    sleeve = mesh.vertex_groups.new(name="sleeve")
    # A group named like a body part except for capitals.
    mesh.vertex_groups.new(name="torso").add(range(40), 1.0, "REPLACE")
    names = groups_of(armature)
    arm = [at for at, name in enumerate(names) if name in ("LeftArm", "LeftForeArm", "LeftHand")]
    sleeve.add(arm, 1.0, "REPLACE")
    check()
    answer["colliding"] = drawn("LCOLLISION_PT_panel")
    answer["groups"] = [group.name for group in settings().groups]
    try:
        bpy.ops.lcollision.ignore_pair()
    except RuntimeError as error:
        answer["refused"] = str(error)
    settings().first, settings().second = "sleeve", "Body"
    bpy.ops.lcollision.ignore_pair()
    answer["ignored"] = check()
    answer["rules"] = drawn("LCOLLISION_PT_rules")
    while len(settings().ignored):
        bpy.ops.lcollision.count_pair(number=0)
    answer["counted"] = check()
    item = settings().frames.add()
    item.frame, item.deepest, item.parts = 7, 0.01, "Torso and Left hand"
    settings().use_range = True
    answer["listed"] = drawn("LCOLLISION_PT_panel")
    # A mesh that modifiers move, written to a copy, with collisions that cannot be resolved.
    mesh.modifiers.new("wave", "DISPLACE").strength = 0.01
    held_by(armature, "COPY_ROTATION")(105.0)
    check()
    settings().off_rig = 0.05
    settings().proposed = "36 of 40 poses collide; without 12 places that touch, none"
    settings().proposal = settings().places = json.dumps({"touching": [[1, 2]]})
    answer["all"] = [*drawn("LCOLLISION_PT_panel"), *drawn("LCOLLISION_PT_rules")]
    answer["too_wide"] = TOO_WIDE
    lines = []
    module = sys.modules["bl_ext.user_default.lcollision.panel"]
    module.LCOLLISION_UL_frames.draw_item(
        None, bpy.context, Recorder(lines), None, item, 0, None, ""
    )
    answer["item"] = lines
    return answer


def locked_and_keyed(path):
    """Resolve with a locked bone, in several rotation modes, with auto-keying."""
    armature = load(path)
    modes = ("XYZ", "ZYX", "AXIS_ANGLE", "QUATERNION")
    for number, bone in enumerate(armature.pose.bones):
        bone.rotation_mode = modes[number % len(modes)]
    bpy.context.view_layer.update()
    lower_arm(armature)
    spine = armature.pose.bones["Spine"]
    spine.lock_rotation = (True, True, True)
    before, free = rotations(armature)["Spine"], rotations(armature)
    bpy.context.scene.tool_settings.use_keyframe_insert_auto = True
    bpy.context.scene.frame_set(12)
    lower_arm(armature, 0.0)
    first = check()
    assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
    after = rotations(armature)
    answer = {
        "before": first,
        "after": check(),
        "spine": before == after["Spine"],
        "turned": [name for name in after if after[name] != free[name]],
        "keys": keys(armature.animation_data.action, armature),
    }
    bpy.context.scene.frame_set(12)
    answer["keyed"] = check()
    return answer


def cancelled(path, clip):
    """Start resolving an action, and cancel it while the engine works."""
    module = sys.modules["bl_ext.user_default.lcollision.actions"]
    armature = load(path, clip)
    bpy.context.scene.frame_set(3)
    steps = module.LCOLLISION_OT_resolve_action.steps(None, bpy.context, settings())
    texts = []
    for text in steps:
        texts.append(text)
        if "Resolving" in text:
            break
    steps.close()
    link = sys.modules["bl_ext.user_default.lcollision.link"]
    answer = {
        "texts": sorted({text.strip("\0").split(" ")[0] for text in texts}),
        "action": armature.animation_data.action.name,
        "actions": sorted(bpy.data.actions.keys()),
        "frame": bpy.context.scene.frame_current,
        "alive": link.engine().is_alive,
    }
    answer["after"] = check()
    return answer


def failing(path, clip, kind):
    """Resolve an action while the check of the result fails or is cancelled."""
    actions, client = module("actions"), module("client")
    armature = load(path, clip)
    if kind == "baked":
        held_by(armature, "COPY_ROTATION")(105.0)
    old = armature.animation_data.action
    bpy.context.scene.frame_set(3)

    def state():
        return {
            "action": armature.animation_data.action.name,
            "slot": armature.animation_data.action_slot.identifier,
            "actions": sorted(bpy.data.actions.keys()),
            "objects": sorted(bpy.data.objects.keys()),
            "hidden": [one.name for one in bpy.data.objects if one.hide_get()],
            "active": bpy.context.view_layer.objects.active.name,
            "frame": bpy.context.scene.frame_current,
            "keys": keys(old, armature),
            "pose": rotations(armature),
        }

    before = state()
    steps = actions.LCOLLISION_OT_resolve_action.steps(None, bpy.context, settings())
    is_written = False
    try:
        for text in steps:
            is_written |= "Resolving" in text
            if is_written and "Checking" in text:
                if kind == "engine":
                    module("link").engine().close()
                else:
                    steps.close()
        answer = {"said": "cancelled"}
    except client.EngineError as error:
        answer = {"said": str(error)}
    after = state()
    return answer | {"changed": [name for name in before if before[name] != after[name]]}


def failing_pose(path, kind):
    """Resolve a pose while the check of the result fails because the engine ends."""
    opened = module("link").OpenCharacter
    armature = load(path)
    if kind == "baked":
        held_by(armature, "COPY_ROTATION")(105.0)
    else:
        lower_arm(armature)
    check_of, n = opened.check, 0

    def failing_check(self, *arguments):
        nonlocal n
        n += 1
        if n == 2:
            self.engine.close()
        return check_of(self, *arguments)

    def state():
        return {
            "objects": sorted(bpy.data.objects.keys()),
            "hidden": [one.name for one in bpy.data.objects if one.hide_get()],
            "active": bpy.context.view_layer.objects.active.name,
            "pose": rotations(armature),
        }

    before = state()
    opened.check = failing_check
    try:
        bpy.ops.lcollision.resolve_pose()
        answer = {"said": "nothing"}
    except RuntimeError as error:
        answer = {"said": str(error)}
    opened.check = check_of
    after = state()
    return answer | {"changed": [name for name in before if before[name] != after[name]], "n": n}


def slots(path, clip):
    """Read the curves of an action whose second slot is the armature's."""
    from bl_ext.user_default.lcollision.actions import curves_of

    armature = load(path, clip)
    other = bpy.data.objects.new("other", None)
    data = other.animation_data_create()
    action = bpy.data.actions.new("both")
    data.action = action
    data.action_slot = action.slots.new("OBJECT", "other")
    other.keyframe_insert("location", frame=1)
    armature.animation_data.action = action
    armature.animation_data.action_slot = action.slots.new("OBJECT", "armature")
    armature.pose.bones["LeftArm"].keyframe_insert("rotation_quaternion", frame=1)
    return [sorted({one.data_path for one in curves_of(action, it)}) for it in (other, armature)]


class InWindow:
    """The context of an operator in a window; records its calls."""

    def __init__(self):
        self.told, self.timers = [], 0
        self.workspace = self.window_manager = self
        self.window = None

    def __getattr__(self, name):
        return getattr(bpy.context, name)

    def status_text_set(self, text):
        self.told.append(text)

    def modal_handler_add(self, operator):
        return True

    def event_timer_add(self, step, window):
        self.timers += 1
        return "timer"

    def event_timer_remove(self, timer):
        self.timers -= 1


def modal(path, clip):
    """Run the ticks of an operator as a window does, to its end and to Esc."""
    actions = module("actions")
    armature = load(path, clip)
    answer = {}
    for name, kind, n_ticks in (
        ("checked", actions.LCOLLISION_OT_check_action, None),
        ("resolved", actions.LCOLLISION_OT_resolve_action, None),
        ("escaped", actions.LCOLLISION_OT_resolve_action, 2),
    ):
        reports, context = [], InWindow()

        operator = stand_in(kind, reports)
        armature.animation_data.action = bpy.data.actions[clip]
        assert operator.invoke(context, event("MOUSEMOVE")) == {"RUNNING_MODAL"}
        passed, done, n = operator.modal(context, event("MOUSEMOVE")), {"RUNNING_MODAL"}, 0
        while done == {"RUNNING_MODAL"}:
            is_escaped = n_ticks is not None and n >= n_ticks
            done, n = operator.modal(context, event("ESC" if is_escaped else "TIMER")), n + 1
            time.sleep(0.01)
        answer[name] = {
            "done": [*done],
            "passed": [*passed],
            "reports": reports,
            "told": context.told,
            "timers": context.timers,
            "action": armature.animation_data.action.name,
            "frame": bpy.context.scene.frame_current,
        }
    # The engine ends, and the character is removed, midway.
    for name in ("ended", "gone"):
        reports, context = [], InWindow()
        operator = stand_in(actions.LCOLLISION_OT_check_action, reports)
        operator.invoke(context, event("MOUSEMOVE"))
        operator.modal(context, event("TIMER"))
        if name == "ended":
            # End it at once, as a crash does.
            module("link").engine().close(0.0)
        else:
            bpy.data.objects.remove(armature)
        done = {"RUNNING_MODAL"}
        while done == {"RUNNING_MODAL"}:
            done = operator.modal(context, event("TIMER"))
        answer[name] = {
            "done": [*done],
            "reports": reports,
            "told": context.told,
            "timers": context.timers,
            "going_on": module("link").n_going_on,
        }
    return answer


def stand_in(kind, reports):
    """Return an operator as a window runs it, and keep its reports."""

    def report(self, kinds, text):
        reports.append([*kinds, text])

    return type(
        "StandIn", (module("steps").ModalOperator,), {"steps": kind.steps, "report": report}
    )()


def event(kind):
    return type("Event", (), {"type": kind})


def hung(path):
    """Suspend the engine's process, so that it never answers, and continue."""
    client, operators, started = module("client"), module("operators"), []
    popen = subprocess.Popen

    def start(*arguments, **named):
        started.append(popen(*arguments, **named))
        return started[-1]

    client.subprocess.Popen = start
    armature = load(path)
    (mesh,) = meshes_of(armature)
    # More data than fits into a pipe that nobody reads.
    mesh.modifiers.new("divided", "SUBSURF")
    lower_arm(armature)
    answer = {"first": check()["verdict"], "said": {}, "ended": []}
    pose = rotations(armature)

    def stop():
        os.kill(started[-1].pid, signal.SIGSTOP)

    # In a window, a tick returns without an answer, and Esc ends the operator.
    for kind in (operators.LCOLLISION_OT_check_pose, operators.LCOLLISION_OT_resolve_pose):
        stop()
        reports, context = [], InWindow()
        operator = stand_in(kind, reports)
        operator.invoke(context, event("MOUSEMOVE"))
        for _ in range(3):
            assert operator.modal(context, event("TIMER")) == {"RUNNING_MODAL"}
        answer[kind.__name__] = [*operator.modal(context, event("ESC"))], reports, context.told
        os.kill(started[-1].pid, signal.SIGCONT)
    client._SILENCE = 1.0
    for name in ("check_pose", "resolve_pose", "check_action"):
        check()
        stop()
        try:
            getattr(bpy.ops.lcollision, name)()
        except RuntimeError as error:
            answer["said"][name] = str(error)
        answer["ended"].append(started[-1].wait(60.0))
    settings().live = True
    looked()
    stop()
    lower_arm(armature, 0.0)
    while settings().live:
        module("live")._look()
    answer["said"]["live"] = settings().verdict
    answer["again"] = check()["verdict"]
    after = rotations(armature)
    moved = {name: float(np.abs(np.subtract(after[name], pose[name])).max()) for name in pose}
    answer["moved"] = max(moved.values())
    # Quitting Blender does not wait for the engine, whatever the timeout of requests.
    client._PATIENCE = 1e6
    stop()
    module("link").stop()
    answer["quit"] = started[-1].poll()
    client.subprocess.Popen = popen
    return answer


def modal_pose(path):
    """Resolve a pose tick by tick, with and without moving a bone meanwhile."""
    armature = load(path)
    lower_arm(armature)
    answer = {}
    for name in ("moved", "resolved"):
        reports, context = [], InWindow()
        operator = stand_in(module("operators").LCOLLISION_OT_resolve_pose, reports)
        assert operator.invoke(context, event("MOUSEMOVE")) == {"RUNNING_MODAL"}
        done, is_moved = {"RUNNING_MODAL"}, False
        while done == {"RUNNING_MODAL"}:
            done = operator.modal(context, event("TIMER"))
            if name == "moved" and not is_moved and "Resolving" in str(context.told[-1]):
                lower_arm(armature, 5.0)
                pose, is_moved = rotations(armature), True
            time.sleep(0.01)
        answer[name] = {
            "done": [*done],
            "reports": reports,
            "told": context.told,
            "changed": rotations(armature) != pose,
        }
    return answer | {"after": check()["verdict"]}


def stale(path, clip):
    """Check a pose; change what is shown in every way, and return."""
    armature, scene = load(path, clip), bpy.context.scene
    other = bpy.data.objects.new("other", None)
    scene.collection.objects.link(other)
    scene.frame_set(12)

    def state():
        return [settings().verdict, len(module("drawing").shown()), settings().off_rig]

    def pose():
        lower_arm(armature, 1.0)

    def frame():
        scene.frame_set(13)

    def undone():
        bpy.ops.ed.undo_push(message="before")
        pose()
        bpy.ops.ed.undo_push(message="posed")
        check()
        bpy.ops.ed.undo_push(message="checked")
        # Undo to the same pose, for which the verdict holds, and to another.
        bpy.ops.ed.undo()
        answer["kept"] = state()
        bpy.ops.ed.undo()

    def active():
        bpy.context.view_layer.objects.active = other
        bpy.context.view_layer.update()

    def key():
        meshes_of(armature)[0].modifiers.new("wave", "DISPLACE").strength = 0.01
        bpy.context.view_layer.update()

    def button():
        assert bpy.ops.lcollision.clear() == {"FINISHED"}

    answer = {}
    for change in (pose, frame, key, button, active, undone):
        armature = next(item for item in bpy.data.objects if item.type == "ARMATURE")
        other = bpy.data.objects["other"]
        bpy.context.view_layer.objects.active = armature
        scene = bpy.context.scene
        scene.frame_set(12)
        check()
        # Changes of nothing that is shown.
        bpy.context.view_layer.update()
        other.location.x += 1.0
        bpy.context.view_layer.update()
        before = state()
        change()
        answer[change.__name__] = [before, state()]
    answer["listed"] = drawn("LCOLLISION_PT_panel")
    armature = next(item for item in bpy.data.objects if item.type == "ARMATURE")
    bpy.context.view_layer.objects.active = armature
    assert bpy.ops.lcollision.check_action() == {"FINISHED"}
    frames = [item.frame for item in settings().frames]
    markers = len(bpy.context.scene.timeline_markers)
    bpy.context.scene.frame_set(frames[2])
    jumped = []
    for is_back in (False, True, True):
        bpy.ops.lcollision.jump(is_back=is_back)
        jumped.append(bpy.context.scene.frame_current)
    answer["frames"] = [frames, jumped, markers]
    answer["action"] = settings().verdict
    assert bpy.ops.lcollision.clear() == {"FINISHED"}
    answer["cleared"] = [len(settings().frames), len(bpy.context.scene.timeline_markers)]
    # The live check greys at once what it will check again.
    bpy.context.scene.frame_set(12)
    settings().live = True
    looked()
    colours = module("drawing").colours()
    lower_arm(armature, 1.0)
    grey = module("drawing").colours()
    answer["live"] = [len(np.unique(colours, axis=0)), len(np.unique(grey, axis=0))]
    looked()
    answer["live"].append(len(np.unique(module("drawing").colours(), axis=0)))
    # Its switch shows its state.
    scenes = [settings().live]
    made = bpy.data.scenes.new("second")
    scenes += [made.lcollision.live, "_on_update" in handlers()]
    made.lcollision.live = False
    scenes += [settings().live, "_on_update" in handlers()]
    settings().live = True
    import addon_utils

    addon_utils.disable("bl_ext.user_default.lcollision")
    addon_utils.enable("bl_ext.user_default.lcollision")
    scenes += [settings().live, "_on_update" in handlers()]
    # Blender's event loop would call it at once.
    module("live")._on_load()
    scenes += [settings().live, "_on_update" in handlers()]
    return answer | {"scenes": scenes}


def options(path, clip):
    """Resolve with the panel's options."""
    armature = load(path)
    lower_arm(armature)
    pose = rotations(armature)
    answer = {}

    def reset():
        for name, rows in pose.items():
            armature.pose.bones[name].matrix_basis = Matrix(rows)
        bpy.context.view_layer.update()

    def changed():
        after = rotations(armature)
        return [name for name in pose if not np.allclose(pose[name], after[name], atol=1e-5)]

    def select(*names):
        for bone in armature.pose.bones:
            (bone if hasattr(bone, "select") else bone.bone).select = bone.name in names

    before = check()
    colours = module("drawing").colours()
    answer["colours"] = [colours[:, 1].min(), colours[:, 1].max(), len(colours)]
    settings().only_selected = True
    select()
    try:
        bpy.ops.lcollision.resolve_pose()
    except RuntimeError as error:
        answer["none"] = str(error)
    select("LeftForeArm", "LeftArm")
    assert bpy.ops.lcollision.resolve_pose() == {"FINISHED"}
    answer["selected"] = [settings().verdict, changed()]
    settings().only_selected = False
    reset()
    # Tolerated depths, and places that touch in nearly every pose, do not count.
    deepest = float(before["details"][0].split()[1])
    settings().tolerated = deepest + 0.1
    answer["tolerated"] = check()["verdict"]
    answer["not_counted"] = settings().details
    settings().tolerated = 10.0
    armature.animation_data.action = action = bpy.data.actions[clip]
    armature.animation_data.action_slot = action.slots[0]
    assert bpy.ops.lcollision.check_action() == {"FINISHED"}
    answer["action_not_counted"] = [settings().verdict, settings().details]
    armature.animation_data.action = None
    reset()
    settings().tolerated = 0.0
    for frame in range(1, 11):
        armature.pose.bones["LeftArm"].keyframe_insert("rotation_quaternion", frame=frame)
    assert bpy.ops.lcollision.propose() == {"FINISHED"}
    answer["proposed"] = [settings().proposed, len(module("drawing").shown())]
    answer["tint"] = module("drawing").colours()[0].tolist()
    assert bpy.ops.lcollision.ignore_places() == {"FINISHED"}
    answer["ignored"] = check()["verdict"]
    assert bpy.ops.lcollision.count_places() == {"FINISHED"}
    answer["counted"] = check()["verdict"] == before["verdict"]
    # A range of an action: nothing before or after it changes.
    armature.animation_data.action = action = bpy.data.actions[clip]
    armature.animation_data.action_slot = action.slots[0]
    assert bpy.ops.lcollision.check_action() == {"FINISHED"}
    frames = [item.frame for item in settings().frames]
    settings().use_range = True
    settings().first_frame, settings().last_frame = frames[0], frames[len(frames) // 2]
    assert bpy.ops.lcollision.check_action() == {"FINISHED"}
    within = [item.frame for item in settings().frames]
    points = every_frame(armature, int(action.frame_range[1]) + 1)
    assert bpy.ops.lcollision.resolve_action() == {"FINISHED"}
    answer["range"] = [frames, within, settings().verdict]
    moved = np.abs(np.subtract(every_frame(armature, len(points)), points)).max(axis=(1, 2))
    answer["moved"] = np.flatnonzero(moved > 1e-6).tolist()
    return answer


def decimated(path):
    """Check a mesh whose number of vertices a modifier changes in each pose."""
    armature = load(path)
    (mesh,) = meshes_of(armature)
    fewer = mesh.modifiers.new("fewer", "DECIMATE")
    fewer.decimate_type, fewer.angle_limit = "DISSOLVE", 0.2
    for name, degrees in (("LeftArm", 20.0), ("LeftForeArm", 60.0), ("Spine", 25.0)):
        lower_arm(armature, degrees, name)
    answer = {}
    for name in ("check_pose", "resolve_pose", "check_action", "resolve_action"):
        armature.pose.bones["LeftArm"].keyframe_insert("rotation_quaternion", frame=1)
        try:
            getattr(bpy.ops.lcollision, name)()
        except RuntimeError as error:
            answer[name] = str(error)
    return answer


def errors(path):
    """Request impossible things."""
    answer = {}

    def refused(name, operator):
        try:
            operator()
            answer[name] = "nothing"
        except RuntimeError as error:
            answer[name] = str(error)

    refused("no character", bpy.ops.lcollision.check_pose)
    armature = load(path)
    refused("no action", bpy.ops.lcollision.resolve_action)
    (mesh,) = meshes_of(armature)
    mesh.hide_set(True)
    refused("no mesh", bpy.ops.lcollision.check_pose)
    mesh.hide_set(False)
    link = sys.modules["bl_ext.user_default.lcollision.link"]
    settled = link.Path(link.__file__).with_name("engine.json")
    text = settled.read_text()
    settled.write_text(json.dumps({"python": "/nowhere/python"}))
    refused("no engine", bpy.ops.lcollision.check_pose)
    settled.write_text(text)
    check()
    # The engine dies and is started again.
    link.engine().close()
    answer["again"] = check()
    module = sys.modules["bl_ext.user_default.lcollision"]
    import addon_utils

    addon_utils.disable("bl_ext.user_default.lcollision")
    answer["disabled"] = not hasattr(bpy.types.Scene, "lcollision") and link._engine is None
    addon_utils.enable("bl_ext.user_default.lcollision")
    answer["enabled"] = check()
    module.link.stop()
    return answer


def still(path, folder):
    """Render a pose before and after, with the faces that the add-on draws, for docs/blender.md."""
    drawing = sys.modules["bl_ext.user_default.lcollision.drawing"]
    armature, scene = load(path), bpy.context.scene
    lower_arm(armature)
    scene.render.engine, scene.cycles.samples = "CYCLES", 32
    scene.render.resolution_x, scene.render.resolution_y = 400, 560
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (0.25, 0.28, 0.32, 1.0)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location, camera.rotation_euler = (0.3, -4.2, 1.1), (math.radians(88.0), 0.0, 0.1)
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.rotation_euler = 3.0, (0.7, 0.3, 0.4)
    for item in (camera, sun):
        bpy.context.collection.objects.link(item)
    scene.camera = camera
    for item in bpy.data.objects:
        item.hide_render = item.type == "MESH" and item not in meshes_of(armature)
    red = bpy.data.materials.new("red")
    red.use_nodes = True
    red.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.8, 0.02, 0.02, 1)
    for name, do in (("before", bpy.ops.lcollision.check_pose), ("after", resolve)):
        assert do() == {"FINISHED"}
        corners = drawing.shown()
        mesh = bpy.data.meshes.new(name)
        faces = np.arange(len(corners)).reshape(-1, 3)
        # Shift towards the camera, as the add-on draws over the mesh.
        towards = np.array(camera.location) - corners
        mesh.from_pydata((corners + 0.05 * towards).tolist(), [], faces.tolist())
        mesh.materials.append(red)
        crossing = bpy.data.objects.new(name, mesh)
        bpy.context.collection.objects.link(crossing)
        scene.render.filepath = f"{folder}/{name}.png"
        bpy.ops.render.render(write_still=True)
        crossing.hide_render = True
    return told()


def resolve():
    return bpy.ops.lcollision.resolve_pose()


def bones_of_bvh(path):
    """Return the bone heads of a BVH file by frame, from Blender's own importer."""
    bpy.ops.import_anim.bvh(filepath=path, frame_start=0, update_scene_duration=True)
    (armature,) = (item for item in bpy.data.objects if item.type == "ARMATURE")
    first, last = map(int, armature.animation_data.action.frame_range)
    frames = []
    for frame in range(first, last + 1):
        bpy.context.scene.frame_set(frame)
        bones = armature.evaluated_get(bpy.context.evaluated_depsgraph_get()).pose.bones
        frames.append({bone.name: list(armature.matrix_world @ bone.head) for bone in bones})
    return frames


def main(tasks):
    """Install the add-on, run one of the tasks, and write its result."""
    archive, answer, task, *arguments = sys.argv[1:]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    installed = bpy.ops.extensions.package_install_files(
        filepath=archive, repo="user_default", enable_on_install=True
    )
    assert installed == {"FINISHED"}
    told = tasks[task](*arguments)
    with open(answer, "w") as file:  # noqa: PTH123
        json.dump(told, file)
    sys.modules["bl_ext.user_default.lcollision.link"].stop()


if __name__ == "__main__":
    main(globals())
