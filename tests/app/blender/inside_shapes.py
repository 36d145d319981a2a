"""Tasks of shape tests inside Blender."""

import bpy
import inside


def played(file, n_frames):
    """Return a character's world vertices in frames of its clip, or in its file's stored pose."""
    scene = bpy.context.scene
    scene.render.fps = 30
    bpy.ops.import_scene.gltf(filepath=file)
    armature = next(item for item in bpy.data.objects if item.type == "ARMATURE")
    answer = []
    for frame in range(int(n_frames)):
        scene.frame_set(frame)
        answer.append(inside.world_points(armature))
    return answer


if __name__ == "__main__":
    inside.main(globals())
