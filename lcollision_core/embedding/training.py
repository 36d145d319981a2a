"""Stage 1: learn the latent space of a pose set, and measure it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.acap.codec import AcapCodec
from lcollision_core.acap.features import component_bridges
from lcollision_core.embedding.bilevel import (
    Decoder,
    Embedding,
    EmbeddingMetrics,
    LatentBox,
    LatentFit,
    feature_pca,
    fit_latent,
    vertex_distances,
)
from lcollision_core.embedding.decoder import build_decoder
from lcollision_core.embedding.seeding import judge_masks
from lcollision_core.embedding.training_run import (
    Checkpoint,
    EmbeddingConfig,
    Run,
)
from lcollision_core.errors import PoseSetError
from lcollision_core.files.pose_set import PoseSet
from lcollision_core.jobs import UNWATCHED, Job, available_cores
from lcollision_core.meshes.alignment import align_rigid
from lcollision_core.meshes.extents import body_size
from lcollision_core.meshes.precision import can_hold
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.model_file import run_key

_JACOBIAN_BYTES = 2_000_000_000
"""Bound on the memory of the Jacobians of poses that are fitted together."""

_RIGID = 6
"""Columns of a Jacobian besides those of the codes."""

_RUN_VERSION = 3
"""Raised when training changes, so that no checkpoint of other code is resumed."""


def train_embedding(
    pose_set: PoseSet,
    config: EmbeddingConfig | None = None,
    *,
    checkpoint: Path | None = None,
    job: Job = UNWATCHED,
    seed: int = 0,
) -> Embedding:
    """Learn the latent space of a pose set.

    Align the poses to the first, moving a distant set to the origin before; compute their features,
    train the bilevel autoencoder on them and fit their codes. Then train a second one without every
    `held_out_stride`-th pose, to compare the error of unseen poses with that of plain principal
    components. A killed run that is started again with the same checkpoint resumes and ends with
    the same bits.

    Parameters
    ----------
    pose_set : at least two poses
    config : how to train, by default `EmbeddingConfig()`
    checkpoint : a file to resume from and to save to; kept when the run ends
    job : reports a `TrainingStatus` after every epoch, and is polled then
    seed : of the order of level 2's batches

    Returns
    -------
    embedding : Embedding

    Raises
    ------
    PoseSetError : fewer than two poses, or fewer vertices than domains.
    LCollisionError : the checkpoint belongs to another run, or is damaged.
    CancelledError : the job was cancelled; the checkpoint holds the last epoch.
    """
    require_several(pose_set)
    trainer = _Trainer(
        pose_set,
        config or EmbeddingConfig(),
        checkpoint,
        job,
        seed,
    )
    return trainer.train()


def require_several(pose_set: PoseSet) -> None:
    """Raise a `PoseSetError` for a single pose, such as one that is left of nearly equal poses."""
    if len(pose_set) < 2:
        raise PoseSetError("one pose isn't enough to learn from", "add poses that differ from it")


class _Trainer:
    """One call of `train_embedding`, with its data prepared."""

    def __init__(
        self,
        pose_set: PoseSet,
        config: EmbeddingConfig,
        checkpoint: Path | None,
        job: Job,
        seed: int,
    ) -> None:
        topology = pose_set.topology
        vertices = np.asarray(pose_set.vertices, dtype=np.float64)
        if not can_hold(vertices[0], topology, np.float32):
            # So far from the origin, float32 would lose the shape.
            vertices = vertices - vertices[0, topology.used_index].mean(axis=0)
        vertices = vertices / body_size(vertices[0], topology)
        key = run_key(
            {"vertices": pose_set.vertices, "faces": pose_set.faces},
            {**asdict(config), "seed": seed, "version": _RUN_VERSION},
        )
        checkpoint_file = Checkpoint(checkpoint, key)
        self._picked = topology.used_index
        alignment = align_rigid(vertices[:, self._picked], vertices[0, self._picked], job)
        weights = np.zeros(topology.n_vertices)
        weights[self._picked] = alignment.weights
        bridges = component_bridges(topology, topology.gathered(vertices[0]))
        self._codec = AcapCodec(topology, vertices[0], weights, bridges)
        self._vertices = np.repeat(self._codec.rest_vertices[None], len(vertices), axis=0)
        self._vertices[:, self._picked] = alignment.vertices
        self._features = self._codec.encode(self._vertices, job=job.part())
        self._config, self._seed = config, seed
        self._everyone = np.arange(len(vertices))
        stride = config.held_out_stride
        self._held_out = self._everyone[stride - 1 :: stride] if stride else self._everyone[:0]
        self._kept = np.setdiff1d(self._everyone, self._held_out)
        if len(self._kept) < 2:
            self._held_out = self._everyone[:0]
        epochs = config.level1_epochs + config.level2_epochs
        n_fits = 0 if config.encoded_codes else len(vertices) + 2 * len(self._held_out)
        total = epochs * (2 if len(self._held_out) else 1) + n_fits
        self._run = Run(checkpoint_file, job, total)

    def train(self) -> Embedding:
        embedding = self._learn("all poses", self._everyone)
        guess, codec = embedding.training_latent, self._codec
        latent, errors = self._fit_codes(
            "all poses",
            "codes",
            embedding.decoder,
            guess,
            embedding.latent_deviation,
            self._everyone,
        )
        level1 = build_decoder(
            (embedding.level1,), embedding.scaling, embedding.mean_features, embedding.topology
        )
        level1_features = level1.features(guess[:, : embedding.n_domains])
        level1_distances = self._distances(codec.decode(level1_features))
        guessed = self._distances(embedding.decode(guess))
        acap = self._distances(codec.decode(self._features))
        masks = judge_masks(embedding.attention_mask, embedding.topology, embedding.rest_vertices)
        metrics = EmbeddingMetrics(
            level1_mean=float(level1_distances.mean()),
            guess_mean=float(guessed.mean()),
            guess_max=float(guessed.max()),
            mean=float(errors[:, 0].mean()),
            max=float(errors[:, 1].max()),
            **self._measure_held_out(),
            acap_mean=float(acap.mean()),
            acap_max=float(acap.max()),
            connected_share=float(masks.connected_share.min()),
            domains_per_vertex=masks.domains_per_vertex,
        )
        box = LatentBox.around(latent)
        return replace(embedding, training_latent=latent, box=box, metrics=metrics)

    def _distances(self, decoded: FloatArray) -> FloatArray:
        """Return the errors of the decoded poses' used vertices, (N, U)."""
        return vertex_distances(decoded[:, self._picked], self._vertices[:, self._picked])

    def _learn(self, model: str, poses: npt.NDArray[np.intp]) -> Embedding:
        # Only training needs torch's networks; a front end that opens a model does not.
        from lcollision_core.embedding.stages import BilevelTrainer

        return BilevelTrainer(
            self._codec,
            self._vertices[poses],
            self._features[poses],
            self._config,
            self._seed,
            model,
            self._run,
        ).train()

    def _fit_codes(
        self,
        model: str,
        part: str,
        decoder: Decoder,
        guess: npt.NDArray[Any],
        deviation: FloatArray,
        poses: npt.NDArray[np.intp],
    ) -> tuple[npt.NDArray[np.float32], FloatArray]:
        """Fit codes to N of the poses; return (N, D) codes, and (N, 2) mean and largest errors.

        With `encoded_codes`, only measure the guess.
        """
        latent = np.array(guess, dtype=np.float32)
        if self._config.encoded_codes:
            decoded = self._codec.decode(decoder.features(latent))[:, self._picked]
            distances = vertex_distances(decoded, self._vertices[poses][:, self._picked])
            return latent, np.stack([distances.mean(axis=1), distances.max(axis=1)], axis=1)
        errors = np.zeros((len(poses), 2))

        def load(arrays: Mapping[str, npt.NDArray[Any]]) -> None:
            latent[:], errors[:] = arrays["latent"], arrays["errors"]

        def save() -> dict[str, npt.NDArray[Any]]:
            return {"latent": latent.copy(), "errors": errors.copy()}

        def fit(index: int) -> LatentFit:
            target = self._vertices[poses[index]]
            return fit_latent(decoder, self._codec, target, latent[index], deviation, n_threads=1)

        steps = self._run.steps(model, "codes", len(poses), load, save, part=part, unit="poses")
        # One pose per thread, so that the bits do not depend on the number of threads.
        pool = ThreadPoolExecutor(self._fit_threads(latent.shape[1]))
        fits: Iterator[LatentFit] | None = None
        try:
            for index in steps:
                if fits is None:
                    fits = pool.map(fit, range(index, len(poses)))
                fitted = next(fits)
                latent[index] = fitted.latent
                errors[index] = fitted.mean_error, fitted.max_error
        finally:
            pool.shutdown(cancel_futures=True)
        return latent, errors

    def _fit_threads(self, n_codes: int) -> int:
        """Return the number of poses to fit at a time, each with its own Jacobian."""
        n_bytes = 8 * 3 * self._codec.topology.n_vertices * (n_codes + _RIGID)
        return max(1, min(available_cores(), _JACOBIAN_BYTES // n_bytes))

    def _measure_held_out(self) -> dict[str, Any]:
        """Train without the held-out poses; measure their errors, and those of plain components."""
        names = ("held_out_mean", "held_out_max", "pca_held_out_mean", "pca_size")
        if len(self._held_out) == 0:
            return dict.fromkeys(names)
        model, unseen = "held out", self._features[self._held_out]
        embedding = self._learn(model, self._kept)
        # `encode` uses deviations of fitted codes; those of the encoders' codes are close.
        deviation = embedding.latent_deviation
        _, errors = self._fit_codes(
            model, "codes", embedding.decoder, embedding.guess(unseen), deviation, self._held_out
        )
        pca, projection, deviation = feature_pca(self._features[self._kept], embedding.latent_size)
        codes = np.tensordot(unseen - pca.offset, projection, axes=2)
        _, plain = self._fit_codes(model, "pca", pca, codes, deviation, self._held_out)
        means = float(errors[:, 0].mean()), float(errors[:, 1].max()), float(plain[:, 0].mean())
        return dict(zip(names, (*means, pca.latent_size), strict=True))
