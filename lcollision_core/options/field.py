"""What people read of a field of options, and its limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from lcollision_core.errors import LCollisionError


@dataclass(frozen=True)
class Option:
    """What is said of a field of a dataclass, in the `Annotated` of its type.

    Attributes
    ----------
    help : a sentence or two
    names : on the command line; that of the field by default
    metavar : stands for the value there
    low, high : limits of a number that it may have
    above, below : limits that it may not have
    choices : the only values
    words : the value is the index of one of these, which people read
    """

    help: str
    names: tuple[str, ...] = ()
    metavar: str | None = None
    low: float | None = None
    high: float | None = None
    above: float | None = None
    below: float | None = None
    choices: tuple[str, ...] = ()
    words: tuple[str, ...] = ()


@cache
def options_of(cls: Any) -> dict[str, tuple[Any, Option]]:
    """Return the type and the option of each field of a dataclass that has one, by name."""
    hints = get_type_hints(cls, include_extras=True)
    found = {}
    for field in fields(cls):
        hint = hints[field.name]
        if get_origin(hint) is Annotated and isinstance(get_args(hint)[1], Option):
            found[field.name] = get_args(hint)[:2]
    return found


def require_limits(options: Any) -> None:
    """Refuse a value of some options that is beyond its limits or none of its choices.

    Raises
    ------
    LCollisionError : naming the first of them.
    """
    for name, (_, option) in options_of(type(options)).items():
        value = getattr(options, name)
        if value is not None and (expected := _not_met(value, option)):
            got = f"{value:g}" if isinstance(value, float) else value
            raise LCollisionError.must_be(f"the {name.replace('_', ' ')}", expected, got)


def _not_met(value: Any, option: Option) -> str:
    """Return what a value must be and is not, "" if it is all."""
    allowed: tuple[Any, ...] = option.choices or tuple(range(len(option.words)))
    if allowed:
        return "" if value in allowed else ", ".join(map(str, allowed))
    if not isinstance(value, int | float):
        return ""
    limits = {
        f"{option.low} or more": option.low is None or value >= option.low,
        f"at most {option.high}": option.high is None or value <= option.high,
        f"above {option.above}": option.above is None or value > option.above,
        f"below {option.below}": option.below is None or value < option.below,
        "finite": math.isfinite(value),
    }
    return next((expected for expected, is_met in limits.items() if not is_met), "")
