"""Messages between clients and the engine, and their bytes in a stream: see docs/protocol.md."""

from __future__ import annotations

import math
import re
import struct
from io import BufferedReader
from typing import Annotated, Any, Final, Literal

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta, Struct

from lcollision_core.errors import LCollisionError
from lcollision_core.json_values import convert_checked
from lcollision_core.options import LARGEST_CHANGE

PROTOCOL_VERSION: Final = 1

MARK: Final = b"LCM1"
"""Starts each message, so that a reader that has lost its place finds the next one."""

MAX_LENGTH: Final = 1 << 28
"""Largest length of a message in bytes."""

_LENGTH = struct.Struct("<I")
_PIECE = 1 << 16

_MOST_NAMES, _SHOWN = 100_000, 60

Name = Annotated[str, Meta(max_length=500)]
Count = Annotated[int, Meta(ge=0, le=2**31 - 1)]
Names = Annotated[list[Name], Meta(max_length=_MOST_NAMES)]


class Array(Struct, forbid_unknown_fields=True):
    """An array: its little-endian dtype, its shape, and its bytes in C order."""

    dtype: Literal["<f4", "<f8", "<i4"]
    shape: Annotated[list[Count], Meta(max_length=4)]
    data: bytes

    @classmethod
    def of(cls, values: npt.NDArray[Any]) -> Array:
        """Wrap an array of float32, float64 or integers."""
        dtype = "<i4" if values.dtype.kind in "iu" else f"<f{min(values.dtype.itemsize, 8)}"
        data = np.ascontiguousarray(values, dtype=dtype).tobytes()
        return cls(dtype, list(values.shape), data)  # type: ignore[arg-type]

    def numbers(self, name: str, shape: tuple[int | None, ...]) -> npt.NDArray[np.float64]:
        """Return the values as float64 of a given shape, None for any length.

        Raises
        ------
        LCollisionError : the shape or number of bytes is wrong, or a number is not finite.
        """
        values = self._values(name, shape).astype(np.float64)
        if not np.isfinite(values).all():
            raise LCollisionError("has a number that is not finite", "leave it out", where=name)
        return values

    def indices(
        self, name: str, shape: tuple[int | None, ...], end: int, first: int = 0
    ) -> npt.NDArray[np.int64]:
        """Return the values as int64 of a given shape, each from `first` to below `end`.

        Raises
        ------
        LCollisionError : the shape, type or number of bytes is wrong, or an index is out of range.
        """
        values = self._values(name, shape)
        if self.dtype != "<i4":
            raise LCollisionError.must_be(name, "of type <i4", self.dtype)
        if values.size and (values.min() < first or values.max() >= end):
            raise LCollisionError.must_be(
                name, f"indices from {first} to {end - 1}", f"{values.min()} to {values.max()}"
            )
        return values.astype(np.int64)

    def _values(self, name: str, shape: tuple[int | None, ...]) -> npt.NDArray[Any]:
        fits = len(shape) == len(self.shape) and all(
            wanted is None or wanted == there
            for wanted, there in zip(shape, self.shape, strict=True)
        )
        if not fits:
            shape_text = " x ".join("any" if n is None else str(n) for n in shape)
            got = " x ".join(map(str, self.shape)) or "a number"
            raise LCollisionError.must_be(name, f"an array of shape {shape_text}", got)
        dtype = np.dtype(self.dtype)
        if math.prod(self.shape) * dtype.itemsize != len(self.data):
            n_bytes = math.prod(self.shape) * dtype.itemsize
            raise LCollisionError.must_be(name, f"{n_bytes} bytes long", len(self.data))
        return np.frombuffer(self.data, dtype).reshape(self.shape)


class _Request(Struct, forbid_unknown_fields=True, tag_field="type", kw_only=True):
    id: Count


class Hello(_Request, tag="hello"):
    """Begin a session."""

    version: Count
    token: Name = ""  # sent, empty, by clients of older releases


