"""Resolve: the nearest pose that is free of collisions, proved exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from itertools import pairwise, repeat
from threading import Lock

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import CollisionDetector
from lcollision_core.embedding import Embedding
from lcollision_core.errors import LCollisionError, ShapeError
from lcollision_core.jobs import CancelToken, Progress, available_cores, no_progress
from lcollision_core.meshes import RigidTransform
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.resolve.exact import ExactCheck
from lcollision_core.resolve.ladder import Ladder
from lcollision_core.resolve.metric import LatentMetric
from lcollision_core.resolve.options import Metric, ResolveOptions, ResolveResult
from lcollision_core.resolve.problem import CollisionModel, ResolveProblem, Watch
from lcollision_core.resolve.threads import single_torch_thread


class PoseResolver:
    """Moves poses of one model free of self-collisions; immutable, safe between threads.

    Parameters
    ----------
    embedding : decodes latent poses
    predictor : says how a latent pose collides, smoothly: a `CollisionPredictor`
    detector : the exact check, in the data's unit
    height : one height in the data's unit
    free_latents : (F, D) array of poses known to be exactly free: see `find_free_poses`. With
        none, a pose that the other steps do not free stays colliding.
    bounds : (low, high), two (D,) arrays: the latent box in which to look
    """

    def __init__(
        self,
        embedding: Embedding,
        predictor: CollisionModel,
        detector: CollisionDetector,
        height: float,
        free_latents: npt.ArrayLike,
        bounds: tuple[npt.ArrayLike, npt.ArrayLike],
    ) -> None:
        self._embedding = embedding
        self._predictor = predictor
        self._detector = detector
        self._height = height
        size = embedding.latent_size
        self._free_latents: FloatArray = np.array(free_latents, np.float64).reshape(-1, size)
        self._low, self._high = (np.array(bound, np.float64) for bound in bounds)

    def resolve(
        self,
        latent: npt.ArrayLike,
        options: ResolveOptions | None = None,
        progress: Progress = no_progress,
        cancel: CancelToken | None = None,
        placement: RigidTransform | None = None,
        near: npt.ArrayLike | None = None,
    ) -> ResolveResult:
        """Find the nearest pose that is exactly free.

        Parameters
        ----------
        latent : (D,) finite array Z*
        options : the defaults if None
        progress : called with (steps of the ladder done, all steps)
        cancel : polled at every evaluation
        placement : where the pose is exported to; the exact check is of the vertices there
        near : (D,) array, a correction Z - Z* to try first, as of the neighbouring frame

        Returns
        -------
        result : ResolveResult; a pose that is exactly free comes back unchanged, and what cannot
            be done (all domains locked, no free pose known) is said in its note

        Raises
        ------
        ShapeError : another shape, a number that is not finite or another number of weights.
        LCollisionError : a locked domain that there is not.
        CancelledError : `cancel` was set.
        """
        chosen = options or ResolveOptions()
        target = self._checked(latent)
        problem = self._problem(target, chosen, cancel)
        check = ExactCheck(self._embedding, self._detector, self._height, placement)
        correction = None if near is None else self._checked(near)
        outside = int(np.count_nonzero((target < self._low) | (target > self._high)))
        remark = (
            f"{outside} of {len(target)} sliders {'is' if outside == 1 else 'are'} outside the "
            f"trained range"
        )
        ladder = Ladder(
            problem,
            check,
            chosen,
            self._free_latents,
            correction,
            progress,
            remark if outside else None,
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
        done : results of an earlier run by place, which are not sought again
        keep : called with each further result and its place as soon as it is there, from one
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
        _ = self._eye, self._embedding.codec, self._embedding.decoder
        known = done or {}
        results: dict[int, ResolveResult] = {}
        guard = Lock()

        def solve(run: range) -> None:
            near = None
            for place in run:
                result = known.get(place) or self.resolve(
                    rows[place], options, no_progress, cancel, placed[place], near
                )
                near = result.latent - rows[place] if sequence else None
                with guard:
                    results[place] = result
                    if keep is not None and place not in known:
                        keep(place, result)
                    progress(len(results), len(rows))

        pool = ThreadPoolExecutor(workers or available_cores(), thread_name_prefix="resolve")
        try:
            if sequence:
                colliding = list(pool.map(self._is_colliding, rows, placed, repeat(cancel)))
                starts = [at for at in range(len(rows)) if at == 0 or not colliding[at]]
            else:
                starts = list(range(len(rows)))
            runs = [range(*pair) for pair in pairwise([*starts, len(rows)])]
            for solved in [pool.submit(solve, run) for run in runs]:
                solved.result()
        finally:
            pool.shutdown(cancel_futures=True)
        return [results[place] for place in range(len(rows))]

    def _is_colliding(
        self, latent: FloatArray, placement: RigidTransform | None, cancel: CancelToken | None
    ) -> bool:
        if cancel is not None:
            cancel.raise_if_cancelled()
        check = ExactCheck(self._embedding, self._detector, self._height, placement)
        return not check.is_free(latent)

    @cached_property
    def _eye(self) -> LatentMetric:
        return LatentMetric.eye(self._embedding)

    @cached_property
    def _plain(self) -> LatentMetric:
        return LatentMetric.latent(self._embedding.latent_size)

    @cached_property
    def _group_of_code(self) -> npt.NDArray[np.int64]:
        sizes = self._embedding.group_sizes
        return np.repeat(np.arange(len(sizes)), sizes)

    def _checked(self, latent: npt.ArrayLike) -> FloatArray:
        target: FloatArray = np.array(latent, dtype=np.float64)
        size = self._embedding.latent_size
        if target.shape != (size,):
            raise ShapeError(f"a latent pose has {size} numbers, got shape {target.shape}")
        if not np.isfinite(target).all():
            raise ShapeError("a latent pose has a number that is not finite; repair the pose")
        return target

    def _problem(
        self, target: FloatArray, options: ResolveOptions, cancel: CancelToken | None
    ) -> ResolveProblem:
        metric = self._eye if options.metric == Metric.EYE else self._plain
        code_weights = np.ones(len(target))
        if options.group_weights is not None:
            n_groups = len(self._embedding.group_sizes)
            if len(options.group_weights) != n_groups:
                raise ShapeError(
                    f"{n_groups} group weights are needed, got {len(options.group_weights)}"
                )
            code_weights = np.array(options.group_weights, np.float64)[self._group_of_code]
            metric = metric.weighted(code_weights)
        low, high = np.minimum(self._low, target), np.maximum(self._high, target)
        for domain in sorted(options.locked_domains):
            if not 0 <= domain < self._embedding.n_domains:
                raise LCollisionError(
                    f"there is no domain {domain + 1} to lock; the model has "
                    f"{self._embedding.n_domains}"
                )
            locked = self._group_of_code == domain + 1
            locked[domain] = True
            low[locked] = high[locked] = target[locked]
        watch = Watch(options.time_budget, cancel)
        return ResolveProblem(
            target,
            metric,
            code_weights,
            low,
            high,
            options.threshold_logit,
            self._predictor,
            watch,
        )
