"""Open bodies by name or file, and remember the user's choices for characters.

There is one JSON file per rig, in the user's data folder.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from lcollision_core.bodies.body import Body
from lcollision_core.bodies.learned_body import LearnedBody, ListedModel
from lcollision_core.bodies.rig_body import RigBody
from lcollision_core.bundled import user_folder
from lcollision_core.errors import LCollisionError, MeshFileError, ModelFileError, ShapeError
from lcollision_core.files import (
    Character,
    Mesh,
    locked,
    read_character,
    read_own_file,
    with_up_axis,
    without_user_choices,
)
from lcollision_core.files.formats import FILES, MODEL_SUFFIX, SCENE_SUFFIXES, SMPL_SUFFIX
from lcollision_core.files.motion.smpl import refuse_pickle
from lcollision_core.files.safe import read_regular, write_bytes
from lcollision_core.files.scene_files import SceneDocument, open_scene
from lcollision_core.json_values import from_json, parse_document
from lcollision_core.meshes import ContactRules, Topology
from lcollision_core.meshes.topology import FloatArray

_FORMAT, _VERSION = "lcollision-character", 1
_MAX_BYTES = 10_000_000
_LIKE_REST = 0.2
"""Largest relative difference of a pose's total edge length from rest."""

_PARTS = ("domain_names", "domain_colours", "domain_order")


@dataclass(frozen=True)
class RememberedChoices:
    """Choices remembered for a rig; None for what was not chosen.

    Attributes
    ----------
    file : path that it was last opened from
    rules, domain_names, domain_colours, domain_order : see `ModelCard`
    up_axis : 0, 1 or 2, if the file's is wrong
    roles : pairs of a joint's name and its role, of `anatomy.ROLE_NAMES`
    mesh : digest of its faces, to recognise meshes of its poses
    offer_declined : True if the user does not want the rules proposed from its poses
    """

    file: str
    rules: ContactRules | None = None
    domain_names: tuple[str, ...] | None = None
    domain_colours: tuple[str, ...] | None = None
    domain_order: tuple[int, ...] | None = None
    up_axis: Annotated[int, Meta(ge=0, le=2)] | None = None
    roles: tuple[tuple[str, str], ...] | None = None
    mesh: str | None = None
    offer_declined: bool | None = None


def user_characters_folder() -> Path:
    """Return the folder of remembered characters, which may not exist yet."""
    return user_folder("characters")


def known_character(fingerprint: str) -> RememberedChoices | None:
    """Return the choices remembered for a rig, None if there are none.

    Parameters
    ----------
    fingerprint : of the rig: see `RigBody.fingerprint`

    Raises
    ------
    ModelFileError : its file is damaged, of a later version, or cannot be read.
    """
    path = _path(fingerprint)
    try:
        document = parse_document(read_regular(path, _MAX_BYTES), _FORMAT, _VERSION, path)
        return from_json(RememberedChoices, document, "the character")
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ModelFileError.unreadable(path, error, "remove it, and choose again") from error


def _readable_character(fingerprint: str) -> RememberedChoices | None:
    """Return the choices remembered for a rig; None if there are none or they are unreadable."""
    try:
        return known_character(fingerprint)
    except ModelFileError:
        # `with_remembered` reports it.
        return None


def find_character(fingerprint: str) -> ListedModel | None:
    """Return the file that a rig was last opened from, None if it is gone or unknown.

    Parameters
    ----------
    fingerprint : of the rig, as stored in a pose file
    """
    if not re.fullmatch("[0-9a-f]{16}", fingerprint):
        return None
    entry = _readable_character(fingerprint)
    if entry is None or not Path(entry.file).is_file():
        return None
    return ListedModel(Path(entry.file).stem, Path(entry.file), bundled=False)


