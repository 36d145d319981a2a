"""The separate process that learns a model: ``python -m app.work.learner WORK_FOLDER``.

It continues when the window that started it closes, and runs at low priority. It first deletes the
file `WANTED` of the work folder, and exits at once if that is missing. It stops on a signal, or
when a file `STOP` appears in the work folder, which any later window can write.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lcollision_core.learning_state import RunState

if TYPE_CHECKING:
    from lcollision_core.jobs import Job
    from lcollision_core.tasks.work_folder import WorkFolder

WANTED = "wanted"
"""File in a work folder that asks for its run to start as soon as no other runs."""

STOP = "stop"
"""File in a work folder that asks for its run to stop; the text `DISCARD` also discards the run."""

DISCARD = "discard"

_NICENESS = 10
_BELOW_NORMAL_PRIORITY_CLASS = 0x4000
_SECONDS_BETWEEN_LOOKS = 0.25
_BUG = "the program has failed ({0}: {1}); continue, or see the log file in {2}"
_NO_MEMORY = "out of memory; close other programs and continue, or use a lighter mesh"
_FULL = "{0}; free some space on the disk of {1}, then continue"
_UNUSABLE = "{0}; check the files and the folder {1}, then continue"
_FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT)


def main(arguments: list[str]) -> int:
    """Learn the model that a work folder requests, or resume learning it.

    Parameters
    ----------
    arguments : the path of the work folder

    Returns
    -------
    status : 0 done, 2 an error that the user can fix, 3 a bug, 130 stopped
    """
    from lcollision_core.errors import CancelledError, LCollisionError
    from lcollision_core.jobs import Job, limit_library_threads

    limit_library_threads()
    _give_way()

    from lcollision_core.tasks.learning import learn_model
    from lcollision_core.tasks.work_folder import WorkFolder

    work, job = WorkFolder.at(Path(arguments[0])), Job()
    start = _Start(work, job)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: job.cancel())
    try:
        with cancel_on_stop_file(work, job):
            learn_model(work, job.part(lambda _: start.claim()))
    except CancelledError:
        return 130
    except LCollisionError as error:
        traceback.print_exc()
        _tell_failure(work, str(error))
        return 2
    except MemoryError:
        traceback.print_exc()
        _tell_failure(work, _NO_MEMORY)
        return 2
    except OSError as error:
        traceback.print_exc()
        advice = _FULL if error.errno in _FULL_ERRORS else _UNUSABLE
        _tell_failure(work, advice.format(error.strerror or error, work.path.parent))
        return 2
    except Exception as error:
        traceback.print_exc()
        _tell_failure(work, _BUG.format(type(error).__name__, error, work.path))
        return 3
    finally:
        start.withdraw()
    return 0


@contextmanager
def cancel_on_stop_file(work: WorkFolder, job: Job) -> Iterator[None]:
    """Cancel `job` once a window requests a stop, and remove the request afterwards.

    Parameters
    ----------
    work : the work folder in use inside the block
    job : of the work inside the block
    """
    ended = threading.Event()
    looking = threading.Thread(target=_watch_stop_file, args=(work, job, ended), daemon=True)
    looking.start()
    try:
        yield
    finally:
        ended.set()
        looking.join()
        _clean_up(work)


def _give_way() -> None:
    """Lower the priority of this process."""
    if sys.platform == "win32":
        import ctypes

        kernel = ctypes.windll.kernel32
        kernel.SetPriorityClass(kernel.GetCurrentProcess(), _BELOW_NORMAL_PRIORITY_CLASS)
    else:
        os.nice(_NICENESS)
        # For Linux kernels that schedule by session: this process has its own.
        with suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(_NICENESS), encoding="ascii")


def _watch_stop_file(work: WorkFolder, job: Job, ended: threading.Event) -> None:
    """Cancel the job once a window requests a stop."""
    while not ended.wait(_SECONDS_BETWEEN_LOOKS):
        if (work.path / STOP).exists():
            job.cancel()


class _Start:
    """The file `WANTED`, deleted by the process that holds the work folder.

    A window that stops a run deletes it first. Whichever side finds it missing knows of the other:
    the process ends, or the window sees that the folder is held and writes `STOP`.
    """

    def __init__(self, work: WorkFolder, job: Job) -> None:
        self._work, self._job, self._is_taken = work, job, False

    def claim(self) -> None:
        """Delete the file at the first call, made by the holder; if it is missing, stop the run."""
        if self._is_taken:
            return
        self._is_taken = True
        try:
            (self._work.path / WANTED).unlink()
        except FileNotFoundError:
            self._job.cancel()

    def withdraw(self) -> None:
        """Delete the request of a run that ended before it began."""
        if not self._is_taken and not self._work.is_locked:
            with suppress(OSError):
                (self._work.path / WANTED).unlink(missing_ok=True)


def _tell_failure(work: WorkFolder, sentence: str) -> None:
    """Store why the run failed, unless another process holds it or the disk is full.

    What the run itself has stored is not written again: a window may have discarded it since.
    """
    from lcollision_core.errors import MeshFileError

    status = work.status
    if not work.is_locked and (status.state, status.sentence) != (RunState.FAILED, sentence):
        with suppress(MeshFileError):
            failed = replace(status, state=RunState.FAILED, sentence=sentence)
            work.write_status(replace(failed, seconds_left=None))


def _clean_up(work: WorkFolder) -> None:
    """Delete the stop request, and the whole work folder if the request discards it."""
    if work.is_locked:
        # The request is for the other process.
        return
    with suppress(OSError):
        if (work.path / STOP).read_text(encoding="utf-8") == DISCARD:
            work.remove()
            return
    with suppress(OSError):
        (work.path / STOP).unlink(missing_ok=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
