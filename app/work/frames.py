"""Frames of a pose for the screen: mesh, normals, prediction and exact check."""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from lcollision_core.bodies import Body
    from lcollision_core.contact import NearestPair, SelfCollisions
    from lcollision_core.meshes import RigidTransform
    from lcollision_core.posing import PoseDragger, PoseSpace

Float32Array = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]

SpaceFactory = Callable[[], "PoseSpace"]
"""Returns the body's pose space in a motion's frame: see `Motion.space_at`."""

_QUICK_CHECK_SECONDS = 0.006
"""A faster exact check accompanies every frame; a slower one waits until the pose rests."""

_CHECKS = 5
"""Number of recent checks whose median time is used."""


def empty_points() -> FloatArray:
    """Return an empty (0, 3) array, read-only."""
    return _frozen(np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """The predictor's estimate for one pose.

    Attributes
    ----------
    domain_energy : (K,) float64 array, read-only, >= 0, in normalised lengths squared
    collision_probability : above 0.5 where the pose is estimated to collide
    """

    domain_energy: FloatArray
    collision_probability: float


@dataclass(frozen=True, eq=False)
class PoseFrame:
    """One pose as drawn; everything in it belongs to one latent.

    Attributes
    ----------
    latent : (D,) float64 array, read-only
    vertices : (V, 3) float32 array, read-only, in the data's unit, aligned to the reference
    normals : (V, 3) float32 array, read-only, of length 1, area-weighted
    prediction : None without a prediction
    found : the exact check of the vertices; None until they are checked
    seconds : thread time of the computation
    contacts : (C, 3) float64 array, points of the surface, in the data's unit, where contact keeps
        the pose from approaching its target
    standing : (S, 3) float64 array, points of the surface that a drag keeps on the ground
    target : that the pose was moved towards; None if it was requested unchanged
    miss : the remaining distance to the target: normalised length, or radians of a twist
    settled : whether the same target would move the pose no further
    """

    latent: FloatArray
    vertices: Float32Array
    normals: Float32Array
    prediction: PosePrediction | None
    found: SelfCollisions | None
    seconds: float
    contacts: FloatArray = field(default_factory=empty_points)
    standing: FloatArray = field(default_factory=empty_points)
    target: FloatArray | None = None
    miss: float = 0.0
    settled: bool = True

    @property
    def is_checked(self) -> bool:
        """Whether all colliding pairs are known, including those that contact rules leave out."""
        return self.found is not None and not self.found.counted_only


@dataclass(frozen=True, eq=False)
class MeasuredFrame:
    """A frame with the nearest pair of its surface.

    Attributes
    ----------
    frame : of the pose
    nearest : None if no pair is nearer than `DISTANCE_BOUND`
    """

    frame: PoseFrame
    nearest: NearestPair | None


class FrameEvaluator:
    """Computes frames and exact checks of one model; for one thread at a time.

    Parameters
    ----------
    model : of all poses

    Attributes
    ----------
    predicts : whether frames get predictions, if the model has a predictor
    """

    def __init__(self, model: Body) -> None:
        self.model = model
        self.predicts = True
        self._checks: deque[float] = deque(maxlen=_CHECKS)

    def frame(
        self,
        latent: FloatArray,
        checks: bool = True,
        placement: RigidTransform | None = None,
        space: PoseSpace | None = None,
    ) -> PoseFrame:
        """Decode, shade and predict one pose, and check it if that is quick.

        Parameters
        ----------
        latent : (D,) finite array
        checks : False omits the exact check
        placement, space : of a motion's frame: see `ExactCheck`
        """
        start = time.thread_time()
        check = self.model.exact_check(placement, space)
        vertices = check.drawn(check.decode(latent)[0])
        is_quick = (
            checks and self._checks and statistics.median(self._checks) < _QUICK_CHECK_SECONDS
        )
        collisions = self._found(vertices) if is_quick else None
        return self._drawn(latent, vertices, collisions, start)

    def moved(self, dragger: PoseDragger, target: FloatArray) -> PoseFrame:
        """Move a pose towards a target, and shade and predict the result.

        Parameters
        ----------
        dragger : of this model, with a drag in progress
        target : see `PoseDragger.move`
        """
        start = time.thread_time()
        step = dragger.move(target)
        return self._drawn(
            step.latent,
            step.vertices,
            step.crossing,
            start,
            contacts=_frozen(step.contacts),
            standing=_frozen(step.standing),
            target=target,
            miss=step.miss,
            settled=step.settled,
        )

    def checked(self, frame: PoseFrame) -> PoseFrame:
        """Check the vertices of a frame exactly."""
        return replace(frame, found=self._found(frame.vertices))

    def measured(self, frame: PoseFrame) -> MeasuredFrame:
        """Find the nearest pair of a frame's surface."""
        from lcollision_core.contact import DISTANCE_BOUND

        return MeasuredFrame(
            frame, self.model.detector.least_distance(frame.vertices, DISTANCE_BOUND)
        )

    def _drawn(
        self,
        latent: FloatArray,
        vertices: Float32Array,
        found: SelfCollisions | None,
        start: float,
        **moved: Any,
    ) -> PoseFrame:
        predicts = self.predicts and self.model.has_predictor
        return PoseFrame(
            latent,
            _frozen(vertices),
            _frozen(self.normals(vertices)),
            self._predict(latent) if predicts else None,
            found,
            time.thread_time() - start,
            **moved,
        )

    def _predict(self, latent: FloatArray) -> PosePrediction:
        predicted = self.model.predict(latent[None])
        return PosePrediction(
            domain_energy=_frozen(predicted.domain_energy[0]),
            collision_probability=float(predicted.collision_probability[0]),
        )

    def _found(self, vertices: Float32Array) -> SelfCollisions:
        start = time.thread_time()
        collisions = self.model.detector.detect(vertices)
        self._checks.append(time.thread_time() - start)
        return collisions

    def normals(self, vertices: Float32Array) -> Float32Array:
        """Return the (V, 3) float32 normals of (V, 3) float32 vertices."""
        from lcollision_core.meshes.normals import vertex_normals

        return vertex_normals(vertices, self.model.faces)


def keep_torch_to_one_thread(model: Body) -> None:
    """Let torch use one core in the calling thread: a single pose is too small to parallelise.

    On a busy machine torch's threads wait for each other: one prediction took 32 ms instead of
    0.4 ms. Does nothing if predicting a pose needs no torch.
    """
    if model.prediction_needs_torch:
        import torch

        torch.set_num_threads(1)


def _frozen(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    array.flags.writeable = False
    return array
