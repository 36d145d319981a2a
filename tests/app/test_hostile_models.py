"""Model files with one field changed: refused in a short sentence, or working without a warning."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from app.cli.models import describe
from lcollision_core.bodies import LearnedBody
from lcollision_core.embedding.bilevel import EmbeddingMetrics
from lcollision_core.errors import LCollisionError, ModelFileError
from lcollision_core.labels import StoreIdentity
from lcollision_core.model_file import FORMAT_VERSION, Section, digest_of, read_model_file
from lcollision_core.predictor import (
    PRESETS,
    CollisionPredictor,
    TrainingFacts,
    score_rows,
)
from lcollision_core.predictor.geometric_network import GeometricNetwork
from lcollision_core.predictor.paper_network import PaperNetwork
from tests.app.support import Lcollision
from tests.core.labelled import labeller_of
from tests.core.predictor_rows import made_up_rows
from tests.hostile_values import VALUES, as_json, changed_arrays, places, with_value

Sections = dict[str, Section]

LONGEST_SENTENCE = 600
N_POINTS, WIDTH, N_MANY = 24, 4, 20


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Keep torch from waking its threads for a handful of numbers, thousands of times."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def sections(editor_model: LearnedBody) -> Sections:
    """Return the sections of a model that has all that a model can have."""
    return _whole(editor_model, "default")


@pytest.fixture(scope="module")
def paper_sections(editor_model: LearnedBody) -> Sections:
    """Return those of a model with the paper's predictor."""
    return _whole(editor_model, "paper")


def _whole(bare: LearnedBody, preset: str) -> Sections:
    embedding = bare.embedding
    errors = dict.fromkeys(EmbeddingMetrics.__dataclass_fields__, 0.01)
    metrics = EmbeddingMetrics(**(errors | {"pca_size": 3}))  # type: ignore[arg-type]
    embedding = replace(embedding, metrics=metrics)
    rows = made_up_rows(embedding, 200)
    if preset == "paper":
        network: torch.nn.Module = PaperNetwork(embedding.group_sizes, True, 0)
    else:
        sites = np.arange(36).reshape(3, 12)
        network = GeometricNetwork(embedding, 0, sites, N_POINTS, WIDTH)
        network._fit(embedding, rows.latent)
    facts = TrainingFacts(
        rows=200,
        training_rows=140,
        colliding_share=0.3,
        seed=0,
        energy_scale=1e-4,
        margin=0.5,
        store=StoreIdentity.of(labeller_of(bare), 0),
        logit_shift=0.1,
    )
    arrays = {name: array.numpy() for name, array in network.state_dict().items()}
    predictor = CollisionPredictor(embedding, arrays, PRESETS[preset], facts)
    predictor = replace(predictor, metrics=score_rows(predictor, rows).metrics())
    card = replace(bare.card, provenance={"command": ["train"], "seconds": 3.5})
    model = LearnedBody("whole", embedding, card).with_predictor(predictor)
    model = model.with_free_poses(0.1 * bare.known_poses[:3])
    arrays, metadata = embedding.to_arrays()
    return {
        **model._other_sections,
        "embedding": Section(arrays, metadata),
        "model": Section({}, card.to_metadata()),
    }


def _write(path: Path, sections: Sections) -> None:
    """Write a model file with a right checksum, whatever the sections hold."""
    tensors = {
        f"{section_name}/{name}": np.ascontiguousarray(array).reshape(array.shape)
        for section_name, section in sections.items()
        for name, array in section.arrays.items()
    }
    metadata = {name: dict(section.metadata) for name, section in sections.items()}
    described = as_json(metadata)
    checksum = digest_of(f"{FORMAT_VERSION}\n{described}\n", tensors)
    document = f'{{"format_version":{FORMAT_VERSION},"sections":{described},"sha256":"{checksum}"}}'
    path.write_bytes(save(tensors, metadata={"lcollision": document}))


def _describe(model: LearnedBody) -> None:
    json.dumps(describe(model), allow_nan=False)


def _decode_and_encode(model: LearnedBody) -> None:
    space = model.latent_space
    few = np.stack([0.0 * space.low, space.low, space.high, model.known_poses[-1]])
    vertices = model.decode(few)
    assert np.isfinite(vertices).all()
    assert model.detector.detect_batch(vertices.astype(np.float32)).n_pairs.min() >= 0
    try:
        encoded = model.encode(vertices[-1])
    except LCollisionError as error:
        assert len(str(error)) < LONGEST_SENTENCE  # noqa: PT017 - both are right
    else:
        assert np.isfinite(encoded.latent).all()


