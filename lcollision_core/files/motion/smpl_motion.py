"""Read motions of SMPL, SMPL-H and SMPL-X in .npz files such as AMASS's, and change such files."""

from __future__ import annotations

import os
import shutil
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import LCollisionError, MeshFileError
from lcollision_core.files.safe import ZIP_DAMAGE, read_npz
from lcollision_core.files.scene.smpl import (
    BODY_JOINTS,
    FACE_JOINTS,
    HAND_JOINTS,
    JOINT_NAMES,
    array_names,
)
from lcollision_core.files.scene.transforms import nearest_winding
from lcollision_core.meshes.topology import FloatArray

_Hands = Mapping[str, tuple[FloatArray, FloatArray]]

_WHOLE = ("poses", "fullpose", "full_pose")
_TRANS, _RATES = ("trans", "transl"), ("mocap_framerate", "mocap_frame_rate", "fps")
_FLAT = "flat_hand_mean"
"""Whether hand poses are relative to the flat hand. The default is true, except for components,
which are relative to the mean."""

_BOTH = (*HAND_JOINTS["left"], *HAND_JOINTS["right"])
_PARTS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("global_orient", "root_orient", "Rh"), BODY_JOINTS[:1]),
    **dict.fromkeys(("body_pose", "pose_body"), BODY_JOINTS[1:]),
    **dict.fromkeys(("jaw_pose", "pose_jaw"), FACE_JOINTS[:1]),
    "leye_pose": FACE_JOINTS[1:2],
    "reye_pose": FACE_JOINTS[2:],
    "pose_eye": FACE_JOINTS[1:],
    "left_hand_pose": HAND_JOINTS["left"],
    "right_hand_pose": HAND_JOINTS["right"],
    "pose_hand": _BOTH,
}
"""Arrays of some joints' rotations: in AMASS, in the package smplx, and, beside `poses`, in
HY-Motion."""

_KEYS = (*_WHOLE, *_PARTS)
_LEFT_OUT = dict.fromkeys(
    ("expression", "expressions", "expr", "facial_expression"), "facial expressions"
) | {"dmpls": "soft tissue"}

_LARGEST = 1e6
_SAME = 1e-6
"""Largest difference, in radians, of two arrays of the same rotations."""

_AGAIN = "export the motion again"


@dataclass(frozen=True, eq=False)
class _Part:
    """An array of a file with the rotations of some joints.

    Attributes
    ----------
    name, array : as in the file, T rows
    joints : indices of the joints in the motion
    base : (n, 3 joints) components that the rows weight; None if the rows are rotation vectors
    mean : (3 joints,) added to the result
    """

    name: str
    array: npt.NDArray[np.floating]
    joints: list[int]
    base: FloatArray | None
    mean: FloatArray

    def turns(self) -> FloatArray:
        """Return the (T, 3 joints) rotation vectors."""
        turns: FloatArray = self.array.reshape(len(self.array), -1).astype(np.float64)
        return (turns if self.base is None else turns @ self.base) + self.mean

    def changed(self, frames: Sequence[int], turns: FloatArray) -> npt.NDArray[np.floating]:
        """Return the array with (n, J, 3) rotations in n frames, as near as components allow."""
        array, before = self.array.copy(), self.turns()[list(frames)]
        after = nearest_winding(turns[:, self.joints], before.reshape(-1, len(self.joints), 3))
        changed = after.reshape(before.shape) - self.mean
        if self.base is not None:
            changed = changed @ np.linalg.pinv(self.base)
        array[list(frames)] = changed.reshape(len(frames), *array.shape[1:]).astype(array.dtype)
        return array


