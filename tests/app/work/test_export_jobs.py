"""The window's exports: into the user's own file, and motions, each checked when written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core import bodies as model_package
from lcollision_core.bodies import (
    ExportRequest,
    LearnedBody,
    NamedPose,
    RigBody,
    open_body,
    sample_poses,
)
from lcollision_core.bodies.motions import read_motions
from lcollision_core.errors import CancelledError
from lcollision_core.files import read_character
from lcollision_core.files.motion.caches import read_point_cache
from lcollision_core.jobs import Job
from lcollision_core.motion import Motion
from lcollision_core.tasks.exporting import export, export_clips, export_frames, frame_files
from tests.core.character_file import figure
from tests.core.fbx_builder import character_fbx
from tests.core.motion.swings import CLIP, swinging_body


@pytest.fixture
def character(tmp_path: Path) -> RigBody:
    return RigBody.of(read_character(figure().write(tmp_path / "figure.glb")))


@pytest.fixture(scope="module")
def body() -> LearnedBody:
    return LearnedBody.load("body")


@pytest.mark.parametrize("form", [None, "joints", "mesh", "morph"])
def test_a_pose_goes_into_the_character_s_own_file(
    character: RigBody, tmp_path: Path, form: str | None
) -> None:
    latent = np.where(character.space.joint_of_code > 0, character.space.high, 0.1)
    path = tmp_path / "posed.glb"
    told = export(
        character,
        NamedPose("bow", latent),
        None,
        path,
        ExportRequest(form=form),
    )
    again = read_character(path)
    vertices = np.empty_like(character.reference)
    vertices[character.character.joined] = again.rest_vertices[again.joined]
    n_pairs = len(character.detector.detect(vertices).pairs)
    assert n_pairs > 1
    verdict = f"{n_pairs} pairs of its triangles collide"
    assert told.startswith(f"Exported posed.glb: {verdict}; ")
    # Every verdict states what the rules leave out.
    assert "are not counted; clips left out, as they would hide the pose: wave" in told
    assert np.abs(vertices - character.decode(latent)).max() < 1e-5


def test_a_motion_says_how_many_of_its_frames_collide(body: LearnedBody, tmp_path: Path) -> None:
    free = body.known_poses[:3]
    colliding = sample_poses(body, 2, seed=0, colliding=True)
    steps: list[tuple[int, int]] = []
    for name, latent, verdict in (
        ("free.pc2", free, "no collisions (checked)"),
        ("worst.mdd", colliding[:1], "1 of 1 frame collides"),
        ("bad.mdd", np.concatenate([free, colliding]), "2 of 5 frames collide"),
    ):
        told = export_frames(
            body,
            Motion("run", np.arange(len(latent)) / 10.0, latent),
            tmp_path / name,
            ExportRequest("maya", fps=10.0),
            Job(lambda done, all_of_them: steps.append((done, all_of_them))),
        )
        assert told == f"Exported {name}: {verdict}"
        frames = read_point_cache(tmp_path / name)
        drawn = np.stack([body.exported_vertices(row) for row in latent])
        expected = 100.0 * drawn.astype(float)[:, :, [0, 2, 1]] * [1.0, 1.0, -1.0]
        np.testing.assert_array_equal(frames, expected.astype(np.float32))
    assert steps[-1] == (5, 5)


def test_a_motion_of_a_character_is_one_file_for_each_of_its_meshes(
    character: RigBody, tmp_path: Path
) -> None:
    folded = np.where(character.space.joint_of_code > 0, character.space.high, 0.0)
    motion = Motion("run", np.arange(2) / 30.0, np.stack([0.0 * folded, folded]))
    caches, clip = (
        export_frames(character, motion, tmp_path / name, ExportRequest(), Job())
        for name in ("run.pc2", "run.glb")
    )
    assert caches == "Exported run Body.pc2, run Core.pc2, run Hat.pc2: 1 of 2 frames collides"
    assert read_point_cache(tmp_path / "run Hat.pc2").shape[0] == 2
    assert clip.startswith("Exported run.glb: 1 of 2 frames collides; clips left out: wave, walk")
    frames = read_character(tmp_path / "run.glb").sample("poses", None)
    assert np.abs(frames.vertices - character.decode(motion.codes)).max() < 1e-5


def test_the_user_s_file_is_read_once_for_a_motion(
    character: RigBody, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, motion = (
        tmp_path / "run.pc2",
        Motion("run", np.zeros(1), np.zeros((1, character.latent_size))),
    )
    files, source = frame_files(character, path, ExportRequest())
    monkeypatch.setattr(model_package, "source_for", None)
    export_frames(character, motion, path, ExportRequest(), Job(), source=source)
    assert len(files) == 3
    assert all(file.exists() for file in files)


def test_a_cancelled_motion_leaves_nothing(body: LearnedBody, tmp_path: Path) -> None:
    job = Job()
    job.cancel()
    motion = Motion("run", np.zeros(1), body.known_poses[:1])
    with pytest.raises(CancelledError):
        export_frames(body, motion, tmp_path / "run.pc2", ExportRequest(), job.part())
    assert not list(tmp_path.iterdir())


def test_the_timeline_of_an_fbx_goes_into_a_rigged_glb_and_that_is_told(tmp_path: Path) -> None:
    pytest.importorskip("ufbx")
    file = character_fbx(swinging_body(), tmp_path / "hero.fbx")
    model, out = open_body(file), tmp_path / "hero.glb"
    (original,) = read_motions(model, file, CLIP)
    codes = original.codes.copy()
    codes[10:20] = 0.0
    changes = [(original, replace(original, codes=codes))]
    told = export_clips(model, file, changes, out)
    assert told.startswith("Exported hero.glb: ")
    assert "FBX can't be written, so hero.fbx comes back as GLB" in told
    frames = read_character(out).sample(CLIP, 30.0).vertices
    expected = 0.01 * model.decode(codes[15])[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    assert np.abs(frames[15] - expected).max() < 1e-5 * np.ptp(expected)
