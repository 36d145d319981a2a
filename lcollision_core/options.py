"""User options, declared once for the command line, the dialogs and files.

Importing this module loads no array library, so that the command line starts quickly.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

from lcollision_core.errors import LCollisionError
from lcollision_core.files.formats import WRITABLE_SUFFIXES

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from lcollision_core.meshes import ContactRules, FaceGroup, Topology


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a numeric field of a dataclass, given in the `Annotated` of its type.

    Attributes
    ----------
    low, high : inclusive limits
    above, below : exclusive limits
    """

    low: float | None = None
    high: float | None = None
    above: float | None = None
    below: float | None = None


@dataclass(frozen=True)
class Option(Limits):
    """Help text and limits of a field.

    Attributes
    ----------
    help : a sentence or two
    names : names on the command line; by default that of the field
    metavar : placeholder for the value in the help of the command line
    choices : allowed values
    words : labels shown to the user; the value is the index of one
    """

    help: str
    names: tuple[str, ...] = ()
    metavar: str | None = None
    choices: tuple[str, ...] = ()
    words: tuple[str, ...] = ()


@cache
def limits_of(cls: Any) -> dict[str, tuple[Any, Limits]]:
    """Return the type and the `Limits` of each field that has some, by name."""
    hints = get_type_hints(cls, include_extras=True)
    limits = {}
    for attribute in fields(cls):
        hint = hints[attribute.name]
        if get_origin(hint) is Annotated and isinstance(get_args(hint)[1], Limits):
            limits[attribute.name] = get_args(hint)[:2]
    return limits


def require_limits(values: Any) -> None:
    """Refuse a dataclass with a value that is beyond its limits or not one of its choices.

    Raises
    ------
    LCollisionError : names the first such value.
    """
    cls: Any = type(values)
    for name, (_, limits) in limits_of(cls).items():
        value = getattr(values, name)
        if value is not None and (expected := _violated_condition(value, limits)):
            field_name = f"the {name.replace('_', ' ')}" if isinstance(limits, Option) else name
            got = f"{value:g}" if isinstance(value, float) else value
            raise LCollisionError.must_be(field_name, expected, got)


def _violated_condition(value: Any, limits: Limits) -> str:
    """Return the condition that a value violates, or an empty string."""
    if isinstance(limits, Option) and (limits.choices or limits.words):
        allowed: tuple[Any, ...] = limits.choices or tuple(range(len(limits.words)))
        return "" if value in allowed else ", ".join(map(str, allowed))
    if not isinstance(value, int | float):
        return ""
    met = {
        f"at least {limits.low}": limits.low is None or value >= limits.low,
        f"at most {limits.high}": limits.high is None or value <= limits.high,
        f"over {limits.above}": limits.above is None or value > limits.above,
        f"below {limits.below}": limits.below is None or value < limits.below,
        "finite": math.isfinite(value),
    }
    return next((expected for expected, is_met in met.items() if not is_met), "")


class SampleDistribution(StrEnum):
    """Distribution of samples: the latent box alone, as in the paper, or mixed.

    Of mixed samples, half are drawn from the box; a quarter are blends of training poses with
    noise, or combine parts of different poses; a quarter lie near the border of the free set.
    """

    BOX = "box"
    MIXED = "mixed"


