"""Tasks of FBX tests inside Blender."""

import json

import bpy
import inside
import numpy as np


def exported(body, folder, rates):
    """Write clips of each rate as FBX, with a shape key that a group of vertices masks.

    Returns
    -------
    points : world vertices in each frame, by the name of the clip, as given by Blender
    """
    armature, scene, random = inside.load(body), bpy.context.scene, np.random.default_rng(7)
    (mesh,) = inside.meshes_of(armature)
    for name in ("Basis", "Long"):
        key = mesh.shape_key_add(name=name)
    for vertex, point in zip(mesh.data.vertices, key.data, strict=True):
        point.co = vertex.co * 1.2
    mask = mesh.vertex_groups.new(name="mask")
    for vertex in mesh.data.vertices:
        mask.add([vertex.index], (vertex.index % 5) / 4, "REPLACE")
    key.vertex_group = mask.name
    for item in bpy.data.objects:
        item.select_set(item in (armature, mesh))
    bones = [armature.pose.bones[name] for name in ("LeftArm", "Hips")]
    armature.animation_data_create()
    answer = {}
    for name, (fps, base, first, count) in json.loads(rates).items():
        armature.animation_data.action = bpy.data.actions.new(name)
        mesh.data.shape_keys.animation_data_clear()
        scene.render.fps, scene.render.fps_base = fps, base
        frames = range(first, first + count)
        scene.frame_start, scene.frame_end = first, frames[-1]
        for frame in frames:
            for bone in bones:
                bone.rotation_mode = "XYZ"
                bone.rotation_euler = random.normal(0.0, 0.3, 3)
                bone.keyframe_insert("rotation_euler", frame=frame)
            key.value = random.random()
            key.keyframe_insert("value", frame=frame)
        answer[name] = []
        for frame in frames:
            scene.frame_set(frame)
            answer[name].append(inside.world_points(armature))
        bpy.ops.export_scene.fbx(
            filepath=f"{folder}/{name}.fbx",
            # Without the objects that display the bones.
            use_selection=True,
            bake_anim_use_all_actions=False,
            bake_anim_use_nla_strips=False,
            # Simplified keys would be off by a thousandth.
            bake_anim_simplify_factor=0.0,
        )
    return answer


if __name__ == "__main__":
    inside.main(globals())
