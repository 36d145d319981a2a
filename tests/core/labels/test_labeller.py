"""Exact labels: drawing samples and labelling them."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody
from lcollision_core.contact import ContactRules
from lcollision_core.embedding import ROWS_PER_BLOCK, LatentBox
from lcollision_core.errors import ShapeError
from lcollision_core.labels import (
    Labeller,
    LabelRows,
    is_held_out,
    is_of_box,
    measures,
)
from lcollision_core.labels.labeller import _sum_energies
from lcollision_core.options import SampleDistribution
from tests.core.contact.detector_checks import near_pairs
from tests.core.labelled import as_bytes
from tests.core.labels.conftest import SEED

PINNED_BITS = [12324809925222472078, 2472481397521176968]


def test_the_samples_of_a_seed_never_change() -> None:
    """A store begun by an older version must continue with the same rows."""
    box = LatentBox(np.array([0.0, -2.0]), np.array([1.0, 2.0]))
    first = box.draw(7, 11)[0]
    bits = np.random.Philox(np.random.SeedSequence([7, 11])).random_raw(2)
    assert bits.tolist() == PINNED_BITS
    assert first[0] == np.float32((PINNED_BITS[0] >> 11) / 2**53)
    assert first[1] == np.float32(-2.0 + 4.0 * ((PINNED_BITS[1] >> 11) / 2**53))


def test_samples_fill_the_box_evenly() -> None:
    low, high = np.array([-1.0, 3.0, 0.5]), np.array([2.0, 3.5, 10.0])
    box = LatentBox(low, high)
    samples = np.concatenate([box.draw(0, block) for block in range(200)]).astype(np.float64)
    place = (samples - low) / (high - low)
    assert place.min() >= 0.0
    assert place.max() <= 1.0 + 1e-6
    shares = np.stack([np.histogram(column, 8, (0, 1))[0] for column in place.T]) / len(place)
    # Five standard deviations of a share of 1/8 in 6400.
    assert np.abs(shares - 0.125).max() < 5 * np.sqrt(0.125 * 0.875 / len(place))
    assert np.abs(np.corrcoef(place.T) - np.eye(3)).max() < 5 / np.sqrt(len(place))


def test_blocks_and_seeds_differ() -> None:
    box = LatentBox(np.zeros(4), np.ones(4))
    drawn = [box.draw(seed, block) for seed in range(3) for block in range(3)]
    assert len({block.tobytes() for block in drawn}) == 9
    assert np.array_equal(box.draw(1, 2), drawn[5])


def test_labels_are_those_of_the_exact_check_of_the_exported_mesh(
    ground_truth: LabelRows, tube_model: LearnedBody
) -> None:
    chosen = np.concatenate([np.flatnonzero(ground_truth.colliding)[:8], np.arange(8)])
    for row in chosen:
        exported = tube_model.decode(ground_truth.latent[row]).astype(np.float32)
        found = tube_model.detector.detect(exported)
        assert ground_truth.n_pairs[row] == len(found.pairs)
        assert ground_truth.energy[row] == pytest.approx(found.energy, rel=1e-12)
        by_domain = tube_model.attention_mask @ found.vertex_energy
        assert ground_truth.domain_energy[row] == pytest.approx(by_domain, rel=1e-12)


@pytest.mark.parametrize("n_touched", [0, 1, 7, 8, 100, 129, 300])
def test_energies_are_summed_to_the_bit_as_numpy_sums_them(n_touched: int) -> None:
    """Stores begun with NumPy's sums continue with the same rows."""
    rng = np.random.default_rng(n_touched)
    shares = rng.random((3, 400)).astype(np.float32)
    energy = np.zeros((2, 400))
    touched = np.sort(rng.permutation(400)[:n_touched])
    energy[1, touched] = 10.0 ** rng.uniform(-9, 0, n_touched)
    by_domain, totals = np.empty((2, 3)), np.empty(2)
    _sum_energies(energy, shares.astype(np.float64), by_domain, totals)
    expected = (np.take(shares, touched, axis=1) * energy[1, touched]).sum(axis=1)
    assert by_domain.tobytes() == np.stack([np.zeros(3), expected]).tobytes()
    assert totals.tolist() == [0.0, energy[1, touched].sum()]


def test_domains_share_out_all_of_the_energy(ground_truth: LabelRows) -> None:
    assert ground_truth.energy[ground_truth.colliding].min() > 0.0
    assert (ground_truth.energy[~ground_truth.colliding] == 0.0).all()
    assert ground_truth.domain_energy.sum(axis=1) == pytest.approx(ground_truth.energy, rel=1e-6)
    assert (ground_truth.domain_energy[ground_truth.colliding].max(axis=0) > 0.0).all()


