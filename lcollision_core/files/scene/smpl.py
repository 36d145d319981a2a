"""Read SMPL, SMPL-H and SMPL-X body models from .npz files of plain arrays."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csc_array, csr_array

from lcollision_core.errors import LCollisionError, MeshFileError
from lcollision_core.files.safe import read_npz
from lcollision_core.files.table import SMPL_SUFFIX
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
    regressor: csr_array
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


def _regressor(arrays: dict[str, npt.NDArray[Any]], n_joints: int, n: int) -> csr_array:
    """Return the (J, V) matrix, which is stored densely or in CSR, CSC or COO form."""
    if _REGRESSOR in arrays:
        return csr_array(_floats(arrays, _REGRESSOR, (n_joints, n)))
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
            return coo_array((data, pair), shape=shape).tocsr()
        starts = numbers("indptr")
        kind = csr_array if len(starts) == n_joints + 1 else csc_array
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
            expected=f"{'numbers' if 'f' in kinds else 'whole numbers'} of shape ({shape_text})",
            got=f"{array.dtype} {array.shape}",
        )
    return array


def _missing(name: str) -> MeshFileError:
    return MeshFileError(f"it has no array {name!r}, as body models have")


def _joined(values: Mapping[int, object]) -> str:
    *most, last = map(str, values)
    return f"{', '.join(most)} or {last}"
