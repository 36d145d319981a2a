"""Opening paths from untrusted sources: regular files only."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
)


def require_regular(path: str | os.PathLike[str]) -> int:
    """Return the size in bytes of a file that may be opened, of whatever name.

    Opening a pipe waits for its writer, a device may never end, and the error of a
    folder explains nothing; so none of them is opened.

    Raises
    ------
    OSError : there is no such file, or it is something else; `strerror` says what.
    ValueError : the name holds a NUL byte.
    """
    status = Path(path).stat()
    if stat.S_ISREG(status.st_mode):
        return status.st_size
    kind = next((name for is_kind, name in _KINDS if is_kind(status.st_mode)), "a device")
    raise OSError(errno.EINVAL, f"it is {kind}, not a plain file", os.fspath(path))


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file to read its bytes.

    Raises
    ------
    OSError, ValueError : as for `require_regular`, or it may not be read.
    """
    require_regular(path)
    return Path(path).open("rb")


def read_regular(path: str | os.PathLike[str], most_bytes: int) -> bytes:
    """Read a regular file whole.

    Raises
    ------
    OSError, ValueError : as for `open_regular`, or it has more than `most_bytes` bytes.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most_bytes:
            raise OSError(
                errno.EFBIG, f"it has {size} bytes, at most {most_bytes} are read", os.fspath(path)
            )
        return file.read(size)
