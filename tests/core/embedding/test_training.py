"""Stage 1 end to end on a tube that bends in two places."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch

from lcollision_core.embedding import (
    Embedding,
    EmbeddingConfig,
    TrainingStatus,
    judge_masks,
    train_embedding,
)
from lcollision_core.embedding.bilevel import fit_latent, vertex_distances
from lcollision_core.errors import (
    CancelledError,
    LCollisionError,
    ModelFileError,
    PoseSetError,
    ShapeError,
)
from lcollision_core.files import PoseSet
from lcollision_core.jobs import Job
from lcollision_core.meshes import Topology

N_RINGS, N_SIDES = 25, 8
SMALL = EmbeddingConfig(
    n_domains=3, n_domain_codes=4, level1_epochs=6, level2_epochs=4, held_out_stride=6
)


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Keep torch from distributing arrays of a few kilobytes over all cores."""
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(n_threads)


def bent_tube(first: float, second: float) -> npt.NDArray[np.float64]:
    """Return a tube along y, length 1, bent by two angles at a third and two thirds."""
    along = np.linspace(0.0, 1.0, 401)

    def bent_by(angle: float, place: float) -> npt.NDArray[np.float64]:
        share = np.clip((along - place) / 0.16 + 0.5, 0.0, 1.0)
        return angle * share**2 * (3.0 - 2.0 * share)

    angle = bent_by(first, 1.0 / 3.0) + bent_by(second, 2.0 / 3.0)
    step = np.diff(along, prepend=0.0)[:, None]
    line = np.cumsum(step * np.stack([np.sin(angle), np.cos(angle)], axis=1), axis=0)
    rings = np.linspace(0, 400, N_RINGS).astype(int)
    turn = np.linspace(0.0, 2.0 * np.pi, N_SIDES, endpoint=False)
    across = 0.06 * np.cos(turn)
    x = line[rings, 0, None] + across * np.cos(angle[rings, None])
    y = line[rings, 1, None] - across * np.sin(angle[rings, None])
    z = np.broadcast_to(0.06 * np.sin(turn), x.shape)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def tube_topology() -> Topology:
    faces = []
    for ring in range(N_RINGS - 1):
        for side in range(N_SIDES):
            a, b = ring * N_SIDES + side, ring * N_SIDES + (side + 1) % N_SIDES
            faces += [[a, b, a + N_SIDES], [b, b + N_SIDES, a + N_SIDES]]
    return Topology(np.array(faces), N_RINGS * N_SIDES)


def tube_poses(n_poses: int = 24, unit: float = 1.0) -> PoseSet:
    bends = np.random.default_rng(5).uniform(-1.2, 1.2, (n_poses, 2))
    bends[0] = 0.0
    vertices = unit * np.stack([bent_tube(*bend) for bend in bends])
    return PoseSet(vertices, tube_topology(), tuple(f"pose {n}" for n in range(n_poses)))


@cache
def trained_tube() -> Embedding:
    return train_embedding(
        tube_poses(),
        EmbeddingConfig(n_domains=3, n_domain_codes=4, level1_epochs=40, level2_epochs=20),
    )


def same_bits(a: Embedding, b: Embedding) -> bool:
    arrays_a, metadata_a = a.to_arrays()
    arrays_b, metadata_b = b.to_arrays()
    return (
        metadata_a == metadata_b
        and arrays_a.keys() == arrays_b.keys()
        and all(np.array_equal(arrays_a[name], arrays_b[name]) for name in arrays_a)
    )


