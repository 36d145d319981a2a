"""A trained model: a body whose poses are latent codes, stored in one file."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.body import Body, read_only
from lcollision_core.bodies.card import ModelCard
from lcollision_core.bodies.names import (
    CodeEffect,
    code_effects,
    domain_colours,
    names_from_labels,
)
from lcollision_core.bundled import bundled_folder, user_folder
from lcollision_core.embedding.bilevel import BOX_ARRAYS, Embedding, LatentFit
from lcollision_core.errors import LCollisionError, ModelFileError
from lcollision_core.files.formats import MODEL_SUFFIX
from lcollision_core.files.safe import (
    FileStamp,
    file_stamp,
    has_known_suffix,
    locked,
    unused_name,
)
from lcollision_core.jobs import Job
from lcollision_core.meshes import ContactRules, body_size
from lcollision_core.meshes.face_groups import ignored_faces_digest
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.model_file import (
    Section,
    digest_of,
    read_model_file,
    read_section,
    required_array,
    write_model_file,
)
from lcollision_core.options import SampleDistribution

if TYPE_CHECKING:
    from lcollision_core.files import PoseSet
    from lcollision_core.files.scene.appearance import Appearance
    from lcollision_core.labels import Labeller
    from lcollision_core.posing import LatentPoseSpace
    from lcollision_core.predictor import CollisionPredictor, PredictorRecord
    from lcollision_core.predictor.pose_module import PoseModule
    from lcollision_core.resolve import PoseResolver


WORK_SUFFIX = ".work"
"""Suffix of an unfinished model's folder, added to its file's name."""


@dataclass(frozen=True)
class ListedModel:
    """A model that can be loaded by name.

    Attributes
    ----------
    name : its file's name without the extension
    path : its file
    bundled : whether it is part of the program
    """

    name: str
    path: Path
    bundled: bool


def user_models_folder() -> Path:
    """Return the folder of the user's own models, which may not exist yet."""
    return user_folder("models")


def list_models() -> tuple[ListedModel, ...]:
    """List the user's models and the bundled ones that they do not hide, by name."""
    models: dict[str, ListedModel] = {}
    for folder, bundled in ((bundled_folder("models"), True), (user_models_folder(), False)):
        for path in folder.glob(f"*{MODEL_SUFFIX}"):
            if not path.name.startswith("."):
                models[path.stem] = ListedModel(path.stem, path, bundled)
    return tuple(models[name] for name in sorted(models))


def is_bundled(file: str | os.PathLike[str]) -> bool:
    """Whether a model is part of the program or has no file, so that changes go to a copy."""
    path = Path(file)
    return not path.is_file() or path.absolute().parent == bundled_folder("models")


def find_model(name_or_path: str | os.PathLike[str]) -> Path:
    """Return the file of a model.

    Parameters
    ----------
    name_or_path : a file or, if there is none, the name of a bundled or user model

    Raises
    ------
    ModelFileError : it is neither, or its training is unfinished; the message says how to
        continue, or lists the known names.
    """
    path = Path(name_or_path)
    if path.is_file():
        return path
    destination = path
    if len(path.parts) == 1:
        listed = list_models()
        for model in listed:
            if model.name == path.name:
                return model.path
        if not has_known_suffix(path):
            destination = user_models_folder() / f"{path}{MODEL_SUFFIX}"
    beside = (checkpoint_path, work_path) if destination.name else ()
    for unfinished in (of(destination) for of in beside):
        if unfinished.exists():
            raise ModelFileError(
                "is not finished",
                f"run its command again, which goes on from {unfinished}",
                where=f"the training of {str(path)!r}",
            )
    if len(path.parts) == 1 and not path.is_dir():
        names = ", ".join(model.name for model in listed) or "none yet"
        close = get_close_matches(path.name, [model.name for model in listed], 1)
        meant = f" (did you mean {close[0]}?)" if close else ""
        raise ModelFileError(
            f"there is no model or file {path.name!r}{meant}", f"the models are: {names}"
        )
    return path


def checkpoint_path(destination: Path) -> Path:
    """Return the checkpoint file of a training run."""
    return destination.with_name(destination.name + ".checkpoint")


def work_path(destination: Path) -> Path:
    """Return the folder in which a model is learned from files: see `tasks.work_folder`."""
    return destination.with_name(destination.name + WORK_SUFFIX)


