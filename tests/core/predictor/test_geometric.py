"""The default network: its points, their contact features, and its training patches."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from lcollision_core.bodies import LearnedBody
from lcollision_core.contact import CollisionDetector, ContactRules
from lcollision_core.embedding import Embedding
from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.jobs import Job
from lcollision_core.meshes import Topology
from lcollision_core.predictor import PRESETS, training_loop
from lcollision_core.predictor.compiled_network import (
    body_points,
    neighbour_order,
    skin_cells,
    skin_distances,
    skin_graph,
    tangent_frames,
)
from lcollision_core.predictor.geometric_network import (
    _MEMBER_RADIUS,
    FOLD_RADIUS,
    N_MEMBERS,
    SIZES,
    ContactField,
    GeometricNetwork,
    _Auxiliary,
    find_fold_sites,
)
from lcollision_core.predictor.kernels import (
    BLOCK,
    FULL,
    RADII,
    SOME,
    UNITS,
    contact_field,
    contact_field_backward,
    in_blocks,
)
from lcollision_core.predictor.network_base import NetworkOutput, SkinCells, Targets
from lcollision_core.predictor.training_loop import PatchLabeller
from tests.core.contact.detector_checks import near_pairs
from tests.core.labelled import labeller_of
from tests.core.predictor_rows import colliding_latent, made_up_rows


@pytest.fixture(scope="module")
def network(tube_model: LearnedBody) -> GeometricNetwork:
    rows = made_up_rows(tube_model.embedding)
    built = GeometricNetwork.build(tube_model.embedding, PRESETS["default"], rows)
    assert isinstance(built, GeometricNetwork)
    return built


def _some_latent(model: LearnedBody, n_poses: int) -> np.ndarray:
    return model.latent_space.sample(n_poses, np.random.default_rng(3))


def test_points_are_spread_and_every_vertex_belongs_to_the_nearest(tube_model: LearnedBody) -> None:
    embedding = tube_model.embedding
    points = body_points(embedding, 20)
    assert len(np.unique(points)) == 20
    assert np.array_equal(skin_cells(embedding, points)[points], np.arange(20))
    positions = embedding.rest_vertices[points]
    between = np.linalg.norm(positions[:, None] - positions[None], axis=2) + np.eye(20)
    covered = np.linalg.norm(embedding.rest_vertices[:, None] - positions[None], axis=2).min(axis=1)
    # Farthest-point sampling: no vertex is farther from the points than they are from each other.
    assert covered.max() <= between.min() + 1e-12


def test_loose_pieces_of_skin_belong_to_the_nearest_of_all_centres() -> None:
    triangle = np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0], [0.0, 1.0, 0.0]])
    # The second lies beside corner 1 of the first, and an unused vertex beside its corner 2.
    vertices = np.concatenate([triangle, triangle + [1.2, 0.0, 0.0], [[0.0, 1.1, 0.0]]])
    topology = Topology(np.array([[0, 1, 2], [3, 4, 5]]), 7)
    embedding = cast(Embedding, SimpleNamespace(topology=topology, rest_vertices=vertices))
    assert skin_cells(embedding, np.array([2, 1])).tolist() == [1, 1, 0, 1, 1, 1, 0]


def test_frames_are_rotations_whose_first_axis_points_out(tube_model: LearnedBody) -> None:
    points = body_points(tube_model.embedding, 30)
    frame = tangent_frames(tube_model.embedding, points)
    assert frame.transpose(0, 2, 1) @ frame == pytest.approx(
        np.broadcast_to(np.eye(3), (30, 3, 3)), abs=1e-12
    )
    assert np.linalg.det(frame) == pytest.approx(np.ones(30))
    rest = tube_model.embedding.rest_vertices
    middle = rest.mean(axis=0)
    outward = ((rest[points] - middle) * frame[:, :, 0]).sum(axis=1)
    assert (outward > 0.0).mean() > 0.9


def test_reduced_body_lies_where_the_decoder_puts_it(
    tube_model: LearnedBody, network: GeometricNetwork
) -> None:
    latent = _some_latent(tube_model, 20)
    with torch.no_grad():
        _, _, positions = network.body(torch.tensor(latent, dtype=torch.float32))
    truth = tube_model.embedding.decode(latent)[:, network.skin.point_vertices]
    errors = np.linalg.norm(positions.numpy().transpose(0, 2, 1) - truth, axis=2)
    assert errors.mean() < 2e-3
    moved = truth - truth[:1]
    assert np.abs(moved).max() > 0.05


def test_frames_and_gradients_are_those_of_the_embedding(
    tube_model: LearnedBody, network: GeometricNetwork
) -> None:
    """Each point's S is symmetric, R turns its frame, and both follow from its features alone."""
    embedding = tube_model.embedding
    latent = _some_latent(tube_model, 3)
    exact = embedding.decoder.features(latent)[:, network.skin.point_vertices]
    with torch.no_grad():
        found = network.body.features(torch.tensor(latent, dtype=torch.float32))
    assert found[:, : len(network.skin.point_vertices)].numpy() == pytest.approx(exact, abs=1e-5)


