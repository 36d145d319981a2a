"""Search batches of poses on a GPU for colliding pairs of faces: the counterpart of `search`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.contact.arrays import Exclusions, FaceTree, IntArray, SkippableNodes
from lcollision_core.contact.gpu_kernels import (
    GpuWork,
    find_candidates,
    measure_candidates,
    place_poses,
    take_sums,
)
from lcollision_core.contact.kernels import COINCIDENT, N_KINDS
from lcollision_core.contact.search import (
    DEPTH_TOLERANCE,
    NO_CELLS,
    NO_ENERGY,
    NO_TABLES,
    Cells,
    node_depths,
)
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.topology import FloatArray, Topology
from lcollision_core.on_gpu import (
    GPU_LOCK,
    THREADS,
    Buffers,
    DeviceArray,
    blocks_for,
    copied,
    cuda,
)

MOST_BYTES = 1 << 29
"""Bound on the arrays of the poses searched at once, and separately on their candidates."""

MOST_POSES = 4096
"""Most poses searched at once; a grid has at most 65 535 blocks along its second axis."""

_BYTES_OF_CANDIDATE = 8

_CANDIDATES_OF_THREAD = 8
"""Candidates that a thread measures, roughly, if a pose fills its capacity."""


class ListedPairs(NamedTuple):
    """Pairs of B poses that penetrate, ordered by pose and faces.

    Attributes
    ----------
    pose : (P,) int64
    pairs : (P, 2) int32, face indices, the smaller first
    squared_depth : (P,) float64, in normalised length squared
    rule : (P,) uint8, as in `PairBuffer`
    """

    pose: npt.NDArray[np.int64]
    pairs: IntArray
    squared_depth: FloatArray
    rule: npt.NDArray[np.uint8]


class GpuCounts(NamedTuple):
    """The results of a search of n poses, valid on the GPU until the next search.

    Attributes
    ----------
    n_by_rule : (n, `N_KINDS`) int32, numbers of pairs by rule
    vertex_energy : (n, V) float64, or (0, V); cell_energy : (n, C) float64, or (0, 0)
    left : indices of poses left to the CPU, whose rows are 0: they have vertices that are refused,
        or more candidates than `MOST_BYTES` hold
    """

    n_by_rule: DeviceArray
    vertex_energy: DeviceArray
    cell_energy: DeviceArray
    left: list[int]


class GpuSearch:
    """The search of one detector, without a clearance.

    Parameters
    ----------
    tree, exclusions, topology, body_size : as for `Searcher`

    Attributes
    ----------
    candidate_capacity : candidates listed for a pose at first; poses with more are searched
        again
    """

    def __init__(
        self, tree: FaceTree, exclusions: Exclusions, topology: Topology, body_size: float
    ) -> None:
        self._body_size, self._slot_face = body_size, tree.slot_face
        self._n_vertices, self._n_nodes = topology.n_vertices, len(tree.left)
        source = np.arange(topology.n_vertices, dtype=np.int32)
        source[topology.unused_vertices] = topology.faces[0, 0]
        inner = np.flatnonzero(tree.left >= 0)
        depth, last_leaf = node_depths(tree), tree.leaf.copy()
        for node in inner[::-1]:
            last_leaf[node] = last_leaf[tree.right[node]]
        by_level = np.argsort(depth, kind="stable").astype(np.int32)
        level_start = np.cumsum([0, *np.bincount(depth)]).astype(np.int32)
        node_of_leaf = np.argsort(np.where(tree.leaf < 0, len(depth), tree.leaf)).astype(np.int32)
        self._source, self._level_start, self._by_level, self._last_leaf, self._node_of_leaf = map(
            cuda.to_device, (source, level_start, by_level, last_leaf, node_of_leaf)
        )
        self._tree, self._exclusions = copied(tree), copied(exclusions)
        self._uncounted = NO_TABLES, copied(NO_TABLES)
        self._buffers = Buffers()
        self.candidate_capacity = max(1024, 2 * len(topology.faces))

    @property
    def at_once(self) -> int:
        """The number of poses that can be searched at once."""
        bytes_of_pose = 84 * self._n_vertices + 24 * (len(self._slot_face) + self._n_nodes)
        most = MOST_BYTES // max(bytes_of_pose, _BYTES_OF_CANDIDATE * self.candidate_capacity)
        return max(1, min(MOST_POSES, most))

    def count(
        self,
        poses: npt.NDArray[np.floating],
        n_by_rule: npt.NDArray[np.int64],
        *,
        vertex_energy: FloatArray = NO_ENERGY,
        cell_energy: FloatArray = NO_ENERGY,
        cells: Cells | None = None,
        first_only: bool = False,
        unit: float = 1.0,
        uncounted: SkippableNodes = NO_TABLES,
        job: Job = UNWATCHED,
    ) -> list[int]:
        """Count the pairs of (B, V, 3) poses by rule and sum their energy, as `Searcher.count`.

        Returns
        -------
        left : indices of poses left to the CPU, as in `GpuCounts`
        """
        left: list[int] = []
        start = 0
        while start < len(poses):
            job.check()
            part = slice(start, start + self.at_once)
            with GPU_LOCK:
                collisions = self.search(
                    poses[part],
                    with_energy=len(vertex_energy) > 0,
                    cells=cells,
                    n_cells=cell_energy.shape[1],
                    first_only=first_only,
                    unit=unit,
                    uncounted=uncounted,
                )
                n_by_rule[part] += collisions.n_by_rule.copy_to_host()
                if len(vertex_energy):
                    vertex_energy[part] += collisions.vertex_energy.copy_to_host()
                if len(cell_energy):
                    cell_energy[part] += collisions.cell_energy.copy_to_host()
            left += [start + number for number in collisions.left]
            start = min(part.stop, len(poses))
            job.report(start, len(poses))
        return left

    def list_pairs(self, poses: npt.NDArray[np.floating]) -> ListedPairs:
        """List the pairs of (B, V, 3) poses that penetrate; poses left to the CPU have none."""
        parts: list[ListedPairs] = []
        for start in range(0, len(poses), self.at_once):
            parts_here: list[ListedPairs] = []
            self.search(poses[start : start + self.at_once], listed=parts_here)
            parts += [part._replace(pose=part.pose + start) for part in parts_here]
        pose, pairs, squared_depth, rule = map(np.concatenate, zip(*parts, strict=True))
        order = np.lexsort((pairs[:, 1], pairs[:, 0], pose))
        return ListedPairs(pose[order], pairs[order], squared_depth[order], rule[order])

    def search(
        self,
        poses: npt.NDArray[np.floating] | DeviceArray,
        *,
        with_energy: bool = False,
        cells: Cells | None = None,
        n_cells: int = 0,
        first_only: bool = False,
        unit: float = 1.0,
        uncounted: SkippableNodes = NO_TABLES,
        listed: list[ListedPairs] | None = None,
    ) -> GpuCounts:
        """Search (n, V, 3) poses, at most `at_once`, which may be on the GPU; see `count`.

        Pairs are appended to `listed`, in any order.
        """
        n_poses = len(poses)
        with GPU_LOCK:
            if isinstance(poses, np.ndarray):
                dtype = np.float32 if poses.dtype == np.float32 else np.float64
                poses = np.ascontiguousarray(poses, dtype=dtype)
            on_gpu = cuda.to_device(poses)
            shape = n_poses if with_energy else 0, self._n_vertices, 2
            n_by_rule = self._buffers.zeros("n_by_rule", (n_poses, N_KINDS), np.int32)
            vertex_sums = self._buffers.zeros("vertex sums", shape, np.int64)
            shape = n_poses if n_cells else 0, n_cells, 2
            cell_sums = self._buffers.zeros("cell sums", shape, np.int64)
            folds = self._exclusions if cells is None else copied(cells.folds)
            of_vertices = cuda.to_device(NO_CELLS if cells is None else cells.of_vertices)
            judging = folds, of_vertices, DEPTH_TOLERANCE, first_only
            sums = n_by_rule, vertex_sums, cell_sums
            left: list[int] = []
            waiting = [(np.arange(n_poses, dtype=np.int32), self.candidate_capacity)]
            while waiting:
                numbers, capacity = waiting.pop()
                n_found = self._search_some(
                    on_gpu,
                    numbers,
                    capacity,
                    unit / self._body_size,
                    uncounted,
                    judging,
                    sums,
                    listed,
                )
                too_many = n_found > MOST_BYTES // _BYTES_OF_CANDIDATE
                left += numbers[(n_found < 0) | too_many].tolist()
                again = (n_found > capacity) & ~too_many
                if again.any():
                    numbers, capacity = numbers[again], int(n_found[again].max())
                    step = MOST_BYTES // (_BYTES_OF_CANDIDATE * capacity)
                    pieces = range(0, len(numbers), step)
                    waiting += [(numbers[start : start + step], capacity) for start in pieces]
                    # At most a twentieth of such poses are then searched twice.
                    self.candidate_capacity = max(
                        self.candidate_capacity, int(np.quantile(n_found, 0.95))
                    )
            energies = (
                self._in_numbers("vertex energy", vertex_sums),
                self._in_numbers("cell energy", cell_sums),
            )
            return GpuCounts(n_by_rule, *energies, left)

    def _search_some(
        self,
        poses: DeviceArray,
        numbers: npt.NDArray[np.int32],
        capacity: int,
        scale: float,
        uncounted: SkippableNodes,
        judging: tuple[Exclusions, DeviceArray, float, bool],
        sums: tuple[DeviceArray, DeviceArray, DeviceArray],
        listed: list[ListedPairs] | None,
    ) -> npt.NDArray[np.int32]:
        """Search poses by index; return the number of candidates of each, -1 if it is refused."""
        n_poses, n_slots = len(numbers), len(self._slot_face)
        if self._uncounted[0] is not uncounted:
            self._uncounted = uncounted, copied(uncounted)
        work, rows = self._workspace(n_poses), cuda.to_device(numbers)
        n_candidates = self._buffers.zeros("n_candidates", (n_poses,), np.int32)
        candidates = self._buffers.take("candidates", (n_poses, capacity, 2), np.int32)
        place_poses[n_poses, THREADS](
            poses,
            rows,
            self._source,
            scale,
            self._tree,
            self._level_start,
            self._by_level,
            work,
            n_candidates,
        )
        find_candidates[(blocks_for(n_slots), n_poses), THREADS](
            self._tree,
            self._last_leaf,
            self._node_of_leaf,
            self._uncounted[1],
            work,
            candidates,
            n_candidates,
        )
        shape = (0, 0) if listed is None else (n_poses, capacity)
        depths, rules = cuda.device_array(shape, np.float64), cuda.device_array(shape, np.uint8)
        measure_candidates[(blocks_for(capacity // _CANDIDATES_OF_THREAD), n_poses), THREADS](
            rows,
            work,
            self._tree,
            self._exclusions,
            *judging,
            candidates,
            n_candidates,
            *sums,
            depths,
            rules,
        )
        n_found: npt.NDArray[np.int32] = n_candidates.copy_to_host()
        if listed is not None:
            every, all_rules = np.arange(capacity), rules.copy_to_host()
            is_listed = (every < n_found[:, None]) & (n_found[:, None] <= capacity)
            row, at = np.nonzero(is_listed & (all_rules != COINCIDENT))
            pairs = np.sort(self._slot_face[candidates.copy_to_host()[row, at]], axis=1)
            depth = depths.copy_to_host()[row, at]
            listed.append(
                ListedPairs(numbers[row].astype(np.int64), pairs, depth, all_rules[row, at])
            )
        return n_found

    def _workspace(self, n_poses: int) -> GpuWork:
        take, n_slots = self._buffers.take, len(self._slot_face)
        return GpuWork(
            take("vertices", (n_poses, self._n_vertices, 3), np.float64),
            take("rounded", (n_poses, self._n_vertices, 3), np.float32),
            take("boxes", (n_poses, 6 * n_slots), np.float32),
            take("node boxes", (n_poses, self._n_nodes, 6), np.float32),
        )

    def _in_numbers(self, name: str, sums: DeviceArray) -> DeviceArray:
        """Convert (n, N, 2) fixed-point sums to (n, N) floats."""
        total = self._buffers.take(name, sums.shape[:2], np.float64)
        if total.size > 0:
            take_sums[(blocks_for(sums.shape[1]), len(sums)), THREADS](sums, total)
        return total
