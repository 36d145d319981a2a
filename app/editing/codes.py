"""What sliders, locks and buttons do to the codes of the working pose."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import QObject, Signal

from app.editing.history import PoseHistory, read_only
from app.wording import counted
from lcollision_core.errors import LCollisionError

if TYPE_CHECKING:
    from lcollision_core.model import NamedPose, PosableBody

FloatArray = npt.NDArray[np.float64]


class CodeEditing(PoseHistory):
    """Edits the working pose of a model by its codes; see `PoseDocument` for the signals.

    Attributes
    ----------
    locked_domains : not changed by Resolve, Randomise, Reset all and blending
    """

    locks_changed = Signal()
    message = Signal(str)

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._model: PosableBody | None = None
        self.locked_domains: frozenset[int] = frozenset()

    @property
    def has_model(self) -> bool:
        """Whether a model is loaded."""
        return self._model is not None

    @property
    def model(self) -> PosableBody:
        """The model that the pose belongs to."""
        if self._model is None:
            raise LCollisionError("no model is open yet", "open one first")
        return self._model

    def load_pose(self, pose: NamedPose) -> None:
        """Edit a pose under its name; one of some codes only, as of hands, leaves the others."""
        if pose.moves is None:
            super().load_pose(pose)
            return
        self._tell_if_locked()
        self._edit(pose.name, self._with_locked(pose.applied_to(self.latent)))

    def set_code(self, index: int, value: float) -> None:
        """Set one number of the latent; a number that is not finite is ignored.

        Parameters
        ----------
        index : from 0, in the latent's order
        value : beyond the sliders' range too, as in poses that came in as meshes
        """
        if not np.isfinite(value) or value == self._wanted[index]:
            return
        self._set_codes(f"Move {self.code_name(index)}", index, value, run=index)

    def reset_code(self, index: int) -> None:
        """Set one number of the latent to 0."""
        self._set_codes(f"Reset {self.code_name(index)}", index, 0.0)

    def reset_all(self) -> None:
        """Set all numbers to 0 and remove all pins in one step; say which locked domains stay.

        The body goes there at once, whatever is in the way, as to any pose that is loaded.
        """
        self._close_gesture()
        state = self._with_latent(read_only(self._with_locked(np.zeros_like(self.latent))))
        self._push("Reset all", replace(state, pose=replace(state.pose, pins=())))
        if self.locked_domains and not self.all_locked:
            n_locked = counted(len(self.locked_domains), "locked body part")
            self.message.emit(f"Everything was reset except {n_locked}: see Edit > Unlock all")
        self._tell_if_locked()

    def randomise(self, amount: float, seed: int) -> None:
        """Move the pose towards a random one, except its locked domains.

        Parameters
        ----------
        amount : 0 leaves the pose, 1 goes all the way to a random one: see `PosableBody.sample`
        seed : equal seeds draw equal poses
        """
        self._tell_if_locked()
        drawn = self.model.sample(1, np.random.default_rng(seed))[0]
        latent = (1.0 - amount) * self.latent + amount * drawn
        self._edit("Randomise", self._with_locked(latent))

    def blend_towards(self, latent: npt.ArrayLike, fraction: float) -> None:
        """Blend from the pose at the start of the gesture, fraction 0, to another (D,) one, 1.

        Locked domains stay as they are.
        """
        start = self._gesture_start
        target = np.asarray(latent, dtype=np.float64)
        blended = target.copy() if fraction == 1.0 else start + fraction * (target - start)
        self._edit("Blend", self._with_locked(blended))

    def code_name(self, index: int) -> str:
        """Return the display name of one latent entry."""
        group = next(g for g in self.model.latent_space.groups if index < g.codes.stop)
        name = self.model.code_names[index]
        return name if group.colour is None else f"{group.name}, {name}"

    def reset_domain(self, domain: int) -> None:
        """Set all numbers of a domain to 0: its own, and its entry of the whole body."""
        codes = self.model.space.codes_of([domain])
        self._set_codes(f"Reset {self.model.domain_names[domain]}", codes, 0.0)

    def _set_codes(self, label: str, codes: Any, value: float, run: int | None = None) -> None:
        latent = self._wanted.copy()
        latent[codes] = value
        self._edit(label, latent, run)

    @property
    def _wanted(self) -> FloatArray:
        """(D,) codes that an edit of some of them begins with."""
        return self.latent

    @property
    def _gesture_start(self) -> FloatArray:
        """(D,) codes that the gesture began with; without one the wanted ones."""
        return self._gesture.before.pose.latent if self._gesture else self._wanted

    def set_locked(self, domain: int, locked: bool) -> None:
        """Lock a domain against Resolve, Randomise, Reset all and blending, or unlock it."""
        changed = self.locked_domains | {domain} if locked else self.locked_domains - {domain}
        if changed != self.locked_domains:
            self.locked_domains = changed
            self._follow_locks()
            self.locks_changed.emit()

    def _follow_locks(self) -> None:
        """Notify the workers, then the widgets, of changed locks."""

    def training_pose(self, number: int) -> NamedPose:
        """Return a training pose of the model by its number, from 0."""
        from lcollision_core.model import NamedPose

        return NamedPose(self.model.card.pose_names[number], self.model.training_latent[number])

    @property
    def starter_poses(self) -> list[NamedPose]:
        """Poses to begin with, none of a body whose joints are not known."""
        from lcollision_core.model import NamedPose

        return [
            NamedPose(pose.name, pose.codes, moves=pose.moves) for pose in self.model.starter_poses
        ]

    @property
    def all_locked(self) -> bool:
        """Whether every domain is locked, so that nothing but a slider can move the pose."""
        return self.has_model and len(self.locked_domains) == len(self.model.domain_names)

    def _tell_if_locked(self) -> None:
        if self.all_locked:
            self.message.emit("All body parts are locked; unlock one to move the pose")

    def _with_locked(self, latent: FloatArray) -> FloatArray:
        """Return the latent with the current codes of locked domains."""
        return np.where(self.model.space.codes_of(self.locked_domains), self.latent, latent)
