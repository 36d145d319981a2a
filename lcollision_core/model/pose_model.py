"""A model read from one file, with everything that a front end needs."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lcollision_core.contact import CollisionDetector
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.embedding.metrics import EmbeddingMetrics
from lcollision_core.errors import LCollisionError, ModelFileError, ShapeError
from lcollision_core.jobs import CancelToken, Progress, no_progress
from lcollision_core.meshes import (
    PoseSet,
    RigidTransform,
    Topology,
    body_size,
    front_direction,
)
from lcollision_core.model.card import ModelCard
from lcollision_core.model.code_names import CodeEffect, code_effects, code_names
from lcollision_core.model.colours import domain_colours
from lcollision_core.model.encoded_pose import EncodedPose
from lcollision_core.model.latent_identity import EMBEDDING, fingerprint_of
from lcollision_core.model.latent_space import WHOLE_BODY, LatentGroup, LatentSpace
from lcollision_core.model.matching import checked_mesh, require_same_faces
from lcollision_core.model.mirror import (
    MirroredPose,
    MirrorSource,
    PoseMirror,
    Symmetry,
    find_symmetry,
)
from lcollision_core.model.model_store import find_model
from lcollision_core.model.naming import names_from_labels, numbered_names
from lcollision_core.model_file import (
    Section,
    read_model_file,
    required_array,
    write_model_file,
)

if TYPE_CHECKING:
    from lcollision_core.labels import Labeller
    from lcollision_core.posing import ExactCheck, LatentPoseSpace, PoseDragger
    from lcollision_core.predictor import CollisionPredictor, Prediction, PredictorRecord
    from lcollision_core.resolve import PoseResolver, ResolveOptions, ResolveResult

FloatArray = npt.NDArray[np.float64]

_CARD = "model"
_PREDICTOR = "predictor"
_FREE_POSES = "free_poses"
_LARGEST_CODE = 1e6
"""Of a latent pose; what is larger would overflow."""


class PoseModel:
    """A body that can take poses: immutable, and safe to share between threads.

    Poses are NumPy arrays in the unit of the data that the model was trained on, in the coordinates
    of its reference. Build one with `load` or `from_training`.

    Parameters
    ----------
    name : what the model is called
    embedding : its latent space
    card : its units, names and origin
    other_sections : of its file, by name: a predictor, known free poses, and sections unknown to
        this version of the program, which are saved unchanged

    Attributes
    ----------
    name, embedding, card : as given; front ends need only the following
    reference : (V, 3) float64 array, read-only, in the data's unit
    attention_mask : (K, V) float32 array, read-only, each column sums to 1
    training_latent : (N, D) float64 array, read-only, the training poses' codes

    Raises
    ------
    ModelFileError : the card names another number of domains or poses than the embedding has.
    """

    def __init__(
        self,
        name: str,
        embedding: Embedding,
        card: ModelCard,
        other_sections: Mapping[str, Section] | None = None,
    ) -> None:
        counts = (len(card.domain_names), len(card.pose_names))
        if counts != (embedding.n_domains, len(embedding.training_latent)):
            raise ModelFileError(
                f"the model names {counts[0]} domains and {counts[1]} poses, but has "
                f"{embedding.n_domains} and {len(embedding.training_latent)}",
                "train or copy the model again",
            )
        self.name = name
        self.card = card
        self.embedding = embedding
        self._other_sections = dict(other_sections or {})
        self.reference: FloatArray = _read_only(
            embedding.topology.gathered(embedding.rest_vertices) * card.height
        )
        self.attention_mask = _read_only(embedding.attention_mask)
        self.training_latent: FloatArray = _read_only(embedding.training_latent.astype(np.float64))

    @classmethod
    def load(cls, name_or_path: str | os.PathLike[str]) -> PoseModel:
        """Read a model; no code in its file is executed.

        Parameters
        ----------
        name_or_path : a file, or the name of a bundled or user model

        Raises
        ------
        ModelFileError : there is no such model, or its file is damaged, of another program or of
            a later version.
        """
        path = find_model(name_or_path)
        sections = read_model_file(path)
        missing = [name for name in (EMBEDDING, _CARD) if name not in sections]
        if missing:
            raise ModelFileError(
                f"lacks its section {missing[0]!r}", "train or copy the model again", where=path
            )
        try:
            embedding_section, card_section = sections.pop(EMBEDDING), sections.pop(_CARD)
            embedding = Embedding.from_arrays(embedding_section.arrays, embedding_section.metadata)
            card = ModelCard.from_metadata(card_section.metadata)
            model = cls(path.stem, embedding, card, sections)
            # Damage is found now, not when these are used.
            _ = model.predictor_record, model.free_latent
            return model
        except ModelFileError as error:
            raise ModelFileError.because(path, "is unusable", error) from error

    @classmethod
    def from_training(
        cls,
        name: str,
        embedding: Embedding,
        pose_set: PoseSet,
        source: str | None = None,
        licence: str = "unknown",
        provenance: Mapping[str, Any] | None = None,
    ) -> PoseModel:
        """Make a model of a trained embedding.

        Parameters
        ----------
        name : what to call it
        embedding : trained on `pose_set`
        pose_set : gives the units, the poses' names and, where its vertices are labelled, the
            domains' names
        source : what the poses are, by default the name of their file
        licence : of the model
        provenance : how it was made, JSON values by name
        """
        reference = pose_set.vertices[0]
        up = pose_set.up.axis
        if pose_set.vertex_labels is None:
            names = numbered_names(embedding.n_domains)
        else:
            names = names_from_labels(
                embedding.attention_mask, pose_set.vertex_labels, reference[:, up]
            )
        card = ModelCard(
            height=body_size(reference, pose_set.topology),
            up_axis=up,
            near_exclusion=pose_set.near_exclusion,
            domain_names=names,
            domain_colours=domain_colours(embedding.attention_mask),
            pose_names=pose_set.names,
            source=source or (pose_set.source.name if pose_set.source else "unknown"),
            licence=licence,
            provenance=dict(provenance or {}),
        )
        return cls(name, embedding, card)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model, whole or not at all; equal models give equal bytes.

        Raises
        ------
        ModelFileError : the file cannot be written.
        """
        arrays, metadata = self.embedding.to_arrays()
        sections = {
            **self._other_sections,
            EMBEDDING: Section(arrays, metadata),
            _CARD: Section({}, self.card.to_metadata()),
        }
        write_model_file(path, sections)

    def decode(self, latent: npt.ArrayLike, n_threads: int | None = None) -> FloatArray:
        """Turn latent poses into meshes.

        Parameters
        ----------
        latent : (D,) or (B, D) finite array
        n_threads : threads to spread the poses over, one for each core by default

        Returns
        -------
        vertices : (V, 3) or (B, V, 3) float64 array, in the data's unit, in the model's
            coordinates; a pose gets the same bits alone and in any batch

        Raises
        ------
        ShapeError : another shape, or a number that is not finite.
        """
        codes = self._checked(latent)
        vertices = self.embedding.decode(codes.reshape(-1, self.latent_size), n_threads)
        vertices *= self.card.height
        return vertices[0] if codes.ndim == 1 else vertices

    def exported_vertices(
        self, latent: npt.ArrayLike, placement: RigidTransform | None = None
    ) -> npt.NDArray[np.floating]:
        """Decode a (D,) latent pose to the (V, 3) vertices that it is exported with.

        Parameters
        ----------
        placement : where the pose is exported to; None leaves it in the model's coordinates
        """
        from lcollision_core.posing import exported_vertices

        return exported_vertices(self.decode(latent, n_threads=1), placement)

    def exact_check(self, placement: RigidTransform | None = None) -> ExactCheck:
        """Return the exact check of poses placed for export."""
        from lcollision_core.posing import ExactCheck

        return ExactCheck(self.pose_space, self.detector, self.body_size, placement)

    @cached_property
    def pose_space(self) -> LatentPoseSpace:
        """The latent poses as dragging and Resolve see them."""
        from lcollision_core.posing import LatentPoseSpace

        return LatentPoseSpace(self.embedding)

    def dragger(self, placement: RigidTransform | None = None) -> PoseDragger:
        """Return what drags poses placed for export by hand; for one thread at a time."""
        from lcollision_core.posing import PoseDragger

        return PoseDragger(self.exact_check(placement))

    def labeller(self) -> Labeller:
        """Return what labels samples of the model's latent box, by the model's pair rule."""
        from lcollision_core.labels import Labeller

        return Labeller(self.embedding, self.body_size, self.near_exclusion, self.fingerprint)

    def predict(self, latent: npt.ArrayLike) -> Prediction:
        """Predict whether poses collide, and how deeply in which domain, without decoding them.

        Parameters
        ----------
        latent : (D,) or (B, D) finite array; one pose is a batch of 1

        Raises
        ------
        ShapeError : another shape, or a number that is not finite.
        ModelFileError : the model has no predictor, or a damaged one.
        """
        return self.require_predictor().predict(np.atleast_2d(np.asarray(latent, np.float64)))

    def resolve(
        self,
        latent: npt.ArrayLike,
        options: ResolveOptions | None = None,
        progress: Progress = no_progress,
        cancel: CancelToken | None = None,
        placement: RigidTransform | None = None,
    ) -> ResolveResult:
        """Find the nearest collision-free pose.

        Parameters
        ----------
        latent : (D,) finite array
        options : the solver, what is kept small, locked domains and limits
        progress : called with (steps of the ladder done, all steps)
        cancel : polled at every evaluation
        placement : where the pose is exported to; the exact check is of the vertices there

        Raises
        ------
        ShapeError : another shape, a number that is not finite or another number of weights.
        LCollisionError : an unknown locked domain.
        ModelFileError : the model has no predictor, or a damaged one.
        CancelledError : `cancel` was set.
        """
        return self.resolver.resolve(latent, options, progress, cancel, placement)

    def mirror(
        self,
        latent: npt.ArrayLike,
        placement: RigidTransform | None = None,
        source: MirrorSource | None = None,
        options: ResolveOptions | None = None,
        progress: Progress = no_progress,
        cancel: CancelToken | None = None,
    ) -> MirroredPose:
        """Exchange left and right of a pose: see `PoseMirror.mirror`.

        Parameters
        ----------
        latent : (D,) finite array
        placement, source, options, progress, cancel : see there

        Raises
        ------
        ShapeError : another shape, or a number that is not finite.
        LCollisionError : the model has no two sides, or a locked domain is unknown.
        ModelFileError : the model's predictor is damaged.
        CancelledError : `cancel` was set.
        """
        pose = self._checked(latent)
        if pose.ndim != 1:
            raise ShapeError("one pose is mirrored at a time", got=f"shape {pose.shape}")
        return self.pose_mirror.mirror(pose, placement, source, options, progress, cancel)

    def encode(
        self, vertices: npt.ArrayLike, cancel: CancelToken | None = None, scale: float = 1.0
    ) -> EncodedPose:
        """Find the latent pose whose mesh lies nearest to a given one, wherever that lies.

        The encoder's guess, then Gauss-Newton steps on the vertex distance that settle code and
        rigid motion together.

        Parameters
        ----------
        vertices : (V, 3) finite array, in any unit; the placement converts back to it
        cancel : polled before the fit
        scale : brings `vertices` into the data's unit

        Raises
        ------
        ShapeError : another shape, a coordinate that is not finite, or a scale that is not above 0.
        WrongScaleError : larger or smaller than a pose of the reference can be.
        PoseSetError : with other vertices joined, or too far from the origin.
        CancelledError : `cancel` was set.
        """
        mesh = checked_mesh(vertices, self.reference, self.topology, self.name, scale)
        fit = self.embedding.encode(mesh / self.card.height, cancel)
        aligning = RigidTransform(fit.rotation, fit.translation * self.card.height, scale)
        return EncodedPose(
            latent=fit.latent.astype(np.float64),
            placement=aligning.inverse(),
            fit_error_mean=fit.mean_error,
            fit_error_max=fit.max_error,
        )

    def require_topology(self, topology: Topology, source: str) -> None:
        """Refuse a mesh whose faces are not the model's, in any order.

        Parameters
        ----------
        topology : the mesh's
        source : what the sentence calls the mesh

        Raises
        ------
        PoseSetError : another number of vertices or faces, or other faces.
        """
        require_same_faces(topology, self.topology, source, self.name)

    def edit_domains(
        self,
        names: Mapping[int, str] | None = None,
        colours: Mapping[int, str] | None = None,
        order: Sequence[int] | None = None,
    ) -> PoseModel:
        """Return the same model with other names, colours or order of some domains.

        Parameters
        ----------
        names : new names by domain, an index from 0; two domains may swap theirs
        colours : new colours "#rrggbb" by domain
        order : all domains in listing order; the order of the latent entries does not change

        Raises
        ------
        ModelFileError : there is no such domain, a name cannot be or is another domain's, or a
            colour or an order is invalid.
        """
        renamed, coloured = list(self.domain_names), list(self.domain_colours)
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

    def with_card(self, card: ModelCard, name: str | None = None) -> PoseModel:
        """Return the same model with another card; computed properties are kept.

        Parameters
        ----------
        card : names, colours or order differ; units and poses are the same
        name : the new name of the model, by default the same
        """
        other = copy(self)
        other.card, other.name = card, name or self.name
        for cached in ("latent_space", "code_names"):
            other.__dict__.pop(cached, None)
        return other

    def turned_upright(self, up_axis: int) -> PoseModel:
        """Return the same model with another axis upwards: 0, 1 or 2 for x, y or z.

        Raises
        ------
        ModelFileError : there is no such axis.
        """
        card = replace(self.card, up_axis=up_axis)
        return PoseModel(self.name, self.embedding, card, self._other_sections)

    def with_predictor(self, predictor: CollisionPredictor) -> PoseModel:
        """Return the same model with a predictor, in the place of any that it had."""
        return self._with_section(_PREDICTOR, predictor.to_section())

    def with_free_poses(self, latent: npt.ArrayLike) -> PoseModel:
        """Return the same model with (F, D) poses that were found collision-free, F >= 0."""
        codes = np.asarray(latent, dtype=np.float32).reshape(-1, self.latent_size)
        return self._with_section(_FREE_POSES, Section({"latent": codes}))

    def _checked(self, latent: npt.ArrayLike) -> FloatArray:
        codes = np.asarray(latent, dtype=np.float64)
        if codes.ndim not in (1, 2) or codes.shape[-1] != self.latent_size:
            raise ShapeError.must_be(
                f"a latent pose of {self.name}",
                f"{self.latent_size} numbers",
                f"shape {codes.shape}",
            )
        if not np.isfinite(codes).all():
            raise ShapeError("a latent pose has a number that is not finite")
        return codes

    def _with_section(self, name: str, section: Section) -> PoseModel:
        sections = {**self._other_sections, name: section}
        return PoseModel(self.name, self.embedding, self.card, sections)

    @property
    def has_predictor(self) -> bool:
        """Whether a predictor was trained; unlike `predictor`, it loads nothing."""
        return _PREDICTOR in self._other_sections

    @cached_property
    def predictor(self) -> CollisionPredictor | None:
        """The collision predictor; None if none was trained yet.

        Raises
        ------
        ModelFileError : it is damaged.
        """
        section = self._other_sections.get(_PREDICTOR)
        if section is None:
            return None
        from lcollision_core.predictor import CollisionPredictor

        return CollisionPredictor.from_section(section, self.embedding)

    @cached_property
    def predictor_record(self) -> PredictorRecord | None:
        """How the predictor was trained and measured, without torch; None if there is none.

        Raises
        ------
        ModelFileError : the record is damaged.
        """
        section = self._other_sections.get(_PREDICTOR)
        if section is None:
            return None
        from lcollision_core.predictor import PredictorRecord

        return PredictorRecord.of_section(section, self.embedding)

    def require_predictor(self) -> CollisionPredictor:
        """Return the predictor, or raise ModelFileError if there is none or it is damaged."""
        predictor = self.predictor
        if predictor is None:
            raise ModelFileError(
                f"the model {self.name!r} has no predictor",
                "run `lcollision label` and then `lcollision train predictor`",
            )
        return predictor

    @cached_property
    def free_latent(self) -> FloatArray:
        """(F, D) poses that were found collision-free when the predictor was made, read-only.

        Raises
        ------
        ModelFileError : they are damaged.
        """
        section = self._other_sections.get(_FREE_POSES)
        codes = None if section is None else section.arrays.get("latent")
        if section is None or (codes is not None and codes.shape == (0, self.latent_size)):
            return _read_only(np.empty((0, self.latent_size)))
        try:
            codes = required_array(
                section.arrays, "latent", np.float32, (None, self.latent_size), _LARGEST_CODE
            )
        except ValueError as error:
            raise ModelFileError.because(
                "the model's free poses", "are damaged", error, "train the predictor again"
            ) from error
        return _read_only(codes.astype(np.float64))

    @cached_property
    def resolver(self) -> PoseResolver:
        """Resolves the self-collisions of this model's poses.

        Raises
        ------
        ModelFileError : the model has no predictor, or a damaged one.
        """
        from lcollision_core.resolve import PoseResolver

        return PoseResolver(self.exact_check(), self.require_predictor(), self.free_latent)

    @cached_property
    def symmetry(self) -> Symmetry | None:
        """Left and right of the mesh; None if its reference is not its own mirror image."""
        return find_symmetry(self.reference, self.topology, self.up_axis)

    @cached_property
    def pose_mirror(self) -> PoseMirror:
        """Exchanges left and right of this model's poses.

        Raises
        ------
        LCollisionError : the mesh has no two sides.
        ModelFileError : the model has a damaged predictor.
        """
        if self.symmetry is None:
            raise LCollisionError(
                "cannot be mirrored: its first pose is not symmetric, so that left and "
                "right are unknown",
                "train a model whose first pose is",
                where=f"poses of {self.name}",
            )
        resolver = self.resolver if self.has_predictor else None
        return PoseMirror(self.embedding, self.symmetry, self.exact_check(), resolver)

    @cached_property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the latent space.

        Models with one fingerprint can exchange latent poses: it depends on neither names nor
        anything that is trained on the latent space.
        """
        return fingerprint_of(*self.embedding.to_arrays())

    @cached_property
    def latent_space(self) -> LatentSpace:
        """The groups, names, colours and ranges of the latent's codes."""
        embedding = self.embedding
        groups, start = [], 0
        labels = ((WHOLE_BODY, None), *zip(self.domain_names, self.domain_colours, strict=True))
        for (name, colour), size in zip(labels, embedding.group_sizes, strict=True):
            code_names = (
                self.domain_names
                if colour is None
                else tuple(f"motion {code + 1}" for code in range(size))
            )
            groups.append(LatentGroup(name, colour, slice(start, start + size), code_names))
            start += size
        return LatentSpace(
            groups=tuple(groups),
            low=_read_only(embedding.box.low),
            high=_read_only(embedding.box.high),
        )

    @cached_property
    def code_effects(self) -> tuple[CodeEffect, ...]:
        """The effect of raising each of the D codes, measured by decoding some poses."""
        return code_effects(
            self.decode,
            self.latent_space.high,
            self.attention_mask,
            self.embedding.group_sizes,
            self.up_axis,
            self.front,
        )

    @cached_property
    def code_names(self) -> tuple[str, ...]:
        """D names of the codes by effect, unique within each group: "left thigh forward"."""
        return code_names(self.code_effects, self.domain_names, self.embedding.group_sizes)

    @cached_property
    def detector(self) -> CollisionDetector:
        """Finds exact self-collisions of this model's meshes, in the data's unit."""
        return CollisionDetector(self.topology, self.reference, near_exclusion=self.near_exclusion)

    @property
    def topology(self) -> Topology:
        """The faces that all poses share, with derived connectivity."""
        return self.embedding.topology

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
        return self.embedding.latent_size

    @property
    def body_size(self) -> float:
        """The body size in the data's unit; lengths are normalised by it."""
        return self.card.height

    @property
    def up_axis(self) -> int:
        """0, 1 or 2 for x, y or z."""
        return self.card.up_axis

    @cached_property
    def front(self) -> FloatArray:
        """(3,) unit vector along an axis: where the reference faces, guessed from its shape."""
        return _read_only(front_direction(self.reference, self.up_axis))

    @property
    def near_exclusion(self) -> float:
        """Normalised length along the surface within which pairs of faces are folds of the skin."""
        return self.card.near_exclusion

    @property
    def domain_names(self) -> tuple[str, ...]:
        """K different names."""
        return self.card.domain_names

    @property
    def domain_colours(self) -> tuple[str, ...]:
        """K colours "#rrggbb"."""
        return self.card.domain_colours

    @property
    def domain_order(self) -> tuple[int, ...]:
        """All K domains, indices from 0, in listing order."""
        return self.card.domain_order or tuple(range(len(self.domain_names)))

    @property
    def pose_names(self) -> tuple[str, ...]:
        """N names of the training poses, whose codes are `training_latent`, (N, D)."""
        return self.card.pose_names

    @property
    def metrics(self) -> EmbeddingMetrics | None:
        """What training measured, lengths normalised."""
        return self.embedding.metrics


def _read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    view = array.view()
    view.flags.writeable = False
    return view
