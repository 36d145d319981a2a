# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading a character as Blender shows it, in its armature's coordinates, and writing its bones.

The evaluated meshes are checked: with constraints, drivers, shape keys and modifiers. Vertices and
transforms are float64, in the unit of the armature object.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy

import bpy
import numpy as np
from mathutils import Matrix, Vector

from .controls import Controls, State, candidates, put_state, rotation_path, set_rotation, state_of
from .tree import Tree, carrier_of, is_deformed_by, is_moved, read_tree

_MEMBER = 0.5
"""Weight above which a vertex belongs to a vertex group."""

OFF_RIG = 1e-4
"""Offset, in body sizes, above which a mesh counts as moved by more than its bones."""

HIDDEN, UNTICKED = "hidden", "not ticked"
"""Reasons why a mesh of a character is not checked."""
_FLAT = 1e-9
"""An armature whose axes span less than this share of an orthogonal volume has no depth."""

_STILL = 1e-7
"""Translation, in lengths of the longest bone, below which a bone only turns."""

_IN_PLANE = 1e-2
"""Twice the distance from a mirror's plane, in longest bones, below which a bone lies in it."""

_TURNED = 1e-5
"""Change of a matrix entry, or in longest bones, below which a bone stays as it was."""


class SceneError(Exception):
    """A sentence on what is wrong with the scene."""


class Caution(str):
    """A report on the work done, shown as a warning."""


