"""Fixtures that several test modules share."""

from __future__ import annotations

import gc
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if "PYTEST_XDIST_WORKER" in os.environ:
    # Each worker has one core, on which several threads would wait for each other. The variable is
    # read when torch is imported, by this process and by those that tests start.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest

from lcollision_core.jobs import limit_library_threads

# NumPy and torch may be imported before the program that would set this.
limit_library_threads()

# The process that only starts the workers loads this file too, so other imports are in functions.
if TYPE_CHECKING:
    from typer.testing import Result

    from lcollision_core.files import PoseSet
    from tests.app.support import Lcollision

UNPUBLISHED = {"characters", "scape", "jumping"}
"""Fixtures of data that is not redistributed: tests that use them are marked slow."""


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect without Python's garbage collector, and keep it from what lives as long as the tests.

    Otherwise, each full collection visits all modules again.
    """
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests as slow: of unpublished data, and all but the first of `variants`.

    Those marked `long` come first.
    """
    items.sort(key=lambda item: item.get_closest_marker("long") is None)
    counts: Counter[str] = Counter()
    for item in items:
        variants = item.get_closest_marker("variants")
        name = item.nodeid.partition("[")[0]
        counts[name] += 1
        is_another = variants is not None and counts[name] > (*variants.args, 1)[0]
        if is_another or UNPUBLISHED.intersection(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(autouse=True)
def _garbage_waits(request: pytest.FixtureRequest) -> Iterator[None]:
    """Keep Python's garbage collector, as the editor does, from running while Qt destroys objects.

    It does not run between two tests with windows either, where their remains are destroyed.
    """
    if "qtbot" not in request.fixturenames:
        gc.enable()
        yield
        return
    gc.disable()
    yield
    # A full collection takes as long as many tests.
    gc.collect(1)


@pytest.fixture(scope="session")
def characters() -> Path:
    """Return the folder of characters that may not be redistributed, or skip the test."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("LCOLLISION_DATA", default)) / "characters"
    if not folder.is_dir():
        pytest.skip(f"there is no folder {folder} of characters (set LCOLLISION_DATA)")
    return folder


def _published_set(name: str) -> PoseSet:
    """Read a published pose set that may not be redistributed, or skip the test."""
    from lcollision_core.files import read_pose_set

    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("LCOLLISION_DATA", default))
    path = folder / name
    if not path.is_file():
        pytest.skip(f"the published pose set {name} is not in {folder} (set LCOLLISION_DATA)")
    return read_pose_set(path)


@pytest.fixture(scope="session")
def scape() -> PoseSet:
    """Return the 71 SCAPE poses at 2161 vertices."""
    return _published_set("scape71.npz")


@pytest.fixture(scope="session")
def jumping() -> PoseSet:
    """Return the 150 frames of the MIT jumping sequence at 10 002 vertices."""
    return _published_set("jumping150.npz")


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Return the address of a Dask scheduler with two worker processes."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=":0"
    ) as local:
        yield local.scheduler_address


@pytest.fixture(scope="session")
def lcollision() -> Lcollision:
    """Run ``lcollision ARGUMENTS``; the result has exit_code, stdout and stderr."""
    from typer.testing import CliRunner

    from app.cli.main import app

    def run(*arguments: object) -> Result:
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return run
