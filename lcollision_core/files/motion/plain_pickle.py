"""Read NumPy's pickled arrays without running any code that they refer to.

A pickle may only contain arrays, dicts, lists, strings and numbers. No NumPy class is instantiated
while reading: arrays stay bytes until their dtype is known to be plain.
"""

from __future__ import annotations

import io
import pickle
import re
from typing import Any

import numpy as np
import numpy.typing as npt

_PLAIN = re.compile(r"[<>|=]?(f[248]|[iu][1248]|b1|[US]\d{1,6})")


class _Type:
    """A pickled dtype."""

    def __init__(self, code: str, *_: object) -> None:
        self.code, self.order = str(code), "|"

    def __setstate__(self, state: Any) -> None:
        self.order = str(state[1])

    def plain(self) -> np.dtype[Any]:
        text = f"{'' if self.order == '|' else self.order}{self.code}"
        if not _PLAIN.fullmatch(text):
            raise pickle.UnpicklingError(f"it holds values of the type {self.code!r}")
        return np.dtype(text)


class _Array:
    """A pickled array."""

    state: Any = None

    def __init__(self, *_: object) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def value(self) -> Any:
        _, shape, kind, is_fortran, content = self.state
        if isinstance(content, list):
            values = [_value(item) for item in content]
            return values[0] if tuple(shape) == () else values
        flat: npt.NDArray[Any] = np.frombuffer(content, kind.plain())
        return flat.reshape(shape, order="F" if is_fortran else "C")


def _scalar(kind: _Type, held: bytes) -> Any:
    return np.frombuffer(held, kind.plain())[0].item()


def _from_text(text: str, encoding: str) -> bytes:
    if encoding != "latin1":
        raise pickle.UnpicklingError("it has text where bytes are expected")
    return text.encode("latin1")


_KNOWN = {
    "ndarray": _Array,
    "_reconstruct": _Array,
    "dtype": _Type,
    "scalar": _scalar,
    "encode": _from_text,
}
_MODULES = re.compile(r"numpy(\._?core\.multiarray)?|_codecs")


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if _MODULES.fullmatch(module) and name in _KNOWN:
            return _KNOWN[name]
        raise pickle.UnpicklingError(
            f"it holds Python objects ({module}.{name}), which are not run"
        )

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError(f"it refers to another file ({pid!r})")


def read_plain_pickle(data: bytes) -> Any:
    """Return the dicts, lists, strings, numbers and arrays of a pickle.

    Raises
    ------
    ValueError : it is damaged, or contains anything else; no code of it was run.
    """
    try:
        return _value(_Unpickler(io.BytesIO(data)).load())
    except Exception as error:
        # Damaged pickles raise errors of any kind.
        raise ValueError(str(error) or type(error).__name__) from error


def _value(held: Any) -> Any:
    if isinstance(held, _Array):
        return held.value()
    if isinstance(held, dict):
        return {str(key): _value(item) for key, item in held.items()}
    if isinstance(held, list | tuple):
        return [_value(item) for item in held]
    if held is None or isinstance(held, str | bytes | bool | int | float):
        return held
    raise pickle.UnpicklingError(f"it holds a {type(held).__name__}")
