"""Read motions of generators: arrays of joint positions, with or without rotations.

Kimodo's .npz files have both. HumanML3D's .npy files of (T, 22, 3) positions, of N such motions, or
of (T, 263) vectors, and MDM's results.npy, have no rotations: these are fitted, each joint turning
as little as possible relative to its parent.
"""

from __future__ import annotations

import io
import os
import pickle
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.errors import MeshFileError
from lcollision_core.files.motion.skeleton import (
    SkeletonMotion,
    least_turns,
    relative_to_parents,
)
from lcollision_core.files.motion.smpl import BODY_JOINTS, array_names
from lcollision_core.files.safe import open_regular, read_header, read_npz
from lcollision_core.meshes.topology import FloatArray

_PLACES, _TURNS = "posed_joints", "global_rot_mats"
_KIMODO_RATE, _HUMANML_RATE = 30.0, 20.0
_LARGEST, _ROUNDED = 1e6, 1e-2
_MOST_BYTES = 1 << 30
_LEAST_HEIGHT, _MOST_HEIGHT = 0.6, 3.0
"""Limits, in metres, of the height of a figure whose vectors are not normalised."""

_SMPL = dict(
    zip(
        BODY_JOINTS,
        (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19),
        strict=True,
    )
)
"""The parents of the 22 joints of SMPL's body."""


_JOINTS, _VECTORS = (len(_SMPL), 3), (263,)
"""Shapes of one frame of HumanML3D, as joint positions and as a vector."""


def _soma(fingers: dict[str, int], *, with_ends: bool) -> dict[str, int]:
    """Return the parents of SOMA's joints by name, given the number of joints per finger."""
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
"""Known skeletons by number of joints: their names and parents."""


def is_generated(path: str | os.PathLike[str]) -> bool:
    """Whether a file is of one of these formats; never raises."""
    suffix = Path(path).suffix.lower()
    return suffix == ".npy" or (suffix == ".npz" and {_PLACES, _TURNS} <= set(array_names(path)))


def holds_joints(path: str | os.PathLike[str]) -> bool:
    """Whether a .npy file has a shape that can be read here; never raises."""
    try:
        with open_regular(path) as file:
            shape, _, dtype = read_header(file)
    except (MeshFileError, OSError, ValueError, EOFError):
        return False
    return dtype.hasobject or _JOINTS in (shape[1:], shape[2:]) or shape[1:] == _VECTORS


def read_generated(path: str | os.PathLike[str]) -> list[SkeletonMotion]:
    """Read motions in metres: several from an MDM file, one from others.

    Raises
    ------
    MeshFileError : the file is missing or damaged, or has other arrays; the message says what was
        expected.
    """
    try:
        if Path(path).suffix.lower() == ".npy":
            return [_of_sample(*sample) for sample in _samples(Path(path))]
        arrays, _ = read_npz(Path(path), [(_PLACES,), (_TURNS,)])
        places = _usable(arrays[_PLACES], _PLACES)
        turns = _usable(arrays[_TURNS], _TURNS)
        skeleton = _SKELETONS.get(places.shape[1]) if places.ndim == 3 else None
        if skeleton is None or places.shape[2] != 3 or turns.shape != (*places.shape, 3):
            sizes = " or ".join(map(str, _SKELETONS))
            raise MeshFileError(
                f"{_PLACES!r} is {places.shape} and {_TURNS!r} {turns.shape}, expected (T, J, 3) "
                f"and (T, J, 3, 3) of Kimodo with J = {sizes} joints"
            )
        what, parents = skeleton
        note = f"taken for a motion of Kimodo on the skeleton of {what}"
        n_frames, cut = _filled(places)
        places, turns = places[:n_frames], turns[:n_frames]
        if np.abs(turns @ np.swapaxes(turns, -1, -2) - np.eye(3)).max() > _ROUNDED:
            raise MeshFileError(f"{_TURNS!r} has matrices that are not rotations")
        return [_motion(parents, places, turns, _KIMODO_RATE, (note, *cut))]
    except (MeshFileError, OSError, ValueError, EOFError) as error:
        raise MeshFileError.unreadable(path, error, "export the motion again") from error


def _filled(places: FloatArray) -> tuple[int, tuple[str, ...]]:
    """Return the number of frames before the padding of (T, J, 3) positions, and a note on it.

    Raises
    ------
    MeshFileError : all frames are padding.
    """
    used = np.flatnonzero(np.ptp(places, axis=1).max(axis=1) > 0.0)
    if not len(used):
        raise MeshFileError("all its joints are in one place")
    n_frames = int(used[-1]) + 1
    n_filling = len(places) - n_frames
    cut = f"its last {n_filling} frames hold no figure and are left out"
    return n_frames, (cut,) if n_filling else ()


