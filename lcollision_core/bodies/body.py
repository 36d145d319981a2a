"""The interface of a body that can take poses, whatever its pose space."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.codec import BLOCK_POSES
from lcollision_core.bodies.card import ModelCard
from lcollision_core.bodies.latent_space import SHAPES, WHOLE_BODY, LatentGroup, LatentSpace
from lcollision_core.bodies.mirror import (
    MirroredPose,
    MirrorSource,
    PoseMirror,
    Symmetry,
    find_symmetry,
)
from lcollision_core.bodies.names import CodeEffect, code_names, with_regions
from lcollision_core.errors import (
    LCollisionError,
    ModelFileError,
    PoseSetError,
    ShapeError,
    WrongScaleError,
)
from lcollision_core.jobs import UNWATCHED, Job, for_blocks
from lcollision_core.meshes import (
    ContactRules,
    FaceGroup,
    RigidTransform,
    Topology,
    body_size,
    front_direction,
    groups_by_kind,
    with_named_groups,
)
from lcollision_core.meshes.face_groups import (
    touching_groups,
)
from lcollision_core.meshes.outliers import LARGEST_SIZE, is_torn, scale_of
from lcollision_core.meshes.precision import can_hold, first_not_finite, in_unit
from lcollision_core.meshes.topology import FloatArray, latent_array, sorted_faces

if TYPE_CHECKING:
    from lcollision_core.bodies.rig_poses import StarterPose
    from lcollision_core.bodies.rig_space import RigPoseSpace
    from lcollision_core.contact import CollisionDetector
    from lcollision_core.embedding.bilevel import Embedding, LatentFit
    from lcollision_core.files.character import Character
    from lcollision_core.files.scene.appearance import Appearance
    from lcollision_core.options import RuleOptions
    from lcollision_core.posing import ExactCheck, PoseDragger, PoseSpace
    from lcollision_core.predictor import CollisionPredictor, Prediction, PredictorRecord
    from lcollision_core.resolve import PoseResolver, ResolveOptions, ResolveResult


@dataclass(frozen=True)
class EncodedPose:
    """A mesh as a latent pose.

    Attributes
    ----------
    latent : (D,) float64 array
    placement : takes the decoded pose to the mesh's position and unit
    fit_error_mean, fit_error_max : normalised distance of the decoded vertices from the mesh's
    """

    latent: npt.NDArray[np.float64]
    placement: RigidTransform
    fit_error_mean: float
    fit_error_max: float


class Body(ABC):
    """A body that can take poses: immutable, and safe to share between threads.

    A pose is a vector of D codes in the body's pose space: the latent codes of a trained model
    (`LearnedBody`), or the angles of a character's joints. Meshes are NumPy arrays in the body's
    unit, in the coordinates of its reference.

    Parameters
    ----------
    name : of the body
    card : its units, names and origin
    topology : of all its poses
    reference : (V, 3) float64 array, in its unit
    attention_mask : (K, V) float32 array, each domain's share of each vertex; columns sum to 1
    known_poses : (N, D) float64 array, the codes of the poses that came with the body

    Attributes
    ----------
    name, card, topology : as given
    reference, attention_mask, known_poses : as given, read-only
    notes : sentences about changes made on reading
    """

    notes: tuple[str, ...] = ()
    character: Character | None = None
    """The character of the file whose joints pose the body; None for a body without joints."""
    joints: RigPoseSpace | None = None
    """`space` if it is that of a rig's joints; None for a body without joints."""
    embedding: Embedding | None = None
    """The latent space of a learned body; None for others."""
    is_trained = False
    """Whether the pose space was learned from the poses that came with the body."""
    has_predictor = False
    """Whether a predictor was trained."""
    no_predictor: tuple[str, str]
    """Why there is no predictor, with a field for the body's name, and advice."""
    can_resolve = True
    """Whether colliding poses can be resolved."""
    shape_names: tuple[str, ...] = ()
    """S names of the last codes, the weights of morph targets; most bodies have none."""
    fixed_domains: frozenset[int] = frozenset()
    """The body parts that must not move, such as those of a fixed body of a scene."""
    ground: tuple[float, npt.NDArray[np.bool_]] | None = None
    """Normalised height of the ground and a (V,) mask of the other vertices; None without."""
    own_card: ModelCard | None = None
    """The card of a body whose file does not keep the user's choices, before any of them."""
    has_unit = False
    """Whether the data's unit is known even if the card's is a metre, as it is by default."""
    no_sides = (
        "its first pose is not symmetric, so left and right cannot be told apart",
        "train a model whose first pose is symmetric",
    )
    """Why there is no `symmetry`, and advice."""

    def __init__(
        self,
        name: str,
        card: ModelCard,
        topology: Topology,
        reference: FloatArray,
        attention_mask: npt.NDArray[np.float32],
        known_poses: FloatArray,
    ) -> None:
        self.name, self.card, self.topology = name, card, topology
        self.reference: FloatArray = read_only(reference)
        self.attention_mask: npt.NDArray[np.float32] = read_only(attention_mask)
        self.known_poses: FloatArray = read_only(known_poses)

    # Each kind of body defines these.

    @property
    @abstractmethod
    def space(self) -> PoseSpace:
        """The pose space that dragging and Resolve use."""

    @property
    @abstractmethod
    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the pose space.

        Bodies with equal fingerprints can exchange poses. It does not depend on names, nor on
        anything trained on top of the pose space.
        """

    @property
    @abstractmethod
    def code_effects(self) -> tuple[CodeEffect, ...]:
        """The effect of raising each of the D codes."""

    @property
    @abstractmethod
    def free_latent(self) -> FloatArray:
        """(F, D) known collision-free poses, read-only."""

    @property
    @abstractmethod
    def resolver(self) -> PoseResolver:
        """Resolves the self-collisions of this body's poses.

        Raises
        ------
        ModelFileError : the body needs a predictor to resolve, and has none or a damaged one.
        """

    @abstractmethod
    def _fit(self, vertices: FloatArray, job: Job, *, in_place: bool) -> LatentFit:
        """Find the codes whose mesh is nearest to (V, 3) normalised vertices.

        Parameters
        ----------
        in_place : whether the mesh is aligned with the reference and must not be moved
        """

    # Some kinds redefine these, and a few of those below.

    @property
    def starter_poses(self) -> tuple[StarterPose, ...]:
        """Poses to begin with; none unless the rig's joints are known."""
        return ()

    @property
    def appearance(self) -> Appearance | None:
        """How the body looks in its source file; None if unknown."""
        return None

    @property
    def predictor(self) -> CollisionPredictor | None:
        """The collision predictor; None if none was trained.

        Raises
        ------
        ModelFileError : it is damaged.
        """
        return None

    @property
    def predictor_record(self) -> PredictorRecord | None:
        """How the predictor was trained and measured, without torch; None if there is none.

        Raises
        ------
        ModelFileError : the record is damaged.
        """
        return None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the body as a model file, atomically.

        Raises
        ------
        ModelFileError : the body was not learned, or the file cannot be written.
        """
        raise ModelFileError(
            f"cannot hold {self.name}, which is no learned model", "copy its own file", where=path
        )

    @property
    def _decoder(self) -> Callable[[FloatArray], FloatArray]:
        """Decoder of (B, D) codes to (B, V, 3) normalised vertices, on the calling thread."""
        return self.space.decode

    def _drawn(self, n_poses: int, generator: np.random.Generator) -> FloatArray:
        return self.latent_space.sample(n_poses, generator)

    def _vertex_labels(self) -> npt.NDArray[np.str_] | None:
        """Return (V,) names of body parts that groups are named after, None if unknown."""
        return None

    # Its size, file and parts.

    @property
    def body_size(self) -> float:
        """The body size in the data's unit; lengths are normalised by it."""
        return self.card.height

    @property
    def known_metres(self) -> float | None:
        """Length of the data's unit in metres; None if unknown."""
        return self.card.metres if self.has_unit or self.card.metres != 1.0 else None

    @property
    def up_axis(self) -> int:
        """0, 1 or 2 for x, y or z."""
        return self.card.up_axis

    @property
    def up(self) -> tuple[float, float, float]:
        """Unit vector along the up axis."""
        x, y, z = (float(axis == self.up_axis) for axis in range(3))
        return x, y, z

    @cached_property
    def front(self) -> FloatArray:
        """(3,) unit vector along an axis: where the reference faces, guessed from its shape."""
        return read_only(front_direction(self.reference, self.up_axis))

    @property
    def faces(self) -> npt.NDArray[np.int32]:
        """(F, 3) int32 array, vertex indices from 0, read-only."""
        return self.topology.faces

    @property
    def n_vertices(self) -> int:
        """V."""
        return self.topology.n_vertices

    @property
    def latent_size(self) -> int:
        """D, the number of a latent pose's codes."""
        return len(self.space.low)

    @property
    def shape_codes(self) -> slice:
        """Range of the shape codes in a pose."""
        return slice(self.latent_size - len(self.shape_names), self.latent_size)

    @property
    def domain_names(self) -> tuple[str, ...]:
        """K unique names."""
        return self.card.domain_names

    @property
    def domain_order(self) -> tuple[int, ...]:
        """All K domains, indices from 0, in listing order."""
        return self.card.domain_order or tuple(range(len(self.domain_names)))

    @property
    def own_file(self) -> Path | None:
        """The character's file; None for a body without joints."""
        return None if self.character is None else self.character.source

    @property
    def own_clips(self) -> tuple[str, ...]:
        """The names of the character's clips."""
        return () if self.character is None else tuple(self.character.clips)

    def is_of_file(self, path: str | os.PathLike[str]) -> bool:
        """Return whether a path is `own_file`."""
        return self.own_file is not None and self.own_file.absolute() == Path(path).absolute()

    def without_ground(self, vertices: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return (..., V, 3) vertices without those of the ground, for fitting views."""
        return vertices if self.ground is None else vertices[..., self.ground[1], :]

    # Poses and meshes.

    def decode(self, latent: npt.ArrayLike, n_threads: int | None = None) -> FloatArray:
        """Turn latent poses into meshes.

        Parameters
        ----------
        latent : (D,) or (B, D) finite array
        n_threads : threads to spread the poses over, by default one per core

        Returns
        -------
        vertices : (V, 3) or (B, V, 3) float64 array, in the body's unit, in its reference's
            coordinates; bit-identical for a pose alone and in any batch

        Raises
        ------
        ShapeError : wrong shape, or a number that is not finite.
        """
        codes = self._checked(latent)
        rows = codes.reshape(-1, self.latent_size)
        vertices = np.empty((len(rows), self.n_vertices, 3))
        decode = self.block_decoder

        def fill(start: int, stop: int) -> None:
            vertices[start:stop] = decode(rows[start:stop])

        for_blocks(fill, len(rows), BLOCK_POSES, n_threads)
        return vertices[0] if codes.ndim == 1 else vertices

    @property
    def block_decoder(self) -> Callable[[FloatArray], FloatArray]:
        """Decoder of (B, D) codes as in `decode`, on the calling thread.

        Everything it needs is built here, so that several threads do not build it at once.
        """
        decode, height = self._decoder, self.card.height

        return lambda codes: decode(codes) * height

    def exported_vertices(
        self, latent: npt.ArrayLike, placement: RigidTransform | None = None
    ) -> npt.NDArray[np.floating]:
        """Decode a (D,) latent pose to the (V, 3) vertices that are exported.

        Parameters
        ----------
        placement : of the exported pose; None leaves it in the model's coordinates
        """
        from lcollision_core.posing import exported_vertices

        return exported_vertices(self.decode(latent, n_threads=1), placement)

    def encode(
        self, vertices: npt.ArrayLike, job: Job = UNWATCHED, scale: float = 1.0
    ) -> EncodedPose:
        """Find the pose whose mesh is nearest to a given one, up to a rigid motion.

        Gauss-Newton steps on the vertex distance refine an initial guess of codes and rigid
        motion together.

        Parameters
        ----------
        vertices : (V, 3) finite array, in any unit; the placement converts back to it
        job : polled before the fit
        scale : factor from the unit of `vertices` to the body's unit

        Raises
        ------
        ShapeError : wrong shape, a coordinate that is not finite, or a scale that is not above 0.
        WrongScaleError : larger or smaller than a pose of the reference can be.
        PoseSetError : the vertex order differs, or the mesh is too far from the origin.
        CancelledError : the job was cancelled.
        """
        mesh = _checked_mesh(vertices, self.reference, self.topology, self.name, scale)
        fit = self._fit(mesh / self.body_size, job, in_place=False)
        aligning = RigidTransform(fit.rotation, fit.translation * self.body_size, scale)
        return EncodedPose(
            latent=fit.latent.astype(np.float64),
            placement=aligning.inverse(),
            fit_error_mean=fit.mean_error,
            fit_error_max=fit.max_error,
        )

    def nearest(self, vertices: FloatArray, job: Job = UNWATCHED) -> FloatArray:
        """Return the (D,) codes whose mesh is nearest to (V, 3) normalised vertices, in place.

        Raises
        ------
        CancelledError : the job was cancelled.
        """
        return self._fit(vertices, job, in_place=True).latent.astype(np.float64)

    def require_topology(self, topology: Topology, source: str) -> None:
        """Raise unless a mesh has the same faces as the model, in any order.

        Parameters
        ----------
        topology : of the mesh
        source : name of the mesh in the message

        Raises
        ------
        PoseSetError : the number of vertices or faces, or the faces themselves, differ.
        """
        needed = self.topology
        for noun, given, expected in (
            ("vertices", topology.n_vertices, needed.n_vertices),
            ("faces", topology.n_faces, needed.n_faces),
        ):
            if given != expected:
                raise PoseSetError(
                    f"has {given} {noun}, the model {self.name!r} has {expected}",
                    "export it with the model's topology",
                    where=source,
                )
        if topology != needed and not np.array_equal(
            sorted_faces(topology.faces), sorted_faces(needed.faces)
        ):
            raise PoseSetError(
                f"has other faces than the model {self.name!r}",
                "export it with the model's topology and vertex order",
                where=source,
            )

    def sample(self, n_poses: int, generator: np.random.Generator) -> FloatArray:
        """Draw (n_poses, D) poses uniformly from the box of the codes' ranges.

        Parameters
        ----------
        n_poses : >= 0
        generator : such as ``np.random.default_rng(seed)``

        Raises
        ------
        LCollisionError : there is no such number of poses, or no generator.
        """
        if n_poses < 0:
            raise LCollisionError.must_be("the number of poses", "at least 0", n_poses)
        given: object = generator
        if not isinstance(given, np.random.Generator):
            expected = "one of NumPy, such as np.random.default_rng(0)"
            raise LCollisionError.must_be("the generator", expected, repr(given))
        return self._drawn(n_poses, generator)

    def _checked(self, latent: npt.ArrayLike) -> FloatArray:
        codes = latent_array(latent).astype(np.float64)
        if codes.ndim not in (1, 2) or codes.shape[-1] != self.latent_size:
            raise ShapeError.must_be(
                f"a latent pose of {self.name}",
                f"{self.latent_size} numbers",
                f"shape {codes.shape}",
            )
        if not np.isfinite(codes).all():
            raise ShapeError("a latent pose has a number that is not finite")
        return codes

    # Checking, resolving and predicting poses.

    @cached_property
    def detector(self) -> CollisionDetector:
        """Finds exact self-collisions of this model's meshes, in the data's unit."""
        from lcollision_core.contact import CollisionDetector

        return CollisionDetector(self.topology, self.reference, self.rules, self.groups)

    def exact_check(
        self,
        placement: RigidTransform | None = None,
        space: PoseSpace | None = None,
        clearance: float = 0.0,
    ) -> ExactCheck:
        """Return the exact check of poses placed for export.

        Parameters
        ----------
        space : the body as it is in a frame, by default `self.space`
        clearance : normalised, to keep between parts of collision-free poses
        """
        from lcollision_core.posing import ExactCheck

        detector = self.detector.with_clearance(clearance)
        return ExactCheck(space or self.space, detector, self.body_size, placement)

    def dragger(
        self,
        placement: RigidTransform | None = None,
        space: PoseSpace | None = None,
    ) -> PoseDragger:
        """Return a dragger for poses of `exact_check`; use it from one thread at a time."""
        from lcollision_core.posing import PoseDragger

        return PoseDragger(self.exact_check(placement, space), np.array(self.up))

    def resolve(
        self,
        latent: npt.ArrayLike,
        options: ResolveOptions | None = None,
        job: Job = UNWATCHED,
        placement: RigidTransform | None = None,
    ) -> ResolveResult:
        """Find the nearest collision-free pose.

        Parameters
        ----------
        latent : (D,) finite array
        options : solver, metric, locked domains and limits
        job : reports (steps done, all steps); polled at every evaluation
        placement : of the exported pose; the exact check uses the vertices there

        Raises
        ------
        ShapeError : wrong shape, a number that is not finite or a wrong number of weights.
        LCollisionError : an unknown locked domain.
        ModelFileError : the body needs a predictor to resolve, and has none or a damaged one.
        CancelledError : the job was cancelled.
        """
        return self.resolver.resolve(latent, options, job, placement)

    def predict(self, latent: npt.ArrayLike) -> Prediction:
        """Predict collisions and domain energies of poses, without decoding them.

        Parameters
        ----------
        latent : (D,) or (B, D) finite array; one pose is a batch of 1

        Raises
        ------
        ShapeError : wrong shape, or a number that is not finite.
        ModelFileError : the body has no predictor, or a damaged one.
        """
        return self.require_predictor().predict(np.atleast_2d(self._checked(latent)))

    def require_predictor(self) -> CollisionPredictor:
        """Return the predictor.

        Raises
        ------
        ModelFileError : there is none, or it is damaged.
        """
        predictor = self.predictor
        if predictor is None:
            reason, advice = self.no_predictor
            raise ModelFileError(reason.format(name=self.name), advice)
        return predictor

    @property
    def prediction_needs_torch(self) -> bool:
        """Whether predictions need torch; loads the predictor."""
        return self.predictor is not None and self.predictor.needs_torch

    # Mirroring poses.

    @cached_property
    def symmetry(self) -> Symmetry | None:
        """Symmetry of the mesh; None if the reference is not nearly its own mirror image."""
        return find_symmetry(self.reference, self.topology, self.up_axis)

    @property
    def why_not_mirrored(self) -> str:
        """Why poses cannot be mirrored; "" if they can."""
        return "" if self.symmetry is not None else f"Cannot be mirrored: {self.no_sides[0]}"

    def mirror(
        self,
        latent: npt.ArrayLike,
        placement: RigidTransform | None = None,
        source: MirrorSource | None = None,
        options: ResolveOptions | None = None,
        job: Job = UNWATCHED,
    ) -> MirroredPose:
        """Exchange left and right of a pose: see `PoseMirror.mirror`.

        Parameters
        ----------
        latent : (D,) finite array
        placement, source, options, job : see there

        Raises
        ------
        ShapeError : wrong shape, or a number that is not finite.
        LCollisionError : the model is not symmetric, or a locked domain is unknown.
        ModelFileError : the model's predictor is damaged.
        CancelledError : the job was cancelled.
        """
        pose = self._checked(latent)
        if pose.ndim != 1:
            raise ShapeError("one pose is mirrored at a time", got=f"shape {pose.shape}")
        return self.pose_mirror.mirror(pose, placement, source, options, job)

    @cached_property
    def pose_mirror(self) -> PoseMirror:
        """Mirrors this model's poses.

        Raises
        ------
        LCollisionError : the mesh is not symmetric.
        ModelFileError : the model's predictor is damaged.
        """
        return PoseMirror(*self._mirror_parts())

    def _mirror_parts(
        self,
    ) -> tuple[
        npt.NDArray[np.float32],
        Symmetry,
        ExactCheck,
        Callable[[FloatArray, Job], FloatArray],
        Callable[..., ResolveResult] | None,
    ]:
        """Return the arguments of `PoseMirror`; raise as `pose_mirror`."""
        if self.symmetry is None:
            reason, next_step = self.no_sides
            where = f"poses of {self.name}"
            raise LCollisionError(f"cannot be mirrored: {reason}", next_step, where=where)
        resolve = self.resolve if self.can_resolve else None
        return self.attention_mask, self.symmetry, self.exact_check(), self.nearest, resolve

    # Contact rules.

    @property
    def rules(self) -> ContactRules:
        """Which pairs of faces do not count."""
        return self.card.rules

    @property
    def own_rules(self) -> ContactRules:
        """The rules in the body's file, or the initial ones of a character or a scene."""
        return self.rules if self.own_card is None else self.own_card.rules

    @property
    def rules_are_chosen(self) -> bool:
        """Whether the user has chosen other rules, which the body's file does not keep."""
        return self.rules != self.own_rules

    @property
    def groups(self) -> tuple[FaceGroup, ...]:
        """Named groups of faces, pairs of which the rules may ignore."""
        return self.card.groups

    @property
    def has_joints(self) -> bool:
        """Whether the rules may exclude pairs at joints."""
        return any(group.about_joint for group in self.groups)

    @cached_property
    def groups_by_kind(self) -> dict[str, tuple[FaceGroup, ...]]:
        """All groups that the rules may ignore pairs of, by each of `GROUP_KINDS`."""
        return groups_by_kind(self.groups, self.topology, self._vertex_labels())

    @property
    def _nameable_groups(self) -> list[FaceGroup]:
        """All groups of `groups_by_kind`, and the domains whose names differ from theirs."""
        groups = [group for kind in self.groups_by_kind.values() for group in kind]
        named, owner = {group.name for group in groups}, self.space.vertex_domain[self.faces[:, 0]]
        parts = enumerate(self.domain_names)
        domains = ((name, np.flatnonzero(owner == k)) for k, name in parts if name not in named)
        return groups + [FaceGroup(name, faces) for name, faces in domains]

    def with_rules(self, rules: ContactRules) -> Self:
        """Return the same model with other contact rules, validated on use.

        They may name any groups of `groups_by_kind`, and domains.

        Raises
        ------
        ShapeError : an ignored group is unknown, or too many pairs are excluded.
        ModelFileError : a predictor depends on the present rules.
        """
        return self._ruled(rules)

    def with_options(self, options: RuleOptions) -> Self:
        """Return the same model with these options added to its rules; itself if none are given.

        Tolerances may differ from those that a predictor was trained with, as the exact check
        applies them.

        Raises
        ------
        LCollisionError : an unknown group, joint rules without joints, or a predictor that depends
            on the rules.
        """
        names = {group.name for group in self._nameable_groups} if options.name_groups else set()
        before, rules = self.rules, options.changed(self.rules, names, self.has_joints, self.name)
        if rules == before:
            return self
        tolerated = {name: getattr(before, name) for name in ("tolerated_depth", "tolerated_pairs")}
        differ_in_depth = replace(rules, **tolerated) == before
        return self._ruled(rules) if differ_in_depth else self.with_rules(rules)

    def with_touching(self, entries: Sequence[str]) -> Self:
        """Return the same model with pairs of groups that may touch whatever the clearance.

        Parameters
        ----------
        entries : "A:B", names of `groups_by_kind`, or of domains

        Raises
        ------
        LCollisionError : an entry is not a pair of these names.
        """
        if not entries:
            return self
        pairs = touching_groups(entries, self._nameable_groups)
        return self._with_detector(self.card, self.detector.with_touching(pairs))

    def _ruled(self, rules: ContactRules) -> Self:
        kinds = {"any": self._nameable_groups} if rules.named_groups else {}
        groups = with_named_groups(self.groups, kinds, rules.named_groups)
        card = replace(self.card, rules=rules, groups=groups)
        return self._with_detector(card, self.detector.with_rules(rules, groups))

    def _with_detector(self, card: ModelCard, detector: CollisionDetector) -> Self:
        """Return the same model with another card and detector, and without stale caches."""
        other = self.with_card(card)
        for cached in ("pose_mirror", "resolver", "free_latent"):
            other.__dict__.pop(cached, None)
        other.__dict__["detector"] = detector
        return other

    # Names.

    @cached_property
    def latent_space(self) -> LatentSpace:
        """The groups, names, colours and ranges of the latent codes."""
        space = self.space
        groups, start = [], 0
        labels = (
            (WHOLE_BODY, None),
            *zip(self.domain_names, self.card.domain_colours, strict=True),
        )
        for (name, colour), size in zip(labels, space.group_sizes, strict=True):
            code_names = (
                self.domain_names
                if colour is None
                else tuple(f"motion {code + 1}" for code in range(size))
            )
            groups.append(LatentGroup(name, colour, slice(start, start + size), code_names))
            start += size
        if self.shape_names:
            groups.append(LatentGroup(SHAPES, None, self.shape_codes, self.shape_names))
        return LatentSpace(
            groups=tuple(groups),
            low=read_only(space.low),
            high=read_only(space.high),
            at_rest=read_only(np.zeros(self.latent_size)),
            shown=read_only(np.ones(self.latent_size)),
            units=("",) * self.latent_size,
        )

    @cached_property
    def code_names(self) -> tuple[str, ...]:
        """D names of the codes by effect, unique within each group: "left thigh forward"."""
        return code_names(self.code_effects, self.domain_names, self.space.group_sizes)

    @cached_property
    def code_words(self) -> tuple[str, ...]:
        """D lower-case search texts, with all names that a code may have."""
        words = [
            # The full name holds its number in the group as well.
            with_regions(f"{group.name} {own} {group.full_name(index)}")
            for group in self.latent_space.groups
            for index, own in enumerate(self.code_names[group.codes])
        ]
        if not any("finger" in text for text in words):
            # Fingers without codes of their own move with the hand.
            words = [f"{text} finger thumb" if "hand" in text else text for text in words]
        return tuple(words)

    def edit_domains(
        self,
        names: Mapping[int, str] | None = None,
        colours: Mapping[int, str] | None = None,
        order: Sequence[int] | None = None,
    ) -> Self:
        """Return the same model with other domain names, colours or listing order.

        Parameters
        ----------
        names : new names by domain, an index from 0; two domains may swap theirs
        colours : new colours "#rrggbb" by domain
        order : all domains in listing order; the order of the latent entries does not change

        Raises
        ------
        ModelFileError : an unknown domain, an invalid or duplicate name, or an invalid colour or
            order.
        """
        renamed, coloured = list(self.domain_names), list(self.card.domain_colours)
        for values, changes in ((renamed, names or {}), (coloured, colours or {})):
            for domain, value in changes.items():
                if not 0 <= domain < len(values):
                    raise ModelFileError(
                        f"{self.name} has no domain {domain + 1}",
                        f"its domains are 1 to {len(values)}",
                    )
                values[domain] = value.strip() if values is renamed else value.lower()
        return self.with_card(
            replace(
                self.card,
                domain_names=tuple(renamed),
                domain_colours=tuple(coloured),
                domain_order=self.card.domain_order if order is None else tuple(order),
            )
        )

    def with_card(self, card: ModelCard, name: str | None = None) -> Self:
        """Return the same model with another card; computed properties are kept.

        Parameters
        ----------
        card : names, colours or order may differ; units and poses are the same
        name : the new name of the model, by default the same
        """
        other = copy(self)
        other.card, other.name = card, name or self.name
        for cached in ("latent_space", "code_names", "code_words"):
            other.__dict__.pop(cached, None)
        return other

    def noted(self, sentence: str) -> Self:
        """Return the same body with one more note."""
        other = self.with_card(self.card)
        other.notes = (*self.notes, sentence)
        return other


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a read-only view of an array."""
    view = array.view()
    view.flags.writeable = False
    return view


_MOST_SIZE = 20.0
"""Size ratio limit for meshes whose edges are not scaled uniformly."""

_UNITS = (0.001, 0.01, 0.0254, 0.1, 0.3048, 1.0)
"""Metres in a millimetre, centimetre, inch, decimetre, foot and metre."""


def _checked_mesh(
    vertices: npt.ArrayLike,
    reference: FloatArray,
    topology: Topology,
    model: str,
    scale: float = 1.0,
) -> FloatArray:
    """Validate a mesh that a model is to encode; return it as float64, in the data's unit.

    Parameters
    ----------
    vertices : (V, 3) array
    reference : (V, 3) array, of the model
    topology : of both
    model : its name
    scale : factor from the unit of `vertices` to the data's unit

    Raises
    ------
    ShapeError : wrong shape, a coordinate that is not finite, or a scale that is not above 0.
    WrongScaleError : the mesh is larger or smaller than the reference, as in another unit.
    PoseSetError : the vertex order differs, or the mesh is too far from the origin for its digits.
    """
    mesh = np.asarray(vertices, dtype=np.float64)
    if mesh.shape != reference.shape:
        raise ShapeError.must_be(f"a mesh of {model}", f"of shape {reference.shape}", mesh.shape)
    if (vertex := first_not_finite(mesh)) is not None:
        raise ShapeError("is not finite", where=f"vertex {vertex} (from 0)")
    if not can_hold(mesh, topology, np.float64):
        raise PoseSetError(
            "the mesh lies so far from the origin that its coordinates lose their digits",
            "move it nearer to the origin",
        )
    mesh = in_unit(mesh, scale)
    lengths, reference_lengths = (topology.edge_lengths(pose) for pose in (mesh, reference))
    size, limit = scale_of(lengths, reference_lengths), LARGEST_SIZE
    if size is None:
        # Not scaled uniformly: perhaps not a pose, but only a large ratio indicates another unit.
        size, limit = body_size(mesh, topology) / body_size(reference, topology), _MOST_SIZE
    if not 1.0 / limit < size < limit:
        sentence = (
            f"the mesh is {float(f'{size:.3g}'):g} times as large as the body of {model!r}, "
            f"which is {body_size(reference, topology):.3g} tall in its own unit"
        )
        if not 0.0 < size < np.inf:
            raise PoseSetError(sentence, "export it again")
        factor = likely_factor(1.0 / size) * scale
        raise WrongScaleError(sentence, f"scale it by {factor:.6g}", factor=factor)
    if is_torn(lengths, size * reference_lengths):
        raise PoseSetError(
            f"the edges of the mesh join other vertices than those of {model!r}, as if in "
            "another vertex order",
            "export it with the model's vertex order",
        )
    return mesh


def likely_factor(measured: float) -> float:
    """Return the factor between two common units that is nearest to a measured ratio.

    Parameters
    ----------
    measured : > 0, ratio of sizes

    Returns
    -------
    factor : such as 1000, 39.3701 or 2.54; `measured`, to three digits, if no factor is within
        the range of body sizes
    """
    factors = np.array([factor / other for factor in _UNITS for other in _UNITS])
    distances = np.abs(np.log(factors / measured))
    if distances.min() > np.log(LARGEST_SIZE):
        return float(f"{measured:.3g}")
    return float(f"{factors[distances.argmin()]:.6g}")