def model_destination(name_or_path: str | os.PathLike[str]) -> Path:
    """Return the file for a new model.

    Parameters
    ----------
    name_or_path : a file ending in .safetensors; or a name without folder or known extension, which
        goes to the folder of user models, created if necessary

    Raises
    ------
    ModelFileError : another extension, or the folder cannot be created.
    """
    path = Path(name_or_path)
    if len(path.parts) == 1 and not has_known_suffix(path):
        folder = user_models_folder()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ModelFileError.because(
                folder, "cannot be made", error, "name a file elsewhere"
            ) from error
        return folder / f"{path}{MODEL_SUFFIX}"
    if path.suffix != MODEL_SUFFIX:
        raise ModelFileError.unwritable(
            path,
            f"a model is a {MODEL_SUFFIX} file",
            "rename it, or give a name alone to store it with your models",
        )
    return path


EMBEDDING = "embedding"
"""Name of the latent space's section in a model file."""


def fingerprint_of(arrays: Mapping[str, npt.NDArray[Any]], metadata: Mapping[str, Any]) -> str:
    """Return 16 hexadecimal digits that identify a latent space, independent of its box.

    Parameters
    ----------
    arrays, metadata : of `Embedding.to_arrays`, or of a model file's section
    """
    weights = {name: arrays[name] for name in arrays.keys() - BOX_ARRAYS}
    return digest_of(json.dumps(metadata["scaling"], sort_keys=True), weights)[:16]


def find_latent_space(fingerprint: str, name: str = "") -> ListedModel | None:
    """Find a bundled or user model by its latent space, without loading it entirely.

    Parameters
    ----------
    fingerprint : of the latent space
    name : of the most likely model, which is tried first

    Returns
    -------
    model : None if no listed model has that latent space; unreadable files are skipped
    """
    for model in sorted(list_models(), key=lambda listed: listed.name != name):
        try:
            section = read_section(model.path, EMBEDDING)
        except ModelFileError:
            continue
        if section is None or "scaling" not in section.metadata:
            continue
        if fingerprint_of(section.arrays, section.metadata) == fingerprint:
            return model
    return None


_CARD = "model"
_PREDICTOR = "predictor"
_FREE_POSES = "free_poses"
_LARGEST_CODE = 1e6
"""Largest magnitude of a code; larger ones would overflow."""


class LearnedBody(Body):
    """A body whose poses are the latent codes of a trained embedding.

    Lengths are in the unit of the training data. Build one with `load` or `from_training`.

    Parameters
    ----------
    name : of the model
    embedding : its latent space
    card : its units, names and origin
    other_sections : further sections of its file, by name: a predictor, known free poses, and
        unknown ones, which are saved unchanged

    Raises
    ------
    ModelFileError : the card's number of domains or poses differs from the embedding's.
    """

    no_predictor = (
        "the model {name!r} has no predictor",
        "run `lcollision label` and then `lcollision train predictor`",
    )
    is_trained = True
    embedding: Embedding

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
        self.has_predictor = self.can_resolve = _PREDICTOR in self._other_sections

    @cached_property
    def appearance(self) -> Appearance | None:
        """How the body looks in the character's file that it was learned from.

        None if that file is missing, cannot be read, or has other faces now.
        """
        from lcollision_core.bodies.export import own_source
        from lcollision_core.files import read_character
        from lcollision_core.files.formats import SCENE_SUFFIXES

        path = own_source(self)
        if path is None or path.suffix.lower() not in SCENE_SUFFIXES:
            return None
        try:
            character = read_character(path)
            return character.look() if character.topology == self.topology else None
        except LCollisionError:
            # Only the appearance depends on the file.
            return None

    @classmethod
    def load(cls, name_or_path: str | os.PathLike[str]) -> LearnedBody:
        """Read a model; no code in its file is executed.

        Parameters
        ----------
        name_or_path : a file, or the name of a bundled or user model

        Raises
        ------
        ModelFileError : the model is missing, or its file is damaged, of another program or of a
            later version.
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
            # Detect damage now, not on first use.
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
    ) -> LearnedBody:
        """Make a model from a trained embedding.

        Parameters
        ----------
        name : of the model
        embedding : trained on `pose_set`
        pose_set : source of units, pose names and, if its vertices are labelled, domain names
        source : what the poses are, by default their file's name
        licence : of the model
        provenance : how it was made, JSON values by name
        """
        reference = pose_set.vertices[0]
        up = pose_set.up.axis
        if pose_set.vertex_labels is None:
            names = tuple(f"part {domain + 1}" for domain in range(embedding.n_domains))
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
        """Write the model atomically; equal models give equal bytes.

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
        """The pose space of latent codes, which dragging and Resolve use."""
        from lcollision_core.posing.pose_space import LatentPoseSpace

        return LatentPoseSpace(self.embedding)

    def labeller(self, draws: SampleDistribution = SampleDistribution.BOX) -> Labeller:
        """Return a labeller, which draws samples and labels them by the model's contact rules."""
        from lcollision_core.labels import Labeller

        return Labeller(
            self.embedding, self.body_size, self.rules, self.groups, self.fingerprint, draws
        )

    def torch_module(self) -> PoseModule:
        """Return the model as a torch module: codes to vertices, energies and logit.

        Raises
        ------
        ModelFileError : the model has no predictor, or a damaged one.
        """
        from lcollision_core.predictor.pose_module import PoseModule

        return PoseModule(self.embedding, self.require_predictor(), self.card.height)

    def _fit(self, vertices: FloatArray, job: Job, *, in_place: bool) -> LatentFit:
        return self.embedding.encode(vertices, job, in_place=in_place)

    @property
    def _decoder(self) -> Callable[[FloatArray], FloatArray]:
        _ = self.embedding.codec, self.embedding.decoder
        return partial(self.embedding.decode, n_threads=1)

    def turned_upright(self, up_axis: int) -> LearnedBody:
        """Return the same model with another up axis: 0, 1 or 2 for x, y or z.

        Raises
        ------
        ModelFileError : an invalid axis.
        """
        card = replace(self.card, up_axis=up_axis)
        return LearnedBody(self.name, self.embedding, card, self._other_sections)

    def with_rules(self, rules: ContactRules) -> LearnedBody:
        """Return the same model with other contact rules: see `Body.with_rules`."""
        if self.has_predictor and rules != self.rules:
            raise ModelFileError(
                "has a predictor, which was trained by the contact rules that it has",
                "train its embedding again with other rules, or keep these",
                where=f"the model {self.name!r}",
            )
        if not rules.near_exclusion < 1.0:
            raise ModelFileError("its near_exclusion must be from 0 to below 1", where=self.name)
        return super().with_rules(rules)

    def with_predictor(self, predictor: CollisionPredictor) -> LearnedBody:
        """Return the same model with a predictor, which replaces any other."""
        return self._with_section(_PREDICTOR, predictor.to_section())

    def with_free_poses(self, latent: npt.ArrayLike) -> LearnedBody:
        """Return the same model with (F, D) known collision-free poses, F >= 0."""
        codes = np.asarray(latent, dtype=np.float32).reshape(-1, self.latent_size)
        return self._with_section(_FREE_POSES, Section({"latent": codes}))

    def _with_section(self, name: str, section: Section) -> LearnedBody:
        sections = {**self._other_sections, name: section}
        return LearnedBody(self.name, self.embedding, self.card, sections)

    @cached_property
    def predictor(self) -> CollisionPredictor | None:
        """The collision predictor; None if none was trained.

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
        from lcollision_core.predictor.predictor import PredictorRecord

        return PredictorRecord.of_section(section, self.embedding)

    @cached_property
    def free_latent(self) -> FloatArray:
        """(F, D) collision-free poses found when the predictor was made, read-only.

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
        """16 hexadecimal digits that identify the latent space: see `Body.fingerprint`."""
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