def test_tube_is_rebuilt_and_split_where_it_bends() -> None:
    embedding = trained_tube()
    metrics = embedding.metrics
    assert metrics is not None
    assert metrics.mean < 0.002
    assert metrics.max < 0.015
    assert metrics.guess_mean < 0.006
    assert metrics.level1_mean > metrics.mean
    assert metrics.held_out_mean is not None
    assert metrics.held_out_mean < 0.006
    quality = judge_masks(embedding.attention_mask, embedding.topology, embedding.rest_vertices)
    assert quality.connected_share.tolist() == [1.0, 1.0, 1.0]
    assert quality.domains_per_vertex < 2.0
    # Numbered from the upper end; each straight piece belongs to one domain.
    owner = embedding.attention_mask.argmax(axis=0).reshape(N_RINGS, N_SIDES)
    assert (owner[22:] == 0).all()
    assert (owner[11:14] == 1).all()
    assert (owner[:3] == 2).all()


def test_level_2_may_stay_as_its_principal_components() -> None:
    config = replace(SMALL, level1_epochs=40, level2_epochs=0, held_out_stride=0)
    metrics = train_embedding(tube_poses(), config).metrics
    assert metrics is not None
    assert metrics.mean < 0.002
    assert metrics.mean < metrics.guess_mean < metrics.level1_mean


def test_metrics_are_those_of_the_embedding() -> None:
    embedding, poses = trained_tube(), tube_poses()
    assert embedding.metrics is not None
    decoded = embedding.decode(embedding.training_latent)
    height = np.ptp(poses.vertices[0], axis=0).max()
    distances = vertex_distances(decoded, poses.vertices / height)
    assert distances.mean() == pytest.approx(embedding.metrics.mean, rel=1e-6)
    assert distances.max() == pytest.approx(embedding.metrics.max, rel=1e-6)


def test_training_poses_keep_the_encoders_codes_where_that_is_asked_for() -> None:
    fitted, encoded = (
        train_embedding(tube_poses(12), replace(SMALL, encoded_codes=of_encoders))
        for of_encoders in (False, True)
    )
    assert np.array_equal(fitted.level1.components, encoded.level1.components)
    assert not np.allclose(encoded.training_latent, fitted.training_latent, atol=1e-2)
    assert encoded.metrics is not None
    assert fitted.metrics is not None
    assert encoded.metrics.mean == pytest.approx(encoded.metrics.guess_mean)
    assert encoded.metrics.mean == pytest.approx(fitted.metrics.guess_mean)
    assert encoded.metrics.mean > fitted.metrics.mean
    assert encoded.metrics.held_out_mean is not None
    assert fitted.metrics.held_out_mean is not None
    assert encoded.metrics.held_out_mean > fitted.metrics.held_out_mean
    reach = encoded.training_latent.max(axis=0).astype(np.float64)
    np.testing.assert_allclose(encoded.box.high, 1.2 * reach, rtol=1e-12)


def test_unit_of_the_poses_does_not_matter() -> None:
    config = replace(SMALL, held_out_stride=0)
    metres = train_embedding(tube_poses(), config)
    millimetres = train_embedding(tube_poses(unit=1024.0), config)
    assert same_bits(metres, millimetres)


def test_latent_ranges_straddle_zero() -> None:
    embedding = trained_tube()
    assert (embedding.box.low < 0.0).all()
    assert (embedding.box.high > 0.0).all()
    assert np.allclose(embedding.box.low, 1.2 * embedding.training_latent.min(axis=0))
    assert embedding.box.low.shape == (embedding.latent_size,) == (3 + 3 * 4,)
    assert embedding.group_sizes == (3, 4, 4, 4)


@pytest.mark.slow
def test_seed_reproduces_the_model_bit_for_bit() -> None:
    first = train_embedding(tube_poses(), SMALL, seed=3)
    assert same_bits(first, train_embedding(tube_poses(), SMALL, seed=3))
    assert not same_bits(first, train_embedding(tube_poses(), SMALL, seed=4))


class CancelAt:
    """Cancels a run at its n-th report."""

    def __init__(self, report: int) -> None:
        self.token = Job()
        self.statuses: list[TrainingStatus] = []
        self._report = report

    def __call__(self, status: TrainingStatus) -> None:
        self.statuses.append(status)
        if len(self.statuses) == self._report:
            self.token.cancel()


