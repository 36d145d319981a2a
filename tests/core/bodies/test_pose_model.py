"""The model: decoding, encoding, names, files."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, sample_poses
from lcollision_core.embedding import LatentBox
from lcollision_core.errors import LCollisionError, ModelFileError, PoseSetError, ShapeError
from lcollision_core.files import PoseSet
from lcollision_core.meshes import Topology
from lcollision_core.model_file import Section, read_model_file, write_model_file
from tests.bending_tube import LENGTH_IN_FILES
from tests.core.labelled import labeller_of
from tests.core.shapes import random_rotation


@pytest.fixture
def model(tube_model: LearnedBody) -> LearnedBody:
    return tube_model


@pytest.fixture
def poses(tube_poses: PoseSet) -> PoseSet:
    return tube_poses


@pytest.fixture
def path(model: LearnedBody, tmp_path: Path) -> Path:
    path = tmp_path / "tube.safetensors"
    model.save(path)
    return path


def _box(model: LearnedBody, n_poses: int, seed: int = 7) -> np.ndarray:
    return model.latent_space.sample(n_poses, np.random.default_rng(seed))


def test_a_pose_has_the_same_bits_alone_in_a_batch_and_in_a_thread(model: LearnedBody) -> None:
    latent = _box(model, 21)
    batch = model.decode(latent)
    alone = np.stack([model.decode(row) for row in latent])
    assert batch.shape == (21, model.n_vertices, 3)
    assert np.array_equal(batch, alone)
    assert np.array_equal(model.decode(latent, n_threads=1), alone)
    with ThreadPoolExecutor(4) as pool:
        assert np.array_equal(np.stack(list(pool.map(model.decode, latent))), alone)
    assert np.ptp(batch, axis=0).max() > 0.1 * model.body_size


def test_no_pose_is_a_batch_too(model: LearnedBody) -> None:
    assert model.decode(np.empty((0, model.latent_size))).shape == (0, model.n_vertices, 3)


def test_decoded_training_poses_are_the_training_poses(model: LearnedBody, poses: PoseSet) -> None:
    metrics = model.embedding.metrics
    assert metrics is not None
    assert metrics.mean < 0.003
    errors = []
    for latent, vertices in zip(model.known_poses, poses.vertices, strict=True):
        encoded = model.encode(vertices)
        back = encoded.placement.apply(model.decode(latent))
        errors.append(np.linalg.norm(back - vertices, axis=1).mean() / LENGTH_IN_FILES)
    assert np.mean(errors) == pytest.approx(metrics.mean, rel=0.3)


def test_decoded_reference_lies_where_the_reference_does(
    model: LearnedBody, poses: PoseSet
) -> None:
    assert np.allclose(model.reference, poses.vertices[0])
    moved = model.decode(model.known_poses[0]) - poses.vertices[0]
    assert np.abs(moved).max() < 0.03 * LENGTH_IN_FILES


def test_a_decoded_mesh_that_was_moved_gives_its_code_back(model: LearnedBody) -> None:
    rng = np.random.default_rng(2)
    for latent in (*_box(model, 6), *model.known_poses[:3]):
        decoded = model.decode(latent)
        moved = decoded @ random_rotation(rng).T + rng.uniform(-500, 500, 3)
        encoded = model.encode(moved)
        assert encoded.latent == pytest.approx(latent, abs=1e-4 * np.abs(latent).max())
        assert encoded.fit_error_max < 1e-6
        placed = encoded.placement.apply(model.decode(encoded.latent))
        assert np.abs(placed - moved).max() < 1e-6 * LENGTH_IN_FILES


def test_a_rigid_motion_changes_the_placement_and_not_the_code(model: LearnedBody) -> None:
    rng = np.random.default_rng(4)
    foreign = model.decode(_box(model, 1)[0])
    # Outside the latent space, so that the fit has to compromise.
    foreign = foreign + rng.normal(0.0, 0.002 * LENGTH_IN_FILES, foreign.shape)
    still = model.encode(foreign)
    assert 1e-3 < still.fit_error_mean < 5e-3
    rotation, shift = random_rotation(rng), rng.uniform(-500, 500, 3)
    moved = model.encode(foreign @ rotation.T + shift)
    assert moved.latent == pytest.approx(still.latent, abs=1e-4 * np.abs(still.latent).max())
    assert moved.fit_error_mean == pytest.approx(still.fit_error_mean, rel=1e-5)
    expected = still.placement.apply(model.decode(still.latent)) @ rotation.T + shift
    placed = moved.placement.apply(model.decode(moved.latent))
    assert np.abs(placed - expected).max() < 1e-4 * LENGTH_IN_FILES


def test_fit_error_is_the_distance_from_the_mesh_in_heights(model: LearnedBody) -> None:
    rng = np.random.default_rng(8)
    mesh = model.decode(_box(model, 1)[0]) + rng.normal(0.0, 0.5, (model.n_vertices, 3))
    encoded = model.encode(mesh)
    placed = encoded.placement.apply(model.decode(encoded.latent))
    distances = np.linalg.norm(placed - mesh, axis=1) / LENGTH_IN_FILES
    assert encoded.fit_error_mean == pytest.approx(distances.mean(), rel=1e-5)
    assert encoded.fit_error_max == pytest.approx(distances.max(), rel=1e-5)


def test_fitted_code_is_a_minimum(model: LearnedBody) -> None:
    """No small change of a single code fits a foreign mesh noticeably better."""
    rng = np.random.default_rng(9)
    mesh = model.decode(_box(model, 1)[0])
    mesh = mesh + rng.normal(0.0, 0.002 * LENGTH_IN_FILES, mesh.shape)
    encoded = model.encode(mesh)

    def squared_distance(latent: np.ndarray) -> float:
        offset = encoded.placement.apply(model.decode(latent)) - mesh
        return float((offset**2).sum(axis=1).mean())

    best = squared_distance(encoded.latent)
    for code in range(model.latent_size):
        for step in (-0.04, 0.04):
            tried = encoded.latent.copy()
            tried[code] += step * model.latent_space.high[code]
            assert squared_distance(tried) > 0.999 * best


def test_shapes_and_numbers_that_do_not_fit_are_refused(model: LearnedBody) -> None:
    bad_latents = (
        np.zeros(model.latent_size + 1),
        np.zeros((2, 2, model.latent_size)),
        np.zeros(()),
        np.full(model.latent_size, np.nan),
    )
    for latent in bad_latents:
        with pytest.raises(ShapeError):
            model.decode(latent)
    vertices = np.array(model.reference)
    with pytest.raises(ShapeError, match="shape"):
        model.encode(vertices[:-1])
    vertices[5, 1] = np.inf
    with pytest.raises(ShapeError, match=r"vertex 5 .*not finite"):
        model.encode(vertices)


def test_latent_space_names_every_code_and_straddles_zero(model: LearnedBody) -> None:
    space = model.latent_space
    assert [group.name for group in space.groups] == ["Whole body", *model.domain_names]
    assert [group.colour for group in space.groups] == [None, *model.card.domain_colours]
    covered = np.concatenate([np.arange(space.size)[group.codes] for group in space.groups])
    assert np.array_equal(covered, np.arange(model.latent_size))
    for group in space.groups:
        assert len(group.code_names) == group.codes.stop - group.codes.start
    assert space.groups[0].code_names == model.domain_names
    assert space.groups[0].full_name(1) == model.domain_names[1]
    assert space.groups[1].full_name(2) == f"{model.domain_names[0]}, motion 3"
    assert (space.low < 0).all()
    assert (space.high > 0).all()
    # Divided by 1.2, the box's limits may be rounded to within the training codes.
    assert (1.2 * model.known_poses >= space.low).all()
    assert (1.2 * model.known_poses <= space.high).all()
    sampled = _box(model, 2000)
    assert (sampled >= space.low).all()
    assert (sampled <= space.high).all()
    assert (sampled.min(axis=0) < 0.95 * space.low).all()
    assert (sampled.max(axis=0) > 0.95 * space.high).all()


def test_what_a_model_gives_cannot_be_written_to(model: LearnedBody) -> None:
    space = model.latent_space
    for array in (
        model.faces,
        model.reference,
        model.attention_mask,
        model.known_poses,
        space.low,
        space.high,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_labelled_parts_name_the_domains_from_top_to_bottom(model: LearnedBody) -> None:
    assert set(model.domain_names) == {"left shin", "left thigh"}
    along = model.reference[:, model.up_axis]
    level = model.attention_mask @ along / model.attention_mask.sum(axis=1)
    assert (
        level[model.domain_names.index("left shin")] < level[model.domain_names.index("left thigh")]
    )


def test_unlabelled_domains_are_numbered(model: LearnedBody, poses: PoseSet) -> None:
    plain = replace(poses, vertex_labels=None, source=Path("/data/some tube.npz"))
    other = LearnedBody.from_training("plain", model.embedding, plain)
    assert other.domain_names == ("part 1", "part 2")
    assert other.card.source == "some tube.npz"


def test_file_holds_all_that_a_front_end_needs(model: LearnedBody, path: Path) -> None:
    loaded = LearnedBody.load(path)
    latent = _box(model, 5)
    assert np.array_equal(loaded.decode(latent), model.decode(latent))
    mesh = model.decode(latent[0]) + 1.0
    assert np.array_equal(loaded.encode(mesh).latent, model.encode(mesh).latent)
    assert loaded.card == model.card
    assert loaded.embedding.metrics == model.embedding.metrics
    assert loaded.name == "tube"
    assert loaded.fingerprint == model.fingerprint
    assert loaded.topology == model.topology
    assert np.array_equal(loaded.attention_mask, model.attention_mask)
    assert np.array_equal(loaded.known_poses, model.known_poses)
    assert (loaded.body_size, loaded.up_axis) == (pytest.approx(LENGTH_IN_FILES), 1)
    again = path.with_name("again.safetensors")
    loaded.save(again)
    assert again.read_bytes() == path.read_bytes()


def test_renaming_is_kept_and_leaves_the_latent_space_alone(model: LearnedBody, path: Path) -> None:
    renamed = LearnedBody.load(path).edit_domains({1: "  Schwanz ☃ "})
    renamed.save(path)
    loaded = LearnedBody.load(path)
    assert loaded.domain_names == (model.domain_names[0], "Schwanz ☃")
    assert loaded.latent_space.groups[2].name == "Schwanz ☃"
    assert loaded.fingerprint == model.fingerprint
    assert model.domain_names[1] != "Schwanz ☃"


@pytest.mark.parametrize("name", ["", "  ", "a\nb", "x" * 61, "\x07"])
def test_names_that_cannot_be_shown_are_refused(model: LearnedBody, name: str) -> None:
    with pytest.raises(ModelFileError, match="cannot name a domain"):
        model.edit_domains({0: name})


def test_taken_names_and_missing_domains_are_refused(model: LearnedBody) -> None:
    first, second = model.domain_names
    with pytest.raises(ModelFileError, match="two domains would be called"):
        model.edit_domains({0: second})
    assert model.edit_domains({0: first}).domain_names == (first, second)
    assert model.edit_domains({0: second, 1: first}).domain_names == (second, first)
    for domain in (-1, 2):
        with pytest.raises(ModelFileError, match="domains are 1 to 2"):
            model.edit_domains({domain: "tail"})


@pytest.mark.parametrize("scale", [0.0, 0.01, 0.75, 1.5, 3.28, 100.0, 1e150])
def test_meshes_in_another_unit_are_refused(model: LearnedBody, scale: float) -> None:
    with pytest.raises(PoseSetError, match="times as large as the body of 'tube'"):
        model.encode(scale * model.reference)


def test_meshes_that_are_no_pose_are_fitted_as_well_as_may_be(model: LearnedBody) -> None:
    """Flat and mirrored meshes get finite codes and a large fit error."""
    mesh = model.decode(_box(model, 1)[0])
    for foreign in (
        mesh * [1.0, 0.0, 1.0],
        mesh * [0.0, 1.0, 0.0],
        mesh * [-1.0, 1.0, 1.0] + [0.0, 0.0, 1e6],
    ):
        encoded = model.encode(foreign)
        assert np.isfinite(encoded.latent).all()
        assert encoded.fit_error_max > encoded.fit_error_mean > 0.001


def test_another_order_of_vertices_is_refused(model: LearnedBody) -> None:
    rng = np.random.default_rng(0)
    mesh = model.decode(_box(model, 1)[0])
    for foreign in (
        mesh[rng.permutation(len(mesh))],
        rng.normal(0.0, LENGTH_IN_FILES, mesh.shape),
    ):
        with pytest.raises(PoseSetError, match="as if in another vertex order"):
            model.encode(foreign)


def test_sections_of_later_programs_survive_a_renaming(path: Path) -> None:
    later = Section({"bones": np.arange(4, dtype=np.int32)}, {"kind": "later"})
    write_model_file(path, read_model_file(path) | {"skeleton": later})
    LearnedBody.load(path).edit_domains({0: "tail"}).save(path)
    kept = read_model_file(path)["skeleton"]
    assert kept.metadata == later.metadata
    assert np.array_equal(kept.arrays["bones"], later.arrays["bones"])


@pytest.mark.parametrize("section", ["embedding", "model"])
def test_missing_sections_are_named(path: Path, section: str) -> None:
    sections = read_model_file(path)
    del sections[section]
    write_model_file(path, sections)
    with pytest.raises(ModelFileError, match=rf"{path}.*section '{section}'"):
        LearnedBody.load(path)


@pytest.mark.parametrize(
    "change",
    [
        {"height": 0.0},
        {"height": "tall"},
        {"up_axis": 3},
        {"near_exclusion": 1.5},
        {"domain_names": ["one"]},
        {"domain_names": ["same", "same"]},
        {"domain_names": [1, 2]},
        {"domain_names": None},
        {"domain_colours": ["red", "blue"]},
        {"pose_names": ["too few"]},
        {"licence": None},
        {"provenance": []},
    ],
)
def test_cards_that_do_not_fit_are_refused(path: Path, change: dict[str, object]) -> None:
    sections = read_model_file(path)
    sections["model"] = Section({}, {**sections["model"].metadata, **change})
    write_model_file(path, sections)
    with pytest.raises(ModelFileError, match=f"^{path} is unusable"):
        LearnedBody.load(path)


def test_embeddings_that_do_not_fit_are_refused(path: Path) -> None:
    sections = read_model_file(path)
    embedding = sections["embedding"]
    assert len(embedding.arrays) > 10
    for name, array in embedding.arrays.items():
        lacking = {key: value for key, value in embedding.arrays.items() if key != name}
        shorter = {**embedding.arrays, name: array[:-1]}
        # With a face less, the mesh is still valid.
        for arrays in [lacking] if name == "faces" else [lacking, shorter]:
            write_model_file(path, {**sections, "embedding": Section(arrays, embedding.metadata)})
            with pytest.raises(ModelFileError, match=f"^{path} is unusable"):
                LearnedBody.load(path)


def test_another_latent_space_has_another_fingerprint(model: LearnedBody, poses: PoseSet) -> None:
    weights = model.embedding.level1
    changed = weights.components.copy()
    changed[0, 0, 0] = np.nextafter(changed[0, 0, 0], np.float32(2.0))
    embedding = replace(model.embedding, level1=replace(weights, components=changed))
    other = LearnedBody.from_training("tube", embedding, poses)
    assert other.fingerprint != model.fingerprint
    assert len(model.fingerprint) == 16


def test_faces_may_come_in_another_order_but_not_be_others(model: LearnedBody) -> None:
    faces = np.array(model.faces)
    shuffled = np.roll(faces[np.random.default_rng(1).permutation(len(faces))], 1, axis=1)
    model.require_topology(Topology(shuffled, model.n_vertices), "shuffled.obj")
    flipped = faces.copy()
    flipped[0] = flipped[0, ::-1]
    with pytest.raises(PoseSetError, match=r"flipped.obj has other faces"):
        model.require_topology(Topology(flipped, model.n_vertices), "flipped.obj")
    with pytest.raises(PoseSetError, match=r"fewer.obj has \d+ faces"):
        model.require_topology(Topology(faces[1:], model.n_vertices), "fewer.obj")
    with pytest.raises(PoseSetError, match=r"more.obj has \d+ vertices"):
        model.require_topology(Topology(faces, model.n_vertices + 1), "more.obj")


@pytest.mark.parametrize(
    ("n_poses", "generator", "sentence"),
    [
        (-1, np.random.default_rng(0), "the number of poses must be at least 0, got -1"),
        (3, 0, "the generator must be one of NumPy, such as np.random.default_rng(0), got 0"),
    ],
)
def test_what_cannot_be_sampled_is_refused_in_a_sentence(
    model: LearnedBody, n_poses: int, generator: Any, sentence: str
) -> None:
    with pytest.raises(LCollisionError) as refused:
        model.sample(n_poses, generator)
    assert str(refused.value) == sentence


@pytest.mark.parametrize("colliding", [True, False])
def test_sampled_poses_are_of_the_kind_asked_for(model: LearnedBody, colliding: bool) -> None:
    everything = sample_poses(model, 64, seed=3)
    share = model.detector.are_colliding(model.decode(everything)).mean()
    assert 0.05 < share < 0.95
    latent = sample_poses(model, 30, seed=3, colliding=colliding)
    for row in latent:
        # A separate check of each exported mesh, not the batch check of the sampling.
        found = model.detector.detect(model.decode(row).astype(np.float32))
        assert found.colliding == colliding
    assert np.array_equal(latent[:20], sample_poses(model, 20, seed=3, colliding=colliding))
    assert not np.array_equal(latent[0], sample_poses(model, 1, seed=4, colliding=colliding)[0])


def test_sampling_gives_up_in_a_sentence(
    model: LearnedBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lcollision_core.bodies.scoring._MOST_MISSES", 128)
    # Poses this near to the mean are all free.
    box = model.embedding.box
    calm = replace(model.embedding, box=LatentBox(0.01 * box.low, 0.01 * box.high))
    calm_model = LearnedBody("calm", calm, model.card)
    with pytest.raises(LCollisionError, match="no colliding pose in 128 samples"):
        sample_poses(calm_model, 1, seed=0, colliding=True)


def test_models_of_programs_with_other_training_options_still_load(path: Path) -> None:
    sections = read_model_file(path)
    embedding = sections["embedding"]
    config = {**embedding.metadata["config"], "an_option_of_later": [1, 2]}
    del config["level2_rate"]
    metadata = {**embedding.metadata, "config": config}
    sections["embedding"] = Section(embedding.arrays, metadata)
    write_model_file(path, sections)
    before = LearnedBody.load(path)
    before.edit_domains({0: "tail"}).save(path)
    assert read_model_file(path)["embedding"].metadata["config"] == config
    assert LearnedBody.load(path).fingerprint == before.fingerprint


def test_the_box_is_kept_in_the_file_and_is_no_part_of_the_fingerprint(
    model: LearnedBody, path: Path
) -> None:
    box = LatentBox(2.0 * model.embedding.box.low, 3.0 * model.embedding.box.high)
    wider = LearnedBody("wider", replace(model.embedding, box=box), model.card)
    wider.save(path)
    loaded = LearnedBody.load(path)
    assert np.array_equal(loaded.latent_space.low, box.low)
    assert np.array_equal(loaded.latent_space.high, box.high)
    assert np.array_equal(labeller_of(loaded).label_rows(0, range(2)).latent, box.draw(0, 0)[:2])
    assert loaded.fingerprint == wider.fingerprint == model.fingerprint


def test_a_box_that_is_none_is_refused(model: LearnedBody, path: Path) -> None:
    model.save(path)
    sections = read_model_file(path)
    arrays = dict(sections["embedding"].arrays)
    low, high = arrays["box_low"], arrays["box_high"]
    for changes, sentence in (
        ({"box_low": high, "box_high": low}, "must lie below 0 and above 0"),
        ({"box_low": 0.0 * low}, "must lie below 0 and above 0"),
        ({"box_high": high[1:]}, "its array box_high must be"),
        ({"box_low": low.astype(np.float32)}, "its array box_low must be"),
        ({"box_high": 1e9 * high}, "its array box_high holds"),
        ({"box_high": None}, "its array box_high is missing"),
    ):
        held = {key: array for key, array in {**arrays, **changes}.items() if array is not None}
        section = Section(held, sections["embedding"].metadata)
        write_model_file(path, {**sections, "embedding": section})
        with pytest.raises(ModelFileError, match=sentence):
            LearnedBody.load(path)
