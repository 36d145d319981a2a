"""A scene of several bodies, posed, checked and resolved as one body."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, product, zip_longest
from typing import Annotated, Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from lcollision_core.bodies.body import Body, read_only
from lcollision_core.bodies.card import ModelCard
from lcollision_core.bodies.latent_space import SHAPES, WHOLE_BODY, LatentGroup, LatentSpace
from lcollision_core.bodies.mirror import PoseMirror, Symmetry
from lcollision_core.bodies.names import BETWEEN_BODIES, MAX_NAME_LENGTH, CodeEffect, unique_names
from lcollision_core.bodies.rig_poses import StarterPose
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.bodies.scene_space import PlacedSpace, SceneSpace, StillSpace
from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.embedding.bilevel import LatentFit
from lcollision_core.errors import LCollisionError
from lcollision_core.files.scene.appearance import Appearance, join_appearances
from lcollision_core.jobs import Job
from lcollision_core.meshes import FaceGroup, RigidTransform, Topology
from lcollision_core.meshes.face_groups import MAX_GROUPS
from lcollision_core.meshes.topology import FloatArray, consecutive
from lcollision_core.model_file import digest_of
from lcollision_core.posing import ExactCheck
from lcollision_core.resolve import BodyAlone, PoseResolver

_GAP = 0.01
"""Normalised gap between bodies in poses that are assumed to be free."""

_SHIFTS = (0.01, 0.02, 0.04, 0.08, 0.16)
"""Normalised lengths by which bodies are shifted apart, until they are free."""

_GREY = "#808080"

_T = TypeVar("_T")


_MOST_BODIES = 64


@dataclass(frozen=True)
class ScenePart:
    """A body of a scene, as stored in the scene file.

    Attributes
    ----------
    file : of the body, relative to the scene file or absolute; or the name of a model
    name : in the scene; "" for that of the file
    at : position in the scene's unit
    turn : degrees about the vertical
    fixed : whether it must not move
    held_by, joint : the body and joint that hold it; "" if none
    counts : whether it takes part in the check
    clip : the clip of its own file that it plays; "" for the first
    start : start time of the clip, in seconds
    """

    file: str
    name: str = ""
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: float = 0.0
    fixed: bool = False
    held_by: str = ""
    joint: str = ""
    counts: bool = True
    clip: str = ""
    start: Annotated[float, Meta(ge=0.0, lt=1e6)] = 0.0


@dataclass(frozen=True)
class SceneFile:
    """The contents of a scene file.

    Attributes
    ----------
    bodies : the first one determines unit and axes
    ground : its height; "rest" for the lowest point of the rest pose; None for no ground
    path : of the file; "" if there is none
    """

    bodies: Annotated[tuple[ScenePart, ...], Meta(min_length=1, max_length=_MOST_BODIES)]
    ground: float | str | None = None
    path: str = field(default="")


@dataclass(frozen=True, eq=False)
class SceneMember:
    """One body of a scene.

    Attributes
    ----------
    name : unique in the scene
    body : a character, a learned model, a prop with one joint, or a static body
    place : from its unit and coordinates to those of the scene
    is_fixed : whether it must not move
    holder, joint : for a held body, the name of its holder and the index of the holder's joint;
        else None and -1
    is_ground : whether it is the ground
    """

    name: str
    body: Body
    place: RigidTransform
    is_fixed: bool = False
    holder: str | None = None
    joint: int = -1
    is_ground: bool = False

    @property
    def moves(self) -> bool:
        """Whether it has codes."""
        has_codes = self.body.joints is not None or self.body.is_trained
        return self.holder is None and has_codes

    @property
    def reference(self) -> FloatArray:
        """(V, 3) its rest pose in the scene's unit and coordinates."""
        return self.place.apply(self.body.reference)