def _predict(model: LearnedBody) -> None:
    space = model.latent_space
    few = np.stack([0.0 * space.low, space.low, space.high])
    many = space.sample(N_MANY, np.random.default_rng(0))
    predictor = model.require_predictor()
    for found in (predictor.predict(few), predictor.predict(many)):
        assert np.isfinite(found.domain_energy).all()
        assert np.isfinite(found.collision_logit).all()
        assert (np.abs(found.collision_probability - 0.5) <= 0.5).all()
    logit, gradient = predictor.logit_and_gradient(few[:2])
    assert np.isfinite(logit).all()
    assert np.isfinite(gradient).all()
    assert model.resolver is not None


Use = Callable[[LearnedBody], None]
EVERY_USE: tuple[Use, ...] = (_describe, _decode_and_encode, _predict)

COMPUTED_WITH = {
    *("height", "up_axis", "near_exclusion", "scaling", "n_vertices", "n_domains"),
    *("preset", "by_domain", "energy_scale", "margin", "logit_shift"),
}
"""Metadata that more than a report depends on."""


def _works(path: Path, uses: tuple[Use, ...] = EVERY_USE) -> bool:
    """Use a model as the commands and the editor do; False if it is refused as it should be."""
    try:
        model = LearnedBody.load(path)
    except ModelFileError as error:
        sentence = str(error)
    else:
        for use in uses:
            use(model)
        return True
    assert str(path) in sentence
    assert "\n" not in sentence
    assert len(sentence) < len(str(path)) + LONGEST_SENTENCE, sentence
    sentence.encode()
    return False


def test_the_whole_model_works(
    sections: Sections, paper_sections: Sections, tmp_path: Path
) -> None:
    for whole in (sections, paper_sections):
        _write(tmp_path / "m.safetensors", whole)
        assert read_model_file(tmp_path / "m.safetensors").keys() == whole.keys()
        assert _works(tmp_path / "m.safetensors")


@pytest.mark.slow
def test_a_model_with_any_value_changed(sections: Sections, tmp_path: Path) -> None:
    path, n_working, n_changes = tmp_path / "m.safetensors", 0, 0
    for name, section in sections.items():
        metadata = json.loads(json.dumps(dict(section.metadata)))
        for place in places(metadata):
            for value in VALUES:
                changed = Section(section.arrays, with_value(metadata, place, value))
                _write(path, {**sections, name: changed})
                n_changes += 1
                is_computed_with = COMPUTED_WITH.intersection(place)
                n_working += _works(path, EVERY_USE if is_computed_with else (_describe,))
    assert n_changes > 2000
    # Of most fields a value of the table is another of their own.
    assert 100 < n_working < n_changes / 3


@pytest.mark.slow
@pytest.mark.parametrize("section_name", ["embedding", "free_poses", "predictor"])
def test_a_model_with_any_array_changed(
    section_name: str, sections: Sections, tmp_path: Path
) -> None:
    _change_every_array(section_name, sections, tmp_path / "m.safetensors")


@pytest.mark.slow
def test_a_paper_s_model_with_any_array_changed(paper_sections: Sections, tmp_path: Path) -> None:
    _change_every_array("predictor", paper_sections, tmp_path / "m.safetensors")


def _change_every_array(name: str, sections: Sections, path: Path) -> None:
    section = sections[name]
    uses = (_predict,) if name == "predictor" else EVERY_USE
    for array_name, array in section.arrays.items():
        n_refused = 0
        for _, changed in changed_arrays(array):
            others = {key: held for key, held in section.arrays.items() if key != array_name}
            held = others if changed is None else {**others, array_name: changed}
            _write(path, {**sections, name: Section(held, section.metadata)})
            n_refused += not _works(path, uses)
        assert n_refused > 12, array_name
    if name == "predictor":
        one_more = Section({**section.arrays, "x": np.ones(3)}, section.metadata)
        _write(path, {**sections, name: one_more})
        assert not _works(path, uses)


def test_a_damaged_model_is_listed_and_the_others_with_it(
    sections: Sections, tmp_path: Path, lcollision: Lcollision, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    folder = tmp_path / "lcollision" / "models"
    folder.mkdir(parents=True)
    _write(folder / "sound.safetensors", sections)
    card = dict(sections["model"].metadata)
    for value in (2.0, None, "x" * 10**6):
        changed = Section({}, {**card, "up_axis": value})
        _write(folder / f"odd {len(str(value))}.safetensors", {**sections, "model": changed})
    (folder / "a folder.safetensors").mkdir()
    result = lcollision("models")
    assert result.exit_code == 2
    assert "sound: 210 vertices" in result.stdout
    for name in ("odd 3", "odd 4", "odd 1000000", "a folder"):
        assert f"{name}: damaged (your own)\n" in result.stdout
        assert f"{folder / name}.safetensors " in result.stderr
    assert all(len(line) < LONGEST_SENTENCE + 200 for line in result.stderr.splitlines())
    result = lcollision("models", "--json")
    assert "sound" in [report["name"] for report in json.loads(result.stdout)]
