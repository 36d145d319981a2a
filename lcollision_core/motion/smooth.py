"""The smallest and smoothest corrections of a span's frames that half-spaces allow.

Minimises sum_t |c_t|^2 + w |c_{t-1} - 2 c_t + c_{t+1}|^2, with |c|^2 = c^T G c, over the
corrections c_t of the frames of a span. Its Hessian is A (x) G with A = I + w D2^T D2, so that the
program is solved in the multipliers of the constraints, of which there are few: its dual Hessian
has the entries (a_i^T A^-1 a_j) (n_i^T G^-1 n_j).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import daqp
import numpy as np

from lcollision_core.meshes.topology import FloatArray

SOFTNESS = 1e-4
"""Added to the normalised dual Hessian: contacts that contradict each other give way a little."""

_LEAST_REACH = 1e-9
"""Squared change of a constraint by a correction of cost 1. What reaches less has no say in it, as
where all that could move it is locked or pinned."""

_OPTIMAL = 1
_UNBOUNDED = -1e30
_TOLERANCE, _MOST_ITERATIONS = 1e-8, 20_000


@dataclass(frozen=True, eq=False)
class HalfSpaces:
    """M constraints sum_t share[i, t] normals[i]^T c_t <= offsets[i] on n corrections.

    Attributes
    ----------
    shares : (M, n) float64 array; a frame's own constraint has one 1
    normals, offsets : (M, D) and (M,) float64 arrays
    """

    shares: FloatArray
    normals: FloatArray
    offsets: FloatArray


@dataclass(frozen=True, eq=False)
class TimeKernel:
    """The smoothest corrections of n frames without constraints, and how far they yield.

    Attributes
    ----------
    spread : (n, n) float64 array, A^-1 of the frames that may change, 0 for those that are pinned
    mean : (n, D) float64 array: where the corrections lie without constraints
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
        """Condition the program on corrections that are given.

        Parameters
        ----------
        n : frames
        smoothness : w
        before, after : (2, D) corrections of the two frames on either side; None at an end of the
            motion, which is left as smooth as it comes
        pinned : corrections of frames that are to keep them
        size : D
        is_cycle : the first frame comes after the last; none are given on either side
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
    kernel: TimeKernel, inverse_metric: FloatArray, constraints: HalfSpaces
) -> FloatArray | None:
    """Return the (n, D) corrections of least cost in all half-spaces; None if the solver fails.

    Parameters
    ----------
    kernel : of the frames
    inverse_metric : (D, D) G^-1; rows and columns of codes that may not change are 0
    constraints : that hold at the result, up to `SOFTNESS`, but for those that no change reaches
    """
    along, across = constraints.shares @ kernel.spread, constraints.normals @ inverse_metric
    reach = (along * constraints.shares).sum(axis=1) * (across * constraints.normals).sum(axis=1)
    counts = reach > _LEAST_REACH
    if not counts.any():
        return kernel.mean
    along, across = along[counts], across[counts]
    shares, normals, offsets = (
        rows[counts] for rows in (constraints.shares, constraints.normals, constraints.offsets)
    )
    gram = (along @ shares.T) * (across @ normals.T)
    scale = 1.0 / np.sqrt(np.diag(gram))
    at_mean = np.einsum("mt,td,md->m", shares, kernel.mean, normals, optimize=True)
    bounds = (offsets - at_mean) * scale
    gram *= np.outer(scale, scale)
    gram[np.diag_indices_from(gram)] += SOFTNESS
    factor = np.linalg.cholesky(gram).astype(np.float64)
    size = len(bounds)
    _, _, status, info = daqp.solve(
        np.eye(size),
        np.zeros(size),
        np.ascontiguousarray(factor),
        bounds,
        np.full(size, _UNBOUNDED),
        np.zeros(size, dtype=np.int32),
        primal_tol=_TOLERANCE,
        iter_limit=_MOST_ITERATIONS,
    )
    if status != _OPTIMAL:
        return None
    pressed = np.asarray(info["lam"]) * scale
    moved: FloatArray = kernel.mean - (along * pressed[:, None]).T @ across
    return moved


def stacked(
    blocks: Sequence[tuple[FloatArray, FloatArray, FloatArray]], n: int, size: int
) -> HalfSpaces:
    """Join blocks of (n,) shares, (m, D) normals and (m,) offsets into one set of constraints."""
    if not blocks:
        return HalfSpaces(np.zeros((0, n)), np.zeros((0, size)), np.zeros(0))
    return HalfSpaces(
        np.concatenate([np.tile(share, (len(offsets), 1)) for share, _, offsets in blocks]),
        np.concatenate([normals for _, normals, _ in blocks]),
        np.concatenate([offsets for _, _, offsets in blocks]),
    )
