"""The errors that users see: problem, place, expected value and next step."""

from __future__ import annotations

import copyreg
from typing import Any, Final, Self


class LCollisionError(Exception):
    """Base of every error that a user can fix; its text is one sentence, composed here alone.

    The sentence is "WHERE WHAT, expected EXPECTED, got GOT; NEXT STEP" without the parts that
    are empty, and "WHERE must be EXPECTED, got GOT; NEXT STEP" where `what` is empty.

    Parameters
    ----------
    what : what is wrong with `where`, as in "cannot be read"
    next_step : what the user can do, as in "export the mesh again"; empty if there is nothing
    where : the file, the pose or the option concerned, as in "pose 12 (mesh012.obj)"
    expected, got : what was needed, and what is there instead

    Attributes
    ----------
    what, next_step, where, expected, got : the same as texts
    """

    def __init__(
        self,
        what: str,
        next_step: str = "",
        *,
        where: object = "",
        expected: object = "",
        got: object = "",
    ) -> None:
        super().__init__(what)
        self.what: Final = what
        self.next_step: Final = next_step
        self.where: Final = str(where)
        self.expected: Final = str(expected)
        self.got: Final = str(got)

    @classmethod
    def must_be(cls, where: object, expected: object, got: object, next_step: str = "") -> Self:
        """Make the error "WHERE must be EXPECTED, got GOT; NEXT STEP"."""
        return cls("", next_step, where=where, expected=expected, got=got)

    @classmethod
    def because(cls, where: object, what: str, reason: object, next_step: str = "") -> Self:
        """Make the error "WHERE WHAT: REASON; NEXT STEP".

        The reason may be an error. Its own next step, if it has one, is taken instead.
        """
        if isinstance(reason, LCollisionError):
            next_step, reason = reason.next_step or next_step, reason.headline
        elif isinstance(reason, OSError):
            reason = reason.strerror or reason
        return cls(f"{what}: {reason}", next_step, where=where)

    @classmethod
    def unreadable(cls, path: object, reason: object, next_step: str = "") -> Self:
        """Make the error "PATH cannot be read: REASON; NEXT STEP"."""
        return cls.because(path, "cannot be read", reason, next_step)

    @classmethod
    def unwritable(cls, path: object, reason: object, next_step: str = "") -> Self:
        """Make the error "PATH cannot be written: REASON; NEXT STEP"."""
        return cls.because(path, "cannot be written", reason, next_step)

    @classmethod
    def too_new(cls, where: object, version: object, known: int) -> Self:
        """Make the error for a file of a later format version than the one that is known."""
        what = f"has format version {version}, this program reads up to {known}"
        return cls(what, "update the program", where=where)

    @classmethod
    def like(cls, error: LCollisionError, where: str | None = None) -> Self:
        """Make an error with the fields of another one, whatever its class, or about `where`."""
        where = error.where if where is None else where
        what, next_step = error.what, error.next_step
        return cls(what, next_step, where=where, expected=error.expected, got=error.got)

    @property
    def headline(self) -> str:
        """The sentence without the next step."""
        said = f"{self.where} {self.what or f'must be {self.expected}'}".lstrip()
        said += f", expected {self.expected}" if self.what and self.expected else ""
        return f"{said}, got {self.got}" if self.got else said

    def __str__(self) -> str:
        return f"{self.headline}; {self.next_step}" if self.next_step else self.headline

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        # Pickling copies an exception by its positional arguments; the fields are none.
        return copyreg.__newobj__, (type(self), self.what), self.__dict__  # type: ignore[attr-defined]


class ShapeError(LCollisionError, ValueError):
    """An array has another shape or dtype than the function documents."""


class MeshFileError(LCollisionError):
    """A file cannot be read as a mesh or a pose set, or cannot be written."""


class UnwritablePoseError(MeshFileError):
    """A form of a character's file cannot hold a pose."""


class ModelFileError(LCollisionError):
    """A file cannot be read as a model or as poses of a model, or cannot be written."""


class HeldElsewhereError(MeshFileError):
    """Another process holds the lock of a file."""


class PoseSetError(LCollisionError):
    """Meshes cannot form one pose set: their topology differs, or a pose is not usable."""


class WrongScaleError(PoseSetError):
    """A mesh is not in the unit that is needed.

    Attributes
    ----------
    factor : multiplies its coordinates
    """

    def __init__(self, what: str, next_step: str = "", *, factor: float = 1.0, **fields: object):
        super().__init__(what, next_step, **fields)
        self.factor: Final = factor


class MissingExtraError(LCollisionError):
    """An optional dependency is not installed; the next step names the extra that brings it."""


class CancelledError(LCollisionError):
    """The caller's job was cancelled; nothing was left half-written."""


class LabelStoreError(LCollisionError):
    """A folder cannot be read as labelled samples of a model, or cannot be written."""