class Open(_Request, tag="open"):
    """Open a character's file."""

    file: Annotated[str, Meta(max_length=10_000)]


class VertexGroup(Struct, forbid_unknown_fields=True):
    """Vertices of a part, by number; the faces with all corners among them form a group."""

    name: Name
    vertices: Array


class MeshPart(Struct, forbid_unknown_fields=True):
    """One mesh that the joints move.

    Attributes
    ----------
    vertices : (W, 3) at rest, in the coordinates of the joints
    faces : (F, 3) vertex indices of triangles
    joint_of, weights : (W, I) the joints that move each vertex, and their weights
    materials, material_of : names, and (F,) index of each face's material
    groups : further groups that contact rules may name
    """

    name: Name
    vertices: Array
    faces: Array
    joint_of: Array
    weights: Array
    materials: Names = []
    material_of: Array | None = None
    groups: Annotated[list[VertexGroup], Meta(max_length=1000)] = []


class OpenMesh(_Request, tag="open_mesh"):
    """Open a character given by arrays of the client.

    Attributes
    ----------
    joints : J names
    parents : (J,) each joint's parent, which comes before it, -1 for a root
    rest : (J, 4, 4) transforms at rest
    poses : (N, J, 4, 4) transforms of a motion, from which the ranges of the joints are taken
    up : the axis that points up
    metres : length of a unit in metres
    """

    name: Name
    parts: Annotated[list[MeshPart], Meta(min_length=1, max_length=1000)]
    joints: Names
    parents: Array
    rest: Array
    poses: Array | None = None
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    metres: Annotated[float, Meta(gt=0.0, lt=1e9)] = 1.0


class _CharacterRequest(_Request, kw_only=True):
    character: Name


class GetRules(_CharacterRequest, tag="rules"):
    """Return the contact rules, and the groups of faces that they may name."""


class SetRules(_CharacterRequest, tag="set_rules"):
    """Set the contact rules, named as in `ContactRules`; missing ones are off."""

    rules: dict[str, Any]


Clearance = Annotated[float, Meta(ge=0.0, lt=1.0)]


class Check(_CharacterRequest, tag="check"):
    """Check a pose.

    Attributes
    ----------
    transforms : (J, 4, 4) of the joints
    vertices : (W, 3) vertices of all parts as shown; checked instead of the rig's if given
    before : (W, 3) vertices shown before: the linear path from there is checked too
    clearance : normalised; faces that are nearer collide
    counted_only : whether to leave out the pairs that contact rules exclude, and the least
        distance, which is faster
    """

    transforms: Array | None = None
    vertices: Array | None = None
    before: Array | None = None
    clearance: Clearance = 0.0
    counted_only: bool = False


class Drag(_CharacterRequest, tag="drag"):
    """Begin or continue to drag a vertex of a pose towards a point.

    Attributes
    ----------
    transforms : (J, 4, 4) pose in which the drag begins; None continues the last drag
    vertex : index among the vertices of all parts
    target : (3,) point that the centre of the grip should reach
    """

    target: Array
    transforms: Array | None = None
    vertex: Count = 0
    solid: bool = True
    locked: Names = []


class _ResolveRequest(_CharacterRequest, kw_only=True):
    """Options of resolving.

    Attributes
    ----------
    locked : joints whose body parts must not turn
    turning : the only joints that may turn, with the whole body if its root is one; all by default
    beyond : fraction of the correction to add to it, if that is free
    clearance : normalised clearance to keep
    largest_change : normalised, the farthest that a vertex may move
    least_change : normalised: joints whose turns together move no vertex by more stay, in a motion
        span by span, if nothing is worse without them
    """

    locked: Names = []
    turning: Names | None = None
    beyond: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    clearance: Clearance = 0.0
    largest_change: Annotated[float, Meta(gt=0.0)] = LARGEST_CHANGE
    least_change: Clearance = 0.0