@dataclass(frozen=True, eq=False)
class SmplMotion:
    """A motion of a body model, in the file's own coordinates.

    Attributes
    ----------
    path : path of its file
    names : J names of the joints that it turns, from `JOINT_NAMES`
    turns : (T, J, 3) float64 array, rotation vectors of the joints relative to their parents
    places : (T, 3) float64 array, in metres, added to all vertices
    betas : (B,) float64 array, the shape; empty if the file has none
    rate : frames per second; None if the file does not define it
    notes : sentences on what was left out
    gender, body_model : body that the motion was made for, in lower case, such as "female" and
        "smplx"; empty if the file does not define it
    """

    path: Path
    names: tuple[str, ...]
    turns: FloatArray
    places: FloatArray
    betas: FloatArray
    rate: float | None
    notes: tuple[str, ...]
    gender: str
    body_model: str
    _parts: tuple[_Part, ...]
    _trans: tuple[str, npt.NDArray[np.floating]]

    def __len__(self) -> int:
        """Return T, the number of frames."""
        return len(self.turns)

    def write(
        self, file: IO[bytes], frames: Sequence[int], turns: FloatArray, places: FloatArray
    ) -> None:
        """Write the file with some frames changed; other arrays are copied byte for byte.

        Parameters
        ----------
        file : open binary file
        frames : n frame numbers
        turns, places : (n, J, 3) and (n, 3)

        Raises
        ------
        MeshFileError : another entry of the file is damaged.
        """
        name, array = self._trans
        moved = array.copy()
        moved[list(frames)] = places.astype(array.dtype)
        changed = {part.name: part.changed(frames, turns) for part in self._parts} | {name: moved}
        try:
            with zipfile.ZipFile(self.path) as source, zipfile.ZipFile(file, "w") as out:
                for info in source.infolist():
                    copied = zipfile.ZipInfo(info.filename, info.date_time)
                    copied.compress_type = info.compress_type
                    new = changed.get(info.filename.removesuffix(".npy"))
                    with source.open(info) as entry, out.open(copied, "w", force_zip64=True) as to:
                        if new is None:
                            shutil.copyfileobj(entry, to)
                        else:
                            np.lib.format.write_array(to, new, allow_pickle=False)
        except ZIP_DAMAGE as error:
            raise MeshFileError.unreadable(self.path, "it is damaged", _AGAIN) from error


def is_smpl_motion(path: str | os.PathLike[str]) -> bool:
    """Whether an .npz file has rotations of joints, and no meshes; never raises."""
    names = array_names(path)
    return "vertices" not in names and not {*_KEYS, *_TRANS}.isdisjoint(names)


def read_smpl_motion(path: str | os.PathLike[str], hands: _Hands | None = None) -> SmplMotion:
    """Read a motion of a body model.

    Parameters
    ----------
    hands : components of the body model's hand poses by side: see `SmplModel`

    Raises
    ------
    MeshFileError : the file is missing, damaged, has Python objects, or no usable motion. The
        message names the file.
    """
    keys = (*_KEYS, *_TRANS, *_RATES, "betas", _FLAT)
    try:
        arrays, names = read_npz(Path(path), [(name,) for name in keys])
        return _motion(Path(path), arrays, names, hands or {})
    except LCollisionError as error:
        raise MeshFileError.unreadable(path, error, _AGAIN) from error


def _motion(
    path: Path, arrays: dict[str, npt.NDArray[Any]], names: tuple[str, ...], hands: _Hands
) -> SmplMotion:
    trans = next((name for name in _TRANS if name in arrays), None)
    if trans is None or not {*_WHOLE, "body_pose", "pose_body"} & arrays.keys():
        raise MeshFileError("it has no arrays 'poses' and 'trans', as motions of SMPL have")
    places = _floats(arrays, trans, (3,))
    left_out = [f"its {what} ({name!r})" for name, what in _LEFT_OUT.items() if name in names]
    notes = [f"left out: {' and '.join(left_out)}"] if left_out else []
    turns: dict[str, FloatArray] = {}
    parts: list[_Part] = []
    numbers: dict[str, int] = {}
    for name, joints, base, mean in _kept(arrays, hands):
        part = _Part(name, arrays[name], [], base, mean)
        if len(part.array) != len(places):
            raise MeshFileError(f"{name!r} has {len(part.array)} frames, {trans!r} {len(places)}")
        rows = part.turns().reshape(len(places), -1, 3)
        both = [(joint, turns[joint]) for joint in joints if joint in turns]
        if any(np.abs(rows[:, joints.index(item)] - own).max() > _SAME for item, own in both):
            notes.append(f"{name!r} contradicts {parts[0].name!r} and is left as it is")
            continue
        for joint, row in zip(joints, rows.swapaxes(0, 1), strict=True):
            numbers.setdefault(joint, len(numbers))
            turns.setdefault(joint, row)
        part.joints.extend(numbers[joint] for joint in joints)
        parts.append(part)
    if BODY_JOINTS[0] not in turns:
        raise MeshFileError("it lacks the pelvis rotation ('global_orient')")
    return SmplMotion(
        path,
        tuple(numbers),
        np.stack(list(turns.values()), axis=1),
        places,
        _betas(arrays),
        _rate(arrays),
        tuple(notes),
        _word(path, "gender"),
        _word(path, "surface_model_type"),
        tuple(parts),
        (trans, arrays[trans]),
    )


