"""Read SMPL, SMPL-H and SMPL-X: body models and motions, such as AMASS's, in .npz files.

Motions are written back with frames changed, and converted to a skeleton's for other bodies.
"""

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
import scipy

from lcollision_core.bundled import bundled_table
from lcollision_core.errors import LCollisionError, MeshFileError
from lcollision_core.files.formats import SMPL_SUFFIX
from lcollision_core.files.motion.skeleton import SkeletonMotion
from lcollision_core.files.safe import ZIP_DAMAGE, read_npz
from lcollision_core.files.scene.transforms import from_rotation_vectors, nearest_winding
from lcollision_core.meshes.topology import FloatArray, Topology

PICKLE_SUFFIXES = (".pkl", ".pickle")
"""Extensions of files that are never opened, because loading them can run code."""

_SIDES = ("left", "right")
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")

BODY_JOINTS = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2"),
    *("left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar"),
    *("right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
    *("left_wrist", "right_wrist"),
)
"""The 22 joints that all three models begin with."""

FACE_JOINTS = ("jaw", "left_eye", "right_eye")

HAND_JOINTS = {
    side: tuple(f"{side}_{finger}{number}" for finger in _FINGERS for number in (1, 2, 3))
    for side in _SIDES
}
"""The 15 joints of the fingers of each hand."""

_BOTH_HANDS = (*HAND_JOINTS["left"], *HAND_JOINTS["right"])

JOINT_NAMES: dict[int, tuple[str, ...]] = {
    24: (*BODY_JOINTS, "left_hand", "right_hand"),
    52: (*BODY_JOINTS, *_BOTH_HANDS),
    55: (*BODY_JOINTS, *FACE_JOINTS, *_BOTH_HANDS),
}
"""The joints of SMPL, SMPL-H and SMPL-X, in the order of their poses."""

_SMPLX, _SHAPES_OF_SMPLX, _FEWER_SHAPES = 55, 300, 10
"""SMPL-X has 300 or 10 shape directions, followed by those of expressions."""

_LARGEST = 1e6
_SUM = 1e-3
"""Largest deviation of a vertex's sum of weights from 1."""

_AS_PLAIN = (
    "where you trust the file, save its arrays as plain numbers: numpy.savez('model.npz', "
    "**{name: numpy.array(model[name]) for name in ('v_template', 'shapedirs', 'posedirs', "
    "'weights', 'kintree_table', 'f')}, J_regressor=model['J_regressor'].toarray())"
)
"""Advice for a pickled model, as models are often distributed."""

_REGRESSOR, _SPARSE = "J_regressor", ("data", "indices", "indptr", "row", "col")
_HAND_ARRAYS = [f"hands_{what}{side[0]}" for what in ("components", "mean") for side in _SIDES]


