"""A client of the engine: this file, `msgpack` and the standard library.

    with Engine.start([sys.executable, "-m", "app"]) as engine:
        opened = engine.ask("open", file="hero.glb")
        answer = engine.ask("check", character=opened["character"], transforms=array)

Arrays are sent and received as maps `{"dtype", "shape", "data"}`. `wrapped` makes one from any
object with a buffer, such as a NumPy array; `numpy.frombuffer(map["data"], map["dtype"])` reads it.
"""

from __future__ import annotations

import contextlib
import queue
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import msgpack

VERSION = 1
_MARK, _LENGTH, _MAX_LENGTH = b"LCM1", struct.Struct("<I"), 1 << 28
_PATIENCE = 10.0
"""Seconds that the engine's process may take to end after its input has ended."""
_START, _SILENCE, _LIMIT, _LONG_LIMIT = 120.0, 20.0, 600.0, 3600.0
"""Seconds within which the engine must answer the first `hello`; any later one, which it answers
at once whatever it computes; other requests, or report their progress; and resolve requests."""
_LOOK = 0.5
"""Seconds between two checks of these limits."""
_GONE = "the engine is gone"

Reply = dict[str, Any]
ProgressCallback = Callable[[int, int], None]


class EngineError(Exception):
    """The engine reported an error, or is gone."""


class EngineCancelled(EngineError):  # noqa: N818 - it is no error
    """A request was cancelled."""


def wrapped(values: Any) -> Reply:
    """Return an array of float32, float64 or int32 in the form that messages hold."""
    view = memoryview(values)
    kind = {"f": "<f4", "d": "<f8", "i": "<i4"}.get(view.format)
    if kind is None or view.shape is None or not view.c_contiguous:
        raise TypeError(f"needs float32, float64 or int32 in C order, got {view.format!r}")
    return {"dtype": kind, "shape": list(view.shape), "data": view.tobytes()}


class Request:
    """A request that was sent, and its answer once that has come."""

    def __init__(self, number: int, progress: ProgressCallback | None, limit: float) -> None:
        self.number, self._progress = number, progress
        self._limit, self._heard = limit, time.monotonic()
        self._done = threading.Event()
        self._reply: Reply = {}

    @property
    def is_done(self) -> bool:
        """Whether the answer has come."""
        return self._done.is_set()

    @property
    def is_late(self) -> bool:
        """Whether neither answer nor progress has come within the limit."""
        return time.monotonic() - self._heard > self._limit

    def result(self, timeout: float | None = None) -> Reply:
        """Wait for the answer.

        Raises
        ------
        EngineError : the engine reported an error or is gone, or the request was cancelled.
        TimeoutError : the answer has not come within `timeout` seconds.
        """
        if not self._done.wait(timeout):
            raise TimeoutError(f"the engine has not answered in {timeout} s")
        kind = self._reply["type"]
        if kind == "error":
            raise EngineError(self._reply["message"])
        if kind == "cancelled":
            raise EngineCancelled("cancelled")
        return self._reply

    def handle_reply(self, reply: Reply) -> None:
        """Handle a message of the engine, in the reader's thread."""
        self._heard = time.monotonic()
        if reply["type"] == "progress":
            if self._progress is not None:
                self._progress(reply["done"], reply["total"])
            return
        self._reply = reply
        self._done.set()