@pytest.mark.variants
@pytest.mark.parametrize(
    "report",
    # In level 2 of the model of all poses, and in the codes of the one with held-out poses.
    [8, 45, *(pytest.param(report, marks=pytest.mark.slow) for report in (6, 20, 42))],
)
def test_resumed_training_equals_uninterrupted(tmp_path: Path, report: int) -> None:
    checkpoint = tmp_path / "run.checkpoint"
    poses = tube_poses()
    stop = CancelAt(report)
    with pytest.raises(CancelledError):
        train_embedding(poses, SMALL, checkpoint=checkpoint, job=stop.token.part(stop), seed=3)
    watch = CancelAt(0)
    resumed = train_embedding(poses, SMALL, checkpoint=checkpoint, job=Job(watch), seed=3)
    assert same_bits(resumed, _uninterrupted())
    done = [status.done for status in watch.statuses]
    assert done[0] == stop.statuses[-1].done + 1
    assert done == sorted(done)
    assert done[-1] == watch.statuses[-1].total


@cache
def _uninterrupted() -> Embedding:
    return train_embedding(tube_poses(), SMALL, seed=3)


def test_progress_shows_both_levels() -> None:
    watch = CancelAt(0)
    train_embedding(tube_poses(), SMALL, job=Job(watch))
    stages = [(status.model, status.stage) for status in watch.statuses]
    assert list(dict.fromkeys(stages)) == [
        ("all poses", "level 1"),
        ("all poses", "level 2"),
        ("all poses", "codes"),
        ("held out", "level 1"),
        ("held out", "level 2"),
        ("held out", "codes"),
    ]
    level2 = [status for status in watch.statuses if status.stage == "level 2"]
    assert all(status.level1_error and status.both_error for status in level2)
    assert level2[-1].both_error is not None
    assert level2[-1].level1_error is not None
    assert level2[-1].both_error < level2[-1].level1_error
    assert [status.done for status in watch.statuses] == list(
        range(1, watch.statuses[-1].total + 1)
    )


def test_checkpoint_of_another_run_is_refused(tmp_path: Path) -> None:
    checkpoint = tmp_path / "run.checkpoint"
    train_embedding(tube_poses(), SMALL, checkpoint=checkpoint)
    with pytest.raises(LCollisionError, match="another training run"):
        train_embedding(tube_poses(), SMALL, checkpoint=checkpoint, seed=1)
    with pytest.raises(LCollisionError, match="another training run"):
        train_embedding(tube_poses(12), SMALL, checkpoint=checkpoint)
    checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
    with pytest.raises(ModelFileError):
        train_embedding(tube_poses(), SMALL, checkpoint=checkpoint)


def test_one_pose_and_too_many_domains_are_refused() -> None:
    with pytest.raises(PoseSetError, match="add poses that differ"):
        train_embedding(tube_poses(1))
    with pytest.raises(PoseSetError, match="cannot have 300 domains"):
        train_embedding(tube_poses(4), EmbeddingConfig(n_domains=300))


def test_fewer_poses_than_codes() -> None:
    config = EmbeddingConfig(n_domains=2, n_domain_codes=10, level1_epochs=5, level2_epochs=2)
    embedding = train_embedding(tube_poses(4), config)
    assert embedding.group_sizes == (2, 4, 4)
    assert embedding.metrics is not None
    assert embedding.metrics.held_out_mean is None
    assert embedding.metrics.mean < 0.01


def test_encode_gives_the_code_of_a_moved_mesh_back() -> None:
    embedding = trained_tube()
    rng = np.random.default_rng(1)
    latent = 0.6 * rng.uniform(embedding.box.low, embedding.box.high, (3, 15))
    for decoded in embedding.decode(latent):
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        turn *= np.linalg.det(turn)
        moved = decoded @ turn.T + [3.0, -2.0, 1.0]
        fit = embedding.encode(moved)
        assert fit.max_error < 1e-3
        again = embedding.decode(fit.latent[None])[0]
        back = moved @ fit.rotation.T + fit.translation
        assert np.abs(again - back).max() < 1e-3
        still = embedding.encode(decoded)
        # Float32 codes and a fit that stops at 2 % gain explain this difference.
        assert np.abs(fit.latent - still.latent).max() < 1e-3 * np.abs(still.latent).max()


