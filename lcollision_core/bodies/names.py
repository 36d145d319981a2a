"""Names of body parts, codes and poses, and colours of body parts."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bundled import bundled_table
from lcollision_core.files.safe import make_unique
from lcollision_core.meshes.topology import FloatArray

MAX_NAME_LENGTH = 60
BETWEEN_BODIES = " + "
"""Joins the names of a scene's bodies."""

MAX_POSE_NAME_LENGTH = 200

_MAIN_SHARE = 0.6
"""Share of a domain's weight above which a labelled part names the domain alone."""
_SECOND_SHARE = 0.2
"""Share of a domain's weight that a second part needs to be named."""
_SAME_SHARE = 0.5
"""Ratio of the two sides' weights above which a domain belongs to both sides."""


def names_from_labels(
    attention_mask: npt.NDArray[Any],
    vertex_labels: npt.NDArray[np.str_],
    levels: npt.NDArray[Any],
) -> tuple[str, ...]:
    """Name each domain after the body parts that its mask covers.

    Parts are weighted by the squared mask: the core of a domain counts, not its border. The leading
    part names the domain; if it has less than 60 %, a second part with at least 20 % joins it, as
    in "left forearm & hand". A left and a right part of similar weight count as one, "thighs", and
    the two sides of the body are named symmetrically. Domains with equal names also take their
    second part and, if that does not help, a position: "upper left thigh".

    Parameters
    ----------
    attention_mask : (K, V) array
    vertex_labels : (V,) non-blank strings, such as "left forearm"
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

    needs_second = {label[0][0] for label in ranked if label[0][1] < _MAIN_SHARE}
    names = [
        name(label, bool({label[0][0], _other_side(label[0][0])} & needs_second))
        for label in ranked
    ]
    shared = _shared(names)
    names = [
        name(label, True) if first in shared else first
        for first, label in zip(names, ranked, strict=True)
    ]
    mass = np.maximum(attention_mask.sum(axis=1), np.finfo(float).tiny)
    return _with_positions(names, attention_mask @ levels / mass)


def join_names(first: str, second: str) -> str:
    """Join two parts' names without repeating a common first word: "left forearm & hand"."""
    words, others = first.split(), second.split()
    if words[0] == others[0]:
        return f"{first} & {' '.join(others[1:])}" if len(others) > 1 else first
    return f"{first} & {second}"