class Engine:
    """A conversation with the engine; safe to share between threads.

    No call waits for an engine that hangs: a separate thread writes the messages, and an engine
    that stops answering is ended, which fails its requests.

    Parameters
    ----------
    read, write : binary streams
    end : called to end the engine, with the seconds that it may take
    """

    def __init__(self, read: BinaryIO, write: BinaryIO, end: Callable[[float], object]) -> None:
        self._read, self._write, self._end = read, write, end
        self._lock = threading.Lock()
        self._waiting: dict[int, Request] = {}
        self._number, self._gone = 0, ""
        self._greeting = {"version": VERSION}
        self._messages: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._closed = threading.Event()
        self._first = self._send("hello", None, _START, self._greeting)
        self._threads = [
            threading.Thread(target=loop, name="lcollision", daemon=True)
            for loop in (self._listen, self._write_all, self._watch)
        ]
        for thread in self._threads:
            thread.start()
        try:
            self.hello = self._first.result()
        except BaseException:
            self.close(0.0)
            raise

    @classmethod
    def start(cls, command: list[str], **options: Any) -> Engine:
        """Start the engine in a process of its own, with a command such as `[python, "-m", "app"]`.

        Raises
        ------
        EngineError : it cannot be started, or has another protocol version.
        """
        try:
            process = subprocess.Popen(
                [*command, "serve"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, **options
            )
        except OSError as error:
            raise EngineError(f"cannot start {command[0]}: {error.strerror}") from error
        read: Any = process.stdout
        write: Any = process.stdin

        def end(patience: float) -> None:
            try:
                process.wait(patience)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

        return cls(read, write, end)

    @property
    def is_alive(self) -> bool:
        """Whether the engine still answers."""
        return not self._gone

    def send(self, kind: str, progress: ProgressCallback | None = None, **values: Any) -> Request:
        """Send a request without waiting; values with a buffer are sent as arrays.

        Raises
        ------
        EngineError : the engine is gone, or the message is too long.
        """
        limit = _LONG_LIMIT if kind.startswith("resolve") else _LIMIT
        return self._send(kind, progress, limit, values)

    def _send(
        self, kind: str, progress: ProgressCallback | None, limit: float, values: Reply
    ) -> Request:
        fields = {key: _plain(value) for key, value in values.items() if value is not None}
        with self._lock:
            if self._gone:
                raise EngineError(self._gone)
            self._number += 1
            request = Request(self._number, progress, limit)
            message = msgpack.packb({"type": kind, "id": request.number, **fields})
            if len(message) > _MAX_LENGTH:
                raise EngineError(
                    f"the message has {len(message) >> 20} MiB, at most {_MAX_LENGTH >> 20} fit; "
                    "send fewer frames at once, or subdivide the meshes less"
                )
            self._waiting[request.number] = request
            self._messages.put(_MARK + _LENGTH.pack(len(message)) + message)
        return request

    def ask(self, kind: str, progress: ProgressCallback | None = None, **values: Any) -> Reply:
        """Send a request and wait for the answer: see `send` and `Request.result`."""
        return self.send(kind, progress, **values).result()

    def cancel(self, request: Request) -> None:
        """Ask the engine to cancel a request; its `result` then raises `EngineCancelled`."""
        self.send("cancel", request=request.number)

    def close(self, patience: float | None = None) -> None:
        """End the conversation, and with it the engine's process.

        Parameters
        ----------
        patience : seconds to wait for the process to end before it is killed; 0 kills it at once
        """
        self._closed.set()
        # Fail the requests before the engine reports them as cancelled, which nobody asked for.
        self._fail(_GONE, is_gone=True)
        self._messages.put(None)
        self._end(_PATIENCE if patience is None else patience)
        for thread in self._threads:
            thread.join()
        self._read.close()

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write_all(self) -> None:
        """Write queued messages, even if the engine is slow to read them."""
        try:
            while (message := self._messages.get()) is not None:
                self._write.write(message)
                self._write.flush()
        except (OSError, ValueError):
            self._fail(_GONE, is_gone=True)
        with contextlib.suppress(OSError, ValueError):
            self._write.close()

    def _watch(self) -> None:
        """End an engine that does not answer in time."""
        sign = self._first
        while not self._closed.wait(_LOOK):
            with self._lock:
                waiting = list(self._waiting.values())
            if any(request.is_late for request in waiting):
                self._fail("the engine did not answer and was ended; try again", is_gone=True)
                self._messages.put(None)
                self._end(0.0)
            elif waiting and sign.is_done:
                with contextlib.suppress(EngineError):
                    sign = self._send("hello", None, _SILENCE, self._greeting)

    def _listen(self) -> None:
        reason = _GONE
        try:
            for reply in self._replies():
                if reply["id"] is None:
                    # The request is unknown and would wait for ever, so fail all of them.
                    self._fail(reply["message"])
                    continue
                request = self._waiting.get(reply["id"])
                if request is not None:
                    if reply["type"] != "progress":
                        del self._waiting[request.number]
                    request.handle_reply(reply)
        except Exception as error:  # no request may wait for ever
            reason = f"{_GONE}: {error}"
        self._fail(reason, is_gone=True)

    def _fail(self, message: str, is_gone: bool = False) -> None:
        """Fail all waiting requests with this message."""
        with self._lock:
            if is_gone:
                self._gone = self._gone or message
            left, self._waiting = list(self._waiting.values()), {}
        for request in left:
            request.handle_reply({"type": "error", "message": message})

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
    """Wrap values that have a buffer, also inside lists and maps."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, str | bytes | int | float) or value is None:
        return value
    return wrapped(value)
