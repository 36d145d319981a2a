"""Jobs and threads: what no room's tests cover."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize("user", [None, pytest.param("77", marks=pytest.mark.slow)])
def test_the_program_limits_the_spinning_of_torch_s_threads_unless_the_user_does(
    user: str | None,
) -> None:
    environment = {name: os.environ[name] for name in os.environ if name != "GOMP_SPINCOUNT"}
    environment |= {"OMP_DISPLAY_ENV": "verbose"} | ({"GOMP_SPINCOUNT": user} if user else {})
    command = [sys.executable, "-c", "import app.cli.main, torch"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    # What torch's library has read from the environment.
    assert f"GOMP_SPINCOUNT = '{user or 10000}'" in done.stderr