def _samples(path: Path) -> list[tuple[str, FloatArray, str]]:
    """Return the motions of a .npy file: name, (T, 22, 3) joint positions and description."""
    expected = (
        "(T, 22, 3) or (N, T, 22, 3), places of the joints of HumanML3D, (T, 263), its vectors, or "
        "the dict of MDM's results.npy with 'motion'"
    )
    with open_regular(path) as file:
        if os.fstat(file.fileno()).st_size > _MOST_BYTES:
            raise MeshFileError("it is too large")
        shape, _, dtype = read_header(file)
        content = read_plain_pickle(file.read()) if dtype.hasobject else None
    if content is not None:
        motion = content.get("motion") if isinstance(content, dict) else None
        if not isinstance(motion, np.ndarray) or motion.ndim != 4 or motion.shape[1:3] != _JOINTS:
            got = f"'motion' of {motion.shape}" if isinstance(motion, np.ndarray) else "no 'motion'"
            raise MeshFileError(f"it holds {got}, expected (N, 22, 3, T), or {expected}")
        lengths = np.asarray(content.get("lengths", [motion.shape[3]] * len(motion))).reshape(-1)
        if len(lengths) != len(motion) or lengths.dtype.kind not in "iu":
            raise MeshFileError("its 'lengths' are not whole numbers, one for each motion")
        places = np.moveaxis(_usable(motion, "'motion'"), 3, 1)
        cut = [row[: max(int(length), 1)] for row, length in zip(places, lengths, strict=True)]
        return _numbered(path, cut, "of MDM")
    if _JOINTS not in (shape[1:], shape[2:]) and shape[1:] != _VECTORS:
        raise MeshFileError(f"it is {shape}, expected {expected}")
    array = _usable(np.load(path, mmap_mode="r", allow_pickle=False), "it")
    if shape[1:] != _VECTORS:
        return _numbered(path, array.reshape(-1, *shape[-3:]), "of HumanML3D")
    places = _joints_of_vectors(array)
    heights = np.ptp(places[..., 1], axis=1)
    if not _LEAST_HEIGHT < float(np.median(heights)) < _MOST_HEIGHT:
        raise MeshFileError(
            f"its vectors make a figure {np.median(heights):.2g} m high, expected metres",
            "undo the normalisation: multiply by Std.npy and add Mean.npy of HumanML3D",
        )
    return [("", places, "that the vectors of HumanML3D hold")]


def _numbered(
    path: Path, samples: Sequence[FloatArray] | FloatArray, what: str
) -> list[tuple[str, FloatArray, str]]:
    """Return the motions of a file with their names, which are empty for a single one."""
    several = len(samples) > 1
    return [
        (f"{path.stem} {number}" if several else "", sample, what)
        for number, sample in enumerate(samples, 1)
    ]


def _joints_of_vectors(vectors: FloatArray) -> FloatArray:
    """Return the (T, 22, 3) joint positions of (T, 263) vectors of HumanML3D.

    Notes
    -----
    `recover_from_ric` of HumanML3D (Guo et al. 2022, "Generating Diverse and Natural 3D Human
    Motions from Text"): a vector begins with the root's angular velocity about y (half the angle,
    as of a quaternion), its velocity along x and z in its local frame, its height, and the
    positions of the other 21 joints in that frame, relative to the root along x and z.
    """
    half = np.concatenate([[0.0], np.cumsum(vectors[:-1, 0])])
    turns = scipy.spatial.transform.Rotation.from_rotvec(
        np.multiply.outer(-2.0 * half, [0.0, 1.0, 0.0])
    )
    steps = np.zeros((len(vectors), 3))
    steps[1:, [0, 2]] = vectors[:-1, 1:3]
    roots = np.cumsum(turns.apply(steps), axis=0)
    local_positions = vectors[:, 4 : 4 + 3 * (len(_SMPL) - 1)].reshape(len(vectors), -1, 3)
    places = np.einsum("txy,tjy->tjx", turns.as_matrix(), local_positions) + roots[:, None]
    roots[:, 1] = vectors[:, 3]
    return np.concatenate([roots[:, None], places], axis=1)


def _of_sample(name: str, places: FloatArray, what: str) -> SkeletonMotion:
    n_frames, cut = _filled(places)
    motion = _fitted(places[:n_frames], what)
    return replace(motion, name=name, notes=(*motion.notes, *cut))


