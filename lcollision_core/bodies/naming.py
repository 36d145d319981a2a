"""Readable names of the domains."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.files.names import numbered_where_equal

MAX_NAME_LENGTH = 60
MAX_POSE_NAME_LENGTH = 200

_MAIN_SHARE = 0.6
"""Fraction of a domain's weight with which a labelled part names the domain alone."""
_SECOND_SHARE = 0.2
"""Fraction of a domain's weight that a second part needs to be named."""
_SAME_SHARE = 0.5
"""Fraction of the other side's weight; with more, a domain belongs to both sides."""


def numbered_names(n_domains: int) -> tuple[str, ...]:
    """Return "part 1" to "part K"."""
    return tuple(f"part {domain + 1}" for domain in range(n_domains))


def names_from_labels(
    attention_mask: npt.NDArray[Any],
    vertex_labels: npt.NDArray[np.str_],
    levels: npt.NDArray[Any],
) -> tuple[str, ...]:
    """Name each domain after the body parts that its mask covers.

    Parts count by the squares of the mask's weights: the core of a domain, not its border.
    The leading part names it; where that has less than 60 %, a second part with at least 20 %
    joins it, as in "left forearm & hand". A left and a right part of similar weight count as one,
    "thighs", and the two sides of the body are named symmetrically. Domains that would share
    a name take their second part too and, if that does not help, a position: "upper left thigh".

    Parameters
    ----------
    attention_mask : (K, V) array
    vertex_labels : (V,) strings that are not blank, such as "left forearm"
    levels : (V,) array, each vertex's coordinate along the up axis, in any unit

    Returns
    -------
    names : K different names of at most `MAX_NAME_LENGTH` characters
    """
    parts, part_of_vertex = np.unique(np.char.strip(vertex_labels), return_inverse=True)
    ranked = []
    for row in np.asarray(attention_mask, dtype=np.float64):
        weights = np.bincount(part_of_vertex, row**2, len(parts))
        shares = weights / max(float(weights.sum()), np.finfo(float).tiny)
        ranked.append(_ranked_parts(dict(zip(parts.tolist(), shares.tolist(), strict=True))))

    def name(parts_of_domain: list[tuple[str, float]], with_second: bool) -> str:
        first = parts_of_domain[0][0]
        if not with_second or len(parts_of_domain) == 1:
            return first
        second, share = parts_of_domain[1]
        return join_names(first, second) if share >= _SECOND_SHARE else first

    needs_second = {found[0][0] for found in ranked if found[0][1] < _MAIN_SHARE}
    names = [
        name(found, bool({found[0][0], _other_side(found[0][0])} & needs_second))
        for found in ranked
    ]
    shared = _shared(names)
    names = [
        name(found, True) if first in shared else first
        for first, found in zip(names, ranked, strict=True)
    ]
    mass = np.maximum(attention_mask.sum(axis=1), np.finfo(float).tiny)
    return _with_positions(names, attention_mask @ levels / mass)


def join_names(first: str, second: str) -> str:
    """Join two parts' names without repeating what they share: "left forearm & hand"."""
    words, others = first.split(), second.split()
    if words[0] == others[0]:
        return f"{first} & {' '.join(others[1:])}" if len(others) > 1 else first
    return f"{first} & {second}"


def _ranked_parts(shares: dict[str, float]) -> list[tuple[str, float]]:
    """Return parts with their fractions, largest first; similar sides of a part are merged."""
    merged = dict(shares)
    for part, left in shares.items():
        stem = part.removeprefix("left ")
        right = shares.get(f"right {stem}", 0.0)
        if stem != part and min(left, right) > _SAME_SHARE * max(left, right):
            del merged[part], merged[f"right {stem}"]
            merged[_plural(stem)] = left + right
    return sorted(merged.items(), key=lambda item: -item[1])


def _other_side(part: str) -> str:
    side, _, stem = part.partition(" ")
    other = {"left": "right", "right": "left"}.get(side, side)
    return f"{other} {stem}".strip()


def _plural(part: str) -> str:
    if part.endswith("foot"):
        return f"{part.removesuffix('foot')}feet"
    return part if part.endswith("s") else f"{part}s"


def unique_names(names: Iterable[str], max_length: int = MAX_POSE_NAME_LENGTH) -> list[str]:
    """Return the names, numbered where an earlier one differs by case at most: "a", "A 2".

    Numbered names are at most `max_length` long.
    """
    return numbered_where_equal(
        names, str.casefold, lambda name, ending: name[: max_length - len(ending)] + ending
    )


def _shared(names: Sequence[str]) -> set[str]:
    return {name for name, count in Counter(names).items() if count > 1}


def _with_positions(names: list[str], levels: npt.NDArray[Any]) -> tuple[str, ...]:
    """Add "upper", "lower" and so on to equal names, from top to bottom."""
    places = {2: ("upper", "lower"), 3: ("upper", "middle", "lower")}
    for shared in sorted(_shared(names)):
        domains = [k for k, name in enumerate(names) if name == shared]
        domains.sort(key=lambda k: -levels[k])
        for rank, domain in enumerate(domains):
            words = places.get(len(domains))
            names[domain] = f"{words[rank]} {shared}" if words else f"{shared} {rank + 1}"
    return tuple(unique_names((name[:MAX_NAME_LENGTH].rstrip() for name in names), MAX_NAME_LENGTH))
