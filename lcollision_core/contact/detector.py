"""Exact self-collision of poses that share one topology."""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from lcollision_core.contact.arrays import FaceTree, Found, NearVertices, PoseWork
from lcollision_core.contact.kernels import (
    LEAF_SIZE,
    MAX_REACH,
    add_vertex_energy,
    search_pose,
)
from lcollision_core.contact.near import near_vertices
from lcollision_core.contact.tree import allocate_work, build_tree
from lcollision_core.errors import ShapeError
from lcollision_core.jobs import CancelToken, Progress, available_cores, no_progress
from lcollision_core.meshes.topology import Topology

IntArray = npt.NDArray[np.int32]
FloatArray = npt.NDArray[np.float64]

DEPTH_TOLERANCE = 1e-9
"""Depth in heights up to which two faces touch; beyond it they collide."""

MAX_HEIGHT = 1e150
"""The reference's height in its unit is at most this and at least its inverse: squared lengths
then neither overflow nor vanish, either of which would call a colliding pose free."""

_FIRST_ROOM = 256
"""Pairs that a thread has room for at first; it grows to what a pose needs and stays there."""

_POSES_A_TASK = 8
"""The most poses that a thread takes at a time: a prompt cancel, and little waiting at the end."""

_TASKS_A_THREAD = 4
"""What small batches are cut into at least, or a few threads would do the work of all."""


@dataclass(frozen=True, slots=True)
class SelfCollisions:
    """All colliding pairs of one pose. Lengths are in heights.

    Attributes
    ----------
    pairs : (P, 2) int32, face indices, the smaller first, rows in ascending order
    penetration_depth : (P,) float64, PD of each pair, > 1e-9
    near_pairs, near_penetration_depth : (Q, 2) and (Q,), the same of the pairs within the near
        exclusion: folds of the skin, which count neither for the verdict nor for the energy
    vertex_energy : (V,) float64, PDe of Algorithm 1 in squared heights
    """

    pairs: IntArray
    penetration_depth: FloatArray
    near_pairs: IntArray
    near_penetration_depth: FloatArray
    vertex_energy: FloatArray

    @property
    def colliding(self) -> bool:
        """Whether the pose intersects itself."""
        return len(self.pairs) > 0

    @property
    def energy(self) -> float:
        """PDe-sum, the penetration energy of the pose, in squared heights."""
        return float(self.vertex_energy.sum())


@dataclass(frozen=True, slots=True)
class BatchCollisions:
    """What `CollisionDetector.detect_batch` finds in B poses.

    Attributes
    ----------
    n_pairs : (B,) int64, colliding pairs
    n_near_pairs : (B,) int64, pairs within the near exclusion
    vertex_energy : (B, V) float64, PDe of Algorithm 1 in squared heights
    """

    n_pairs: npt.NDArray[np.int64]
    n_near_pairs: npt.NDArray[np.int64]
    vertex_energy: FloatArray

    @property
    def colliding(self) -> npt.NDArray[np.bool_]:
        """(B,) whether each pose intersects itself."""
        return self.n_pairs > 0


