"""A motion: frames, corrections, spans that change, and reports of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ShapeError
from lcollision_core.jobs import for_blocks
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.contacts import KeptContacts
from lcollision_core.posing import ExactCheck, PoseSpace

NOMINAL_RATE = 30.0
"""Frame rate to which durations in frames refer."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The poses of one body at given times.

    Attributes
    ----------
    name : of the motion, such as that of its clip
    times : (T,) float64 array, in seconds, ascending
    codes : (T, D) float64 array, read-only
    placements : placement of each frame's pose; None leaves all as decoded
    space_at : returns the pose space of the body at a time, counted in frames from 0, if the body
        changes, as a clip scales its joints or weights morph targets; None if it does not
    source : the name of the file that it was read from, "" if there is none
    hidden : returns the faces that a frame scales to nothing, which count in none of its pairs;
        None if no frame does
    contacts : returns the contacts of the body that the motion was made for, as patches of this
        body; None if that is this body or has no surface

    Raises
    ------
    ShapeError : the shapes do not agree, there is no frame, a number is not finite, or the times
        do not ascend.
    """

    name: str
    times: FloatArray
    codes: FloatArray
    placements: tuple[RigidTransform | None, ...] | None = None
    space_at: Callable[[float], PoseSpace] | None = None
    source: str = ""
    hidden: Callable[[int], npt.NDArray[np.intp]] | None = None
    contacts: Callable[[], KeptContacts | None] | None = None

    def __post_init__(self) -> None:
        if self.codes.ndim != 2 or len(self.codes) != len(self.times) or len(self.codes) == 0:
            raise ShapeError.must_be(
                f"the motion {self.name!r}",
                "one row of codes for each of its times, at least one",
                f"shape {self.codes.shape} at {len(self.times)} times",
            )
        if self.placements is not None and len(self.placements) != len(self.codes):
            raise ShapeError.must_be(
                f"the motion {self.name!r}",
                f"{len(self.codes)} placements",
                len(self.placements),
            )
        unusable = np.flatnonzero(~np.isfinite(self.codes).all(axis=1))
        if len(unusable):
            raise ShapeError(
                f"frame {unusable[0]} of the motion {self.name!r} has a number that is not finite",
                "repair the frame or leave it out",
            )
        if not (np.isfinite(self.times).all() and (np.diff(self.times) > 0.0).all()):
            raise ShapeError(f"the times of the motion {self.name!r} do not ascend", "sort them")
        # Take a view, so that the caller's array stays writable.
        view = self.codes.view()
        view.flags.writeable = False
        object.__setattr__(self, "codes", view)

    def __len__(self) -> int:
        """Return T, the number of frames."""
        return len(self.codes)

    @cached_property
    def rate(self) -> float:
        """The median frame rate, in frames a second; the nominal rate for a single frame."""
        return 1.0 / float(np.median(np.diff(self.times))) if len(self) > 1 else NOMINAL_RATE

    @cached_property
    def is_cycle(self) -> bool:
        """Whether the last frame repeats the first one, to the bit."""
        if len(self) == 1 or not np.array_equal(self.codes[0], self.codes[-1]):
            return False
        first, last = (
            np.zeros(0) if place is None else place.apply(np.eye(4, 3))
            for place in (self.placement(0), self.placement(-1))
        )
        if self.space_at is None or not np.array_equal(first, last):
            return np.array_equal(first, last)
        begin, end = (self.space_at(at).decode(self.codes[:1]) for at in (0, len(self) - 1))
        return np.array_equal(begin, end)

    def two_turns(self) -> Motion:
        """Return two turns of a cycle, without the frame that repeats the first."""
        n, space_at, hidden = len(self) - 1, self.space_at, self.hidden
        turn = self.times[:-1]
        return replace(
            self,
            times=np.concatenate([turn, turn + (self.times[-1] - self.times[0])]),
            codes=np.tile(self.codes[:-1], (2, 1)),
            placements=None if self.placements is None else self.placements[:-1] * 2,
            space_at=None if space_at is None else lambda time: space_at(time % n),
            hidden=None if hidden is None else lambda frame: hidden(frame % n),
            contacts=self._contacts_at([*range(n)] * 2),
        )

    def _contacts_at(self, frames: Sequence[int]) -> Callable[[], KeptContacts | None] | None:
        """Return the `contacts` of a motion of some of the frames."""
        find = self.contacts
        if find is None:
            return None

        def chosen() -> KeptContacts | None:
            contacts = find()
            return None if contacts is None else contacts.at(frames)

        return chosen

    def placement(self, frame: int) -> RigidTransform | None:
        """Return the placement of one frame's pose."""
        return None if self.placements is None else self.placements[frame]

    def in_frames(self, nominal: float) -> int:
        """Return the number of frames, at least 1, as long as `nominal` at `NOMINAL_RATE`."""
        return max(1, round(nominal * self.rate / NOMINAL_RATE))

    def part(self, frames: range) -> Motion:
        """Return the motion of some successive frames, at their times."""
        space_at, hidden = self.space_at, self.hidden
        rows = slice(frames.start, frames.stop)
        return replace(
            self,
            times=self.times[rows],
            codes=np.array(self.codes[rows]),
            placements=None if self.placements is None else self.placements[rows],
            space_at=None if space_at is None else lambda time: space_at(time + frames.start),
            hidden=None if hidden is None else lambda frame: hidden(frame + frames.start),
            contacts=self._contacts_at(frames),
        )

    def at_rate(self, rate: float) -> Motion:
        """Return the motion at `rate` frames a second, with linearly interpolated codes.

        With placements, the nearest frames are taken instead.
        """
        # A rounding error must not lose a frame.
        n = int((self.times[-1] - self.times[0]) * rate + 1e-3) + 1
        times = np.minimum(self.times[0] + np.arange(n) / rate, self.times[-1])
        if len(self) == n and np.allclose(times, self.times, rtol=0.0, atol=1e-6):
            return self
        nearest = np.searchsorted(0.5 * (self.times[1:] + self.times[:-1]), times)
        space_at, placements, hidden = self.space_at, self.placements, self.hidden
        codes, at = np.array(self.codes[nearest]), nearest.astype(np.float64)
        if placements is None:
            codes = np.array([np.interp(times, self.times, row) for row in self.codes.T]).T
            at = np.interp(times, self.times, np.arange(len(self), dtype=np.float64))
        return replace(
            self,
            times=self.times[0] + np.arange(n) / rate,
            codes=codes,
            placements=None if placements is None else tuple(placements[at] for at in nearest),
            space_at=None
            if space_at is None
            else lambda time: space_at(float(np.interp(time, np.arange(n), at))),
            hidden=None if hidden is None else lambda frame: hidden(int(nearest[frame])),
            contacts=self._contacts_at(nearest.tolist()),
        )

    def space(self, time: float, space: PoseSpace) -> PoseSpace:
        """Return the pose space of the body at a time, counted in frames; `space` by default."""
        return space if self.space_at is None else self.space_at(time)

    def decoded(self, frame: int, space: PoseSpace) -> FloatArray:
        """Return the normalised (V, 3) vertices of a frame, without its placement."""
        vertices: FloatArray = self.space(frame, space).decode(self.codes[frame][None])[0]
        return vertices

    def check(self, frame: int, check: ExactCheck, share: float = 0.0) -> ExactCheck:
        """Return the exact check of one frame, with its placement and the body's shape then.

        Parameters
        ----------
        share : fraction of the way to the next frame
        """
        space = self.space(frame + share, check.space)
        frame_check = replace(check, space=space, placement=self.placement(frame))
        return self.seen(frame_check, range(frame, frame + 1 + (share > 0.0)))

    def seen(self, check: ExactCheck, frames: range) -> ExactCheck:
        """Return a check without the faces that any of the frames hides."""
        if self.hidden is None:
            return check
        return replace(check, hidden=np.unique(np.concatenate([*map(self.hidden, frames)])))

    def drawn(self, frame: int, check: ExactCheck) -> npt.NDArray[np.float32]:
        """Return the (V, 3) vertices of a frame as they are drawn, in model coordinates."""
        frame_check = self.check(frame, check)
        return frame_check.drawn(frame_check.decode(self.codes[frame])[0])

    def vertices(
        self, frame: int, check: ExactCheck, share: float = 0.0
    ) -> npt.NDArray[np.floating]:
        """Return the exported (V, 3) vertices of a frame, or of a pose between it and the next.

        Parameters
        ----------
        share : fraction of the way to the next frame. With placements, poses between interpolate
            the vertices of both frames, else the codes.
        """
        codes = self.codes[frame]
        if share and self.placements is None:
            codes = (1.0 - share) * codes + share * self.codes[frame + 1]
        if share == 0.0 or self.placements is None:
            frame_check = self.check(frame, check, share)
            return frame_check.exported(frame_check.decode(codes)[0])
        between = (1.0 - share) * self.vertices(frame, check)
        between += share * self.vertices(frame + 1, check)
        return between

    def are_free(self, check: ExactCheck) -> npt.NDArray[np.bool_]:
        """Return (T,) whether each frame is free, checked on all cores."""
        free = np.empty(len(self), dtype=np.bool_)

        def look(start: int, stop: int) -> None:
            frames = range(start, stop)
            free[start:stop] = [self.check(at, check).is_free(self.codes[at]) for at in frames]

        for_blocks(look, len(self), 1)
        return free

    def collide(
        self, frames: Sequence[int], check: ExactCheck, share: float = 0.0
    ) -> npt.NDArray[np.bool_]:
        """Return (n,) whether each frame, or a pose between it and the next, collides.

        It takes only a few calls of compiled loops; frames must hide nothing.

        Parameters
        ----------
        frames : their numbers
        check : of their vertices
        share : as for `vertices`
        """
        if self.space_at is None and self.placements is None:
            return ~replace(check, placement=None).are_free(self._codes_at(frames, share))
        return ~check.are_free_meshes(self.meshes(frames, check, share))

    def meshes(
        self, frames: Sequence[int], check: ExactCheck, share: float = 0.0
    ) -> npt.NDArray[np.floating]:
        """Return (n, V, 3) exported vertices; parameters are those of `collide`."""
        if self.space_at is not None or (share and self.placements is not None):
            return np.stack([self.vertices(frame, check, share) for frame in frames])
        decoded = check.decode(self._codes_at(frames, share))
        if self.placements is None:
            return replace(check, placement=None).exported(decoded)
        placed = [replace(check, placement=self.placement(frame)) for frame in frames]
        return np.stack(
            [frame_check.exported(own) for frame_check, own in zip(placed, decoded, strict=True)]
        )

    def _codes_at(self, frames: Sequence[int], share: float) -> FloatArray:
        codes = self.codes[frames]
        if share:
            codes = (1.0 - share) * codes + share * self.codes[np.add(frames, 1)]
        return codes