def _kept(
    arrays: dict[str, npt.NDArray[Any]], hands: _Hands
) -> Iterator[tuple[str, tuple[str, ...], FloatArray | None, FloatArray]]:
    """Yield the name, joints, `_Part.base` and `_Part.mean` of each array of rotations."""
    flat = arrays.get(_FLAT)
    if flat is not None and flat.dtype.kind not in "biuf":
        raise MeshFileError(f"its {_FLAT!r} is neither true nor false")
    is_flat = flat is None or bool(flat.reshape(-1)[:1].any())
    by_width = {3 * n: JOINT_NAMES.get(n, BODY_JOINTS) for n in (*JOINT_NAMES, len(BODY_JOINTS))}
    for name in _KEYS:
        if name not in arrays:
            continue
        values = _floats(arrays, name)
        width = int(np.prod(values.shape[1:]))
        joints = by_width.get(width, ()) if name in _WHOLE else _PARTS[name]
        if name in ("body_pose", "pose_body") and width == 3 * (len(JOINT_NAMES[24]) - 1):
            joints = JOINT_NAMES[24][1:]
        side = name.removesuffix("_hand_pose")
        if side in HAND_JOINTS and width < 3 * len(joints):
            if width > len(hands.get(side, ((),))[0]):
                raise MeshFileError(
                    f"{name!r} has {width} components of a hand's poses, which the body model does "
                    "not hold",
                    "save the hands as 45 numbers each",
                )
            base, mean = hands[side]
            is_from_mean = flat is None or not is_flat
            yield name, joints, base[:width], mean if is_from_mean else np.zeros_like(mean)
            continue
        if width != 3 * len(joints) or not joints:
            sizes = ", ".join(map(str, sorted(by_width))) if name in _WHOLE else 3 * len(joints)
            raise MeshFileError(f"{name!r} has {width} numbers a frame, expected {sizes}")
        mean = np.zeros(width)
        if not is_flat and side in hands:
            mean = hands[side][1]
        yield name, joints, None, mean


def _floats(
    arrays: Mapping[str, npt.NDArray[Any]], name: str, rest: tuple[int, ...] | None = None
) -> FloatArray:
    """Return a float array of shape (T, *rest), or with any one or two further sizes if None."""
    array = arrays[name]
    fits = array.shape[1:] == rest if rest is not None else array.ndim in (2, 3)
    if not fits or not array.size or array.dtype.kind != "f":
        raise MeshFileError(
            "cannot be used",
            where=f"its array {name!r}",
            expected="numbers by frame",
            got=f"{array.dtype} {array.shape}",
        )
    with np.errstate(all="ignore"):
        floats: FloatArray = array.astype(np.float64)
    unusable = np.flatnonzero(~(np.abs(floats.reshape(len(floats), -1)) <= _LARGEST).all(axis=1))
    if len(unusable):
        raise MeshFileError(
            f"has a number that is not finite or too large in frame {unusable[0]}",
            where=f"its array {name!r}",
        )
    return floats


def _word(path: Path, name: str) -> str:
    """Return the first word of a string in a file, in lower case; empty for anything else."""
    try:
        array = read_npz(path, [(name,)])[0].get(name)
    except MeshFileError:
        # Some files pickle the string, which is not read.
        return ""
    if array is None or array.dtype.kind not in "SU" or array.size != 1:
        return ""
    text = array.reshape(-1)[0]
    words = (text.decode("latin-1") if isinstance(text, bytes) else str(text)).lower()
    return words.replace("-", "").split("_")[0].strip()


def _betas(arrays: Mapping[str, npt.NDArray[Any]]) -> FloatArray:
    if "betas" not in arrays or not arrays["betas"].size:
        return np.zeros(0)
    rows = np.atleast_2d(arrays["betas"])
    rows = _floats({"betas": rows}, "betas", rows.shape[1:]) if rows.ndim == 2 else rows
    if rows.ndim != 2 or (rows != rows[0]).any():
        raise MeshFileError("its shape ('betas') changes from frame to frame, expected one shape")
    shape: FloatArray = rows[0]
    return shape


def _rate(arrays: Mapping[str, npt.NDArray[Any]]) -> float | None:
    name = next((name for name in _RATES if name in arrays), None)
    if name is None:
        return None
    values = arrays[name].reshape(-1)
    rate = float(values[0]) if len(values) == 1 and values.dtype.kind in "fiu" else 0.0
    if not 0.0 < rate <= _LARGEST:
        raise MeshFileError(f"its frame rate ({name!r}) is no number above 0")
    return rate
