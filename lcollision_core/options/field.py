"""What people read of a field of options, and its limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from lcollision_core.errors import LCollisionError


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What the number in a field of a dataclass must be, in the `Annotated` of its type.

    Attributes
    ----------
    low, high : limits that it may have
    above, below : limits that it may not have
    """

    low: float | None = None
    high: float | None = None
    above: float | None = None
    below: float | None = None


@dataclass(frozen=True)
class Option(Limits):
    """What people read of a field, and its limits.

    Attributes
    ----------
    help : a sentence or two
    names : on the command line; that of the field by default
    metavar : stands for the value there
    choices : the only values
    words : the value is the index of one of these, which people read
    """

    help: str
    names: tuple[str, ...] = ()
    metavar: str | None = None
    choices: tuple[str, ...] = ()
    words: tuple[str, ...] = ()


@cache
def limits_of(cls: Any) -> dict[str, tuple[Any, Limits]]:
    """Return the type and the limits, or the option, of each field that has some, by name."""
    hints = get_type_hints(cls, include_extras=True)
    found = {}
    for field in fields(cls):
        hint = hints[field.name]
        if get_origin(hint) is Annotated and isinstance(get_args(hint)[1], Limits):
            found[field.name] = get_args(hint)[:2]
    return found


def require_limits(values: Any) -> None:
    """Refuse a value of a dataclass that is beyond its limits or none of its choices.

    Raises
    ------
    LCollisionError : naming the first of them.
    """
    cls: Any = type(values)
    for name, (_, limits) in limits_of(cls).items():
        value = getattr(values, name)
        if value is not None and (expected := _not_met(value, limits)):
            said = f"the {name.replace('_', ' ')}" if isinstance(limits, Option) else name
            got = f"{value:g}" if isinstance(value, float) else value
            raise LCollisionError.must_be(said, expected, got)


def _not_met(value: Any, limits: Limits) -> str:
    """Return what a value must be and is not, "" if it is all."""
    if isinstance(limits, Option) and (limits.choices or limits.words):
        allowed: tuple[Any, ...] = limits.choices or tuple(range(len(limits.words)))
        return "" if value in allowed else ", ".join(map(str, allowed))
    if not isinstance(value, int | float):
        return ""
    met = {
        f"at least {limits.low}": limits.low is None or value >= limits.low,
        f"at most {limits.high}": limits.high is None or value <= limits.high,
        f"over {limits.above}": limits.above is None or value > limits.above,
        f"below {limits.below}": limits.below is None or value < limits.below,
        "finite": math.isfinite(value),
    }
    return next((expected for expected, is_met in met.items() if not is_met), "")