@dataclass(frozen=True, kw_only=True)
class RuleOptions:
    """Changes to contact rules; None leaves a rule unchanged, groups are added to existing ones.

    Attributes
    ----------
    near_exclusion, rest_exclusion, tolerated_depth, joint_exclusion : see `ContactRules`
    ignored : "A:B", names of groups of faces whose pairs do not count
    left_out : names of groups of faces that are not checked
    tolerated_pairs : "A:B=DEPTH", names of groups of faces and the tolerated depth of their pairs
    """

    near_exclusion: Annotated[
        float | None,
        Option(
            "Do not count pairs within X body sizes along the surface; report them separately. "
            "Default: what the character's own rules say, else 0.",
            metavar="X",
            low=0,
            below=1,
        ),
    ] = None
    rest_exclusion: Annotated[
        float | None,
        Option(
            "Do not count pairs that touch in the rest pose, or within R body sizes of such a pair "
            "along the surface. 0: those pairs only.",
            metavar="R",
            low=0,
            below=1,
        ),
    ] = None
    joint_exclusion: Annotated[
        bool | None,
        Option(
            "Do not count pairs of parts linked by a joint where both faces are within a limb's "
            "thickness of it. On by default for a character with joints.",
            ("--joint-exclusion/--no-joint-exclusion",),
        ),
    ] = None
    ignored: Annotated[
        tuple[str, ...] | None,
        Option(
            "Do not count pairs between these two groups of faces: meshes, materials, body parts "
            "or components, as in 'component 1:component 2' (component 1 has the most faces). May "
            "be repeated.",
            ("--ignore",),
            metavar="A:B",
        ),
    ] = None
    left_out: Annotated[
        tuple[str, ...],
        Option(
            "Leave a mesh, material, body part or component out of the check, such as a weapon "
            "that has a stand-in. It is still posed and exported. May be repeated.",
            ("--leave-out",),
            metavar="NAME",
        ),
    ] = ()
    tolerated_depth: Annotated[
        float | None,
        Option("Do not count pairs up to D body sizes deep.", metavar="D", low=0, below=1),
    ] = None
    tolerated_pairs: Annotated[
        tuple[str, ...],
        Option(
            "Do not count pairs between these two groups up to DEPTH body sizes deep, whatever "
            "--tolerated-depth says, as in 'belly:left hand=0.01'. May be repeated.",
            ("--tolerate",),
            metavar="A:B=DEPTH",
        ),
    ] = ()

    @property
    def name_groups(self) -> bool:
        """Whether the options name groups of faces."""
        return bool(self.ignored or self.left_out or self.tolerated_pairs)

    def changed(
        self, rules: ContactRules, names: Collection[str], has_joints: bool, where: str
    ) -> ContactRules:
        """Return the rules with these options applied.

        Parameters
        ----------
        names : names of the mesh's groups of faces
        has_joints : whether some of these groups lie about joints
        where : name of the mesh in error messages

        Raises
        ------
        LCollisionError : a group is not one of `names`, a depth is out of range, or the joint
            exclusion is switched on without joints.
        """
        from lcollision_core.meshes import named_group, named_pair

        if self.joint_exclusion and not has_joints:
            what = "has no joints, which --joint-exclusion needs"
            next_step = "leave the option out, or learn the model again from a rigged character"
            raise LCollisionError(what, next_step, where=where)
        values = {field.name: getattr(self, field.name) for field in fields(RuleOptions)}
        changes: dict[str, Any] = {name: to for name, to in values.items() if to is not None}
        if self.near_exclusion is not None:
            changes["near_by_limb"] = False
        pairs = (named_pair(entry, names) for entry in self.ignored or ())
        left_out = (named_group(entry, names) for entry in self.left_out)
        changes["ignored"] = tuple(dict.fromkeys((*rules.ignored, *pairs)))
        changes["left_out"] = tuple(dict.fromkeys((*rules.left_out, *left_out)))
        tolerated = (_tolerated_pair(entry, names) for entry in self.tolerated_pairs)
        by_pair = {frozenset(pair[:2]): pair for pair in (*rules.tolerated_pairs, *tolerated)}
        changes["tolerated_pairs"] = tuple(by_pair.values())
        return replace(rules, **changes)

    def applied(
        self,
        rules: ContactRules,
        groups: tuple[FaceGroup, ...],
        topology: Topology,
        vertex_labels: npt.NDArray[np.str_] | None = None,
    ) -> tuple[ContactRules, tuple[FaceGroup, ...]]:
        """Return the rules with these options applied, and the groups with those that they name.

        Parameters
        ----------
        rules, groups : of the mesh or pose set
        vertex_labels : (V,) names of body parts, if they are known

        Raises
        ------
        LCollisionError : see `changed`.
        """
        from lcollision_core.meshes import groups_by_kind, with_named_groups

        kinds = groups_by_kind(groups, topology, vertex_labels) if self.name_groups else {}
        names = {group.name for kind in kinds.values() for group in kind}
        has_joints = any(group.about_joint for group in groups)
        changed = self.changed(rules, names, has_joints, "the mesh")
        return changed, with_named_groups(groups, kinds, changed.named_groups)


def _tolerated_pair(entry: str, names: Collection[str]) -> tuple[str, str, float]:
    """Read "A:B=DEPTH"."""
    from lcollision_core.meshes import named_pair

    pair, _, number = entry.rpartition("=")
    try:
        depth = float(number)
    except ValueError:
        depth = -1.0
    if not pair or not 0.0 <= depth < 1.0:
        what = "is not A:B=DEPTH with a depth of 0 or more and below 1 body size"
        example = "name two groups of faces and a depth, as in 'belly:left hand=0.01'"
        raise LCollisionError(what, example, where=f"the tolerated pair {entry!r}")
    return *named_pair(pair, names, "the tolerated pair"), depth