def corrected(motion: Motion, frame: int, codes: npt.ArrayLike, easing: int) -> Motion:
    """Set one frame of a motion, and ease the change in and out over the frames around it.

    A cycle, whose first and last frames are equal, is eased across its seam and stays one.

    Parameters
    ----------
    motion : T frames
    frame : the frame to set
    codes : (D,) its new codes
    easing : >= 0, frames on either side over which the change fades, on a raised cosine

    Returns
    -------
    corrected : the motion; frames beyond the easing stay equal to the bit

    Raises
    ------
    ShapeError : another shape.
    """
    aim = np.asarray(codes, dtype=np.float64)
    if aim.shape != motion.codes.shape[1:]:
        raise ShapeError.must_be(
            "the corrected frame", f"shape {motion.codes.shape[1:]}", aim.shape
        )
    changed = np.array(motion.codes)
    reached = eased_frames(motion, frame, easing)
    change = aim - motion.codes[frame]
    for at, away in reached.items():
        changed[at] += (0.5 + 0.5 * np.cos(np.pi * away / (easing + 1))) * change
    # Set the frame's own codes to the bit.
    changed[[at for at, away in reached.items() if away == 0]] = aim
    return replace(motion, codes=changed)


def eased_frames(motion: Motion, frame: int, easing: int) -> dict[int, int]:
    """Return the frames that the correction of one frame reaches, with their distances from it."""
    n = len(motion)
    near = {at: abs(at - frame) for at in range(max(0, frame - easing), min(n, frame + easing + 1))}
    if motion.is_cycle:
        # The last frame is the first one of the next cycle.
        for at in range(n):
            away = min(abs(at - frame + cycle * (n - 1)) for cycle in (-1, 1))
            if away <= easing:
                near[at] = min(near.get(at, away), away)
    return near