def _field(
    near: np.ndarray, order: np.ndarray, frame: np.ndarray, positions: np.ndarray
) -> np.ndarray:
    """Return the compiled field of points, some of them neighbours along the surface."""
    field = np.empty((positions.shape[2], len(frame), *UNITS.shape))
    contact_field(frame, positions, order, _blocks(near, order), field)
    return field


def _blocks(near: np.ndarray, order: np.ndarray) -> np.ndarray:
    return in_blocks(near.astype(np.float32), order).astype(np.float64)


@pytest.mark.slow
def test_the_compiled_field_is_that_of_torch() -> None:
    """On a GPU, torch computes the same as the compiled CPU loops, which skip far blocks."""
    rng = np.random.default_rng(4)
    positions = 0.05 * rng.standard_normal((2, 3, 45))
    positions[1, 0, 20:] += 0.6
    half = np.triu(rng.random((45, 45)))
    near = half + np.triu(half, 1).T < 0.2
    frame = np.linalg.qr(rng.standard_normal((2, 45, 3, 3)))[0]
    order = neighbour_order(positions[1].T, BLOCK)
    found = _field(near, order, frame, positions)
    assert np.abs(found).max() > 0.1
    skin = SimpleNamespace(geodesic_neighbours=near.astype(np.float64))
    given = torch.tensor(frame, requires_grad=True), torch.tensor(positions, requires_grad=True)
    theirs = ContactField(skin)(*given)  # type: ignore[arg-type]
    assert found == pytest.approx(theirs.detach().numpy(), abs=1e-12)
    by_field = rng.standard_normal(found.shape)
    gradients = np.zeros_like(frame), np.zeros_like(positions)
    blocks = _blocks(near, order)
    contact_field_backward(frame, positions, order, blocks, found, by_field, *gradients)
    theirs.backward(torch.tensor(by_field))
    for ours, tensor in zip(gradients, given, strict=True):
        assert tensor.grad is not None
        assert np.abs(ours).max() > 0.1
        assert ours == pytest.approx(tensor.grad.numpy(), abs=1e-9)
    more = np.concatenate([frame, frame[:, :4]], axis=1)
    assert np.array_equal(found, _field(near, order, more, positions))


def test_field_by_hand() -> None:
    """Two points face each other across 0.05; a third, behind the first one's skin, is ignored."""
    frame = np.tile(np.eye(3), (1, 3, 1, 1))
    frame[0, 1] = np.diag([-1.0, 1.0, -1.0])
    positions = np.zeros((1, 3, 3))
    positions[0, :, 1] = [0.05, 0.01, 0.0]
    positions[0, 0, 2] = -0.1
    order = np.array([2, 1, 0, 0, 0, 0, 0, 0], dtype=np.int32)
    (first, second, _) = _field(np.eye(3), order, frame, positions)[:, 0]
    for k, radius in enumerate(RADII):
        weight = (1.0 - (0.05**2 + 0.01**2) / radius**2) ** 3
        share, mean = weight / (weight + FULL), weight / (weight + SOME)
        # The first is 0.05 above the second's plane, whose normal points to it.
        means = np.array([0.05 / radius, 0.05 / radius, 0.01 / radius, 0.0, -1.0, 0.0, 0.0])
        assert first[k] == pytest.approx(np.array([share, *(mean * means)]), abs=1e-12)
        # The second's local frame rotates its features: its forward is the world's -x.
        means[2] *= -1.0
        assert second[k] == pytest.approx(np.array([share, *(mean * means)]), abs=1e-12)


