"""``lcollision contacts``: which pairs of faces do not count, and how commands report that."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import JsonOption, note, print_json, progress_bar, tell
from app.cli.options import ModelArgument, takes_options
from lcollision_core.options import RuleOptions
from lcollision_core.tasks.words import counted, say, say_number

if TYPE_CHECKING:
    from lcollision_core.bodies import Body, ProposedRules
    from lcollision_core.meshes import ContactRules


@takes_options
def contacts(
    model_name: ModelArgument,
    options: RuleOptions,
    ignore_proposed: Annotated[
        bool,
        typer.Option(
            "--ignore-proposed",
            help="Do not count patches that touch in nearly every pose, nor faces close to them.",
        ),
    ] = False,
    defaults: Annotated[
        bool,
        typer.Option("--defaults", help="Start from the character's default rules."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show which pairs of faces a model or a character does not count, or change that.

    Options add to the current rules and are stored: for a character in your data folder, which the
    editor reads; for a model without a predictor in its file.
    """
    from lcollision_core.bodies import open_body, propose_rules
    from lcollision_core.meshes.contact_rules import pair_in_words

    before = open_body(model_name)
    body = before.with_rules(before.own_rules) if defaults else before
    body = body.with_options(options)
    proposed = None
    if not body.has_predictor:
        with progress_bar("Looking for pairs in contact") as job:
            proposed = propose_rules(body, job)
        if ignore_proposed and proposed is None:
            note("nothing to ignore: few sampled poses collide, or no place touches in nearly all")
    if ignore_proposed and proposed is not None:
        body, proposed = body.with_rules(proposed.rules), None
    keep_rules(model_name, before, body.rules)
    if as_json:
        print_json({"name": body.name, **rules_json(body), "proposed": _proposed_json(proposed)})
        return
    if body.rules.exclude_nothing:
        tell(say("{body}: every pair counts", body=body.name))
    else:
        tell(f"{body.name}: {rules_sentence(body.rules, excluded_at_rest(body))}")
    if proposed is not None:
        fields = {
            "poses": counted(proposed.n_poses, "sampled pose", "sampled poses"),
            "then": proposed.n_colliding_then or "none",
            "places": counted(len(proposed.new), "place", "places"),
        }
        tell(
            say_number(
                proposed.n_colliding,
                "  {n} of {poses} collides, {then} without {places} where parts touch in nearly "
                "all of them; --ignore-proposed leaves these out:",
                "  {n} of {poses} collide, {then} without {places} where parts touch in nearly "
                "all of them; --ignore-proposed leaves these out:",
                **fields,
            )
        )
        for pair, number in proposed.places.items():
            tell(f"    {pair_in_words(pair)}: {counted(number, 'place', 'places')}")


def _proposed_json(proposed: ProposedRules | None) -> dict[str, Any] | None:
    if proposed is None:
        return None
    return {
        "rules": proposed.rules.to_json(),
        "places": [{"groups": list(pair), "n": n} for pair, n in proposed.places.items()],
        "poses": proposed.n_poses,
        "colliding": proposed.n_colliding,
        "colliding_then": proposed.n_colliding_then,
    }


def keep_rules(name: str, body: Body, rules: ContactRules) -> None:
    """Store new contact rules of a body, if they differ, and report it."""
    from lcollision_core.tasks.changing import require_changeable, set_rules

    if rules == body.rules:
        return
    if body.is_trained:
        name = str(require_changeable(name))
    set_rules(body, name, rules)
    note(f"the contact rules of {body.name} have changed")


def note_rules(body: Body) -> None:
    """Print which pairs of faces the figures leave out, and how many there are at rest."""
    if body.rules_are_chosen:
        note(f"{body.name} uses the contact rules that you chose")
    if not body.rules.exclude_nothing:
        note(rules_sentence(body.rules, excluded_at_rest(body)))


def rules_sentence(rules: ContactRules, at_rest: dict[str, int]) -> str:
    """Describe the rules, and how many pairs each one excludes at rest."""
    from lcollision_core.meshes import RuleCounts

    said = RuleCounts(**at_rest).described()
    return f"not counted: {rules.described()}; at rest: {said or 'no pair'}"


def excluded_at_rest(body: Body) -> dict[str, int]:
    """Return how many pairs of the rest pose each rule excludes, as JSON values."""
    from lcollision_core.meshes import RuleCounts

    if body.rules.exclude_nothing:
        return RuleCounts().to_json()
    return body.detector.detect(body.reference).excluded.to_json()


def rules_json(body: Body) -> dict[str, Any]:
    """Return the JSON fields of the contact rules, and how many pairs they exclude at rest."""
    return {"rules": body.rules.to_json(), "excluded_at_rest": excluded_at_rest(body)}
