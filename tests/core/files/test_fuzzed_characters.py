"""500 damaged characters and point caches: one sentence each or a valid mesh, in bounded memory."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lcollision_core.errors import LCollisionError
from lcollision_core.files import PoseSet, read_character, read_mesh, read_pose_set, write_mesh
from lcollision_core.files.motion.caches import write_point_cache
from tests.core.background import wait_for_tables
from tests.core.fbx_builder import arm_fbx
from tests.core.gltf_builder import GltfBuilder, arm, tube

pytestmark = pytest.mark.slow

MOST_MEMORY = 100 << 20
"""Bytes that a damaged file of some kilobytes may take at a time."""

N_GLB_BYTES, N_GLB_VALUES, N_FBX, N_EACH_CACHE = 120, 200, 60, 60

HOSTILE = (
    -1, 0, 1, 3, 255, 65536, 2**31 - 1, 2**31, 2**40, 2**64, 0.5, -1e308, 1e-308, "", "x", None,
    True, [], {}, [0], [1e39] * 3, [10**9], {"a": 1}, "\u202e\x00", "VEC3", "../x.bin",
)  # fmt: skip


def _overwritten(data: bytes, seed: int) -> bytes:
    """Cut a file, overwrite some of its bytes, or repeat a stretch of it."""
    generator = np.random.default_rng(seed)
    result = bytearray(data)
    kind = seed % 4
    if kind == 0:
        del result[int(generator.integers(len(result))) :]
    for _ in range(int(generator.integers(1, 9)) if kind else 0):
        result[int(generator.integers(len(result)))] = int(generator.integers(256))
    if kind == 3:
        first, last = np.sort(generator.integers(len(result), size=2)).tolist()
        result[first:first] = result[first:last]
    return bytes(result)


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every value inside another."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, held in items:
        yield (*path, key)
        if isinstance(held, dict | list):
            yield from _places(held, (*path, key))


def _with_hostile_value(seed: int) -> GltfBuilder:
    """Replace one or two values of a description by ones that it should not have."""
    generator = np.random.default_rng(seed)
    builder = arm()
    builder.description |= {"scene": 0, "scenes": [{"nodes": [0]}]}
    builder.description = json.loads(json.dumps(builder.description))
    for _ in range(1 + seed % 2):
        places = list(_places(builder.description))
        *path, last = places[int(generator.integers(len(places)))]
        inside = builder.description
        for key in path:
            inside = inside[key]
        inside[last] = HOSTILE[int(generator.integers(len(HOSTILE)))]
    return builder


def _read_all(path: Path) -> None:
    """Read a character with all frames, and the same as a mesh."""
    character = read_character(path)
    _require_valid(character.rest_vertices, character.topology.faces)
    assert character.joined.max() < character.topology.n_vertices
    for clip in character.clips:
        frames = character.sample(clip, None)
        assert np.isfinite(frames.vertices).all()
        assert frames.vertices.shape == (len(frames.times), character.topology.n_vertices, 3)
    mesh = read_mesh(path)
    _require_valid(mesh.vertices, mesh.faces)


def _require_valid(vertices: np.ndarray, faces: np.ndarray) -> None:
    assert np.isfinite(vertices).all()
    assert vertices.ndim == 2
    assert 0 <= faces.min() <= faces.max() < len(vertices)


def _peak_of(read: Callable[[], object], path: Path) -> tuple[int, bool]:
    """Return the most bytes that reading took, and whether it was refused in one sentence."""
    refused = False
    tracemalloc.start()
    try:
        read()
    except LCollisionError as error:
        refused = True
        sentence = str(error)
        assert path.stem in sentence
        assert "\n" not in sentence
        assert len(sentence) < 600
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        wait_for_tables()
        tracemalloc.stop()
    return peak, refused


def _require_bounded(
    n_files: int, made: Callable[[int], Path], read: Callable[[Path], object]
) -> None:
    """Read the files of n seeds: some must be refused, all in bounded memory."""
    n_refused = 0
    for seed in range(n_files):
        path = made(seed)
        peak, refused = _peak_of(lambda path=path: read(path), path)  # type: ignore[misc]
        assert peak < MOST_MEMORY, f"seed {seed}"
        n_refused += refused
    assert n_refused > n_files // 10


def test_glb_of_damaged_bytes(tmp_path: Path) -> None:
    whole = arm().write(tmp_path / "whole.glb").read_bytes()
    path = tmp_path / "damaged.glb"

    def made(seed: int) -> Path:
        path.write_bytes(_overwritten(whole, seed))
        return path

    _require_bounded(N_GLB_BYTES, made, _read_all)


def test_glb_of_hostile_values(tmp_path: Path) -> None:
    _require_bounded(
        N_GLB_VALUES,
        lambda seed: _with_hostile_value(seed).write(tmp_path / "hostile.glb"),
        _read_all,
    )


def test_fbx_of_damaged_bytes(tmp_path: Path) -> None:
    pytest.importorskip("ufbx")
    whole = arm_fbx(tmp_path / "whole.fbx").read_bytes()
    path = tmp_path / "damaged.fbx"

    def made(seed: int) -> Path:
        path.write_bytes(_overwritten(whole, seed))
        return path

    _require_bounded(N_FBX, made, lambda path: read_pose_set(path, fps=2.0))


@pytest.mark.parametrize("suffix", [".pc2", ".mdd"])
def test_point_caches_of_damaged_bytes(tmp_path: Path, suffix: str) -> None:
    vertices, faces = tube()
    write_mesh(tmp_path / "damaged.obj", vertices, faces)
    path = tmp_path / f"damaged{suffix}"
    write_point_cache(path, np.stack([vertices, vertices * [1.0, 1.1, 1.0]]))
    whole = path.read_bytes()

    def made(seed: int) -> Path:
        # The sizes are in the first bytes.
        head, rest = (whole[:40], whole[40:]) if seed % 2 else (b"", whole)
        path.write_bytes(_overwritten(head or rest, seed) + (rest if head else b""))
        return path

    def read(path: Path) -> PoseSet:
        poses = read_pose_set(path)
        assert np.isfinite(poses.vertices).all()
        return poses

    _require_bounded(N_EACH_CACHE, made, read)


def test_there_are_500() -> None:
    assert N_GLB_BYTES + N_GLB_VALUES + N_FBX + 2 * N_EACH_CACHE == 500


@pytest.mark.parametrize(
    "name", ["blender_279_sausage_7400_binary.fbx", "maya_advanced_skinned_pivot_7700_binary.fbx"]
)
def test_real_fbx_of_damaged_bytes(name: str, characters: Path, tmp_path: Path) -> None:
    pytest.importorskip("ufbx")
    whole = (characters / name).read_bytes()
    path = tmp_path / "damaged.fbx"

    def made(seed: int) -> Path:
        path.write_bytes(_overwritten(whole, seed))
        return path

    _require_bounded(20, made, read_mesh)
