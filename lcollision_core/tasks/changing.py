"""Change and store a body's settings: contact rules, body parts, joint roles and up axis.

A model's file stores them. A character's file is left alone: the user's data folder stores them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lcollision_core.errors import LCollisionError, ModelFileError
from lcollision_core.jobs import Job
from lcollision_core.tasks.opening import OpenedModel

if TYPE_CHECKING:
    from collections.abc import Mapping

    from lcollision_core.bodies import Body, ProposedRules
    from lcollision_core.contact import ProposedPair
    from lcollision_core.meshes import ContactRules


def require_changeable(name: str | Path) -> Path:
    """Return a model's file, or raise if the model is bundled and can only be changed in a copy.

    Raises
    ------
    LCollisionError : the model is bundled.
    """
    from lcollision_core.bodies import find_model, is_bundled

    path = find_model(name)
    if path.is_file() and is_bundled(path):
        raise LCollisionError(
            "is a bundled model and can't be changed",
            f"copy {path} and name the copy",
            where=path.stem,
        )
    return path


def change_body(
    body: Body, file: str | Path, change: Callable[[Any], Any], what: str = "it"
) -> Body:
    """Change a body and store the change.

    Parameters
    ----------
    body, file : the body, and the name or file that it was opened by
    change : maps the stored body to the changed one
    what : name of the change, as in "its contact rules"

    Raises
    ------
    LCollisionError : the body can't be changed, or its file holds another body now.
    """
    from lcollision_core.bodies import change_model, remember_choices

    if not body.is_trained:
        changed: Body = change(body)
        remember_choices(changed)
        return changed

    def change_same(kept: Body) -> Any:
        if kept.fingerprint != body.fingerprint:
            advice = f"open that one to change {what}"
            raise ModelFileError("has been replaced by another model", advice, where=file)
        return change(kept)

    return change_model(require_changeable(file), change_same)


def set_rules(body: Body, file: str, rules: ContactRules) -> OpenedModel:
    """Set and store a body's contact rules; those of a bundled model change in memory only."""
    from lcollision_core.bodies import is_bundled

    if not (body.is_trained and is_bundled(file)):
        change_body(body, file, lambda kept: kept.with_rules(rules), "its contact rules")
    return OpenedModel(body.with_rules(rules), file)


def propose_pairs(body: Body, job: Job) -> dict[str, tuple[ProposedPair, ...]]:
    """Propose groups to ignore, by kind, from some of the poses that came with the body."""
    from lcollision_core.bodies import typical_poses
    from lcollision_core.contact import propose_by_kind

    return propose_by_kind(body.detector, typical_poses(body), body.groups_by_kind, job=job)


def offered_rules(body: Body, job: Job) -> tuple[ProposedRules | None, bool]:
    """Propose rules for a character if most of its poses collide: see `bodies.propose_rules`.

    Returns
    -------
    proposed : or None
    is_offered : whether there is a proposal that the user has not declined before
    """
    from lcollision_core.bodies import propose_rules
    from lcollision_core.bodies.remembered import is_offer_declined

    proposed = propose_rules(body, job)
    return proposed, proposed is not None and not is_offer_declined(body)


def set_joint_roles(body: Body, roles: Mapping[str, str | None]) -> None:
    """Store roles for joints of a character, as in knee-left; None for the automatic role.

    They apply when the character is opened again.

    Raises
    ------
    LCollisionError : the body lacks such a joint, or has no joints.
    """
    from lcollision_core.bodies import remember_roles

    if body.joints is None:
        advice = "give --role with a rigged character"
        raise LCollisionError("has no joints", advice, where=body.name)
    remember_roles(body, roles)


def set_up_axis(body: Body, file: str | Path, axis: int) -> Body:
    """Set and store the up axis of a model or a character, 0, 1 or 2."""
    from lcollision_core.bodies import open_body, remember_up

    if body.is_trained:
        return change_body(body, file, lambda kept: kept.turned_upright(axis), "its up axis")
    if body.character is None:
        return body
    remember_up(body, axis)
    return open_body(body.character)


@dataclass(frozen=True)
class PartEdits:
    """New names, colours and order of body parts.

    Attributes
    ----------
    names, colours : of the changed domains, by index from 0
    order : all domains in listing order, None to keep it
    copy_name : name of a new user model to change, None to change the model's own file
    """

    names: Mapping[int, str]
    colours: Mapping[int, str]
    order: tuple[int, ...] | None = None
    copy_name: str | None = None


def edit_parts(body: Body, file: str, edits: PartEdits) -> OpenedModel:
    """Rename, recolour or reorder a body's parts, in place or in a copy among the user's models.

    Raises
    ------
    LCollisionError : as in `change_body`, or a model with the copy's name exists.
    """
    from lcollision_core.bodies import model_destination
    from lcollision_core.files import locked

    def edit(kept: Body) -> Body:
        return kept.edit_domains(edits.names, edits.colours, edits.order)

    if edits.copy_name is None:
        edited, path = change_body(body, file, edit, "its body parts"), Path(file)
    else:
        edited, path = edit(body), model_destination(edits.copy_name)
        with locked(path):
            if path.exists():
                what = f"a model {edits.copy_name!r} already exists"
                raise ModelFileError(what, "choose another name")
            edited.save(path)
    if not body.is_trained:
        return OpenedModel(edited, file)
    # Keep what the open model has loaded and compiled.
    return OpenedModel(body.with_card(edited.card, path.stem), str(path))
