"""Options that say which pairs of faces do not count."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any

from lcollision_core.errors import LCollisionError
from lcollision_core.options.field import Option

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from lcollision_core.meshes import ContactRules, FaceGroup, Topology


@dataclass(frozen=True, kw_only=True)
class RuleOptions:
    """Changes of contact rules; None leaves a rule as it is, groups are added to its own.

    Attributes
    ----------
    near_exclusion, rest_exclusion, tolerated_depth, joint_exclusion : see `ContactRules`
    ignored : "A:B", names of groups of faces whose pairs do not count
    left_out : names of groups of faces that take no part in the check
    tolerated_pairs : "A:B=DEPTH", names of groups of faces and what their pairs may have
    """

    near_exclusion: Annotated[
        float | None,
        Option(
            "Count pairs within X body sizes along the surface separately. Default: what the "
            "character's own rules say, else 0.",
            metavar="X",
            low=0,
            below=1,
        ),
    ] = None
    rest_exclusion: Annotated[
        float | None,
        Option(
            "Do not count pairs that touch in the rest pose, or within R body sizes of such a pair "
            "along the surface. 0: those pairs only.",
            metavar="R",
            low=0,
            below=1,
        ),
    ] = None
    joint_exclusion: Annotated[
        bool | None,
        Option(
            "Do not count pairs of parts linked by a joint where both faces are within a limb's "
            "thickness of it. On by default for a character with joints.",
            ("--joint-exclusion/--no-joint-exclusion",),
        ),
    ] = None
    ignored: Annotated[
        tuple[str, ...] | None,
        Option(
            "Do not count pairs between these two groups of faces: meshes, materials, body parts "
            "or components, as in 'component 1:component 2' (component 1 has the most faces). May "
            "be repeated.",
            ("--ignore",),
            metavar="A:B",
        ),
    ] = None
    left_out: Annotated[
        tuple[str, ...],
        Option(
            "Leave a mesh, material, body part or component out of the check, such as a weapon "
            "that has a stand-in. It is still posed and exported. May be repeated.",
            ("--leave-out",),
            metavar="NAME",
        ),
    ] = ()
    tolerated_depth: Annotated[
        float | None,
        Option("Do not count pairs up to D body sizes deep.", metavar="D", low=0, below=1),
    ] = None
    tolerated_pairs: Annotated[
        tuple[str, ...],
        Option(
            "Do not count pairs between these two groups up to DEPTH body sizes deep, whatever "
            "--tolerated-depth says, as in 'belly:left hand=0.01'. May be repeated.",
            ("--tolerate",),
            metavar="A:B=DEPTH",
        ),
    ] = ()

    @property
    def name_groups(self) -> bool:
        """Whether they name groups of faces."""
        return bool(self.ignored or self.left_out or self.tolerated_pairs)

    def changed(
        self, rules: ContactRules, names: Collection[str], has_joints: bool, where: str
    ) -> ContactRules:
        """Return the rules with these options.

        Parameters
        ----------
        names : of the groups of faces that the mesh has
        has_joints : whether some of these lie about joints
        where : what the mesh is called

        Raises
        ------
        LCollisionError : an ignored or tolerated pair is not two of the names, a depth is out of
            its range, what is left out is none, or there are no joints to leave out pairs at.
        """
        from lcollision_core.meshes import named_group, named_pair

        if self.joint_exclusion and not has_joints:
            what = "has no joints, which --joint-exclusion needs"
            next_step = "leave the option out, or learn the model again from a rigged character"
            raise LCollisionError(what, next_step, where=where)
        values = {field.name: getattr(self, field.name) for field in fields(RuleOptions)}
        chosen: dict[str, Any] = {name: to for name, to in values.items() if to is not None}
        if self.near_exclusion is not None:
            chosen["near_by_limb"] = False
        pairs = (named_pair(entry, names) for entry in self.ignored or ())
        left_out = (named_group(entry, names) for entry in self.left_out)
        chosen["ignored"] = tuple(dict.fromkeys((*rules.ignored, *pairs)))
        chosen["left_out"] = tuple(dict.fromkeys((*rules.left_out, *left_out)))
        tolerated = (_tolerated_pair(entry, names) for entry in self.tolerated_pairs)
        by_pair = {frozenset(one[:2]): one for one in (*rules.tolerated_pairs, *tolerated)}
        chosen["tolerated_pairs"] = tuple(by_pair.values())
        return replace(rules, **chosen)

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
        LCollisionError : as of `changed`.
        """
        from lcollision_core.meshes import groups_by_kind, with_named_groups

        kinds = groups_by_kind(groups, topology, vertex_labels) if self.name_groups else {}
        names = {group.name for kind in kinds.values() for group in kind}
        has_joints = any(group.about_joint for group in groups)
        changed = self.changed(rules, names, has_joints, "the mesh")
        return changed, with_named_groups(groups, kinds, changed.named_groups)


def _tolerated_pair(entry: str, names: Collection[str]) -> tuple[str, str, float]:
    """Read "A:B=DEPTH"."""
    from lcollision_core.meshes import named_pair

    pair, _, number = entry.rpartition("=")
    try:
        depth = float(number)
    except ValueError:
        depth = -1.0
    if not pair or not 0.0 <= depth < 1.0:
        what = "is not A:B=DEPTH with a depth of 0 or more and below 1 body size"
        example = "name two groups of faces and a depth, as in 'belly:left hand=0.01'"
        raise LCollisionError(what, example, where=f"the tolerated pair {entry!r}")
    return *named_pair(pair, names, "the tolerated pair"), depth


NO_CHANGE = RuleOptions()
"""Leaves all rules as they are."""
