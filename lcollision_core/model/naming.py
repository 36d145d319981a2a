"""What a person would call each domain."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import ModelFileError

MAX_NAME_LENGTH = 60

_MAIN_SHARE = 0.6
"""Of a domain's weight: a body part with as much names the domain alone."""
_SECOND_SHARE = 0.2
"""Of a domain's weight: a second part with less is not worth naming."""


# What people call the bones of a trunk.
_PLAIN_WORDS = {
    "collar": "shoulder",
    "lumbar": "waist",
    "neck": "neck",
    "pelvis": "hips",
    "thorax": "chest",
}


def numbered_names(n_domains: int) -> tuple[str, ...]:
    """Return "part 1" to "part K"."""
    return tuple(f"part {domain + 1}" for domain in range(n_domains))


def names_from_labels(
    attention_mask: npt.NDArray[Any],
    vertex_labels: npt.NDArray[np.str_],
    heights: npt.NDArray[Any],
) -> tuple[str, ...]:
    """Name each domain after the body parts that its mask covers.

    The part with most of the mask's weight gives the name; where it has less than 60 %, a second
    part with at least 20 % joins it, as in "left forearm & hand". Domains that would share a name
    take their second part too, and where that does not help, their place: "upper left thigh".

    Parameters
    ----------
    attention_mask : (K, V) array
    vertex_labels : (V,) strings, such as "left forearm"; of a built-in body its bones, whose
        names are put in plain words: "thorax 2" is "chest"
    heights : (V,) array, each vertex's coordinate along the up axis, in any unit

    Returns
    -------
    names : K different names
    """
    parts, part_of_label = np.unique(vertex_labels, return_inverse=True)
    labels, label_of_part = np.unique([plain_words(part) for part in parts], return_inverse=True)
    index = label_of_part[part_of_label].astype(np.int64)
    weights = np.stack([np.bincount(index, row, len(labels)) for row in attention_mask])
    shares = weights / np.maximum(weights.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    order = np.argsort(-shares, axis=1, kind="stable")

    def name(domain: int, with_second: bool) -> str:
        first = str(labels[order[domain, 0]])
        if len(labels) == 1 or not with_second:
            return first
        second = order[domain, 1]
        if shares[domain, second] < _SECOND_SHARE:
            return first
        return join_names(first, str(labels[second]))

    n_domains = len(attention_mask)
    names = [
        name(domain, bool(shares[domain, order[domain, 0]] < _MAIN_SHARE))
        for domain in range(n_domains)
    ]
    shared = _shared(names)
    names = [name(k, True) if names[k] in shared else names[k] for k in range(n_domains)]
    mass = np.maximum(attention_mask.sum(axis=1), np.finfo(float).tiny)
    return _told_apart(names, attention_mask @ heights / mass)


def plain_words(bone: str) -> str:
    """Return what a person calls the part round a bone: "left thigh end" is "left thigh"."""
    side = next((side for side in ("left ", "right ") if bone.startswith(side)), "")
    name = bone.removeprefix(side).removesuffix(" end")
    return side + _PLAIN_WORDS.get(re.sub(r" [0-9]+$", "", name), name)


def join_names(first: str, second: str) -> str:
    """Join two parts' names without repeating what they share: "left forearm & hand"."""
    words, others = first.split(), second.split()
    if words[0] == others[0]:
        return f"{first} & {' '.join(others[1:])}" if len(others) > 1 else first
    if words[1:] == others[1:] and {words[0], others[0]} == {"left", "right"}:
        return " ".join(["left & right", *words[1:]])
    return f"{first} & {second}"


def checked_name(name: str, taken: Sequence[str]) -> str:
    """Return a name without the spaces round it, if a domain may bear it.

    Raises
    ------
    ModelFileError : it is empty, longer than `MAX_NAME_LENGTH`, not printable, or taken.
    """
    stripped = name.strip()
    if not stripped or len(stripped) > MAX_NAME_LENGTH or not stripped.isprintable():
        raise ModelFileError(
            f"{name[:80]!r} cannot name a domain; use 1 to {MAX_NAME_LENGTH} printable characters"
        )
    if stripped in taken:
        raise ModelFileError(f"another domain is already called {stripped!r}; choose another name")
    return stripped


def _shared(names: Sequence[str]) -> set[str]:
    return {name for name, count in Counter(names).items() if count > 1}


def _told_apart(names: list[str], levels: npt.NDArray[Any]) -> tuple[str, ...]:
    """Give domains of one name their places from top to bottom."""
    places = {2: ("upper", "lower"), 3: ("upper", "middle", "lower")}
    for shared in sorted(_shared(names)):
        domains = [k for k, name in enumerate(names) if name == shared]
        domains.sort(key=lambda k: -levels[k])
        for rank, domain in enumerate(domains):
            words = places.get(len(domains))
            names[domain] = f"{words[rank]} {shared}" if words else f"{shared} {rank + 1}"
    return tuple(names)