def test_pairs_that_do_not_count_are_not_labelled(
    labeller: Labeller, ground_truth: LabelRows, tube_model: LearnedBody
) -> None:
    every = np.flatnonzero(ground_truth.colliding)[:20]
    by_rules = replace(labeller, rules=ContactRules(0.5))
    excluded = by_rules.label(ground_truth.latent[every])
    found = [
        by_rules.detector.detect(tube_model.decode(latent).astype(np.float32))
        for latent in ground_truth.latent[every]
    ]
    n_near = np.array([len(near_pairs(one)) for one in found])
    assert n_near.max() > 0
    assert excluded.n_pairs.tolist() == [len(one.pairs) for one in found]
    assert np.array_equal(excluded.n_pairs + n_near, ground_truth.n_pairs[every])
    assert (excluded.energy <= ground_truth.energy[every] * (1.0 + 1e-12)).all()
    assert excluded.energy.sum() < ground_truth.energy[every].sum()


def test_a_row_has_the_same_bits_alone_and_in_a_batch(
    labeller: Labeller, ground_truth: LabelRows
) -> None:
    alone = [labeller.label(ground_truth.latent[row : row + 1]) for row in range(70)]
    assert as_bytes(LabelRows.joined(alone)) == as_bytes(ground_truth.taken(slice(70)))


@pytest.mark.slow
def test_a_labeller_that_travelled_says_the_same(
    labeller: Labeller, ground_truth: LabelRows
) -> None:
    copy = pickle.loads(pickle.dumps(labeller))
    assert copy.fingerprint == labeller.fingerprint
    assert as_bytes(copy.label_rows(SEED, range(ROWS_PER_BLOCK))) == as_bytes(
        ground_truth.taken(slice(ROWS_PER_BLOCK))
    )


def test_a_latent_of_another_size_is_refused(labeller: Labeller) -> None:
    with pytest.raises(ShapeError, match="latent must be of shape"):
        labeller.label(np.zeros((2, 5)))


def test_three_rows_in_ten_are_held_out_for_good() -> None:
    held_out = is_held_out(np.arange(100_000))
    assert held_out.mean() == 0.3
    assert np.flatnonzero(held_out[:20]).tolist() == [7, 8, 9, 17, 18, 19]


def test_mixed_samples_are_of_the_box_of_known_poses_and_at_the_border(
    tube_model: LearnedBody,
) -> None:
    mixed, box = tube_model.labeller(SampleDistribution.MIXED), tube_model.labeller()
    rows, plain = (one.label_rows(SEED, range(640)) for one in (mixed, box))
    place = np.arange(640) % ROWS_PER_BLOCK
    of_box = is_of_box(np.arange(640), SampleDistribution.MIXED)
    assert of_box.mean() == 0.5
    assert np.array_equal(rows.latent[of_box], plain.latent[of_box])
    # Each row of a block gets the same label as alone.
    assert as_bytes(mixed.label(rows.latent[:64])) == as_bytes(rows.taken(slice(64)))
    # Bisections end nearer to the collision boundary.
    at_border, inside = place >= 24, of_box & rows.colliding
    assert 0.1 < rows.colliding[at_border].mean() < 0.9
    assert np.median(rows.energy[at_border & rows.colliding]) < np.median(rows.energy[inside])


def test_a_part_of_a_mixed_block_is_that_of_the_whole(tube_model: LearnedBody) -> None:
    labeller = tube_model.labeller(SampleDistribution.MIXED)
    whole = labeller.label_rows(SEED, range(2 * ROWS_PER_BLOCK))
    for n_rows in (5, 30, ROWS_PER_BLOCK + 20):
        assert as_bytes(labeller.label_rows(SEED, range(n_rows))) == as_bytes(
            whole.taken(slice(n_rows))
        )


def test_no_mixed_training_row_depends_on_one_that_measures(
    tube_model: LearnedBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bisections use only rows that are not held out."""
    labeller = tube_model.labeller(SampleDistribution.MIXED)
    ends: list[LabelRows] = []

    def note_ends(_: Labeller, given: LabelRows, others: np.ndarray) -> Iterator[np.ndarray]:
        ends.append(given)
        return (yield others)

    monkeypatch.setattr(Labeller, "_near_border", note_ends)
    rows = labeller.label_rows(SEED, range(320))
    measuring = rows.latent[measures(np.arange(320), SampleDistribution.MIXED)]
    assert 0.14 < len(measuring) / 320 < 0.16
    for given in ends:
        assert not (given.latent[:, None] == measuring[None]).all(axis=2).any()


def test_where_nothing_collides_the_box_fills_a_mixed_block(tube_model: LearnedBody) -> None:
    """With rules that tolerate any depth."""
    rules = ContactRules(tolerated_depth=0.5)
    labeller = replace(tube_model.labeller(SampleDistribution.MIXED), rules=rules)
    rows = labeller.label_rows(SEED, range(ROWS_PER_BLOCK))
    assert not rows.colliding.any()
    assert np.array_equal(rows.latent[24:], labeller.embedding.box.draw(SEED, 0)[24:])
