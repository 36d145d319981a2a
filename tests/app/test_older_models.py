"""Model files of the previous version are read, with the same results."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core import model_file
from lcollision_core.bodies import LearnedBody, sample_poses
from lcollision_core.embedding.bilevel import BOX_ARRAYS
from lcollision_core.model_file import Section, read_model_file, write_model_file
from lcollision_core.resolve import find_free_poses


def test_a_model_of_version_1_resolves_to_the_same_result(
    editor_model: LearnedBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It had no latent box: the box follows from its training codes."""
    old, new, again = (tmp_path / f"{name}.safetensors" for name in ("old", "new", "again"))
    free = find_free_poses(editor_model.embedding, editor_model.exact_check())
    editor_model.with_free_poses(free).save(new)
    sections = read_model_file(new)
    embedding = sections["embedding"]
    arrays = {name: held for name, held in embedding.arrays.items() if name not in BOX_ARRAYS}
    assert len(arrays) == len(embedding.arrays) - 2
    with monkeypatch.context() as patched:
        patched.setattr(model_file, "FORMAT_VERSION", 1)
        write_model_file(old, {**sections, "embedding": Section(arrays, embedding.metadata)})
    assert rb"format_version\":1" in old.read_bytes()

    models = [LearnedBody.load(path) for path in (old, new)]
    models[0].save(again)
    assert again.read_bytes() == new.read_bytes()
    assert rb"format_version\":3" in again.read_bytes()
    assert models[0].fingerprint == models[1].fingerprint
    assert np.array_equal(models[0].latent_space.low, 1.2 * models[0].known_poses.min(axis=0))
    (pose,) = sample_poses(models[0], 1, seed=0, colliding=True)
    before, after = (model.resolve(pose) for model in models)
    assert before.exactly_free
    assert not np.array_equal(before.latent, pose)
    assert np.array_equal(before.latent, after.latent)
    assert before.evaluations == after.evaluations
