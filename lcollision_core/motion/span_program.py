"""The quadratic program that frees the frames of a span smoothly.

It minimises sum_t |c_t|^2 + w |c_{t-1} - 2 c_t + c_{t+1}|^2, with |c|^2 = c^T G c, over the
corrections c_t of the frames of a span. Its Hessian is A (x) G with A = I + w D2^T D2. The program
is solved in the multipliers of the constraints, of which there are few: its dual Hessian has the
entries (a_i^T A^-1 a_j) (n_i^T G^-1 n_j).
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.jobs import UNWATCHED
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion.contacts import Pulls
from lcollision_core.motion.frames import Frames, HalfSpacesOfPose

SOFTNESS, _PULLED, _LEVEL = 1e-4, 1e-2, 1e-3
"""Added to the normalised dual Hessian: contradictory contacts give way a little, and kept ones, of
two patches or of one with the ground, give way more."""

_LEAST_REACH = 1e-9
"""Least squared change of a constraint by a correction of cost 1. Constraints below it are ignored,
as when all codes that could change them are locked or pinned."""

_TOLERANCE, _MOST_ITERATIONS, _PATIENCE = 1e-8, 2000, 3
"""Tolerance of a half-space, most iterations, and most successive ones without progress."""

_ADDED, _DROPPING_ROUNDS = 150, 30
"""A program begins with this many half-spaces, those of least slack. Each round adds as many, the
most violated, until none is violated: of thousands, few are active. Inactive ones are dropped in
the first rounds only, of this number, as rounding could let the same ones come and go for ever."""


@dataclass(frozen=True, eq=False)
class HalfSpaces:
    """M constraints sum_t share[i, t] normals[i]^T c_t <= offsets[i] on n corrections.

    Attributes
    ----------
    shares : (M, n) float64 array; a constraint of one frame has a single 1
    normals, offsets : (M, D) and (M,) float64 arrays
    softness : of all constraints, or (M,): see `SOFTNESS`
    """

    shares: FloatArray
    normals: FloatArray
    offsets: FloatArray
    softness: FloatArray | float = SOFTNESS

    def joined(self, other: HalfSpaces) -> HalfSpaces:
        """Concatenate these constraints and others."""
        return HalfSpaces(
            np.concatenate([self.shares, other.shares]),
            np.concatenate([self.normals, other.normals]),
            np.concatenate([self.offsets, other.offsets]),
            np.concatenate(
                [np.broadcast_to(part.softness, len(part.offsets)) for part in (self, other)]
            ),
        )


@dataclass(frozen=True, eq=False)
class TimeKernel:
    """The smoothest corrections of n frames without constraints, and their covariance over time.

    Attributes
    ----------
    spread : (n, n) float64 array, A^-1 of the frames that may change, 0 for pinned ones
    mean : (n, D) float64 array, the corrections without constraints
    """

    spread: FloatArray
    mean: FloatArray

    @classmethod
    def of(
        cls,
        n: int,
        smoothness: float,
        before: FloatArray | None,
        after: FloatArray | None,
        pinned: Mapping[int, FloatArray],
        size: int,
        is_cycle: bool = False,
    ) -> TimeKernel:
        """Condition the program on given corrections.

        Parameters
        ----------
        n : number of frames
        smoothness : w
        before, after : (2, D) corrections of the two frames on either side; None at an end of the
            motion, where nothing constrains the smoothness
        pinned : fixed corrections, by frame
        size : D
        is_cycle : whether the first frame follows the last; `before` and `after` are then None
        """
        given = dict(pinned)
        lead, tail = (0 if row is None else 2 for row in (before, after))
        if before is not None:
            given |= {-2: before[0], -1: before[1]}
        if after is not None:
            given |= {n: after[0], n + 1: after[1]}
        total = lead + n + tail
        bend = np.zeros((total if is_cycle else max(total - 2, 0), total))
        for row in range(len(bend)):
            np.add.at(bend[row], np.arange(row, row + 3) % total, (1.0, -2.0, 1.0))
        hessian = np.eye(total) + smoothness * bend.T @ bend
        movable = [frame for frame in range(n) if frame not in pinned]
        spread, mean = np.zeros((n, n)), np.zeros((n, size))
        inside = np.array(movable, dtype=np.int64) + lead
        spread[np.ix_(movable, movable)] = np.linalg.inv(hessian[np.ix_(inside, inside)])
        if given:
            fixed = np.array(list(given)) + lead
            rows = np.array(list(given.values()))
            mean[movable] = (
                -spread[np.ix_(movable, movable)] @ hessian[np.ix_(inside, fixed)] @ rows
            )
        for frame, correction in pinned.items():
            mean[frame] = correction
        return cls(spread, mean)


def least_corrections(
    kernel: TimeKernel,
    inverse_metric: FloatArray,
    constraints: HalfSpaces,
    equations: HalfSpaces | None = None,
) -> FloatArray | None:
    """Return the (n, D) corrections of least cost in all half-spaces; None if the solver fails.

    Parameters
    ----------
    kernel : of the frames
    inverse_metric : (D, D) G^-1; rows and columns of codes that may not change are 0
    constraints : inequalities of the result, up to their softness; those that no correction can
        change are ignored
    equations : further constraints, as equalities
    """
    both = constraints if equations is None else equations.joined(constraints)
    shares, normals, offsets = both.shares, both.normals, both.offsets
    along, across = shares @ kernel.spread, normals @ inverse_metric
    reach = (along * shares).sum(axis=1) * (across * normals).sum(axis=1)
    counts = reach > _LEAST_REACH
    if not counts.any():
        return kernel.mean
    n_equal = int(np.count_nonzero(counts[: len(shares) - len(constraints.offsets)]))
    along, across = along[counts], across[counts]
    shares, normals, offsets = shares[counts], normals[counts], offsets[counts]
    softness = np.broadcast_to(both.softness, len(counts))[counts]
    scale: FloatArray = 1.0 / np.sqrt(reach[counts])

    def slack(corrections: FloatArray) -> FloatArray:
        at: FloatArray = (offsets - ((shares @ corrections) * normals).sum(axis=1)) * scale
        return at

    slack_at_mean = slack(kernel.mean)
    active = np.arange(n_equal)
    added = n_equal + np.argsort(slack_at_mean[n_equal:], kind="stable")[:_ADDED]
    for number in itertools.count():
        rows = np.concatenate([active, added])
        gram = (along[rows] @ shares[rows].T) * (across[rows] @ normals[rows].T)
        gram *= np.outer(scale[rows], scale[rows])
        gram[np.diag_indices_from(gram)] += softness[rows]
        presses = slack_at_mean[rows] < 0.0
        presses[: len(active)] = True
        multipliers = _solve_program(gram, slack_at_mean[rows], presses, n_equal)
        if multipliers is None:
            return None
        pressed = scale[rows] * multipliers
        moved: FloatArray = kernel.mean - (along[rows] * pressed[:, None]).T @ across[rows]
        left = slack(moved)
        left[rows] = 0.0
        if (left >= -_TOLERANCE).all():
            break
        is_kept = (multipliers > 0.0) | (np.arange(len(rows)) < n_equal)
        active = rows[is_kept] if number < _DROPPING_ROUNDS else rows
        worst = np.argsort(left, kind="stable")[:_ADDED]
        added = worst[left[worst] < -_TOLERANCE]
        if not len(added):
            return None
    return moved


def _solve_program(
    gram: FloatArray, slack: FloatArray, presses: npt.NDArray[np.bool_], n_equal: int
) -> FloatArray | None:
    """Return the (M,) multipliers of equations, which come first, and half-spaces, or None."""
    equal, rest = slice(n_equal), slice(n_equal, None)
    # Eliminate the equations, which leaves a program of the half-spaces.
    solved = np.zeros((n_equal, 1 + len(slack) - n_equal))
    if n_equal:
        known = np.column_stack([slack[equal], gram[equal, rest]])
        solved = scipy.linalg.cho_solve(scipy.linalg.cho_factor(gram[equal, equal]), known)
    mixed = gram[rest, equal]
    multipliers = _solve_lcp(
        gram[rest, rest] - mixed @ solved[:, 1:],
        slack[rest] - mixed @ solved[:, 0],
        presses[rest],
    )
    if multipliers is None:
        return None
    return np.concatenate([-solved[:, 0] - solved[:, 1:] @ multipliers, multipliers])


def _solve_lcp(
    gram: FloatArray, slack: FloatArray, presses: npt.NDArray[np.bool_]
) -> FloatArray | None:
    """Return the multipliers >= 0 of (M,) half-spaces, None if the solver fails.

    Parameters
    ----------
    gram : (M, M) dual Hessian, definite
    slack : (M,) of each half-space at 0
    presses : (M,) half-spaces that are taken as active at first

    Notes
    -----
    Block principal pivoting: Júdice and Pires, "A block principal pivoting algorithm for
    large-scale strictly monotone linear complementarity problems", 1994. All half-spaces on the
    wrong side change sides at once, or only one if that makes no progress.
    """
    presses, least, patience = presses.copy(), len(slack) + 1, _PATIENCE
    for _ in range(_MOST_ITERATIONS):
        pressing = np.flatnonzero(presses)
        multipliers = np.zeros(len(slack))
        if len(pressing):
            factor = scipy.linalg.cho_factor(
                gram[np.ix_(pressing, pressing)], lower=True, overwrite_a=True
            )
            multipliers[pressing] = scipy.linalg.cho_solve(factor, -slack[pressing])
        left = slack + gram[:, pressing] @ multipliers[pressing]
        is_wrong = np.where(presses, multipliers < 0.0, left < -_TOLERANCE)
        n_wrong = int(np.count_nonzero(is_wrong))
        if n_wrong == 0:
            return multipliers
        patience = _PATIENCE if n_wrong < least else patience - 1
        least = min(least, n_wrong)
        if patience < 0:
            is_wrong[: np.flatnonzero(is_wrong)[-1]] = False
        presses ^= is_wrong
    return None


_Block = tuple[FloatArray, FloatArray, FloatArray]
"""(n,) shares, (m, D) normals and (m,) offsets."""


def stacked(blocks: Sequence[_Block], n: int, size: int, softness: float = SOFTNESS) -> HalfSpaces:
    """Join blocks to one set of constraints."""
    if not blocks:
        return HalfSpaces(np.zeros((0, n)), np.zeros((0, size)), np.zeros(0))
    offsets = np.concatenate([offsets for _, _, offsets in blocks])
    return HalfSpaces(
        np.concatenate([np.tile(share, (len(offsets), 1)) for share, _, offsets in blocks]),
        np.concatenate([normals for _, normals, _ in blocks]),
        offsets,
        softness,
    )


SMOOTHNESS = 300.0
"""w at 30 frames a second: the weight of acceleration relative to displacement. A third of it stays
nearer to the motion and adds a tenth to its acceleration."""

ROUNDS, _FEW_ROUNDS = 22, 4
"""Most rounds of a search, and of one that goes on from fewer frames: what is left is searched
anew from there."""

_LEFT_BY_ROUND = 0.96
"""Share of the remaining work that a round is reported to leave."""

_RESOLVED_AT = (6, 8, 10, 12)
"""Rounds in which frames without a free pose look for one by all means of Resolve."""

_PINNED_AT = (14, 17, 20)
"""Rounds in which frames that still collide are pinned to free poses, and the others settle
smoothly around them."""

_PIN_REACH = 0.015
"""Normalised distance of a free pose up to which frames are pinned, except in the last of these
rounds."""

_STALLED, _NEARER = 4, 0.95
"""Rounds without progress after which patches are left apart, if all is free, and the share of
their lacking distance below which there is progress."""

_DROPS = 4
"""Contacts that are left out one by one, before all that stay apart are."""

_SEARCHES, _SETTLED = 6, 0.95
"""Most searches of a span, and the share of the cost that a search must go below to be followed by
another one."""

_ENOUGH = 1.25
"""Cost, relative to that of a search of the knots alone, up to which a span is not searched
again."""

_FALLING = 0.4
"""Share of the cost below which a search is followed by another one in any case."""

_MOSTLY_BENT, _BENT_MORE, _UNSETTLED_BENT_MORE = 0.3, 1.02, 1.2
"""Corrections are jerky if their bends count for more than this share of their size, and the motion
bends by more than this factor, or by more than the second if some frames are not free yet. Of one
clip with noise, 0.14 to 0.31 and at most 1.02 were seen, and 0.32 to 60 and 1.02 to 6.7 of searches
that had met contacts on the wrong sides."""

_STILL = 1e-4
"""Normalised distance from a pose that was free within which a frame is taken as free, until all
others are."""

_REMEMBERED, _REMEMBERED_BETWEEN = 6, 3
"""Number of poses whose contacts are used, for each frame and between frames."""

_NEAR, _HALVINGS = 0.004, 3
"""Distance and number of halvings to find where a frame, on the way from a free pose, begins to
collide; contacts are taken there."""

_REFUTED, _SLACK = 5e-4, 1e-5
"""Half-spaces that a free pose violates by more than the first, normalised, are dropped; the others
are moved to hold it with the second."""

_LEAST_EXCESS = 2.0 * _SLACK
"""Excess above which a half-space excludes a pose."""

_BEYOND, _BOUNDED, _BOUND_ROUNDS = 0.01, 60, 3
"""Excess beyond their limits from which codes become constraints, the most of these in a round, the
farthest first, and the most rounds."""


class _Evaluation(NamedTuple):
    """Corrections of the frames of a span, and their collisions.

    Attributes
    ----------
    corrections : (n, D)
    is_free : (n,) whether each frame is free
    between : frames that are free like the next, but with a colliding pose between
    n_apart : number of patches, summed over frames, that should touch and do not
    lack : sum of the distances that they lack, normalised
    """

    corrections: FloatArray
    is_free: npt.NDArray[np.bool_]
    between: list[int]
    n_apart: int = 0
    lack: float = 0.0

    @property
    def score(self) -> float:
        """The number of colliding frames, plus half that of colliding poses between."""
        return float(np.count_nonzero(~self.is_free)) + 0.5 * len(self.between)

    @property
    def rank(self) -> tuple[float, int]:
        """Sort key, less is better: the score, then the number of patches apart."""
        return self.score, self.n_apart


@dataclass(eq=False)
class SpanProgram:
    """Find the corrections of the frames of a span.

    Parameters
    ----------
    frames : of the motion
    span : its n frames
    start : (n, D) initial corrections
    is_free : (n,) whether each frame is free with them
    before, after : (2, D) corrections of the two frames on either side, or None: see `TimeKernel`
    smoothness : w
    fractions : for each of the n frames, fractions of the way to the next of poses that must be
        free too
    knots : (n,) frames that are resolved first, the others and the poses between after them
    cuts_off : whether a half-space across the way from a frame's known free pose excludes a
        colliding pose that its contacts allow
    is_cycle : whether the first frame follows the last
    tell : called with an estimate of the share done, in [0, 1)
    """

    frames: Frames
    span: range
    start: FloatArray
    is_free: npt.NDArray[np.bool_]
    before: FloatArray | None
    after: FloatArray | None
    smoothness: float
    fractions: Sequence[FloatArray]
    knots: npt.NDArray[np.bool_]
    cuts_off: bool
    is_cycle: bool = False
    tell: Callable[[float], None] = UNWATCHED.report
    _rounds: int = 0
    _contacts: list[list[HalfSpacesOfPose]] = field(init=False)
    _hopeless: set[int] = field(default_factory=set)
    _between: dict[tuple[int, float], list[HalfSpacesOfPose]] = field(default_factory=dict)
    _limits: dict[tuple[int, int], float] = field(default_factory=dict)
    _pulls: dict[int, Pulls] = field(default_factory=dict)
    _clear: dict[tuple[int, float], FloatArray] = field(default_factory=dict)
    _best: _Evaluation | None = None
    _n_dropped: int = 0

    def __post_init__(self) -> None:
        # The frames that are checked; others are taken as free.
        self._watched = self.knots
        self._targets = self.frames.motion.codes[self.span.start : self.span.stop]
        self._contacts = [[] for _ in self.span]
        # The newest known free pose of each frame.
        self._known, self._is_known = self._targets + self.start, self.is_free.copy()
        self._is_free_before = self.is_free & ~self.start.any(axis=1)
        # Whether that is the pose in which the frame was checked last.
        self._was_free = self._is_free_before.copy()
        bounds = [self.frames.limits(frame) for frame in self.span]
        # Whether half-spaces are moved to hold known free poses: frees less, but bends less.
        self._gives_way = True
        self._low, self._high = (np.array(side) for side in zip(*bounds, strict=True))

    def solve(self) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Return the (n, D) corrections, and (n,) whether each frame is free with them."""
        best, least = self._search(None), 0.0
        if not self.knots.all():
            # What is between the knots moves with them.
            self._watched = np.ones_like(self.knots)
            if self._rounds < _PINNED_AT[1]:
                least = self.cost(best.corrections)
            best = self._search(best)
        best = self._best = self._settled_search(best, _ENOUGH * least)
        put_back: npt.NDArray[np.bool_] = ~best.is_free & self._is_known
        chosen = np.where(put_back[:, None], self._known - self._targets, best.corrections)
        return chosen, best.is_free | put_back

    def _settled_search(self, best: _Evaluation, enough: float) -> _Evaluation:
        """Search again while that gains much, and costs more than enough; return the best."""
        gives_way, last = True, 0.0
        n_drops = 0
        # Touches that contradict each other may be kept without the one that lacks most.
        while best.n_apart and self._drop_contacts(best, drops_all=n_drops >= _DROPS):
            n_drops += 1
            best = self._search(None)
        for _ in range(1, _SEARCHES):
            self._best, cost = best, self.cost(best.corrections)
            is_done = best.score > 0.0 or _FALLING * last <= cost <= enough
            if self._is_settled(best) and is_done:
                break
            last = cost
            self._gives_way = gives_way
            self._forget(best)
            solution = self._search(None)
            gives_way = self._is_settled(solution)
            before, after = self._worth(best), self._worth(solution)
            if after < before:
                best = solution
                if after > (*before[:2], _SETTLED * before[2]):
                    break
            elif gives_way or not self._gives_way or not self.knots.all():
                break
        return best

    @property
    def is_settled(self) -> bool:
        """Whether a search has freed all but the frames for which no free pose was found."""
        return self._best is not None and self._is_settled(self._best)

    @property
    def rank(self) -> tuple[float, int]:
        """What the last search could not free, and the touches left out; less is better."""
        score, n_apart = self._best.rank if self._best is not None else (np.inf, 0)
        return score, n_apart + self._n_dropped

    @property
    def is_free_now(self) -> npt.NDArray[np.bool_]:
        """(n,) whether each frame is free with the corrections of the best search."""
        return self._best.is_free if self._best is not None else np.zeros_like(self.is_free)

    def so_far(self) -> dict[int, FloatArray]:
        """Return the (D,) corrections that free frames, if the search is stopped."""
        if self._best is not None and self.is_settled:
            return dict(enumerate(self._best.corrections))
        freed = self._is_known & ~self._is_free_before
        return {at: self._known[at] - self._targets[at] for at in np.flatnonzero(freed).tolist()}

    def _drop_contacts(self, best: _Evaluation, *, drops_all: bool) -> bool:
        """Leave out, where it stays apart, the contact that lacks most, or all of them.

        Returns
        -------
        whether there is one
        """
        contacts = self.frames.kept_contacts
        if contacts is None:
            return False
        pulled = self.frames.pool.map(
            self.frames.pulls, self.span, self._targets + best.corrections
        )
        lacks: dict[int, float] = defaultdict(float)
        apart: list[tuple[int, int, int]] = []
        for at, pulls in zip(self.span, pulled, strict=True):
            for number, lack in pulls.apart.items() if pulls is not None else ():
                contact = contacts.touches[at][number].contact
                lacks[contact] += lack
                apart.append((at, number, contact))
        worst = max(lacks, key=lacks.__getitem__, default=None)
        dropped: dict[int, list[int]] = defaultdict(list)
        for at, number, contact in apart:
            if drops_all or contact == worst:
                dropped[at].append(number)
                self._n_dropped += 1
        self.frames = replace(self.frames, kept_contacts=contacts.without_touches(dropped))
        return bool(apart)

    def _forget(self, best: _Evaluation) -> None:
        """Forget a search but for its result: contacts met elsewhere lead to detours."""
        for seen in (*self._contacts, *self._between.values()):
            seen.clear()
        self._limits.clear()
        ends = self._targets + best.corrections
        freed = best.is_free & self._watched
        self._known = np.where(freed[:, None], ends, self._known)
        self._is_known |= freed
        self._known[self._is_free_before] = self._targets[self._is_free_before]
        self._was_free = self._is_free_before.copy()

    def _search(self, begin: _Evaluation | None) -> _Evaluation:
        """Return the first corrections that free all frames, else the best of all rounds.

        Parameters
        ----------
        begin : the result of a search of fewer frames, to go on from; None for no corrections
        """
        n = len(self._targets)
        corrections = np.zeros(self._targets.shape) if begin is None else begin.corrections
        start = self._evaluate(corrections, {}, resolves=begin is not None)
        if start.score == 0.0 and not start.n_apart:
            return start
        pinned: dict[int, FloatArray] = {}
        kernel, now, best = self._kernel(pinned), start, start
        least, n_stalled = start.lack, 0
        n_rounds = ROUNDS if begin is None else _FEW_ROUNDS
        if begin is None and self._watched.all() and not self.knots.all():
            # Frames that still collide then are better resolved one by one.
            n_rounds = _PINNED_AT[0]
        for number in range(n_rounds):
            # Two pinned neighbours would leave a pose between them no way out.
            released = [at for at in now.between if at in pinned and (at + 1) % n in pinned]
            for at in released:
                pinned.pop(at, None)
            if number in _PINNED_AT:
                stuck = self._stuck(now, None if number == _PINNED_AT[-1] else _PIN_REACH)
                pinned |= {at: self._known[at] - self._targets[at] for at in stuck}
            if released or number in _PINNED_AT:
                kernel = self._kernel(pinned)
            moved = self._settle(kernel, pinned)
            corrections = now.corrections.copy() if moved is None else moved
            # Apply pinned corrections even if the solver failed.
            for at, correction in pinned.items():
                corrections[at] = correction
            now = self._evaluate(corrections, pinned, number + 1 in _RESOLVED_AT)
            self._rounds += 1
            self.tell(1.0 - _LEFT_BY_ROUND**self._rounds)
            if number + 1 in _RESOLVED_AT:
                # Contacts of frames without a known free pose would keep the others from settling.
                self._hopeless |= set(np.flatnonzero(~(now.is_free | self._is_known)).tolist())
            n_stalled = 0 if now.lack < _NEARER * least else n_stalled + 1
            least = min(least, now.lack)
            if self._is_settled(now) and (now.n_apart == 0 or n_stalled >= _STALLED):
                is_better = now.rank <= min(best.rank, (now.score, start.n_apart))
                if is_better and (now.score == 0.0 or now.score < start.score):
                    return now
                break
            # Corrections must be better than none.
            if now.rank <= best.rank and now.rank < start.rank:
                best = now
        return self._look(best.corrections, {}, resolves=False, still=0.0)

    def _is_settled(self, now: _Evaluation) -> bool:
        """Whether all is free except frames for which no free pose was found."""
        return self._are_hopeless(~now.is_free) and not now.between

    def _are_hopeless(self, stuck: npt.NDArray[np.bool_]) -> bool:
        """Whether no free pose was found for any of some frames, (n,), nor is still sought."""
        return set(np.flatnonzero(stuck)) <= self._hopeless - set(np.flatnonzero(self._is_known))

    def _stuck(self, now: _Evaluation, reach: float | None) -> list[int]:
        """Return the colliding frames that have a known free pose within a reach.

        A neighbour's correction may give a frame a nearer free pose.
        """
        n, frames, stuck = len(self._targets), self.frames, []
        for at in np.flatnonzero(~now.is_free).tolist():
            goal = self._targets[at] + now.corrections[at]
            known = frames.distance(self._known[at], goal) if self._is_known[at] else np.inf
            beside = [(at + step) % n for step in (-1, 1) if self.is_cycle or 0 <= at + step < n]
            for neighbour in beside:
                pose = self._targets[at] + now.corrections[neighbour]
                away = frames.distance(pose, goal)
                is_nearer = now.is_free[neighbour] and away < known
                if is_nearer and frames.contacts(self.span[at], pose) is None:
                    self._known[at], self._is_known[at], known = pose, True, away
            if known < np.inf and (reach is None or known <= reach):
                stuck.append(at)
        return stuck

    def _worth(self, solution: _Evaluation) -> tuple[float, int, float]:
        return *solution.rank, self.cost(solution.corrections)

    def cost(self, corrections: FloatArray) -> float:
        """Return the objective of the program for (n, D) corrections."""
        return sum(self._parts(corrections))

    def is_jerky(self, corrections: FloatArray) -> bool:
        """Whether (n, D) corrections make the motion bend more, and are mostly bends."""
        moved, bent = self._parts(corrections)
        before, after = (
            self._square(np.diff(poses, 2, axis=0))
            for poses in (self._targets, self._targets + corrections)
        )
        factor = _BENT_MORE if self.is_settled else _UNSETTLED_BENT_MORE
        return bent > _MOSTLY_BENT * moved and after > factor * before

    def _parts(self, corrections: FloatArray) -> tuple[float, float]:
        """Return what the objective counts of the corrections and of their bends."""
        rows = np.concatenate([corrections, corrections[:2]]) if self.is_cycle else corrections
        known = [side for side in (self.before, rows, self.after) if side is not None]
        bends = np.diff(np.concatenate(known), 2, axis=0)
        return self._square(corrections), self.smoothness * self._square(bends)

    def _square(self, rows: FloatArray) -> float:
        return float(np.einsum("td,de,te->", rows, self.frames.metric, rows))

    def _kernel(self, pinned: dict[int, FloatArray]) -> TimeKernel:
        n, size = self._targets.shape
        return TimeKernel.of(
            n, self.smoothness, self.before, self.after, pinned, size, self.is_cycle
        )

    def _evaluate(
        self, corrections: FloatArray, pinned: dict[int, FloatArray], resolves: bool
    ) -> _Evaluation:
        """Collect the contacts of corrections; frames that hardly move are checked last."""
        now = self._look(corrections, pinned, resolves, _STILL)
        return self._look(corrections, pinned, False, 0.0) if self._is_settled(now) else now

    def _look(
        self,
        corrections: FloatArray,
        pinned: dict[int, FloatArray],
        resolves: bool,
        still: float,
    ) -> _Evaluation:
        """Collect the contacts of corrections.

        Parameters
        ----------
        pinned : frames that are free
        resolves : whether colliding frames without a free pose look farther for one
        still : distance from a pose that was free within which a frame counts as free
        """
        poses = self._targets + corrections
        frames = self.frames
        watched = [at for at in np.flatnonzero(self._watched).tolist() if at not in pinned]
        asked = [
            at
            for at in watched
            if not (self._was_free[at] and self._is_near(poses[at], self._known[at], still))
        ]
        verdicts = frames.are_free([self.span[at] for at in asked], codes=poses[asked])
        self._was_free[asked] = verdicts
        now_free, colliding = (list(np.compress(side, asked)) for side in (verdicts, ~verdicts))
        self._known[now_free], self._is_known[now_free] = poses[now_free], True
        known = {int(at): self._known[at].copy() for at in np.flatnonzero(self._is_known)}
        for _ in frames.pool.map(lambda at: self._meet(at, poses[at], known, resolves), colliding):
            pass
        is_free = np.ones(len(poses), dtype=np.bool_)
        is_free[colliding] = False
        self._pulls = {}
        if frames.kept_contacts is not None:
            pulled = frames.pool.map(frames.pulls, self.span, poses)
            self._pulls = {at: pulls for at, pulls in enumerate(pulled) if pulls is not None}
        between = self._look_between(poses, is_free, still)
        n_apart = sum(pulls.n_apart for pulls in self._pulls.values())
        lack = sum(pulls.lack for pulls in self._pulls.values())
        return _Evaluation(corrections, is_free, between, n_apart, lack)

    def _look_between(
        self, poses: FloatArray, is_free: npt.NDArray[np.bool_], still: float
    ) -> list[int]:
        """Collect the contacts between free frames; return those before a colliding pose.

        Parameters
        ----------
        poses : (n, D) codes of the frames
        is_free : (n,) whether each frame is free
        still : see `_look`
        """
        n, is_whole = len(poses), self._are_hopeless(~is_free)
        places = [
            (at, fraction)
            for at in range(n if self.is_cycle else n - 1)
            if self._watched.all() and is_free[at] and is_free[(at + 1) % n]
            for fraction in self.fractions[at].tolist()
            # Frames come first: what lies between them moves with them.
            if is_whole or (at, fraction) in self._between
        ]
        middles = {
            (at, share): (1.0 - share) * poses[at] + share * poses[(at + 1) % n]
            for at, share in places
        }
        places = [
            place
            for place in places
            if place not in self._clear
            or not self._is_near(middles[place], self._clear[place], still)
        ]
        half_spaces = self.frames.pool.map(
            lambda place: self.frames.contacts_between(
                self.span[place[0]], place[1], poses[place[0]], poses[(place[0] + 1) % n]
            ),
            places,
        )
        between = []
        for place, contacts in zip(places, half_spaces, strict=True):
            self._clear.pop(place, None)
            if contacts is None:
                self._clear[place] = middles[place]
            else:
                between.append(place[0])
                self._between.setdefault(place, []).append(contacts)
        return between

    def _meet(
        self, at: int, goal: FloatArray, known: Mapping[int, FloatArray], resolves: bool
    ) -> None:
        """Collect the contacts of one frame on its way to a colliding pose.

        Parameters
        ----------
        known : free poses, by frame
        """
        frames, frame, colliding = self.frames, self.span[at], goal
        apart = frames.distance(self._known[at], goal) if self._is_known[at] else np.inf
        # Frames with watched neighbours keep to their side; others look for the nearest way out.
        is_alone = not self._watched.all() and not np.array_equal(goal, self._targets[at])
        if is_alone or apart == np.inf:
            freed, contacts = frames.polished(frame, goal)
            if freed is not None and frames.distance(freed, goal) < apart:
                self._known[at], self._is_known[at] = freed, True
                self._contacts[at].append(contacts)
                return
        if not self._is_known[at]:
            free_pose = self._free_beside(at, goal, known)
            if free_pose is None and resolves:
                free_pose = frames.near(frame, goal)
            if free_pose is not None:
                self._known[at], self._is_known[at] = free_pose, True
        if self._is_known[at]:
            free, apart = self._known[at], frames.distance(self._known[at], goal)
            for _ in range(_HALVINGS):
                if apart <= _NEAR:
                    break
                middle, apart = 0.5 * (free + colliding), 0.5 * apart
                if frames.is_free(frame, middle):
                    free = middle
                else:
                    colliding = middle
            self._known[at] = free
        if half_spaces := frames.contacts(frame, colliding):
            self._contacts[at].append(half_spaces)
        if self.cuts_off:
            self._cut_off(at, goal)

    def _cut_off(self, at: int, goal: FloatArray) -> None:
        """Exclude a colliding (D,) pose of a frame that its contacts allow."""
        known, own = self._known[at], self._own_half_spaces(at)
        apart = self.frames.distance(goal, known)
        is_excluded = any(
            (normals @ goal > offsets + _LEAST_EXCESS).any() for normals, offsets in own
        )
        if self._is_known[at] and apart > 0.0 and not is_excluded:
            across = self.frames.metric @ (goal - known) / apart
            self._contacts[at].append((across[None], across[None] @ known))

    def _free_beside(
        self, at: int, goal: FloatArray, known: Mapping[int, FloatArray]
    ) -> FloatArray | None:
        """Return the nearest pose or correction of neighbours that frees a frame, or None."""
        frames, poses = self.frames, []
        for neighbour in (
            max((n for n in known if n < at), default=None),
            min((n for n in known if n > at), default=None),
        ):
            if neighbour is not None:
                correction = known[neighbour] - self._targets[neighbour]
                poses += [self._targets[at] + correction, known[neighbour]]
        poses = [np.clip(pose, self._low[at], self._high[at]) for pose in poses]
        free = [
            pose
            for pose in poses
            if frames.is_near_enough(self.span[at], pose) and frames.is_free(self.span[at], pose)
        ]
        return min(free, key=lambda pose: frames.distance(pose, goal), default=None)

    def _is_near(self, pose: FloatArray, known: FloatArray, still: float) -> bool:
        if still == 0.0:
            return np.array_equal(pose, known)
        return self.frames.distance(pose, known) <= still

    def _settle(self, kernel: TimeKernel, pinned: dict[int, FloatArray]) -> FloatArray | None:
        """Return the smoothest corrections that all contacts and limits allow, or None."""
        n, size = self._targets.shape
        blocks, (pulls, level) = self._half_spaces(pinned), self._pulled(pinned)
        moved = None
        for _ in range(_BOUND_ROUNDS):
            limits = [
                self._limit(*place, side)
                for place, side in self._limits.items()
                if place[0] not in pinned
            ]
            constraints = stacked([*blocks, *limits], n, size)
            if pulls:
                constraints = constraints.joined(stacked(pulls, n, size, _PULLED))
            corrections = least_corrections(
                kernel,
                self.frames.inverse_metric,
                constraints,
                stacked(level, n, size, _LEVEL),
            )
            if corrections is None:
                break
            poses = self._targets + corrections
            moved = np.clip(poses, self._low, self._high) - self._targets
            beyond = np.maximum(poses - self._high, self._low - poses)
            beyond[list(pinned)] = 0.0
            new = [
                (int(at), int(code))
                for at, code in np.argwhere(beyond > _BEYOND)
                if (at, code) not in self._limits
            ]
            if not new:
                break
            for place in sorted(new, key=lambda place: -beyond[place])[:_BOUNDED]:
                self._limits[place] = 1.0 if poses[place] > self._high[place] else -1.0
        return moved

    def _pulled(self, pinned: dict[int, FloatArray]) -> tuple[list[_Block], list[_Block]]:
        """Return the constraints that bring patches together, and equations of anchored ones."""
        shares = np.eye(len(self._targets))
        both: tuple[list[_Block], list[_Block]] = [], []
        for at, pulls in self._pulls.items():
            if at not in pinned:
                own = (pulls.normals, pulls.offsets), (pulls.standing, pulls.places)
                for blocks, (normals, offsets) in zip(both, own, strict=True):
                    blocks.append((shares[at], normals, offsets - normals @ self._targets[at]))
        return both

    def _half_spaces(self, pinned: dict[int, FloatArray]) -> list[_Block]:
        n = len(self._targets)
        shares, blocks = np.eye(n), []
        for at in range(n):
            if at in pinned or (at in self._hopeless and not self._is_known[at]):
                continue
            target = self._targets[at]
            for normals, offsets in self._own_half_spaces(at):
                blocks.append((shares[at], normals, offsets - normals @ target))
        for (at, fraction), seen in self._between.items():
            share, target = (
                (1.0 - fraction) * rows[at] + fraction * rows[(at + 1) % n]
                for rows in (shares, self._targets)
            )
            for normals, offsets in seen[-_REMEMBERED_BETWEEN:]:
                blocks.append((share, normals, offsets - normals @ target))
        return blocks

    def _own_half_spaces(self, at: int) -> list[HalfSpacesOfPose]:
        """Return the half-spaces of one frame that its known free pose does not refute."""
        seen = self._contacts[at][-_REMEMBERED:]
        if not self._is_known[at]:
            return seen
        rows = []
        for normals, offsets in seen:
            at_free = normals @ self._known[at]
            kept = at_free - offsets <= _REFUTED
            if self._gives_way:
                offsets = np.maximum(offsets, at_free - _SLACK)
            rows.append((normals[kept], offsets[kept]))
        return rows

    def _limit(self, at: int, code: int, side: float) -> _Block:
        n, size = self._targets.shape
        limit = self._high[at, code] if side > 0.0 else self._low[at, code]
        normal = side * np.eye(1, size, code)
        return np.eye(1, n, at)[0], normal, side * np.array([limit - self._targets[at, code]])
