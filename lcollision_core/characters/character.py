"""A character as its file has it: meshes joined for computing, a rig, and clips."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lcollision_core.characters.character_file import CharacterFile
from lcollision_core.meshes.appearance import Appearance
from lcollision_core.meshes.face_groups import FaceGroup
from lcollision_core.meshes.formats.scene import MOST_KEYS_PER_SECOND
from lcollision_core.meshes.formats.smpl import SmplModel
from lcollision_core.meshes.scene_files import as_file_error
from lcollision_core.meshes.topology import FloatArray, Topology

NO_JOINTS = "has no joints to pose it by"
"""What is wrong with a file without a skin where a rig is needed."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A skeleton with linear blend skinning.

    Vertex v of a pose whose joints have the global transforms G is
    sum_i weights[v, i] T_j points[v, i] with j = joint_of[v, i] and T_j = G_j rest[j]^-1.

    Attributes
    ----------
    joint_names : J names as in the file, unique
    parents : (J,) int64 array, each joint's parent, -1 for a root; parents come before children
    rest : (J, 4, 4) float64 array, the joints' global transforms in the rest pose, in the
        character's frame and unit
    nodes : (J,) int64 array, the number of each joint's node in the file
    joint_of : (V, I) int32 array, the joints that move each vertex
    weights : (V, I) float64 array >= 0, each row sums to 1
    points : (V, I, 3) float64 array: where each of these joints alone has the vertex in the rest
        pose; all the same where the rest pose is the bind pose
    chosen : what the user says that joints are, by their names: of `anatomy.ROLE_NAMES`
    stretch : (J, 3, 3) float64 array, positive definite: how what is above each joint is scaled at
        rest, P of the polar decomposition P Q of its linear part, the largest scale 1. Turning the
        joint in its file by R then turns the vertices by P Q R (P Q)^-1, which is a rotation only
        for P = 1. None where all are 1.
    moving : (J,) bool array, joints that turn about any axis; the others do not turn. None where
        what a joint is says how it turns.
    pose_shapes : (V, 3, 9 (J - 1)) float32 array, what each entry of R - I adds to `points`, of the
        rotations R of all joints but the first against their parents, in the character's axes, row
        by row (the pose blend shapes of SMPL). None where poses shape nothing.
    file_parents : (J,) int64 array, each joint's parent in the file, which may come later; None
        where all are `parents`: see `loose_ends`
    """

    joint_names: tuple[str, ...]
    parents: npt.NDArray[np.int64]
    rest: FloatArray
    nodes: npt.NDArray[np.int64]
    joint_of: npt.NDArray[np.int32]
    weights: FloatArray
    points: FloatArray
    chosen: Mapping[str, str] = field(default_factory=dict)
    stretch: FloatArray | None = None
    moving: npt.NDArray[np.bool_] | None = None
    pose_shapes: npt.NDArray[np.float32] | None = None
    file_parents: npt.NDArray[np.int64] | None = None

    @property
    def own_parents(self) -> npt.NDArray[np.int64]:
        """(J,) int64 array, each joint's parent in the file."""
        return self.parents if self.file_parents is None else self.file_parents


@dataclass(frozen=True, eq=False)
class ClipFrames:
    """Frames of one animation.

    Attributes
    ----------
    clip : its name
    names : N names, as "moves 12", numbered from 0 by frame
    times : (N,) float64 array, in seconds
    transforms : (N, J, 4, 4) float64 array, global transforms of the rig's joints; None without rig
    skin : makes `vertices`, which takes long
    shown : of frames that the transforms alone do not say, as they weigh morph targets or hide a
        part, what makes the (V, 3) vertices of one
    """

    clip: str
    names: tuple[str, ...]
    times: FloatArray
    transforms: FloatArray | None
    skin: Callable[[], FloatArray]
    shown: Mapping[int, Callable[[], FloatArray]] = field(default_factory=dict)

    @cached_property
    def vertices(self) -> FloatArray:
        """(N, V, 3) float64 array, as the file says, in the character's frame and unit."""
        return self.skin()


@dataclass(frozen=True, eq=False)
class Character:
    """A character, its vertices at equal places with equal weights in all frames joined.

    Attributes
    ----------
    name : the file's, without extension
    source : its file
    topology : of the joined vertices; faces that joining makes degenerate are left out
    rest_vertices : (V, 3) float64 array, the rest pose in the file's frame and unit
    joined : (W,) int64 array: the joined vertex of each of the file's W vertices, in the order of
        the file's meshes and primitives
    up : (3,) float64 array, a signed unit axis: what the file says, else a guess
    up_is_sure : whether the file says so, or the guess leaves no doubt
    metres : length of the file's unit
    groups : named meshes and materials, of the joined faces
    rig : None for one without joints
    clips : lengths in seconds of its animations, by their names
    sample : (clip, fps) to its frames; None for the clip's own key frames at at most 30 a second,
        an array for frames at (N,) times
    notes : sentences on what was changed on reading
    no_rig : what is wrong with the file where `rig` is None
    file : what was read of it; None for one that is not from a file of a scene
    smpl : the body model that it has its shape of; None of other files
    """

    name: str
    source: Path
    topology: Topology
    rest_vertices: FloatArray
    joined: npt.NDArray[np.int64]
    up: FloatArray
    up_is_sure: bool
    metres: float
    groups: tuple[FaceGroup, ...]
    rig: Rig | None
    clips: Mapping[str, float]
    sample: Callable[[str, float | FloatArray | None], ClipFrames]
    notes: tuple[str, ...] = ()
    no_rig: str = NO_JOINTS
    file: CharacterFile | None = None
    smpl: SmplModel | None = None

    def look(self) -> Appearance | None:
        """Read how it looks, which takes long the first time; None where no file says that.

        Raises
        ------
        MeshFileError : the file is damaged.
        """
        if self.file is None:
            return None
        with as_file_error(self.source):
            return self.file.appearance

    def rate(self, clip: str) -> float:
        """Return how many frames a second a clip has: see `Clip.rate`; it raises as `sample`."""
        clips = () if self.file is None else self.file.scene.clips
        with as_file_error(self.source):
            return next((one.rate for one in clips if one.name == clip), MOST_KEYS_PER_SECOND)
