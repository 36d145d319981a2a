"""What a first start needs is compiled in a process of its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.work import compile_ahead


def test_a_first_start_compiles_beside_the_window_and_a_second_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert not compile_ahead.is_compiled()
    compile_ahead.begin()
    compile_ahead.wait_for_check()
    assert compile_ahead.is_compiled()
    compile_ahead.wait_for_all()
    assert list(tmp_path.glob("contact_*/distance.keep_near-*.nbi"))
    assert list(tmp_path.glob("contact_*/kernels.look_again-*.nbi"))
    compiled = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb?")}
    for wait in (compile_ahead.begin, compile_ahead.wait_for_check, compile_ahead.wait_for_all):
        wait()
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb?")} == compiled
