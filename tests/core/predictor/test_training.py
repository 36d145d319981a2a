"""Stage 2: learning, reproducibility and resuming."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from torch.nn.modules.module import register_module_forward_pre_hook

from lcollision_core.bodies import LearnedBody
from lcollision_core.embedding import Embedding
from lcollision_core.errors import CancelledError, LabelStoreError, LCollisionError, ShapeError
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.labels import LabelRows, is_held_out
from lcollision_core.model_file import read_model_file
from lcollision_core.predictor import (
    PRESETS,
    Loss,
    PredictorConfig,
    PredictorStatus,
    train_predictor,
)
from lcollision_core.predictor import training_loop as loop
from lcollision_core.predictor.config import has_begun, patches_path, split_rows
from lcollision_core.predictor.network_base import PredictorNetwork
from lcollision_core.predictor.predictor import BATCH_ROWS
from lcollision_core.predictor.training_loop import PatchLabeller, rate_at
from tests.core.killed import after_checkpoint
from tests.core.labelled import labeller_of
from tests.core.predictor_rows import PAPER, colliding_latent, config, made_up_rows, weights_of

SECONDS_TO_WAIT = 600.0

TRAIN = """
import pickle, sys
from pathlib import Path
from lcollision_core.predictor import train_predictor
with open(sys.argv[1], "rb") as file:
    rows, embedding, config, checkpoint = pickle.load(file)
predictor = train_predictor(rows, embedding, config, checkpoint=checkpoint, device="cpu")
section = predictor.to_section()
if "rank" in sys.argv:
    import os
    sys.argv[2] += os.environ["RANK"]
