# SPDX-License-Identifier: GPL-3.0-or-later
"""The controls of a rig such as Rigify's: which bones each one turns, and posing by them.

Blender evaluates the constraints and drivers between controls and deforming bones. So controls are
found by turning each a little and reading the result.
"""

import re
from dataclasses import dataclass, field

import bpy
import numpy as np
from mathutils import Matrix

from .tree import Tree

_SWITCH = "IK_FK"
"""The property of Rigify's limbs that is 1 when they are posed by their FK controls."""

_PROBE, _WHOLE, _APART = 0.1, 0.9, 0.3
"""Radians by which a control is turned; least share of that for its own bone's turn; largest error
of the bones below it, as a share of their way."""

_MOVED, _MOVED_BY_IK = 0.05, 0.75
"""Shares of `_PROBE` above which a bone counts as turned; larger with IK, which twists others."""

_OFF, _SHARE_OFF = 2e-3, 0.3
"""Largest error of an IK chain, in radians and lengths of the longest bone, or as a share of the
way to its target."""

_SAME = 1e-6
"""Tolerance of a matrix entry: a control that differs by no more is not moved."""

State = dict[tuple[str, str], tuple[float, ...]]
"""Values of bone properties, by bone name and path from the bone."""


@dataclass
class Controls:
    """Bones that do not deform, each of which turns a joint with everything that hangs on it.

    Attributes
    ----------
    armature : the object
    tree : of its J joints, the bones that move meshes
    now : for each joint with one, the control that turns it; in limbs posed by IK, the target
    by_fk : for joints of limbs that IK may pose, the FK control
    holders : for the controls of `by_fk`, the bone that follows them once the limb is switched
    switches : for the joints of `by_fk`, the bone with the limb's `_SWITCH`
    locked : joints whose control is locked
    """

    armature: bpy.types.Object
    tree: Tree
    now: dict[int, str] = field(default_factory=dict)
    by_fk: dict[int, str] = field(default_factory=dict)
    holders: dict[str, str] = field(default_factory=dict)
    switches: dict[int, str] = field(default_factory=dict)
    locked: set[int] = field(default_factory=set)

    @classmethod
    def of(cls, armature: bpy.types.Object, tree: Tree) -> "Controls | None":
        """Find the controls of a rig; None if at most the root has one."""
        found, bones = cls(armature, tree), armature.pose.bones
        chosen = candidates(armature)
        switched = {bone.name: bone[_SWITCH] for bone in bones if _SWITCH in bone}
        # In FK, everything that hangs on a joint moves with it.
        for name in switched:
            found._switch_on(name)
        try:
            by_turns = found._probed(chosen, _MOVED)
        finally:
            for name, value in switched.items():
                bones[name][_SWITCH] = value
        own = {name: found._holder(name) for name in by_turns.values()}
        for joint, name in by_turns.items():
            switch = None if own[name] is None else found._switch(own[name])
            if all(bones[name].lock_rotation):
                found.locked.add(joint)
            elif switch is None:
                found.now[joint] = name
            else:
                found.by_fk[joint], found.switches[joint] = name, switch
                found.holders[name] = own[name]
        if any(not found.is_by_fk(one) for one in found.switches.values()):
            others = [name for name in chosen if name not in own]
            targets = found._probed(others, _MOVED_BY_IK)
            for joint, name in targets.items():
                if joint in by_turns and joint not in found.now:
                    if all(bones[name].lock_rotation):
                        found.locked.add(joint)
                    else:
                        found.now[joint] = name
        has_own = found.joints - found.locked
        return found if any(tree.parents[joint] >= 0 for joint in has_own) else None

    @property
    def joints(self) -> set[int]:
        """The joints that unlocked controls turn."""
        return (set(self.now) | set(self.by_fk)) - self.locked

    @property
    def names(self) -> list[str]:
        """The names of the controls."""
        return list(dict.fromkeys((*self.now.values(), *self.by_fk.values())))

    def of_joint(self, joint: int) -> list[str]:
        """Return the names of the controls of a joint."""
        return [one[joint] for one in (self.now, self.by_fk) if joint in one]

    def switch_paths(self) -> list[tuple[str, str]]:
        """Return the properties that switch limbs: names of bones, and paths."""
        return [(name, f'["{_SWITCH}"]') for name in dict.fromkeys(self.switches.values())]

    def state(self) -> State:
        """Return the rotations and locations of the controls, and the limbs' switches."""
        paths = [
            (name, path)
            for name in self.names
            for path in (rotation_path(self.armature.pose.bones[name]), "location")
        ]
        return state_of(self.armature, paths + self.switch_paths())

    def is_by_fk(self, switch: str) -> bool:
        """Return whether a limb is posed by FK now."""
        return self.armature.pose.bones[switch][_SWITCH] >= 1.0

    def _probed(self, chosen: list[str], least: float) -> dict[int, str]:
        """Turn each candidate a little; return the joints' controls in the rig's present state.

        Parameters
        ----------
        least : share of the turn above which a joint counts as turned
        """
        self._update()
        before, own = self._joints(), self._matrices(chosen)
        below = self._below()
        found = {}
        for name, matrix in zip(chosen, own, strict=True):
            bone = self.armature.pose.bones[name]
            path = rotation_path(bone)
            rotation = value_of(bone, path)
            # Turn about an axis across the bone: rigs distribute twists over a limb.
            set_rotation(bone, bone.matrix_basis @ Matrix.Rotation(_PROBE, 4, "X"))
            self._update()
            after, (turned,) = self._joints(), self._matrices([name])
            put_value(bone, path, rotation)
            joint = self._turned(before, after, turned @ np.linalg.inv(matrix), below, least)
            if joint is not None:
                found[joint] = name
        self._update()
        return found

    def _turned(
        self,
        before: np.ndarray,
        after: np.ndarray,
        turn: np.ndarray,
        below: list[np.ndarray],
        least: float,
    ) -> int | None:
        """Return the joint that turns like a control, with all that hangs on it and no other."""
        angles = _angles(before, after) / _PROBE
        is_moved, parents = angles > least, self.tree.parents
        tops = [
            at for at in np.flatnonzero(is_moved) if parents[at] < 0 or not is_moved[parents[at]]
        ]
        if len(tops) != 1 or angles[tops[0]] < _WHOLE:
            return None
        places = before[below[tops[0]], :3, 3]
        wanted = places @ turn[:3, :3].T + turn[:3, 3]
        off = np.linalg.norm(after[below[tops[0]], :3, 3] - wanted, axis=1)
        ways = np.linalg.norm(wanted - places, axis=1)
        return None if (off > _APART * ways.max(initial=0.0)).any() else int(tops[0])

    def _below(self) -> list[np.ndarray]:
        """Return all joints below each joint."""
        n = len(self.tree.bones)
        hangs = np.zeros((n, n), np.bool_)
        for at, above in enumerate(self.tree.parents.tolist()):
            if above >= 0:
                hangs[at] = hangs[above]
                hangs[at, above] = True
        return [np.flatnonzero(column) for column in hangs.T]

    def _holder(self, control: str) -> str | None:
        """Return the bone that copies a control's transforms once the limb is switched to it."""
        for bone in self.armature.pose.bones:
            for one in bone.constraints:
                if one.type == "COPY_TRANSFORMS" and one.subtarget == control:
                    return bone.name
        return None

    def _switch(self, holder: str) -> str | None:
        """Return the bone whose `_SWITCH` drives a bone's constraints."""
        start = f"{self.armature.pose.bones[holder].path_from_id()}.constraints"
        for one in self.armature.animation_data.drivers:
            if one.data_path.startswith(start):
                paths = (
                    target.data_path for each in one.driver.variables for target in each.targets
                )
                for path in paths:
                    found = re.fullmatch(rf'pose\.bones\["(.*)"\]\["{_SWITCH}"\]', path)
                    if found is not None and found[1] in self.armature.pose.bones:
                        return found[1]
        return None

    def _switch_on(self, name: str) -> None:
        """Switch a limb to FK."""
        bone = self.armature.pose.bones[name]
        bone[_SWITCH] = type(bone[_SWITCH])(1)

    def _update(self) -> None:
        self.armature.update_tag()
        bpy.context.view_layer.update()

    def _matrices(self, names: list[str]) -> np.ndarray:
        bones = self.armature.evaluated_get(bpy.context.evaluated_depsgraph_get()).pose.bones
        return np.array([bones[name].matrix for name in names], np.float64).reshape(-1, 4, 4)

    def _joints(self) -> np.ndarray:
        return self._matrices(self.tree.bones)

    def jumping(self, by_fk: set[str]) -> set[tuple[str, str]]:
        """Return the properties that have no effect unless limbs are switched to FK."""
        names = {name for joint, name in self.by_fk.items() if self.switches[joint] in by_fk}
        keys = [key for key in self.state() if key[0] in names]
        return {*keys, *(key for key in self.switch_paths() if key[0] in by_fk)}

    def place(self, targets: np.ndarray, by_fk: set[str]) -> set[str]:
        """Pose the controls so that the joints reach (J, 4, 4) transforms.

        A limb posed by IK keeps its IK if moving the target brings its joints there.

        Parameters
        ----------
        by_fk : switch bones of limbs that are switched to FK in any case

        Returns
        -------
        by_fk : switch bones of all limbs that were switched
        """
        self._update()
        starts = self._joints()
        turns = targets @ np.linalg.inv(starts)
        held = {
            name: (self._matrices([self.holders[name]]) if name in self.holders else at[None])[0]
            for name, at in zip(self.names, self._matrices(self.names), strict=True)
        }
        were = {one for one in self.switches.values() if self.is_by_fk(one)}
        by_fk = {*were, *by_fk}

        def wanted(controls: dict[int, str], only: set[str] | None) -> dict[int, tuple]:
            return {
                joint: (name, turns[joint] @ held[name])
                for joint, name in controls.items()
                if joint not in self.locked and (only is None or self.switches.get(joint) in only)
            }

        kept = {
            joint: name for joint, name in self.now.items() if self.switches.get(joint) not in by_fk
        }
        state = self.state()
        self._place(wanted(kept, None))
        now, longest = self._joints(), max(one.length for one in self.armature.data.bones)
        # IK does not determine the twist within a limb.
        has_target = np.isin(np.arange(len(targets)), list(self.now))
        wants, misses = (
            np.maximum(
                has_target * _angles(targets, at),
                np.linalg.norm(targets[:, :3, 3] - at[:, :3, 3], axis=1) / longest,
            )
            for at in (starts, now)
        )
        limbs: dict[str, list[int]] = {}
        for joint, switch in self.switches.items():
            limbs.setdefault(switch, []).append(joint)
        for switch, own in limbs.items():
            if misses[own].max() > max(_OFF, _SHARE_OFF * wants[own].max()):
                by_fk.add(switch)
        for name in by_fk - were:
            self._switch_on(name)
        # The IK controls of switched limbs stay as they were.
        left = {name for joint, name in kept.items() if self.switches.get(joint) in by_fk}
        put_state(self.armature, {key: one for key, one in state.items() if key[0] in left})
        self._place(wanted(self.by_fk, by_fk))
        return by_fk - were

    def _place(self, wanted: dict[int, tuple[str, np.ndarray]]) -> None:
        """Move the controls of joints to their matrices, from the trunk outwards."""
        depth: list[int] = []
        for above in self.tree.parents.tolist():
            depth.append(0 if above < 0 else depth[above] + 1)
        longest = max(one.length for one in self.armature.data.bones)
        for level in sorted({depth[joint] for joint in wanted}):
            self._update()
            for joint, (name, matrix) in wanted.items():
                if depth[joint] == level:
                    self._put_at(name, matrix, longest)
        self._update()

    def _put_at(self, name: str, matrix: np.ndarray, longest: float) -> None:
        (now,) = self._matrices([name])
        limit = _SAME * np.array([1.0, 1.0, 1.0, longest])
        if not (np.abs(matrix - now) > limit).any():
            return
        bone = self.armature.pose.bones[name]
        above = {}
        if bone.parent is not None:
            (parent,) = self._matrices([bone.parent.name])
            above = {
                "parent_matrix": Matrix(parent.tolist()),
                "parent_matrix_local": bone.parent.bone.matrix_local,
            }
        basis = bone.bone.convert_local_to_pose(
            Matrix(matrix.tolist()), bone.bone.matrix_local, invert=True, **above
        )
        if np.linalg.norm(matrix[:3, 3] - now[:3, 3]) > 100.0 * _SAME * longest:
            for axis, is_locked in enumerate(bone.lock_location):
                if not is_locked:
                    bone.location[axis] = basis.translation[axis]
        set_rotation(bone, basis)