def test_only_points_far_along_the_surface_count() -> None:
    rng = np.random.default_rng(1)
    frame = np.linalg.qr(rng.standard_normal((2, 7, 3, 3)))[0]
    positions = 0.02 * rng.standard_normal((2, 3, 7))
    order = np.array([3, 1, 0, 2, 6, 5, 4, 4], dtype=np.int32)
    near = np.ones((7, 7))
    assert np.abs(_field(near, order, frame, positions)).max() == 0.0
    near[2, 3] = near[3, 2] = 0.0
    found = _field(near, order, frame, positions)
    assert np.abs(found[[0, 1, 4, 5, 6]]).max() == 0.0
    assert np.abs(found[[2, 3]]).max() > 0.0


def test_neighbours_are_in_one_block() -> None:
    """Two clusters of 8 points and one of 3, in any order, give three blocks."""
    rng = np.random.default_rng(3)
    cluster = rng.permutation(np.repeat([0, 1, 2], [8, 8, 3]))
    positions = 10.0 * cluster[:, None] + rng.random((19, 3))
    order = neighbour_order(positions, 8)
    assert order.dtype == np.int32
    assert np.array_equal(np.sort(order[:19]), np.arange(19))
    assert np.array_equal(cluster[order[:19]], np.repeat([0, 1, 2], [8, 8, 3]))
    assert np.array_equal(cluster[order[19:]], [2] * 5)
    assert len(neighbour_order(positions[:3], 8)) == 8


def test_folds_are_looked_for_where_the_skin_folds(
    tube_model: LearnedBody, tube_folds: np.ndarray
) -> None:
    """Sites lie at colliding near pairs, and their members around them."""
    embedding = tube_model.embedding
    assert tube_folds.shape[1] == N_MEMBERS
    assert 1 <= len(tube_folds) <= SIZES["default"].sites
    centres = tube_folds[:, 0]
    assert len(np.unique(centres)) == len(centres)
    detector = CollisionDetector(
        embedding.topology, embedding.rest_vertices, rules=ContactRules(FOLD_RADIUS)
    )
    folded = [
        near_pairs(detector.detect(pose.astype(np.float32)))
        for pose in embedding.decode(colliding_latent(tube_model))
    ]
    touched = np.unique(embedding.topology.faces[np.concatenate(folded)])
    assert len(touched)
    assert np.isin(centres, touched).all()
    distance = skin_distances(skin_graph(embedding), centres)
    for members, own in zip(tube_folds, distance, strict=True):
        nearest = np.sort(own)[:N_MEMBERS]
        assert own[members].max() <= max(_MEMBER_RADIUS, nearest[-1])


def test_a_body_without_folds_has_no_sites(tube_model: LearnedBody) -> None:
    embedding = tube_model.embedding
    sites = find_fold_sites(embedding, np.zeros((3, embedding.latent_size), dtype=np.float32))
    assert sites.shape == (0, N_MEMBERS)
    network = GeometricNetwork(embedding, 0, sites)
    assert (network.skin_cells(embedding).fold == -1).all()
    assert torch.isfinite(network(torch.zeros((2, embedding.latent_size))).logit).all()


@pytest.mark.parametrize("preset", SIZES)
def test_inputs_are_the_same_with_derivatives_and_without(
    tube_model: LearnedBody, preset: str
) -> None:
    """Without derivatives, the CPU uses compiled loops in blocks of rows; with them, torch."""
    rows = labeller_of(tube_model).label(colliding_latent(tube_model, 70))
    network = GeometricNetwork.build(tube_model.embedding, PRESETS[preset], rows)
    assert isinstance(network, GeometricNetwork)
    assert network.patch.layers[0].weight.shape[2] == SIZES[preset].width
    latent = torch.tensor(rows.latent)
    by_loops = network._inputs(latent)
    by_torch = network._inputs(latent.clone().requires_grad_())
    for ours, theirs in zip(by_loops, by_torch, strict=True):
        assert not ours.requires_grad
        assert theirs.requires_grad
        assert ours.abs().max() > 0.1
        # In single precision each is up to 2e-5 from double.
        assert torch.allclose(ours, theirs, atol=4e-5)


def test_a_batch_is_its_poses(tube_model: LearnedBody, network: GeometricNetwork) -> None:
    latent = torch.tensor(_some_latent(tube_model, 70), dtype=torch.float32)
    with torch.no_grad():
        together = network(latent)
        alone = [network(row[None]) for row in latent]
    assert torch.allclose(together.logit, torch.cat([one.logit for one in alone]), atol=1e-4)
    assert together.logit.std() > 0.0
    assert (together.domain_energy >= 0.0).all()


