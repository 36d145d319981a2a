"""The process of its own that learns a model: ``python -m app.work.learner WORK_FOLDER``.

It goes on when the window that started it closes, and gives way to whatever else the computer does.
A signal stops it, or the file `STOP` in the work folder, which any later window can write.
"""

from __future__ import annotations

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

if TYPE_CHECKING:
    from lcollision_core.jobs import CancelToken
    from lcollision_core.learning import WorkFolder

WANTED = "wanted"
"""A file of a work folder whose run is to begin as soon as no other runs."""

STOP = "stop"
"""A file of a work folder whose run is to stop; with the text `DISCARD` its folder is to go too."""

DISCARD = "discard"

_NICENESS = 10
_BELOW_NORMAL_PRIORITY_CLASS = 0x4000
_SECONDS_BETWEEN_LOOKS = 0.25
_BUG = "the program has failed ({0}: {1}); continue, or see the log file in {2}"
_NO_MEMORY = (
    "there is not enough memory; close other programs and continue, or learn a lighter mesh"
)
_FULL_OR_GONE = "{0}; free some space on the disk of {1}, then continue"


def main(arguments: list[str]) -> int:
    """Learn what the request of a work folder asks for, or what is left of it.

    Parameters
    ----------
    arguments : the path of the work folder

    Returns
    -------
    status : 0 done, 2 what a user can fix, 3 a bug, 130 stopped
    """
    # Small products take microseconds, which threads that share them out multiply.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _give_way()

    from lcollision_core.errors import CancelledError, LCollisionError
    from lcollision_core.jobs import CancelToken
    from lcollision_core.learning import WorkFolder, learn_model

    work, cancel = WorkFolder.at(Path(arguments[0])), CancelToken()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: cancel.cancel())
    try:
        with obeying(work, cancel):
            learn_model(work, lambda _: _begun(work), cancel)
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
        _tell_failure(work, _FULL_OR_GONE.format(error.strerror or error, work.path.parent))
        return 2
    except Exception as error:
        traceback.print_exc()
        _tell_failure(work, _BUG.format(type(error).__name__, error, work.path))
        return 3
    return 0


@contextmanager
def obeying(work: WorkFolder, cancel: CancelToken) -> Iterator[None]:
    """Cancel the work once a window asks for its end; afterwards what asked is taken away.

    Parameters
    ----------
    work : that is worked on inside the block
    cancel : of that work
    """
    ended = threading.Event()
    looking = threading.Thread(target=_obey, args=(work, cancel, ended), daemon=True)
    looking.start()
    try:
        yield
    finally:
        ended.set()
        looking.join()
        _leave(work)


def _give_way() -> None:
    """Let everything else on the computer go first."""
    if sys.platform == "win32":
        import ctypes

        kernel = ctypes.windll.kernel32
        kernel.SetPriorityClass(kernel.GetCurrentProcess(), _BELOW_NORMAL_PRIORITY_CLASS)
    else:
        os.nice(_NICENESS)


def _obey(work: WorkFolder, cancel: CancelToken, ended: threading.Event) -> None:
    """Stop the run once a window asks for it."""
    while not ended.wait(_SECONDS_BETWEEN_LOOKS):
        if (work.path / STOP).exists():
            cancel.cancel()


def _begun(work: WorkFolder) -> None:
    (work.path / WANTED).unlink(missing_ok=True)


def _tell_failure(work: WorkFolder, sentence: str) -> None:
    """Keep why the run failed, unless another process is at it or the disk has no space."""
    from lcollision_core.errors import MeshFileError
    from lcollision_core.learning import WorkState

    if not work.is_held:
        with suppress(MeshFileError):
            failed = replace(work.status, state=WorkState.FAILED, sentence=sentence)
            work.tell(replace(failed, seconds_left=None))


def _leave(work: WorkFolder) -> None:
    """Take away what the run was asked by, and all of it if that is wanted."""
    with suppress(OSError):
        if (work.path / STOP).read_text(encoding="utf-8") == DISCARD:
            work.remove()
            return
    for name in (WANTED, STOP):
        with suppress(OSError):
            (work.path / name).unlink(missing_ok=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