class ResolvePose(_ResolveRequest, tag="resolve_pose"):
    """Find the nearest free pose.

    Attributes
    ----------
    vertices : (W, 3) vertices as shown; their offsets from the rig's turn along with the joints
    keep_feet : whether parts that stand on the ground stay there
    """

    transforms: Array
    vertices: Array | None = None
    keep_feet: bool = False


class ResolveMotion(_ResolveRequest, tag="resolve_motion"):
    """Resolve the colliding spans of a motion.

    Attributes
    ----------
    transforms : (T, J, 4, 4)
    times : (T,) in seconds
    vertices : (T, W, 3) vertices as shown, if they differ from the rig's
    within : the first frame that may change, and the one after the last; all by default
    substeps : number of poses between two frames that must be free too
    continuous : whether the linear paths of the vertices between frames must be free
    """

    transforms: Array
    times: Array
    vertices: Array | None = None
    keep_feet: bool = True
    easing: Annotated[int, Meta(ge=0, le=1000)] = 12
    within: Annotated[list[Count], Meta(min_length=2, max_length=2)] | None = None
    substeps: Annotated[int, Meta(ge=0, le=15)] = 1
    continuous: bool = False


class ProposeRules(_CharacterRequest, tag="propose_rules"):
    """Propose places to leave out of the check because they touch in nearly every pose.

    Attributes
    ----------
    vertices : (N, W, 3) vertices of some poses as shown; by default poses that the character came
        with, or random ones
    """

    vertices: Array | None = None


class Cancel(_Request, tag="cancel"):
    """Cancel a request by its number."""

    request: Count


class Close(_CharacterRequest, tag="close"):
    """Forget a character."""


Request = (
    Hello
    | Open
    | OpenMesh
    | GetRules
    | SetRules
    | Check
    | Drag
    | ResolvePose
    | ResolveMotion
    | ProposeRules
    | Cancel
    | Close
)

_decoder = msgspec.msgpack.Decoder(Request)


class RefusedMessageError(LCollisionError):
    """A message is not a valid request; `number` is its id, if that could be read."""

    number: int | None = None
    is_readable = True


def read_request(message: bytes) -> Any:
    """Read a request.

    Raises
    ------
    RefusedMessageError : it is not MessagePack, of an unknown type, or has an invalid value.
    """
    try:
        return _decoder.decode(message)
    except msgspec.ValidationError as error:
        values = _plain(message)
        number = values.get("id") if isinstance(values, dict) else None
        refused = RefusedMessageError(_sentence(error, values), "see docs/protocol.md")
        if isinstance(number, int) and not isinstance(number, bool) and 0 <= number < 2**31:
            refused.number = number
        raise refused from None
    except (msgspec.DecodeError, RecursionError, ValueError, OverflowError) as error:
        refused = RefusedMessageError.because("a message", "is not MessagePack", error)
        refused.is_readable = False
        raise refused from None


def _plain(message: bytes) -> Any:
    try:
        return msgspec.msgpack.decode(message)
    except (msgspec.DecodeError, RecursionError, ValueError, OverflowError):
        return None


def _sentence(error: msgspec.ValidationError, values: Any) -> str:
    if not isinstance(values, dict):
        return "a message must be a map with a type and an id"
    if not isinstance(values.get("type"), str):
        return "a message must have a type, which is a string"
    if unknown := re.match(r"Object contains unknown field `(.*?)`(?: - at `\$(.*)`)?", str(error)):
        return f"the message{unknown[2] or ''} has an unknown field {unknown[1][:_SHOWN]!r}"
    try:
        kind: Any = Request
        convert_checked(kind, values, "the message")
    except ValueError as refusal:
        return str(refusal)
    except (LookupError, TypeError):
        pass
    return f"the message cannot be read: {error}"


def write_reply(number: int | None, kind: str, **values: Any) -> bytes:
    """Encode a reply as MessagePack, with arrays wrapped."""
    fields = {
        key: Array.of(value) if isinstance(value, np.ndarray) else value
        for key, value in values.items()
    }
    return msgspec.msgpack.encode({"type": kind, "id": number, **fields})


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
