"""Options and reports of contact rules: which pairs of faces do not count."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import note

if TYPE_CHECKING:
    from lcollision_core.bodies import Body
    from lcollision_core.meshes import ContactRules

RestOption = Annotated[
    Path | None,
    typer.Option(
        metavar="MESH",
        readable=False,
        help="The rest pose of the meshes: body size and distances are measured on it, and pairs "
        "that touch in it are not counted.",
    ),
]
ClearanceOption = Annotated[
    float,
    typer.Option(
        "--clearance",
        metavar="C",
        min=0.0,
        max=1.0,
        help="Distance to keep between parts, in body sizes: faces that are nearer count as "
        "colliding. Parts near at rest may come to half their rest distance.",
    ),
]
TouchOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="A:B",
        help="With --clearance, these two groups of faces may touch: meshes, materials, body parts "
        "or components. May be repeated.",
    ),
]
NoRulesOption = Annotated[
    bool, typer.Option("--no-rules", help="Count all pairs and ignore the character's rules.")
]


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