class SceneBody(Body):
    """The bodies of a scene as one, with the codes of all: see `SceneSpace`.

    Unit and axes are those of the first body, and lengths are normalised by its size. Near and
    joint exclusions do not apply between bodies, so all their pairs count.

    Parameters
    ----------
    members : in listing order, characters first
    name : of the scene; by default the names of its bodies
    file : contents of its file, or of the file that it would have

    Attributes
    ----------
    members, file : as given
    standing : the members that are not held, in the order of `SceneSpace.members`
    vertices_of, faces_of : slices of each member's vertices and faces, by name
    """

    no_predictor = "a scene of several bodies has no predictor", "open one of them"
    has_unit = True

    def __init__(
        self, members: Sequence[SceneMember], name: str = "", file: SceneFile | None = None
    ) -> None:
        self.members, self.file = tuple(members), file
        first = members[0]
        self._size = first.body.body_size * first.place.scale
        self.standing = [member for member in members if member.holder is None]
        in_order = [own for member in self.standing for own in (member, *self._held_by(member))]
        names = [member.name for member in in_order]
        vertices = consecutive(member.body.n_vertices for member in in_order)
        faces = consecutive(len(member.body.faces) for member in in_order)
        self.vertices_of = dict(zip(names, vertices, strict=True))
        self.faces_of = dict(zip(names, faces, strict=True))
        self._space = SceneSpace([self._placed(member) for member in self.standing])
        domain_names, colours = self._domains()
        rules, groups = self._joined_rules()
        card = ModelCard(
            height=self._size,
            up_axis=first.body.up_axis,
            domain_names=domain_names,
            domain_colours=colours,
            pose_names=("rest",),
            source=", ".join(own.body.card.source for own in members if not own.is_ground)[:1000],
            licence="unknown",
            rules=rules,
            metres=first.body.card.metres / first.place.scale,
            groups=groups,
        )
        space = self._space
        super().__init__(
            name or BETWEEN_BODIES.join(own.name for own in members if not own.is_ground)[:200],
            card,
            space.topology,
            space.rest_vertices * self._size,
            space.attention_mask,
            np.zeros((1, len(space.low))),
        )
        self.own_card = card
        self.shape_names = tuple(
            self._in_body(member.name, name)
            for member in self.standing
            if member.moves
            for name in member.body.shape_names
        )
        fixed = (self.domains_of_member(member.name) for member in members if member.is_fixed)
        self.fixed_domains = frozenset(chain.from_iterable(fixed))
        self.ground = self._find_ground()
        several = "it has several bodies", "mirror the pose of each by itself"
        only = self.only_posed
        self.no_sides = several if only is None else only.body.no_sides
        held = "it is held, so its own clips are left out"
        self.notes = tuple(
            f"{member.name}: {note}"
            for member in members
            for note in (
                *member.body.notes,
                *([held] if member.holder is not None and member.body.own_clips else []),
            )
        )

    def with_file(self, file: SceneFile) -> SceneBody:
        """Return the scene with a file that differs only in the clips that bodies play."""
        other = copy(self)
        other.file = file
        return other

    def _find_ground(self) -> tuple[float, npt.NDArray[np.bool_]] | None:
        """Return `ground`."""
        for member in self.members:
            if member.is_ground:
                rows, stands = self.vertices_of[member.name], np.ones(self.n_vertices, np.bool_)
                stands[rows] = False
                return float((self.reference[rows] @ self.up).max()) / self.body_size, stands
        return None

    @cached_property
    def only_posed(self) -> SceneMember | None:
        """The body that is posed; None if several are, or if props have the names of its parts.

        Its parts keep their names, and its poses can be mirrored.
        """
        posed = [member for member in self.standing if member.moves and not member.is_fixed]
        if len(posed) != 1:
            return None
        body = posed[0].body
        parts = {*body.domain_names, *body.shape_names, *(group.name for group in body.groups)}
        return posed[0] if parts.isdisjoint(member.name for member in self.members) else None

    def _in_body(self, body: str, part: str) -> str:
        """Name a part of a body of the scene, as in "hero: left hand"."""
        is_only = self.only_posed is not None and self.only_posed.name == body
        return part if is_only else f"{body}: {part}"

    @property
    def plays(self) -> dict[str, tuple[str, float]]:
        """Clip and start time, by name, of each moving body that has clips."""
        parts = () if self.file is None else self.file.bodies
        clip_of = {}
        for member, part in zip_longest(self.members, parts[: len(self.members)]):
            clips = member.body.own_clips
            if member.moves and clips and member.body.own_file is not None:
                chosen = part is not None and part.clip in clips
                start = 0.0 if part is None else part.start
                clip_of[member.name] = (part.clip if chosen else clips[0], start)
        return clip_of

    def _placed(self, member: SceneMember) -> PlacedSpace:
        """Return the space of a member and its held bodies."""
        body, place = member.body, member.place
        in_scene = RigidTransform(
            place.rotation,
            place.translation / self._size,
            place.scale * body.body_size / self._size,
        )
        if not member.moves:
            still = StillSpace(body.topology, body.reference / body.body_size)
            return PlacedSpace(still, in_scene)
        space, topology = body.space, body.topology
        for held in self._held_by(member):
            faces = np.concatenate([topology.faces, held.body.faces + topology.n_vertices])
            topology = Topology(faces, topology.n_vertices + held.body.n_vertices)
            points = place.inverse().apply(held.reference)
            assert isinstance(space, RigPoseSpace)
            space = space.holding(held.name, topology, points, held.joint)
        return PlacedSpace(space, in_scene)

    def _domains(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        names: list[str] = []
        colours: list[str] = []
        for member in self.standing:
            own = member.body.domain_names if member.moves else ("",)
            several = len(own) > 1
            names += [self._in_body(member.name, part) if several else member.name for part in own]
            colours += member.body.card.domain_colours if member.moves else (_GREY,)
            held_names = [other.name for other in self._held_by(member)]
            names += held_names
            colours += [_GREY] * len(held_names)
        return tuple(unique_names(names, MAX_NAME_LENGTH)), tuple(colours)

    def _joined_rules(self) -> tuple[ContactRules, tuple[FaceGroup, ...]]:
        """Return the combined rules of all bodies; each body's rules apply within it."""
        groups: list[FaceGroup] = []
        ignored: list[tuple[str, str]] = []
        left_out: list[str] = []
        tolerated: list[tuple[str, str, float]] = []
        touching: list[tuple[int, int]] = []
        in_shapes: list[tuple[int, int]] = []
        bending = [member.body for member in self.members if member.moves and bends(member.body)]
        # Joints crease what they turn: without their exclusions characters collide at rest.
        jointed = [body for body in bending if body.joints is not None]
        posed = [body.rules for body in jointed or bending]
        still = [member.name for member in self.members if member.is_fixed and not member.is_ground]
        domains = self._space.vertex_domain
        for member in self.members:
            rules, rows, name = member.body.rules, self.faces_of[member.name], member.name
            is_prop = member.holder is not None or (member.moves and not bends(member.body))
            groups += self._groups_of(member, is_prop)
            ignored += [(self._in_body(name, a), self._in_body(name, b)) for a, b in rules.ignored]
            left_out += [self._in_body(name, name_left_out) for name_left_out in rules.left_out]
            tolerated += [
                (self._in_body(name, a), self._in_body(name, b), depth)
                for a, b, depth in rules.tolerated_pairs
            ]
            if rules.tolerated_depth:
                tolerated.append((name, name, rules.tolerated_depth))
            for joined, patches in (
                (touching, rules.touching),
                (in_shapes, rules.shape_touching),
            ):
                joined += [(a + rows.start, b + rows.start) for a, b in patches]
            if is_prop and not member.is_fixed:
                ignored.append((name, name))
            if member.holder is not None:
                holding = self._part_of(member)
                grip = self._in_body(name, "grip")
                inside = domains[self._space.topology.faces[:, 0]] == holding
                groups.append(FaceGroup(grip, np.flatnonzero(inside)))
                ignored.append((name, grip))
        ignored += [(a, b) for number, a in enumerate(still) for b in still[number:]]
        joints = [group for group in groups if group.about_joint]
        joints = sorted(joints, key=lambda group: -len(group.faces))[:MAX_GROUPS]
        others = [group for group in groups if not group.about_joint][:MAX_GROUPS]
        rests = [rules.rest_exclusion for rules in posed if rules.rest_exclusion is not None]
        return (
            ContactRules(
                near_exclusion=min((rules.near_exclusion for rules in posed), default=0.0),
                near_by_limb=any(rules.near_by_limb for rules in posed),
                rest_exclusion=max(rests, default=None),
                ignored=tuple(dict.fromkeys(ignored)),
                joint_exclusion=any(rules.joint_exclusion for rules in posed),
                touching=tuple(touching),
                touching_radius=max((rules.touching_radius for rules in posed), default=0.0),
                left_out=tuple(left_out),
                tolerated_pairs=tuple(tolerated),
                shape_touching=tuple(in_shapes),
            ),
            (*others, *joints),
        )

    def _groups_of(self, member: SceneMember, is_prop: bool) -> Iterator[FaceGroup]:
        """Yield the group of all faces of a body, then its own groups, as named in the scene."""
        own = {group.name for group in member.body.groups}
        rows, name = self.faces_of[member.name], member.name
        everyone = np.arange(rows.start, rows.stop)
        yield FaceGroup(name, everyone)
        for group in member.body.groups:
            if is_prop and len(group.faces) == len(everyone):
                continue  # The prop's name says it: not "sword: Sword".
            # The name of a branch of two limbs joins the names of both joints.
            pieces = group.name.split(", ", 1)
            pieces = pieces if own.issuperset(pieces) else [group.name]
            label = ", ".join(self._in_body(name, piece) for piece in pieces)
            yield replace(group, name=label, faces=group.faces + rows.start)

    def _held_by(self, holder: SceneMember) -> list[SceneMember]:
        """Return the props that a member holds."""
        return [member for member in self.members if member.holder == holder.name]

    def _part_of(self, prop: SceneMember) -> int:
        """Return the body part that holds a prop, as an index into the scene's."""
        assert prop.holder is not None
        joints = self.member(prop.holder).body.joints
        assert joints is not None
        first = self.domains_of_member(prop.holder).start
        return first + int(joints.part_of_joint[prop.joint])

    @property
    def space(self) -> SceneSpace:
        """The pose space of all bodies."""
        return self._space

    def member(self, name: str) -> SceneMember:
        """Return a body of the scene by name.

        Raises
        ------
        LCollisionError : there is no such body.
        """
        for member in self.members:
            if member.name == name:
                return member
        names = ", ".join(member.name for member in self.members)
        raise LCollisionError(f"has no body {name!r}", f"its bodies are {names}", where="the scene")

    def codes_of_member(self, name: str, latent: FloatArray) -> FloatArray:
        """Return a moving body's (..., D_k) codes of (..., D) codes."""
        at = next(n for n, entry in enumerate(self.standing) if entry.name == name)
        return self._space.of(latent, at)

    def with_codes_of_member(self, name: str, latent: FloatArray, codes: FloatArray) -> FloatArray:
        """Return (D,) codes with those of a moving body replaced by (D_k,) codes."""
        replaced = latent.copy()
        for places, member in zip(self._space.codes, self.standing, strict=True):
            if member.name == name:
                replaced[places] = codes
        return replaced

    def domains_of_member(self, name: str) -> range:
        """Return the body parts of a body and what it holds; empty for a held body."""
        for member, own in zip(self.standing, self._space.domains, strict=True):
            if member.name == name:
                return own
        return range(0)

    def joined_codes(self, codes: Sequence[FloatArray | None]) -> FloatArray:
        """Join (D_k,) codes of the members into (D,); None and static bodies stay at rest."""
        joined = np.zeros(self.latent_size)
        by_name = {member.name: own for member, own in zip(self.members, codes, strict=True)}
        for places, member in zip(self._space.codes, self.standing, strict=True):
            own = by_name[member.name]
            if own is not None:
                joined[places] = own
        return joined

    @cached_property
    def detector(self) -> CollisionDetector:
        """Finds collisions within and between bodies, in the scene's unit.

        Bodies may overlap at rest: contacts at rest are measured with the bodies moved apart.
        """
        apart, end = self.reference.copy(), 0.0
        for member in self.members:
            rows = self.vertices_of[member.name]
            low, high = apart[rows, 0].min(), apart[rows, 0].max()
            apart[rows, 0] += end - low
            end += float(high - low) + 2.0 * self._size
        return CollisionDetector(self.topology, apart, self.rules, self.groups, self._size)

    @cached_property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the bodies and which holds which."""
        members = [
            f"{member.body.fingerprint} {member.holder or ''} {member.joint}"
            for member in self.members
        ]
        arrays: dict[str, npt.NDArray[Any]] = {}
        return digest_of("scene " + "; ".join(members), arrays)[:16]

    @property
    def up(self) -> tuple[float, float, float]:
        """Unit vector along the up axis of the first body."""
        return self.members[0].body.up

    @cached_property
    def front(self) -> FloatArray:
        """(3,) unit vector along an axis: the direction that the first body faces."""
        return self.members[0].body.front

    @cached_property
    def symmetry(self) -> Symmetry | None:
        """That of the only body that is posed; the partner of any other vertex is itself."""
        only = self.only_posed
        own = None if only is None else only.body.symmetry
        if only is None or own is None:
            return None
        rows, place = self.vertices_of[only.name], only.place
        partner = np.arange(self.n_vertices, dtype=np.int32)
        partner[rows] = own.partner + rows.start
        normal = place.rotation @ own.normal
        offset = place.scale * own.offset + float(place.translation @ normal)
        return Symmetry(read_only(partner), normal, offset)

    @cached_property
    def pose_mirror(self) -> PoseMirror:
        """Mirrors poses of the only body that is posed; all else keeps its codes.

        Raises
        ------
        LCollisionError : several bodies are posed, or the body is not symmetric.
        """
        parts, only = self._mirror_parts(), self.only_posed
        assert only is not None
        at = self.standing.index(only)
        space = self._space
        return _MirrorOfOne(
            *parts,
            only.body.pose_mirror,
            space.members[at],
            space.codes[at],
            space.vertices[at],
            space.domains[at].start,
        )

    @cached_property
    def starter_poses(self) -> tuple[StarterPose, ...]:
        """Those of each body."""
        return self.poses_of_members(lambda body: body.starter_poses)

    def poses_of_members(
        self, poses_of: Callable[[Body], Iterable[StarterPose]]
    ) -> tuple[StarterPose, ...]:
        """Return poses of each body that is posed, which leave the others as they are."""
        poses = []
        for member, own in zip(self.standing, self._space.codes, strict=True):
            if not member.moves or member.is_fixed:
                continue
            for pose in poses_of(member.body):
                codes = np.zeros(self.latent_size)
                moves = np.zeros(self.latent_size, dtype=np.bool_)
                codes[own] = pose.codes
                moves[own] = True if pose.moves is None else pose.moves
                name = self._in_body(member.name, pose.name)
                poses.append(StarterPose(name, read_only(codes), moves))
        return tuple(poses)

    @cached_property
    def appearance(self) -> Appearance | None:
        """Appearance of the bodies; large textures take long to read."""
        members = sorted(self.members, key=lambda member: self.vertices_of[member.name].start)
        bodies = [member.body for member in members]
        if all(body.appearance is None for body in bodies):
            return None
        looks = [
            body.appearance or Appearance.plain(body.n_vertices, body.faces.astype(np.int64))
            for body in bodies
        ]
        counts = [body.n_vertices for body in bodies]
        return join_appearances(looks, counts, np.arange(self.n_vertices))

    @cached_property
    def code_effects(self) -> tuple[CodeEffect, ...]:
        """The effects of the bodies' codes."""
        effects: dict[int, CodeEffect] = {}
        for place, member, effect in self._by_code(lambda body: body.code_effects):
            parts = self.domains_of_member(member.name)
            domain = min(parts.start + effect.domain, parts.stop - 1)
            effects[place] = replace(effect, domain=domain)
        return tuple(effects[place] for place in range(self.latent_size))

    def _by_code(
        self, of_codes: Callable[[Body], Sequence[_T]]
    ) -> Iterator[tuple[int, SceneMember, _T]]:
        """Yield, for each code, its index, its body and what that body has for it."""
        for member, own in zip(self.standing, self._space.codes, strict=True):
            if member.moves:
                for place, value in zip(own.tolist(), of_codes(member.body), strict=True):
                    yield place, member, value

    def _named_codes(self, of_codes: Callable[[Body], Sequence[str]]) -> list[str]:
        """Return D names of codes; those of whole bodies are prefixed with the body's name."""
        names, n_whole = [""] * self.latent_size, self._space.group_sizes[0]
        for place, member, name in self._by_code(of_codes):
            names[place] = self._in_body(member.name, name) if place < n_whole else name
        return names

    @cached_property
    def code_names(self) -> tuple[str, ...]:
        """D names of the codes; those of whole bodies are prefixed with the body's name."""
        names = self._named_codes(lambda body: body.code_names)
        return (*names[: sum(self._space.group_sizes)], *self.shape_names)

    @cached_property
    def code_words(self) -> tuple[str, ...]:
        """D search texts, each with the name of the code's body."""
        words = [""] * self.latent_size
        for place, member, text in self._by_code(lambda body: body.code_words):
            words[place] = f"{member.name.lower()} {text}"
        return tuple(words)

    @cached_property
    def latent_space(self) -> LatentSpace:
        """The groups, names, colours and ranges of the codes."""
        at_rest, shown = np.zeros(self.latent_size), np.ones(self.latent_size)
        units = [""] * self.latent_size

        def displays(body: Body) -> list[tuple[float, float, str]]:
            space = body.latent_space
            return list(zip(space.at_rest, space.shown, space.units, strict=True))

        for place, _, display in self._by_code(displays):
            at_rest[place], shown[place], units[place] = display

        def labels(body: Body) -> list[str]:
            groups = body.latent_space.groups
            return [name for group in groups for name in group.code_names]

        code_names = self._named_codes(labels)
        ends = np.cumsum(self._space.group_sizes).tolist()
        shapes = LatentGroup(SHAPES, None, self.shape_codes, self.shape_names)
        whole = LatentGroup(WHOLE_BODY, None, slice(0, ends[0]), tuple(code_names[: ends[0]]))
        groups = [
            LatentGroup(name, colour, slice(a, b), tuple(code_names[a:b]))
            for name, colour, a, b in zip(
                self.domain_names, self.card.domain_colours, ends[:-1], ends[1:], strict=True
            )
        ]
        return LatentSpace(
            (whole, *groups, *([shapes] if self.shape_names else [])),
            read_only(self._space.low),
            read_only(self._space.high),
            read_only(at_rest),
            read_only(shown),
            tuple(units),
        )

    def _drawn(self, n_poses: int, generator: np.random.Generator) -> FloatArray:
        """Draw (n_poses, D) poses; each body stays in place, and fixed ones at rest."""
        poses = np.zeros((n_poses, self.latent_size))
        for member, own in zip(self.standing, self._space.codes, strict=True):
            if member.moves and not member.is_fixed:
                poses[:, own] = member.body.sample(n_poses, generator)
        return poses

    def _fit(self, vertices: FloatArray, job: Job, *, in_place: bool) -> LatentFit:  # noqa: ARG002
        codes: list[FloatArray | None] = [None] * len(self.members)
        for placed, member in zip(self._space.members, self.standing, strict=True):
            if member.moves:
                rows = self.vertices_of[member.name]
                own = placed.place.inverse().apply(vertices[rows])
                codes[self.members.index(member)] = member.body.nearest(own, job)
        latent = self.joined_codes(codes)
        away = np.linalg.norm(vertices - self._space.decode(latent[None])[0], axis=1)
        return LatentFit(latent, np.eye(3), np.zeros(3), float(away.mean()), float(away.max()))

    @property
    def _movable(self) -> npt.NDArray[np.bool_]:
        """Whether each of the bodies that nothing holds can be shifted as a whole."""
        members = zip(self.standing, self._space.members, strict=True)
        return np.array(
            [
                member.moves and not member.is_fixed and placed.has_place
                for member, placed in members
            ]
        )

    def separated_poses(self, latent: FloatArray) -> list[FloatArray]:
        """Return variants of a (D,) pose with the bodies moved apart and out of the ground.

        They move along the line on which they stand, sideways, forward or up.
        """
        up = np.array(self.up)
        decoded = self._space.decode(latent[None])[0]
        meshes = [decoded[own] for own in self._space.vertices]
        movable = self._movable
        if not movable.any():
            return []
        ground = [
            float((mesh @ up).max())
            for mesh, member in zip(meshes, self.standing, strict=True)
            if member.is_ground
        ]
        lifts = [
            max(0.0, ground[0] + _GAP - float((mesh @ up).min())) if ground and moves else 0.0
            for mesh, moves in zip(meshes, movable, strict=True)
        ]
        middles = np.array([0.5 * (mesh.min(axis=0) + mesh.max(axis=0)) for mesh in meshes])
        bodies = [n for n, member in enumerate(self.standing) if not member.is_ground]
        line = middles[bodies[-1]] - middles[bodies[0]]
        line -= (line @ up) * up
        left = np.cross(up, self.front)
        length = float(np.linalg.norm(line))
        ways = [left, np.asarray(self.front, dtype=np.float64)]
        if any(not movable[n] for n in bodies):
            ways.append(up)
        if length > _GAP:
            ways.insert(0, line / length)
        poses = []
        for way in ways:
            shifts = _row([mesh @ way for mesh in meshes], movable.tolist(), bodies)
            moves = [shift * way + lift * up for shift, lift in zip(shifts, lifts, strict=True)]
            poses.append(self._space.moved_apart(latent, moves))
        return poses

    def least_separated(self, latent: FloatArray, check: ExactCheck) -> FloatArray:
        """Return (n, D) free variants of a (D,) pose with whole bodies shifted by the least length.

        A single movable body is shifted along the axes and diagonals, several away from their
        middle. There may be none.
        """
        decoded, movable = self._space.decode(latent[None])[0], self._movable
        middles = np.array([decoded[own].mean(axis=0) for own in self._space.vertices])
        signs = np.array([sign for sign in product((-1, 0, 1), repeat=3) if any(sign)])
        ways = signs / np.linalg.norm(signs, axis=1)[:, None]
        shares = np.tile(movable.astype(np.float64), (len(ways), 1))
        if movable.sum() > 1:
            shares *= 0.5 * np.sign(ways @ (middles - middles[movable].mean(axis=0)).T)
        for length in _SHIFTS if movable.any() else ():
            poses = np.array(
                [
                    self._space.moved_apart(latent, list(length * share[:, None] * way))
                    for share, way in zip(shares, ways, strict=True)
                ]
            )
            is_free = check.are_free(poses)
            if is_free.any():
                return poses[is_free]
        return np.empty((0, self.latent_size))

    @cached_property
    def free_latent(self) -> FloatArray:
        """(F, D) collision-free rest poses with the bodies apart, read-only."""
        poses = np.array(
            [np.zeros(self.latent_size), *self.separated_poses(np.zeros(self.latent_size))]
        )
        return read_only(poses[self.exact_check().are_free(poses)])

    @cached_property
    def resolver(self) -> PoseResolver:
        """Resolves collisions within and between bodies."""
        bodies = self._alone.values() if self._own_rules_hold else ()
        check, starts = self.exact_check(), self.starting_poses
        return SceneResolver(check, self.free_latent, starts, tuple(bodies))

    @property
    def _own_rules_hold(self) -> bool:
        """Whether each body keeps its own contact rules in the scene."""
        rules, own = self.rules, self.own_rules
        more = set(rules.left_out).difference(own.left_out)
        return replace(rules, left_out=own.left_out) == own and more.isdisjoint(self._alone)

    @cached_property
    def _alone(self) -> dict[str, BodyAlone]:
        """The bodies that bend and are not fixed, by name, each with the props that it holds."""
        alone = {}
        for at, member in enumerate(self.standing):
            if not member.moves or member.is_fixed or not bends(member.body):
                continue
            body, place = member.body, self._space.members[at].place
            if not body.can_resolve:
                continue
            holds = self._held_by(member)
            if holds and len(self.standing) > 1:
                body = SceneBody([member, *holds])
                place = RigidTransform(np.eye(3), np.zeros(3), body.body_size / self._size)
            alone[member.name] = BodyAlone(
                body.resolver,
                self._space.codes[at],
                self._space.domains[at],
                place,
                lambda space, at=at: cast("SceneSpace", space).members[at].space,  # type: ignore[misc]
            )
        return alone

    def starting_poses(self, target: FloatArray, check: ExactCheck) -> FloatArray:
        """Return poses near a (D,) target with resolved bodies apart.

        If no small shift of whole bodies frees them, they are far apart and may still collide.

        Parameters
        ----------
        check : of the scene, whose clearance applies within each body too
        """
        if check.is_free(target):
            return np.empty((0, self.latent_size))
        from lcollision_core.options import ResolveOptions

        latent = target.copy()
        options = ResolveOptions(clearance=check.clearance)
        for body in self._alone.values():
            resolved = body.resolver.resolve(target[body.codes], body.options(options))
            latent[body.codes] = resolved.latent
        near = self.least_separated(latent, check)
        if len(near):
            return near
        return np.array(self.separated_poses(latent)).reshape(-1, self.latent_size)


@dataclass(frozen=True, eq=False)
class _MirrorOfOne(PoseMirror):
    """Mirrors the poses of one body of a scene.

    Attributes
    ----------
    own : mirrors that body
    placed, codes, rows : its pose space, codes and vertices in the scene
    first : its first domain
    """

    own: PoseMirror
    placed: PlacedSpace
    codes: npt.NDArray[np.intp]
    rows: slice
    first: int

    def codes_of_image(self, latent: FloatArray, image: FloatArray, job: Job) -> FloatArray:
        mirrored, back = latent.copy(), self.placed.place.inverse()
        mirrored[self.codes] = self.own.codes_of_image(
            latent[self.codes], back.apply(image[self.rows]), job
        )
        return mirrored

    def misfit(self, latent: FloatArray, mirrored: FloatArray, off: FloatArray) -> FloatArray:
        scale = self.placed.place.scale
        own = self.placed.turned_back(off[self.rows]) / scale**2
        return scale * self.own.misfit(latent[self.codes], mirrored[self.codes], own)

    def partner(self, domain: int) -> int | None:
        """Return the domain on the other side; None if it is in the middle or has no match."""
        other = self.own.partner(domain - self.first)
        return None if other is None else other + self.first


def as_scene(body: Body) -> SceneBody | None:
    """Return a body as a scene of several bodies; None for a single body."""
    return body if isinstance(body, SceneBody) else None


class SceneResolver(PoseResolver):
    """Resolves poses of a scene, starting with its bodies apart.

    Parameters
    ----------
    check, free_latents : see `PoseResolver`
    starts : maps a target and the check to further starting poses
    bodies : those that can be resolved separately
    """

    def __init__(
        self,
        check: ExactCheck,
        free_latents: npt.ArrayLike,
        starts: Callable[[FloatArray, ExactCheck], FloatArray],
        bodies: tuple[BodyAlone, ...],
    ) -> None:
        super().__init__(check, None, free_latents)
        self._starts, self.bodies = starts, bodies

    def _known_free(self, target: FloatArray) -> FloatArray:
        return np.concatenate([self._starts(target, self.check), super()._known_free(target)])


def bends(body: Body) -> bool:
    """Whether a posable body has parts that move relative to each other; a prop has none."""
    return len(body.space.low) > body.space.group_sizes[0]


def _row(
    along: Sequence[FloatArray], movable: Sequence[bool], bodies: Sequence[int]
) -> list[float]:
    """Return shifts along a line after which no two bodies overlap on it.

    Parameters
    ----------
    along : coordinates of each body's vertices along the line
    movable : which bodies may be shifted
    bodies : indices of the bodies to separate
    """
    ends = [(float(item.min()), float(item.max())) for item in along]
    shifts = [0.0] * len(along)
    still = [ends[n] for n in bodies if not movable[n]]
    moving = sorted((n for n in bodies if movable[n]), key=lambda n: sum(ends[n]))
    at = max((high for _, high in still), default=-np.inf)
    for number in moving:
        low, high = ends[number]
        shifts[number] = max(0.0, at + _GAP - low)
        at = high + shifts[number]
    if not still and moving:
        middle = sum(shifts[n] for n in moving) / len(moving)
        for number in moving:
            shifts[number] -= middle
    return shifts
