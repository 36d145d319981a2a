from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.errors import LCollisionError, MeshFileError, ShapeError
from lcollision_core.files.formats import POINT_CACHE_SUFFIXES
from lcollision_core.files.motion import caches
from lcollision_core.files.motion.caches import (
    cache_rate,
    point_cache,
    read_point_cache,
    write_point_cache,
)
from tests.core.background import peak_memory

FRAMES = np.arange(2 * 4 * 3, dtype=np.float32).reshape(2, 4, 3) / 7.0


def test_a_pc2_file_is_what_its_users_describe(tmp_path: Path) -> None:
    write_point_cache(tmp_path / "m.pc2", FRAMES)
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, 4, 0.0, 1.0, 2)
    body = struct.pack("<24f", *FRAMES.ravel())
    assert (tmp_path / "m.pc2").read_bytes() == head + body


def test_an_mdd_file_is_what_its_users_describe(tmp_path: Path) -> None:
    write_point_cache(tmp_path / "m.mdd", FRAMES, fps=24.0)
    head = struct.pack(">2i2f", 2, 4, 0.0, 1.0 / 24.0)
    body = struct.pack(">24f", *FRAMES.ravel())
    assert (tmp_path / "m.mdd").read_bytes() == head + body


@pytest.mark.parametrize("suffix", POINT_CACHE_SUFFIXES)
def test_times_of_a_cache_of_as_many_frames_are_kept(tmp_path: Path, suffix: str) -> None:
    source, out = tmp_path / f"m{suffix}", tmp_path / f"out{suffix}"
    write_point_cache(source, FRAMES, fps=24.0)
    data = bytearray(source.read_bytes())
    place, form, times = (20, "<2f", (101.0, 0.5)) if suffix == ".pc2" else (8, ">2f", (4.0, 4.5))
    data[place : place + 8] = struct.pack(form, *times)
    source.write_bytes(data)
    for n_frames, fps in ((2, 2.0), (1, 2.0), (2, 25.0)):
        with point_cache(out, n_frames, 3, fps, source) as write:
            for _ in range(n_frames):
                write(FRAMES[0, :3])
        is_kept = n_frames == 2 and (suffix == ".pc2" or fps == 2.0)
        written = out.read_bytes()[place : place + 4 * n_frames]
        assert (written == struct.pack(form, *times)) == is_kept
        assert read_point_cache(out).shape == (n_frames, 3, 3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("suffix", [*POINT_CACHE_SUFFIXES, ".PC2"])
def test_round_trip(tmp_path: Path, suffix: str, dtype: type[np.floating]) -> None:
    path = tmp_path / f"m{suffix}"
    write_point_cache(path, FRAMES.astype(dtype), fps=10.0)
    frames = read_point_cache(path)
    assert frames.dtype == np.float32
    assert not frames.flags.writeable
    assert np.array_equal(frames, FRAMES)


def test_more_numbers_than_can_be_read_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "m.pc2"
    write_point_cache(path, FRAMES)
    monkeypatch.setattr(caches, "MAX_ITEMS", FRAMES.size)
    assert np.array_equal(read_point_cache(path), FRAMES)
    monkeypatch.setattr(caches, "MAX_ITEMS", FRAMES.size - 1)
    with pytest.raises(MeshFileError, match=r"at most 23 coordinates .* keep fewer frames"):
        read_point_cache(path)


@pytest.mark.parametrize("suffix", POINT_CACHE_SUFFIXES)
def test_frames_beyond_those_announced_are_left_aside(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"m{suffix}"
    write_point_cache(path, FRAMES)
    path.write_bytes(path.read_bytes() + FRAMES[0].tobytes())
    assert np.array_equal(read_point_cache(path), FRAMES)


@pytest.mark.parametrize("suffix", POINT_CACHE_SUFFIXES)
def test_every_truncation_is_one_sentence(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"m{suffix}"
    write_point_cache(path, FRAMES)
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(MeshFileError, match=r"m\.\w+ cannot be read: it .*export the cache"):
            read_point_cache(path)
        if suffix == ".mdd":
            with pytest.raises(MeshFileError, match=r"m\.mdd cannot be read: it "):
                cache_rate(path)


@pytest.mark.parametrize("suffix", POINT_CACHE_SUFFIXES)
def test_damaged_bytes_end_in_one_sentence_or_finite_frames(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"m{suffix}"
    write_point_cache(path, FRAMES)
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    generator = np.random.default_rng(0)
    sentences = []
    for _ in range(250):
        damaged = whole.copy()
        places = generator.integers(0, len(whole), 3)
        damaged[places] = generator.integers(0, 256, 3)
        path.write_bytes(damaged.tobytes())
        try:
            assert np.isfinite(read_point_cache(path)).all()
        except MeshFileError as error:
            sentences.append(str(error))
    assert 0 < len(sentences) < 250
    assert all(sentence.startswith(f"{path} cannot be read: ") for sentence in sentences)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "head"),
    [
        (".pc2", struct.pack("<12siiffi", b"POINTCACHE2\0", 1, 2**31 - 1, 0.0, 1.0, 2**31 - 1)),
        (".pc2", struct.pack("<12siiffi", b"POINTCACHE2\0", 1, -4, 0.0, 1.0, -2)),
        (".mdd", struct.pack(">2i", 2**31 - 1, 2**31 - 1)),
        (".mdd", struct.pack(">2i", -2, -4)),
        (".mdd", struct.pack(">2i", 0, 4)),
    ],
)
def test_what_is_announced_takes_no_memory(tmp_path: Path, suffix: str, head: bytes) -> None:
    path = tmp_path / f"m{suffix}"
    path.write_bytes(head + bytes(200))

    def read() -> None:
        with pytest.raises(MeshFileError, match=r"it announces -?[0-9]+ frames of"):
            read_point_cache(path)

    assert peak_memory(read) < 1 << 20


@pytest.mark.parametrize("suffix", POINT_CACHE_SUFFIXES)
def test_a_coordinate_that_is_not_finite_is_named(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"m{suffix}"
    write_point_cache(path, FRAMES)
    content = path.read_bytes()
    path.write_bytes(content[:-16] + b"\xff\xff\xff\xff" + content[-12:])
    with pytest.raises(MeshFileError, match=r"vertex 2 of frame 1 \(from 0\) is at .*nan"):
        read_point_cache(path)


@pytest.mark.parametrize("n_points", [4, 128])
@pytest.mark.parametrize("suffix", POINT_CACHE_SUFFIXES)
def test_a_wrong_byte_order_is_said(tmp_path: Path, suffix: str, n_points: int) -> None:
    path = tmp_path / f"m{suffix}"
    write_point_cache(path, np.ones((2, n_points, 3)))
    start = 12 if suffix == ".pc2" else 0
    content = path.read_bytes()
    swapped = np.frombuffer(content[start:], "<u4").astype(">u4").tobytes()
    path.write_bytes(content[:start] + swapped)
    with pytest.raises(MeshFileError, match="wrong byte order; export the cache again"):
        read_point_cache(path)


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "m.pc2").write_bytes(b"POINTCACHE3\0" + bytes(40))
    with pytest.raises(MeshFileError, match="does not begin with POINTCACHE2"):
        read_point_cache(tmp_path / "m.pc2")
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 2, 4, 0.0, 1.0, 2)
    (tmp_path / "m.pc2").write_bytes(head + FRAMES.tobytes())
    with pytest.raises(MeshFileError, match="its version is 2"):
        read_point_cache(tmp_path / "m.pc2")
    with pytest.raises(
        MeshFileError, match=r"m\.abc is not a point cache, expected \.pc2 or \.mdd"
    ):
        write_point_cache(tmp_path / "m.abc", FRAMES)
    with pytest.raises(MeshFileError, match=r"none\.pc2 cannot be read: No such file"):
        read_point_cache(tmp_path / "none.pc2")


@pytest.mark.parametrize(
    "frames", [FRAMES[0], FRAMES[:, :, :2], FRAMES[:0], FRAMES.astype(np.float64) * 1e39]
)
def test_nothing_is_written_of_what_the_format_cannot_hold(
    tmp_path: Path, frames: np.ndarray
) -> None:
    with pytest.raises(ShapeError):
        write_point_cache(tmp_path / "m.pc2", frames)
    with pytest.raises(LCollisionError, match="fps must be a number above 0"):
        write_point_cache(tmp_path / "m.mdd", FRAMES, fps=0.0)
    assert not list(tmp_path.iterdir())
