"""Stage 2: learn to predict collisions from labelled samples of the latent box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lcollision_core.embedding import Embedding
from lcollision_core.errors import LabelStoreError
from lcollision_core.jobs import CancelToken, no_progress
from lcollision_core.labels import LabelRows, StoreIdentity, is_of_box
from lcollision_core.meshes import FaceGroup
from lcollision_core.options.labels import Draws
from lcollision_core.predictor.config import PRESETS, PredictorConfig
from lcollision_core.predictor.evaluation import score_rows
from lcollision_core.predictor.metrics import mean_difference
from lcollision_core.predictor.predictor import (
    CollisionPredictor,
    TrainingFacts,
    require_model,
)
from lcollision_core.predictor.training.operating_point import balanced_logit
from lcollision_core.predictor.training.row_split import split_rows
from lcollision_core.predictor.training.status import StatusCallback


def train_predictor(
    rows: LabelRows,
    embedding: Embedding,
    config: PredictorConfig | None = None,
    *,
    store: StoreIdentity | None = None,
    groups: Sequence[FaceGroup] = (),
    device: str = "auto",
    checkpoint: Path | None = None,
    progress: StatusCallback = no_progress,
    cancel: CancelToken | None = None,
    seed: int = 0,
) -> CollisionPredictor:
    """Train a predictor on labelled samples and measure it on those held out.

    Rows that `measures` holds out never train. A killed run that is started again with the same
    checkpoint goes on where it was and ends with the same bits, on one machine with one number of
    threads. Under torchrun every process calls this with the same arguments: they share the
    labelling of patches and each batch, and all return the same predictor.

    Parameters
    ----------
    rows : samples 0, 1, 2, ... of a store; at least one free and one colliding one to train on.
        Where something is chosen, some of them only do that, see `split_rows`.
    embedding : of the model that the rows label
    config : the choices, by default the preset "default"
    store : what the rows label, and by which contact rules; kept with the predictor
    groups : of faces, of which these rules may ignore pairs
    device : "cpu", "cuda", or "auto" for CUDA where there is one
    checkpoint : a file to go on from and to save to; kept when the run ends
    progress : called every few steps and after every epoch
    cancel : polled after every step
    seed : of the initial weights and of the order

    Returns
    -------
    predictor : CollisionPredictor, on the CPU, with its metrics

    Raises
    ------
    ShapeError : the rows are of another latent space, or not finite.
    LabelStoreError : all rows collide, or none does, or none is held out.
    LCollisionError : the checkpoint belongs to another run or is damaged, the training diverges,
        or there is no such device.
    CancelledError : `cancel` was set; the checkpoint holds the last step, or the file beside it,
        see `patches_path`, what was labelled up to the last twentieth.
    """
    # Here, so that reading a predictor's types loads no torch.
    from lcollision_core.predictor.training.loop import TrainingLoop

    config = PRESETS["default"] if config is None else config
    require_model(rows, embedding)
    draws = Draws.BOX if store is None else store.draws
    split = split_rows(len(rows), config, draws)
    energy = rows.energy[split.training]
    colliding = rows.colliding[split.training]
    n_training, n_colliding = len(colliding), int(colliding.sum())
    if not 0 < n_colliding < n_training or not len(split.held_out):
        raise LabelStoreError(
            f"{n_colliding} of the {n_training} rows to train on collide and {len(split.held_out)} "
            "are held out",
            "training needs some of each: label more samples",
        )
    scale = float(energy[colliding].mean())
    if not scale > 0.0:
        raise LabelStoreError("no colliding row has any depth to learn", "label more samples")
    facts = TrainingFacts(
        rows=len(rows),
        training_rows=n_training,
        colliding_share=float(rows.colliding[is_of_box(np.arange(len(rows)), draws)].mean()),
        seed=seed,
        energy_scale=scale,
        margin=mean_difference(energy) / scale,
        store=store,
    )
    loop = TrainingLoop(
        rows,
        split,
        embedding,
        config,
        facts,
        device,
        checkpoint,
        progress,
        cancel or CancelToken(),
        groups,
    )
    state = loop.run().state_dict()
    arrays = {name: values.detach().cpu().numpy() for name, values in state.items()}
    predictor = CollisionPredictor(embedding, arrays, config, facts)
    if config.balanced and len(split.validation):
        chosen_by = rows.taken(split.validation)
        logit = predictor.scaled_outputs(chosen_by.latent)[1]
        limit = balanced_logit(logit, chosen_by.colliding)
        if limit != 0.0:
            predictor = replace(predictor, facts=replace(facts, logit_shift=-limit))
    return replace(predictor, metrics=score_rows(predictor, rows.taken(split.held_out)).metrics())
