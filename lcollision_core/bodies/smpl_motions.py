"""Motions of the SMPL family as poses of their body model, and back."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lcollision_core.bodies.posable_body import PosableBody
from lcollision_core.bodies.rig_model import RigModel
from lcollision_core.characters import RigPoseSpace
from lcollision_core.errors import MeshFileError
from lcollision_core.files import Character
from lcollision_core.files.character_reading import character_of_smpl
from lcollision_core.files.motion.smpl_motion import SmplMotion, read_smpl_motion
from lcollision_core.files.safe import atomic_write
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion import NOMINAL_RATE, Motion

_SAME = 1e-9
"""Metres, by which the joints of equal shapes may differ."""

_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation of coordinates in which z is up, as AMASS has them, to those of the body models."""

_NAMED = 3

_GENDERS = ("female", "male", "neutral")
"""In this order: a name with "female" has "male" in it."""

_KINDS = {24: "smpl", 52: "smplh", 55: "smplx"}
"""Body models by their number of joints."""


def body_of_smpl(body: PosableBody, path: Path) -> tuple[RigModel, tuple[str, ...]]:
    """Return a body in the shape that a motion says; joints that it does not turn are still.

    Parameters
    ----------
    body : a character of a body model, of any shape
    path : of the motion

    Returns
    -------
    body : with the same contact rules and names; itself where it is that already
    notes : sentences on what is not as in the file

    Raises
    ------
    MeshFileError : the body is of no body model, or see `read_smpl_motion`.
    """
    rigged, motion = _read(body, path)
    model = rigged.character.smpl
    assert model is not None
    notes = list(motion.notes)
    missing = [name for name in model.names if name not in motion.names]
    unknown = [name for name in motion.names if name not in model.names]
    n_shapes = model.shape_directions.shape[2]
    if missing:
        notes.append(f"it does not turn {_listed(missing)}, which stay as in the body model")
    if unknown:
        notes.append(f"the body model has no {_listed(unknown)}")
    if motion.betas[n_shapes:].any():
        notes.append(f"only the first {n_shapes} of its betas are in the body model")
    notes += _misfits(rigged, motion)
    shaped = _shaped(rigged, motion)
    same = rigged if shaped is None else RigModel.of(shaped).with_choices_of(rigged)
    return same, tuple(notes)


def _misfits(body: RigModel, motion: SmplMotion) -> list[str]:
    """Say where a motion was made for another body than the one that it is to move."""
    model = body.character.smpl
    assert model is not None
    name, notes = model.path.name, []
    own = next((gender for gender in _GENDERS if gender in model.path.stem.lower()), "")
    if own and motion.gender in _GENDERS and motion.gender != own:
        notes.append(f"it was made for a {motion.gender} body ('gender'), and {name} is {own}")
    kind = _KINDS[len(model.names)]
    if motion.body_model in _KINDS.values() and motion.body_model != kind:
        made_for, ours = motion.body_model.upper(), kind.upper()
        notes.append(f"it was made for {made_for} ('surface_model_type'), and {name} is {ours}")
    return notes


def motion_of_smpl(body: PosableBody, path: Path, fps: float | None = None) -> Motion:
    """Read a motion of the SMPL family as poses of a body in its shape: see `body_of_smpl`.

    Parameters
    ----------
    fps : frames a second; None for those that the file says, else 30

    Raises
    ------
    MeshFileError : the body is of no body model, or of another shape; or see `read_smpl_motion`.
    """
    rigged, motion = _read(body, path)
    if _shaped(rigged, motion) is not None:
        raise MeshFileError(
            "is of another shape ('betas') than the body, or turns other joints",
            "open the body in the shape of the motion",
            where=path,
        )
    space, frame = rigged.space, _frame(motion)
    turns = np.zeros((len(motion), space.n_joints, 3))
    for joint, number in _pairs(space, motion):
        turns[:, joint] = motion.turns[:, number]
    turns[:, 0] = (Rotation.from_matrix(frame) * Rotation.from_rotvec(turns[:, 0])).as_rotvec()
    pelvis = space.rig.rest[0, :3, 3]
    codes = space.codes_of_turns(turns, (pelvis + motion.places) @ frame.T - pelvis)
    times = np.arange(len(motion)) / (fps or motion.rate or NOMINAL_RATE)
    return Motion(path.stem, times, space.unwound(codes), source=path.name)


def write_smpl(
    path: str | os.PathLike[str],
    body: PosableBody,
    file: Path,
    frames: Sequence[int],
    codes: FloatArray,
) -> None:
    """Write the file of a motion with some frames changed, whole or not at all.

    Parameters
    ----------
    file : that the motion was read from
    frames : n numbers of frames
    codes : (n, D) of them

    Raises
    ------
    MeshFileError : the file cannot be read any more, or the other cannot be written.
    """
    rigged, motion = _read(body, file)
    space, frame = rigged.space, _frame(motion)
    turns, places = motion.turns[list(frames)], motion.places[list(frames)]
    pelvis = space.rig.rest[0, :3, 3]
    for row, pose in enumerate(codes):
        own, shift = space.turns_of(pose)
        own[0] = (Rotation.from_matrix(frame.T) * Rotation.from_rotvec(own[0])).as_rotvec()
        for joint, number in _pairs(space, motion):
            turns[row, number] = own[joint]
        places[row] = (pelvis + shift) @ frame - pelvis
    with atomic_write(path) as out:
        motion.write(out, frames, turns, places)


def _read(body: PosableBody, path: Path) -> tuple[RigModel, SmplMotion]:
    model = body.character.smpl if isinstance(body, RigModel) else None
    if model is None or not isinstance(body, RigModel):
        raise MeshFileError(
            "is a motion of SMPL, SMPL-H or SMPL-X, and the body is none of these",
            "name the .npz file of the body model as the body",
            where=path,
        )
    return body, read_smpl_motion(path, model.hands)


def _shaped(body: RigModel, motion: SmplMotion) -> Character | None:
    """Return a body model in the shape of a motion, None where the body is that."""
    character = body.character
    assert character.smpl is not None
    shaped, rig = character_of_smpl(character.smpl, motion.betas, motion.names), body.space.rig
    own = shaped.rig
    assert own is not None
    turns_same = np.array_equal(np.asarray(own.moving), np.asarray(rig.moving))
    if turns_same and np.abs(own.rest - rig.rest).max() <= _SAME:
        return None
    chosen = replace(own, chosen=rig.chosen)
    return replace(shaped, rig=chosen, up=character.up, up_is_sure=character.up_is_sure)


def _pairs(space: RigPoseSpace, motion: SmplMotion) -> list[tuple[int, int]]:
    """Return the joints that body and motion both have: their numbers in each."""
    numbers = {name: number for number, name in enumerate(motion.names)}
    names = enumerate(space.rig.joint_names)
    return [(joint, numbers[name]) for joint, name in names if name in numbers]


def _frame(motion: SmplMotion) -> FloatArray:
    """Return the rotation from the motion's coordinates to the body's, in which y is up.

    Up is y or z, along which the body stands more.
    """
    up = Rotation.from_rotvec(motion.turns[:, motion.names.index("pelvis")]).apply([0.0, 1.0, 0.0])
    _, y, z = up.mean(axis=0)
    return _FROM_Z_UP if z > y else np.eye(3)


def _listed(names: Sequence[str]) -> str:
    plain = [name.replace("_", " ") for name in names]
    more = f" and {len(plain) - _NAMED} more joints" if len(plain) > _NAMED else ""
    return ", ".join(plain[:_NAMED]) + more