NO_CHANGE = RuleOptions()
"""Leaves all rules as they are."""


class Solver(StrEnum):
    """Solver of the paper's problem; AUGLAG is the paper's method."""

    SQP = "sqp"
    AUGLAG = "auglag"
    SLSQP = "slsqp"
    CCSAQ = "ccsaq"


class Metric(StrEnum):
    """Distance to minimise: displacement of the vertices, or of the codes as in the paper."""

    DISPLACEMENT = "vertices"
    LATENT = "latent"

    @classmethod
    def _missing_(cls, value: object) -> Metric | None:
        # The name in older scripts.
        return cls.DISPLACEMENT if value == "eye" else None


LARGEST_CHANGE = 0.25
"""Default of the largest displacement of a vertex, normalised."""


@dataclass(frozen=True)
class ResolveOptions:
    """How to resolve a pose; the defaults gave the best results in our measurements.

    Attributes
    ----------
    solver : name of the `Solver` for the paper's problem
    metric : name of the `Metric` to minimise
    threshold : decision threshold in (0, 1): largest collision probability of a pose that is
        predicted free
    margin : >= 0, how far below the threshold's logit the solver first aims; by default 0, and the
        larger margins of the ladder are tried too
    locked_domains : indices of domains that keep their codes: Z_k, and the domain's own entry of
        Z_0. Neighbours may still carry a locked domain along.
    locked_codes : indices of further codes to keep
    still_domains : indices of domains whose vertices should stay in place, as pinned ones do,
        though their codes may change
    standing : unit vector away from the ground: parts that stand on it in the pose should stay in
        place too, and a body that can be shifted is moved as a whole for it; None if nothing stands
    group_weights : 1 + K numbers > 0 for (Z_0, Z_1, ..., Z_K), factors of the cost of moving each
        group; by default all 1
    time_budget : seconds after which the ladder goes straight to its last step; None for no limit.
        With a budget, results depend on the machine's speed.
    verify : check exactly and climb the ladder; False returns the solver's result
    clearance : in [0, 1), normalised: a pose is free if no pair that counts is nearer than that,
        see `CollisionDetector.with_clearance`; the solver of the paper's problem ignores it
    largest_change : > 0, normalised: no vertex moves farther. If no free pose is that near, the
        result is the pose of least overlap. None accepts a free pose at any distance. Without
        `verify` there is no bound.
    seed : >= 0, seed of the restarts and draws

    Raises
    ------
    LCollisionError : the solver or metric is unknown, a number is out of range, or a largest
        change is given without `verify`.
    """

    solver: Annotated[str, Option("sqp, auglag (the paper's), slsqp or ccsaq.", metavar="NAME")] = (
        Solver.SQP
    )
    metric: Annotated[
        str, Option("Distance to minimise: of vertices, or of codes.", metavar="vertices|latent")
    ] = Metric.DISPLACEMENT
    threshold: Annotated[
        float,
        Option(
            "Decision threshold: up to this probability a pose is predicted free.",
            metavar="P",
            above=0.0,
            below=1.0,
        ),
    ] = 0.5
    margin: Annotated[
        float | None,
        Option("How far below the threshold's logit the first step aims.", metavar="X", low=0.0),
    ] = None
    locked_domains: frozenset[int] = field(default_factory=frozenset)
    locked_codes: frozenset[int] = field(default_factory=frozenset)
    still_domains: frozenset[int] = field(default_factory=frozenset)
    standing: tuple[float, float, float] | None = None
    group_weights: tuple[float, ...] | None = None
    time_budget: Annotated[
        float | None,
        Option(
            "Search time per pose; after that, a known free pose is used.",
            metavar="SECONDS",
            above=0.0,
        ),
    ] = None
    verify: Annotated[
        bool,
        Option(
            "Check the solver's answer exactly, and take further steps if it collides.",
            ("--verify/--no-verify",),
        ),
    ] = True
    seed: Annotated[int, Option("Seed of the solver's restarts.", metavar="S", low=0)] = 0

    clearance: Annotated[
        float,
        Option(
            "Distance to keep between parts, in body sizes. Parts near at rest may "
            "come to half their rest distance.",
            metavar="C",
            low=0.0,
            below=1.0,
        ),
    ] = 0.0

    largest_change: Annotated[
        float | None,
        Option(
            "Move no vertex farther than this, in body sizes. If no free pose is that near, the "
            "result is the pose found with the least overlap, or the pose as it was.",
            ("--largest-change", "--soft"),
            metavar="MAX",
            above=0.0,
        ),
    ] = LARGEST_CHANGE

    def __post_init__(self) -> None:
        for name, kind in (("solver", Solver), ("metric", Metric)):
            given = getattr(self, name)
            try:
                object.__setattr__(self, name, kind(given))
            except ValueError:
                raise LCollisionError(
                    f"unknown {name} {given!r}", f"choose one of {', '.join(kind)}"
                ) from None
        if not self.verify and self.largest_change not in (None, LARGEST_CHANGE):
            what = "a largest change needs the exact check"
            raise LCollisionError(what, "leave out --no-verify or --largest-change")
        if self.group_weights is not None and not all(
            0.0 < weight < math.inf for weight in self.group_weights
        ):
            raise LCollisionError("a group's weight must be a number above 0")
        require_limits(self)

    @property
    def threshold_logit(self) -> float:
        """The logit of `threshold`, 0 for 0.5."""
        return math.log(self.threshold) - math.log1p(-self.threshold)