Path(sys.argv[2]).write_bytes(pickle.dumps((dict(section.arrays), predictor.metrics)))
"""


@pytest.fixture(scope="module")
def rows(tube_model: LearnedBody) -> LabelRows:
    return made_up_rows(tube_model.embedding)


@pytest.mark.parametrize(
    "preset",
    # The next test covers the default preset's real training.
    [pytest.param(name, marks=() if name == "paper" else pytest.mark.slow) for name in PRESETS],
)
def test_both_presets_learn_what_collides_and_how_deep(
    tube_model: LearnedBody, rows: LabelRows, preset: str
) -> None:
    chosen = replace(PRESETS[preset], batch_rows=32, epochs=12)
    metrics = train_predictor(rows, tube_model.embedding, chosen).metrics
    assert metrics is not None
    assert metrics.samples == 450
    assert 0.6 < metrics.majority_rate < 0.72
    assert metrics.accuracy > metrics.majority_rate + 0.15
    assert metrics.spearman is not None
    assert metrics.spearman > 0.8
    assert metrics.energy_mse is not None
    assert metrics.energy_mse < 0.1


@pytest.mark.slow
def test_the_default_preset_learns_real_collisions(tube_model: LearnedBody) -> None:
    """Patches, folds and labels are of the same mesh, as in real use."""
    latent = colliding_latent(tube_model, 2000)
    rows = labeller_of(tube_model).label(latent)
    chosen = replace(PRESETS["default"], batch_rows=64)
    metrics = train_predictor(rows, tube_model.embedding, chosen).metrics
    assert metrics is not None
    assert metrics.accuracy > metrics.majority_rate + 0.1


def test_domains_get_their_own_energy(tube_model: LearnedBody, rows: LabelRows) -> None:
    trained = train_predictor(rows, tube_model.embedding, config(epochs=6))
    deep = is_held_out(np.arange(len(rows))) & (rows.latent[:, 0] > 0.6)
    predicted = trained.predict(rows.latent[deep]).domain_energy
    right = predicted.argmax(axis=1) == rows.domain_energy[deep].argmax(axis=1)
    assert len(right) > 50
    assert right.mean() > 0.9
    ratio = predicted.sum() / rows.domain_energy[deep].sum()
    assert 0.8 < ratio < 1.2


def test_equal_seeds_give_equal_bits_and_held_out_rows_teach_nothing(
    tube_model: LearnedBody, rows: LabelRows
) -> None:
    held_out = is_held_out(np.arange(len(rows)))
    tampered = replace(
        rows,
        latent=np.where(held_out[:, None], np.float32(0.1), rows.latent),
        n_pairs=np.where(held_out, 1 - rows.n_pairs, rows.n_pairs).astype(np.int32),
        energy=np.where(held_out, 1.0, rows.energy),
    )
    embedding, chosen = tube_model.embedding, config(epochs=1)
    first, again, unseen, other = (
        weights_of(train_predictor(data, embedding, chosen, seed=seed).to_section().arrays)
        for data, seed in ((rows, 4), (rows, 4), (tampered, 4), (rows, 5))
    )
    assert first == again == unseen
    assert first != other


def test_every_row_of_table_1_trains(tube_model: LearnedBody, rows: LabelRows) -> None:
    scores = {}
    for loss in get_args(Loss):
        trained = train_predictor(rows, tube_model.embedding, config(epochs=1).with_loss(loss))
        metrics = trained.metrics
        assert metrics is not None
        assert metrics.accuracy > metrics.majority_rate - 0.1
        scores[loss] = (metrics.energy_mse is not None, metrics.ranking_margin is not None)
    assert scores == {
        "full": (True, True),
        "no-rank": (True, True),
        "no-depth": (False, True),
        "entropy": (False, False),
    }
    chosen = config(epochs=4, by_domain=False)
    undivided = train_predictor(rows, tube_model.embedding, chosen)
    assert undivided.metrics is not None
    assert undivided.metrics.accuracy > undivided.metrics.majority_rate + 0.1
    energy = undivided.predict(rows.latent[:9]).domain_energy
    np.testing.assert_array_equal(energy[:, 0], energy[:, 1])


@pytest.mark.parametrize("loss", get_args(Loss)[1:])
def test_only_the_paper_s_losses_can_be_left_out(loss: Loss) -> None:
    with pytest.raises(LCollisionError, match=f"the loss {loss}; add --preset paper"):
        PRESETS["default"].with_loss(loss)
    assert PRESETS["default"].with_loss("full") == PRESETS["default"]


def test_a_configuration_names_the_parts_left_out_of_its_preset() -> None:
    assert PRESETS["default"].described == "default"
    assert PRESETS["paper"].with_loss("no-rank").described == "paper without the ranking loss"
    baseline = replace(PRESETS["paper"], by_domain=False).with_loss("entropy")
    assert baseline.described == "paper without domains, the depth loss, the ranking loss"


def test_many_rows_are_watched_a_few_at_a_time(tube_model: LearnedBody) -> None:
    sizes: list[int] = []
    hook = register_module_forward_pre_hook(
        lambda module, given: sizes.append(len(given[0])) if module.training is False else None
    )
    try:
        many = made_up_rows(tube_model.embedding, 3 * BATCH_ROWS + 500)
        seen: list[PredictorStatus] = []
        train_predictor(many, tube_model.embedding, config(epochs=1), job=Job(seen.append))
    finally:
        hook.remove()
    assert None not in seen[-1].held_out_errors
    assert max(sizes) == BATCH_ROWS


def test_progress_ends_at_the_last_step(tube_model: LearnedBody, rows: LabelRows) -> None:
    seen: list[PredictorStatus] = []
    train_predictor(rows, tube_model.embedding, config(epochs=2), job=Job(seen.append))
    # 1050 rows in batches of 64 give 17 steps per epoch.
    assert (seen[0].done, seen[0].total, seen[0].loss) == (0, 34, None)
    assert (seen[-1].done, seen[-1].epoch, seen[-1].epochs) == (34, 2, 2)
    assert [status.done for status in seen] == sorted(status.done for status in seen)
    assert seen[-1].loss is not None
    assert all(rate is not None and 0.0 <= rate <= 1.0 for rate in seen[-1].held_out_errors)
    assert seen[0].held_out_errors == (None, None)


def _stop_training(
    rows: LabelRows,
    embedding: Embedding,
    chosen: PredictorConfig,
    checkpoint: Path,
    is_time: Callable[[PredictorStatus], bool],
) -> None:
    """Train with a checkpoint, and cancel at the first status that fulfils a condition."""
    job = Job()

    def stop(status: PredictorStatus) -> None:
        if is_time(status):
            job.cancel()

    with pytest.raises(CancelledError):
        train_predictor(rows, embedding, chosen, checkpoint=checkpoint, job=job.part(stop))


@pytest.mark.slow
def test_a_cancelled_run_goes_on_to_the_same_bits(
    tube_model: LearnedBody, rows: LabelRows, tmp_path: Path
) -> None:
    embedding, checkpoint = tube_model.embedding, tmp_path / "checkpoint"
    steps: list[int] = []

    def in_the_second_epoch(status: PredictorStatus) -> bool:
        steps.append(status.done)
        return status.done >= 17

    _stop_training(rows, embedding, config(), checkpoint, in_the_second_epoch)
    later: list[PredictorStatus] = []
    resumed = train_predictor(
        rows, embedding, config(), checkpoint=checkpoint, job=Job(later.append)
    )
    assert later[0].done == steps[-1] + 1
    whole = train_predictor(rows, embedding, config())
    assert weights_of(resumed.to_section().arrays) == weights_of(whole.to_section().arrays)
    assert resumed.metrics == whole.metrics
    with pytest.raises(LCollisionError, match="checkpoint of another training run"):
        train_predictor(rows, embedding, config(), checkpoint=checkpoint, seed=9)


def test_a_run_that_stopped_after_an_epoch_shows_the_loss_of_the_next_alone(
    tube_model: LearnedBody, rows: LabelRows, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "_SECONDS_BETWEEN_REPORTS", -1.0)
    embedding, checkpoint = tube_model.embedding, tmp_path / "checkpoint"
    # A cancel after step 16 takes effect after step 17, the last of the first epoch.
    _stop_training(rows, embedding, config(epochs=2), checkpoint, lambda status: status.done == 16)
    resumed, whole = list[PredictorStatus](), list[PredictorStatus]()
    for path, seen in ((checkpoint, resumed), (None, whole)):
        train_predictor(rows, embedding, config(epochs=2), checkpoint=path, job=Job(seen.append))
    assert resumed[0].done == 17
    assert [one.loss for one in resumed[1:]] == [one.loss for one in whole if one.done > 17]


@pytest.mark.slow
def test_patches_are_not_labelled_again(
    tube_model: LearnedBody, rows: LabelRows, tmp_path: Path
) -> None:
    embedding, checkpoint = tube_model.embedding, tmp_path / "checkpoint"
    chosen = replace(PRESETS["default"], epochs=1, batch_rows=256)
    _stop_training(rows, embedding, chosen, checkpoint, lambda status: status.preparing is None)
    patches = tmp_path / "checkpoint.patches"
    assert patches.exists()
    seen: list[PredictorStatus] = []
    resumed, whole = (
        train_predictor(rows, embedding, chosen, checkpoint=path, job=job)
        for path, job in ((checkpoint, Job(seen.append)), (None, UNWATCHED))
    )
    assert all(status.preparing is None for status in seen)
    assert not patches.exists()
    assert weights_of(resumed.to_section().arrays) == weights_of(whole.to_section().arrays)


@pytest.mark.slow
def test_labelling_patches_goes_on_where_it_was_stopped(
    tube_model: LearnedBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "_LEAST_PATCHES_KEPT", 100)
    embedding, checkpoint = tube_model.embedding, tmp_path / "checkpoint"
    rows = labeller_of(tube_model).label(colliding_latent(tube_model, 600))
    chosen = replace(PRESETS["default"], epochs=1, batch_rows=64)
    _stop_training(
        rows, embedding, chosen, checkpoint, lambda status: (status.preparing or 0.0) > 0.5
    )
    assert has_begun(checkpoint)
    assert not checkpoint.exists()
    n_known = len(read_model_file(patches_path(checkpoint))["patches"].arrays["root"])
    assert n_known in (200, 300)

    labelled: list[int] = []
    roots = PatchLabeller.roots

    def noted(labeller: PatchLabeller, index: np.ndarray, *others: Any) -> np.ndarray:
        labelled.extend(index)
        return roots(labeller, index, *others)

    monkeypatch.setattr(PatchLabeller, "roots", noted)
    seen: list[PredictorStatus] = []
    resumed = train_predictor(rows, embedding, chosen, checkpoint=checkpoint, job=Job(seen.append))
    training = split_rows(len(rows), chosen).training
    np.testing.assert_array_equal(labelled, training[n_known:])
    assert seen[0].preparing is not None
    assert seen[0].preparing > n_known / len(training)
    whole = train_predictor(rows, embedding, chosen)
    assert weights_of(resumed.to_section().arrays) == weights_of(whole.to_section().arrays)


PATCHES = """
from lcollision_core.predictor import training_loop as loop
loop._LEAST_PATCHES_KEPT = 100
labelled, roots = [], loop.PatchLabeller.roots
def noted(labeller, index, *others):
    labelled.append(index)
    return roots(labeller, index, *others)
