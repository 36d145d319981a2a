"""Helpers of label tests."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from lcollision_core.bodies import LearnedBody
from lcollision_core.labels import Labeller, LabelRows


def labeller_of(model: LearnedBody) -> Labeller:
    return model.labeller()


def as_bytes(rows: LabelRows) -> dict[str, bytes]:
    """Return every column's bytes, to compare rows exactly."""
    return {field.name: getattr(rows, field.name).tobytes() for field in fields(rows)}


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the contents of a folder's files, by name."""
    return {file.name: file.read_bytes() for file in folder.iterdir()}
