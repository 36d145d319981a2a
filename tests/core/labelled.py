"""What the tests of labels share."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from lcollision_core.bodies import LearnedBody
from lcollision_core.labels import Labeller, LabelRows


def labeller_of(model: LearnedBody) -> Labeller:
    return model.labeller()


def as_bytes(rows: LabelRows) -> dict[str, bytes]:
    """Return every column's bytes: rows are the same when these are."""
    return {field.name: getattr(rows, field.name).tobytes() for field in fields(rows)}


def files_of(folder: Path) -> dict[str, bytes]:
    """Return what a folder's files hold, by name."""
    return {file.name: file.read_bytes() for file in folder.iterdir()}