def test_patches_and_folds_share_out_the_exact_energy(
    tube_model: LearnedBody, tube_folds: np.ndarray
) -> None:
    embedding = tube_model.embedding
    latent = colliding_latent(tube_model)
    cells = SkinCells(
        skin_cells(embedding, body_points(embedding, 25)), skin_cells(embedding, tube_folds[:, 0])
    )
    index = np.arange(0, 60, 2)
    rows = labeller_of(tube_model).label(latent)
    roots = PatchLabeller(embedding, rows, cells, 1e-4, ContactRules()).roots(index)
    assert roots.shape == (30, cells.n_patches + cells.n_folds)
    detector = CollisionDetector(embedding.topology, embedding.rest_vertices)
    vertices = embedding.decode(latent[index]).astype(np.float32)
    energy = detector.detect_batch(vertices).vertex_energy.sum(axis=1)
    assert (energy > 0.0).sum() >= 5
    assert ((roots > 0.0).any(axis=1) == (energy > 0.0)).all()
    squares = roots.astype(np.float64) ** 2
    shares = np.repeat([0.05, 0.005], [cells.n_patches, cells.n_folds])
    assert (squares * shares).sum(axis=1) * 1e-4 == pytest.approx(energy, rel=5e-3, abs=1e-9)
    assert squares[:, : cells.n_patches].any()
    assert squares[:, cells.n_patches :].any()


@pytest.mark.parametrize(
    "rules",
    [ContactRules(), ContactRules(0.1), ContactRules(rest_exclusion=0.0, tolerated_depth=2e-3)],
)
def test_every_collision_that_counts_is_taught(
    tube_model: LearnedBody, rules: ContactRules
) -> None:
    """With and without sites, and with rules; excluded pairs are neither contact nor fold."""
    embedding, latent = tube_model.embedding, colliding_latent(tube_model)
    detector = CollisionDetector(embedding.topology, embedding.rest_vertices, rules=rules)
    found = detector.detect_batch(embedding.decode(latent).astype(np.float32))
    rows = replace(labeller_of(tube_model), rules=rules).label(latent)
    patch = skin_cells(embedding, body_points(embedding, 25))
    sites = find_fold_sites(embedding, latent, rules)
    assert len(sites)
    for fold in (skin_cells(embedding, centres) for centres in (sites[:, 0], sites[:0, 0])):
        cells = SkinCells(patch, fold)
        labeller = PatchLabeller(embedding, rows, cells, 1e-4, rules)
        roots = labeller.roots(np.arange(60))
        assert ((roots > 0.0).any(axis=1) == found.colliding).all()
        shares = np.repeat([0.05, 0.005], [cells.n_patches, cells.n_folds])
        taught = (roots.astype(np.float64) ** 2 * shares).sum(axis=1) * 1e-4
        energy = found.vertex_energy.sum(axis=1)
        assert taught == pytest.approx(energy, rel=5e-3, abs=1e-9)


def test_labelling_patches_can_be_cancelled(tube_model: LearnedBody) -> None:
    job = Job()
    job.cancel()
    zeros = np.zeros(tube_model.n_vertices, dtype=np.int64)
    rows = labeller_of(tube_model).label(colliding_latent(tube_model))
    labeller = PatchLabeller(
        tube_model.embedding, rows, SkinCells(zeros, zeros - 1), 1.0, ContactRules()
    )
    with pytest.raises(CancelledError):
        labeller.roots(np.arange(4), job=job)


def test_patches_do_not_depend_on_what_is_labelled_beside_them(tube_model: LearnedBody) -> None:
    embedding = tube_model.embedding
    rows = labeller_of(tube_model).label(colliding_latent(tube_model))
    cells = SkinCells(
        skin_cells(embedding, body_points(embedding, 25)), np.full(tube_model.n_vertices, -1)
    )
    labeller = PatchLabeller(embedding, rows, cells, 1e-4, ContactRules())
    told = list[tuple[int, int]]()
    whole = labeller.roots(np.arange(60), job=Job(lambda *step: told.append(step)))
    n_colliding = np.count_nonzero(rows.colliding)
    assert n_colliding > training_loop._ROWS_PER_BLOCK
    assert told == [(training_loop._ROWS_PER_BLOCK, n_colliding), (n_colliding, n_colliding)]
    assert whole.any()
    for part in (np.arange(7), np.arange(7, 60), np.array([50, 3])):
        assert np.array_equal(labeller.roots(part), whole[part])


