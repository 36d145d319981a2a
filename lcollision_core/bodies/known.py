"""Bodies by their names and files, and what a user has chosen for a character.

One JSON file for each rig, in the user's data folder.
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
from lcollision_core.errors import LCollisionError, MeshFileError, ModelFileError, ShapeError
from lcollision_core.files import (
    Character,
    Mesh,
    as_read,
    locked,
    read_character,
    read_own_file,
    turned,
)
from lcollision_core.files.safe import atomic_write, read_regular
from lcollision_core.files.scene.smpl import refuse_pickle
from lcollision_core.files.scene_files import SceneDocument, open_scene
from lcollision_core.files.table import SCENE_SUFFIXES, SMPL_SUFFIX
from lcollision_core.json_values import from_json, parse_json, quoted
from lcollision_core.meshes import ContactRules, Topology
from lcollision_core.meshes.topology import FloatArray

_FORMAT, _VERSION = "lcollision-character", 1
_MAX_BYTES = 10_000_000
_LIKE_REST = 0.2
"""By how much the edges of poses may be longer or shorter than at rest, all together."""

_PARTS = ("domain_names", "domain_colours", "domain_order")


@dataclass(frozen=True)
class KnownCharacter:
    """What is remembered of a rig; of what was not chosen, None.

    Attributes
    ----------
    file : where it was last opened from
    rules, domain_names, domain_colours, domain_order : see `ModelCard`
    up_axis : 0, 1 or 2, where the file is wrong about it
    roles : pairs of a joint's name and what it is, of `characters.ROLE_NAMES`
    mesh : a digest of its faces, by which meshes of its poses are known
    offer_declined : True where the user does not want the rules that its poses propose
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
    """Return the folder of what is remembered of characters, which may not exist yet."""
    from platformdirs import user_data_path

    return user_data_path("lcollision", appauthor=False) / "characters"


def known_character(fingerprint: str) -> KnownCharacter | None:
    """Return what is remembered of a rig, None for nothing.

    Parameters
    ----------
    fingerprint : of the rig: see `RigBody.fingerprint`

    Raises
    ------
    ModelFileError : its file is damaged, of a later version, or cannot be read.
    """
    path = _path(fingerprint)
    try:
        document = parse_json(read_regular(path, _MAX_BYTES))
        if not isinstance(document, dict) or document.get("format") != _FORMAT:
            raise ValueError("it contains something else")
        version = document.get("format_version")
        if isinstance(version, int) and version > _VERSION:
            raise ModelFileError.too_new(path, quoted(version), _VERSION)
        return from_json(KnownCharacter, document, "the character")
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ModelFileError.unreadable(path, error, "remove it, and choose again") from error


def _readable_character(fingerprint: str) -> KnownCharacter | None:
    """Return what is remembered of a rig, None for nothing and for what cannot be read."""
    try:
        return known_character(fingerprint)
    except ModelFileError:
        # Opening the character says so.
        return None


def find_character(fingerprint: str) -> ListedModel | None:
    """Return the file that a rig was last opened from, None if it is gone or unknown.

    Parameters
    ----------
    fingerprint : of the rig, as a file of poses says it
    """
    if not re.fullmatch("[0-9a-f]{16}", fingerprint):
        return None
    known = _readable_character(fingerprint)
    if known is None or not Path(known.file).is_file():
        return None
    return ListedModel(Path(known.file).stem, Path(known.file), bundled=False)


