"""Options of the command line: those of dataclasses, and those that several commands take."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer

from lcollision_core.devices import Device
from lcollision_core.errors import LCollisionError
from lcollision_core.options import Option, limits_of

_BY_NAME = inspect.Parameter.KEYWORD_ONLY


class Excluding(frozenset[str]):
    """In `Annotated` of a command's parameter: fields that are not options of that command."""


def takes_options(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command take dataclasses whose fields with an `Option` become its options.

    Fields without an `Option` keep their defaults; fields without a default become arguments.
    """
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, tuple[Any, list[Field[Any]]]] = {}
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command).parameters.values():
        hint = hints[parameter.name]
        kind, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        if not is_dataclass(kind):
            parameters.append(parameter.replace(annotation=hint, kind=_BY_NAME))
            continue
        left_out = next((extra for extra in extras if isinstance(extra, Excluding)), Excluding())
        options_of_field = _options_of(kind)
        offered = [f for f in fields(kind) if f.name in options_of_field and f.name not in left_out]
        offered.sort(key=lambda field: bool(field.kw_only))
        groups[parameter.name] = kind, offered
        parameters += [_parameter(field, *options_of_field[field.name]) for field in offered]
    parameters.sort(key=lambda parameter: parameter.default is not inspect.Parameter.empty)

    @functools.wraps(command)
    def run(**values: Any) -> None:
        for name, (kind, offered) in groups.items():
            options_of_field = _options_of(kind)
            field_values = {field.name: values.pop(field.name, None) for field in offered}
            values[name] = kind(
                **{
                    field: _read(value, *options_of_field[field])
                    for field, value in field_values.items()
                    if value is not None
                }
            )
        command(**values)

    hinted: Any = run
    hinted.__signature__ = inspect.Signature(parameters)
    hinted.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def refuse_given(context: typer.Context, names: Collection[str], why: str, next_step: str) -> None:
    """Refuse options that would have no effect, even if given with their default values.

    Parameters
    ----------
    names : of the command's parameters
    why : follows the option's name in the error's sentence

    Raises
    ------
    LCollisionError : one of the options is given.
    """
    for option in context.command.params:
        source = context.get_parameter_source(option.name or "")
        if option.name in names and source is not None and source.name == "COMMANDLINE":
            is_off = option.secondary_opts and not context.params[option.name]
            name = (option.secondary_opts if is_off else option.opts)[0]
            raise LCollisionError(f"{name} {why}", next_step)


def _options_of(kind: Any) -> dict[str, tuple[Any, Option]]:
    """Return the type and the option of each field that has one, by name."""
    limits = limits_of(kind).items()
    return {name: (of, option) for name, (of, option) in limits if isinstance(option, Option)}


def _parameter(field: Field[Any], kind: Any, option: Option) -> inspect.Parameter:
    """Return the command parameter for a field."""
    default = inspect.Parameter.empty if field.default is MISSING else field.default
    given: dict[str, Any] = {"help": option.help, "metavar": option.metavar, "readable": False}
    if tuple in _origins(kind):
        kind, default = list[str], default or None
        kind = kind if default is inspect.Parameter.empty else kind | None
    elif option.words or option.choices:
        kind = Literal[option.words or option.choices]
        kind = kind | None if default is None else kind
    else:
        given |= {"min": option.low, "max": option.below if option.high is None else option.high}
    is_argument = default is inspect.Parameter.empty
    described = typer.Argument(**given) if is_argument else typer.Option(*option.names, **given)
    return inspect.Parameter(
        field.name,
        _BY_NAME,
        default=default,
        annotation=Annotated[kind, described],
    )


def _origins(kind: Any) -> set[Any]:
    """Return the origins of a type, or of each member of an optional type."""
    kinds = get_args(kind) if NoneType in get_args(kind) else (kind,)
    return {get_origin(kind) or kind for kind in kinds}


def _read(value: Any, kind: Any, option: Option) -> Any:
    """Convert a command line value to the field's type."""
    if option.words:
        return option.words.index(value)
    return tuple(value) if tuple in _origins(kind) else value


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


def require_one_workplace(workers: int | None, scheduler: str | None) -> None:
    """Raise if both threads of this machine and a cluster are asked for.

    Raises
    ------
    LCollisionError : they are.
    """
    if workers is not None and scheduler is not None:
        what = "--workers and --scheduler can't be used together"
        raise LCollisionError(what, "the cluster has its own workers")


def touch_entries(touch: list[str] | None, clearance: float) -> tuple[str, ...]:
    """Return the entries of --touch.

    Raises
    ------
    LCollisionError : there are some, and no clearance.
    """
    if touch and clearance == 0.0:
        raise LCollisionError("--touch needs --clearance", "add that, or leave it out")
    return tuple(touch or ())