def _usable(array: npt.NDArray[Any], name: str) -> FloatArray:
    if array.dtype.kind != "f" or not array.size:
        raise MeshFileError(f"{name} is {array.dtype} {array.shape}, expected floats by frame")
    floats: FloatArray = array.astype(np.float64)
    if not (np.abs(floats) <= _LARGEST).all():
        raise MeshFileError(f"{name} has a number that is not finite or too large")
    return floats


def _motion(
    skeleton: dict[str, int],
    places: FloatArray,
    turns: FloatArray,
    rate: float,
    notes: tuple[str, ...],
) -> SkeletonMotion:
    """Return the motion of joints with these global positions and rotations."""
    parents = np.array(list(skeleton.values()))
    local, root_places = relative_to_parents(parents, turns, places)
    offsets = root_places.mean(axis=0) * (parents >= 0)[:, None]
    axes = np.broadcast_to(np.eye(3), (len(parents), 3, 3)).copy()
    times, ends = np.arange(len(places)) / rate, np.full(offsets.shape, np.nan)
    names = tuple(skeleton)
    return SkeletonMotion(
        "", names, parents, offsets, ends, axes, times, None, local, root_places, notes
    )


def _fitted(places: FloatArray, what: str) -> SkeletonMotion:
    """Return a motion of SMPL's joints with rotations fitted to (T, 22, 3) positions."""
    names, parents = list(_SMPL), np.array(list(_SMPL.values()))
    turns = np.broadcast_to(np.eye(3), (*places.shape, 3)).copy()
    for joint, parent in enumerate(parents.tolist()):
        below = np.flatnonzero(parents == joint)
        if parent >= 0:
            turns[:, joint] = turns[:, parent]
        if names[joint] in ("pelvis", "spine3"):
            # The left, right and upper child.
            kinds = sorted(below.tolist(), key=lambda one: ("_" not in names[one], one))
            turns[:, joint] = _axes_of(*(places[:, kind] for kind in kinds))
        elif len(below):
            way = places[:, below[0]] - places[:, joint]
            at_rest = turns[:, joint] @ _rest_way(names[int(below[0])])
            turns[:, joint] = least_turns(at_rest, way) @ turns[:, joint]
    motion = _motion(_SMPL, places, turns, _HUMANML_RATE, ())
    fitted_places = places.copy()
    for joint, parent in enumerate(parents.tolist()):
        if parent >= 0:
            fitted_places[:, joint] = (
                fitted_places[:, parent] + turns[:, parent] @ motion.offsets[joint]
            )
    off = np.linalg.norm(fitted_places - places, axis=2) / max(
        float(np.ptp(places[0], axis=0).max()), 1e-9
    )
    note = (
        f"taken for the joints {what}, whose turns are fitted by inverse kinematics: joints are "
        f"{100.0 * off.mean():.2g} % of the figure's size off on average, "
        f"{100.0 * off.max():.2g} % at most"
    )
    return replace(motion, notes=(note,))


def _axes_of(left: FloatArray, right: FloatArray, upper: FloatArray) -> FloatArray:
    """Return the left, up and front axes of a trunk joint from its children's (T, 3) positions."""
    across, up = left - right, upper - 0.5 * (left + right)
    x = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    z = np.cross(x, up)
    z /= np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-9)
    axes: FloatArray = np.stack([x, np.cross(z, x), z], axis=2)
    return axes


def _rest_way(name: str) -> FloatArray:
    """Return the direction, in a T pose, of the bone that ends in a joint."""
    if name.endswith(("shoulder", "elbow", "wrist")):
        return np.array([1.0 if name.startswith("left") else -1.0, 0.0, 0.0])
    if name.endswith("_foot"):
        return np.array([0.0, 0.0, 1.0])
    return np.array([0.0, -1.0 if name.endswith(("knee", "ankle")) else 1.0, 0.0])


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


def _scalar(kind: _Type, loaded: bytes) -> Any:
    return np.frombuffer(loaded, kind.plain())[0].item()


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


def _value(loaded: Any) -> Any:
    if isinstance(loaded, _Array):
        return loaded.value()
    if isinstance(loaded, dict):
        return {str(key): _value(item) for key, item in loaded.items()}
    if isinstance(loaded, list | tuple):
        return [_value(item) for item in loaded]
    if loaded is None or isinstance(loaded, str | bytes | bool | int | float):
        return loaded
    raise pickle.UnpicklingError(f"it holds a {type(loaded).__name__}")