@dataclass(frozen=True, eq=False)
class SmplModel:
    """A body model; lengths are in metres, y is up, and it faces +z.

    Attributes
    ----------
    path : path of its file
    names : J names of the joints
    parents : (J,) int64 array, -1 for the pelvis, which is the first; parents come before children
    topology : topology of its V vertices
    template : (V, 3) float64 array, the mean shape
    shape_directions : (V, 3, S) float64 array, offsets by each number of the shape (beta)
    pose_directions : (V, 3, 9 (J - 1)) float32 array, offsets by each entry of R - I, for the
        rotations R of all joints but the first, row by row
    regressor : (J, V) sparse array, from the vertices of a shape to its joints
    weights : (V, J) float64 array >= 0, each row sums to 1
    hands : for each hand, if the file has them, (45, 45) principal components of its poses, one
        per row, and the (45,) mean
    """

    path: Path
    names: tuple[str, ...]
    parents: npt.NDArray[np.int64]
    topology: Topology
    template: FloatArray
    shape_directions: FloatArray
    pose_directions: npt.NDArray[np.float32]
    regressor: scipy.sparse.csr_array
    weights: FloatArray
    hands: Mapping[str, tuple[FloatArray, FloatArray]]

    def shaped(self, betas: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return a shape's (V, 3) vertices and (J, 3) joints: B_S and J of Loper et al. 2015.

        Parameters
        ----------
        betas : (n,) array, n <= S
        """
        vertices: FloatArray = self.template + self.shape_directions[..., : len(betas)] @ betas
        return vertices, self.regressor @ vertices


def is_smpl_model(path: str | os.PathLike[str]) -> bool:
    """Whether an .npz file is a body model, not poses of one; never raises."""
    return "v_template" in array_names(path)


def array_names(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Return the names of the arrays in an .npz file; none for any other file."""
    if Path(path).suffix.lower() != SMPL_SUFFIX:
        return ()
    try:
        return read_npz(Path(path), ())[1]
    except MeshFileError:
        return ()


def refuse_pickle(path: str | os.PathLike[str]) -> None:
    """Refuse a file of Python objects by its extension.

    Raises
    ------
    MeshFileError : it is a pickle.
    """
    if Path(path).suffix.lower() in PICKLE_SUFFIXES:
        raise MeshFileError(
            "is a pickle, which is not opened because that can run code", _AS_PLAIN, where=path
        )


def read_smpl(path: str | os.PathLike[str]) -> SmplModel:
    """Read a body model.

    Raises
    ------
    MeshFileError : the file is missing, damaged, has Python objects or other content, or has other
        joints. The message names the file.
    """
    array_names = (
        "v_template",
        "shapedirs",
        "posedirs",
        "weights",
        "kintree_table",
        "f",
        _REGRESSOR,
    )
    sparse = [f"{_REGRESSOR}_{part}" for part in _SPARSE]
    try:
        arrays, names = read_npz(Path(path), [(name,) for name in (*array_names, *sparse)])
        if "v_template" not in arrays and {"poses", "trans"} & set(names):
            raise MeshFileError("it is a motion, not a body", "name its body model first")
        if "v_template" not in arrays and "vertices" in names:
            raise MeshFileError(
                "it is a pose set, not a body", "learn a model of it: lcollision new"
            )
        hands, _ = read_npz(Path(path), [(name,) for name in _HAND_ARRAYS if name in names])
        return _model(Path(path), arrays, hands)
    except LCollisionError as error:
        is_pickled = "Python objects" in error.what
        reason = MeshFileError(error.headline, _AS_PLAIN) if is_pickled else error
        advice = "name the .npz file of SMPL, SMPL-H or SMPL-X"
        raise MeshFileError.unreadable(path, reason, advice) from error


def _model(
    path: Path, arrays: dict[str, npt.NDArray[Any]], hands: dict[str, npt.NDArray[Any]]
) -> SmplModel:
    table = _plain(arrays, "kintree_table", "iu", (2, None))
    n_joints = table.shape[1]
    if n_joints not in JOINT_NAMES:
        raise MeshFileError(f"it has {n_joints} joints, expected {_joined(JOINT_NAMES)}")
    parents = table[0].astype(np.int64)
    # The pelvis has no parent: the file stores the largest unsigned number, or -1.
    parents[0] = -1
    if (parents[1:] < 0).any() or (parents[1:] >= np.arange(1, n_joints)).any():
        raise MeshFileError("one of its joints comes before its parent")
    template = _floats(arrays, "v_template", (None, 3))
    n = len(template)
    shapes = _floats(arrays, "shapedirs", (n, 3, None))
    if n_joints == _SMPLX:
        is_whole = shapes.shape[2] >= _SHAPES_OF_SMPLX
        shapes = shapes[..., : _SHAPES_OF_SMPLX if is_whole else _FEWER_SHAPES]
    poses = _floats(arrays, "posedirs", (n, 3, 9 * (n_joints - 1)))
    weights = _floats(arrays, "weights", (n, n_joints))
    if (weights < 0.0).any() or np.abs(weights.sum(axis=1) - 1.0).max() > _SUM:
        raise MeshFileError("the weights of its vertices are below 0, or do not sum to 1")
    return SmplModel(
        path,
        JOINT_NAMES[n_joints],
        parents,
        Topology(_plain(arrays, "f", "iu", (None, 3)).astype(np.int64), n),
        template,
        shapes,
        poses.astype(np.float32),
        _regressor(arrays, n_joints, n),
        weights,
        {
            side: (
                _floats(hands, f"hands_components{side[0]}", (None, 45)),
                _floats(hands, f"hands_mean{side[0]}", (45,)),
            )
            for side in _SIDES
            if len(hands) == len(_HAND_ARRAYS)
        },
    )


def _regressor(
    arrays: dict[str, npt.NDArray[Any]], n_joints: int, n: int
) -> scipy.sparse.csr_array:
    """Return the (J, V) matrix, which is stored densely or in CSR, CSC or COO form."""
    if _REGRESSOR in arrays:
        return scipy.sparse.csr_array(_floats(arrays, _REGRESSOR, (n_joints, n)))
    if f"{_REGRESSOR}_data" not in arrays:
        raise _missing(_REGRESSOR)
    data = _floats(arrays, f"{_REGRESSOR}_data", (None,))

    def numbers(part: str, size: int | None = None) -> npt.NDArray[np.int64]:
        values = _plain(arrays, f"{_REGRESSOR}_{part}", "iu", (size,)).astype(np.int64)
        if (values < 0).any():
            raise MeshFileError(f"its array '{_REGRESSOR}_{part}' has a number below 0")
        return values

    shape = n_joints, n
    try:
        if f"{_REGRESSOR}_row" in arrays:
            pair = numbers("row", len(data)), numbers("col", len(data))
            return scipy.sparse.coo_array((data, pair), shape=shape).tocsr()
        starts = numbers("indptr")
        kind = scipy.sparse.csr_array if len(starts) == n_joints + 1 else scipy.sparse.csc_array
        matrix = kind((data, numbers("indices", len(data)), starts), shape=shape)
        matrix.check_format()
        return matrix.tocsr()
    except ValueError as error:
        raise MeshFileError(f"its joint regressor is damaged: {error}") from error


def _floats(
    arrays: Mapping[str, npt.NDArray[Any]], name: str, shape: tuple[int | None, ...]
) -> FloatArray:
    with np.errstate(all="ignore"):
        array = _plain(arrays, name, "f", shape).astype(np.float64)
    # Comparisons with NaN are false.
    if not (np.abs(array) <= _LARGEST).all():
        raise MeshFileError(
            "has a number that is not finite or too large", where=f"its array {name!r}"
        )
    return array


def _plain(
    arrays: Mapping[str, npt.NDArray[Any]], name: str, kinds: str, shape: tuple[int | None, ...]
) -> npt.NDArray[Any]:
    """Return an array with one of the dtype kinds and a shape, in which None is any size above 0.

    Raises
    ------
    MeshFileError : it is missing, or has another dtype or shape.
    """
    if name not in arrays:
        raise _missing(name)
    array = arrays[name]
    fits = array.ndim == len(shape) and all(
        own == size or (size is None and own > 0)
        for own, size in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype.kind not in kinds:
        shape_text = ", ".join("any" if size is None else str(size) for size in shape)
        raise MeshFileError(
            "cannot be used",
            where=f"its array {name!r}",
            expected=f"numbers of shape ({shape_text})"
            if "f" in kinds
            else f"whole numbers of shape ({shape_text})",
            got=f"{array.dtype} {array.shape}",
        )
    return array


def _missing(name: str) -> MeshFileError:
    return MeshFileError(f"it has no array {name!r}, as body models have")


def _joined(values: Mapping[int, object]) -> str:
    *most, last = map(str, values)
    return f"{', '.join(most)} or {last}"


_Hands = Mapping[str, tuple[FloatArray, FloatArray]]

_WHOLE = ("poses", "fullpose", "full_pose")
_TRANS, _RATES = ("trans", "transl"), ("mocap_framerate", "mocap_frame_rate", "fps")
_FLAT = "flat_hand_mean"
"""Whether hand poses are relative to the flat hand. The default is true, except for components,
which are relative to the mean."""

_PARTS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("global_orient", "root_orient", "Rh"), BODY_JOINTS[:1]),
    **dict.fromkeys(("body_pose", "pose_body"), BODY_JOINTS[1:]),
    **dict.fromkeys(("jaw_pose", "pose_jaw"), FACE_JOINTS[:1]),
    "leye_pose": FACE_JOINTS[1:2],
    "reye_pose": FACE_JOINTS[2:],
    "pose_eye": FACE_JOINTS[1:],
    "left_hand_pose": HAND_JOINTS["left"],
    "right_hand_pose": HAND_JOINTS["right"],
    "pose_hand": _BOTH_HANDS,
}
"""Arrays of some joints' rotations: in AMASS, in the package smplx, and, beside `poses`, in
HY-Motion."""

