"""What the tests of labels share."""

from __future__ import annotations

from dataclasses import fields

from lcollision_core.labels import Labeller, LabelRows
from lcollision_core.model import PoseModel


def labeller_of(model: PoseModel) -> Labeller:
    return Labeller(model.embedding, model.height, model.near_exclusion, model.fingerprint)


def as_bytes(rows: LabelRows) -> dict[str, bytes]:
    """Return every column's bytes: rows are the same when these are."""
    return {field.name: getattr(rows, field.name).tobytes() for field in fields(rows)}