def test_a_stored_network_predicts_the_same(
    tube_model: LearnedBody, tube_folds: np.ndarray, network: GeometricNetwork
) -> None:
    embedding, config = tube_model.embedding, PRESETS["default"]
    folding = GeometricNetwork(embedding, 3, tube_folds)
    latent = torch.tensor(_some_latent(tube_model, 5), dtype=torch.float32)
    for given in (network, folding):
        restored = GeometricNetwork.restore(embedding, config, given.state_dict())
        with torch.no_grad():
            assert torch.equal(restored(latent).logit, given(latent).logit)
    state = folding.state_dict() | {"site_vertices": torch.tensor([[10**6] * N_MEMBERS])}
    with pytest.raises(ValueError, match="fold sites"):
        GeometricNetwork.restore(embedding, config, state)


def test_the_loss_teaches_patches_folds_energies_and_the_verdict(
    tube_model: LearnedBody, tube_folds: np.ndarray
) -> None:
    network = GeometricNetwork(tube_model.embedding, 0, tube_folds)
    n_points, n_folds, n_domains = len(network.skin.point_vertices), len(tube_folds), 2
    assert n_folds > 0
    # Two rows. The first one's patches and folds collide, with square roots of 0.4 and 3.
    taught = torch.zeros((2, n_points + n_folds), dtype=torch.float64)
    taught[0, :n_points], taught[0, n_points:] = 0.4, 3.0
    energy = torch.tensor([[0.25, 0.0], [0.0, 0.0]], dtype=torch.float64)
    colliding = torch.tensor([1.0, 0.0], dtype=torch.float64)
    targets = Targets(energy, energy.sum(dim=1), colliding, taught)

    def loss(values: torch.Tensor) -> torch.Tensor:
        logit, patch_logit, patch_root, root = values.split(
            [1, n_points + n_folds, n_points + n_folds, n_domains + 1], dim=1
        )
        output = NetworkOutput(energy, logit[:, 0], _Auxiliary(patch_logit, patch_root, root))
        return network.loss(output, targets, (0, 2), PRESETS["default"], 0.0)

    n_values = 1 + 2 * (n_points + n_folds) + n_domains + 1
    values = torch.zeros((2, n_values), dtype=torch.float64)
    values[:, 0] = np.log(3.0)
    patches = 20.0 * np.log(2.0) + 5.0 * 0.5 * 0.4**2 / 2
    folds = 5.0 * np.log(2.0) + 1.25 * (3.0 - 0.5) / 2
    verdict = -(np.log(0.75) + np.log(0.25)) / 2
    # Two of six square roots are 0.5.
    energies = 2 * 0.5 * 0.5**2 / 6
    expected = patches + folds + verdict + energies
    assert float(loss(values)) == pytest.approx(expected)

    values = values + torch.linspace(-0.7, 0.7, 2 * n_values, dtype=torch.float64).view(2, -1)
    (gradient,) = torch.autograd.grad(loss(values.requires_grad_()), values)
    assert (gradient != 0.0).all()
    values, step = values.detach(), 1e-6
    for place in list(np.ndindex(*values.shape))[::5]:
        moved = torch.zeros_like(values)
        moved[place] = step
        slope = float(loss(values + moved) - loss(values - moved)) / (2 * step)
        assert float(gradient[place]) == pytest.approx(slope, abs=1e-7)


def test_a_process_without_rows_adds_nothing(
    tube_model: LearnedBody, tube_folds: np.ndarray
) -> None:
    """For example if the last batch is smaller than the number of processes."""
    network = GeometricNetwork(tube_model.embedding, 0, tube_folds)
    latent = torch.zeros((2, tube_model.latent_size))
    n_cells = len(network.skin.point_vertices) + len(tube_folds)
    sizes = (2, tube_model.embedding.n_domains), (2,), (2,), (2, n_cells)
    targets = Targets(*(torch.zeros(size) for size in sizes))
    none = latent[2:].requires_grad_()
    loss = network.loss(network(none), targets, (2, 2), PRESETS["default"], 0.0)
    assert loss == 0.0
    loss.backward()
    assert none.grad is not None
    for values in network.parameters():
        assert values.grad is not None
        assert (values.grad == 0.0).all()


def test_a_network_without_domains_is_the_paper_s_alone(tube_model: LearnedBody) -> None:
    config = replace(PRESETS["default"], by_domain=False)
    with pytest.raises(LCollisionError, match="--preset paper"):
        GeometricNetwork.build(tube_model.embedding, config)
