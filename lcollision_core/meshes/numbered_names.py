"""Names made different by numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable


def numbered_where_equal(
    names: Iterable[str],
    key: Callable[[str], str] = str,
    joined: Callable[[str, str], str] = str.__add__,
) -> list[str]:
    """Return names of which no two have the same key: a later one gets a number, " 2", behind it.

    Parameters
    ----------
    names : any
    key : from a name to what must differ, such as the name in small letters
    joined : puts an ending behind a name, which may have to be shortened for that
    """
    taken: set[str] = set()
    counts: Counter[str] = Counter()
    result = []
    for name in names:
        candidate, base = name, key(name)
        while (found := key(candidate)) in taken:
            counts[base] += 1
            candidate = joined(name, f" {counts[base] + 1}")
        taken.add(found)
        result.append(candidate)
    return result
