"""The errors that users see: each message is one sentence saying what, where, and what to do."""

from __future__ import annotations


class LCollisionError(Exception):
    """Base of every error that a user can fix; its text is fit to be shown as it is."""


class ShapeError(LCollisionError, ValueError):
    """An array has another shape or dtype than the function documents."""


class MeshFileError(LCollisionError):
    """A file cannot be read as a mesh or a pose set, or cannot be written."""


class ModelFileError(LCollisionError):
    """A file cannot be read as a model or as poses of a model, or cannot be written."""


class PoseSetError(LCollisionError):
    """Meshes cannot form one pose set: their topology differs, or a pose is not usable."""


class WrongScaleError(PoseSetError):
    """A mesh is not in the unit that is needed.

    Attributes
    ----------
    factor : what its coordinates are to be multiplied by
    """

    def __init__(self, message: str, factor: float) -> None:
        super().__init__(message)
        self.factor = factor


class MissingExtraError(LCollisionError):
    """An optional dependency is not installed; the message names the extra that brings it."""


class CancelledError(LCollisionError):
    """The caller's cancel token was set; nothing was left half-written."""


class LabelStoreError(LCollisionError):
    """A folder cannot be read as labelled samples of a model, or cannot be written."""