@dataclass(frozen=True)
class SceneOptions:
    """Further bodies in the scene of a body.

    Attributes
    ----------
    others : "FILE", or "FILE@JOINT" for an object held by a joint of the first body
    places : "NAME=X,Y,Z" or "NAME=X,Y,Z,DEGREES", position of a body and its turn
    fixed : names of bodies that do not give way
    ground : height of the ground, or "rest"; None for no ground
    played : "NAME=CLIP" or "NAME=FILE", followed by "@SECONDS" for a later start
    """

    others: Annotated[
        tuple[str, ...],
        Option(
            "A further body of the scene: a character, a prop, or with --fixed a set or a learned "
            "model. FILE@JOINT is held by that joint of M, and its joint's part may touch it. May "
            "be repeated.",
            ("--with",),
            metavar="FILE[@JOINT]",
        ),
    ] = ()
    places: Annotated[
        tuple[str, ...],
        Option(
            "Where a body of the scene stands, in the unit of M, and how it is turned about the "
            "vertical. Default: as its file says. May be repeated.",
            ("--at",),
            metavar="NAME=X,Y,Z[,DEG]",
        ),
    ] = ()
    fixed: Annotated[
        tuple[str, ...],
        Option(
            "A body of the scene that does not give way. May be repeated.",
            ("--fixed",),
            metavar="NAME",
        ),
    ] = ()
    ground: Annotated[
        str | None,
        Option(
            "Put a level ground at this height, without one where the bodies stand at rest.",
            metavar="[HEIGHT]",
        ),
    ] = None
    played: Annotated[
        tuple[str, ...],
        Option(
            "With --motion or --clips: what a body of the scene does, one of its clips or a motion "
            "file, and when it begins. Default: its first clip. May be repeated.",
            ("--play",),
            metavar="NAME=CLIP[@SECONDS]",
        ),
    ] = ()

    @property
    def has_others(self) -> bool:
        """Whether the scene has more than the one body."""
        return bool(self.others or self.ground)


NO_SCENE = SceneOptions()


@dataclass(frozen=True)
class MotionChoice:
    """Choice of motions in a file, and of their poses to check.

    Attributes
    ----------
    clip : name of a clip of the file; None for all
    fps : frames per second; None for the rate of its keys, else 30
    substeps : >= 0, number of poses between two frames to check too
    continuous : whether to check the whole linear path of the vertices between two frames

    Raises
    ------
    LCollisionError : a number is out of range.
    """

    clip: Annotated[
        str | None, Option("Of motions: one of a file's clips. Default: all.", metavar="NAME")
    ] = None
    fps: Annotated[
        float | None,
        Option(
            "Frames a second of a motion. Default: the rate of its keys, else 30.",
            metavar="N",
            low=0.01,
            high=1000.0,
        ),
    ] = None
    substeps: Annotated[
        int,
        Option("For motions: poses to check between two frames.", metavar="N", low=0, high=99),
    ] = 1
    continuous: Annotated[
        bool,
        Option(
            "For motions: prove that nothing touches between frames either, if every vertex moves "
            "in a straight line from frame to frame, as cloth solvers assume. "
            "Needs the extra 'ccd'.",
            ("--continuous",),
        ),
    ] = False

    def __post_init__(self) -> None:
        require_limits(self)