class Rigged:
    """An armature and the meshes that its bones move: deformed, or carried like a helmet.

    Parameters
    ----------
    armature : the object
    meshes : the objects, sorted by name
    left_out : further meshes of the character, and why each is not checked
    tree : of the bones that move the meshes; read if not given

    Attributes
    ----------
    armature, meshes, left_out : as given
    bones : J names of the bones that move meshes, parents first
    parents : (J,) int32 array, -1 for none
    controls : that turn the bones; None if the bones are turned directly
    """

    def __init__(
        self,
        armature: bpy.types.Object,
        meshes: list[bpy.types.Object],
        left_out: tuple[tuple[bpy.types.Object, str], ...] = (),
        tree: Tree | None = None,
    ) -> None:
        self.armature, self.meshes, self.left_out = armature, meshes, left_out
        self._was_active: bpy.types.Object | None = None
        self._hidden: list[tuple[bpy.types.Object, bool, bool]] = []
        self._further: list[bpy.types.Object] = []
        self._carriers = {
            one: None if is_deformed_by(one, armature) else carrier_of(one, armature)
            for one in meshes
        }
        self._tree = tree or read_tree(armature, meshes, set(self._carriers.values()) - {None})
        self.bones, self.parents = self._tree.bones, self._tree.parents
        self.controls: Controls | None = None

    @classmethod
    def of(cls, context: bpy.types.Context) -> "Rigged":
        """Return the active armature, or that of the active mesh, with all its visible meshes.

        Meshes that the user has unticked are left out.

        Raises
        ------
        SceneError : there is no such armature or mesh, or the pose is not shown.
        """
        active = context.view_layer.objects.active
        armatures = [one for one in context.view_layer.objects if one.type == "ARMATURE"]
        armature = active
        if active is not None and active.type == "MESH":
            armature = next((one for one in armatures if is_moved(active, one)), None)
        if armature is None or armature.type != "ARMATURE":
            raise SceneError("Make a mesh with an armature active")
        meshes, left_out = [], []
        for one in sorted(context.view_layer.objects, key=lambda one: one.name):
            if one.type != "MESH" or not is_moved(one, armature):
                continue
            if not one.visible_get():
                left_out.append((one, HIDDEN))
            elif not one.lcollision_is_checked:
                left_out.append((one, UNTICKED))
            else:
                meshes.append(one)
        if not meshes:
            raise SceneError(f"No visible mesh is deformed by {armature.name}")
        found = cls(armature, meshes, tuple(left_out))
        if not found.bones:
            raise SceneError(f"No bone of {armature.name} deforms a mesh")
        found._ensure_pose_is_shown()
        return found

    def _ensure_pose_is_shown(self) -> None:
        """Refuse a character that is not shown in its pose: the verdict would not apply to it."""
        name = self.armature.name
        for item in (self.armature, *self.meshes):
            if item.data.is_editmode:
                raise SceneError(
                    f"{item.name} is in Edit Mode, which hides the pose; leave it (Tab)"
                )
        if self.armature.data.pose_position == "REST":
            raise SceneError(
                f"{name} is shown in its rest position; choose Pose Position (armature properties)"
            )
        for mesh in self.meshes:
            bound = [
                one.show_viewport
                for one in mesh.modifiers
                if one.type == "ARMATURE" and one.object == self.armature
            ]
            if bound and not any(bound):
                raise SceneError(
                    f"{mesh.name} does not follow its pose: its Armature modifier is off in the "
                    "viewport; switch it on, or hide the mesh"
                )
        columns = self.armature.matrix_world.to_3x3().col
        volume = np.prod([one.length for one in columns])
        if abs(self.armature.matrix_world.to_3x3().determinant()) <= _FLAT * volume:
            raise SceneError(f"{name} is scaled to 0; give it a scale in all directions")

    def by_controls(self) -> "Rigged | None":
        """Return the same character, posed by its rig's controls; None if none are found."""
        controls = Controls.of(self.armature, self._tree)
        if controls is None:
            return None
        found = copy(self)
        found.controls = controls
        return found

    @property
    def may_have_controls(self) -> bool:
        """Whether some bone may be a control; Resolve finds out what it turns."""
        return bool(candidates(self.armature))

    @property
    def is_copied(self) -> bool:
        """Whether the resolved pose is written to a baked copy."""
        return self.controls is None and self.is_driven

    def writers(self, joint: int) -> list[str]:
        """Return the names of the bones that turn a joint."""
        return [self.bones[joint]] if self.controls is None else self.controls.of_joint(joint)

    def jumping(self, by_fk: set[str]) -> set[tuple[str, str]]:
        """Return the properties that have no effect unless limbs are switched to FK."""
        return set() if self.controls is None else self.controls.jumping(by_fk)

    def ensure_writable(self) -> None:
        """Refuse to resolve an armature whose changes no file would keep, before computing.

        Raises
        ------
        SceneError : the armature is linked from another file.
        """
        library = self.armature.library
        if library is not None:
            raise SceneError(
                f"{self.armature.name} is linked from {bpy.path.basename(library.filepath)}, and "
                "changes to it are lost when the file is saved; make it editable first "
                "(Object > Library Override > Make)"
            )

    @property
    def is_driven(self) -> bool:
        """Whether anything but keys may move bones: constraints, IK or drivers."""
        constrained = any(
            not one.mute and one.influence > 0.0
            for bone in self.armature.pose.bones
            for one in bone.constraints
        )
        data = self.armature.animation_data
        return constrained or (data is not None and len(data.drivers) > 0)

    def moved_besides(self) -> list[str]:
        """List the influences that move the meshes besides the turns of bones."""
        found = []
        for mesh in self.meshes:
            modifiers = [one for one in mesh.modifiers if one.show_viewport]
            for one in modifiers:
                if one.type != "ARMATURE":
                    found.append(f"{one.name} of {mesh.name}")
                elif one.use_deform_preserve_volume:
                    found.append(f"Preserve Volume of {mesh.name}")
            keys = mesh.data.shape_keys
            if keys is not None and any(one.value and not one.mute for one in keys.key_blocks[1:]):
                found.append(f"shape keys of {mesh.name}")
        for name in self.bones:
            bone = self.armature.pose.bones[name]
            if max(abs(size - 1.0) for size in bone.scale) > _TURNED:
                found.append(f"the scale of {name}")
            if bone.bone.bbone_segments > 1:
                found.append(f"the bend of {name}")
        return found

    def left_out_lines(self) -> str:
        """Return a line for each mesh that is not checked, with the reason."""
        return "\n".join(f"{item.name} ({why})" for item, why in self.left_out)

    def key(self) -> tuple:
        """Return a key that is cheap to compute and changes with the character."""
        graph = bpy.context.evaluated_depsgraph_get()
        shown = (one.evaluated_get(graph).data for one in self.meshes)
        counts = tuple(
            (one.name, len(one.data.vertices), len(mesh.vertices), len(mesh.polygons))
            for one, mesh in zip(self.meshes, shown, strict=True)
        )
        return self.armature.name, tuple(self.bones), self.parents.tobytes(), counts

    def shown(self) -> np.ndarray:
        """Return the (W, 3) vertices of all meshes as shown."""
        graph = bpy.context.evaluated_depsgraph_get()
        points = []
        for one, into in self._evaluated(graph):
            mesh = one.to_mesh()
            own = np.empty(3 * len(mesh.vertices), np.float32)
            mesh.vertices.foreach_get("co", own)
            points.append(own.reshape(-1, 3) @ into[:3, :3].T + into[:3, 3])
            one.to_mesh_clear()
        return np.concatenate(points)

    def transforms(self) -> np.ndarray:
        """Return the (J, 4, 4) transforms of the bones as shown."""
        graph = bpy.context.evaluated_depsgraph_get()
        bones = self.armature.evaluated_get(graph).pose.bones
        read = np.array([bones[name].matrix for name in self.bones], dtype=np.float64)
        return self._mirrored(read)

    def _evaluated(self, graph: bpy.types.Depsgraph) -> Iterator[tuple]:
        """Yield each evaluated mesh with its (4, 4) matrix to the armature's coordinates."""
        armature = np.array(self.armature.evaluated_get(graph).matrix_world, dtype=np.float64)
        for item in self.meshes:
            one = item.evaluated_get(graph)
            yield one, np.linalg.inv(armature) @ np.array(one.matrix_world, dtype=np.float64)

    def to_world(self) -> np.ndarray:
        """Return the (4, 4) matrix from armature to world coordinates."""
        graph = bpy.context.evaluated_depsgraph_get()
        return np.array(self.armature.evaluated_get(graph).matrix_world, dtype=np.float64)

    def world_size(self) -> float:
        """Return the length of an armature unit in world coordinates."""
        return float(np.cbrt(abs(np.linalg.det(self.to_world()[:3, :3]))))

    def as_character(self) -> dict:
        """Return the fields of an `open_mesh` request: rest meshes, weights and bones."""
        bones = self.armature.data.bones
        rest = np.array([bones[name].matrix_local for name in self.bones], dtype=np.float64)
        with self._at_rest():
            graph = bpy.context.evaluated_depsgraph_get()
            parts = [self._part(one, into) for one, into in self._evaluated(graph)]
        world = self.to_world()
        up = np.linalg.inv(world[:3, :3]) @ [0.0, 0.0, 1.0]
        axis = int(np.abs(up).argmax())
        return {
            "name": self.armature.name,
            "parts": parts,
            "joints": list(self.bones),
            "parents": self.parents,
            "rest": rest,
            "up": ("-" if up[axis] < 0.0 else "") + "xyz"[axis],
            "metres": self.world_size() * bpy.context.scene.unit_settings.scale_length,
        }

    @contextmanager
    def _at_rest(self) -> Iterator[None]:
        data = self.armature.data
        before = data.pose_position
        data.pose_position = "REST"
        try:
            yield
        finally:
            data.pose_position = before

    def _part(self, one: bpy.types.Object, into: np.ndarray) -> dict:
        """Return one evaluated mesh as a part of an `open_mesh` request."""
        joint = {name: number for number, name in enumerate(self.bones)}
        carrier = self._carriers[one.original]
        of_group = [
            joint.get(group.name, -1) if carrier is None else -1
            for group in one.original.vertex_groups
        ]
        mesh = one.to_mesh()
        n = len(mesh.vertices)
        points = np.empty(3 * n, np.float32)
        mesh.vertices.foreach_get("co", points)
        rows, joints, weights = [], [], []
        members = {group.index: [] for group in one.original.vertex_groups}
        for row, vertex in enumerate(mesh.vertices):
            for group in vertex.groups:
                if group.weight > _MEMBER and group.group in members:
                    members[group.group].append(row)
                if group.group < len(of_group) and of_group[group.group] >= 0 and group.weight > 0:
                    rows.append(row)
                    joints.append(of_group[group.group])
                    weights.append(group.weight)
        if carrier is not None:
            rows, joints, weights = range(n), [joint[carrier]] * n, [1.0] * n
        # As many columns as the largest number of influences of a vertex.
        counts = np.bincount(np.array(rows, dtype=np.int64), minlength=n)
        column = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        joint_of = np.zeros((n, max(1, counts.max(initial=0))), np.int32)
        shares = np.zeros(joint_of.shape)
        joint_of[rows, column] = joints
        shares[rows, column] = weights
        mesh.calc_loop_triangles()
        n_faces = len(mesh.loop_triangles)
        faces, material_of = np.empty(3 * n_faces, np.int32), np.empty(n_faces, np.int32)
        mesh.loop_triangles.foreach_get("vertices", faces)
        mesh.loop_triangles.foreach_get("material_index", material_of)
        one.to_mesh_clear()
        materials = [slot.name for slot in one.original.material_slots]
        groups = [
            {"name": group.name, "vertices": np.array(members[group.index], dtype=np.int32)}
            for group in one.original.vertex_groups
        ]
        return {
            "name": one.name,
            "vertices": points.reshape(-1, 3) @ into[:3, :3].T + into[:3, 3],
            "faces": faces.reshape(-1, 3),
            "joint_of": joint_of,
            "weights": shares,
            "materials": materials,
            "groups": groups,
            "material_of": np.where(material_of < len(materials), material_of, -1).astype(np.int32),
        }

    def triangles(self) -> np.ndarray:
        """Return the (F, 3) vertex indices of all shown triangles, in the engine's face order."""
        graph = bpy.context.evaluated_depsgraph_get()
        found, first = [], 0
        for one, _ in self._evaluated(graph):
            mesh = one.to_mesh()
            mesh.calc_loop_triangles()
            faces = np.empty(3 * len(mesh.loop_triangles), np.int32)
            mesh.loop_triangles.foreach_get("vertices", faces)
            found.append(faces.reshape(-1, 3) + first)
            first += len(mesh.vertices)
            one.to_mesh_clear()
        return np.concatenate(found)

    def locked(self) -> list[str]:
        """Return the bones whose rotations are all locked.

        If a copy is written, locks of bones that constraints and drivers move do not count: rigs
        lock these so that nobody turns them by hand. A control's locks count for the bone that it
        turns.
        """
        if self.controls is not None:
            return [self.bones[joint] for joint in sorted(self.controls.locked)]
        bones, driven = self.armature.pose.bones, self._driven() if self.is_driven else set()
        return [
            name for name in self.bones if all(bones[name].lock_rotation) and name not in driven
        ]

    def _reflection(self) -> np.ndarray | None:
        """Return the (4, 4) reflection of a Mirror modifier after the armature; None without."""
        for mesh in self.meshes:
            shown = [one for one in mesh.modifiers if one.show_viewport]
            kinds = [one.type for one in shown]
            after = kinds.index("ARMATURE") if "ARMATURE" in kinds else len(shown)
            for one in shown[after:]:
                if one.type == "MIRROR" and any(one.use_axis):
                    flipped = np.eye(4)
                    axis = [*one.use_axis].index(True)
                    flipped[axis, axis] = -1.0
                    plane = np.array((one.mirror_object or mesh).matrix_world, dtype=np.float64)
                    into = np.linalg.inv(self.to_world()) @ plane
                    return into @ flipped @ np.linalg.inv(into)
        return None

    def in_mirrors(self) -> set[str]:
        """Return the bones that lie in the plane of a Mirror modifier after the armature.

        It shows one side as the mirror image of the other, so a bone in the plane must not turn.
        """
        reflection = self._reflection()
        if reflection is None:
            return set()
        found, bones = set(), self.armature.data.bones
        for name in self.bones:
            ends = np.array([bones[name].head_local, bones[name].tail_local])
            apart = ends @ reflection[:3, :3].T + reflection[:3, 3] - ends
            if np.abs(apart).max() < _IN_PLANE * self.longest_bone:
                found.add(name)
        return found

    def _mirrored(self, transforms: np.ndarray) -> np.ndarray:
        """Give the bones of a side that a Mirror modifier generates the other side's transforms."""
        reflection = self._reflection()
        if reflection is None:
            return transforms
        number, bones = {name: at for at, name in enumerate(self.bones)}, self.armature.data.bones
        after = transforms.copy()
        for at, name in enumerate(self.bones):
            other = number.get(bpy.utils.flip_name(name), at)
            if not self._tree.moves[at] and self._tree.moves[other]:
                own, its = (
                    np.array(bones[self.bones[one]].matrix_local, dtype=np.float64)
                    for one in (at, other)
                )
                moved = transforms[other] @ np.linalg.inv(its)
                after[at] = reflection @ moved @ np.linalg.inv(reflection) @ own
        return after

    def _driven(self) -> set[str]:
        """Return the bones that constraints or drivers move, directly or by a skipped ancestor."""
        data = self.armature.animation_data
        paths = [] if data is None else [one.data_path for one in data.drivers]
        moved = {
            bone.name
            for bone in self.armature.pose.bones
            if any(not one.mute and one.influence > 0.0 for one in bone.constraints)
            or any(path.startswith(f"{bone.path_from_id()}.") for path in paths)
        }
        found = set()
        for name, above in zip(self.bones, self._tree.own_parents, strict=True):
            bone = self.armature.data.bones[name]
            until = self.bones[above] if above >= 0 else None
            while bone is not None and bone.name != until:
                if bone.name in moved:
                    found.add(name)
                bone = bone.parent
        return found

    def state(self) -> State:
        """Return the present values of the properties that are written."""
        if self.controls is not None:
            return self.controls.state()
        bones = self.armature.pose.bones
        paths = [
            (name, path) for name in self.bones for path in (rotation_path(bones[name]), "location")
        ]
        return state_of(self.armature, paths)

    def put(self, state: State) -> None:
        """Restore the properties that are written."""
        put_state(self.armature, state)
        self.armature.update_tag()

    def turn(
        self,
        transforms: np.ndarray,
        joints: list[int],
        turns: np.ndarray,
        by_fk: set[str] = frozenset(),
    ) -> set[str]:
        """Turn bones from their present pose.

        Parameters
        ----------
        transforms : (J, 4, 4) of the present pose
        joints, turns : n indices and (n, 4, 4), from the engine's answer
        by_fk : limbs to be posed by FK, see `Controls.place`

        Returns
        -------
        by_fk : limbs that were switched to FK
        """
        if self.controls is not None:
            return self.controls.place(self.posed(transforms, joints, turns), by_fk)
        for joint, turn in zip(*self.in_bones(transforms, joints, turns), strict=True):
            if not self._tree.moves[joint]:
                # With a Mirror modifier, the vertices belong to the other side's bones.
                continue
            bone = self.armature.pose.bones[self.bones[joint]]
            after = bone.matrix_basis @ Matrix(turn.tolist())
            set_rotation(bone, after)
            shift = np.abs(np.array(after.translation) - np.array(bone.location))
            if shift.max() > _STILL * self.longest_bone:
                bone.location = after.translation
        return set()

    def posed(self, transforms: np.ndarray, joints: list[int], turns: np.ndarray) -> np.ndarray:
        """Return the (J, 4, 4) transforms after turning some bones, with everything below them.

        Parameters
        ----------
        transforms : (J, 4, 4) before
        joints, turns : n indices and (n, 4, 4), from the engine's answer
        """
        turn_of, after = dict(zip(joints, turns, strict=True)), np.empty_like(transforms)
        for at, above in enumerate(self.parents.tolist()):
            before, now = (np.eye(4),) * 2 if above < 0 else (transforms[above], after[above])
            own = np.linalg.inv(before) @ transforms[at]
            turn = turn_of.get(at)
            if turn is not None:
                # A bone is scaled before it turns.
                size = np.append(np.linalg.norm(own[:3, :3], axis=0), 1.0)
                own = own @ (turn / size[:, None] * size)
            after[at] = now @ own
        return after

    def in_bones(
        self, transforms: np.ndarray, joints: list[int], turns: np.ndarray
    ) -> tuple[list[int], np.ndarray]:
        """Return which bones turn, and how, relative to their parents in Blender.

        A bone whose parent differs here, or that does not inherit its rotation or scale, also
        turns when only the parent does.

        Parameters
        ----------
        transforms : (J, 4, 4) before
        joints, turns : n indices and (n, 4, 4), from the engine's answer
        """
        after, turn_of = (
            self.posed(transforms, joints, turns),
            dict(zip(joints, turns, strict=True)),
        )
        found: dict[int, np.ndarray] = {}
        for at, name in enumerate(self.bones):
            bone, above = self.armature.data.bones[name], int(self._tree.own_parents[at])
            own = self.armature.pose.bones[name]
            is_full = bone.use_inherit_rotation and bone.inherit_scale == "FULL"
            if above == self.parents[at] and (is_full or above < 0) and _is_even(own.scale):
                if at in turn_of:
                    found[at] = turn_of[at]
                continue
            bases = []
            for pose in (transforms, after):
                if self._tree.is_next[at]:
                    basis = bone.convert_local_to_pose(
                        Matrix(pose[at].tolist()),
                        bone.matrix_local,
                        parent_matrix=Matrix(pose[above].tolist()),
                        parent_matrix_local=bone.parent.matrix_local,
                        invert=True,
                    )
                    bases.append(np.array(basis, dtype=np.float64))
                else:
                    base = np.eye(4) if above < 0 else pose[above]
                    bases.append(np.linalg.inv(base) @ pose[at])
            turn = np.linalg.inv(bases[0]) @ bases[1]
            limit = _TURNED * np.array([1.0, 1.0, 1.0, self.longest_bone])
            if at in turn_of or (np.abs(turn - np.eye(4)) > limit).any():
                found[at] = turn
        return list(found), np.array(list(found.values())).reshape(-1, 4, 4)

    @property
    def longest_bone(self) -> float:
        """The length of the longest bone."""
        return max(one.length for one in self.armature.data.bones)

    def lengths(self) -> np.ndarray:
        """Return the (J,) lengths of the bones."""
        return np.array([self.armature.data.bones[name].length for name in self.bones])

    def baked_copy(self) -> "Rigged":
        """Copy the armature, as shown, and what follows it, without constraints and drivers.

        The copy is linked to the same collections; the original is hidden, in renders too.
        """
        matrices = self.matrices()
        copies = {}
        for item in (self.armature, *self._following()):
            copies[item] = copy = item.copy()
            copy.name = f"{item.name}.free"
            if copy.override_library is not None:
                # Otherwise, reopening the file would restore its constraints.
                copy.make_local(clear_liboverride=True)
            own = [one for one in item.users_collection if _takes_objects(one)]
            for collection in own or [bpy.context.scene.collection]:
                collection.objects.link(copy)
            copy.hide_set(item.hide_get())
        armature = copies[self.armature]
        armature.animation_data_clear()
        for bone in armature.pose.bones:
            for constraint in list(bone.constraints):
                bone.constraints.remove(constraint)
        for item, copy in copies.items():
            if item.parent in copies:
                copy.parent = copies[item.parent]
            for held in (*copy.modifiers, *copy.constraints):
                _retarget(held, copies)
        found = Rigged(
            armature,
            [copies[item] for item in self.meshes],
            tuple((copies[item], why) for item, why in self.left_out),
            self._tree,
        )
        found._further = [one for one in copies.values() if one not in found.meshes]
        found._was_active = bpy.context.view_layer.objects.active
        found._hidden = [(one, one.hide_get(), one.hide_render) for one in copies]
        for item in copies:
            item.hide_set(True)
            item.hide_render = True
        found.place(matrices)
        bpy.context.view_layer.objects.active = armature
        bpy.context.view_layer.update()
        return found

    def _following(self) -> list[bpy.types.Object]:
        """Return the objects that bones deform or carry, and their children."""
        found = []
        for item in bpy.context.view_layer.objects:
            follows = item.type == "MESH" and is_deformed_by(item, self.armature)
            if item != self.armature and (follows or carrier_of(item, self.armature) is not None):
                found += [item, *item.children_recursive]
        there = set(bpy.context.view_layer.objects)
        return [item for item in dict.fromkeys(found) if item in there and item != self.armature]

    def remove_copy(self) -> None:
        """Remove this baked copy, and show the original again."""
        for item in (*self.meshes, *self._further):
            bpy.data.objects.remove(item)
        for item, was_hidden, was_hidden_in_renders in self._hidden:
            item.hide_set(was_hidden)
            item.hide_render = was_hidden_in_renders
        bpy.context.view_layer.objects.active = self._was_active

    def matrices(self) -> dict[str, Matrix]:
        """Return the transforms of all bones as shown."""
        graph = bpy.context.evaluated_depsgraph_get()
        bones = self.armature.evaluated_get(graph).pose.bones
        return {bone.name: bone.matrix.copy() for bone in bones}

    def place(self, matrices: dict[str, Matrix]) -> None:
        """Set the transforms of all bones of an armature without constraints."""
        for bone in self.armature.pose.bones:
            above = {}
            if bone.parent is not None:
                above = {
                    "parent_matrix": matrices[bone.parent.name],
                    "parent_matrix_local": bone.parent.bone.matrix_local,
                }
            basis = bone.bone.convert_local_to_pose(
                matrices[bone.name], bone.bone.matrix_local, invert=True, **above
            )
            set_rotation(bone, basis)
            bone.location, bone.scale = basis.to_translation(), basis.to_scale()


def _is_even(scale: Vector) -> bool:
    """Return whether a scale is uniform."""
    return max(scale) - min(scale) <= _TURNED * max(map(abs, scale))


def _retarget(held: bpy.types.bpy_struct, copies: dict[bpy.types.Object, bpy.types.Object]) -> None:
    """Redirect a modifier or a constraint from objects to their copies."""
    for path, kind in held.bl_rna.properties.items():
        if kind.type == "POINTER" and not kind.is_readonly and getattr(held, path) in copies:
            setattr(held, path, copies[getattr(held, path)])
    for target in getattr(held, "targets", ()):
        if target.target in copies:
            target.target = copies[target.target]


def _takes_objects(collection: bpy.types.Collection) -> bool:
    """Return whether objects can be linked to a collection; not if it is from another file."""
    return collection.library is None and collection.override_library is None