_KEYS = (*_WHOLE, *_PARTS)
_LEFT_OUT = dict.fromkeys(
    ("expression", "expressions", "expr", "facial_expression"), "facial expressions"
) | {"dmpls": "soft tissue"}

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
    places = _by_frame(arrays, trans, (3,))
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
        values = _by_frame(arrays, name)
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


def _by_frame(
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
    rows = _by_frame({"betas": rows}, "betas", rows.shape[1:]) if rows.ndim == 2 else rows
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


_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from z-up coordinates, as in AMASS, to those of the body models."""

_LEFT = bundled_table("smpl_skeleton.toml", dict[str, tuple[str, tuple[float, float, float]]])
_WAYS = _LEFT | {
    name.replace("left", "right"): (parent.replace("left", "right"), (-x, y, z))
    for name, (parent, (x, y, z)) in _LEFT.items()
    if name.startswith("left")
}
"""T pose of a person of average build: each joint's parent and offset from it in metres."""


def axes_of_smpl(motion: SmplMotion) -> FloatArray:
    """Return the rotation from the motion's coordinates to the body's, in which y is up.

    Up is y or z, whichever the body mainly stands along.
    """
    up = scipy.spatial.transform.Rotation.from_rotvec(
        motion.turns[:, motion.names.index("pelvis")]
    ).apply([0.0, 1.0, 0.0])
    _, y, z = up.mean(axis=0)
    return _FROM_Z_UP if z > y else np.eye(3)


def skeleton_of_smpl(motion: SmplMotion, nominal_rate: float) -> SkeletonMotion:
    """Return a motion as that of a skeleton of average build, y up.

    Parameters
    ----------
    nominal_rate : frames per second, if the motion does not define them
    """
    ways, numbers = _WAYS, {name: number for number, name in enumerate(motion.names)}
    # Order parents first; leave out joints without rotations.
    depth = {"": 0}
    order: list[str] = []
    while len(order) < len(numbers):
        level = [name for name in motion.names if name not in depth and ways[name][0] in depth]
        depth |= dict.fromkeys(level, 1)
        order += level
        if not level:
            break
    index = {name: place for place, name in enumerate(order)}
    parents = np.array([index.get(ways[name][0], -1) for name in order], dtype=np.int64)
    offsets = np.array([ways[name][1] for name in order])
    frame, n_frames = axes_of_smpl(motion), len(motion)
    joint_turns = motion.turns[:, [numbers[name] for name in order]]
    turns = from_rotation_vectors(joint_turns.reshape(-1, 3))
    turns = turns.reshape(n_frames, len(order), 3, 3)
    turns[:, 0] = frame @ turns[:, 0]
    places = np.tile(offsets, (n_frames, 1, 1))
    # Without places, the body turns where it is at rest, whichever way is up.
    if motion.places.any():
        places[:, 0] = (offsets[0] + motion.places) @ frame.T
    times = np.arange(n_frames) / (motion.rate or nominal_rate)
    ends, axes = np.full(offsets.shape, np.nan), np.tile(np.eye(3), (len(order), 1, 1))
    note = "read as an SMPL motion and retargeted; its body shape ('betas') is ignored"
    notes = (note, *motion.notes)
    return SkeletonMotion(
        "", tuple(order), parents, offsets, ends, axes, times, None, turns, places, notes
    )