@dataclass(frozen=True)
class MotionOptions:
    """How to resolve a motion; the defaults gave the best results in our measurements.

    Attributes
    ----------
    easing : >= 0, frames, at 30 per second, on either side of a collision over which the
        correction fades in and out
    keep_feet : whether parts that stand on the ground stay there
    keep_contacts : whether contacts of a motion made for another body are kept on this one
    frame : options for single frames: locked domains, weights, metric and largest change; still
        domains stay where the motion has them, as feet do
    substeps : >= 0, number of poses between two frames that must be free too
    continuous : whether the whole linear path of the vertices between two frames must be free
    feet : domains that count as standing in all frames; if empty, those that rest near the ground
        are detected
    budget : > 0, seconds after which a motion ends with the spans that are done; None for no limit

    Raises
    ------
    LCollisionError : a number is out of range.
    """

    easing: Annotated[
        int,
        Option(
            "Frames, at 30 a second, over which a motion's correction fades in and out.",
            metavar="N",
            low=0,
            high=1000,
        ),
    ] = 12
    keep_feet: Annotated[
        bool,
        Option(
            "Keep standing feet in place: of motions, and of a character's poses.",
            ("--keep-feet/--no-keep-feet",),
        ),
    ] = True
    keep_contacts: Annotated[
        bool,
        Option(
            "Of motions of another character: what touches on its body, or the ground, touches on "
            "this one too.",
            ("--keep-contacts/--no-keep-contacts",),
        ),
    ] = True
    frame: ResolveOptions = field(default_factory=ResolveOptions)
    substeps: int = 1
    continuous: bool = False
    feet: frozenset[int] = field(default_factory=frozenset)
    budget: Annotated[
        float | None,
        Option(
            "Seconds for each motion: the best found by then is written where it makes nothing "
            "worse, the rest stays as it was and is named.",
            metavar="SECONDS",
            low=0.001,
            high=1e6,
        ),
    ] = None

    def __post_init__(self) -> None:
        require_limits(self)


class ExportAxes(StrEnum):
    """Axes and unit of an exported mesh, by the program that will read it.

    With them, the program's own importer, at its default settings, shows the mesh upright and
    facing its front. Blender's turns an OBJ file from y up to z up and leaves PLY and STL
    unchanged; Maya takes y up and centimetres; Unreal takes centimetres and z up, x forward, and
    flips y itself, as its axes are left-handed.
    """

    MODEL = "model"
    Y_UP = "y-up"
    BLENDER = "blender"
    MAYA = "maya"
    UNREAL = "unreal"


