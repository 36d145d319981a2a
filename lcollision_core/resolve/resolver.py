"""Resolve: the nearest pose that is free of collisions by the exact check."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise, repeat
from threading import Lock

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError, ShapeError
from lcollision_core.jobs import CancelToken, Progress, available_cores, no_progress
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.options.resolve import Metric, ResolveOptions
from lcollision_core.posing import ExactCheck
from lcollision_core.resolve.ladder import Ladder
from lcollision_core.resolve.problem import CollisionModel, Deadline, ResolveProblem
from lcollision_core.resolve.result import ResolveResult
from lcollision_core.resolve.standing import Standing
from lcollision_core.resolve.threads import single_torch_thread

STILL_WEIGHT = 1e4
"""Of the squared displacement of parts that are to stay where they are: feet then slide by less
than a thousandth of a percent a frame. Locking their codes instead leaves poses colliding."""


class PoseResolver:
    """Resolves the self-collisions of one model's poses; immutable, safe between threads.

    Parameters
    ----------
    check : the exact check of the model's poses
    predictor : the differentiable predictor: a `CollisionPredictor`; None leaves out the steps that
        need one, and steps from known free poses towards the target instead
    free_latents : (F, D) array of poses known to be collision-free: see `find_free_poses`. Without
        any, a pose that the other steps do not resolve stays colliding.

    Attributes
    ----------
    check : as given
    """

    def __init__(
        self,
        check: ExactCheck,
        predictor: CollisionModel | None,
        free_latents: npt.ArrayLike,
    ) -> None:
        self.check, self._space, self._predictor = check, check.space, predictor
        self._low, self._high = check.space.low, check.space.high
        size = len(self._low)
        self._free_latents: FloatArray = np.array(free_latents, np.float64).reshape(-1, size)

    def with_check(self, check: ExactCheck) -> PoseResolver:
        """Return the same of poses that another check judges, as where something is added to them.

        Parameters
        ----------
        check : of the same space
        """
        # Other poses are free by it, or not.
        known = self._free_latents
        if len(known):
            known = known[[check.is_free(one) for one in known]]
        return PoseResolver(check, self._predictor, known)

    def resolve(
        self,
        latent: npt.ArrayLike,
        options: ResolveOptions | None = None,
        progress: Progress = no_progress,
        cancel: CancelToken | None = None,
        placement: RigidTransform | None = None,
        near: npt.ArrayLike | None = None,
        before: npt.ArrayLike | None = None,
    ) -> ResolveResult:
        """Find the nearest collision-free pose.

        Parameters
        ----------
        latent : (D,) finite array Z*
        options : the defaults if None
        progress : called with (steps of the ladder done, all steps)
        cancel : polled at every evaluation
        placement : where the pose is exported to; the exact check is of the vertices there
        near : (D,) array, a correction Z - Z* to try first, as of the neighbouring frame
        before : (D,) array, a collision-free pose that is known besides, as of the neighbouring
            frame; without a predictor the way to Z* may begin there

        Returns
        -------
        result : ResolveResult; a collision-free pose comes back unchanged, and what cannot be done
            (all domains locked, no free pose known) is said in its note

        Raises
        ------
        ShapeError : another shape, a number that is not finite or another number of weights.
        LCollisionError : an unknown locked domain, or neither a predictor nor the exact check.
        CancelledError : `cancel` was set.
        """
        chosen = options or ResolveOptions()
        if self._predictor is None and not chosen.verify:
            raise LCollisionError(
                "has no predictor, so its answer can't be left unchecked",
                "resolve with the exact check",
                where="the body",
            )
        target = self._checked(latent)
        outside = int(np.count_nonzero((target < self._low) | (target > self._high)))
        # Nobody has trained a bare rig, nor has it sliders where a client poses it.
        what, kind = ("values of the pose", "their usual range")
        if self._predictor is not None:
            what, kind = ("sliders", "the trained range")
        verb = "is" if outside == 1 else "are"
        remark = f"{outside} of {len(target)} {what} {verb} outside {kind}"
        known = self._free_latents
        if before is not None and self._predictor is None:
            known = np.concatenate([self._checked(before)[None], known])
        standing = None
        if chosen.standing is not None:
            standing = Standing.of(self.check, target, np.array(chosen.standing))
            if not self._space.limbs.is_relative:
                # Nothing else keeps them there.
                still = chosen.still_domains | standing.domains(self.check)
                chosen = replace(chosen, still_domains=still)
        ladder = Ladder(
            self.problem(target, chosen, cancel),
            replace(self.check.with_clearance(chosen.clearance), placement=placement),
            chosen,
            known,
            None if near is None else self._checked(near),
            progress,
            remark if outside else None,
            standing,
        )
        with single_torch_thread():
            return ladder.climb() if chosen.verify else ladder.solve_only()

    def resolve_many(
        self,
        latents: npt.ArrayLike,
        options: ResolveOptions | None = None,
        workers: int | None = None,
        progress: Progress = no_progress,
        cancel: CancelToken | None = None,
        *,
        placements: Sequence[RigidTransform | None] | None = None,
        sequence: bool = False,
        done: Mapping[int, ResolveResult] | None = None,
        keep: Callable[[int, ResolveResult], None] | None = None,
    ) -> list[ResolveResult]:
        """Resolve (B, D) poses on several threads.

        Parameters
        ----------
        latents : (B, D) finite array
        options : the defaults if None
        workers : threads, one for each available core by default; results do not depend on it
        progress : called with (poses done, B), from one thread at a time
        cancel : polled at every evaluation, and before each frame of a sequence is checked
        placements : where each pose is exported to
        sequence : the poses are the frames of a motion: a frame starts from the correction of the
            one before, so that the motion does not flicker. Frames that collide in a row are one
            thread's work.
        done : results of an earlier run by index, which are not computed again
        keep : called with each further result and its index as soon as it is there, from one
            thread at a time: what was done is known whatever interrupts the rest

        Returns
        -------
        results : B of them, in the order of `latents`

        Raises
        ------
        ShapeError, LCollisionError, CancelledError : as of `resolve`.
        """
        rows = [self._checked(row) for row in np.atleast_2d(np.asarray(latents, np.float64))]
        placed = [None] * len(rows) if placements is None else placements
        # Built once, before several threads would each begin to.
        _ = self._space.metric, self._space.decode(np.zeros((1, len(self._low))))
        known = done or {}
        results: dict[int, ResolveResult] = {}
        guard = Lock()

        def solve(run: range) -> None:
            near = before = None
            for index in run:
                result = known.get(index) or self.resolve(
                    rows[index], options, no_progress, cancel, placed[index], near, before
                )
                if sequence:
                    near = result.latent - rows[index]
                    before = result.latent if result.exactly_free else None
                with guard:
                    results[index] = result
                    if keep is not None and index not in known:
                        keep(index, result)
                    progress(len(results), len(rows))

        pool = ThreadPoolExecutor(workers or available_cores(), thread_name_prefix="resolve")
        try:
            if sequence:
                check = self.check.with_clearance((options or ResolveOptions()).clearance)
                colliding = list(
                    pool.map(_is_colliding, repeat(check), rows, placed, repeat(cancel))
                )
                starts = [at for at in range(len(rows)) if at == 0 or not colliding[at]]
            else:
                starts = list(range(len(rows)))
            runs = [range(*pair) for pair in pairwise([*starts, len(rows)])]
            for solved in [pool.submit(solve, run) for run in runs]:
                solved.result()
        finally:
            pool.shutdown(cancel_futures=True)
        return [results[index] for index in range(len(rows))]

    def _checked(self, latent: npt.ArrayLike) -> FloatArray:
        target: FloatArray = np.array(latent, dtype=np.float64)
        size = len(self._low)
        if target.shape != (size,):
            raise ShapeError.must_be("a latent pose", f"{size} numbers", f"shape {target.shape}")
        if not np.isfinite(target).all():
            raise ShapeError("a latent pose has a number that is not finite", "repair the pose")
        return target

    def problem(
        self, target: FloatArray, options: ResolveOptions, cancel: CancelToken | None = None
    ) -> ResolveProblem:
        """Return the problem of one pose: what a distance is, and where its codes may lie.

        Parameters
        ----------
        target : (D,) finite float64 array Z*
        options, cancel : as of `resolve`

        Raises
        ------
        ShapeError, LCollisionError : as of `resolve`.
        """
        is_displacement = options.metric == Metric.DISPLACEMENT
        metric = self._space.metric if is_displacement else np.eye(len(target))
        if options.still_domains:
            weights = np.zeros(self._space.n_domains)
            weights[sorted(options.still_domains)] = STILL_WEIGHT
            metric = metric + self._space.domain_metrics.weighted(weights)
        sizes = self._space.group_sizes
        group_weights = options.group_weights or (1.0,) * len(sizes)
        if len(group_weights) != len(sizes):
            raise ShapeError.must_be("group weights", f"{len(sizes)} numbers", len(group_weights))
        code_weights = np.repeat(group_weights, sizes)
        root = np.sqrt(code_weights)
        low, high = np.minimum(self._low, target), np.maximum(self._high, target)
        for domain in sorted(options.locked_domains):
            if not 0 <= domain < self._space.n_domains:
                raise LCollisionError(
                    f"unknown domain {domain + 1} to lock",
                    f"the model has {self._space.n_domains}",
                )
        locked = self._space.codes_of(options.locked_domains)
        locked[sorted(options.locked_codes)] = True
        low[locked] = high[locked] = target[locked]
        return ResolveProblem(
            target,
            metric * np.outer(root, root),
            code_weights,
            low,
            high,
            options.threshold_logit,
            self._predictor,
            Deadline(options.time_budget, cancel),
        )


def _is_colliding(
    check: ExactCheck,
    latent: FloatArray,
    placement: RigidTransform | None,
    cancel: CancelToken | None,
) -> bool:
    if cancel is not None:
        cancel.raise_if_cancelled()
    return not replace(check, placement=placement).is_free(latent)
