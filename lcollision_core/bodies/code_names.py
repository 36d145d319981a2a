"""What each code of a latent pose does to the body, in words: "left thigh forward", "twist"."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.naming import unique_names

FloatArray = npt.NDArray[np.float64]

_CHUNK = 32
"""Poses that are decoded together: memory stays small for large meshes."""
_STEP = 0.5
"""Fraction of a code's range above zero where its effect is measured."""
_AIMLESS = 0.5
"""Of what a code moves, as sums of squares: with less as one shift, a turn or a bend names it."""
_OWN = 0.25
"""Of the largest domain's motion: a domain that moves as much is what its own code moves."""
_TINY = 1e-12

_REGIONS = (
    (r"\b(thumb|index|middle|ring|pinky|pinkie|little)\b", "finger"),
    (r"\bfinger", "hand"),
    (r"\btoes?\b", "foot"),
    (r"clavicle|collar|scapula", "shoulder"),
    (r"shoulder|forearm|\bhand|wrist", "arm"),
    (r"forearm", "elbow"),
    (r"\bhand", "wrist"),
    (r"thigh|shin|calf|knee|\bfoot|\bfeet|ankle", "leg"),
    (r"thigh", "hip"),
    (r"shin|calf", "knee"),
    (r"\bfoot|\bfeet", "ankle"),
    (r"spine|torso|chest|belly|abdomen|waist|neck", "spine trunk"),
    (r"\b(face|eyes?|jaw|chin|brow|tongue)\b", "head"),
)
"""Words by which people look for what is called otherwise; each may lead to the next."""

_WAYS = (("up", "down"), ("forward", "back"), ("left", "right"))
_ASIDE = 2


@dataclass(frozen=True)
class CodeEffect:
    """What raising one code does.

    Attributes
    ----------
    domain : index from 0 of the domain that the name refers to: in the first group, where each
        domain has one code, that domain, however far it moves what is attached to it; in a domain's
        group that domain, unless the code mainly moves another
    motion : "up", "down", "forward", "back", "left" or "right" for a shift of that domain, "in" or
        "out" for the last two of one that lies on one side of the body; "bend up" and so on where
        it turns, after its far end; "twist" about its long axis; "still" where nothing moves
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
    """Measure what each code does about the pose of zeros.

    Parameters
    ----------
    decode : turns (B, D) latent poses into (B, V, 3) vertices
    high : (D,) array, the upper end of each code's range, above 0
    attention_mask : (K, V) array, each column sums to 1
    group_sizes : 1 + K sizes of the latent's groups, which sum to D
    up_axis : 0, 1 or 2
    front : (3,) array, horizontal, the direction that the body faces

    Returns
    -------
    effects : D of them

    Notes
    -----
    What moves as the code goes from 0 to half of its range is weighted by the squares of the mask:
    the core of a domain, not its border. The leading domain's motion is split into a shift, a
    turn about its middle, by least squares, and what is left.
    """
    up = np.eye(3)[up_axis]
    axes = np.stack([up, front, np.cross(up, front)])
    weights = np.asarray(attention_mask, dtype=np.float64) ** 2
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), _TINY)
    domains = np.arange(len(weights))
    own = np.concatenate([domains, np.repeat(domains, group_sizes[1:])])
    positions = decode(np.zeros((1, len(high))))[0]
    effects: list[CodeEffect] = []
    for start in range(0, len(high), _CHUNK):
        codes = np.arange(start, min(start + _CHUNK, len(high)))
        poses = np.zeros((len(codes), len(high)))
        poses[codes - start, codes] = _STEP * high[codes]
        moved = decode(poses) - positions
        effects.extend(
            _effect(
                motion, positions, weights, axes, own[code], _OWN if code >= len(domains) else 0.0
            )
            for code, motion in zip(codes, moved, strict=True)
        )
    return tuple(effects)


def code_names(
    effects: Sequence[CodeEffect], domain_names: Sequence[str], group_sizes: Sequence[int]
) -> tuple[str, ...]:
    """Name the codes after what they do; names within a group differ.

    Parameters
    ----------
    effects : D, in the latent's order
    domain_names : K names
    group_sizes : 1 + K sizes that sum to D

    Returns
    -------
    names : D names: in the first group of the domain and its motion, "left thigh forward"; in a
        domain's own of the motion, with the domain's name only where another one moves more. The
        second of two that are alike is "forward 2".
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
    """Return a name in small letters, with the general words for its region of the body.

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
    # A domain lies on one side where it hardly reaches over the middle.
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
    # The far end of a limb points away from the body's middle, that of the trunk is its top.
    away = long_axis @ (weight @ positions - positions.mean(axis=0))
    half_length = np.sqrt(3.0 * long_axis @ spread @ long_axis)
    outward = long_axis * np.sign((away if abs(away) > half_length else axes[0] @ long_axis) or 1)
    return CodeEffect(domain, f"bend {way_in_words(axes @ np.cross(turn, outward), side)}")


def way_in_words(along: FloatArray, side: float) -> str:
    """Return the word for the largest component of a direction.

    Parameters
    ----------
    side : 1 for what lies on the body's left, -1 on its right, 0 in the middle
    """
    way = int(np.abs(along).argmax())
    if way == _ASIDE and side != 0.0:
        return "out" if along[way] * side > 0.0 else "in"
    return _WAYS[way][int(along[way] < 0.0)]
