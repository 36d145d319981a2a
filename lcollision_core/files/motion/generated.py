"""Motions as generators write them: arrays of joints' places, with their turns or without.

Kimodo's .npz files hold both. The joints of HumanML3D, a .npy file of (T, 22, 3) places, say no
turns: these are fitted, each joint turning as little as it can from the one before.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError
from lcollision_core.files.motion.node_motion import NodeMotion
from lcollision_core.files.safe import read_npz
from lcollision_core.files.scene.smpl import BODY_JOINTS, array_names
from lcollision_core.meshes.topology import FloatArray

_PLACES, _TURNS = "posed_joints", "global_rot_mats"
_KIMODO_RATE, _HUMANML_RATE = 30.0, 20.0
_LARGEST, _ROUNDED = 1e6, 1e-2
_MOST_BYTES = 1 << 30

_SMPL = dict(
    zip(
        BODY_JOINTS,
        (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19),
        strict=True,
    )
)
"""The parents of the 22 joints of SMPL's body."""


def _soma(fingers: dict[str, int], *, with_ends: bool) -> dict[str, int]:
    """Return the parents of SOMA's joints by their names: with so many joints of each finger."""
    parents: dict[str, int] = {}

    def chain(above: str, *names: str) -> None:
        for name in names:
            parents[name] = list(parents).index(above) if above else -1
            above = name

    chain("", "Hips", "Spine1", "Spine2", "Chest", "Neck1", "Neck2", "Head")
    for name in (*["HeadEnd"] * with_ends, "Jaw", "LeftEye", "RightEye"):
        chain("Head", name)
    for side in ("Left", "Right"):
        chain("Chest", *(f"{side}{name}" for name in ("Shoulder", "Arm", "ForeArm", "Hand")))
        for finger, n in fingers.items():
            names = [f"{side}Hand{finger}{number + 1}" for number in range(n)]
            chain(f"{side}Hand", *names, f"{side}Hand{finger}End")
    for side in ("Left", "Right"):
        names = ["Leg", "Shin", "Foot", "ToeBase", *["ToeEnd"] * with_ends]
        chain("Hips", *(f"{side}{name}" for name in names))
    return parents


_SKELETONS = {
    22: ("SMPL-X", _SMPL),
    30: ("SOMA", _soma({"Thumb": 0, "Middle": 0}, with_ends=False)),
    77: (
        "SOMA",
        _soma({"Thumb": 3, "Index": 4, "Middle": 4, "Ring": 4, "Pinky": 4}, with_ends=True),
    ),
}
"""By their number of joints, those that are known: what people call them, and their parents."""


def is_generated(path: str | os.PathLike[str]) -> bool:
    """Whether a file is one of these; it raises nothing."""
    suffix = Path(path).suffix.lower()
    return suffix == ".npy" or (suffix == ".npz" and {_PLACES, _TURNS} <= set(array_names(path)))


def holds_joints(path: str | os.PathLike[str]) -> bool:
    """Whether a .npy file is of the shape of joints that is read here; it raises nothing."""
    try:
        return _array(Path(path)).shape[1:] == (len(_SMPL), 3)
    except (MeshFileError, OSError, ValueError, EOFError):
        return False


def read_generated(path: str | os.PathLike[str]) -> NodeMotion:
    """Read a motion, in metres.

    Raises
    ------
    MeshFileError : the file is missing or damaged, or holds arrays of another kind; the sentence
        says what was expected.
    """
    try:
        if Path(path).suffix.lower() == ".npy":
            joints = _joints_alone(Path(path))
            n_frames, cut = _filled(joints)
            motion = _fitted(joints[:n_frames])
            return replace(motion, notes=(*motion.notes, *cut))
        arrays, _ = read_npz(Path(path), [(_PLACES,), (_TURNS,)])
        places = _usable(arrays[_PLACES], _PLACES)
        turns = _usable(arrays[_TURNS], _TURNS)
        known = _SKELETONS.get(places.shape[1]) if places.ndim == 3 else None
        if known is None or places.shape[2] != 3 or turns.shape != (*places.shape, 3):
            sizes = " or ".join(map(str, _SKELETONS))
            raise MeshFileError(
                f"{_PLACES!r} is {places.shape} and {_TURNS!r} {turns.shape}, expected (T, J, 3) "
                f"and (T, J, 3, 3) of Kimodo with J = {sizes} joints"
            )
        what, parents = known
        note = f"taken for a motion of Kimodo on the skeleton of {what}"
        n_frames, cut = _filled(places)
        places, turns = places[:n_frames], turns[:n_frames]
        if np.abs(turns @ np.swapaxes(turns, -1, -2) - np.eye(3)).max() > _ROUNDED:
            raise MeshFileError(f"{_TURNS!r} has matrices that are not rotations")
        return _motion(parents, places, turns, _KIMODO_RATE, (note, *cut))
    except (MeshFileError, OSError, ValueError, EOFError) as error:
        raise MeshFileError.unreadable(path, error, "export the motion again") from error


def _filled(places: FloatArray) -> tuple[int, tuple[str, ...]]:
    """Return how many frames there are before those that only fill (T, J, 3), and a note on them.

    Raises
    ------
    MeshFileError : there is none.
    """
    used = np.flatnonzero(np.ptp(places, axis=1).max(axis=1) > 0.0)
    if not len(used):
        raise MeshFileError("all its joints are in one place")
    n_frames = int(used[-1]) + 1
    n_filling = len(places) - n_frames
    cut = f"its last {n_filling} frames hold no figure and are left out"
    return n_frames, (cut,) if n_filling else ()


