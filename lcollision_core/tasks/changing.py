"""Change what is kept of a body: contact rules, body parts, the roles of joints, the up axis.

A model keeps it in its file. A character's file is not ours: the user's data folder keeps it.
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
    from lcollision_core.meshes import ContactRules, RuleCounts


def require_changeable(name: str | Path) -> Path:
    """Return the file of a model, or refuse one that is changed in a copy alone.

    Raises
    ------
    LCollisionError : the model is a bundled one.
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
    """Change a body, and keep the change.

    Parameters
    ----------
    body, file : the body, and the name or file that it was opened by
    change : gets the body that is kept now, and returns the one to keep
    what : changes, as in "its contact rules"

    Raises
    ------
    LCollisionError : the body can't be changed, or its file holds another one by now.
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
    """Give a body other contact rules, and keep them; a bundled model's change in memory alone."""
    from lcollision_core.bodies import is_bundled

    if not (body.is_trained and is_bundled(file)):
        change_body(body, file, lambda kept: kept.with_rules(rules), "its contact rules")
    return OpenedModel(body.with_rules(rules), file)


@dataclass(frozen=True)
class ContactsAtRest:
    """What the contact rules make of the rest pose.

    Attributes
    ----------
    n_counted : colliding pairs that count
    excluded : how many each rule leaves out
    """

    n_counted: int
    excluded: RuleCounts


def contacts_at_rest(body: Body) -> ContactsAtRest:
    """Count the colliding pairs of the rest pose by the rules that leave them out."""
    collisions = body.detector.detect(body.reference)
    return ContactsAtRest(len(collisions.pairs), collisions.excluded)


def propose_pairs(body: Body, job: Job) -> dict[str, tuple[ProposedPair, ...]]:
    """Propose groups to ignore, by kind, by some of the poses that the body came with."""
    from lcollision_core.bodies import typical_poses
    from lcollision_core.contact import propose_by_kind

    return propose_by_kind(body.detector, typical_poses(body), body.groups_by_kind, job=job)


def offered_rules(body: Body, job: Job) -> tuple[ProposedRules | None, bool]:
    """Propose rules for a character most of whose poses collide: see `bodies.propose_rules`.

    Returns
    -------
    proposed : or None
    is_offered : whether the user has not declined them before
    """
    from lcollision_core.bodies import propose_rules
    from lcollision_core.bodies.known import is_offer_declined

    proposed = propose_rules(body, job)
    return proposed, proposed is not None and not is_offer_declined(body)


def set_joint_roles(body: Body, roles: Mapping[str, str | None]) -> None:
    """Keep what joints of a character are, as in knee-left; None for what its rig says.

    Opened again, the character has them.

    Raises
    ------
    LCollisionError : it has no such joints, or no joints at all.
    """
    from lcollision_core.bodies import remember_roles

    if body.joints is None:
        advice = "give --role with a rigged character"
        raise LCollisionError("has no joints", advice, where=body.name)
    remember_roles(body, roles)


def set_up_axis(body: Body, file: str | Path, axis: int) -> Body:
    """Turn a model or a character so that an axis, 0, 1 or 2, is up, and keep that."""
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
    names, colours : of the domains that change, by index from 0
    order : all domains in listing order, None if that stays
    copy_name : of the user's own model to make, None to change the model's file
    """

    names: Mapping[int, str]
    colours: Mapping[int, str]
    order: tuple[int, ...] | None = None
    copy_name: str | None = None


def edit_parts(body: Body, file: str, edits: PartEdits) -> OpenedModel:
    """Rename, recolour or reorder the parts of a body, or of a copy that becomes the user's own.

    Raises
    ------
    LCollisionError : as for `change_body`, or there is a model of the copy's name.
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
    # What the open model has loaded and compiled stays.
    return OpenedModel(body.with_card(edited.card, path.stem), str(path))
