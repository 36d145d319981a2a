"""A character that its rig poses: a body without anything trained."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from lcollision_core.bodies.card import ModelCard
from lcollision_core.bodies.code_names import CodeEffect, with_regions
from lcollision_core.bodies.colours import domain_colours
from lcollision_core.bodies.latent_space import WHOLE_BODY, LatentSpace
from lcollision_core.bodies.mirror import PoseMirror, Symmetry
from lcollision_core.bodies.naming import MAX_NAME_LENGTH, MAX_POSE_NAME_LENGTH, unique_names
from lcollision_core.bodies.posable_body import PosableBody, read_only
from lcollision_core.bodies.rig_fit import fit_rig
from lcollision_core.bodies.rig_mirror import JointSides, RigMirror, find_joint_sides
from lcollision_core.bodies.rig_names import motion_names
from lcollision_core.bodies.starter_poses import StarterPose, starter_poses
from lcollision_core.characters import (
    ROLE_NAMES,
    RigPoseSpace,
    default_rules,
    joint_groups,
    joint_parts,
)
from lcollision_core.characters.random_poses import random_codes
from lcollision_core.characters.rig_space import ROOT_CODES
from lcollision_core.embedding.bilevel import LatentFit
from lcollision_core.errors import LCollisionError, MeshFileError, ModelFileError
from lcollision_core.files import Character
from lcollision_core.jobs import Job
from lcollision_core.meshes import ContactRules, part_groups
from lcollision_core.meshes.evenly_spaced import evenly_spaced
from lcollision_core.model_file import digest_of

if TYPE_CHECKING:
    from lcollision_core.files.scene.appearance import Appearance
    from lcollision_core.predictor import Prediction
    from lcollision_core.resolve import PoseResolver

FloatArray = npt.NDArray[np.float64]

REST = "rest"
"""The name of the rest pose."""

_MOST_FRAMES, _MOST_RATE = 300, 10.0
"""Of the clips, that are taken as poses, and in a second: enough to know what the character does.
"""

_SAME = 1e-5
"""Normalised: what is alike to so much is the same rig."""

_SHIFTS = 3
"""The first codes move the whole body, by normalised lengths; the others are angles."""

_MOST_FREE = 32
"""Of the poses that the character came with, evenly spaced, those that Resolve starts from."""


class RigModel(PosableBody):
    """A character posed by its joints: see `RigPoseSpace` for what the codes are.

    Its unit is that of the character's file. Build one with `of`.

    Parameters
    ----------
    character : with a rig
    space : its poses
    card : its units, names and origin
    poses : (N, D) float64 array, the rest pose and frames of the clips

    Attributes
    ----------
    character : as given
    own_card : the card that its file makes, whatever was chosen instead
    notes : sentences on what was changed on reading, and on what else is not as in the file
    """

    def __init__(
        self, character: Character, space: RigPoseSpace, card: ModelCard, poses: FloatArray
    ) -> None:
        super().__init__(
            character.name,
            card,
            character.topology,
            character.topology.gathered(character.rest_vertices),
            space.attention_mask,
            poses,
        )
        self.character, self._space = character, space
        self.own_card, self.notes = card, (*character.notes, *space.anatomy.notes)

    @classmethod
    def of(cls, character: Character, parts: Sequence[str] | None = None) -> RigModel:
        """Make a body of a rigged character.

        Parameters
        ----------
        character : with a rig
        parts : names of body parts by joint: see `RigPoseSpace`

        Raises
        ------
        LCollisionError : the character has no rig.
        """
        names, frames, rate = [REST], [], _frame_rate(character)
        for clip in character.clips if character.rig is not None else ():
            try:
                found = character.sample(clip, rate)
            except MeshFileError:
                continue  # A damaged clip is refused where it is asked for.
            if found.transforms is not None:
                names += found.names
                frames.append(found.transforms)
        transforms = np.concatenate(frames)[:_MOST_FRAMES] if frames else None
        space = RigPoseSpace(character, parts, transforms)
        poses = np.concatenate([np.zeros((1, len(space.low))), space.frame_codes])
        printable = ("".join(filter(str.isprintable, name)) for name in space.part_names)
        parts_of_faces = part_groups(character.topology, joint_parts(character, space.anatomy))
        groups = (*character.groups, *parts_of_faces, *joint_groups(character))
        shown = [name.strip()[:MAX_NAME_LENGTH] or "part" for name in printable]
        card = ModelCard(
            height=space.body_size,
            up_axis=int(np.abs(character.up).argmax()),
            domain_names=tuple(unique_names(shown, MAX_NAME_LENGTH)),
            domain_colours=domain_colours(space.attention_mask),
            pose_names=tuple(name[:MAX_POSE_NAME_LENGTH] for name in names[: len(poses)]),
            source=character.source.name,
            licence="unknown",
            rules=default_rules(character, groups),
            metres=character.metres,
            groups=groups,
        )
        return cls(character, space, card, poses)

    def with_roles(self, chosen: Mapping[str, str]) -> RigModel:
        """Return the character with joints that are what the user says, and its own rules.

        Parameters
        ----------
        chosen : one of `characters.ROLE_NAMES` for each joint by its name

        Raises
        ------
        LCollisionError : the rig has no such joint, or there is no such role.
        """
        rig = self.space.rig
        for name, role in chosen.items():
            if name not in rig.joint_names:
                raise LCollisionError(
                    f"has no joint {name!r}", "domains lists its joints", where=self.name
                )
            if role not in ROLE_NAMES:
                raise LCollisionError(
                    "is not known", f"choose one of {', '.join(ROLE_NAMES)}", where=f"role {role!r}"
                )
        return RigModel.of(replace(self.character, rig=replace(rig, chosen=dict(chosen))))

    def with_choices_of(self, other: RigModel) -> RigModel:
        """Return the body with the contact rules and body parts of another shape of it."""
        card, held = self.card, other.card
        if len(held.domain_names) == len(card.domain_names):
            names, colours = held.domain_names, held.domain_colours
            card = replace(card, domain_names=names, domain_colours=colours)
            card = replace(card, domain_order=held.domain_order)
        chosen = self.with_card(card)
        if held.rules != card.rules:
            chosen = chosen.with_rules(held.rules)
        touching = other.detector.may_touch
        if not touching:
            return chosen
        return chosen._with_detector(chosen.card, chosen.detector.with_touching(touching))

    def noted(self, sentence: str) -> RigModel:
        """Return the same body with a further note."""
        other = self.with_card(self.card)
        other.notes = (*self.notes, sentence)
        return other

    @property
    def own_rules(self) -> ContactRules:
        """The rules that the character starts with, which its file does not hold."""
        return self.own_card.rules

    @cached_property
    def appearance(self) -> Appearance | None:
        """How the character looks; reading it takes as long as its textures are large."""
        return self.character.look()

    @property
    def space(self) -> RigPoseSpace:
        """The rig's poses as dragging and Resolve see them."""
        return self._space

    @cached_property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the rig, its skin and its codes."""
        space, rig = self.space, self.space.rig
        measures = {
            "points": rig.points / space.body_size,
            "weights": rig.weights,
            "origins": space.origins,
            "axes": space.axes,
        }
        if rig.stretch is not None:
            measures["stretch"] = rig.stretch
        if rig.pose_shapes is not None:
            measures["pose shapes"] = rig.pose_shapes.astype(np.float64) / space.body_size
        # Not to depend on how a machine rounds.
        arrays: dict[str, npt.NDArray[Any]] = {
            name: np.round(values / _SAME).astype(np.int64) for name, values in measures.items()
        }
        arrays |= {"faces": self.topology.faces, "joint_of": rig.joint_of, "parents": rig.parents}
        arrays["codes"] = np.stack([space.joint_of_code, space.axis_of_code])
        names = {"joints": rig.joint_names, "parts": space.part_names}
        return digest_of(json.dumps(names), arrays)[:16]

    def _vertex_labels(self) -> npt.NDArray[np.str_]:
        return joint_parts(self.character, self._space.anatomy)

    @property
    def is_trained(self) -> bool:
        """The joints are those of the character's file."""
        return False

    @property
    def has_predictor(self) -> bool:
        """Nothing is trained on a rig."""
        return False

    @property
    def can_resolve(self) -> bool:
        """A rig steps from free poses towards the target."""
        return True

    def predict(self, latent: npt.ArrayLike) -> Prediction:  # noqa: ARG002
        """Refuse: there is no predictor."""
        raise ModelFileError(
            f"the character {self.name!r} has no predictor", "train a model of its poses"
        )

    @property
    def known_metres(self) -> float:
        """Length of the data's unit in metres, which the character's file says."""
        return self.card.metres

    @cached_property
    def free_latent(self) -> FloatArray:
        """(F, D) collision-free poses that the character came with, read-only."""
        poses = self.known_poses[evenly_spaced(len(self.known_poses), _MOST_FREE)]
        return read_only(poses[self.exact_check().are_free(poses)])

    @cached_property
    def resolver(self) -> PoseResolver:
        """Resolves the self-collisions of this character's poses."""
        from lcollision_core.resolve import PoseResolver

        return PoseResolver(self.exact_check(), None, self.free_latent)

    def _fit(self, vertices: FloatArray, job: Job, *, in_place: bool) -> LatentFit:
        return fit_rig(self.space, vertices, job, in_place=in_place)

    @cached_property
    def front(self) -> FloatArray:
        """(3,) unit vector along an axis: where the character faces."""
        axis = int(np.abs(self.space.front).argmax())
        return read_only(np.sign(self.space.front[axis]) * np.eye(3)[axis])

    @cached_property
    def latent_space(self) -> LatentSpace:
        """The groups, names, colours and ranges of the codes: angles are shown in degrees."""
        angles = np.arange(self.latent_size) >= _SHIFTS
        names = [
            WHOLE_BODY.lower() if joint < 0 else self.space.rig.joint_names[joint]
            for joint in self.space.joint_of_code.tolist()
        ]
        space = super().latent_space
        return replace(
            space,
            groups=tuple(
                replace(group, code_names=tuple(names[group.codes])) for group in space.groups
            ),
            shown=read_only(np.where(angles, np.degrees(1.0), 100.0)),
            units=tuple("°" if angle else " %" for angle in angles),
        )

    def sample(self, n_poses: int, generator: np.random.Generator) -> FloatArray:
        """Draw (n_poses, D) poses that a person could take, of the body in its place."""
        if self.latent_size == ROOT_CODES:
            return np.zeros((n_poses, ROOT_CODES))
        return random_codes(self.space, n_poses, generator)

    no_sides = (
        "its joint names do not say left and right, and its joints are not symmetric",
        "name them, for example, LeftArm and RightArm",
    )

    @cached_property
    def _sides(self) -> JointSides | None:
        return find_joint_sides(self.space)

    @cached_property
    def starter_poses(self) -> tuple[StarterPose, ...]:
        """Poses to begin with: see `starter_poses`."""
        return starter_poses(self.space)

    @cached_property
    def symmetry(self) -> Symmetry | None:
        """Left and right of the rig; None if its joints have no two sides.

        The mesh need not be symmetric: a vertex's partner is the one nearest to its image.
        """
        sides = self._sides
        if sides is None:
            return None
        everyone = np.arange(self.n_vertices, dtype=np.int32)
        plane = Symmetry(everyone, sides.normal, sides.offset * self.body_size)
        partner = cKDTree(self.reference).query(plane.reflect(self.reference))[1]
        return replace(plane, partner=read_only(partner.astype(np.int32)))

    @cached_property
    def pose_mirror(self) -> PoseMirror:
        """Exchanges left and right of this character's poses, joint by joint.

        Raises
        ------
        LCollisionError : the rig has no two sides.
        """
        sides, symmetry = self._sides, self.symmetry
        if sides is None or symmetry is None:
            raise self._not_mirrored()
        return RigMirror(
            self.attention_mask,
            symmetry,
            self.exact_check(),
            self.nearest,
            self.resolve,
            self.space,
            sides,
        )

    @cached_property
    def code_effects(self) -> tuple[CodeEffect, ...]:
        """The body part that each code turns, and how, by the joints' axes."""
        groups = np.repeat(np.arange(len(self.space.group_sizes)), self.space.group_sizes)
        root = int(np.bincount(self.space.vertex_domain).argmax())
        return tuple(
            CodeEffect(int(group) - 1 if group else root, name)
            for group, name in zip(groups, self.code_names, strict=True)
        )

    @cached_property
    def code_names(self) -> tuple[str, ...]:
        """D names of the codes, unique within each group: "bend", "index 1 sideways"."""
        names = motion_names(self.space)
        ends = np.cumsum(self.space.group_sizes)
        return tuple(
            name
            for start, end in zip((0, *ends[:-1]), ends, strict=True)
            for name in unique_names(names[start:end])
        )

    @cached_property
    def code_words(self) -> tuple[str, ...]:
        """Also by what the joints are and on which side, in whatever language they are named."""
        kinds = [
            f"{role.name.lower().replace('_', ' ')} {side.value}"
            for role, side in zip(self.space.roles, self.space.sides, strict=True)
        ]
        return tuple(
            words if joint < 0 else with_regions(f"{words} {kinds[joint]}")
            for words, joint in zip(
                super().code_words, self.space.joint_of_code.tolist(), strict=True
            )
        )


def _frame_rate(character: Character) -> float:
    """Return how many frames a second of all clips together are no more than are taken."""
    seconds = sum(character.clips.values())
    most = max(1, _MOST_FRAMES - len(character.clips))
    return min(_MOST_RATE, most / seconds) if seconds > 0.0 else _MOST_RATE
