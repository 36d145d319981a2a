"""Read the motions of a body: its own clips, those of other files, or a scene's together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lcollision_core.errors import MeshFileError
from lcollision_core.jobs import Job
from lcollision_core.options import MotionChoice

if TYPE_CHECKING:
    from lcollision_core.bodies import Body
    from lcollision_core.bodies.partners import JointMatch
    from lcollision_core.motion import Motion


def read_motions(body: Body, path: Path, clip: str | None, job: Job) -> list[Motion]:
    """Read the motions of a file at their own rate: see `bodies.motions.read_motions`.

    A scene's own motion is that of all its bodies together.
    """
    from lcollision_core.bodies import as_scene
    from lcollision_core.bodies.motions import read_motions as read
    from lcollision_core.tasks.scenes import scene_motion

    scene = as_scene(body)
    if scene is not None and path == own_motions(body)[0]:
        motion = scene_motion(scene, (), MotionChoice(), job)[0]
        return [motion if clip is None else replace(motion, name=clip)]
    return read(body, path, clip, None, job)


def own_motions(body: Body) -> tuple[Path | None, tuple[str, ...]]:
    """Return the file and names of a body's own motions; a scene has one motion of all bodies."""
    from lcollision_core.bodies import as_scene

    scene = as_scene(body)
    if scene is None:
        return body.own_file, body.own_clips
    names = dict.fromkeys(clip for clip, _ in scene.plays.values())
    if not names or scene.file is None or not scene.file.path:
        return None, ()
    return Path(scene.file.path), (" + ".join(names),)


@dataclass(frozen=True, eq=False)
class OpenedMotions:
    """The contents of a motion file.

    Attributes
    ----------
    body : the open body, or that body in the shape of the motions
    motions : empty if only a user can match the joints
    joints : the joint matching, None if the motions are of the body's own joints
    """

    body: Body
    motions: list[Motion]
    joints: JointMatch | None


def open_motions(body: Body, path: Path, job: Job) -> OpenedMotions:
    """Read the motions of a file at their own rate, for a body.

    Raises
    ------
    LCollisionError : the file can't be read, or the body can't follow its motion.
    """
    from lcollision_core.bodies.motions import body_of_motion as in_shape
    from lcollision_core.bodies.motions import is_retargeted
    from lcollision_core.bodies.retargeting import joint_match

    joints = joint_match(body, path) if is_retargeted(body, path) else None
    try:
        shaped, notes = in_shape(body, path)
    except MeshFileError:
        if joints is None or not joints.unsure:
            raise
        return OpenedMotions(body, [], joints)
    if shaped is not body:
        for sentence in notes:
            shaped = shaped.noted(sentence)
    return OpenedMotions(shaped, read_motions(shaped, path, None, job), joints)