def candidates(armature: bpy.types.Object) -> list[str]:
    """Return the names of bones that may be controls, including locked ones."""
    data = armature.animation_data
    driven = set() if data is None else {one.data_path for one in data.drivers}
    found = []
    for bone in armature.pose.bones:
        locks = [*bone.lock_rotation]
        is_held = any(not one.mute and one.influence > 0.0 for one in bone.constraints)
        is_driven = f"{bone.path_from_id()}.{rotation_path(bone)}" in driven
        if bone.bone.use_deform or is_held or is_driven:
            continue
        if not any(locks) or (all(locks) and bone.custom_shape is not None):
            found.append(bone.name)
    # Of two controls that turn the same bone, the lower one, probed later, wins.
    return sorted(found, key=lambda name: len(armature.data.bones[name].parent_recursive))


def _angles(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the angles in radians between two sets of (J, 4, 4) transforms."""
    axes = [
        one[:, :3, :3] / np.linalg.norm(one[:, :3, :3], axis=1)[:, None] for one in (before, after)
    ]
    return 2.0 * np.arcsin(
        np.clip(np.linalg.norm(axes[1] - axes[0], axis=(1, 2)) / 8.0**0.5, 0.0, 1.0)
    )


def whole_path(bone: bpy.types.PoseBone, path: str) -> str:
    """Return the path of a bone's property from its armature."""
    return bone.path_from_id() + path if path.startswith("[") else bone.path_from_id(path)


def value_of(bone: bpy.types.PoseBone, path: str) -> tuple[float, ...]:
    """Return the values of a bone's property, built-in or custom ('["name"]')."""
    return (bone.path_resolve(path),) if path.startswith("[") else tuple(getattr(bone, path))


def put_value(bone: bpy.types.PoseBone, path: str, value: tuple[float, ...]) -> None:
    """Set the values of a bone's property."""
    if path.startswith("["):
        name = path[2:-2]
        bone[name] = type(bone[name])(value[0])
    else:
        setattr(bone, path, value)


def state_of(armature: bpy.types.Object, paths: list[tuple[str, str]]) -> State:
    """Return the values of properties, given by bone names and paths."""
    return {(name, path): value_of(armature.pose.bones[name], path) for name, path in paths}


def put_state(armature: bpy.types.Object, state: State) -> None:
    """Restore the values of properties."""
    for (name, path), value in state.items():
        put_value(armature.pose.bones[name], path, value)


def rotation_path(bone: bpy.types.PoseBone) -> str:
    """Return the property that holds a bone's rotation."""
    own = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}
    return own.get(bone.rotation_mode, "rotation_euler")


def set_rotation(bone: bpy.types.PoseBone, matrix: Matrix) -> None:
    """Set a rotation in the bone's own mode, near its present values."""
    turn = matrix.to_quaternion()
    if bone.rotation_mode == "QUATERNION":
        # Choose the sign that matches the existing keys.
        turn.make_compatible(bone.rotation_quaternion)
        bone.rotation_quaternion = turn
    elif bone.rotation_mode == "AXIS_ANGLE":
        axis, angle = turn.to_axis_angle()
        bone.rotation_axis_angle = (angle, *axis)
    else:
        bone.rotation_euler = turn.to_euler(bone.rotation_mode, bone.rotation_euler)
