"""Files that are no files, that lie about their sizes, or that would fill the memory."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, NamedPose, read_poses, write_poses
from lcollision_core.errors import LCollisionError
from lcollision_core.files import read_mesh, read_pose_set
from lcollision_core.files.safe import open_regular
from lcollision_core.files.table import READABLE_SUFFIXES
from lcollision_core.meshes import RigidTransform
from lcollision_core.model_file import read_model_file
from tests.core.background import wait_for_tables
from tests.hostile_values import UNPLAIN_FILES, VALUES, as_json, places, with_value


def _readers(model: LearnedBody) -> dict[str, Callable[[Path], Any]]:
    return {
        **dict.fromkeys(READABLE_SUFFIXES, read_mesh),
        ".npz": read_pose_set,
        ".safetensors": read_model_file,
        ".json": lambda path: read_poses(path, model),
        "": open_regular,
    }


@pytest.mark.parametrize("kind", UNPLAIN_FILES)
def test_what_is_no_plain_file_is_never_opened(
    kind: str, tmp_path: Path, tube_model: LearnedBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pipe would wait for its writer for ever, a device never end."""
    monkeypatch.chdir(tmp_path)  # Sockets have short names only.
    for suffix, read in _readers(tube_model).items():
        path = Path(f"f{suffix}")
        if kind == "a folder" and suffix == ".npz":
            continue  # A folder is a pose set of another form.
        UNPLAIN_FILES[kind](path)
        with pytest.raises((LCollisionError, OSError)) as caught:
            read(path)
        assert f"it is {kind}, not a plain file" in str(caught.value)
        assert "\n" not in str(caught.value)


def _peak(work: Callable[[], object]) -> int:
    """Return the most bytes that a call took at a time."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        wait_for_tables()
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize(
    "content",
    [
        b"[" + b"{}," * 4_000_000 + b"{}]",
        b"[" + b"[]," * 7_000_000 + b"[]]",
        b"[" + b'"ab",' * 6_000_000 + b"0]",
        b"[" * 100_000,
    ],
)
def test_json_that_would_fill_the_memory_is_refused(
    content: bytes, tmp_path: Path, tube_model: LearnedBody
) -> None:
    path = tmp_path / "poses.json"
    path.write_bytes(content)

    def read() -> None:
        with pytest.raises(LCollisionError, match=r"poses\.json is not JSON \(") as caught:
            read_poses(path, tube_model)
        assert len(str(caught.value)) < 400

    assert _peak(read) < 4 * len(content) + 10**6


@pytest.mark.slow
def test_poses_with_any_value_changed(tube_model: LearnedBody, tmp_path: Path) -> None:
    path = tmp_path / "poses.json"
    placement = RigidTransform(np.eye(3), np.zeros(3))
    poses = [
        NamedPose("a", 0.1 * tube_model.known_poses[0]),
        NamedPose("b", tube_model.known_poses[1], placement, 0.01, 0.02),
    ]
    write_poses(path, tube_model, poses)
    document = json.loads(path.read_text())
    n_working = n_changes = 0
    for place in places(document):
        for value in VALUES:
            path.write_text(as_json(with_value(document, place, value)))
            n_changes += 1
            try:
                read = read_poses(path, tube_model)
            except LCollisionError as error:
                sentence = str(error)
            else:
                n_working += 1
                for pose in read:
                    assert np.isfinite(tube_model.decode(pose.latent)).all()
                continue
            assert str(path) in sentence
            assert "\n" not in sentence
            assert len(sentence) < len(str(path)) + 600
    assert n_changes > 300
    assert 30 < n_working < n_changes / 2