def test_fit_has_the_same_bits_on_any_number_of_threads_and_few_jacobians(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    embedding, poses = trained_tube(), tube_poses()
    codec, decoder = embedding.codec, embedding.decoder
    vertices = poses.vertices[1] / np.ptp(poses.vertices[0], axis=0).max()
    calls = []
    differentiate = codec.decode_jvp

    def counted(*arguments: object) -> object:
        calls.append(arguments)
        return differentiate(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(codec, "decode_jvp", counted)
    guess, deviation = np.zeros(embedding.latent_size), embedding.latent_deviation
    fits = [
        fit_latent(decoder, codec, vertices, guess, deviation, n_threads=n_threads)
        for n_threads in (1, 2)
    ]
    assert np.array_equal(fits[0].latent, fits[1].latent)
    assert fits[0].mean_error < 0.005
    n_jacobians = len(calls) / 2 / len(embedding.group_sizes)
    assert 1 < n_jacobians <= 5


def test_encode_improves_on_the_guess() -> None:
    embedding, poses = trained_tube(), tube_poses()
    vertices = poses.vertices[1:4] / np.ptp(poses.vertices[0], axis=0).max()
    guess = embedding.decode(embedding.guess(embedding.codec.encode(vertices)))
    for decoded, mesh in zip(guess, vertices, strict=True):
        guessed = vertex_distances(decoded[None], mesh[None]).mean()
        assert embedding.encode(mesh).mean_error < guessed


def test_decode_serial_and_batch_agree() -> None:
    embedding = trained_tube()
    rng = np.random.default_rng(0)
    latent = rng.uniform(embedding.box.low, embedding.box.high, (19, 15))
    batch = embedding.decode(latent, n_threads=2)
    for row, vertices in zip(latent, batch, strict=True):
        assert np.array_equal(embedding.decode(row[None])[0], vertices)
    with pytest.raises(ShapeError, match="latent"):
        embedding.decode(latent[:, :-1])


def test_arrays_bring_the_same_embedding_back() -> None:
    embedding = trained_tube()
    arrays, metadata = embedding.to_arrays()
    again = Embedding.from_arrays(arrays, metadata)
    assert same_bits(embedding, again)
    assert np.array_equal(
        embedding.decode(embedding.training_latent), again.decode(embedding.training_latent)
    )
    assert again.metrics == embedding.metrics


def test_arrays_that_do_not_fit_are_refused() -> None:
    arrays, metadata = trained_tube().to_arrays()
    without = {name: array for name, array in arrays.items() if name != "level2_1_components"}
    with pytest.raises(ModelFileError, match="level2_1_components"):
        Embedding.from_arrays(without, metadata)
    with pytest.raises(ModelFileError, match="training_latent"):
        Embedding.from_arrays(
            {**arrays, "training_latent": arrays["training_latent"][:, 1:]}, metadata
        )
    with pytest.raises(ModelFileError, match="sum to 1"):
        Embedding.from_arrays({**arrays, "level2_0_mask": 0.5 * arrays["level2_0_mask"]}, metadata)
    with pytest.raises(ModelFileError, match="support"):
        Embedding.from_arrays(
            {**arrays, "level2_0_support": arrays["level2_0_support"][::-1]}, metadata
        )


@pytest.mark.parametrize(
    "change",
    [
        {"n_domains": 0},
        {"n_domain_codes": 0},
        {"batch_poses": 0},
        {"held_out_stride": 1},
        {"level1_rate": -1.0},
        {"vertex_weight": float("nan")},
        {"window_overlap": 1.0},
    ],
)
def test_senseless_choices_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(LCollisionError, match=next(iter(change))):
        replace(EmbeddingConfig(), **change)  # type: ignore[arg-type]
