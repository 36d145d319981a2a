"""Files of named latent poses: JSON that says which model they belong to."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from lcollision_core.errors import MeshFileError, ModelFileError
from lcollision_core.meshes import RigidTransform, atomic_write
from lcollision_core.model.encoded_pose import EncodedPose
from lcollision_core.model.pose_model import PoseModel

POSES_FORMAT = "lcollision-poses"
POSES_VERSION = 1
"""The version that `write_poses` stores; later ones are refused."""

MAX_FILE_BYTES = 2**30
MAX_NAME_LENGTH = 200

_NOT_ROTATED = 1e-6


@dataclass(frozen=True)
class NamedPose:
    """One latent pose of a file.

    Attributes
    ----------
    name : unlike that of the file's other poses
    latent : (D,) float64 array
    placement : where the decoded pose belongs, for one that came in as a mesh; None leaves it in
        the reference's frame
    fit_error_mean, fit_error_max : of one that came in as a mesh, in heights
    """

    name: str
    latent: npt.NDArray[np.float64]
    placement: RigidTransform | None = None
    fit_error_mean: float | None = None
    fit_error_max: float | None = None

    @classmethod
    def of_mesh(cls, name: str, encoded: EncodedPose) -> NamedPose:
        """Name an encoded mesh."""
        return cls(
            name, encoded.latent, encoded.placement, encoded.fit_error_mean, encoded.fit_error_max
        )


def write_poses(path: str | os.PathLike[str], model: PoseModel, poses: Sequence[NamedPose]) -> None:
    """Write latent poses, whole or not at all.

    Parameters
    ----------
    path : a .json file in an existing folder
    model : whose latent space they are in
    poses : names all different

    Raises
    ------
    ModelFileError : the extension is not .json, two poses share a name, `read_poses` would refuse
        a pose, or the file cannot be written.
    """
    if Path(path).suffix.lower() != ".json":
        raise ModelFileError(f"{path} cannot be written: poses are a .json file; rename it")
    name, times = Counter(pose.name for pose in poses).most_common(1)[0] if poses else ("", 0)
    if times > 1:
        raise ModelFileError(f"{path} cannot be written: {times} poses are called {name!r}")
    entries = [_to_json(pose) for pose in poses]
    for pose, entry in zip(poses, entries, strict=True):
        try:
            _from_json(entry, model.latent_size)
        except ValueError as error:
            raise ModelFileError(
                f"{path} cannot be written: of the pose {pose.name[:80]!r}, {error}; mend that pose"
            ) from error
    document = {
        "format": POSES_FORMAT,
        "format_version": POSES_VERSION,
        "model": {"name": model.name, "fingerprint": model.fingerprint},
        "poses": entries,
    }
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    try:
        with atomic_write(path) as file:
            file.write(text.encode())
            file.write(b"\n")
    except MeshFileError as error:
        raise ModelFileError(str(error)) from error


def read_poses(path: str | os.PathLike[str], model: PoseModel) -> tuple[NamedPose, ...]:
    """Read latent poses of a model.

    Raises
    ------
    ModelFileError : the file is missing, empty, damaged, no file of poses, of a later version, or
        of another model's poses.
    """
    source = Path(path)
    try:
        if not source.is_file():
            kind = "it is not a plain file" if source.exists() else "there is no such file"
            raise ModelFileError(f"{path} cannot be read: {kind}; name a .json file of poses")
        if source.stat().st_size > MAX_FILE_BYTES:
            raise ModelFileError(f"{path} is larger than {MAX_FILE_BYTES} bytes; split it")
        content = source.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ModelFileError(f"{path} cannot be read: {reason}; check the file") from error
    try:
        document = json.loads(content.decode("utf-8-sig"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise ModelFileError(
            f"{path} is no JSON ({error}); name a file of poses that lcollision wrote"
        ) from error
    return _parse(document, path, model)


def name_of_file(path: Path) -> str:
    """Name a pose after its file, without what a file of poses cannot hold."""
    stem = path.stem.encode(errors="replace").decode()
    return stem[:MAX_NAME_LENGTH]


def unique_names(names: Iterable[str]) -> list[str]:
    """Return the names, numbered where an earlier one differs by case at most: "a", "A 2".

    Numbered names are at most `MAX_NAME_LENGTH` long.
    """
    taken: set[str] = set()
    result = []
    for name in names:
        candidate, number = name, 1
        while candidate.casefold() in taken:
            number += 1
            ending = f" {number}"
            candidate = name[: MAX_NAME_LENGTH - len(ending)] + ending
        taken.add(candidate.casefold())
        result.append(candidate)
    return result


def _parse(document: Any, path: str | os.PathLike[str], model: PoseModel) -> tuple[NamedPose, ...]:
    if not isinstance(document, dict) or document.get("format") != POSES_FORMAT:
        raise ModelFileError(
            f"{path} holds no poses of this program; name a file that lcollision wrote"
        )
    version = document.get("format_version")
    if isinstance(version, int) and version > POSES_VERSION:
        raise ModelFileError(
            f"{path} has format version {version}, this program reads up to {POSES_VERSION}; "
            f"update the program"
        )
    owner, entries = document.get("model"), document.get("poses")
    if version != POSES_VERSION or not isinstance(owner, dict) or not isinstance(entries, list):
        raise ModelFileError(f"{path} is damaged: it lacks its version, model or poses")
    if owner.get("fingerprint") != model.fingerprint:
        raise ModelFileError(
            f"{path} holds poses of the model {owner.get('name')!r} ({owner.get('fingerprint')}), "
            f"which is not {model.name!r} ({model.fingerprint}); name their own model, or decode "
            f"them with it and encode the meshes with this one"
        )
    poses = []
    for place, entry in enumerate(entries):
        try:
            poses.append(_from_json(entry, model.latent_size))
        except ValueError as error:
            raise ModelFileError(
                f"{path} is damaged at pose {place} (from 0): {error}; mend or remove that pose"
            ) from error
    if len({pose.name for pose in poses}) < len(poses):
        raise ModelFileError(f"{path} is damaged: two of its poses share a name; rename one")
    return tuple(poses)


def _to_json(pose: NamedPose) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": pose.name, "latent": pose.latent.tolist()}
    if pose.placement is not None:
        entry["placement"] = {
            "rotation": pose.placement.rotation.tolist(),
            "translation": pose.placement.translation.tolist(),
        }
    if pose.fit_error_mean is not None and pose.fit_error_max is not None:
        entry["fit_error"] = {"mean": pose.fit_error_mean, "max": pose.fit_error_max}
    return entry


def _from_json(entry: Any, latent_size: int) -> NamedPose:
    pose = _object(entry, "entry")
    name = pose.get("name")
    if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME_LENGTH:
        raise ValueError(f"its name must be a text of 1 to {MAX_NAME_LENGTH} characters")
    if any("\ud800" <= character <= "\udfff" for character in name):
        raise ValueError("its name has half a character, which no text file holds")
    latent = _numbers(pose.get("latent"), (latent_size,), "latent")
    placement = None
    if "placement" in pose:
        held = _object(pose["placement"], "placement")
        rotation = _numbers(held.get("rotation"), (3, 3), "rotation")
        translation = _numbers(held.get("translation"), (3,), "translation")
        turned = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not turned < _NOT_ROTATED or np.linalg.det(rotation) < 0.0:
            raise ValueError("its rotation is no rotation matrix")
        placement = RigidTransform(rotation, translation)
    if "fit_error" not in pose:
        return NamedPose(name, latent, placement)
    errors = _object(pose["fit_error"], "fit error")
    mean, largest = _numbers([errors.get("mean"), errors.get("max")], (2,), "fit error")
    return NamedPose(name, latent, placement, float(mean), float(largest))


def _object(value: Any, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"its {name} must be a JSON object")
    return value


def _numbers(value: Any, shape: tuple[int, ...], name: str) -> npt.NDArray[np.float64]:
    try:
        array = np.array(value)
    except ValueError:
        array = np.array(None)
    if array.shape != shape or array.dtype.kind not in "iuf":
        size = " by ".join(map(str, shape))
        raise ValueError(f"its {name} must be {size} numbers")
    numbers = array.astype(np.float64)
    if not np.isfinite(numbers).all():
        raise ValueError(f"its {name} has a number that is not finite")
    return numbers


def _refuse_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is no JSON number")