def runs(mask: npt.NDArray[np.bool_]) -> list[range]:
    """Return the runs of True in a (T,) mask, in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [range(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]


def colliding_spans(
    colliding: npt.NDArray[np.bool_],
    easing: int,
    within: range | None = None,
    is_cycle: bool = False,
    barred: npt.NDArray[np.bool_] | None = None,
) -> list[range]:
    """Return the spans of frames that may change: colliding ones, and `easing` on either side.

    Spans that would overlap or meet are joined, and none goes beyond the frames `within`.

    Parameters
    ----------
    colliding : (T,) mask
    easing : number of frames
    within : the frames that may change; all if None
    is_cycle : whether the first frame follows the last, with number T: a span across the seam then
        continues beyond T, and a span of all frames begins at a free one, if there is any
    barred : (T,) mask of frames that may not change, even if they collide
    """
    n = len(colliding)
    if barred is not None:
        colliding = colliding & ~barred
    turns = np.tile(colliding, 3 if is_cycle else 1)
    eased = turns.copy()
    for run in runs(turns):
        eased[max(0, run.start - easing) : run.stop + easing] = True
    if is_cycle:
        eased = eased[n : 2 * n]
    if within is not None:
        eased &= np.isin(np.arange(n), np.asarray(within) % n)
    if barred is not None:
        eased &= ~barred
    first = int(np.argmin(colliding if eased.all() else eased)) if is_cycle else 0
    spans = [range(first + run.start, first + run.stop) for run in runs(np.roll(eased, -first))]
    if barred is None:
        return spans
    # Drop spans that barred frames separate from the collision they would ease.
    return [span for span in spans if colliding[np.asarray(span) % n].any()]


def windows(span: range, length: int, overlap: int) -> list[range]:
    """Divide a long span into windows to resolve in turn.

    Each begins `overlap` frames before the end of the previous one, and corrects these again.
    """
    starts = range(span.start, max(span.start + 1, span.stop - overlap), length - overlap)
    return [range(start, min(start + length, span.stop)) for start in starts]


def knots_of(free: npt.NDArray[np.bool_], spacing: int) -> npt.NDArray[np.bool_]:
    """Return (n,) whether a frame is evenly spaced in, or ends, a run of free or colliding frames.

    Parameters
    ----------
    free : (n,) whether each frame is free
    spacing : >= 1
    """
    knots = np.zeros(len(free), dtype=np.bool_)
    for run in (*runs(free), *runs(~free)):
        knots[run.start : run.stop : spacing] = knots[run.stop - 1] = True
    return knots


NEAR_GROUND = 0.03
"""Normalised height above the motion's lowest point up to which parts may stand."""