def _array(path: Path) -> npt.NDArray[Any]:
    """Return the array of a .npy file, which is read where it is used."""
    with path.open("rb") as file:
        if file.read(6) != b"\x93NUMPY":
            raise MeshFileError("it is no array of NumPy")
    array: npt.NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    return array


def _joints_alone(path: Path) -> FloatArray:
    if path.stat().st_size > _MOST_BYTES:
        raise MeshFileError("it is too large")
    expected = "(T, 22, 3), places of the joints of HumanML3D"
    try:
        array = _array(path)
    except ValueError as error:
        raise MeshFileError(
            f"it is damaged or holds Python objects, as MDM's results.npy; expected {expected}",
            "save one sample of its 'motion' as an array, frames first",
        ) from error
    if array.shape[1:] != (len(_SMPL), 3):
        raise MeshFileError(f"it is {array.shape}, expected {expected}")
    return _usable(array, "it")


def _usable(array: npt.NDArray[Any], name: str) -> FloatArray:
    if array.dtype.kind != "f" or not array.size:
        raise MeshFileError(f"{name!r} is {array.dtype} {array.shape}, expected floats by frame")
    floats: FloatArray = array.astype(np.float64)
    if not (np.abs(floats) <= _LARGEST).all():
        raise MeshFileError(f"{name!r} has numbers that cannot be used")
    return floats


def _motion(
    skeleton: dict[str, int],
    places: FloatArray,
    turns: FloatArray,
    rate: float,
    notes: tuple[str, ...],
) -> NodeMotion:
    """Return the motion of joints that have these places and turns in the world."""
    parents = np.array(list(skeleton.values()))
    seen, local = places.copy(), turns.copy()
    for joint, parent in enumerate(parents.tolist()):
        if parent >= 0:
            back = np.swapaxes(turns[:, parent], 1, 2)
            local[:, joint] = back @ turns[:, joint]
            seen[:, joint] = np.einsum("txy,ty->tx", back, places[:, joint] - places[:, parent])
    offsets = seen.mean(axis=0) * (parents >= 0)[:, None]
    axes = np.broadcast_to(np.eye(3), (len(parents), 3, 3)).copy()
    times, ends = np.arange(len(places)) / rate, np.full(offsets.shape, np.nan)
    names = tuple(skeleton)
    return NodeMotion("", names, parents, offsets, ends, axes, times, None, local, seen, notes)


def _fitted(places: FloatArray) -> NodeMotion:
    """Return a motion of SMPL's joints whose turns are fitted to their (T, 22, 3) places."""
    names, parents = list(_SMPL), np.array(list(_SMPL.values()))
    turns = np.broadcast_to(np.eye(3), (*places.shape, 3)).copy()
    for joint, parent in enumerate(parents.tolist()):
        below = np.flatnonzero(parents == joint)
        if parent >= 0:
            turns[:, joint] = turns[:, parent]
        if names[joint] in ("pelvis", "spine3"):
            # Its left, its right and its upper one.
            kinds = sorted(below.tolist(), key=lambda one: ("_" not in names[one], one))
            turns[:, joint] = _axes_of(*(places[:, one] for one in kinds))
        elif len(below):
            way = places[:, below[0]] - places[:, joint]
            at_rest = turns[:, joint] @ _rest_way(names[int(below[0])])
            turns[:, joint] = _least_turns(at_rest, way) @ turns[:, joint]
    motion = _motion(_SMPL, places, turns, _HUMANML_RATE, ())
    shown = places.copy()
    for joint, parent in enumerate(parents.tolist()):
        if parent >= 0:
            shown[:, joint] = shown[:, parent] + turns[:, parent] @ motion.offsets[joint]
    off = np.linalg.norm(shown - places, axis=2) / max(float(np.ptp(places[0], axis=0).max()), 1e-9)
    note = (
        "taken for the joints of HumanML3D, whose turns are fitted by inverse kinematics: joints "
        f"are {100.0 * off.mean():.2g} % of the figure's size off on average, "
        f"{100.0 * off.max():.2g} % at most"
    )
    return replace(motion, notes=(note,))


def _axes_of(left: FloatArray, right: FloatArray, upper: FloatArray) -> FloatArray:
    """Return left, up and front of a trunk's joint, by the (T, 3) places of its children."""
    across, up = left - right, upper - 0.5 * (left + right)
    x = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    z = np.cross(x, up)
    z /= np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-9)
    axes: FloatArray = np.stack([x, np.cross(z, x), z], axis=2)
    return axes


def _rest_way(name: str) -> FloatArray:
    """Return where the bone that ends in a joint points in a T pose."""
    if name.endswith(("shoulder", "elbow", "wrist")):
        return np.array([1.0 if name.startswith("left") else -1.0, 0.0, 0.0])
    if name.endswith("_foot"):
        return np.array([0.0, 0.0, 1.0])
    return np.array([0.0, -1.0 if name.endswith(("knee", "ankle")) else 1.0, 0.0])


def _least_turns(ways: FloatArray, others: FloatArray) -> FloatArray:
    """Return the (T, 3, 3) smallest rotations from (T, 3) directions to others."""
    a = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    b = others / np.maximum(np.linalg.norm(others, axis=1, keepdims=True), 1e-9)
    axis, cosine = np.cross(a, b), np.einsum("tx,tx->t", a, b)
    cross = np.zeros((len(a), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = axis
    cross[:, [1, 2, 0], [2, 0, 1]] = -axis
    share = 1.0 / np.maximum(1.0 + cosine, 1e-6)
    turned: FloatArray = np.eye(3) + cross + cross @ cross * share[:, None, None]
    return turned