def open_character(
    source: str | os.PathLike[str] | SceneDocument | Character,
    up: int | None = None,
    *,
    clips: bool = True,
) -> RigBody:
    """Read a character and apply the user's choices of axis, joint roles, rules and body parts.

    Notes report the choices, or why they could not be applied.

    Parameters
    ----------
    source : its file, the result of `open_scene` on it, or the character itself
    up : the up axis, which overrides a remembered one
    clips : whether to read the clips' frames, which is slow

    Raises
    ------
    MeshFileError : see `read_character`.
    LCollisionError : the character has no rig.
    """
    character = (
        without_user_choices(source) if isinstance(source, Character) else read_character(source)
    )
    if not clips:
        character = replace(character, clips={})
    model = RigBody.of(character if up is None else with_up_axis(character, up))
    try:
        entry = known_character(model.fingerprint)
        if up is None and entry is not None and entry.up_axis is not None:
            model = RigBody.of(with_up_axis(character, entry.up_axis))
            entry = known_character(model.fingerprint)
        if entry is not None and entry.roles is not None:
            model = model.with_roles(dict(entry.roles))
    except (ModelFileError, ShapeError):
        # Damaged, as `with_remembered` reports.
        pass
    except LCollisionError as error:
        model = model.noted(f"your joint roles were ignored: {error.headline}")
    return with_remembered(model)


def with_remembered(model: RigBody) -> RigBody:
    """Apply the user's rules and body parts to a character.

    Notes report them, or why they could not be applied.
    """
    try:
        entry = known_character(model.fingerprint)
        if entry is None:
            return model
        remembered = {name: getattr(entry, name) for name in _PARTS}
        remembered = {name: value for name, value in remembered.items() if value is not None}
        changed = model.with_card(replace(model.card, **remembered)) if remembered else model
        if entry.rules is None:
            return changed
        return changed.with_rules(entry.rules).noted(
            "its contact rules are those that you chose for it"
        )
    except LCollisionError as error:
        return model.noted(f"your settings for it were ignored: {error.headline}")


def character_of_mesh(path: Path, mesh: Mesh) -> tuple[RigBody, FloatArray] | None:
    """Return the character whose pose a mesh file holds, with its rules, and that pose.

    The file is one that a character was exported to, with its rules; the file of a character for
    which rules were chosen; or a mesh with the same faces in the same order as a character opened
    before, as a note says.

    Parameters
    ----------
    path : of the file
    mesh : read from it

    Returns
    -------
    body : the character; None is returned if there is none
    vertices : (V, 3) float64 array, in its unit

    Raises
    ------
    MeshFileError : the character's data in the file is damaged or outdated.
    LCollisionError : a character that was opened before cannot be opened now.
    """
    suffix = path.suffix.lower()
    document = open_scene(path) if suffix in SCENE_SUFFIXES else None
    own_file = None if document is None else read_own_file(document)
    if own_file is not None:
        return RigBody.of(own_file.character).with_roles(own_file.roles).with_rules(
            own_file.rules
        ), own_file.vertices
    if document is not None and document.has_skin:
        body = open_character(document, clips=False)
        if known_character(body.fingerprint) is not None and mesh.topology == body.topology:
            # Whatever touches in its stored pose would not count by the usual rules.
            return (body, mesh.vertices) if body.rules_are_chosen else None
    digest = _digest(mesh.topology)
    for file in sorted(user_characters_folder().glob("*.json")):
        entry = _readable_character(file.stem)
        if entry is not None and entry.mesh == digest and Path(entry.file).is_file():
            body = open_character(entry.file, clips=False)
            if body.topology == mesh.topology:
                body = body.noted(f"it has the faces of {entry.file}, which was opened before")
                return body, mesh.vertices * _unit_of(mesh.vertices, body)
    return None


def _unit_of(vertices: FloatArray, body: RigBody) -> float:
    """Return the scale from a pose's unit to a body's, a power of ten if nearly one."""
    ratio = float(
        body.topology.edge_lengths(body.reference).sum()
        / body.topology.edge_lengths(vertices).sum()
    )
    power = float(10.0 ** np.round(np.log10(ratio)))
    return power if abs(ratio / power - 1.0) < _LIKE_REST else ratio


def remember_file(model: Body, file: str | os.PathLike[str]) -> None:
    """Remember a character's file, so that pose files can find it.

    Parameters
    ----------
    file : that it was opened from

    Raises
    ------
    ModelFileError : the file cannot be written.
    """
    path = str(Path(file).absolute())
    _change(model, lambda known: replace(known, file=path))


def remember_up(model: Body, up: int) -> None:
    """Remember the up axis of a character whose file is wrong about it.

    Parameters
    ----------
    up : 0, 1 or 2; the file's own axis is not stored

    Raises
    ------
    ModelFileError : the file cannot be written.
    """
    if model.character is None:
        return
    read_body = RigBody.of(without_user_choices(model.character))
    chosen_axis = None if up == read_body.up_axis else up
    _change(read_body, lambda known: replace(known, up_axis=chosen_axis))