STILL = 0.03
"""Speed up to which a part stands, in normalised lengths a second."""

_AT_ONCE = 64
"""Number of frames that are decoded together."""


def standing_parts(
    motion: Motion, check: ExactCheck, up: npt.ArrayLike, ground: float | None = None
) -> npt.NDArray[np.bool_]:
    """Find the body parts that rest near the ground.

    A part stands in a frame if its vertices near the ground hardly move from the previous frame or
    to the next.

    Parameters
    ----------
    motion : of T frames
    check : decodes poses
    up : (3,) unit vector
    ground : its height along `up`, normalised; that of the motion's lowest point if None

    Returns
    -------
    standing : (T, K) bool, whether each of the K body parts stands in each frame
    """
    domain, n_domains = check.space.vertex_domain, check.space.n_domains
    axis = np.asarray(up, dtype=np.float64)
    if ground is None:
        ground = min(float((placed @ axis).min()) for placed in placed_frames(motion, check))
    standing = np.zeros((len(motion), n_domains), dtype=np.bool_)
    pairs = pairwise(placed_frames(motion, check))
    for frame, ((before, after), seconds) in enumerate(
        zip(pairs, np.diff(motion.times), strict=True)
    ):
        low = (np.minimum(before @ axis, after @ axis) < ground + NEAR_GROUND).astype(np.float64)
        count = np.bincount(domain, low, n_domains)
        moved = [np.bincount(domain, low * along, n_domains) for along in (after - before).T]
        speed = np.linalg.norm(moved, axis=0) / np.maximum(count, 1.0) / seconds
        standing[frame : frame + 2] |= (count > 0.0) & (speed < STILL)
    return standing


def parts_on_ground(motion: Motion, check: ExactCheck, up: npt.ArrayLike) -> frozenset[int]:
    """Return the body parts as low as the lowest point of a motion's first frame."""
    heights = next(placed_frames(motion, check)) @ np.asarray(up, dtype=np.float64)
    low = heights < heights.min() + NEAR_GROUND
    return frozenset(check.space.vertex_domain[low].tolist())


