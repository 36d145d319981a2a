"""Tasks that prepare motions for cloth inside Blender: see `inside.py`."""

from pathlib import Path

import bpy
import inside
import inside_actions
import numpy as np


def frames_of(armature, first, last, subframes):
    """Return the (n, W, 3) world vertices in frames and between them, as given by Blender."""
    found, scene = [], bpy.context.scene
    for at in range((last - first) * (subframes + 1) + 1):
        whole, rest = divmod(at, subframes + 1)
        scene.frame_set(first + whole, subframe=rest / (subframes + 1))
        found.append(inside.world_points(armature))
    return np.array(found)


def prepare(path, clip, output, gap, subframes, folder, first="", last=""):
    """Prepare an action for cloth; write the points before and after, and the faces, to files.

    Without a clip, an arm swings down and up again. Without a range, all frames are used.
    """
    armature = inside.load(path, clip or None)
    if not clip:
        inside_actions.swing(armature, ((1, 0.0), (20, 40.0), (40, 0.0)))
    settings, subframes = inside.settings(), int(subframes)
    if first:
        settings.use_range, settings.first_frame, settings.last_frame = True, int(first), int(last)
    first, last = map(round, armature.animation_data.action.frame_range)
    if settings.use_range:
        first, last = settings.first_frame, settings.last_frame
    settings.cloth_output, settings.cloth_folder = output, folder
    settings.cloth_gap, settings.cloth_subframes = float(gap), subframes
    before = frames_of(armature, first, last, subframes)
    said = inside_actions.reported(inside.module("cloth").LCOLLISION_OT_prepare_cloth)
    shown = bpy.context.view_layer.objects.active
    np.savez(
        f"{folder}/frames.npz",
        before=before,
        after=frames_of(shown, first, last, subframes),
        faces=inside.triangles(shown),
    )
    meshes = inside.meshes_of(shown)
    return {
        "said": said,
        "verdict": settings.verdict,
        "frames": [[item.frame, item.why] for item in settings.frames],
        "text": bpy.data.texts["Cloth Report"].as_string() if bpy.data.texts else "",
        "action": shown.animation_data.action.name,
        "modifiers": [[one.type for one in item.modifiers] for item in meshes],
        "files": sorted(path.name for path in Path(folder).glob("*.pc2*")),
        "groups": inside.groups_of(shown),
    }


def refused(path, clip, folder):
    """Request caches without a folder for them, then with a bone that cannot be keyed."""
    armature = inside.load(path, clip)
    settings, kind = inside.settings(), inside.module("cloth").LCOLLISION_OT_prepare_cloth
    settings.cloth_output = "CACHE"
    unsaved = inside_actions.reported(kind)
    settings.cloth_folder = f"{folder}/file/caches"
    Path(f"{folder}/file").write_text("", encoding="utf-8")
    unwritable = inside_actions.reported(kind)
    settings.cloth_output = "ACTION"
    for bone in armature.pose.bones:
        bone.lock_rotation = (True, True, True)
    locked = inside_actions.reported(kind)
    return {
        "unsaved": unsaved,
        "unwritable": unwritable,
        "locked": locked,
        "frames": [[item.frame, item.why] for item in settings.frames],
        "text": bpy.data.texts["Cloth Report"].as_string(),
        "modifiers": [[one.type for one in item.modifiers] for item in inside.meshes_of(armature)],
        "action": armature.animation_data.action.name,
    }


if __name__ == "__main__":
    inside.main(globals())