loop.PatchLabeller.roots = noted
class Batches(loop._Batches):
    def __init__(self, *given):
        import os, pickle, sys
        from pathlib import Path
        rank = os.environ["RANK"]
        Path(sys.argv[2] + "patches" + rank).write_bytes(pickle.dumps((labelled, given[-1])))
        super().__init__(*given)
loop._Batches = Batches
"""


@pytest.mark.slow
def test_two_processes_share_the_labelling_of_patches(
    tube_model: LearnedBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    embedding = tube_model.embedding
    rows = labeller_of(tube_model).label(colliding_latent(tube_model, 600))
    chosen = replace(PRESETS["default"], epochs=1, batch_rows=64)
    _train_in_two(tmp_path, PATCHES, rows, embedding, chosen, tmp_path / "checkpoint")
    labelled, roots = zip(
        *(pickle.loads((tmp_path / f"sharedpatches{rank}").read_bytes()) for rank in (0, 1)),
        strict=True,
    )
    training = split_rows(len(rows), chosen).training
    each = [np.concatenate(parts) for parts in labelled]
    np.testing.assert_array_equal(np.sort(np.concatenate(each)), training)
    assert abs(len(each[0]) - len(each[1])) <= 10

    alone: list[np.ndarray] = []

    class Batches(loop._Batches):
        def __init__(self, *given: Any) -> None:
            alone.append(given[-1])
            super().__init__(*given)

    monkeypatch.setattr(loop, "_Batches", Batches)
    train_predictor(rows, embedding, chosen)
    assert alone[0].any()
    for shared in roots:
        np.testing.assert_array_equal(shared, alone[0])


def _written(path: Path, *parts: object) -> Path:
    path.write_bytes(pickle.dumps(parts))
    return path


def test_the_mean_of_the_weights_is_kept(tube_model: LearnedBody, rows: LabelRows) -> None:
    """The mean over every tenth step: uniform at first, then exponential."""
    chosen = config(epochs=1, batch_rows=16, average_passes=0.5)
    n_steps = -(-len(split_rows(len(rows), chosen).training) // 16)
    seen: list[dict[str, np.ndarray]] = []

    def look(module: torch.nn.Module, given: object) -> None:  # noqa: ARG001
        if module.training and isinstance(module, PredictorNetwork):
            # Before a step, the weights are those after the previous step.
            seen.append({name: part.numpy().copy() for name, part in module.state_dict().items()})

    hook = register_module_forward_pre_hook(look)
    try:
        averaged = train_predictor(rows, tube_model.embedding, chosen)
    finally:
        hook.remove()
    assert len(seen) == n_steps > 60
    share = 10 / (0.5 * n_steps)
    assert 1 / 4 < share < 1 / 2
    mean = seen[10]
    for count, step in enumerate(range(20, n_steps, 10), start=2):
        weight = max(share, 1 / count)
        mean = {name: (1 - weight) * mean[name] + weight * seen[step][name] for name in mean}
    arrays = averaged.to_section().arrays
    for name, values in mean.items():
        np.testing.assert_allclose(arrays[name], values, rtol=1e-4, atol=1e-6)
    last = train_predictor(rows, tube_model.embedding, replace(chosen, average_passes=0.0))
    assert weights_of(last.to_section().arrays) != weights_of(arrays)


def test_a_few_steps_are_in_the_mean_of_the_weights(
    tube_model: LearnedBody, rows: LabelRows
) -> None:
    chosen = config(epochs=1, batch_rows=256)
    last = train_predictor(rows, tube_model.embedding, chosen)
    averaged = train_predictor(rows, tube_model.embedding, replace(chosen, average_passes=1.0))
    assert weights_of(averaged.to_section().arrays) == weights_of(last.to_section().arrays)


def test_a_stopped_run_remembers_its_mean_weights(
    tube_model: LearnedBody, rows: LabelRows, tmp_path: Path
) -> None:
    embedding, chosen = tube_model.embedding, config(epochs=3, average_passes=1.0)
    checkpoint = tmp_path / "checkpoint"
    _stop_training(rows, embedding, chosen, checkpoint, lambda status: status.epoch == 2)
    resumed, whole = (
        train_predictor(rows, embedding, chosen, checkpoint=path) for path in (checkpoint, None)
    )
    assert weights_of(resumed.to_section().arrays) == weights_of(whole.to_section().arrays)


def test_running_means_never_leave_the_normal_form_of_numbers() -> None:
    """For a weight that has a gradient only in the first step."""
    weight = torch.nn.Parameter(torch.linspace(-1.0, 1.0, 1000))
    optimiser = torch.optim.Adam([weight], lr=1e-3, fused=True)
    smallest = torch.finfo(torch.float32).tiny
    for step in range(1, 1200):
        weight.grad = weight.detach().clone() if step == 1 else torch.zeros_like(weight)
        optimiser.step()
        if step % loop._STEPS_BETWEEN_CLEARINGS == 0:
            loop._clear_tiny_moments(optimiser)
        mean = optimiser.state[weight]["exp_avg"].abs()
        assert not ((mean > 0.0) & (mean < smallest)).any()
        assert step > 50 or mean.max() > 0.0
    assert mean.max() == 0.0


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_bits(
    tube_model: LearnedBody, rows: LabelRows, tmp_path: Path
) -> None:
    embedding, chosen = tube_model.embedding, config(epochs=12)
    checkpoint = tmp_path / "checkpoint"
    job = _written(tmp_path / "job", rows, embedding, chosen, checkpoint)
    threads = f"import torch; torch.set_num_threads({torch.get_num_threads()})\n"
    code = threads + after_checkpoint(30) + TRAIN
    command = [sys.executable, "-c", code, job, tmp_path / "killed"]
    process = subprocess.run(command, timeout=SECONDS_TO_WAIT, check=False)
    assert process.returncode == -signal.SIGKILL
    seen: list[PredictorStatus] = []
    resumed, whole = (
        train_predictor(rows, embedding, chosen, checkpoint=path, job=Job(seen.append))
        for path in (checkpoint, None)
    )
    assert seen[0].done == 30 < seen[0].total
    assert weights_of(resumed.to_section().arrays) == weights_of(whole.to_section().arrays)
    assert resumed.metrics == whole.metrics


def _train_in_two(folder: Path, before: str, *job: object) -> None:
    """Train in two processes; each writes its result to a file "shared" plus its rank."""
    script = folder / "train.py"
    script.write_text(before + TRAIN)
    subprocess.run(
        [
            *(sys.executable, "-m", "torch.distributed.run", "--standalone"),
            *("--nproc-per-node", "2", script, _written(folder / "job", *job)),
            *(folder / "shared", "rank"),
        ],
        check=True,
        timeout=SECONDS_TO_WAIT,
        capture_output=True,
    )


@pytest.mark.slow
def test_two_processes_learn_what_one_does(
    tube_model: LearnedBody, rows: LabelRows, tmp_path: Path
) -> None:
    # One epoch, as other orders of summation diverge with every step. Of the 1026 training rows,
    # the last batch has 2: the second process gets none of them.
    embedding, chosen, some = tube_model.embedding, config(epochs=1), rows.taken(slice(1464))
    _train_in_two(tmp_path, "", some, embedding, chosen, tmp_path / "checkpoint")
    first, second = (pickle.loads((tmp_path / f"shared{rank}").read_bytes()) for rank in (0, 1))
    assert weights_of(first[0]) == weights_of(second[0])
    alone = train_predictor(some, embedding, chosen)
    arrays = alone.to_section().arrays
    untrained = train_predictor(some, embedding, replace(chosen, rate=1e-12)).to_section().arrays
    moved = np.concatenate([(arrays[name] - untrained[name]).ravel() for name in arrays])
    differs = np.concatenate([(arrays[name] - first[0][name]).ravel() for name in arrays])
    assert np.linalg.norm(differs) < 0.02 * np.linalg.norm(moved)
    assert alone.metrics is not None
    assert first[1].accuracy == pytest.approx(alone.metrics.accuracy, abs=0.01)


def test_rows_that_cannot_teach_are_refused(tube_model: LearnedBody, rows: LabelRows) -> None:
    embedding = tube_model.embedding
    energy, latent = rows.energy.copy(), rows.latent.copy()
    energy[11], latent[17, 2] = np.nan, np.inf
    for broken, row in ((replace(rows, energy=energy), 11), (replace(rows, latent=latent), 17)):
        with pytest.raises(ShapeError, match=rf"row {row} \(from 0\) contains NaN or inf"):
            train_predictor(broken, embedding, config())
    foreign = replace(rows, latent=rows.latent[:, :-1])
    size = embedding.latent_size
    with pytest.raises(ShapeError, match=f"have {size - 1} codes .* the model has {size}"):
        train_predictor(foreign, embedding, config())
    none = replace(rows, n_pairs=0 * rows.n_pairs)
    with pytest.raises(LabelStoreError, match="0 of 1050 training rows collide"):
        train_predictor(none, embedding, config())
    with pytest.raises(LabelStoreError, match="0 rows are held out"):
        train_predictor(rows.taken(slice(6)), embedding, config())
    with pytest.raises(LCollisionError, match="unknown device 'abacus'"):
        train_predictor(rows, embedding, PAPER, device="abacus")


def test_a_diverging_run_says_so(tube_model: LearnedBody, rows: LabelRows) -> None:
    with pytest.raises(LCollisionError, match="diverged in step"):
        train_predictor(rows, tube_model.embedding, config(rate=1e30))


def test_the_one_cycle_schedule_rises_and_falls_to_nothing() -> None:
    chosen = config(schedule="one-cycle", rate=0.5)
    rates = [rate_at(step, 100, chosen) for step in range(100)]
    assert max(rates) == rates[20] == 0.5
    assert rates[0] < 0.01
    assert rates[-1] < 0.001
    assert (np.diff(rates[:21]) > 0).all()
    assert (np.diff(rates[20:]) < 0).all()
    assert {rate_at(step, 100, config()) for step in range(100)} == {1e-3}


def test_many_rows_are_gone_through_less_often() -> None:
    config = PRESETS["default"]
    assert [config.passes(n) for n in (10, 35_000, 350_000, 500_000, 10_000_000)] == [
        10,
        10,
        8,
        6,
        6,
    ]
    assert PRESETS["paper"].passes(10_000_000) == 30
