"""A trained model read from one file: the body whose poses are latent codes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.card import ModelCard
from lcollision_core.bodies.code_names import CodeEffect, code_effects
from lcollision_core.bodies.colours import domain_colours
from lcollision_core.bodies.latent_identity import EMBEDDING, fingerprint_of
from lcollision_core.bodies.model_store import find_model
from lcollision_core.bodies.naming import names_from_labels, numbered_names
from lcollision_core.bodies.posable_body import PosableBody, read_only
from lcollision_core.embedding.bilevel import Embedding, LatentFit
from lcollision_core.errors import LCollisionError, ModelFileError
from lcollision_core.files import PoseSet
from lcollision_core.jobs import Job
from lcollision_core.meshes import ContactRules, body_size
from lcollision_core.model_file import (
    Section,
    read_model_file,
    required_array,
    write_model_file,
)
from lcollision_core.options import Draws

if TYPE_CHECKING:
    from lcollision_core.files.scene.appearance import Appearance
    from lcollision_core.labels import Labeller
    from lcollision_core.posing import LatentPoseSpace
    from lcollision_core.predictor import CollisionPredictor, Prediction, PredictorRecord
    from lcollision_core.predictor.pose_module import PoseModule
    from lcollision_core.resolve import PoseResolver

FloatArray = npt.NDArray[np.float64]

_CARD = "model"
_PREDICTOR = "predictor"
_FREE_POSES = "free_poses"
_LARGEST_CODE = 1e6
"""Of a latent pose; what is larger would overflow."""


class PoseModel(PosableBody):
    """A body whose poses are the latent codes of a trained embedding.

    Its unit is that of the data that the model was trained on. Build one with `load` or
    `from_training`.

    Parameters
    ----------
    name : what the model is called
    embedding : its latent space
    card : its units, names and origin
    other_sections : of its file, by name: a predictor, known free poses, and sections unknown to
        this version of the program, which are saved unchanged

    Attributes
    ----------
    embedding : as given

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
        super().__init__(
            name,
            card,
            embedding.topology,
            embedding.topology.gathered(embedding.rest_vertices) * card.height,
            embedding.attention_mask,
            embedding.training_latent.astype(np.float64),
        )
        self.embedding = embedding
        self._other_sections = dict(other_sections or {})

    @cached_property
    def appearance(self) -> Appearance | None:
        """How the body looks in the character's file that it was learned from.

        None where that file is gone, cannot be read, or holds other faces by now.
        """
        from lcollision_core.bodies.source_file import own_source
        from lcollision_core.files import PATCHED_SUFFIXES, read_character

        path = own_source(self)
        if path is None or path.suffix.lower() not in PATCHED_SUFFIXES:
            return None
        try:
            character = read_character(path)
            return character.look() if character.topology == self.topology else None
        except LCollisionError:
            # Nothing but its look depends on the file.
            return None

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
            card = ModelCard.from_metadata(card_section.metadata, embedding.topology.n_faces)
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
            domain_names=names,
            domain_colours=domain_colours(embedding.attention_mask),
            pose_names=pose_set.names,
            source=source or (pose_set.source.name if pose_set.source else "unknown"),
            licence=licence,
            provenance=dict(provenance or {}),
            rules=pose_set.rules,
            groups=pose_set.groups,
            metres=pose_set.metres or 1.0,
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

    @cached_property
    def space(self) -> LatentPoseSpace:
        """The latent poses as dragging and Resolve see them."""
        from lcollision_core.posing import LatentPoseSpace

        return LatentPoseSpace(self.embedding)

    def labeller(self, draws: Draws = Draws.BOX) -> Labeller:
        """Return what draws samples and labels them, by the model's contact rules."""
        from lcollision_core.labels import Labeller

        return Labeller(
            self.embedding, self.body_size, self.rules, self.groups, self.fingerprint, draws
        )

    def predict(self, latent: npt.ArrayLike) -> Prediction:
        """Evaluate the predictor: see `PosableBody.predict`."""
        return self.require_predictor().predict(np.atleast_2d(self._checked(latent)))

    def torch_module(self) -> PoseModule:
        """Return the model as a torch module: codes to vertices, energies and logit.

        Raises
        ------
        ModelFileError : the model has no predictor, or a damaged one.
        """
        from lcollision_core.predictor.pose_module import PoseModule

        return PoseModule(self.embedding, self.require_predictor(), self.card.height)

    @property
    def prediction_needs_torch(self) -> bool:
        """Whether predictions need torch; it loads the predictor."""
        return self.predictor is not None and self.predictor.needs_torch

    def _fit(self, vertices: FloatArray, job: Job, *, in_place: bool) -> LatentFit:
        return self.embedding.encode(vertices, job, in_place=in_place)

    def _decode(self, codes: FloatArray, n_threads: int | None) -> FloatArray:
        return self.embedding.decode(codes, n_threads)

    def turned_upright(self, up_axis: int) -> PoseModel:
        """Return the same model with another axis upwards: 0, 1 or 2 for x, y or z.

        Raises
        ------
        ModelFileError : there is no such axis.
        """
        card = replace(self.card, up_axis=up_axis)
        return PoseModel(self.name, self.embedding, card, self._other_sections)

    def with_rules(self, rules: ContactRules) -> PoseModel:
        """Return the same model with other contact rules: see `PosableBody.with_rules`."""
        if self.has_predictor and rules != self.rules:
            raise ModelFileError(
                "has a predictor, which was trained by the contact rules that it has",
                "train its embedding again with other rules, or keep these",
                where=f"the model {self.name!r}",
            )
        return super().with_rules(rules)

    def with_predictor(self, predictor: CollisionPredictor) -> PoseModel:
        """Return the same model with a predictor, in the place of any that it had."""
        return self._with_section(_PREDICTOR, predictor.to_section())

    def with_free_poses(self, latent: npt.ArrayLike) -> PoseModel:
        """Return the same model with (F, D) poses that were found collision-free, F >= 0."""
        codes = np.asarray(latent, dtype=np.float32).reshape(-1, self.latent_size)
        return self._with_section(_FREE_POSES, Section({"latent": codes}))

    def _with_section(self, name: str, section: Section) -> PoseModel:
        sections = {**self._other_sections, name: section}
        return PoseModel(self.name, self.embedding, self.card, sections)

    @property
    def is_trained(self) -> bool:
        """The latent space was learned."""
        return True

    @property
    def has_predictor(self) -> bool:
        """Whether a predictor was trained; unlike `predictor`, it loads nothing."""
        return _PREDICTOR in self._other_sections

    @property
    def can_resolve(self) -> bool:
        """Whether there is the predictor that Resolve needs."""
        return self.has_predictor

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
            return read_only(np.empty((0, self.latent_size)))
        try:
            codes = required_array(
                section.arrays, "latent", np.float32, (None, self.latent_size), _LARGEST_CODE
            )
        except ValueError as error:
            raise ModelFileError.because(
                "the model's free poses", "are damaged", error, "train the predictor again"
            ) from error
        return read_only(codes.astype(np.float64))

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
    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the latent space: see `PosableBody.fingerprint`."""
        return fingerprint_of(*self.embedding.to_arrays())

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
