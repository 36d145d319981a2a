"""A motion: the poses of one body at given times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ShapeError
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.posing import ExactCheck

NOMINAL_RATE = 30.0
"""Frames a second that lengths of time in frames refer to."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The poses of one body at given times.

    Attributes
    ----------
    name : of the motion, as of its clip
    times : (T,) float64 array, in seconds, ascending
    codes : (T, D) float64 array, read-only
    placements : where each frame's pose lies; None leaves all of them where they are decoded
    displacement : of a frame, the (V, 3) or (1, 3) array that is added to its decoded and placed
        vertices, in the unit there: what the codes do not hold of it. None where they hold all.
    source : the name of the file that it was read from, "" if there is none
    hidden : of a frame, the numbers of the faces that count in none of its pairs, as it scales them
        to nothing; None where no frame does

    Raises
    ------
    ShapeError : the shapes do not agree, there is no frame, a number is not finite, or the times
        do not ascend.
    """

    name: str
    times: FloatArray
    codes: FloatArray
    placements: tuple[RigidTransform | None, ...] | None = None
    displacement: Callable[[int], npt.NDArray[np.floating]] | None = None
    source: str = ""
    hidden: Callable[[int], npt.NDArray[np.intp]] | None = None

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
        # A view, so that the caller's array stays writable.
        view = self.codes.view()
        view.flags.writeable = False
        object.__setattr__(self, "codes", view)

    def __len__(self) -> int:
        """Return T, the number of frames."""
        return len(self.codes)

    @cached_property
    def rate(self) -> float:
        """Frames a second, the median; the nominal rate of a single frame."""
        return 1.0 / float(np.median(np.diff(self.times))) if len(self) > 1 else NOMINAL_RATE

    @cached_property
    def is_cycle(self) -> bool:
        """Whether the last frame is the first again, to the bit."""
        if len(self) == 1 or not np.array_equal(self.codes[0], self.codes[-1]):
            return False
        first, last = (
            np.zeros(0) if place is None else place.apply(np.eye(4, 3))
            for place in (self.placement(0), self.placement(-1))
        )
        moved = self.displacement
        return np.array_equal(first, last) and (
            moved is None or np.array_equal(moved(0), moved(len(self) - 1))
        )

    def two_turns(self) -> Motion:
        """Return a cycle gone through twice, without the frame that is its first again."""
        n, moved, hidden = len(self) - 1, self.displacement, self.hidden
        turn = self.times[:-1]
        return replace(
            self,
            times=np.concatenate([turn, turn + (self.times[-1] - self.times[0])]),
            codes=np.tile(self.codes[:-1], (2, 1)),
            placements=None if self.placements is None else self.placements[:-1] * 2,
            displacement=None if moved is None else lambda frame: moved(frame % n),
            hidden=None if hidden is None else lambda frame: hidden(frame % n),
        )

    def placement(self, frame: int) -> RigidTransform | None:
        """Return where one frame's pose lies."""
        return None if self.placements is None else self.placements[frame]

    def in_frames(self, nominal: float) -> int:
        """Return how many frames last as long as so many at the nominal rate; at least 1."""
        return max(1, round(nominal * self.rate / NOMINAL_RATE))

    def part(self, frames: range) -> Motion:
        """Return some successive frames alone, at their times."""
        moved, hidden = self.displacement, self.hidden
        chosen = slice(frames.start, frames.stop)
        return replace(
            self,
            times=self.times[chosen],
            codes=np.array(self.codes[chosen]),
            placements=None if self.placements is None else self.placements[chosen],
            displacement=None if moved is None else lambda frame: moved(frame + frames.start),
            hidden=None if hidden is None else lambda frame: hidden(frame + frames.start),
        )

    def at_rate(self, rate: float) -> Motion:
        """Return the motion at so many frames a second, its codes linear between its own frames.

        Where each frame is placed by itself, or codes do not hold all of it, the nearest is taken.
        """
        # A rounding error is no frame less.
        n = int((self.times[-1] - self.times[0]) * rate + 1e-3) + 1
        times = np.minimum(self.times[0] + np.arange(n) / rate, self.times[-1])
        if len(self) == n and np.allclose(times, self.times, rtol=0.0, atol=1e-6):
            return self
        nearest = np.searchsorted(0.5 * (self.times[1:] + self.times[:-1]), times)
        moved, placements, hidden = self.displacement, self.placements, self.hidden
        if moved is None and placements is None:
            codes = np.array([np.interp(times, self.times, row) for row in self.codes.T]).T
        else:
            codes = np.array(self.codes[nearest])
        return replace(
            self,
            times=self.times[0] + np.arange(n) / rate,
            codes=codes,
            placements=None if placements is None else tuple(placements[at] for at in nearest),
            displacement=None if moved is None else lambda frame: moved(int(nearest[frame])),
            hidden=None if hidden is None else lambda frame: hidden(int(nearest[frame])),
        )

    def check(self, frame: int, check: ExactCheck) -> ExactCheck:
        """Return the exact check of one frame: where it lies, with what its codes do not hold."""
        moved = None if self.displacement is None else self.displacement(frame)
        own = replace(check, placement=self.placement(frame), displacement=moved)
        return self.seen(own, range(frame, frame + 1))

    def seen(self, check: ExactCheck, frames: range) -> ExactCheck:
        """Return a check without the faces that some of the frames hide."""
        if self.hidden is None:
            return check
        return replace(check, hidden=np.unique(np.concatenate([*map(self.hidden, frames)])))

    def drawn(self, frame: int, check: ExactCheck) -> npt.NDArray[np.float32]:
        """Return the (V, 3) vertices of a frame as they are drawn, in the model's frame."""
        own = self.check(frame, check)
        return own.drawn(own.decode(self.codes[frame])[0])

    def vertices(
        self, frame: int, check: ExactCheck, share: float = 0.0
    ) -> npt.NDArray[np.floating]:
        """Return the (V, 3) vertices of a frame, or between it and the next, as they are exported.

        Parameters
        ----------
        share : of the way to the next frame. Where each frame is placed by itself, or codes do not
            hold all of it, that is between the vertices of both, else between the codes.
        """
        own, codes = self.check(frame, check), self.codes[frame]
        if share == 0.0:
            return own.exported(own.decode(codes)[0])
        if self.placements is None and self.displacement is None:
            codes = (1.0 - share) * codes + share * self.codes[frame + 1]
            return own.exported(own.decode(codes)[0])
        between = (1.0 - share) * self.vertices(frame, check)
        between += share * self.vertices(frame + 1, check)
        return between
