"""Framing of messages in a byte stream: a mark, the length, and that many bytes."""

from __future__ import annotations

import struct
from io import BufferedReader
from typing import Final

from lcollision_core.errors import LCollisionError

MARK: Final = b"LCM1"
"""Starts each message, so that a reader that has lost its place finds the next one."""

MAX_LENGTH: Final = 1 << 28
"""Largest length of a message in bytes."""

_LENGTH = struct.Struct("<I")
_PIECE = 1 << 16


class FrameReader:
    """Reads the messages of a stream.

    Parameters
    ----------
    stream : binary stream whose `read` blocks until it has all the bytes asked for, or the end
    """

    def __init__(self, stream: BufferedReader) -> None:
        self._stream = stream
        self._is_lost = False

    def lose_place(self) -> None:
        """Let the next `read` skip to the next mark without an error."""
        self._is_lost = True

    def read(self) -> bytes | None:
        """Return the next message; None at the end of the stream.

        Raises
        ------
        LCollisionError : the bytes are no message, or it is too long. The next call skips to the
            next mark.
        """
        head = self._stream.read(len(MARK))
        if self._is_lost or (head != MARK and len(head) == len(MARK)):
            was_lost, self._is_lost = self._is_lost, True
            if not was_lost:
                raise LCollisionError.must_be("a message", f"begun by {MARK!r}", repr(head))
            while head != MARK:
                # Skip all that is buffered at once: there may be hundreds of megabytes.
                ahead = self._stream.peek()
                if not ahead:
                    return None
                received = head + ahead
                at = received.find(MARK)
                end = len(received) if at < 0 else at + len(MARK)
                self._stream.read(end - len(head))
                head = received[:end][-len(MARK) :]
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
        # Read in pieces: a wrong length must not allocate memory for bytes that never come.
        pieces, left = [], n_bytes
        while left:
            piece = self._stream.read(min(left, _PIECE))
            if not piece:
                return None
            pieces.append(piece)
            left -= len(piece)
        return b"".join(pieces)


def framed(message: bytes) -> bytes:
    """Return a message with its mark and length."""
    return MARK + _LENGTH.pack(len(message)) + message
