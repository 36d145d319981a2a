"""What is asked for when poses are written as meshes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from lcollision_core.mesh_formats import MESH_FORMATS
from lcollision_core.options.field import Option


class ExportAxes(StrEnum):
    """For which program a mesh is written: its axes, and its unit.

    Each is what the program's own importer, with its default settings, puts upright and facing
    its front: Blender's turns an OBJ file from y up to z up and leaves PLY and STL unchanged;
    Maya takes y up and centimetres; Unreal takes centimetres and z up, x forward, and itself
    turns y round, as its axes are left-handed.
    """

    MODEL = "model"
    Y_UP = "y-up"
    BLENDER = "blender"
    MAYA = "maya"
    UNREAL = "unreal"


@dataclass(frozen=True)
class ExportRequest:
    """How poses are written as meshes.

    Attributes
    ----------
    axes : one of `ExportAxes`
    scale : the file's units in one of the model's; those of the axes if None
    like : the user's file whose form is kept; None for a character's own where that can be written
    form : the key of one of the forms that it offers, see `EXPORT_FORMS`; None for the best
    keep_clips : whether a character's file keeps its clips beside a pose in its joints
    fps : frames a second of a motion
    mesh_format : of the meshes in a folder; None for that of `like` or of a character, else obj
    """

    axes: Annotated[
        str,
        Option(
            "Use this program's axes, and its unit if the model is in metres.",
            choices=tuple(ExportAxes),
        ),
    ] = ExportAxes.MODEL
    scale: Annotated[
        float | None,
        Option(
            "File units per model unit. Default: 100 for maya and unreal, else 1.",
            metavar="X",
            low=1e-6,
            high=1e6,
        ),
    ] = None
    like: Annotated[
        Path | None,
        Option(
            "Your own OBJ, GLB, VRM or FBX file of this body: the output is that file in another "
            "pose (an FBX as GLB), or point caches of its meshes. Default for a character: its own "
            "file.",
            metavar="FILE",
        ),
    ] = None
    form: Annotated[
        str | None,
        Option(
            "How a GLB stores the pose: turned joints, a static mesh or a morph target; or all "
            "poses as the frames of a clip. Default: joints if the pose came from joints, else "
            "mesh.",
            choices=("joints", "mesh", "morph", "clip"),
        ),
    ] = None
    keep_clips: Annotated[
        bool,
        Option(
            "Keep the clips of a character's file beside the pose, which the joints then hold. "
            "Programs that play a clip on opening show that first. Default: left out.",
        ),
    ] = False
    fps: Annotated[
        float,
        Option("Frames per second of a clip or an .mdd file.", metavar="N", low=0.01, high=1000),
    ] = 30.0
    mesh_format: Annotated[
        str | None,
        Option(
            "Format of the meshes in a folder. Default: obj; glb with --like and for a character.",
            ("--format",),
            choices=tuple(MESH_FORMATS),
        ),
    ] = None


MODELS_OWN = ExportRequest()
"""Axes, unit and vertex order of the model."""
