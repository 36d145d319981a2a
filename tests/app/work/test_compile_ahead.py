"""The loops of a first start are compiled in a separate process."""

from __future__ import annotations

import os
import shutil
import stat
import sys
from pathlib import Path

import numpy as np
import pytest

from app.work import compile_ahead
from app.work.compile_ahead import CompileAhead, is_compiled
from lcollision_core.bodies import NamedPose, open_body, write_poses
from lcollision_core.errors import CancelledError
from lcollision_core.jobs import Job
from tests.app.support import Lcollision
from tests.app.windows import PATIENCE


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the empty folder of Numba's cache."""
    folder = tmp_path / "kept"
    folder.mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    monkeypatch.setattr(compile_ahead, "_PATIENCE", PATIENCE / 1000)
    return folder


@pytest.mark.slow
@pytest.mark.long
def test_a_first_start_compiles_beside_the_window_and_a_second_does_not(
    kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A user's folder with a package of the same name.
    (tmp_path / "app").mkdir()
    (tmp_path / "app" / "__init__.py").write_text("raise SystemExit")
    monkeypatch.setattr(sys, "path", [str(Path(__file__).parents[3]), *filter(None, sys.path)])
    monkeypatch.chdir(tmp_path)
    assert not is_compiled()
    ahead = CompileAhead()
    ahead.begin()
    for _ in range(2):
        ahead.wait_for_check()
        assert list(kept.glob("contact_*/kernels.search_pose-*.nbi"))
        assert not is_compiled()
    ahead.wait_for_all()
    assert list(kept.glob("contact_*/distance.keep_too_near-*.nbi"))
    assert is_compiled()
    compiled = {path: path.stat().st_mtime_ns for path in kept.rglob("*.nb?")}
    for wait in (ahead.begin, ahead.wait_for_check, ahead.wait_for_all):
        wait()
    assert {path: path.stat().st_mtime_ns for path in kept.rglob("*.nb?")} == compiled


@pytest.mark.parametrize("program", ["false", "missing"])
def test_a_process_that_cannot_compile_is_not_waited_for(
    kept: Path, monkeypatch: pytest.MonkeyPatch, program: str
) -> None:
    monkeypatch.setattr(sys, "executable", shutil.which(program) or str(kept / program))
    ahead = CompileAhead()
    ahead.begin()
    ahead.wait_for_check()
    ahead.wait_for_all()
    assert not is_compiled()


@pytest.mark.skipif(sys.platform == "win32", reason="the program is a script of the shell")
def test_a_wait_is_cancelled_and_the_process_ends_with_the_window(
    kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asleep, job = kept / "asleep", Job()
    asleep.write_text("#!/bin/sh\nexec sleep 600\n")
    asleep.chmod(asleep.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(sys, "executable", str(asleep))
    ahead = CompileAhead()
    ahead.begin()
    job.cancel()
    with pytest.raises(CancelledError):
        ahead.wait_for_check(job)
    ahead.end()
    ahead.wait_for_all()


@pytest.mark.parametrize(
    ("command", "words", "is_checked"),
    [("sample", "-n 1 --free", True), ("resolve", "{poses}", True)]
    + [("resolve", "{poses} --no-verify", False)]
    + [("sample", "-n 1 --free --error-bound 0.5", False)],
)
def test_a_command_waits_for_the_check_that_another_process_compiles(
    lcollision: Lcollision,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    words: str,
    is_checked: bool,
) -> None:
    poses, ahead = tmp_path / "poses.json", CompileAhead()
    write_poses(poses, open_body("body"), [NamedPose("zero", np.zeros(110))])
    monkeypatch.setattr(compile_ahead, "AHEAD", ahead)
    # The process finds everything compiled.
    monkeypatch.setattr(compile_ahead, "is_compiled", lambda: False)
    given = [word.format(poses=poses) for word in words.split()]
    result = lcollision(command, "body", *given, "-o", tmp_path / "free.json")
    assert (result.exit_code, "free.json" in result.stderr) == (0, True), result.stderr
    assert ahead._checked.is_set()
    if not is_checked:
        assert ahead._process is None
        return
    assert ahead._process is not None
    ahead.wait_for_all()
    assert ahead._process.returncode == 0


def test_a_command_that_is_refused_does_not_wait(
    lcollision: Lcollision, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wait(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(CompileAhead, "wait_for_check", wait)
    monkeypatch.setattr(compile_ahead, "AHEAD", CompileAhead())
    refused = lcollision("resolve", "body", tmp_path / "none.json", "-o", tmp_path / "free.json")
    assert "none.json cannot be read: there is no such file" in refused.stderr
    assert refused.exit_code == 2


def test_what_an_older_version_or_another_python_compiled_does_not_count(kept: Path) -> None:
    folder = kept / "contact_1"
    folder.mkdir()
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    old = folder / f"kernels.test_pairs-1.{version}.nbi"
    old.touch()
    os.utime(old, (1e9, 1e9))
    (folder / "kernels.test_pairs-2.py27.nbi").touch()
    (folder / f"kernels.search_pose-2.{version}.nbi").touch()
    assert not is_compiled()
    os.utime(old)
    assert is_compiled()
