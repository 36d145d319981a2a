"""Which faces lie about a joint that links what they are of, so that their crossing is a crease."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from lcollision_core.files.character import Character, Rig
from lcollision_core.meshes.contact_rules import MAX_NAME_LENGTH
from lcollision_core.meshes.face_groups import MAX_GROUPS, FaceGroup, part_groups
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.meshes.units import body_size

_STEPS = 3
"""Joints up the tree that are linked: from an upper arm over a collar bone to the chest."""

_END = 1 / 3
"""Of a bone: a limb's radius at a joint is that of its faces up to so far along it."""

_WITHIN = 75.0
"""Per cent of these faces that lie within the radius: the others are flaps and folds of clothes."""

_MOST_THICK = 0.1
"""Normalised length: a thigh's thickness; no limb is taken for thicker."""

_ON_BONE = 0.25
"""Of the thickness: a twist joint is no farther than this from the bone that it twists with."""

_BETWEEN = 0.8
"""Of the thickness: what is this near to both joints lies between two limbs that branch. X Bot's
thighs meet there within 0.78 of it when it steps, and cross from 1.3 on."""

_SAME_PLACE = 1e-3
"""Normalised length."""


def joint_groups(character: Character) -> tuple[FaceGroup, ...]:
    """Return the faces about each joint: of the parts that it links, within the limb's thickness.

    A joint links the part that it moves with the parts that it hangs on, up to three steps, and
    with those of the twist joints along their bone. Two limbs that branch off one part, as thighs
    and fingers do, are linked where both of their joints are near: in the crotch, between knuckles.
    The thickness is twice the radius of the thinner of the part and its parent at the joint, at
    most 0.1 in normalised length; the middle of a face counts.

    Returns
    -------
    groups : named after their joints, of each that has a parent and of pairs that branch; none
        without a rig
    """
    rig = character.rig
    if rig is None:
        return ()
    topology, rest = character.topology, character.rest_vertices
    size, centres = body_size(rest, topology), rig.rest[:, :3, 3]
    main = rig.joint_of[np.arange(len(rest)), rig.weights.argmax(axis=1)]
    # By number, as names may be cut.
    faces_of = {int(part.name): part.faces for part in part_groups(topology, main.astype(np.str_))}
    parents = _linked_parents(rig, set(faces_of), _SAME_PLACE * size)
    middles = rest[topology.faces].mean(axis=1)
    thickness: dict[int, float] = {}
    groups: list[FaceGroup] = []

    def add(faces: list[int], joints: tuple[int, ...], share: float) -> None:
        about = np.sort(np.concatenate([faces_of[joint] for joint in faces]))
        for joint in joints:
            away = np.linalg.norm(middles[about] - centres[joint], axis=1)
            about = about[away <= share * thickness[joint]]
        if len(about) > 1:
            names = "".join(filter(str.isprintable, ", ".join(rig.joint_names[j] for j in joints)))
            name = names.strip()[:MAX_NAME_LENGTH] or f"joint {joints[0]}"
            groups.append(FaceGroup(name, about, about_joint=True))

    linked = [joint for joint in faces_of if parents[joint] >= 0]
    for joint in linked:
        children = [child for child in linked if parents[child] == joint]
        own, above, centre = faces_of[joint], parents[joint], centres[joint]
        end = centres[children].mean(axis=0) if children else middles[own].mean(axis=0)
        radius = min(
            _radius(middles[own] - centre, end - centre),
            _radius(middles[faces_of[above]] - centre, centres[above] - centre),
        )
        thickness[joint] = min(2.0 * radius, _MOST_THICK * size)
        add(_linked(joint, parents, centres, _ON_BONE * thickness[joint]), (joint,), 1.0)
    for one, other in combinations(linked, 2):
        if parents[one] == parents[other]:
            apart = float(np.linalg.norm(centres[one] - centres[other]))
            if apart < thickness[one] + thickness[other]:
                add([one, other], (one, other), _BETWEEN)
    # Where there are that many, the small ones are strands of hair.
    return tuple(sorted(groups, key=lambda group: -len(group.faces))[:MAX_GROUPS])


def _linked_parents(rig: Rig, moving: set[int], tolerance: float) -> dict[int, int]:
    """Return of each joint that moves faces the next one up that does, -1 for none.

    One that moves none is stood for by a child at its place, as in rigs whose deforming joints all
    hang on others that control them.
    """
    centres, parents = rig.rest[:, :3, 3], rig.parents.tolist()
    stand_in = {joint: joint for joint in moving}
    for joint in sorted(moving):
        parent = parents[joint]
        if parent >= 0 and np.linalg.norm(centres[joint] - centres[parent]) <= tolerance:
            stand_in.setdefault(parent, joint)
    found = {}
    for joint in sorted(moving):
        above = parents[joint]
        while above >= 0 and stand_in.get(above, joint) == joint:
            above = parents[above]
        found[joint] = stand_in[above] if above >= 0 else -1
    return found


def _linked(
    joint: int, parents: dict[int, int], centres: FloatArray, tolerance: float
) -> list[int]:
    """Return the joints whose parts a joint links, itself among them."""
    linked = [joint]
    while len(linked) <= _STEPS and parents[linked[-1]] >= 0:
        linked.append(parents[linked[-1]])
    start = centres[linked[1]]
    bone = centres[joint] - start
    for other, parent in parents.items():
        beside = linked[1] in (parent, parents.get(parent)) and joint not in (other, parent)
        if beside and other not in linked:
            from_start = centres[other] - start
            share = np.clip(from_start @ bone / max(float(bone @ bone), 1e-300), 0.0, 1.0)
            if np.linalg.norm(from_start - share * bone) <= tolerance:
                linked.append(other)
    return linked


def _radius(middles: FloatArray, bone: FloatArray) -> float:
    """Return the radius of a limb's end at the origin, from which its bone leads.

    Parameters
    ----------
    middles : (n, 3) float64 array of its faces
    bone : (3,) float64 array
    """
    length = float(np.linalg.norm(bone))
    axis = bone / max(length, 1e-300)
    along = middles @ axis
    away = np.linalg.norm(middles - along[:, None] * axis, axis=1)
    near = np.abs(along) <= _END * length
    return float(np.percentile(away[near] if near.any() else away, _WITHIN))
