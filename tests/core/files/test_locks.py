"""Two writers of one file: no changes are lost, and no lock files remain."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Barrier, Thread

import pytest

from lcollision_core.errors import MeshFileError
from lcollision_core.files import atomic_write, file_stamp, locked, safe, unused_name
from lcollision_core.files.safe import require_regular

_READ_THEN_WRITE = """
import sys, time
from lcollision_core.files import atomic_write, locked
with locked(sys.argv[1]):
    text = open(sys.argv[1]).read()
    time.sleep(0.2)
    with atomic_write(sys.argv[1]) as file:
        file.write((text + sys.argv[2]).encode())
"""
_HOLD = """
import sys, time
from lcollision_core.files import atomic_write, locked
with locked(sys.argv[1]), atomic_write(sys.argv[1]) as file:
    file.write(b"half")
    file.flush()
    print("held", flush=True)
    time.sleep(60)
"""


def _held_by_another(path: Path) -> subprocess.Popen[bytes]:
    process = subprocess.Popen([sys.executable, "-c", _HOLD, path], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    return process


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGKILL)
    process.communicate()


@pytest.mark.slow
def test_two_processes_lose_nobodys_change(tmp_path: Path) -> None:
    path = tmp_path / "names"
    path.write_text("")
    changes = [
        subprocess.Popen([sys.executable, "-c", _READ_THEN_WRITE, path, letter]) for letter in "abc"
    ]
    assert [change.wait() for change in changes] == [0, 0, 0]
    assert sorted(path.read_text()) == ["a", "b", "c"]
    assert list(tmp_path.iterdir()) == [path]


def test_a_lock_may_vanish_while_it_is_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, lock = tmp_path / "names", tmp_path / ".names.lock"
    lock.write_text("")
    looked: list[Path] = []

    def look(file: Path) -> None:
        looked.append(file)
        file.unlink()  # like its last holder
        require_regular(file)

    monkeypatch.setattr(safe, "require_regular", look)
    with locked(path):
        assert looked == [lock]
        path.write_text("mine")
    assert list(tmp_path.iterdir()) == [path]


def test_two_threads_lose_nobodys_change(tmp_path: Path) -> None:
    path = tmp_path / "names"
    path.write_text("")
    start = Barrier(4)

    def add(letter: str) -> None:
        start.wait()
        with locked(path):
            text = path.read_text()
            time.sleep(0.05)
            path.write_text(text + letter)

    threads = [Thread(target=add, args=(letter,)) for letter in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(path.read_text()) == ["a", "b", "c", "d"]


def test_lock_of_a_living_process_is_respected_and_that_of_a_killed_one_is_not(
    tmp_path: Path,
) -> None:
    path = tmp_path / "m.json"
    path.write_text("old")
    holder = _held_by_another(path)
    try:
        with (
            pytest.raises(MeshFileError, match="being written by another command"),
            locked(path, wait=0.2),
        ):
            pass
    finally:
        _end(holder)
    with locked(path, wait=0.0):
        assert path.read_text() == "old"


def test_lock_refuses_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(MeshFileError, match="No such file"), locked(tmp_path / "none" / "m"):
        pass


def test_a_killed_writer_leaves_the_file_as_it_was_and_disturbs_no_one(tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    path.write_bytes(b"old")
    _end(_held_by_another(path))
    assert path.read_bytes() == b"old"
    with atomic_write(path) as file:
        file.write(b"new")
    assert path.read_bytes() == b"new"


def test_names_at_the_limit_of_the_file_system_are_written(tmp_path: Path) -> None:
    # 255 bytes, but far fewer characters: temporary files beside it must fit as well.
    path = tmp_path / ("\N{DANCER}" * 62 + "abc.obj")
    assert len(os.fsencode(path.name)) == 255
    with locked(path), atomic_write(path) as file:
        file.write(b"v")
    assert list(tmp_path.iterdir()) == [path]


def test_stamp_tells_a_replaced_file_from_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "m"
    assert file_stamp(path) is None
    path.write_text("same")
    before = file_stamp(path)
    assert file_stamp(path) == before
    with atomic_write(path) as file:
        file.write(b"same")
    assert file_stamp(path) != before


def test_an_unused_name_is_no_files(tmp_path: Path) -> None:
    (tmp_path / "m 2.obj").touch()
    assert unused_name(tmp_path / "m.obj") == tmp_path / "m 3.obj"
