"""Labelling on the threads of this process.

Threads and not processes: decoding and the exact check run outside the interpreter's lock, they
share one model and start at once. SCAPE at 2161 vertices, two cores: one thread 678 rows/s, two
threads 1237, two processes 1269. A row holds the lock for less than 0.06 of its 1.5 ms, so that
some 25 threads would fill it; beyond that a Dask cluster on the same machine goes on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from lcollision_core.jobs import CancelToken
from lcollision_core.labels.box import ROWS_A_BLOCK
from lcollision_core.labels.labeller import Labeller, LabelRows
from lcollision_core.labels.layout import ROWS_A_CHUNK

CountRows = Callable[[int, int], None]
"""Called with (rows labelled, of these colliding) since the last call."""


@dataclass(frozen=True)
class ChunkTask:
    """A chunk to label: its first `n_rows` rows."""

    chunk: int
    n_rows: int

    @property
    def blocks(self) -> range:
        """The blocks of samples that it consists of."""
        first = self.chunk * (ROWS_A_CHUNK // ROWS_A_BLOCK)
        return range(first, first + -(-self.n_rows // ROWS_A_BLOCK))


def label_chunk(labeller: Labeller, seed: int, task: ChunkTask) -> LabelRows:
    """Label one chunk on the calling thread."""
    return _assemble([labeller.label_block(seed, block) for block in task.blocks], task)


def label_locally(
    labeller: Labeller,
    seed: int,
    tasks: Sequence[ChunkTask],
    n_threads: int,
    count: CountRows,
    cancel: CancelToken,
) -> Generator[tuple[ChunkTask, LabelRows], None, None]:
    """Label chunks one after the other, their blocks spread over threads.

    One block a thread is begun beyond the chunk in work: so no thread idles while a chunk is
    written, and a kill costs little more than that chunk.

    Parameters
    ----------
    labeller : of the model
    seed : of the samples
    tasks : what to label
    n_threads : >= 1
    count : called after each block
    cancel : polled after each block

    Yields
    ------
    each task with its rows, in the order of `tasks`

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    labeller.prepare()
    waiting: deque[Future[LabelRows]] = deque()
    blocks = (block for task in tasks for block in task.blocks)
    pool = ThreadPoolExecutor(n_threads, thread_name_prefix="labels")
    try:
        for task in tasks:
            parts: list[LabelRows] = []
            for _ in task.blocks:
                while len(parts) + len(waiting) < len(task.blocks) + n_threads:
                    block = next(blocks, None)
                    if block is None:
                        break
                    waiting.append(pool.submit(labeller.label_block, seed, block))
                cancel.raise_if_cancelled()
                done = waiting.popleft().result()
                parts.append(done.head(task.n_rows - len(parts) * ROWS_A_BLOCK))
                count(len(parts[-1]), int(np.count_nonzero(parts[-1].colliding)))
            yield task, _assemble(parts, task)
    finally:
        pool.shutdown(cancel_futures=True)


def _assemble(parts: Sequence[LabelRows], task: ChunkTask) -> LabelRows:
    return LabelRows.joined(parts).head(task.n_rows)