def open_character(
    source: str | os.PathLike[str] | SceneDocument | Character,
    up: int | None = None,
    *,
    clips: bool = True,
) -> RigBody:
    """Read a character, with the axis, joints, rules and body parts that the user chose for it.

    Its notes say so, or why what is remembered does not apply.

    Parameters
    ----------
    source : its file, what `open_scene` read of that, or the character, whose file is not read
    up : the axis that is up now, whatever was chosen
    clips : whether their frames are wanted, which take long

    Raises
    ------
    MeshFileError : see `read_character`.
    LCollisionError : the character has no rig.
    """
    character = as_read(source) if isinstance(source, Character) else read_character(source)
    if not clips:
        character = replace(character, clips={})
    model = RigBody.of(character if up is None else turned(character, up))
    try:
        known = known_character(model.fingerprint) if up is None else None
        if known is not None and known.up_axis is not None:
            model = RigBody.of(turned(character, known.up_axis))
            known = known_character(model.fingerprint)
        known = known or known_character(model.fingerprint)
        if known is not None and known.roles is not None:
            model = model.with_roles(dict(known.roles))
    except (ModelFileError, ShapeError):
        # It is damaged, as `with_remembered` says.
        pass
    except LCollisionError as error:
        model = model.noted(f"what you chose for its joints is left out: {error.headline}")
    return with_remembered(model)


def with_remembered(model: RigBody) -> RigBody:
    """Return a character with the rules and body parts that the user chose for it.

    Its notes say so, or why what is remembered does not apply.
    """
    try:
        known = known_character(model.fingerprint)
        if known is None:
            return model
        chosen = {name: getattr(known, name) for name in _PARTS}
        chosen = {name: value for name, value in chosen.items() if value is not None}
        changed = model.with_card(replace(model.card, **chosen)) if chosen else model
        if known.rules is None:
            return changed
        return changed.with_rules(known.rules).noted(
            "its contact rules are those that you chose for it"
        )
    except LCollisionError as error:
        return model.noted(f"what you chose for it is left out: {error.headline}")


def character_of_mesh(path: Path, mesh: Mesh) -> tuple[RigBody, FloatArray] | None:
    """Return the character that a mesh file has a pose of, with its rules, and that pose.

    That is a file that a character was written to, with the rules that it had; a character's own
    file that was opened before, or a mesh of the same faces in the same order as one that was.

    Parameters
    ----------
    path : of the file
    mesh : that it holds

    Returns
    -------
    body : the character; None for a mesh of another or of none
    vertices : (V, 3) float64 array, in its unit

    Raises
    ------
    MeshFileError : what the file says of its character is damaged, or changed since.
    LCollisionError : the character, which was opened before, cannot be opened now.
    """
    suffix = path.suffix.lower()
    document = open_scene(path) if suffix in SCENE_SUFFIXES else None
    own = None if document is None else read_own_file(document)
    if own is not None:
        return RigBody.of(own.character).with_roles(own.roles).with_rules(own.rules), own.vertices
    if document is not None and document.has_skin:
        body = open_character(document, clips=False)
        if known_character(body.fingerprint) is not None and mesh.topology == body.topology:
            return body, mesh.vertices
    digest = _digest(mesh.topology)
    for file in sorted(user_characters_folder().glob("*.json")):
        known = _readable_character(file.stem)
        if known is not None and known.mesh == digest and Path(known.file).is_file():
            body = open_character(known.file, clips=False)
            if body.topology == mesh.topology:
                return body, mesh.vertices * _unit_of(mesh.vertices, body)
    return None


def _unit_of(vertices: FloatArray, body: RigBody) -> float:
    """Return the unit of a pose in that of a body, of units a power of ten where it nearly is."""
    ratio = float(
        body.topology.edge_lengths(body.reference).sum()
        / body.topology.edge_lengths(vertices).sum()
    )
    power = float(10.0 ** np.round(np.log10(ratio)))
    return power if abs(ratio / power - 1.0) < _LIKE_REST else ratio


def remember_file(model: Body, file: str | os.PathLike[str]) -> None:
    """Keep where a character is, for files of poses that belong to it.

    Parameters
    ----------
    file : that it was opened from

    Raises
    ------
    ModelFileError : it cannot be kept.
    """
    path = str(Path(file).absolute())
    _change(model, lambda known: replace(known, file=path))


def remember_up(model: Body, up: int) -> None:
    """Keep which axis is up for a character whose file is wrong about it.

    Parameters
    ----------
    up : 0, 1 or 2; what the file says is not remembered

    Raises
    ------
    ModelFileError : it cannot be kept.
    """
    if model.character is None:
        return
    own = RigBody.of(as_read(model.character))
    chosen = None if up == own.up_axis else up
    _change(own, lambda known: replace(known, up_axis=chosen))


