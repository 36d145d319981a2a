"""Damaged or meaningless messages: one sentence each, and the engine keeps running."""

from __future__ import annotations

import io
import os
import struct
import subprocess
import sys
from typing import Any

import msgpack
import numpy as np
import pytest

from lcollision_core.errors import LCollisionError
from lcollision_core.serve.client import Reply, wrapped
from lcollision_core.serve.messages import MARK, MAX_LENGTH, FrameReader, framed
from tests.core.serve.engines import ROOT, as_arrays
from tests.rigged_shapes import rigged_body

N_DAMAGED = 300


class Raw:
    """An engine process that receives raw bytes."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "app", "serve"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
        self.tell(hello())
        assert self.reply()["type"] == "hello"

    def tell(self, data: bytes) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(data)
        self.process.stdin.flush()

    def reply(self) -> Reply:
        assert self.process.stdout is not None
        head = self.process.stdout.read(8)
        assert head[:4] == MARK, self.process.stderr
        (length,) = struct.unpack("<I", head[4:])
        reply: Reply = msgpack.unpackb(self.process.stdout.read(length))
        return reply

    def end(self) -> tuple[int, str]:
        """Close the input; return the exit status and standard error."""
        _, errors = self.process.communicate(timeout=60.0)
        return self.process.returncode, errors.decode()


def hello(number: int = 1) -> bytes:
    return framed(msgpack.packb({"type": "hello", "id": number, "version": 1}))


def plain(values: Any) -> Any:
    """Encode the arrays of a message."""
    if isinstance(values, dict):
        return {key: plain(one) for key, one in values.items()}
    if isinstance(values, list):
        return [plain(one) for one in values]
    return wrapped(values) if isinstance(values, np.ndarray) else values


def requests() -> list[Reply]:
    """Return a request of each kind with arrays or texts."""
    body = as_arrays(rigged_body())
    pose = np.array(body["rest"])
    told: list[Reply] = [
        {"type": "open_mesh", **body},
        {"type": "open", "file": "nowhere.glb"},
        {"type": "check", "character": "0" * 16, "transforms": pose},
        {"type": "resolve_pose", "character": "0" * 16, "transforms": pose, "beyond": 0.1},
        {"type": "set_rules", "character": "0" * 16, "rules": {"near_exclusion": 0.1}},
        {"type": "drag", "character": "0" * 16, "target": np.zeros(3)},
    ]
    return [plain(one) for one in told]


def damaged(generator: np.random.Generator, request: Reply, number: int) -> bytes:
    """Return a damaged request: its bytes or values are changed."""
    request = {**request, "id": number}
    kind = int(generator.integers(6))
    keys = [key for key in request if key != "id"]
    if kind == 0:
        request[keys[int(generator.integers(len(keys)))]] = [None, -1, "x", [], {}, 1e400][
            int(generator.integers(6))
        ]
        return framed(msgpack.packb(request))
    if kind == 1:
        request[f"{keys[-1]}s"] = request.pop(keys[int(generator.integers(len(keys)))])
        return framed(msgpack.packb(request))
    data = bytearray(msgpack.packb(request))
    if kind == 2:
        return framed(bytes(data[: int(generator.integers(len(data)))]))
    if kind == 3:
        for at in generator.integers(min(len(data), 64), size=4).tolist():
            data[at] = int(generator.integers(256))
        return framed(bytes(data))
    if kind == 4:
        return bytes(generator.integers(256, size=30, dtype=np.uint8)).replace(b"L", b"l")
    return MARK + struct.pack("<I", MAX_LENGTH + 1 + int(generator.integers(1000))) + bytes(data)


@pytest.mark.slow
def test_damaged_messages_get_one_sentence_each_and_the_engine_stays() -> None:
    engine, generator = Raw(), np.random.default_rng(37)
    kinds = requests()
    sentences = set()
    n_refused = number = 0
    while n_refused < N_DAMAGED:
        number += 2
        request = kinds[int(generator.integers(len(kinds)))]
        engine.tell(damaged(generator, request, number))
        engine.tell(hello(number + 1))
        replies = [engine.reply()]
        while replies[-1]["id"] != number + 1 or replies[-1]["type"] != "hello":
            replies.append(engine.reply())
        # Replies may come after the greeting's; only messages that are still valid may succeed.
        if len(replies) == 1:
            replies.insert(0, engine.reply())
        assert len(replies) == 2, replies
        said = replies[0]
        assert said["type"] in ("error", "result", "cancelling", "hello")
        if said["type"] != "error":
            continue
        n_refused += 1
        sentence = said["message"]
        sentences.add(sentence)
        assert sentence.strip()
        assert "\n" not in sentence
        assert len(sentence) < 600
        assert "Traceback" not in sentence
        assert "bug" not in sentence
    assert len(sentences) > 20
    assert engine.end() == (0, "")


class Counted(io.BufferedReader):
    """Counts the read calls."""

    n_reads = 0

    def read(self, size: int | None = -1, /) -> bytes:
        self.n_reads += 1
        return super().read(size)


@pytest.mark.parametrize("rest", [b"", b"L", b"LC", b"LCM", b"LCMLC"])
def test_a_message_that_is_too_long_is_skipped_in_pieces(rest: bytes) -> None:
    n = MAX_LENGTH + 1
    head = MARK + struct.pack("<I", n)
    data = head + bytes(100_000) + rest + framed(b"first") + framed(b"second")
    # Some remainders make the mark straddle two of its chunks.
    stream = Counted(io.BytesIO(data), 2273)  # type: ignore[arg-type]
    reader = FrameReader(stream)
    with pytest.raises(LCollisionError, match="bytes long"):
        reader.read()
    messages: list[bytes | None] = [reader.read() for _ in range(3)]
    assert messages == [b"first", b"second", None]
    assert stream.n_reads < 200


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"type": "chek"}, "the message.type must be a known value, got 'chek'"),
        ({"type": 5}, "a message must have a type"),
        ({"id": "one"}, "the message.id must be a whole number"),
        ({"character": None}, "the message.character must be a string, got None"),
        ({"transforms": {"dtype": "<f8", "shape": [3], "data": b""}}, "no character '0000"),
        ({"transforms": {"dtype": "|O", "shape": [3], "data": b""}}, "transforms.dtype"),
        ({"beyond": float("nan")}, "beyond"),
        ({"beyond": 2.0}, "beyond must be"),
        ({"more": 1}, "the message has an unknown field 'more'"),
    ],
)
def test_a_message_that_is_wrong_is_told_what_is_wrong(
    engine: Raw, change: Reply, sentence: str
) -> None:
    pose = wrapped(np.eye(4)[None].copy())
    request = {
        "type": "resolve_pose",
        "id": 7,
        "character": "0000",
        "transforms": pose,
        **change,
    }
    engine.tell(framed(msgpack.packb(request)))
    reply = engine.reply()
    assert reply["type"] == "error"
    assert sentence in reply["message"]
    assert reply["id"] == (7 if "id" not in change else None)


@pytest.fixture(scope="module")
def engine() -> Any:
    one = Raw()
    yield one
    assert one.end() == (0, "")


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("parents", np.zeros(21, np.int32), "joint 'Hips' comes before its parent"),
        ("parents", np.zeros(3, np.int32), "parents must be an array of shape 21, got 3"),
        ("parents", np.full(21, 99, np.int32), "parents must be indices from -1 to 20"),
        ("rest", np.zeros((21, 4, 4)), "joint 'Hips' has no size at rest"),
        ("rest", np.full((21, 4, 4), np.nan), "rest has a number that is not finite"),
        ("joints", [], "joints must be at least one"),
    ],
)
def test_a_mesh_that_cannot_be_is_refused(
    engine: Raw, field: str, value: Any, sentence: str
) -> None:
    request = plain({"type": "open_mesh", "id": 3, **as_arrays(rigged_body()), field: value})
    engine.tell(framed(msgpack.packb(request)))
    reply = engine.reply()
    assert (reply["type"], reply["id"]) == ("error", 3)
    assert sentence in reply["message"]


@pytest.mark.slow
def test_a_session_begins_with_hello_of_a_known_version() -> None:
    process = subprocess.run(
        [sys.executable, "-m", "app", "serve"],
        input=framed(msgpack.packb({"type": "rules", "id": 1, "character": ""}))
        + framed(msgpack.packb({"type": "hello", "id": 2, "version": 99})),
        capture_output=True,
        check=True,
        cwd=ROOT,
    )
    assert b"the first message must be hello" in process.stdout
    assert b"the version of the protocol must be 1, got 99; use a client" in process.stdout