def _ranked_parts(shares: dict[str, float]) -> list[tuple[str, float]]:
    """Return parts with their shares, largest first; similar sides of a part are merged."""
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
    """Return the names, numbered if equal to an earlier one up to case: "a", "A 2".

    They are cut to `max_length` characters.
    """
    return make_unique(
        (name[:max_length] for name in names),
        str.casefold,
        lambda name, ending: name[: max_length - len(ending)] + ending,
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


_CHUNK = 32
"""Poses decoded at once; limits the memory for large meshes."""
_STEP = 0.5
"""Share of a code's range above zero at which its effect is measured."""
_AIMLESS = 0.5
"""Share of the squared motion below which a turn or a bend names a code, not a shift."""
_OWN = 0.25
"""Share of the largest domain's motion from which a code is named after its own domain."""
_TINY = 1e-12

_TABLES = bundled_table("body_parts.toml", dict[str, Any])
_REGIONS, PALETTE = _TABLES["regions"], _TABLES["palette"]

_WAYS = (("up", "down"), ("forward", "back"), ("left", "right"))
_ASIDE = 2


@dataclass(frozen=True)
class CodeEffect:
    """The effect of raising one code.

    Attributes
    ----------
    domain : index from 0 of the domain that the name refers to: in the first group, where each
        domain has one code, that domain, however far it moves attached parts; in a domain's
        group that domain, unless the code mainly moves another
    motion : "up", "down", "forward", "back", "left" or "right" if the domain shifts, with "in" and
        "out" for the last two in a domain on one side of the body; "bend up" and so on, by the
        motion of its far end, if it turns; "twist" about its long axis; "still" if nothing moves
    """

    domain: int
    motion: str


def code_effects(
    decode: Callable[[FloatArray], FloatArray],
    high: npt.NDArray[np.float64],
    attention_mask: npt.NDArray[np.float32],
    group_sizes: Sequence[int],
    up_axis: int,
    front: FloatArray,
) -> tuple[CodeEffect, ...]:
    """Measure the effect of each code about the zero pose.

    Parameters
    ----------
    decode : maps (B, D) latent poses to (B, V, 3) vertices
    high : (D,) array > 0, the upper end of each code's range
    attention_mask : (K, V) array, each column sums to 1
    group_sizes : 1 + K sizes of the latent groups, which sum to D
    up_axis : 0, 1 or 2
    front : (3,) array, horizontal, the direction that the body faces

    Returns
    -------
    effects : D effects

    Notes
    -----
    The motion as the code goes from 0 to half of its range is weighted by the squared mask: the
    core of a domain counts, not its border. The leading domain's motion is split by least squares
    into a shift, a turn about its centre, and a remainder.
    """
    up = np.eye(3)[up_axis]
    axes = np.stack([up, front, np.cross(up, front)])
    weights = np.asarray(attention_mask, dtype=np.float64) ** 2
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), _TINY)
    domains = np.arange(len(weights))
    domain_of_code = np.concatenate([domains, np.repeat(domains, group_sizes[1:])])
    positions = decode(np.zeros((1, len(high))))[0]
    effects: list[CodeEffect] = []
    for start in range(0, len(high), _CHUNK):
        codes = np.arange(start, min(start + _CHUNK, len(high)))
        poses = np.zeros((len(codes), len(high)))
        poses[codes - start, codes] = _STEP * high[codes]
        moved = decode(poses) - positions
        effects.extend(
            _effect(
                motion,
                positions,
                weights,
                axes,
                domain_of_code[code],
                _OWN if code >= len(domains) else 0.0,
            )
            for code, motion in zip(codes, moved, strict=True)
        )
    return tuple(effects)


def code_names(
    effects: Sequence[CodeEffect], domain_names: Sequence[str], group_sizes: Sequence[int]
) -> tuple[str, ...]:
    """Name the codes after their effects; names within a group differ.

    Parameters
    ----------
    effects : D, in the latent's order
    domain_names : K names
    group_sizes : 1 + K sizes that sum to D

    Returns
    -------
    names : D names: in the first group domain and motion, "left thigh forward"; in a domain's own
        group the motion, with a domain's name only if another one moves more. The second of two
        equal names is "forward 2".
    """
    names: list[str] = []
    for group, size in enumerate(group_sizes):
        names += unique_names(
            effect.motion
            if effect.domain == group - 1 or effect.motion == "still"
            else f"{domain_names[effect.domain]} {effect.motion}"
            for effect in effects[len(names) : len(names) + size]
        )
    return tuple(names)


def with_regions(name: str) -> str:
    """Return a name in lower case, with general words for its region of the body.

    Examples
    --------
    >>> with_regions("Ring 1 bend")
    'ring 1 bend finger hand arm wrist'
    """
    words = name.casefold()
    for pattern, region in _REGIONS:
        if re.search(pattern, words):
            words += f" {region}"
    return words


