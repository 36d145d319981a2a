"""A small colliding mesh, and helpers that run the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from typer.testing import Result

from app.editing.document import PoseDocument
from app.work.threads import as_task
from lcollision_core.bodies import ExportRequest
from lcollision_core.tasks import exporting

STABBED = """\
v 0 0 0
v 1 0 0
v 0 1 0
v 0.2 0.2 -0.1
v 0.2 0.2 0.9
v 0.3 0.2 0.9
f 1 2 3
f 4 5 6
"""
"""Two triangles, one of which penetrates the other by 0.1; the mesh is 1 high."""


class Lcollision(Protocol):
    """Runs the command line in this process."""

    def __call__(self, *arguments: object) -> Result: ...


def refusal(lcollision: Lcollision, *arguments: object) -> str:
    """Run a command that must refuse its input, and return its one sentence."""
    result = lcollision(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("lcollision: ")
    return line


def export_pose(document: PoseDocument, path: Path, request: ExportRequest | None = None) -> None:
    """Write the pose on the screen, as the window does."""
    work = as_task(
        exporting.export,
        document.model,
        document.history.pose,
        document.history.state.outcome,
        path,
        request or ExportRequest(),
    )
    document.tasks.write(f"Exporting {path.name}", work)
