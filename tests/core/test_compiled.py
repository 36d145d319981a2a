"""Compiled loops work wherever the program is installed."""

from __future__ import annotations

import importlib.util
import logging
import pickle
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numba
import numpy as np
import pytest

from lcollision_core import compiled

SOURCE = """\
from lcollision_core.compiled import compiled

@compiled
def triangular(n):
    total = 0
    for i in range(n + 1):
        total += i
    return total
"""


def _module(folder: Path) -> ModuleType:
    path = folder / "loops.py"
    path.write_text(SOURCE)
    spec = importlib.util.spec_from_file_location("loops", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_loop_is_cached_beside_its_file(tmp_path: Path) -> None:
    assert _module(tmp_path).triangular(4) == 10
    assert list(tmp_path.glob("__pycache__/loops.triangular-*.nbc"))


def test_compiling_is_logged_once_until_it_pauses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = [time.perf_counter()]
    monkeypatch.setattr(compiled, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    caplog.set_level(logging.INFO, compiled.__name__)
    triangular = _module(tmp_path).triangular
    for kinds, n_logged in (((np.int8, np.int16), 1), ((np.int16,), 1), ((np.int32, np.int64), 2)):
        now[0] += 2.0 * compiled._PAUSE_SECONDS
        for kind in kinds:
            assert triangular(kind(4)) == 10
        assert len(caplog.records) == n_logged


def test_the_working_clock_stands_still_while_numba_compiles(tmp_path: Path) -> None:
    triangular = _module(tmp_path).triangular
    behind = time.perf_counter() - compiled.working_seconds()
    started = time.perf_counter()
    assert triangular(np.uint8(4)) == 10
    stood = time.perf_counter() - compiled.working_seconds() - behind
    assert 0.0 < stood <= time.perf_counter() - started
    compiling = compiled._compilations
    for is_end in (False, True):
        compiling.notify(SimpleNamespace(is_end=is_end))
        moments = [compiled.working_seconds() for _ in range(2)]
        assert (moments[0] == moments[1]) != is_end


def test_a_loop_runs_where_nothing_can_be_cached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A file instead of the folder keeps even root from writing there.
    (tmp_path / "__pycache__").write_text("")
    for variable in ("HOME", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(variable, str(tmp_path / "__pycache__"))
    assert _module(tmp_path).triangular(4) == 10


def test_a_cache_that_names_a_class_of_an_earlier_release_is_made_anew(tmp_path: Path) -> None:
    assert _module(tmp_path).triangular(4) == 10
    (index,) = tmp_path.glob("__pycache__/loops.triangular-*.nbi")
    whole = index.read_bytes()
    gone = b"clcollision_core.compiled\nGone\n."
    index.write_bytes(pickle.dumps(numba.__version__) + gone)
    assert _module(tmp_path).triangular(4) == 10
    assert gone not in index.read_bytes()
    assert len(index.read_bytes()) > len(whole) // 2