def remember_roles(model: Body, roles: Mapping[str, str | None]) -> None:
    """Remember the user's roles for joints of a character, including earlier ones.

    As this changes its codes, it counts as another character, which inherits the contact rules.

    Parameters
    ----------
    roles : by joint name; None for the automatic role

    Raises
    ------
    LCollisionError : the body has no joints, or a joint or role is unknown.
    ModelFileError : the file cannot be written.
    """
    if not isinstance(model, RigBody):
        raise LCollisionError("has no joints", "open a rigged character", where=model.name)
    all_roles = {**model.space.rig.chosen, **roles}
    roles_kept = {name: role for name, role in all_roles.items() if role is not None}
    changed, unchanged = model.with_roles(roles_kept), model.with_roles({})
    pairs = tuple(roles_kept.items()) or None
    _change(unchanged, lambda known: replace(known, roles=pairs))
    if model.rules_are_chosen and known_character(changed.fingerprint) is None:
        _change(changed, lambda known: replace(known, rules=model.rules))


def remember_choices(model: Body) -> None:
    """Remember a character's rules and body parts as far as they differ from its file's.

    Raises
    ------
    ModelFileError : the file cannot be written.
    """
    if not isinstance(model, RigBody):
        return
    own_card, card = model.own_card, model.card
    choices = {name: getattr(card, name) for name in ("rules", *_PARTS)}
    changed: dict[str, Any] = {
        name: None if getattr(own_card, name) == choices[name] else choices[name]
        for name in choices
    }
    _change(model, lambda known: replace(known, **changed))


def remember_offer_declined(model: Body) -> None:
    """Remember not to offer again the contact rules proposed from a character's poses.

    Raises
    ------
    ModelFileError : the file cannot be written.
    """
    _change(model, lambda known: replace(known, offer_declined=True))


def is_offer_declined(model: Body) -> bool:
    """Return whether the user declined the rules proposed from a character's poses."""
    entry = None if model.character is None else _readable_character(model.fingerprint)
    return entry is not None and entry.offer_declined is True


def _change(model: Body, change: Callable[[RememberedChoices], RememberedChoices]) -> None:
    """Change the choices remembered for a body, under a lock.

    Does nothing for bodies without joints: a model's own file stores its choices.
    """
    if model.own_file is None:
        return
    path = _path(model.fingerprint)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path):
            before = known_character(model.fingerprint)
            known = change(before or RememberedChoices(str(model.own_file)))
            known = replace(known, mesh=_digest(model.topology))
            if known == before:
                return
            entries = {name: entry for name, entry in asdict(known).items() if entry is not None}
            document = {"format": _FORMAT, "format_version": _VERSION, **entries}
            write_bytes(path, json.dumps(document, indent=1).encode() + b"\n")
    except (OSError, MeshFileError) as error:
        raise ModelFileError.because(
            f"the settings of {model.name}", "could not be saved", error, "try again"
        ) from error


def _digest(topology: Topology) -> str:
    faces = topology.faces.astype("<i4").tobytes()
    return hashlib.sha256(b"%d " % topology.n_vertices + faces).hexdigest()[:16]


def _path(fingerprint: str) -> Path:
    return user_characters_folder() / f"{fingerprint}.json"


def open_body(
    source: str | os.PathLike[str] | SceneDocument | Character, up: int | None = None
) -> Body:
    """Read a body that can take poses; the user's choices are applied to characters.

    Parameters
    ----------
    source : a model file, the name of a bundled or user model, the file of a rigged character or
        of a body model of the SMPL family, or one already read: see `open_character`
    up : the up axis, 0, 1 or 2, of a character whose file is wrong about it

    Raises
    ------
    ModelFileError : see `LearnedBody.load`.
    MeshFileError : see `read_character`.
    LCollisionError : the character has no rig.
    """
    if isinstance(source, SceneDocument | Character):
        return open_character(source, up)
    refuse_pickle(source)
    suffix = Path(source).suffix.lower()
    if suffix in (*SCENE_SUFFIXES, SMPL_SUFFIX):
        return open_character(source, up)
    if suffix in FILES and suffix != MODEL_SUFFIX and Path(source).is_file():
        raise MeshFileError(
            f"is a {suffix} file, not a single body that can be posed",
            f"name a model, or the file of a rigged character ({', '.join(SCENE_SUFFIXES)})",
            where=source,
        )
    return LearnedBody.load(source)
