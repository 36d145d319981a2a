"""A client of the engine: this file, `msgpack` and the standard library.

    with Engine.start([sys.executable, "-m", "app"]) as engine:
        opened = engine.ask("open", file="hero.glb")
        answer = engine.ask("check", character=opened["character"], transforms=array)

Arrays go to and fro as `{"dtype", "shape", "data"}`; `wrapped` makes one of anything with a buffer,
as NumPy's arrays have, and `numpy.frombuffer(one["data"], one["dtype"])` takes one.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import subprocess
import threading
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import msgpack

VERSION = 1
_MARK, _LENGTH, _MAX_LENGTH = b"LCM1", struct.Struct("<I"), 1 << 28
_PATIENCE = 10.0
"""Seconds in which the engine's process is to end, once its input has."""

Reply = dict[str, Any]
Told = Callable[[int, int], None]


class EngineError(Exception):
    """The engine's sentence on what is wrong, or that it is gone."""


class EngineCancelled(EngineError):  # noqa: N818 - it is no error
    """A request was cancelled."""


def wrapped(values: Any) -> Reply:
    """Return an array of float32, float64 or int32 as messages hold it."""
    view = memoryview(values)
    kind = {"f": "<f4", "d": "<f8", "i": "<i4"}.get(view.format)
    if kind is None or view.shape is None or not view.c_contiguous:
        raise TypeError(f"needs float32, float64 or int32 in C order, got {view.format!r}")
    return {"dtype": kind, "shape": list(view.shape), "data": view.tobytes()}


class Request:
    """An answer that is on its way."""

    def __init__(self, number: int, progress: Told | None) -> None:
        self.number, self._progress = number, progress
        self._done = threading.Event()
        self._reply: Reply = {}

    @property
    def is_done(self) -> bool:
        """Whether the answer is there."""
        return self._done.is_set()

    def result(self, timeout: float | None = None) -> Reply:
        """Wait for the answer.

        Raises
        ------
        EngineError : the engine's sentence, that it is gone, or that it was cancelled.
        TimeoutError : it takes longer.
        """
        if not self._done.wait(timeout):
            raise TimeoutError(f"the engine has not answered in {timeout} s")
        kind = self._reply["type"]
        if kind == "error":
            raise EngineError(self._reply["message"])
        if kind == "cancelled":
            raise EngineCancelled("cancelled")
        return self._reply

    def take(self, reply: Reply) -> None:
        """Take a message of the engine, in the reader's thread."""
        if reply["type"] == "progress":
            if self._progress is not None:
                self._progress(reply["done"], reply["total"])
            return
        self._reply = reply
        self._done.set()


class Engine:
    """A conversation with the engine; safe to share between threads.

    Parameters
    ----------
    read, write : streams of bytes
    end : called when it is closed
    """

    def __init__(
        self, read: BinaryIO, write: BinaryIO, end: Callable[[], object], token: str = ""
    ) -> None:
        self._read, self._write, self._end = read, write, end
        self._lock = threading.Lock()
        self._waiting: dict[int, Request] = {}
        self._number, self._gone = 0, ""
        self._thread = threading.Thread(target=self._listen, name="lcollision", daemon=True)
        self._thread.start()
        try:
            self.hello = self.ask("hello", version=VERSION, token=token)
        except BaseException:
            self.close()
            raise

    @classmethod
    def start(cls, command: list[str], **options: Any) -> Engine:
        """Start the engine as a process of its own, as by `[python, "-m", "app"]`.

        Raises
        ------
        EngineError : it cannot be started, or speaks another version.
        """
        try:
            process = subprocess.Popen(
                [*command, "serve"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, **options
            )
        except OSError as error:
            raise EngineError(f"cannot start {command[0]}: {error.strerror}") from error
        read: Any = process.stdout
        write: Any = process.stdin

        def end() -> None:
            try:
                process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

        return cls(read, write, end)

    @classmethod
    def connect(cls, port: int, token: str) -> Engine:
        """Talk to an engine that listens on a port of this machine.

        Raises
        ------
        EngineError : it refuses.
        OSError : nothing listens there.
        """
        link = socket.create_connection(("127.0.0.1", port))

        def end() -> None:
            link.close()

        class _Write:
            def write(self, data: bytes) -> None:
                link.sendall(data)

            def flush(self) -> None:
                pass

            def close(self) -> None:
                link.shutdown(socket.SHUT_RDWR)

        write: Any = _Write()
        return cls(link.makefile("rb"), write, end, token)

    @property
    def is_alive(self) -> bool:
        """Whether it still answers."""
        return not self._gone

    def send(self, kind: str, progress: Told | None = None, **values: Any) -> Request:
        """Ask without waiting; what has a buffer is sent as an array.

        Raises
        ------
        EngineError : the engine is gone, or this is more than a message holds.
        """
        fields = {key: _plain(value) for key, value in values.items() if value is not None}
        with self._lock:
            if self._gone:
                raise EngineError(self._gone)
            self._number += 1
            request = Request(self._number, progress)
            message = msgpack.packb({"type": kind, "id": request.number, **fields})
            if len(message) > _MAX_LENGTH:
                raise EngineError(
                    f"the message has {len(message) >> 20} MiB, at most {_MAX_LENGTH >> 20} fit; "
                    "send fewer frames at once, or subdivide the meshes less"
                )
            self._waiting[request.number] = request
            try:
                self._write.write(_MARK + _LENGTH.pack(len(message)) + message)
                self._write.flush()
            except (OSError, ValueError) as error:
                del self._waiting[request.number]
                raise EngineError(f"the engine is gone: {error}") from error
        return request

    def ask(self, kind: str, progress: Told | None = None, **values: Any) -> Reply:
        """Ask and wait for the answer: see `send` and `Request.result`."""
        return self.send(kind, progress, **values).result()

    def cancel(self, request: Request) -> None:
        """Ask the engine to cancel a request, whose result then says so."""
        self.send("cancel", request=request.number)

    def close(self) -> None:
        """End the conversation, and with it the engine's process."""
        with contextlib.suppress(OSError, ValueError):
            self._write.close()
        self._end()
        self._thread.join()
        self._read.close()

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _listen(self) -> None:
        reason = "the engine is gone"
        try:
            for reply in self._replies():
                if reply["id"] is None:
                    # Nobody can tell whose it is, and that one would wait for ever.
                    self._fail(reply["message"])
                    continue
                request = self._waiting.get(reply["id"])
                if request is not None:
                    if reply["type"] != "progress":
                        del self._waiting[request.number]
                    request.take(reply)
        except Exception as error:  # whatever it is, nobody may wait for ever
            reason = f"the engine is gone: {error}"
        self._fail(reason, is_gone=True)

    def _fail(self, message: str, is_gone: bool = False) -> None:
        """Let all that wait for an answer have this sentence."""
        with self._lock:
            if is_gone:
                self._gone = message
            left, self._waiting = list(self._waiting.values()), {}
        for request in left:
            request.take({"type": "error", "message": message})

    def _replies(self) -> Iterator[Reply]:
        while True:
            head = self._read.read(len(_MARK) + _LENGTH.size)
            if len(head) < len(_MARK) + _LENGTH.size or not head.startswith(_MARK):
                return
            (length,) = _LENGTH.unpack(head[len(_MARK) :])
            message = self._read.read(length)
            if len(message) < length:
                return
            yield msgpack.unpackb(message)


def _plain(value: Any) -> Any:
    """Wrap what has a buffer, also inside lists and maps."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, str | bytes | int | float) or value is None:
        return value
    return wrapped(value)
