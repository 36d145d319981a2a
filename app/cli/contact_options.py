"""Options and reports of the commands that let people say which pairs of faces do not count."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli.console import note
from lcollision_core.errors import LCollisionError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from lcollision_core.meshes import ContactRules, FaceGroup, Topology
    from lcollision_core.model import PosableBody

NearExclusionOption = Annotated[
    float | None,
    typer.Option(
        min=0.0,
        max=1.0,
        metavar="X",
        help="Count pairs within X body sizes along the surface separately. Default: what the "
        "character's own rules say, else 0.",
    ),
]
RestExclusionOption = Annotated[
    float | None,
    typer.Option(
        min=0.0,
        max=1.0,
        metavar="R",
        help="Do not count pairs that touch in the rest pose, or within R body sizes of such a "
        "pair along the surface. 0: those pairs only.",
    ),
]
RestOption = Annotated[
    Path | None,
    typer.Option(
        metavar="MESH",
        readable=False,
        help="The rest pose of the meshes: body size and distances are measured on it, and pairs "
        "that touch in it are not counted.",
    ),
]
IgnoreOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="A:B",
        help="Do not count pairs between these two groups of faces: meshes, materials, body "
        "parts or components, as in 'component 1:component 2' (component 1 has the most "
        "faces). May be repeated.",
    ),
]
LeaveOutOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Leave a mesh, material, body part or component out of the check, such as a weapon "
        "that has a stand-in. It is still posed and exported. May be repeated.",
    ),
]
JointExclusionOption = Annotated[
    bool | None,
    typer.Option(
        "--joint-exclusion/--no-joint-exclusion",
        help="Do not count pairs of parts linked by a joint where both faces are within a limb's "
        "thickness of it. On by default for a character with joints.",
    ),
]
ToleratedDepthOption = Annotated[
    float | None,
    typer.Option(min=0.0, max=1.0, metavar="D", help="Do not count pairs up to D body sizes deep."),
]
NoRulesOption = Annotated[
    bool, typer.Option("--no-rules", help="Count all pairs and ignore the character's rules.")
]


@dataclass(frozen=True)
class RuleOptions:
    """What the options say; None leaves the rule as it is."""

    near_exclusion: float | None = None
    rest_exclusion: float | None = None
    ignore: Sequence[str] | None = None
    tolerated_depth: float | None = None
    joint_exclusion: bool | None = None
    leave_out: Sequence[str] | None = None

    def applied(
        self,
        rules: ContactRules,
        groups: tuple[FaceGroup, ...],
        topology: Topology,
        vertex_labels: npt.NDArray[np.str_] | None = None,
    ) -> tuple[ContactRules, tuple[FaceGroup, ...]]:
        """Return the rules with these options, and the groups with those that they name.

        Parameters
        ----------
        rules, groups : of the mesh or pose set
        vertex_labels : (V,) names of body parts, where they are known

        Raises
        ------
        LCollisionError : an ignored pair is not two names of groups, or an unknown one is left out.
        """
        from lcollision_core.meshes import groups_by_kind, with_named_groups

        names_groups = self.ignore or self.leave_out
        kinds = groups_by_kind(groups, topology, vertex_labels) if names_groups else {}
        names = {group.name for kind in kinds.values() for group in kind}
        changed = self._changed(rules, names)
        return changed, with_named_groups(groups, kinds, changed.named_groups)

    def applied_to(self, body: PosableBody) -> PosableBody:
        """Return a body with these options added to its rules.

        Raises
        ------
        LCollisionError : an ignored or left out group is unknown, it has no joints to leave
            out pairs at, or a predictor depends on its rules.
        """
        if self.joint_exclusion and not body.has_joints:
            what = "has no joints, which --joint-exclusion needs"
            next_step = "leave the option out, or learn the model again from a rigged character"
            raise LCollisionError(what, next_step, where=body.name)
        groups = body.groups_by_kind.values() if self.ignore or self.leave_out else ()
        rules = self._changed(body.rules, {group.name for kind in groups for group in kind})
        return body if rules == body.rules else body.with_rules(rules)

    def _changed(self, rules: ContactRules, names: Collection[str]) -> ContactRules:
        from lcollision_core.meshes import named_group, named_pair

        options = {
            "near_exclusion": self.near_exclusion,
            "rest_exclusion": self.rest_exclusion,
            "joint_exclusion": self.joint_exclusion,
            "tolerated_depth": self.tolerated_depth,
        }
        chosen: dict[str, Any] = {name: to for name, to in options.items() if to is not None}
        pairs = (named_pair(entry, names) for entry in self.ignore or ())
        left_out = (named_group(entry, names) for entry in self.leave_out or ())
        return replace(
            rules,
            **chosen,
            ignored=tuple(dict.fromkeys((*rules.ignored, *pairs))),
            left_out=tuple(dict.fromkeys((*rules.left_out, *left_out))),
        )


def note_rules(body: PosableBody) -> None:
    """Report the pairs of faces that the figures leave out, and how many that is at rest."""
    if body.rules_are_chosen:
        note(f"{body.name} uses the contact rules that you chose")
    if not body.rules.exclude_nothing:
        note(rules_sentence(body.rules, excluded_at_rest(body)))


def rules_sentence(rules: ContactRules, at_rest: dict[str, int]) -> str:
    """Write what is not counted, and how many pairs each rule excludes at rest."""
    from lcollision_core.meshes import RuleCounts

    said = RuleCounts(**at_rest).described()
    return f"not counted: {rules.described()}; at rest: {said or 'no pair'}"


def excluded_at_rest(body: PosableBody) -> dict[str, int]:
    """Return how many pairs of the rest pose each rule excludes, for JSON."""
    from lcollision_core.meshes import RuleCounts

    if body.rules.exclude_nothing:
        return RuleCounts().to_json()
    return body.detector.detect(body.reference).excluded.to_json()


def rules_json(body: PosableBody) -> dict[str, Any]:
    """Return the JSON fields that say which pairs do not count, and how many of them at rest."""
    return {"rules": body.rules.to_json(), "excluded_at_rest": excluded_at_rest(body)}