class CollisionDetector:
    """Finds where poses of one topology intersect themselves, exactly.

    Two faces collide when they share no vertex and their penetration depth exceeds
    `DEPTH_TOLERANCE`. A detector may be used by several threads at once.

    Parameters
    ----------
    topology : of all poses
    reference : (V, 3) array, a typical pose: the tree is built on it, and its height, the
        longest side of its bounding box, is the unit of every result
    near_exclusion : pairs with an edge path of at most this length between them on the
        reference, in heights, are counted apart; 0 excludes nothing

    Raises
    ------
    ShapeError : `reference` is not a finite (V, 3) array with an extent between 1 / `MAX_HEIGHT`
        and `MAX_HEIGHT`, or `near_exclusion` is negative, or relates too many vertices.
    """

    def __init__(
        self, topology: Topology, reference: npt.ArrayLike, *, near_exclusion: float = 0.0
    ) -> None:
        vertices = np.asarray(reference, dtype=np.float64)
        if vertices.shape != (topology.n_vertices, 3):
            raise ShapeError(
                f"the reference must have shape ({topology.n_vertices}, 3), got {vertices.shape}"
            )
        if not np.isfinite(vertices).all():
            vertex = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
            raise ShapeError(f"vertex {vertex} of the reference is not finite")
        if not near_exclusion >= 0.0:
            raise ShapeError(f"the near exclusion must be 0 or more heights, got {near_exclusion}")
        self.topology = topology
        self.near_exclusion = float(near_exclusion)
        # Halves, as the whole may be beyond the largest number.
        self.height = 2.0 * float(np.ptp(0.5 * vertices, axis=0).max())
        if self.height == 0.0:
            raise ShapeError("all vertices are in one point; give it a mesh with an extent")
        if not 1.0 / MAX_HEIGHT <= self.height <= MAX_HEIGHT:
            raise ShapeError(
                f"the mesh is {self.height:.1e} high, {1.0 / MAX_HEIGHT:.0e} to {MAX_HEIGHT:.0e} "
                f"is needed; scale it"
            )
        self._tree: FaceTree = build_tree(vertices, topology.faces)
        self._near: NearVertices = near_vertices(
            topology, vertices, self.near_exclusion * self.height
        )
        self._idle: queue.LifoQueue[_Searcher] = queue.LifoQueue()

    def detect(self, vertices: npt.ArrayLike) -> SelfCollisions:
        """Find all colliding pairs of one pose.

        Parameters
        ----------
        vertices : (V, 3) array in the unit of the reference

        Raises
        ------
        ShapeError : another shape, or a vertex that is not finite or absurdly far away.
        """
        pose = self._checked(vertices, (self.topology.n_vertices, 3))
        with self._searcher() as searcher:
            n_found = searcher.search(pose, first_only=False)
            found = searcher.found
            vertex_energy = np.zeros(self.topology.n_vertices)
            add_vertex_energy(self._tree, found, n_found, vertex_energy)
            pairs = np.sort(self._tree.slot_face[found.slots[:n_found]], axis=1)
            depth = np.sqrt(found.squared_depth[:n_found])
            is_near = found.is_near[:n_found].copy()
        order = np.lexsort((pairs[:, 1], pairs[:, 0]))
        pairs, depth, is_near = pairs[order], depth[order], is_near[order]
        return SelfCollisions(
            pairs=pairs[~is_near],
            penetration_depth=depth[~is_near],
            near_pairs=pairs[is_near],
            near_penetration_depth=depth[is_near],
            vertex_energy=vertex_energy,
        )

    def detect_batch(
        self,
        vertices: npt.ArrayLike,
        *,
        workers: int | None = None,
        progress: Progress = no_progress,
        cancel: CancelToken | None = None,
    ) -> BatchCollisions:
        """Find the energies and the number of colliding pairs of many poses.

        Parameters
        ----------
        vertices : (B, V, 3) array in the unit of the reference
        workers : threads, default one per available core; the result does not depend on it
        progress, cancel : called and asked every few poses

        Raises
        ------
        ShapeError : another shape, or a vertex that is not finite or absurdly far away.
        CancelledError : `cancel` was set.
        """
        poses = self._checked(vertices, (-1, self.topology.n_vertices, 3))
        n_pairs = np.zeros(len(poses), dtype=np.int64)
        n_near_pairs = np.zeros(len(poses), dtype=np.int64)
        vertex_energy = np.zeros(poses.shape[:2])

        def search(searcher: _Searcher, pose: int) -> None:
            n_found = searcher.search(poses[pose], first_only=False, number=pose)
            add_vertex_energy(self._tree, searcher.found, n_found, vertex_energy[pose])
            n_near_pairs[pose] = np.count_nonzero(searcher.found.is_near[:n_found])
            n_pairs[pose] = n_found - n_near_pairs[pose]

        self._for_each(len(poses), search, workers, progress, cancel)
        return BatchCollisions(n_pairs, n_near_pairs, vertex_energy)

    def are_colliding(
        self,
        vertices: npt.ArrayLike,
        *,
        workers: int | None = None,
        progress: Progress = no_progress,
        cancel: CancelToken | None = None,
    ) -> npt.NDArray[np.bool_]:
        """Tell which poses intersect themselves, stopping at the first pair of each.

        Parameters and errors are those of `detect_batch`; returns a (B,) bool array.
        """
        poses = self._checked(vertices, (-1, self.topology.n_vertices, 3))
        colliding = np.zeros(len(poses), dtype=np.bool_)

        def search(searcher: _Searcher, pose: int) -> None:
            n_found = searcher.search(poses[pose], first_only=True, number=pose)
            # The search ends at a pair that counts, so the last one found tells.
            colliding[pose] = n_found > 0 and not searcher.found.is_near[n_found - 1]

        self._for_each(len(poses), search, workers, progress, cancel)
        return colliding

    def _checked(self, vertices: npt.ArrayLike, shape: tuple[int, ...]) -> npt.NDArray[np.floating]:
        """Refuse another shape, in which -1 stands for any number of poses."""
        array = np.asarray(vertices)
        if array.ndim != len(shape) or array.shape[-2:] != shape[-2:]:
            wanted = ", ".join("B" if size < 0 else str(size) for size in shape)
            raise ShapeError(f"vertices must have shape ({wanted}), got {array.shape}")
        return array if array.dtype.kind == "f" else array.astype(np.float64)

    def _for_each(
        self,
        n_poses: int,
        search: Callable[[_Searcher, int], None],
        workers: int | None,
        progress: Progress,
        cancel: CancelToken | None,
    ) -> None:
        n_threads = available_cores() if workers is None else workers
        size = max(1, min(_POSES_A_TASK, n_poses // (_TASKS_A_THREAD * max(1, n_threads))))
        starts = range(0, n_poses, size)

        def work(start: int) -> int:
            if cancel is not None:
                cancel.raise_if_cancelled()
            stop = min(start + size, n_poses)
            with self._searcher() as searcher:
                for pose in range(start, stop):
                    search(searcher, pose)
            return stop

        if min(n_threads, len(starts)) <= 1:
            # Starting a thread takes a third of the time that a pose of 2000 vertices does.
            for stop in map(work, starts):
                progress(stop, n_poses)
            return
        pool = ThreadPoolExecutor(n_threads, thread_name_prefix="contact")
        try:
            for stop in pool.map(work, starts):
                progress(stop, n_poses)
        finally:
            pool.shutdown(cancel_futures=True)

    @contextmanager
    def _searcher(self) -> Iterator[_Searcher]:
        """Lend the work arrays of one thread, kept from search to search."""
        try:
            searcher = self._idle.get_nowait()
        except queue.Empty:
            searcher = _Searcher(self._tree, self._near, self.topology, self.height)
        try:
            yield searcher
        finally:
            self._idle.put(searcher)


class _Searcher:
    """One thread's work arrays and the search with them."""

    def __init__(
        self, tree: FaceTree, near: NearVertices, topology: Topology, height: float
    ) -> None:
        self._tree = tree
        self._near = near
        self._inverse_height = 1.0 / height
        self._work: PoseWork = allocate_work(tree)
        self._pose = np.empty((topology.n_vertices, 3))
        self.found = _room_for(_FIRST_ROOM)

    def search(
        self, pose: npt.NDArray[np.floating], *, first_only: bool, number: int | None = None
    ) -> int:
        """Fill `found` with the pairs of one pose (V, 3) and return how many there are.

        `number` is the pose's place in its batch, for the error message.
        """
        np.copyto(self._pose, pose)
        while True:
            n_found: int = search_pose(
                self._pose,
                self._inverse_height,
                DEPTH_TOLERANCE,
                self._tree,
                self._near,
                self._work,
                first_only,
                self.found,
                LEAF_SIZE,
            )
            if n_found < 0:
                self._refuse(number)
            if n_found <= len(self.found.slots):
                return n_found
            self.found = _room_for(2 * n_found)

    def _refuse(self, number: int | None) -> NoReturn:
        within = np.abs(self._pose) * self._inverse_height <= MAX_REACH  # False for NaN
        vertex = int(np.flatnonzero(~within.all(axis=1))[0])
        where = "" if number is None else f" of pose {number}"
        position = self._pose[vertex].tolist()
        what = (
            f"is more than {MAX_REACH:.0e} heights away from the origin"
            if np.isfinite(position).all()
            else "is not finite"
        )
        raise ShapeError(f"vertex {vertex}{where} {what}, at {position}; move or mend the mesh")


def _room_for(n_pairs: int) -> Found:
    return Found(
        slots=np.empty((n_pairs, 2), dtype=np.int32),
        squared_depth=np.empty(n_pairs),
        is_near=np.empty(n_pairs, dtype=np.bool_),
    )