def change_model(
    path: str | os.PathLike[str], change: Callable[[LearnedBody], LearnedBody]
) -> LearnedBody:
    """Read a model, change it and write it back, under a lock.

    Parameters
    ----------
    path : of its file
    change : maps the model in the file to the one to write

    Raises
    ------
    ModelFileError : see `LearnedBody.load` and `LearnedBody.save`; also whatever `change` raises.
    MeshFileError : another command has locked it, see `locked`.
    """
    with locked(path):
        model = change(LearnedBody.load(path))
        model.save(path)
    return model


def save_trained(
    destination: Path,
    before: FileStamp | None,
    model: LearnedBody,
    add: Callable[[LearnedBody], LearnedBody] | None = None,
) -> Path:
    """Write a trained model without losing changes made to its file during the training.

    Parameters
    ----------
    destination : the file to write
    before : its stamp at the start of the training
    model : the trained model
    add : adds the training's results to a model. If the file has changed but still has the same
        body and latent space, they are added to its model, whose names stay.

    Returns
    -------
    path : the written file; another name than `destination` if that has changed otherwise

    Raises
    ------
    ModelFileError : the file cannot be written.
    MeshFileError : another command has locked it, see `locked`.
    """
    with locked(destination):
        path, base = destination, model
        stamp = file_stamp(destination)
        if stamp not in (None, before):
            now = _of_same_space(destination, model) if add is not None else None
            path, base = (destination, now) if now is not None else (unused_name(path), model)
        (base if add is None else add(base)).save(path)
    return path


def _of_same_space(path: Path, model: LearnedBody) -> LearnedBody | None:
    """Return the model in a file if the results trained for `model` fit it."""
    try:
        now = LearnedBody.load(path)
    except ModelFileError:
        return None

    def space(of: LearnedBody) -> tuple[str, ContactRules, str, float]:
        return of.fingerprint, of.rules, ignored_faces_digest(of.rules, of.groups), of.body_size

    return now if space(now) == space(model) else None