@dataclass(frozen=True)
class ExportRequest:
    """How to write poses as meshes.

    Attributes
    ----------
    axes : one of `ExportAxes`
    scale : file units per model unit; None for that of `axes`
    like : source file whose form is kept; None for a character's own if that can be written
    form : key of one of its export forms, see `EXPORT_FORMS`; None for the best
    keep_clips : whether a character's file keeps its clips beside a pose in its joints
    fps : frames per second of a motion
    mesh_format : format of the meshes in a folder; None for that of `like` or of a character, else
        obj
    times_of : point cache whose frames' times are kept, see `point_cache`
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
            choices=tuple(suffix.removeprefix(".") for suffix in WRITABLE_SUFFIXES),
        ),
    ] = None
    times_of: Path | None = None


MODELS_OWN = ExportRequest()
"""Keeps the axes, unit and vertex order of the model."""


class OpenLayers(StrEnum):
    """How to treat open layers, such as cloth and hair; AUTO decides by the shape of the rim."""

    AUTO = "auto"
    CLOSE = "close"
    THICKEN = "thicken"


@dataclass(frozen=True)
class PrintOptions:
    """How to make a pose a solid for 3D printing; lengths are in millimetres.

    Attributes
    ----------
    height : height of the figure, without its base
    wall : least thickness: open layers are given it, thinner walls are reported
    open_layers : one of `OpenLayers`
    base : thickness of a round plate under the figure; None for no plate
    join : largest gap that a pin bridges; None for a fiftieth of the height
    without : names of groups of faces that are not printed
    resolve : whether the pose is resolved first

    Raises
    ------
    LCollisionError : a number is out of range.
    """

    height: Annotated[
        float, Option("Height of the figure, without its base.", metavar="MM", low=1.0, high=1e4)
    ] = 100.0
    wall: Annotated[
        float,
        Option(
            "Least wall: open layers are made this thick, and how much of the surface has a "
            "thinner wall is reported.",
            metavar="MM",
            low=0.01,
            high=100.0,
        ),
    ] = 1.0
    open_layers: Annotated[
        str,
        Option(
            "Layers with holes: auto closes the holes of hulls, and thickens sheets, as cloth and "
            "hair; close and thicken do so with all.",
            choices=tuple(OpenLayers),
        ),
    ] = OpenLayers.AUTO
    base: Annotated[
        float | None,
        Option(
            "Stand the figure on a round plate of this thickness.",
            metavar="MM",
            low=0.1,
            high=1000.0,
        ),
    ] = None
    join: Annotated[
        float | None,
        Option(
            "Join loose parts by pins across gaps up to this. Default: 2 % of the height.",
            metavar="MM",
            low=0.0,
            high=1000.0,
        ),
    ] = None
    without: Annotated[
        tuple[str, ...],
        Option(
            "Leave out a mesh, material, body part or component. May be repeated.",
            ("--without",),
            metavar="NAME",
        ),
    ] = ()
    resolve: Annotated[
        bool,
        Option(
            "Resolve the pose first. Parts that still collide grow together.",
            ("--resolve/--no-resolve",),
        ),
    ] = True

    def __post_init__(self) -> None:
        require_limits(self)

    @property
    def reach(self) -> float:
        """The largest gap that a pin bridges."""
        return self.height / 50.0 if self.join is None else self.join


class Quality(StrEnum):
    """Trade-off between learning time and accuracy of a model."""

    QUICK = "quick"
    GOOD = "good"
    BEST = "best"


@dataclass(frozen=True)
class LearningRequest(RuleOptions):
    """Request to learn a model, stored with the model.

    Attributes
    ----------
    sources : absolute paths of files of a character, folders of meshes, point caches or pose sets
        of one body
    quality : a `Quality`
    by_rig : number of random poses of the rig; None for as many as the quality needs beside the
        clips
    clip, fps : of a character's animations, see `read_pose_set`
    up : up axis, 0, 1 or 2, if the files do not have it or are wrong; None for that of the files
    scale : factor from the unit of the files to that of the model
    seed : equal seeds give equal models
    licence : licence of the model
    regardless : train a predictor even if nearly all samples collide; ignored when requests are
        compared
    stamps : stamps of the sources, by which a file that has changed since it was read is noticed

    Rules that are None are proposed from the poses; an empty `ignored` proposes no groups.

    Raises
    ------
    LCollisionError : a value is out of range.
    """

    sources: Annotated[
        tuple[str, ...],
        Option(
            "Files of one character (GLB, glTF, VRM, FBX), folders of meshes, point caches beside "
            "their mesh, .npz files.",
            metavar="FILE...",
        ),
    ]
    quality: Annotated[
        str,
        Option(
            "Time spent against accuracy: quick, 100 poses of a rig and 20 000 samples; good, 150 "
            "and 50 000, with errors of held-out poses; best, 300 and 340 000, with three times "
            "the epochs of level 2 and a larger predictor.",
            choices=tuple(Quality),
        ),
    ] = Quality.GOOD
    by_rig: Annotated[
        int | None,
        Option(
            "Number of random poses made by the rig. Default: as many as the clips lack.",
            metavar="N",
            low=0,
            high=10_000,
        ),
    ] = None
    clip: Annotated[str | None, Option("The animation to read. Default: all.", metavar="NAME")] = (
        None
    )
    fps: Annotated[
        float | None,
        Option(
            "Frames per second. Default: the animation's keys.", metavar="X", low=0.01, high=1000.0
        ),
    ] = None
    up: Annotated[
        int | None,
        Option("The up axis. Default: what the files say, else a guess.", words=("x", "y", "z")),
    ] = None
    scale: Annotated[
        float, Option("Factor from the files' unit to the model's.", metavar="S", above=0)
    ] = 1.0
    seed: Annotated[int, Option("The same seed gives the same models.", metavar="S", low=0)] = 0
    licence: Annotated[str, Option("Licence of the model.")] = "unknown"
    regardless: Annotated[
        bool,
        Option(
            "Train the predictor even where nearly all samples collide.",
            ("--regardless",),
        ),
    ] = field(default=False, compare=False)
    stamps: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.sources:
            raise LCollisionError("no files are given to learn from", "name at least one")
        require_limits(self)
