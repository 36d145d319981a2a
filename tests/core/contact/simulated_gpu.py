"""The GPU check against the CPU's; `test_gpu` runs it with a GPU simulated by Numba."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcollision_core import devices
from lcollision_core.bodies import open_body
from lcollision_core.bodies.motions import read_motions
from lcollision_core.bodies.scoring import check_poses
from lcollision_core.contact import STRICT, CollisionDetector, ContactRules, gpu_search
from lcollision_core.contact.kernels import N_KINDS
from lcollision_core.devices import Device, choose_device
from lcollision_core.embedding.gpu_decoder import GpuDecoder
from lcollision_core.errors import ShapeError
from lcollision_core.meshes import FaceGroup
from lcollision_core.on_gpu import SIMULATED
from tests.core.shapes import Mesh, grid, join, soup, sphere
from tests.core.simulator import poll_politely
from tests.small_models import SWING, stored

RULES = {
    "strict": STRICT,
    "near": ContactRules(near_exclusion=0.3),
    "rest": ContactRules(rest_exclusion=0.0),
    "joint": ContactRules(joint_exclusion=True),
    "ignored": ContactRules(ignored=(("ball", "sheet"),)),
    "tolerated": ContactRules(tolerated_depth=0.02),
    "touching": ContactRules(touching=((12, 40),), touching_radius=0.4),
    "shape": ContactRules(shape_touching=((35, 50),)),
}
ALL_RULES = ContactRules(
    0.3,
    0.0,
    (("loose", "ball"),),
    0.005,
    joint_exclusion=True,
    tolerated_pairs=(("ball", "sheet", 0.02),),
)


@pytest.fixture(autouse=True)
def _gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    assert SIMULATED
    poll_politely(monkeypatch)
    monkeypatch.setattr(devices, "_LEAST_POSES", 1)
    choose_device(Device.CPU)


def _bodies(
    rules: ContactRules, n_poses: int, seed: int = 5
) -> tuple[CollisionDetector, np.ndarray]:
    """Return a sheet, a ball in it, loose faces and an unused vertex, and poses of them."""
    rng = np.random.default_rng(seed)
    ball = sphere(0.3, 4).moved([0.5, 0.5, 0.1])
    mesh = join(grid(5), ball, soup(0.3 * rng.uniform(size=(4, 3, 3))))
    n_sheet, n_faces = len(grid(5).faces), len(mesh.faces)
    vertices = np.concatenate([mesh.vertices, [[9.0, 9.0, 9.0]]])
    rest = Mesh(vertices + rng.normal(scale=0.02, size=vertices.shape), mesh.faces)
    groups = (
        FaceGroup("sheet", np.arange(n_sheet)),
        FaceGroup("ball", np.arange(n_sheet, n_sheet + len(ball.faces))),
        FaceGroup("loose", np.arange(n_sheet + len(ball.faces), n_faces)),
        FaceGroup("elbow", np.arange(0, n_sheet + 8), about_joint=True),
    )
    scale = rng.uniform(0.0, 0.12, size=(n_poses, 1, 1))
    poses = rest.vertices + scale * rng.normal(size=(n_poses, *rest.vertices.shape))
    return CollisionDetector(rest.topology, rest.vertices, rules, groups), poses.astype(np.float32)


def _require_equal(detector: CollisionDetector, poses: np.ndarray, unit: float = 1.0) -> int:
    """Compare the results of both devices, and return how many pairs count."""
    choose_device(Device.CPU)
    batch, colliding = detector.detect_batch(poses), detector.are_colliding(poses, unit=unit)
    found = [detector.detect(pose) for pose in poses]
    choose_device(Device.CUDA)
    on_gpu = detector.detect_batch(poses)
    assert np.array_equal(on_gpu.n_pairs, batch.n_pairs)
    assert np.array_equal(on_gpu.n_excluded, batch.n_excluded)
    assert np.allclose(on_gpu.vertex_energy, batch.vertex_energy, rtol=1e-12, atol=1e-22)
    assert np.array_equal(detector.are_colliding(poses, unit=unit), colliding)
    listed = detector.gpu_search().list_pairs(poses)
    for number, one in enumerate(found):
        counted = (listed.pose == number) & (listed.rule == 0)
        excluded = (listed.pose == number) & (listed.rule > 0)
        assert np.array_equal(listed.pairs[counted], one.pairs)
        assert np.allclose(np.sqrt(listed.squared_depth[counted]), one.penetration_depth)
        assert np.array_equal(listed.pairs[excluded], one.excluded_pairs)
        assert np.array_equal(listed.rule[excluded], one.excluded_rule)
    return int(batch.n_pairs.sum())


def test_all_rules_together() -> None:
    detector, poses = _bodies(ALL_RULES, 8)
    poses = poses[-2:]
    assert _require_equal(detector, poses, unit=0.5) > 0
    assert (detector.detect_batch(poses).n_excluded.sum(axis=0) > 0).sum() >= 3


@pytest.mark.parametrize("rules", RULES.values(), ids=RULES)
def test_each_rule(rules: ContactRules) -> None:
    detector, poses = _bodies(rules, 8)
    # In the last of these, every rule excludes pairs.
    poses = poses[-2:]
    detector._uncounted.nodes(wait=True)
    assert _require_equal(detector, poses) > 0
    assert detector.detect_batch(poses).n_excluded.any() == (rules is not STRICT)
    counted = detector.detect_batch(poses, counted_only=True)
    assert counted.n_excluded.sum() == 0
    choose_device(Device.CPU)
    assert np.array_equal(counted.n_pairs, detector.detect_batch(poses).n_pairs)


def test_auto_takes_a_gpu_for_what_is_worth_it_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    detector, poses = _bodies(STRICT, 2)
    notes: list[str] = []
    choose_device(Device.AUTO, notes.append)
    monkeypatch.setattr(devices, "_LEAST_POSES", 2)
    expected = detector.are_colliding(poses)
    assert not notes
    monkeypatch.setattr(devices, "_WORTHWHILE", 100)
    # Any memory layout is accepted.
    flipped = np.asfortranarray(poses.astype(np.float64))
    assert np.array_equal(detector.are_colliding(flipped), expected)
    assert np.array_equal(detector.are_colliding(poses[:1]), expected[:1])
    assert np.array_equal(detector.are_colliding(poses), expected)
    (note,) = notes
    assert "on the GPU" in note


def test_candidates_that_overflow_are_found_again_and_what_is_refused_is_left() -> None:
    detector, poses = _bodies(STRICT, 3)
    search = detector.gpu_search()
    counts = np.zeros((2, 3, N_KINDS), dtype=np.int64)
    assert search.count(poses, counts[0]) == []
    search.candidate_capacity = 2
    assert search.count(poses, counts[1]) == []
    assert np.array_equal(counts[1], counts[0])
    assert search.candidate_capacity > 2
    poses[2, 1, 2] = np.nan
    assert search.count(poses, np.zeros((3, N_KINDS), dtype=np.int64)) == [2]
    choose_device(Device.CUDA)
    with pytest.raises(ShapeError, match="vertex 1 of pose 2 is not finite"):
        detector.are_colliding(poses)


def test_poses_with_too_many_candidates_are_checked_by_the_processor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    detector, poses = _bodies(STRICT, 4)
    expected = detector.detect_batch(poses)
    monkeypatch.setattr(gpu_search, "MOST_BYTES", 8 * 105)
    search = detector.gpu_search()
    search.candidate_capacity = 30
    assert 0 < len(search.count(poses, np.zeros((4, N_KINDS), dtype=np.int64))) < 4
    choose_device(Device.CUDA)
    found = detector.detect_batch(poses)
    assert np.array_equal(found.n_pairs, expected.n_pairs)
    assert np.allclose(found.vertex_energy, expected.vertex_energy, rtol=1e-12, atol=1e-22)


def test_energies_of_cells() -> None:
    detector, poses = _bodies(STRICT, 4)
    folds = detector.with_rules(RULES["joint"], detector.groups)
    of_vertices = np.arange(detector.topology.n_vertices, dtype=np.int32)
    cells = np.stack([of_vertices % 7, 7 + of_vertices % 5])
    expected = detector.cell_energies(poses, folds, cells, 12)
    choose_device(Device.CUDA)
    found = detector.cell_energies(poses, folds, cells, 12)
    assert (expected > 0.0).any(axis=0).all()
    assert np.allclose(found, expected, rtol=1e-12, atol=1e-22)


def test_sums_do_not_depend_on_the_order() -> None:
    detector, poses = _bodies(STRICT, 3)
    choose_device(Device.CUDA)
    energy = detector.detect_batch(poses).vertex_energy
    for order in ([2, 0, 1], [1, 2, 0]):
        assert np.array_equal(detector.detect_batch(poses[order]).vertex_energy, energy[order])


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n_faces=st.integers(1, 20), scale=st.floats(1e-3, 1e3))
def test_any_loose_faces(seed: int, n_faces: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    mesh = soup(scale * rng.uniform(size=(n_faces, 3, 3)))
    detector = CollisionDetector(mesh.topology, mesh.vertices)
    poses = mesh.vertices + scale * rng.normal(scale=0.3, size=(3, *mesh.vertices.shape))
    _require_equal(detector, poses)


def test_decoded_codes_are_the_processors_to_the_bit() -> None:
    model = stored("tube")
    codes = model.embedding.box.draw(0, 0)[:2]
    found = GpuDecoder(model.embedding, model.body_size).decode(codes).copy_to_host()
    assert np.array_equal(found, (model.embedding.decode(codes) * model.body_size).astype("f4"))


def test_labels_of_codes() -> None:
    labeller = stored("tube").labeller()
    labeller.detector._uncounted.nodes(wait=True)
    expected = labeller.label_rows(3, range(4))
    assert 0 < expected.colliding.sum() < 4
    choose_device(Device.CUDA)
    found = labeller.label_rows(3, range(4))
    assert np.array_equal(found.latent, expected.latent)
    assert np.array_equal(found.n_pairs, expected.n_pairs)
    assert np.allclose(found.energy, expected.energy, rtol=1e-12, atol=1e-20)
    assert np.allclose(found.domain_energy, expected.domain_energy, rtol=1e-12, atol=1e-20)
    broken = found.latent[:2].copy()
    broken[1] = np.nan
    with pytest.raises(ShapeError, match="not finite"):
        labeller.label(broken)


def test_skinned_vertices_are_the_processors_to_the_bit() -> None:
    body = open_body(str(SWING))
    codes = body.sample(3, np.random.default_rng(0))
    decoder = body.space.gpu_decoder(body.card.height)
    assert decoder is not None
    found = decoder.decode(codes).copy_to_host()
    assert np.array_equal(found, body.decode(codes).astype(np.float32))


def test_codes_to_verdicts_stay_on_the_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    body = open_body(str(SWING))
    (motion, *_), check = read_motions(body, SWING), body.exact_check()
    frames = list(range(0, len(motion), len(motion) // 3))
    expected = motion.collide(frames, check)
    assert 0 < expected.sum() < len(frames)
    assert np.array_equal(check_poses(body, motion.codes[frames]).colliding, expected)
    choose_device(Device.CUDA)
    monkeypatch.setattr(type(body.space), "decode", None)
    assert np.array_equal(motion.collide(frames, check), expected)
    assert np.array_equal(check_poses(body, motion.codes[frames]).colliding, expected)
