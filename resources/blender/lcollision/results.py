# SPDX-License-Identifier: GPL-3.0-or-later
"""The last results, shown in the panel and over the mesh while they apply to what is shown."""

from dataclasses import dataclass

import bpy
import numpy as np
from bpy.app.handlers import persistent

from . import drawing
from .scene import Rigged, SceneError

MARKER = "collides"
"""Name of the markers of colliding frames."""


@dataclass(frozen=True, eq=False)
class Shown:
    """A character as shown at one time.

    Attributes
    ----------
    scene, armature, meshes : names
    transforms : (J, 4, 4) of the bones
    vertices : (W, 3)
    world : (4, 4) from the armature's coordinates
    """

    scene: str
    armature: str
    meshes: tuple[str, ...]
    transforms: np.ndarray
    vertices: np.ndarray
    world: np.ndarray

    @classmethod
    def of(cls, rigged: Rigged) -> "Shown":
        """Read the character as shown now."""
        return cls(
            bpy.context.scene.name,
            rigged.armature.name,
            tuple(one.name for one in rigged.meshes),
            rigged.transforms(),
            rigged.shown(),
            rigged.to_world(),
        )

    def is_of(self, rigged: Rigged) -> bool:
        """Return whether a character is still shown like this."""
        names = (bpy.context.scene.name, rigged.armature.name)
        return (
            names == (self.scene, self.armature)
            and np.array_equal(self.transforms, rigged.transforms())
            and np.array_equal(self.world, rigged.to_world())
            and np.array_equal(self.vertices, rigged.shown())
        )


_shown: Shown | None = None
"""The character to which the drawn faces and the verdict on a pose apply."""
_reply: dict | None = None
"""The check that found these faces; None for faces of another origin."""
_is_looking = False
is_stale = False
"""Whether the pose has changed since, and the live check will soon check it."""


def show(rigged: Rigged, reply: dict, shown: Shown) -> None:
    """Show the result of a check of `shown`, in the panel and over the mesh."""
    global _reply
    _say(rigged, reply)
    pairs = array(reply["faces"]).reshape(-1, 2)
    deepest = np.zeros(max(len(rigged.triangles()), pairs.max(initial=-1) + 1))
    for faces in pairs.T:
        np.maximum.at(deepest, faces, array(reply["depths"]))
    chosen = np.unique(pairs)
    tint(rigged, chosen, drawing.by_depth(deepest[chosen]), shown)
    if _shown is not None:
        _reply = reply


def _say(rigged: Rigged, reply: dict) -> None:
    settings = bpy.context.scene.lcollision
    settings.left_out = rigged.left_out_lines()
    settings.show(reply, rigged.armature.name)


def tint(rigged: Rigged, faces: np.ndarray, colours: np.ndarray, shown: Shown) -> None:
    """Show faces in (n, 4) colours, replacing those shown before."""
    global _shown, _reply, is_stale
    triangles, world = rigged.triangles(), shown.world
    is_there = faces < len(triangles)
    corners = shown.vertices[triangles[faces[is_there]].ravel()] @ world[:3, :3].T + world[:3, 3]
    drawing.show(corners, colours[is_there], {shown.armature, *shown.meshes})
    _shown, _reply, is_stale = shown, None, False
    refresh()


def clear() -> None:
    """Show no faces, and withdraw the verdict on the pose."""
    global _shown, _reply, is_stale
    _shown, _reply, is_stale = None, None, False
    drawing.clear()
    settings = bpy.context.scene.lcollision
    if settings.is_of_pose:
        settings.forget()


def clear_frames(scene: bpy.types.Scene) -> None:
    """Clear the list of colliding frames and their markers; the user's own markers stay."""
    markers, frames = scene.timeline_markers, scene.lcollision.frames
    listed = {item.frame for item in frames}
    for marker in [one for one in markers if one.name == MARKER and one.frame in listed]:
        markers.remove(marker)
    frames.clear()


def refresh() -> None:
    """Withdraw outdated results, or show them in grey if the live check will update them."""
    global is_stale
    settings = bpy.context.scene.lcollision
    if _shown is None:
        # Undo and loading a file bring back the verdict, but not its subject.
        if settings.is_of_pose:
            settings.forget()
        return
    try:
        rigged = Rigged.of(bpy.context)
        is_so = _shown.is_of(rigged)
    except SceneError:
        is_so = False
    if is_so and _reply is not None and not settings.is_of_pose:
        # Undo removes the verdict, too: restore it.
        _say(rigged, _reply)
    if not is_so and not settings.live:
        clear()
    elif is_so == is_stale:
        is_stale = not is_so
        drawing.grey(is_stale)


@persistent
def _on_change(*_: object) -> None:
    global _is_looking
    # A render changes frames by itself.
    if _is_looking or bpy.app.is_job_running("RENDER"):
        return
    _is_looking = True
    try:
        refresh()
    finally:
        _is_looking = False


@persistent
def _on_load(*_: object) -> None:
    clear()


def array(values: dict) -> np.ndarray:
    """Return an array from the engine's answer."""
    return np.frombuffer(values["data"], values["dtype"]).reshape(values["shape"])


class LCOLLISION_OT_clear(bpy.types.Operator):
    """Clear the results: coloured faces, verdict, frames and markers"""

    bl_idname = "lcollision.clear"
    bl_label = "Clear"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set:
        """Clear all results."""
        clear()
        context.scene.lcollision.forget()
        clear_frames(context.scene)
        return {"FINISHED"}


class LCOLLISION_OT_jump(bpy.types.Operator):
    """Go to the next or previous frame that collides"""

    bl_idname = "lcollision.jump"
    bl_label = "Colliding Frame"
    bl_options = {"REGISTER"}

    is_back: bpy.props.BoolProperty(name="Previous")

    def execute(self, context: bpy.types.Context) -> set:
        """Go to the frame."""
        scene = context.scene
        frames = [item.frame for item in scene.lcollision.frames]
        if self.is_back:
            ahead = [at for at, one in enumerate(frames) if one < scene.frame_current][-1:]
        else:
            ahead = [at for at, one in enumerate(frames) if one > scene.frame_current][:1]
        if not ahead:
            where = "before" if self.is_back else "after"
            self.report({"INFO"}, f"No frame {where} this one is known to collide")
            return {"CANCELLED"}
        scene.lcollision.frame = ahead[0]
        return {"FINISHED"}


_CLASSES = (LCOLLISION_OT_clear, LCOLLISION_OT_jump)


def _handlers() -> tuple:
    on = bpy.app.handlers
    changes = (on.depsgraph_update_post, on.frame_change_post, on.undo_post, on.redo_post)
    return (*((one, _on_change) for one in changes), (on.load_post, _on_load))


def register() -> None:
    """Add the operators and the handlers of changes."""
    for one in _CLASSES:
        bpy.utils.register_class(one)
    for handlers, own in _handlers():
        handlers.append(own)


def unregister() -> None:
    """Remove the operators, the handlers and the drawn faces."""
    global _shown, is_stale
    _shown, is_stale = None, False
    drawing.clear()
    for handlers, own in _handlers():
        handlers.remove(own)
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
