"""Untrusted JSON: parsed in bounded memory, and only of the expected types."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import (
    Any,
    Literal,
    NoReturn,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

MAX_MEMORY = 2**29
"""Most bytes of memory for the values of one document."""

_BYTES_EACH = {b"{": 232, b"[": 88, b",": 40, b'"': 30}
"""Most bytes of memory per such character of the text."""

_QUOTED_LENGTH = 60

T = TypeVar("T")


def parse_json(content: bytes) -> Any:
    """Parse a JSON document in UTF-8, with or without a byte order mark.

    Raises
    ------
    ValueError : it is not JSON, is nested too deeply, or its values would take more memory than
        `MAX_MEMORY`.
    """
    if sum(content.count(mark) * each for mark, each in _BYTES_EACH.items()) > MAX_MEMORY:
        raise ValueError(f"its values would take more than {MAX_MEMORY >> 20} MiB of memory")
    try:
        return json.loads(content.decode("utf-8-sig"), parse_constant=_refuse_constant)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def from_json(cls: type[T], values: Any, name: str) -> T:
    """Build a dataclass from a JSON object, each value of the type that the class documents.

    A whole number stands for a float too, a list for a tuple. Unknown entries
    are ignored, as a later version may have added them.

    Parameters
    ----------
    cls : a dataclass whose fields are bool, int, float, str, Any, Mapping, Literal, dataclasses,
        tuples of one of these, or one of these or None
    values : the parsed JSON
    name : what the sentence calls the object

    Raises
    ------
    ValueError : a value is missing, of another type, not finite, or beyond 64 bits.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{name} must be an object, got {quoted(values)}")
    given = {}
    for field_name, (hint, required) in _field_hints(cast(Any, cls)).items():
        if field_name in values:
            given[field_name] = _converted(values[field_name], hint, f"{name}.{field_name}")
        elif required:
            raise ValueError(f"{name} lacks {field_name}")
    return cls(**given)


def quoted(value: object) -> str:
    """Return a value for use in a message: its Python form, shortened."""
    text = repr(value)
    return text if len(text) <= _QUOTED_LENGTH else f"{text[: _QUOTED_LENGTH - 3]}..."


@cache
def _field_hints(cls: type[Any]) -> dict[str, tuple[Any, bool]]:
    """Return each field's type, and whether it has no default."""
    hints = get_type_hints(cls)
    return {
        field.name: (
            hints[field.name],
            field.default is MISSING and field.default_factory is MISSING,
        )
        for field in fields(cls)
    }


def _converted(value: Any, hint: Any, name: str) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, UnionType):
        if value is None and NoneType in arguments:
            return None
        (hint,) = (argument for argument in arguments if argument is not NoneType)
        return _converted(value, hint, name)
    if origin is tuple and isinstance(value, list | tuple):
        return tuple(_converted(one, arguments[0], f"{name}[{i}]") for i, one in enumerate(value))
    if origin is Literal and isinstance(value, str) and value in arguments:
        return value
    if origin is Mapping and isinstance(value, Mapping):
        return value
    if is_dataclass(hint):
        return from_json(cast(type[Any], hint), value, name)
    if hint is bool and isinstance(value, bool):
        return value
    if hint is int and type(value) is int and -(2**63) <= value < 2**63:
        return value
    if hint is float and type(value) in (int, float) and abs(value) < math.inf:
        # Whole numbers of JSON have any length.
        return float(value) if abs(value) < 2**1023 else _refuse(value, hint, name)
    if hint is str and isinstance(value, str):
        # A lone surrogate, from an undecodable file name, cannot be printed.
        return value.encode(errors="replace").decode()
    return _refuse(value, hint, name)


_WORDS = {bool: "true or false", int: "a whole number", float: "a finite number", str: "a text"}


def _refuse(value: Any, hint: Any, name: str) -> NoReturn:
    if get_origin(hint) is Literal:
        needed = f"one of {', '.join(map(repr, get_args(hint)))}"
    else:
        needed = _WORDS.get(hint) or ("a list" if get_origin(hint) is tuple else "an object")
    raise ValueError(f"{name} must be {needed}, got {quoted(value)}")


def _refuse_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is not a JSON number")
