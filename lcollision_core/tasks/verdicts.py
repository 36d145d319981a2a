"""Results of tasks on meshes and motions: plain values, named as in reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lcollision_core.contact.solids import Layer


@dataclass(frozen=True)
class CheckedMesh:
    """The check of one mesh; lengths are normalised. The names are those of the JSON.

    `parts` are the colliding ones; only scenes have them.
    """

    file: str
    vertices: int
    faces: int
    watertight: bool
    pairs: int
    near_pairs: int
    excluded_pairs: dict[str, int]
    rules: dict[str, Any]
    rules_of: str | None
    coincident_pairs: int
    deepest: list[dict[str, Any]]
    clearance: float
    least_distance: float | None
    least_at: dict[str, Any] | None
    energy: float
    colliding: bool
    seconds: float
    not_counted: str
    parts: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the values for a report."""
        row = asdict(self)
        del row["not_counted"]
        if not self.parts:
            del row["parts"]
        return row


@dataclass(frozen=True)
class CheckedFrame:
    """One frame of a clip with colliding pairs; depths are normalised.

    Excluded pairs are None if not searched for: see `ExcludedPairs.step_for`.
    """

    frame: int
    seconds: float
    pairs: int
    deepest: float
    parts: list[list[str]]
    excluded_pairs: int | None
    excluded_deepest: float | None
    excluded_rules: dict[str, int] | None


@dataclass(frozen=True)
class CheckedClip:
    """The check of one clip; lengths are normalised. The names are those of the JSON."""

    file: str
    clip: str
    frames: int
    fps: float
    colliding_frames: list[CheckedFrame]
    excluding_frames: list[CheckedFrame]
    in_between: list[int]
    collides_between: tuple[int, ...] | None
    least_distance: float | None
    least_frame: int | None
    colliding: bool
    left_out: dict[str, Any]
    not_counted: str
    clearance: float
    estimated_frames: int
    contacts: dict[str, Any] | None = None
    ground: dict[str, Any] | None = None

    @property
    def deepest(self) -> float:
        """Depth of the deepest counted pair; 0 if no frame collides."""
        return max((frame.deepest for frame in self.colliding_frames), default=0.0)

    def to_json(self) -> dict[str, Any]:
        """Return the values for a report."""
        row = asdict(self)
        left_out: dict[str, Any] = row.pop("left_out")
        return row | left_out


@dataclass
class ResolvedClip:
    """The outcome of one motion; lengths are normalised. The names are those of the JSON.

    The output is "" if the motion was only checked. The contacts are a `ContactReport` for a
    retargeted motion, if known, else None. The ground is a `GroundReport` for a scene with one.
    Rough spans, by first and last frame, were not smooth yet when the budget ended.
    """

    source: str
    output: str
    clip: str
    frames: int
    free_before: int
    free_after: int
    deepest_before: float
    deepest_after: float
    in_between_before: int
    in_between_after: int
    collides_between: Sequence[int] | None
    kept_spans: list[dict[str, Any]]
    mean_change: float
    largest_change: float
    acceleration_ratio: float
    largest_jump: float
    foot_slide: float
    colliding_frames: list[int]
    left_out: dict[str, Any]
    not_counted: str
    clearance: float
    least_distance: float | None
    least_frame: int | None
    seconds: float
    contacts: dict[str, Any] | None = None
    ground: dict[str, Any] | None = None
    rough_spans: list[list[int]] = field(default_factory=list)
    error = ""

    @property
    def is_free(self) -> bool:
        """Whether all written frames are free and, if it was requested, the motion between them."""
        is_whole = self.free_after == self.frames and not self.kept_spans
        if not self.output:
            is_whole = is_whole and not self.in_between_before
        return is_whole and not self.collides_between

    def to_json(self) -> dict[str, Any]:
        """Return the values for a report."""
        row = asdict(self)
        left_out: dict[str, Any] = row.pop("left_out")
        return row | left_out


@dataclass
class FailedFile:
    """A file of a folder whose motions could not be resolved, and the reason."""

    source: str
    error: str

    def to_json(self) -> dict[str, Any]:
        """Return the values for a report."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class PrintedFigure:
    """A figure written for 3D printing; lengths are in millimetres.

    Attributes
    ----------
    pose : its name
    output : the file
    height : of the figure, without its base
    size : overall, along x, y and z (up)
    volume : cubic millimetres
    filled : part of the volume that lay enclosed between parts
    n_vertices, n_faces : of the solid
    closed, capped, thickened : number of layers that were closed, were closed by capping holes, or
        became sheets of the least wall
    pins : (3,) positions of pins that join loose parts
    pairs_before, pairs_after : colliding pairs of the given and of the printed pose
    wall : the requested least wall
    thinnest : wall thickness at the first percentile of the surface, at most `wall`
    thin_share : share of the surface whose wall is thinner than `wall`
    thin_places : names of the parts with most of it, at most three
    layers : the layers that it was made from
    """

    pose: str
    output: str
    height: float
    size: tuple[float, float, float]
    volume: float
    filled: float
    n_vertices: int
    n_faces: int
    closed: int
    capped: int
    thickened: int
    pins: list[list[float]]
    pairs_before: int
    pairs_after: int
    wall: float
    thinnest: float
    thin_share: float
    thin_places: list[str]
    layers: list[Layer]

    def to_json(self) -> dict[str, Any]:
        """Return the values for a report."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        del values["layers"]
        return values