def _effect(
    moved: FloatArray,
    positions: FloatArray,
    weights: FloatArray,
    axes: FloatArray,
    own: np.intp,
    least_share: float,
) -> CodeEffect:
    motion = weights @ (moved**2).sum(axis=1)
    domain = int(motion.argmax())
    if motion[own] >= least_share * motion[domain]:
        domain = int(own)
    weight = weights[domain]
    total = float(weight @ (moved**2).sum(axis=1))
    if total <= _TINY * float(weight @ (positions**2).sum(axis=1)):
        return CodeEffect(domain, "still")
    arms = positions - weight @ positions
    # A domain lies on one side if it hardly reaches across the middle.
    aside = float(axes[2] @ (weight @ positions - positions.mean(axis=0)))
    side = np.sign(aside) if abs(aside) > np.sqrt(weight @ (arms @ axes[2]) ** 2) else 0.0
    shift = weight @ moved
    if float(shift @ shift) >= _AIMLESS * total:
        return CodeEffect(domain, way_in_words(axes @ shift, side))
    spread = (weight[:, None] * arms).T @ arms
    inertia = np.trace(spread) * np.eye(3) - spread
    torque = weight @ np.cross(arms, moved - shift)
    turn = np.linalg.lstsq(inertia, torque, rcond=1e-9)[0]
    long_axis = np.linalg.eigh(spread)[1][:, -1]
    twist = (turn @ long_axis) * long_axis

    def size(rotation: FloatArray) -> float:
        return float(weight @ (np.cross(rotation, arms) ** 2).sum(axis=1))

    if size(twist) > size(turn - twist):
        return CodeEffect(domain, "twist")
    # A limb's far end points away from the body's centre; the trunk's is its top.
    away = long_axis @ (weight @ positions - positions.mean(axis=0))
    half_length = np.sqrt(3.0 * long_axis @ spread @ long_axis)
    outward = long_axis * np.sign((away if abs(away) > half_length else axes[0] @ long_axis) or 1)
    return CodeEffect(domain, f"bend {way_in_words(axes @ np.cross(turn, outward), side)}")


def way_in_words(along: FloatArray, side: float) -> str:
    """Return the word for the largest component of a direction.

    Parameters
    ----------
    side : 1 if it lies on the body's left, -1 on its right, 0 in the middle
    """
    way = int(np.abs(along).argmax())
    if way == _ASIDE and side != 0.0:
        return "out" if along[way] * side > 0.0 else "in"
    return _WAYS[way][int(along[way] < 0.0)]


_MOST_ARRANGED = 3 * len(PALETTE)
"""Most domains whose colours are rearranged; with more, neighbours share a colour anyway."""

_XYZ_OF_RGB = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)
_D65 = np.array([0.9505, 1.0, 1.089])


def domain_colours(attention_mask: npt.NDArray[Any]) -> tuple[str, ...]:
    """Choose a colour for each domain, with different hues where domains meet.

    Parameters
    ----------
    attention_mask : (K, V) array

    Returns
    -------
    colours : K strings "#rrggbb", all different for up to 16

    Notes
    -----
    Weights are drawn as tints, so a pale colour must not pass for a neighbour's full one: only
    CIELAB hue and chroma count. Colours are swapped between domains while that reduces the sum
    of overlaps over squared distances. Above `_MOST_ARRANGED` domains, they are taken in order.
    """
    n_domains = len(attention_mask)
    colours = [PALETTE[domain % len(PALETTE)] for domain in range(n_domains)]
    if n_domains > _MOST_ARRANGED:
        return tuple(colours)
    chroma = np.array([cielab(colour)[1:] for colour in colours])
    likeness = 1.0 / (((chroma[:, None] - chroma) ** 2).sum(axis=2) + 25.0)
    mask = np.asarray(attention_mask, dtype=np.float64)
    overlap = mask @ mask.T
    np.fill_diagonal(overlap, 0.0)
    order = np.arange(n_domains)
    while True:
        # How much the sum changes by each swap of two colours.
        arranged = likeness[np.ix_(order, order)]
        sums = overlap @ arranged
        change = sums - sums.diagonal() - overlap * (arranged.diagonal() - arranged)
        better = np.argwhere(np.triu(change + change.T) < -1e-12 * sums.max())
        if not len(better):
            return tuple(colours[colour] for colour in order)
        order[better[0]] = order[better[0, ::-1]]


def cielab(colour: str, sight: npt.NDArray[np.float64] | None = None) -> npt.NDArray[np.float64]:
    """Return the CIELAB lightness, a and b of "#rrggbb" under daylight (D65).

    Parameters
    ----------
    colour : sRGB
    sight : (3, 3) matrix on linear RGB, such as one that simulates colour blindness
    """
    rgb = np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    if sight is not None:
        linear = np.clip(sight @ linear, 0.0, 1.0)
    xyz = _XYZ_OF_RGB @ linear / _D65
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])
