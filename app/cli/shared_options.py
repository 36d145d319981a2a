"""Arguments and options that several commands take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from lcollision_core.devices import Device
from lcollision_core.errors import LCollisionError

Axis = Literal["x", "y", "z"]

ModelArgument = Annotated[
    str,
    typer.Argument(metavar="M", help="The file of a model or a character, or a model's name."),
]
MeshesArgument = Annotated[
    list[Path],
    # readable=False: read_mesh reports the error and the file itself.
    typer.Argument(
        metavar="MESH...",
        readable=False,
        help="OBJ, PLY, OFF, STL, GLB, glTF, VRM or FBX files, or folders of them.",
    ),
]
PoseSetArgument = Annotated[
    Path,
    typer.Argument(
        metavar="DATASET",
        readable=False,
        help="A folder of meshes, an .npz file, a character with animations or a point cache.",
    ),
]
PosesArgument = Annotated[
    Path, typer.Argument(metavar="POSES", readable=False, help="A .json file of poses.")
]
RowsOption = Annotated[
    int | None,
    typer.Option("--rows", min=1, metavar="N", help="Use the first N rows. Default: all."),
]
ThreadsOption = Annotated[
    int | None,
    typer.Option(min=1, max=1024, metavar="N", help="Threads. Default: one per core."),
]
DeviceOption = Annotated[
    Device,
    typer.Option(
        help="Device that checks batches of poses; auto uses a GPU (needs the extra gpu) if there "
        "is one and the batch is large enough.",
    ),
]
ErrorBoundOption = Annotated[
    float,
    typer.Option(
        "--error-bound",
        min=0.0,
        max=0.5,
        metavar="E",
        help="Replace the exact check by the estimate where the predictor is sure, so that at most "
        "this share of all verdicts is wrong, as measured on its latent box; 0.001 is one in a "
        "thousand.",
    ),
]
JointsOption = Annotated[
    Path | None,
    typer.Option(
        "--joints",
        metavar="FILE",
        help="For motions of another skeleton: which of its joints each joint of the body follows, "
        'as a JSON file {"joints": {"body joint": "motion joint", ...}}; null for none. Joints '
        "that are not named are found by names and places. Default: what was chosen in the editor.",
    ),
]
ScaleOption = Annotated[
    float,
    typer.Option(
        "--scale",
        metavar="S",
        help="Converts the meshes to the model's unit: 0.001 takes millimetres to metres. "
        "Results are in the meshes' own unit.",
    ),
]
RestOption = Annotated[
    Path | None,
    typer.Option(
        metavar="MESH",
        readable=False,
        help="The rest pose of the meshes: body size and distances are measured on it, and pairs "
        "that touch in it are not counted.",
    ),
]
ClearanceOption = Annotated[
    float,
    typer.Option(
        "--clearance",
        metavar="C",
        min=0.0,
        max=1.0,
        help="Distance to keep between parts, in body sizes: faces that are nearer count as "
        "colliding. Parts near at rest may come to half their rest distance.",
    ),
]
TouchOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="A:B",
        help="With --clearance, these two groups of faces may touch: meshes, materials, body parts "
        "or components. May be repeated.",
    ),
]
NoRulesOption = Annotated[
    bool, typer.Option("--no-rules", help="Count all pairs and ignore the character's rules.")
]

PosesOutput = Annotated[
    Path, typer.Option("--output", "-o", metavar="POSES", help="The .json file to write.")
]
ModelOutput = Annotated[
    str,
    typer.Option(
        "--output",
        "-o",
        metavar="M",
        help="The .safetensors file to write; a name alone stores it with your models.",
    ),
]
FormOutput = Annotated[
    str,
    typer.Option(
        "--output",
        "-o",
        metavar="OUT",
        help="A mesh file for one pose, a folder for several, a .pc2 or .mdd file with all as "
        "frames, or a .json file.",
    ),
]

InPlaceOption = Annotated[
    bool,
    typer.Option("--in-place", help="Let the output replace a file that the command reads."),
]


def touch_entries(touch: list[str] | None, clearance: float) -> tuple[str, ...]:
    """Return the entries of --touch.

    Raises
    ------
    LCollisionError : there are some, and no clearance.
    """
    if touch and clearance == 0.0:
        raise LCollisionError("--touch needs --clearance", "add that, or leave it out")
    return tuple(touch or ())
