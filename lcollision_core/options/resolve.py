"""Options of Resolve."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

from lcollision_core.errors import LCollisionError
from lcollision_core.options.field import Option, require_limits


class Solver(StrEnum):
    """What solves the paper's problem; AUGLAG is the paper's method."""

    SQP = "sqp"
    AUGLAG = "auglag"
    SLSQP = "slsqp"
    CCSAQ = "ccsaq"


class Metric(StrEnum):
    """What is kept small: the displacement of the vertices, or of the codes as in the paper."""

    DISPLACEMENT = "vertices"
    LATENT = "latent"

    @classmethod
    def _missing_(cls, value: object) -> Metric | None:
        # Its name in older scripts.
        return cls.DISPLACEMENT if value == "eye" else None


LARGEST_CHANGE = 0.25
"""Normalised: farther than that a vertex is moved only if somebody asks for it."""


@dataclass(frozen=True)
class ResolveOptions:
    """How to solve; the defaults are what measured best.

    Attributes
    ----------
    solver : of the paper's problem, the name of a `Solver`
    metric : what is kept small, the name of a `Metric`
    threshold : largest collision probability of a pose that counts as predicted free, in (0, 1)
    margin : >= 0, how far below the threshold's logit the solver is to go at first; by default 0
        with the further margins of the ladder tried beside it
    locked_domains : indices from 0 of domains that keep their codes: Z_k, and the one code of
        Z_0 whose component the domain is. Neighbours may still carry a locked domain along.
    locked_codes : indices from 0 of further codes that stay
    still_domains : indices from 0 of domains whose vertices are to stay where they are, though
        their codes may change, as pinned ones
    standing : unit vector away from the ground: parts that stand on it in the pose are to stay
        likewise, and a body that has a place of its own is moved as a whole so that they do; None
        where nothing stands
    group_weights : 1 + K numbers > 0 for (Z_0, Z_1, ..., Z_K), by which the cost of moving each
        group is multiplied; by default all 1
    time_budget : seconds after which the ladder goes straight to its last step; None for no limit.
        With one, results depend on the machine's speed.
    verify : check exactly and climb the ladder; False returns the solver's result
    clearance : in [0, 1), normalised: a pose is free where no pair that counts is nearer than that,
        see `CollisionDetector.with_clearance`; the solver of the paper's problem does not know it
    largest_change : > 0, normalised: no vertex moves farther, and where no free pose is that near,
        the pose of least overlap is the result; None for a free pose however far it is. Without
        `verify` there is no bound.
    seed : >= 0, of the restarts

    Raises
    ------
    LCollisionError : there is no such solver or metric, a number is out of its range, or a largest
        change is chosen without `verify`.
    """

    solver: Annotated[str, Option("sqp, auglag (the paper's), slsqp or ccsaq.", metavar="NAME")] = (
        Solver.SQP
    )
    metric: Annotated[
        str, Option("Distance to minimise: of vertices, or of codes.", metavar="vertices|latent")
    ] = Metric.DISPLACEMENT
    threshold: Annotated[
        float,
        Option("Decision threshold: up to this probability a pose is predicted free.", metavar="P"),
    ] = 0.5
    margin: Annotated[
        float | None,
        Option("How far below the threshold's logit the first step aims.", metavar="X"),
    ] = None
    locked_domains: frozenset[int] = field(default_factory=frozenset)
    locked_codes: frozenset[int] = field(default_factory=frozenset)
    still_domains: frozenset[int] = field(default_factory=frozenset)
    standing: tuple[float, float, float] | None = None
    group_weights: tuple[float, ...] | None = None
    time_budget: Annotated[
        float | None,
        Option("Search time per pose; after that, a known free pose is used.", metavar="SECONDS"),
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
        if not 0.0 < self.threshold < 1.0:
            raise LCollisionError.must_be(
                "the threshold", "a probability between 0 and 1", f"{self.threshold:g}"
            )
        if self.margin is not None and not 0.0 <= self.margin < math.inf:
            raise LCollisionError.must_be("the margin", "0 or more", f"{self.margin:g}")
        if self.largest_change is not None:
            if not 0.0 < self.largest_change < math.inf:
                allowed, got = "a number of body sizes above 0", f"{self.largest_change:g}"
                raise LCollisionError.must_be("the largest change", allowed, got)
            if not self.verify and self.largest_change != LARGEST_CHANGE:
                what = "a largest change needs the exact check"
                raise LCollisionError(what, "leave out --no-verify or --largest-change")
        if self.time_budget is not None and not self.time_budget > 0.0:
            raise LCollisionError.must_be(
                "the time budget", "more than 0 seconds", f"{self.time_budget:g}"
            )
        if self.group_weights is not None and not all(
            0.0 < weight < math.inf for weight in self.group_weights
        ):
            raise LCollisionError("a group's weight must be a number above 0")
        require_limits(self)

    @property
    def threshold_logit(self) -> float:
        """The logit of `threshold`, 0 for 0.5."""
        return math.log(self.threshold) - math.log1p(-self.threshold)
