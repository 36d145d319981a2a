"""Damaged clips of every kind: each is read, or refused in one sentence that names it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import RigBody
from lcollision_core.bodies.motions import body_of_motion, read_motions
from lcollision_core.errors import LCollisionError
from lcollision_core.files.motion.caches import write_point_cache
from tests.core.bodies.test_generated import posed
from tests.core.bodies.test_retargeting import as_vrma, of_rig
from tests.core.fbx_builder import character_fbx
from tests.core.motion.swings import CLIP, swinging_body
from tests.rigged_shapes import write_gltf

N_FRAMES = 4
KINDS = (
    *("glb", "vrma", "bvh", "fbx", "pc2", "mdd"),
    *("amass.npz", "kimodo.npz", "joints.npy", "results.npy"),
)


@pytest.fixture(scope="module")
def body() -> RigBody:
    return RigBody.of(swinging_body())


@pytest.fixture(scope="module")
def clips(body: RigBody, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with an intact clip of each kind, "clip.KIND"."""
    from lcollision_core.files.motion.generated import _SMPL as SMPL

    folder = tmp_path_factory.mktemp("sound")
    glb = write_gltf(swinging_body(), folder / "clip.glb")
    as_vrma(glb, folder / "clip.vrma")
    character_fbx(swinging_body(), folder / "clip.fbx")
    (motion, *_) = read_motions(body, glb, CLIP)
    codes = motion.codes[:N_FRAMES]
    (folder / "clip.bvh").write_text(of_rig(body, codes))
    for suffix in ("pc2", "mdd"):
        write_point_cache(folder / f"clip.{suffix}", body.decode(codes), fps=24.0)
    places, turns = posed(tuple(SMPL), list(SMPL.values()))
    np.savez(folder / "clip.kimodo.npz", posed_joints=places, global_rot_mats=turns)
    np.savez(folder / "clip.amass.npz", poses=np.zeros((4, 156)), trans=np.zeros((4, 3)))
    np.save(folder / "clip.joints.npy", places)
    held = {"motion": places.transpose(1, 2, 0)[None], "lengths": np.array([len(places)])}
    np.save(folder / "clip.results.npy", np.array(held, dtype=object))
    return folder


def truncated(data: bytearray, rng: np.random.Generator) -> bytes:
    return bytes(data[: rng.integers(len(data))])


def flipped(data: bytearray, rng: np.random.Generator) -> bytes:
    for at in rng.integers(len(data), size=rng.integers(1, 30)):
        data[at] = rng.integers(256)
    return bytes(data)


def flipped_at_the_start(data: bytearray, rng: np.random.Generator) -> bytes:
    for at in rng.integers(min(len(data), 200), size=rng.integers(1, 5)):
        data[at] = rng.integers(256)
    return bytes(data)


def blanked(data: bytearray, rng: np.random.Generator) -> bytes:
    start, length = rng.integers(len(data)), rng.integers(1, 400)
    data[start : start + length] = bytes(len(data[start : start + length]))
    return bytes(data)


def cut_out(data: bytearray, rng: np.random.Generator) -> bytes:
    start = rng.integers(len(data))
    del data[start : start + rng.integers(1, 400)]
    return bytes(data)


def repeated(data: bytearray, rng: np.random.Generator) -> bytes:
    start = rng.integers(len(data))
    return bytes(data[:start] + data[max(0, start - 300) :])


DAMAGES = (truncated, flipped, flipped_at_the_start, blanked, cut_out, repeated)


def require_one_sentence(
    body: RigBody,
    sound: Path,
    path: Path,
    damage: Callable[[bytearray, np.random.Generator], bytes],
    seed: int,
) -> bool:
    """Read a damaged clip, and return whether it was refused; that must be in one sentence."""
    path.write_bytes(damage(bytearray(sound.read_bytes()), np.random.default_rng(seed)))
    before = {one.name for one in path.parent.iterdir()}
    try:
        own, _ = body_of_motion(body, path)
        for motion in read_motions(own, path):
            assert np.isfinite(motion.codes).all()
            assert len(motion)
        refused = False
    except LCollisionError as error:
        sentence = str(error)
        assert path.name in sentence, sentence
        assert "\n" not in sentence
        assert len(sentence) < 500, sentence
        refused = True
    assert {one.name for one in path.parent.iterdir()} == before
    return refused


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_clip_gets_one_sentence(
    body: RigBody, clips: Path, tmp_path: Path, kind: str
) -> None:
    sound, path = clips / f"clip.{kind}", tmp_path / f"damaged.{kind}"
    refused = [
        require_one_sentence(body, sound, path, damage, seed)
        for seed, damage in enumerate(DAMAGES[:3])
    ]
    assert any(refused)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("damage", DAMAGES)
def test_300_damaged_clips_get_one_sentence_each(
    body: RigBody,
    clips: Path,
    tmp_path: Path,
    kind: str,
    damage: Callable[[bytearray, np.random.Generator], bytes],
) -> None:
    sound, path = clips / f"clip.{kind}", tmp_path / f"damaged.{kind}"
    for seed in range(100, 105):
        require_one_sentence(body, sound, path, damage, seed)
