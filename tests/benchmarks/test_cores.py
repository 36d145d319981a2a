"""The thread benchmark times the same loops on one thread and on several."""

from __future__ import annotations

import json

import pytest

from app.benchmarks import cores
from tests.app.support import Lcollision

pytestmark = pytest.mark.slow


def test_the_command_prints_a_row_for_each_loop(
    lcollision: Lcollision, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cores, "_SECONDS", 0.02)
    monkeypatch.setattr(cores, "_ROUNDS", 3)
    result = lcollision("benchmark", "cores", "-n", 32, "--json")
    assert result.exit_code == 0
    rows = {row["what"]: row for row in json.loads(result.stdout)}
    assert {"decode", "any pair", "all pairs", "screening", "labels"} <= set(rows)
    assert rows["labels"]["items"] == 32
    assert all(0.0 < row["serial"] < 1.0 for row in rows.values())
    assert all(
        row["ratio"] == pytest.approx(row["ms_one"] / row["ms_all"]) for row in rows.values()
    )