def remember_roles(model: Body, roles: Mapping[str, str | None]) -> None:
    """Keep what the user says that joints of a character are, also of those named before.

    Its codes are others then, so it counts as another character, which keeps the contact rules.

    Parameters
    ----------
    roles : of joints by their names; None for what names and skeleton say

    Raises
    ------
    LCollisionError : the body has no joints or no such joint, or there is no such role.
    ModelFileError : it cannot be kept.
    """
    if not isinstance(model, RigBody):
        raise LCollisionError("has no joints", "open a rigged character", where=model.name)
    chosen = {**model.space.rig.chosen, **roles}
    roles_kept = {name: role for name, role in chosen.items() if role is not None}
    changed, own = model.with_roles(roles_kept), model.with_roles({})
    pairs = tuple(roles_kept.items()) or None
    _change(own, lambda known: replace(known, roles=pairs))
    if model.rules_are_chosen and known_character(changed.fingerprint) is None:
        _change(changed, lambda known: replace(known, rules=model.rules))


def remember_choices(model: Body) -> None:
    """Keep what the rules and body parts of a character differ in from those of its file.

    Raises
    ------
    ModelFileError : it cannot be kept.
    """
    if not isinstance(model, RigBody):
        return
    own, card = model.own_card, model.card
    chosen = {name: getattr(card, name) for name in ("rules", *_PARTS)}
    changed: dict[str, Any] = {
        name: None if getattr(own, name) == chosen[name] else chosen[name] for name in chosen
    }
    _change(model, lambda known: replace(known, **changed))


def remember_offer_declined(model: Body) -> None:
    """Keep that the contact rules which a character's poses propose are not to be offered again.

    Raises
    ------
    ModelFileError : it cannot be kept.
    """
    _change(model, lambda known: replace(known, offer_declined=True))


def is_offer_declined(model: Body) -> bool:
    """Return whether the rules that a character's poses propose are not to be offered."""
    known = None if model.character is None else _readable_character(model.fingerprint)
    return known is not None and known.offer_declined is True


def _change(model: Body, change: Callable[[KnownCharacter], KnownCharacter]) -> None:
    """Read what is remembered, change it and write it back; no other window's change is lost.

    Nothing is remembered of a body without joints: a model's own file holds what is chosen.
    """
    if model.own_file is None:
        return
    path = _path(model.fingerprint)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path):
            before = known_character(model.fingerprint)
            known = change(before or KnownCharacter(str(model.own_file)))
            known = replace(known, mesh=_digest(model.topology))
            if known == before:
                return
            chosen = {name: entry for name, entry in asdict(known).items() if entry is not None}
            document = {"format": _FORMAT, "format_version": _VERSION, **chosen}
            with atomic_write(path) as file:
                file.write(json.dumps(document, indent=1).encode() + b"\n")
    except (OSError, MeshFileError) as error:
        raise ModelFileError.because(
            f"what is remembered of {model.name}", "cannot be kept", error, "try again"
        ) from error


def _digest(topology: Topology) -> str:
    faces = topology.faces.astype("<i4").tobytes()
    return hashlib.sha256(b"%d " % topology.n_vertices + faces).hexdigest()[:16]


def _path(fingerprint: str) -> Path:
    return user_characters_folder() / f"{fingerprint}.json"


def open_body(
    source: str | os.PathLike[str] | SceneDocument | Character, up: int | None = None
) -> Body:
    """Read a body that can take poses; a character with what the user has chosen for it.

    Parameters
    ----------
    source : a model's file, the name of a bundled or user model, the file of a rigged character or
        of a body model of the SMPL family, or what was read of one: see `open_character`
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
    if Path(source).suffix.lower() in (*SCENE_SUFFIXES, SMPL_SUFFIX):
        return open_character(source, up)
    return LearnedBody.load(source)
