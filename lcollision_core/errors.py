"""Errors that users see: the problem, its place, the expected value and the next step."""

from __future__ import annotations

import copyreg
from collections.abc import Iterable
from typing import Any, Final, Self


class LCollisionError(Exception):
    """Base of every error that a user can fix; its text is one sentence, composed here.

    The sentence is "WHERE WHAT, expected EXPECTED, got GOT; NEXT STEP" without the parts that
    are empty, or "WHERE must be EXPECTED, got GOT; NEXT STEP" if `what` is empty.

    Parameters
    ----------
    what : the problem with `where`, such as "cannot be read"
    next_step : advice for the user, such as "export it again"; may be empty
    where : the file, pose or option concerned, such as "pose 12 (mesh012.obj)"
    expected, got : the required value and the actual one

    Attributes
    ----------
    what, next_step, where, expected, got : the parameters as strings
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

        The reason may be an exception; the next step of an `LCollisionError`, if any, is used.
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
        """Make the error for a file of a later format version than `known`."""
        what = f"has format version {version}, this program reads up to {known}"
        return cls(what, "update the program", where=where)

    @classmethod
    def from_error(cls, error: LCollisionError, where: str | None = None) -> Self:
        """Make an error of this class from another one, optionally with another `where`."""
        where = error.where if where is None else where
        what, next_step = error.what, error.next_step
        return cls(what, next_step, where=where, expected=error.expected, got=error.got)

    @property
    def headline(self) -> str:
        """The sentence without the next step."""
        sentence = f"{self.where} {self.what or f'must be {self.expected}'}".lstrip()
        sentence += f", expected {self.expected}" if self.what and self.expected else ""
        return f"{sentence}, got {self.got}" if self.got else sentence

    def __str__(self) -> str:
        return f"{self.headline}; {self.next_step}" if self.next_step else self.headline

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        # By default, pickling restores an exception from `args`, which lacks the fields.
        return copyreg.__newobj__, (type(self), self.what), self.__dict__  # type: ignore[attr-defined]


def listed(names: Iterable[object], most: int = 8) -> str:
    """List names in a sentence, at most so many, as in "hat, belt and 3 more"."""
    texts = [*map(str, names)]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


class ShapeError(LCollisionError, ValueError):
    """An array has the wrong shape or dtype."""


class MeshFileError(LCollisionError):
    """A file cannot be read as a mesh or a pose set, or cannot be written."""


class UnwritablePoseError(MeshFileError):
    """An export form of a character's file cannot hold a pose."""


class ModelFileError(LCollisionError):
    """A file cannot be read as a model or as poses of a model, or cannot be written."""


class FileLockedError(MeshFileError):
    """Another process has locked a file."""


class PoseSetError(LCollisionError):
    """Meshes cannot form one pose set: their topologies differ, or a pose is unusable."""


class WrongScaleError(PoseSetError):
    """A mesh is not in the required unit.

    Attributes
    ----------
    factor : scale factor that corrects its coordinates
    """

    def __init__(self, what: str, next_step: str = "", *, factor: float = 1.0, **fields: object):
        super().__init__(what, next_step, **fields)
        self.factor: Final = factor


class MissingExtraError(LCollisionError):
    """An optional dependency is not installed; the next step names the extra that provides it."""


class CancelledError(LCollisionError):
    """The job was cancelled; no file is left half-written."""


class LabelStoreError(LCollisionError):
    """A folder of labelled samples of a model cannot be read or written."""