def placed_frames(motion: Motion, check: ExactCheck) -> Iterator[FloatArray]:
    """Yield the normalised (V, 3) vertices of a motion's frames in turn, as placed."""
    n_at_once = _AT_ONCE if motion.space_at is None else 1
    for start in range(0, len(motion), n_at_once):
        decoding = motion.space(start, check.space)
        for frame, decoded in enumerate(
            decoding.decode(motion.codes[start : start + n_at_once]), start
        ):
            place = motion.placement(frame)
            size = check.body_size
            yield decoded if place is None else place.apply(decoded * size) / (size * place.scale)


_STILL = 1e-9
"""Normalised displacement of a vertex up to which a frame counts as unchanged."""

_UNSEEN_BEND = 1e-4
"""Normalised second difference at `NOMINAL_RATE`, root mean square over the vertices, that counts
as standing still: the acceleration of a motion is compared with at least that."""


@dataclass(frozen=True)
class MotionReport:
    """The change of a motion by Resolve. Lengths are normalised.

    Attributes
    ----------
    mean_change : mean displacement over the vertices of the frames that changed
    largest_change : largest displacement of a vertex
    acceleration_ratio : mean squared second difference of the vertices after, over that before, in
        the frames that changed and their neighbours, with `_UNSEEN_BEND` squared added to both; 1
        if none changed
    largest_jump : largest change of the correction from one frame to the next, as a mean over the
        vertices
    foot_slide : largest change of a standing part's mean displacement from one frame to the next
    """

    mean_change: float = 0.0
    largest_change: float = 0.0
    acceleration_ratio: float = 1.0
    largest_jump: float = 0.0
    foot_slide: float = 0.0

    @classmethod
    def of(
        cls,
        before: Motion,
        after: Motion,
        check: ExactCheck,
        standing: npt.NDArray[np.bool_] | None = None,
    ) -> MotionReport:
        """Compare a motion with the original, frame by frame in bounded memory.

        Parameters
        ----------
        before, after : T frames each, at the same times
        check : of the body's poses
        standing : (T, K) bool, whether each part stands in each frame
        """
        domain, n_domains = check.space.vertex_domain, check.space.n_domains
        sizes = np.maximum(np.bincount(domain, minlength=n_domains), 1)
        changes, largest, jumps, slides = [], [], [0.0], [0.0]
        bends: list[tuple[float, float]] = []
        window: list[tuple[FloatArray, FloatArray]] = []
        last: FloatArray | None = None
        frames = zip(placed_frames(before, check), placed_frames(after, check), strict=True)
        for frame, (old, new) in enumerate(frames):
            moved = new - old
            lengths = np.linalg.norm(moved, axis=1)
            changes.append(float(lengths.mean()))
            largest.append(float(lengths.max()))
            if last is not None:
                step = moved - last
                jumps.append(float(np.linalg.norm(step, axis=1).mean()))
                if standing is not None and (feet := standing[frame] & standing[frame - 1]).any():
                    means = [np.bincount(domain, along, n_domains) / sizes for along in step.T]
                    slides.append(float(np.linalg.norm(means, axis=0)[feet].max()))
            last = moved
            window = [*window[-2:], (old, new)]
            if len(window) == 3:
                bends.append(tuple(_bend([pair[side] for pair in window]) for side in (0, 1)))  # type: ignore[arg-type]
        touched = np.array(largest) > _STILL
        near = touched.copy()
        near[1:] |= touched[:-1]
        near[:-1] |= touched[1:]
        unseen = (_UNSEEN_BEND * (NOMINAL_RATE / before.rate) ** 2) ** 2
        near_bends = np.array(bends).reshape(-1, 2)[near[1:-1]] + unseen
        old_bend, new_bend = near_bends.sum(axis=0)
        return cls(
            mean_change=float(np.mean(np.array(changes)[touched])) if touched.any() else 0.0,
            largest_change=max(largest),
            acceleration_ratio=float(new_bend / old_bend) if len(near_bends) else 1.0,
            largest_jump=max(jumps),
            foot_slide=max(slides),
        )


def _bend(three: list[FloatArray]) -> float:
    """Return the mean squared second difference of three frames' vertices."""
    first, second = (after - before for before, after in pairwise(three))
    return float(((second - first) ** 2).sum(axis=1).mean())
