"""Messages in a stream of bytes: each has a mark, its length, and that many bytes."""

from __future__ import annotations

import struct
from io import BufferedReader
from typing import Final

from lcollision_core.errors import LCollisionError

MARK: Final = b"LCM1"
"""Begins each message, so that a reader that has lost its place finds the next one."""

MAX_LENGTH: Final = 1 << 28
"""Most bytes of a message."""

_LENGTH = struct.Struct("<I")
_PIECE = 1 << 16


class FrameReader:
    """Reads the messages of a stream.

    Parameters
    ----------
    stream : of bytes; `read` waits for as many as asked for, or the end
    """

    def __init__(self, stream: BufferedReader) -> None:
        self._stream = stream
        self._is_lost = False

    def lose_place(self) -> None:
        """Skip to the next mark in silence: what was read last made no sense."""
        self._is_lost = True

    def read(self) -> bytes | None:
        """Return the next message; None at the end of the stream.

        Raises
        ------
        LCollisionError : there is something else than a message, or it is too long. What follows
            up to the next mark is skipped then.
        """
        head = self._stream.read(len(MARK))
        if self._is_lost or (head != MARK and len(head) == len(MARK)):
            was_lost, self._is_lost = self._is_lost, True
            if not was_lost:
                raise LCollisionError.must_be("a message", f"begun by {MARK!r}", repr(head))
            while head != MARK:
                # As much as is there at once: what is skipped may be hundreds of megabytes.
                ahead = self._stream.peek()
                if not ahead:
                    return None
                seen = head + ahead
                at = seen.find(MARK)
                end = len(seen) if at < 0 else at + len(MARK)
                self._stream.read(end - len(head))
                head = seen[:end][-len(MARK) :]
            self._is_lost = False
        length = self._stream.read(_LENGTH.size)
        if len(length) < _LENGTH.size:
            return None
        (n_bytes,) = _LENGTH.unpack(length)
        if n_bytes > MAX_LENGTH:
            self._is_lost = True
            raise LCollisionError.must_be(
                "a message", f"at most {MAX_LENGTH} bytes long", f"{n_bytes} bytes"
            )
        # What a wrong length announces is not set aside before it comes.
        pieces, left = [], n_bytes
        while left:
            piece = self._stream.read(min(left, _PIECE))
            if not piece:
                return None
            pieces.append(piece)
            left -= len(piece)
        return b"".join(pieces)


def framed(message: bytes) -> bytes:
    """Return a message as it goes into a stream."""
    return MARK + _LENGTH.pack(len(message)) + message
