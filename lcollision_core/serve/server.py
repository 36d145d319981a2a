"""The engine as a process: on standard input and output, or on a port of this machine alone."""

from __future__ import annotations

import os
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from io import BufferedReader
from typing import BinaryIO, cast

from lcollision_core.errors import LCollisionError
from lcollision_core.serve.session import Session

_LOOPBACK = "127.0.0.1"


def serve_stdio() -> None:
    """Answer the one client on standard input and output, until the input ends.

    What else is printed goes to standard error.
    """
    sys.stdout.flush()
    write = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    Session(cast("BufferedReader", sys.stdin.buffer), write).run()


def serve_port(port: int, token: str, started: Callable[[int], None]) -> None:
    """Answer clients on a port of this machine, each by a session of its own.

    It ends when standard input does, as that of a child whose parent is gone.

    Parameters
    ----------
    port : 0 for any that is free
    token : that clients must say
    started : called with the port

    Raises
    ------
    LCollisionError : the port is not free.
    """
    try:
        listener = socket.create_server((_LOOPBACK, port))
    except (OSError, OverflowError) as error:
        raise LCollisionError.because(f"port {port}", "cannot be used", error, "name 0") from error
    started(listener.getsockname()[1])
    ended = threading.Thread(target=_close_at_end, args=(sys.stdin.buffer, listener), daemon=True)
    ended.start()
    with listener:
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=_talk, args=(client, token), daemon=True).start()


def _talk(client: socket.socket, token: str) -> None:
    with client, client.makefile("rb") as read, client.makefile("wb") as write:
        try:
            Session(read, write, token).run()
        except OSError:
            # The client reset the connection.
            return


def _close_at_end(read: BinaryIO, listener: socket.socket) -> None:
    while read.read(1 << 16):
        pass
    # Closing alone does not wake a thread that waits in it; elsewhere than on Linux it does.
    with suppress(OSError):
        listener.shutdown(socket.SHUT_RDWR)
    listener.close()
