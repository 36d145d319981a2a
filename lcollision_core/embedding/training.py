"""Stage 1: learn the latent space of a pose set, and measure it.

What was tried, with its figures, is in docs/experiments.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.embedding.autoencoders import (
    build_decoder,
    centre_features,
    run_encoders,
)
from lcollision_core.embedding.bilevel import Embedding
from lcollision_core.embedding.checkpoint import Checkpoint, run_key
from lcollision_core.embedding.config import EmbeddingConfig
from lcollision_core.embedding.fitting import Decoder, fit_latent
from lcollision_core.embedding.latent_box import LatentBox
from lcollision_core.embedding.masks import judge_masks
from lcollision_core.embedding.metrics import EmbeddingMetrics, feature_pca, vertex_distances
from lcollision_core.errors import PoseSetError
from lcollision_core.jobs import CancelToken
from lcollision_core.meshes.alignment import align_rigid
from lcollision_core.meshes.pose_set import PoseSet
from lcollision_core.meshes.precision import can_hold
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.meshes.units import body_size

_RUN_VERSION = 1
"""Goes up when training changes, so that no checkpoint is continued by other rules."""


@dataclass(frozen=True)
class TrainingStatus:
    """How far a training run is.

    Attributes
    ----------
    model : "all poses", or "held out" for the second model that measures how unseen poses fare
    stage : "level 1", "level 2" or "codes"
    stage_done, stage_total : epochs, or poses for "codes"
    done, total : the same over the whole run
    level1_error : mean vertex error with level 1 alone, of a few training poses, normalised
    both_error : mean vertex error with both levels, of the training poses, normalised; None
        before level 2
    """

    model: str
    stage: str
    stage_done: int
    stage_total: int
    done: int
    total: int
    level1_error: float | None
    both_error: float | None


StatusCallback = Callable[[TrainingStatus], None]


def no_status(status: TrainingStatus) -> None:
    """Ignore the progress."""


def train_embedding(
    pose_set: PoseSet,
    config: EmbeddingConfig | None = None,
    *,
    checkpoint: Path | None = None,
    progress: StatusCallback = no_status,
    cancel: CancelToken | None = None,
    seed: int = 0,
) -> Embedding:
    """Learn the latent space of a pose set.

    Moves a set that lies far from the origin to it, aligns the poses to the first, takes their
    features, trains the bilevel autoencoder on all of them, fits their codes, and trains a second
    one without every `held_out_stride`-th pose to measure how unseen poses fare beside plain
    principal components. A killed run that is started again with the same checkpoint goes on where
    it was and ends with the same bits.

    Parameters
    ----------
    pose_set : at least two poses
    config : the choices, by default `EmbeddingConfig()`
    checkpoint : a file to go on from and to save to; kept when the run ends
    progress : called after every epoch
    cancel : polled after every epoch
    seed : of the order of level 2's batches

    Returns
    -------
    embedding : Embedding

    Raises
    ------
    PoseSetError : fewer than two poses, or fewer vertices than domains.
    LCollisionError : the checkpoint belongs to another run, or is damaged.
    CancelledError : `cancel` was set; the checkpoint holds the last epoch.
    """
    if len(pose_set) < 2:
        raise PoseSetError("one pose has nothing to learn from", "a pose set needs at least two")
    run = _Run(
        pose_set,
        config or EmbeddingConfig(),
        checkpoint,
        progress,
        cancel or CancelToken(),
        seed,
    )
    return run.train()


class _Run:
    """One call of `train_embedding`: data prepared, progress counted."""

    def __init__(
        self,
        pose_set: PoseSet,
        config: EmbeddingConfig,
        checkpoint: Path | None,
        progress: StatusCallback,
        cancel: CancelToken,
        seed: int,
    ) -> None:
        vertices = np.asarray(pose_set.vertices, dtype=np.float64)
        if not can_hold(vertices[0], pose_set.topology, np.float32):
            # So far from the origin that what is drawn and learnt in float32 would lose its shape.
            vertices = vertices - vertices[0, pose_set.topology.picked].mean(axis=0)
        vertices = vertices / body_size(vertices[0], pose_set.topology)
        key = run_key(
            {"vertices": pose_set.vertices, "faces": pose_set.faces},
            {**asdict(config), "seed": seed, "version": _RUN_VERSION},
        )
        self._checkpoint = Checkpoint(checkpoint, key)
        self._picked = pose_set.topology.picked
        alignment = align_rigid(vertices[:, self._picked], vertices[0, self._picked], cancel)
        self._alignment_weights = np.zeros(pose_set.topology.n_vertices)
        self._alignment_weights[self._picked] = alignment.weights
        self._codec = AcapCodec(pose_set.topology, vertices[0], self._alignment_weights)
        self._vertices = np.repeat(self._codec.rest_vertices[None], len(vertices), axis=0)
        self._vertices[:, self._picked] = alignment.vertices
        self._features = self._codec.encode(self._vertices)
        self._config, self._cancel, self._seed = config, cancel, seed
        self._progress = progress
        poses = np.arange(len(vertices))
        stride = config.held_out_stride
        self._held_out = poses[stride - 1 :: stride] if stride else poses[:0]
        self._kept = np.setdiff1d(poses, self._held_out)
        if len(self._held_out) == 0 or len(self._kept) < 2:
            self._held_out = poses[:0]
        epochs = config.level1_epochs + config.level2_epochs
        self._total = epochs + len(poses)
        if len(self._held_out):
            self._total += epochs + 2 * len(self._held_out)
        self._before = 0
        self._errors: tuple[float | None, float | None] = (None, None)

    def train(self) -> Embedding:
        everyone = np.arange(len(self._vertices))
        embedding = self._learn("all poses", everyone)
        guess = embedding.training_latent
        fitted = self._fit_codes(
            "all poses", "codes", embedding.decoder, guess, embedding.latent_deviation, everyone
        )
        embedding = replace(
            embedding, training_latent=fitted.latent, box=LatentBox.around(fitted.latent)
        )
        level1 = build_decoder(
            (embedding.level1,), embedding.scaling, embedding.mean_features, embedding.topology
        )
        level1_features = level1.features(guess[:, : embedding.n_domains])
        level1_distances = self._distances(self._codec.decode(level1_features))
        guessed = self._distances(embedding.decode(guess))
        acap = self._distances(self._codec.decode(self._features))
        masks = judge_masks(embedding.attention_mask, embedding.topology, embedding.rest_vertices)
        held_out = self._measure_held_out()
        metrics = EmbeddingMetrics(
            level1_mean=float(level1_distances.mean()),
            guess_mean=float(guessed.mean()),
            guess_max=float(guessed.max()),
            mean=float(fitted.mean_error.mean()),
            max=float(fitted.max_error.max()),
            held_out_mean=held_out.mean,
            held_out_max=held_out.max,
            pca_held_out_mean=held_out.pca_mean,
            pca_size=held_out.pca_size,
            acap_mean=float(acap.mean()),
            acap_max=float(acap.max()),
            connected_share=float(masks.connected_share.min()),
            domains_per_vertex=masks.domains_per_vertex,
        )
        return replace(embedding, metrics=metrics)

    def _distances(self, decoded: FloatArray) -> FloatArray:
        """Return how far the decoded poses' used vertices lie from the poses', (N, U)."""
        return vertex_distances(decoded[:, self._picked], self._vertices[:, self._picked])

    def _learn(self, model: str, poses: npt.NDArray[np.intp]) -> Embedding:
        """Train on some poses; the embedding's codes are still the encoders' own."""
        # Only training needs torch's networks; a front end that opens a model does not.
        from lcollision_core.embedding.stages import BilevelTrainer

        def report(
            stage: str, done: int, total: int, level1: float | None, both: float | None
        ) -> None:
            self._errors = (level1, both)
            # Level 2 counts on from level 1, whether or not that ran in this process.
            earlier = self._config.level1_epochs if stage == "level 2" else 0
            self._report(model, stage, done, total, earlier + done)

        trainer = BilevelTrainer(
            self._codec,
            self._vertices[poses],
            self._features[poses],
            self._config,
            self._seed,
            model,
            self._checkpoint,
            report,
            self._cancel,
        )
        learnt = trainer.train()
        self._before += self._config.level1_epochs + self._config.level2_epochs
        centred = centre_features(self._features[poses], learnt.scaling, learnt.mean_features)
        latent = run_encoders(
            centred, learnt.level1, learnt.level2, learnt.attention_mask, self._codec.topology
        )
        return Embedding(
            topology=self._codec.topology,
            rest_vertices=self._codec.rest_vertices,
            alignment_weights=self._alignment_weights,
            scaling=learnt.scaling,
            mean_features=learnt.mean_features,
            level1=learnt.level1,
            level2=learnt.level2,
            attention_mask=learnt.attention_mask,
            training_latent=latent,
            box=LatentBox.around(latent),
            metrics=None,
            config=asdict(self._config),
            seed=self._seed,
        )

    def _fit_codes(
        self,
        model: str,
        part: str,
        decoder: Decoder,
        guess: npt.NDArray[Any],
        deviation: FloatArray,
        poses: npt.NDArray[np.intp],
    ) -> _FittedCodes:
        """Fit codes to some of the poses, going on from the checkpoint."""
        name = f"{model}/{part}"
        latent = np.array(guess, dtype=np.float32)
        errors = np.zeros((len(poses), 2))
        stored = self._checkpoint.get(name)
        done = 0
        if stored is not None:
            done = int(stored.metadata["poses"])
            latent, errors = np.array(stored.arrays["latent"]), np.array(stored.arrays["errors"])
        for index in range(done, len(poses)):
            one = slice(index, index + 1)
            fit = fit_latent(
                decoder, self._codec, self._vertices[poses[one]], latent[one], deviation
            )
            latent[one] = fit.latent
            errors[index] = fit.mean_error[0], fit.max_error[0]
            self._report(model, "codes", index + 1, len(poses), index + 1)
            last = index + 1 == len(poses)
            self._checkpoint.put(
                name,
                {"latent": latent.copy(), "errors": errors.copy()},
                {"poses": index + 1},
                now=last or self._cancel.cancelled,
            )
            self._cancel.raise_if_cancelled()
        self._before += len(poses)
        return _FittedCodes(latent, errors[:, 0], errors[:, 1])

    def _measure_held_out(self) -> _HeldOut:
        """Train without the held-out poses and fit those, and plain components of the same."""
        if len(self._held_out) == 0:
            return _HeldOut(None, None, None, None)
        model = "held out"
        embedding = self._learn(model, self._kept)
        # Deviations as `encode` has them need fitted codes; the encoders' own are close.
        fitted = self._fit_codes(
            model,
            "codes",
            embedding.decoder,
            embedding.guess(self._features[self._held_out]),
            embedding.latent_deviation,
            self._held_out,
        )
        pca, projection, deviation = feature_pca(self._features[self._kept], embedding.latent_size)
        codes = np.tensordot(self._features[self._held_out] - pca.offset, projection, axes=2)
        plain = self._fit_codes(model, "pca", pca, codes, deviation, self._held_out)
        return _HeldOut(
            float(fitted.mean_error.mean()),
            float(fitted.max_error.max()),
            float(plain.mean_error.mean()),
            pca.latent_size,
        )

    def _report(self, model: str, stage: str, done: int, total: int, in_model: int) -> None:
        level1, both = self._errors
        self._progress(
            TrainingStatus(
                model, stage, done, total, self._before + in_model, self._total, level1, both
            )
        )


@dataclass(frozen=True)
class _FittedCodes:
    latent: npt.NDArray[np.float32]
    mean_error: FloatArray
    max_error: FloatArray


@dataclass(frozen=True)
class _HeldOut:
    mean: float | None
    max: float | None
    pca_mean: float | None
    pca_size: int | None
