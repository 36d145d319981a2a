"""The session of one client with the engine: its characters, jobs and replies."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from io import BufferedReader
from threading import Lock
from typing import Any, BinaryIO, cast

from lcollision_core import __version__
from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.jobs import Job, at_most_every, available_cores
from lcollision_core.serve import messages as m
from lcollision_core.serve.characters import OpenedCharacter, character_id, open_arrays, open_file
from lcollision_core.serve.work import (
    Dragging,
    answer_resolve_motion,
    check_pose,
    describe,
    propose,
    resolve_pose,
)

_BETWEEN_PROGRESS = 0.1
"""Seconds between two progress messages."""

_LONG: dict[type, Callable[..., dict[str, Any]]] = {
    m.ResolvePose: resolve_pose,
    m.ResolveMotion: answer_resolve_motion,
    m.ProposeRules: propose,
}
"""Long work, which runs beside other requests."""

Reply = dict[str, Any]

log = logging.getLogger(__name__)


class Session:
    """Answers the requests of one stream until it ends.

    Opening, rules and drags are done in order. Checks, on all cores, and long work, one at a time,
    run beside them with the rules that were set before their request.

    Parameters
    ----------
    read, write : binary streams; `write` is used by one thread at a time
    """

    def __init__(self, read: BufferedReader, write: BinaryIO) -> None:
        self._reader, self._write = m.FrameReader(read), write
        self._write_lock, self._jobs_lock = Lock(), Lock()
        self._jobs: dict[int, Job] = {}
        self._characters: dict[str, OpenedCharacter] = {}
        self._dragging: Dragging | None = None
        self._greeted = False

    def run(self) -> None:
        """Answer until the stream ends, then cancel the running jobs."""
        with (
            # `_lane`, which feeds the others, must end first.
            ThreadPoolExecutor(1, "engine, long") as self._long,
            ThreadPoolExecutor(available_cores(), "engine, checks") as self._checks,
            ThreadPoolExecutor(1, "engine") as self._lane,
        ):
            try:
                while self._answer_next():
                    pass
            finally:
                with self._jobs_lock:
                    for job in self._jobs.values():
                        job.cancel()

    def _answer_next(self) -> bool:
        """Handle the next message; return False at the end of the stream."""
        try:
            message = self._reader.read()
            if message is None:
                return False
            request = m.read_request(message)
        except m.RefusedMessageError as error:
            if not error.is_readable:
                self._reader.lose_place()
            self._refuse(error.number, error)
            return True
        except LCollisionError as error:
            self._refuse(None, error)
            return True
        if isinstance(request, m.Hello):
            self._greet(request)
        elif not self._greeted:
            self._refuse(request.id, LCollisionError("the first message must be hello"))
        elif isinstance(request, m.Cancel):
            with self._jobs_lock:
                job = self._jobs.get(request.request)
            if job is not None:
                job.cancel()
            self._send(request.id, "cancelling", {"found": job is not None})
        else:
            self._begin(request)
        return True

    def _greet(self, request: m.Hello) -> None:
        if request.version != m.PROTOCOL_VERSION:
            error = LCollisionError.must_be(
                "the version of the protocol",
                m.PROTOCOL_VERSION,
                request.version,
                "use a client of the same release",
            )
            self._refuse(request.id, error)
            return
        self._greeted = True
        greeting = {"version": m.PROTOCOL_VERSION, "program": __version__}
        self._send(request.id, "hello", greeting)

    def _begin(self, request: Any) -> None:
        def report(done: int, total: int) -> None:
            self._send(request.id, "progress", {"done": done, "total": total})

        job = Job(at_most_every(_BETWEEN_PROGRESS, report))
        with self._jobs_lock:
            is_known = self._jobs.setdefault(request.id, job) is not job
        if is_known:
            what = f"request {request.id} is still running"
            self._refuse(request.id, LCollisionError(what, "use increasing ids"))
            return
        self._lane.submit(self._do, request, job)

    def _do(self, request: Any, job: Job) -> None:
        """Answer a request, in other threads if it is a check or long work."""
        opened = self._characters.get(getattr(request, "character", ""))
        if opened is not None and isinstance(request, m.Check):
            do = partial(check_pose, opened, request)
            self._checks.submit(self._finish, request.id, job, do)
        elif opened is not None and (work := _LONG.get(type(request))) is not None:
            do = partial(work, opened, request, job)
            self._long.submit(self._finish, request.id, job, do)
        else:
            self._finish(request.id, job, partial(self._quick, request))

    def _finish(self, number: int, job: Job, do: Callable[[], Reply]) -> None:
        kind, fields = "result", {}
        try:
            job.check()
            fields = do()
            job.check()
        except CancelledError:
            kind = "cancelled"
        except LCollisionError as error:
            kind, fields = "error", {"message": str(error)}
        except MemoryError:
            message = "out of memory; send smaller meshes or fewer frames"
            kind, fields = "error", {"message": message}
        except Exception:
            log.exception("request %d", number)
            kind, fields = "error", {"message": "this is a bug in lcollision; please report it"}
        with self._jobs_lock:
            del self._jobs[number]
        self._send(number, kind, fields)

    def _quick(self, request: Any) -> Reply:
        match request:
            case m.Open() | m.OpenMesh():
                return self._open(request)
        opened = self._character(request.character)
        match request:
            case m.GetRules():
                return {"rules": opened.body.rules.to_json(), "groups": _groups(opened)}
            case m.SetRules():
                from lcollision_core.meshes import ContactRules

                body = opened.body.with_rules(ContactRules.from_json(request.rules))
                self._characters[request.character] = replace(opened, body=body)
                self._dragging = None
                return {"rules": body.rules.to_json(), "in_words": body.rules.summary()}
            case m.Drag():
                if request.transforms is not None:
                    self._dragging = Dragging.begin(opened, request)
                if self._dragging is None or self._dragging.opened is not opened:
                    raise LCollisionError("no drag of this character has begun", "send transforms")
                return self._dragging.move(request)
            case m.Close():
                del self._characters[request.character]
                return {}
        raise AssertionError(request)

    def _open(self, request: m.Open | m.OpenMesh) -> Reply:
        digest = character_id(request)
        # A character that is already open keeps its rules.
        opened = self._characters.get(digest)
        if opened is None:
            if isinstance(request, m.Open):
                opened = open_file(request.file)
            else:
                opened = open_arrays(request)
            self._characters[digest] = opened
        return {"character": digest, **describe(opened)}

    def _character(self, digest: str) -> OpenedCharacter:
        if digest not in self._characters:
            raise LCollisionError(f"no character {digest!r} is open", "open it")
        return self._characters[digest]

    def _refuse(self, number: int | None, error: LCollisionError) -> None:
        self._send(number, "error", {"message": str(error)})

    def _send(self, number: int | None, kind: str, values: Reply) -> None:
        message = m.framed(m.write_reply(number, kind, **values))
        try:
            with self._write_lock:
                self._write.write(message)
                self._write.flush()
        except (OSError, ValueError):
            # The client is gone; the reader notices it.
            return


def _groups(opened: OpenedCharacter) -> dict[str, list[str]]:
    kinds = opened.body.groups_by_kind
    return {kind: [group.name for group in groups] for kind, groups in kinds.items()}


def serve_stdio() -> None:
    """Serve one client on standard input and output until the input ends.

    Anything else that is printed goes to standard error.
    """
    sys.stdout.flush()
    write = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    Session(cast("BufferedReader", sys.stdin.buffer), write).run()
