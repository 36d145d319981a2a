"""Read untrusted JSON in bounded memory, and check its types."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NoReturn, TypeVar

from msgspec import ValidationError, convert

from lcollision_core.errors import ModelFileError

MAX_MEMORY = 2**29
"""Most bytes that the values of one document may take."""

_BYTES_EACH = {b"{": 232, b"[": 88, b",": 40, b'"': 30}
"""Upper bound of the bytes of memory per such character of the text."""

_QUOTED_LENGTH = 60
_BEYOND = {bool: 2, int: 2**63, float: math.inf}

T = TypeVar("T")


def parse_json(content: bytes) -> Any:
    """Parse a JSON document in UTF-8, with or without a byte order mark.

    Raises
    ------
    ValueError : it is not JSON, is nested too deeply, or its values would take more memory than
        `MAX_MEMORY`.
    """
    if not content.strip():
        raise ValueError("it is empty")
    if sum(content.count(mark) * each for mark, each in _BYTES_EACH.items()) > MAX_MEMORY:
        raise ValueError(f"its values would take more than {MAX_MEMORY >> 20} MiB of memory")
    try:
        return json.loads(content.decode("utf-8-sig"), parse_constant=_refuse_constant)
    except UnicodeDecodeError as error:
        raise ValueError("its text is not UTF-8") from error
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def parse_document(content: bytes, kind: str, version: int, where: object) -> dict[str, Any]:
    """Parse a JSON object that names its format and version.

    Parameters
    ----------
    kind, version : the format, and the latest version that is known
    where : the file, for messages

    Raises
    ------
    ValueError : it is no JSON, or of another format.
    ModelFileError : it is of a later version.
    """
    document = parse_json(content)
    if not isinstance(document, dict) or document.get("format") != kind:
        raise ValueError("it contains something else")
    stored = document.get("format_version")
    if isinstance(stored, int) and stored > version:
        raise ModelFileError.too_new(where, quoted(stored), version)
    return document


def from_json(cls: type[T], values: Any, name: str) -> T:
    """Build a dataclass from a JSON object and check the types of its values.

    An integer is accepted for a float, a list for a tuple. Unknown entries are ignored: a later
    version may have added them.

    Parameters
    ----------
    cls : a dataclass or `msgspec.Struct`; its types may have limits, given by `msgspec.Meta`
    values : the parsed JSON
    name : name of the object in error messages

    Raises
    ------
    ValueError : a value is missing, of another type, beyond its limits, not finite, or beyond 64
        bits; or an error that the class itself raises.
    """
    try:
        return convert_checked(cls, _sanitised(values, name), name)
    except RecursionError as error:
        raise ValueError(f"{name} is nested too deeply") from error


def convert_checked(cls: type[T], values: Any, name: str) -> T:
    """Do as `from_json`, without its check for numbers that are not finite and lone surrogates."""
    try:
        return convert(values, cls)
    except ValidationError as error:
        if isinstance(error.__cause__, ValueError):
            raise error.__cause__ from None
        raise ValueError(_sentence(str(error), values, name)) from error


def to_json(value: Any) -> dict[str, Any]:
    """Return a dataclass as JSON values, with lists for tuples as when read from a file."""
    values: dict[str, Any] = json.loads(json.dumps(asdict(value)))
    return values


def quoted(value: object) -> str:
    """Return the `repr` of a value, shortened for use in a message."""
    text = repr(value)
    return text if len(text) <= _QUOTED_LENGTH else f"{text[: _QUOTED_LENGTH - 3]}..."


def _sanitised(value: Any, name: str) -> Any:
    """Return a value whose strings can all be printed; refuse numbers beyond 64 bits."""
    if isinstance(value, str):
        # A lone surrogate, from an undecodable file name, cannot be printed.
        return value.encode(errors="replace").decode()
    if isinstance(value, Mapping):
        return {key: _sanitised(item, f"{name}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_sanitised(item, name) for item in value]
    if isinstance(value, int | float) and not abs(value) < _BEYOND[type(value)]:
        raise ValueError(f"{name} must be a finite number of 64 bits, got {quoted(value)}")
    return value


def _sentence(message: str, values: Any, name: str) -> str:
    """Rephrase a message of msgspec and quote the offending value.

    A typical message is "Expected `int`, got `str` - at `$.rules.ignored[0]`".
    """
    what, _, path = message.partition(" - at `$")
    for key, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        values = values[key or int(index)]
    place = name + path.removesuffix("`")
    if missing := re.fullmatch("Object missing required field `(.+)`", what):
        return f"{place} lacks {missing[1]}"
    expected = re.match(r"Expected `([^`]+)`([^,]*)", what)
    if isinstance(values, float) and not math.isfinite(values):
        return f"{place} is not finite"
    if expected is None:  # the message has another form: it quotes the value
        is_beyond = isinstance(values, int) and abs(values) >= _BEYOND[int]
        needed = "a number nearer to 0" if is_beyond else "a known value"
        return f"{place} must be {needed}, got {quoted(values)}"
    kinds = " or ".join(_WORDS.get(kind, kind) for kind in expected[1].split(" | "))
    limits = expected[2].replace("<=", "at most").replace(">=", "at least")
    return f"{place} must be {kinds}{limits}, got {quoted(values)}"


_WORDS = {
    "bool": "true or false",
    "int": "a whole number",
    "float": "a finite number",
    "str": "a string",
    "array": "a list",
    "object": "an object",
    "null": "null",
}


def _refuse_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is not a JSON number")
