"""Labelling on the threads of this process.

Threads and not processes: decoding and the exact check run outside the interpreter's lock, they
share one model and start at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from lcollision_core.jobs import CancelToken
from lcollision_core.labels.labeller import Labeller, LabelRows, blocks_of

CountRows = Callable[[LabelRows], None]
"""Called with the rows that were labelled since the last call."""

_BLOCKS_AHEAD = 2
"""Blocks submitted for each thread, so that none idles while a chunk is written."""


def label_locally(
    labeller: Labeller,
    seed: int,
    chunks: Sequence[range],
    n_threads: int,
    count: CountRows,
    cancel: CancelToken,
) -> Generator[tuple[range, LabelRows], None, None]:
    """Label chunks one after the other, their blocks spread over threads.

    Parameters
    ----------
    labeller : of the model
    seed : of the samples
    chunks : the rows to label
    n_threads : >= 1
    count : called after each block
    cancel : polled after each block

    Yields
    ------
    each of `chunks` with its labels, in their order

    Raises
    ------
    CancelledError : `cancel` was set.
    """
    labeller.prepare()
    blocks = (rows for chunk in chunks for rows in blocks_of(chunk))
    pending: deque[Future[LabelRows]] = deque()
    pool = ThreadPoolExecutor(n_threads, thread_name_prefix="labels")
    try:
        for chunk in chunks:
            parts: list[LabelRows] = []
            for _ in blocks_of(chunk):
                while len(pending) < _BLOCKS_AHEAD * n_threads and (rows := next(blocks, None)):
                    pending.append(pool.submit(labeller.label_rows, seed, rows))
                cancel.raise_if_cancelled()
                parts.append(pending.popleft().result())
                count(parts[-1])
            yield chunk, LabelRows.joined(parts)
    finally:
        pool.shutdown(cancel_futures=True)
