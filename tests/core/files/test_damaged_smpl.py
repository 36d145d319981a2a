"""300 damaged body models and motions: one sentence or a body, and nothing of theirs is run."""

from __future__ import annotations

import itertools
import os
import pickle
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.motions import body_of_motion, read_motions
from lcollision_core.errors import LCollisionError
from tests.app.support import Lcollision
from tests.hostile_values import changed_arrays
from tests.smpl_files import Arrays, motion_arrays, tiny_arrays

pytestmark = pytest.mark.slow

N_OF_EACH = 150
N_FRAMES = 3


class Runs:
    """What leaves a file where it is unpickled."""

    def __init__(self, left: Path) -> None:
        self.left = str(left)

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (self.left,)


def archive(arrays: Arrays) -> bytes:
    file = BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def damaged(arrays: Arrays, seed: int, left: Path) -> Iterator[bytes]:
    """Give files with one array changed, one array pickled, or some bytes lost or changed."""
    for name in arrays:
        pickled = np.array([Runs(left)], dtype=object)
        yield archive(arrays | {name: pickled})
    changes = [
        (name, changed) for name, array in arrays.items() for _, changed in changed_arrays(array)
    ]
    generator = np.random.default_rng(seed)
    data = archive(arrays)
    for place in generator.permutation(len(changes))[: N_OF_EACH // 2]:
        name, changed = changes[place]
        rest = {key: one for key, one in arrays.items() if key != name}
        yield archive(rest if changed is None else rest | {name: changed})
    while True:
        broken = bytearray(data)
        if generator.random() < 0.3:
            del broken[generator.integers(len(broken)) :]
        else:
            # Names, sizes and headers are where the most can go wrong.
            for _ in range(generator.integers(1, 4)):
                place = int(generator.integers(generator.choice([200, len(broken)])))
                broken[place] ^= 1 << int(generator.integers(8))
        yield bytes(broken)


def refused(path: Path, open_it: Callable[[], None]) -> bool:
    """Tell whether a file is refused, which it may be in one sentence that names it."""
    try:
        open_it()
    except LCollisionError as error:
        sentence = str(error)
    else:
        return False
    assert str(path) in sentence
    assert "\n" not in sentence
    return True


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    path = tmp_path / "sound.npz"
    np.savez(path, **tiny_arrays())
    return path


def test_damaged_models_are_refused_or_posed(tmp_path: Path) -> None:
    path, left, n_refused = tmp_path / "model.npz", tmp_path / "ran", 0
    for data in itertools.islice(damaged(tiny_arrays(), 0, left), N_OF_EACH):
        path.write_bytes(data)

        def pose() -> None:
            body = open_body(path)
            assert np.isfinite(body.decode(np.zeros(body.latent_size))).all()

        n_refused += refused(path, pose)
    assert not left.exists()
    assert N_OF_EACH > n_refused > 0.7 * N_OF_EACH


def test_damaged_motions_are_refused_or_read(tmp_path: Path, sound: Path) -> None:
    path, left, n_refused = tmp_path / "walk.npz", tmp_path / "ran", 0
    arrays = motion_arrays(24, N_FRAMES) | {"betas": np.zeros(4)}
    body = open_body(sound)
    assert isinstance(body, RigBody)
    for data in itertools.islice(damaged(arrays, 1, left), N_OF_EACH):
        path.write_bytes(data)

        def read() -> None:
            shaped, _ = body_of_motion(body, path)
            (motion,) = read_motions(shaped, path)
            assert np.isfinite(motion.codes).all()

        n_refused += refused(path, read)
    assert not left.exists()
    assert N_OF_EACH > n_refused > 0.5 * N_OF_EACH


def test_commands_refuse_them_and_write_nothing(
    lcollision: Lcollision, tmp_path: Path, sound: Path
) -> None:
    model, motion, out = tmp_path / "model.npz", tmp_path / "walk.npz", tmp_path / "free.npz"
    left = tmp_path / "ran"
    for number, data in enumerate(itertools.islice(damaged(tiny_arrays(), 2, left), 7)):
        motion.write_bytes(archive(motion_arrays(24, N_FRAMES)))
        model.write_bytes(data)
        of_motion = archive(motion_arrays(24, N_FRAMES) | {"poses": np.full((1, number + 1), 0.5)})
        wrong = tmp_path / "wrong.npz"
        wrong.write_bytes(of_motion)
        for arguments in (
            ("check", motion, "--clips", "--body", model),
            ("resolve", model, motion, "--motion", "-o", out),
            ("resolve", sound, wrong, "--motion", "-o", out),
        ):
            result = lcollision(*arguments)
            assert result.exit_code == 2
            assert result.stderr.count("\n") == 1
            assert "Traceback" not in result.output
            assert not out.exists()
    assert not left.exists()
    # What is beside is copied, and not read.
    arrays = motion_arrays(24, N_FRAMES) | {"info": np.array([Runs(left)], dtype=object)}
    np.savez(motion, **arrays)
    result = lcollision("resolve", sound, motion, "--motion", "-o", out)
    assert result.exit_code in (0, 1), result.output
    assert out.exists()
    assert not left.exists()
    with pytest.raises(ValueError, match="allow_pickle"):
        np.load(out, allow_pickle=False)["info"]


def test_the_pickle_would_run(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Runs(tmp_path / "ran")))
    assert (tmp_path / "ran").exists()
