"""What is computed of a pose for the screen: mesh, normals, prediction and exact check."""

from __future__ import annotations

import statistics
import time
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from lcollision_core.contact import RuleCounts, SelfCollisions
    from lcollision_core.model import PosableBody
    from lcollision_core.posing import PoseDragger

Float32Array = npt.NDArray[np.float32]
FloatArray = npt.NDArray[np.float64]

_QUICK_CHECK_SECONDS = 0.006
"""An exact check that takes less accompanies every frame; others wait until the pose rests."""

_CHECKS = 5
"""Recent checks whose median time counts."""

NO_POINTS: FloatArray = np.empty((0, 3))
NO_POINTS.flags.writeable = False


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """What the predictor estimates of one pose.

    Attributes
    ----------
    domain_energy : (K,) float64 array, read-only, >= 0, in normalised lengths squared
    collision_probability : above 0.5 where the pose is estimated to collide
    """

    domain_energy: FloatArray
    collision_probability: float


@dataclass(frozen=True, eq=False)
class ExactVerdict:
    """The exact check of the vertices of one frame, as they are drawn and exported.

    Attributes
    ----------
    request_id : of the frame that was checked
    pairs : (P, 2) int32 array, read-only, the colliding faces, the smaller first
    excluded_pairs : (Q, 2) int32 array, read-only, colliding faces that the contact rules leave out
    excluded : how many of them each rule leaves out; None of a pose that is dragged, as only pairs
        that count are looked for until it rests
    energy : of the whole pose, in normalised lengths squared
    vertex_energy : (V,) float64 array, read-only, in normalised lengths squared
    colliding : whether there is a pair that counts
    """

    request_id: int
    pairs: npt.NDArray[np.int32]
    excluded_pairs: npt.NDArray[np.int32]
    excluded: RuleCounts | None
    energy: float
    vertex_energy: FloatArray
    colliding: bool

    @classmethod
    def of(
        cls, found: SelfCollisions, request_id: int, *, counted_only: bool = False
    ) -> ExactVerdict:
        """Keep what was found of a frame."""
        return cls(
            request_id=request_id,
            pairs=_frozen(found.pairs),
            excluded_pairs=_frozen(found.excluded_pairs),
            excluded=None if counted_only else found.excluded,
            energy=found.energy,
            vertex_energy=_frozen(found.vertex_energy),
            colliding=found.colliding,
        )


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """One pose as it is drawn; all of it belongs to one latent.

    Attributes
    ----------
    request_id : rises from frame to frame
    latent : (D,) float64 array, read-only
    vertices : (V, 3) float32 array, read-only, in the data's unit, in the reference's frame
    normals : (V, 3) float32 array, read-only, of length 1, area-weighted
    prediction : None for a model without a predictor
    seconds : of its thread that all of it took, whatever else the machine does
    verdict : the exact check, where it came at once
    contacts : (C, 3) float64 array, points of the surface, in the data's unit, where contact keeps
        the pose from going on towards its target
    standing : (S, 3) float64 array, points of the surface that a drag leaves on the ground
    target : of the drag that led here, None for a pose that was asked for
    miss : what is left to the target: normalised length, radians of a twist
    settled : whether the same target would lead no further
    """

    request_id: int
    latent: FloatArray
    vertices: Float32Array
    normals: Float32Array
    prediction: PosePrediction | None
    seconds: float
    verdict: ExactVerdict | None
    contacts: FloatArray
    standing: FloatArray
    target: FloatArray | None = None
    miss: float = 0.0
    settled: bool = True


class FrameEvaluator:
    """Computes frames and exact checks of one model; for one thread at a time.

    Parameters
    ----------
    model : of all poses

    Attributes
    ----------
    predicts : whether frames get predictions, as far as the model has a predictor
    """

    def __init__(self, model: PosableBody) -> None:
        self.model = model
        self.predicts = True
        self._checks: deque[float] = deque(maxlen=_CHECKS)

    def frame(self, latent: FloatArray, request_id: int) -> LiveFrame:
        """Decode, shade and predict one pose.

        Parameters
        ----------
        latent : (D,) finite array
        request_id : of the frame
        """
        start = time.thread_time()
        vertices = self.model.decode(latent, n_threads=1).astype(np.float32)
        return self._evaluated(latent, vertices, request_id, start)

    def dragged(self, dragger: PoseDragger, target: FloatArray, request_id: int) -> LiveFrame:
        """Drag a pose towards a target, and shade and predict where it has come.

        Parameters
        ----------
        dragger : of this model, whose drag has begun
        target : see `PoseDragger.move`
        request_id : of the frame
        """
        start = time.thread_time()
        step = dragger.move(target)
        frame = self._evaluated(step.latent, step.vertices, request_id, start, step.found)
        return replace(
            frame,
            contacts=_frozen(step.contacts),
            standing=_frozen(step.standing),
            target=target,
            miss=step.miss,
            settled=step.settled,
        )

    def _evaluated(
        self,
        latent: FloatArray,
        vertices: Float32Array,
        request_id: int,
        start: float,
        found: SelfCollisions | None = None,
    ) -> LiveFrame:
        verdict = None
        if found is not None:
            counted_only = not self.model.rules.exclude_nothing
            verdict = ExactVerdict.of(found, request_id, counted_only=counted_only)
        elif self._checks and statistics.median(self._checks) < _QUICK_CHECK_SECONDS:
            verdict = self._checked(vertices, request_id)
        predicts = self.predicts and self.model.has_predictor
        return LiveFrame(
            request_id=request_id,
            latent=latent,
            vertices=_frozen(vertices),
            normals=_frozen(self.normals(vertices)),
            prediction=self._predict(latent) if predicts else None,
            verdict=verdict,
            contacts=NO_POINTS,
            standing=NO_POINTS,
            seconds=time.thread_time() - start,
        )

    def _predict(self, latent: FloatArray) -> PosePrediction:
        predicted = self.model.predict(latent[None])
        return PosePrediction(
            domain_energy=_frozen(predicted.domain_energy[0]),
            collision_probability=float(predicted.collision_probability[0]),
        )

    def verdict(self, frame: LiveFrame) -> ExactVerdict:
        """Check the vertices of a frame exactly."""
        return self._checked(frame.vertices, frame.request_id)

    def _checked(self, vertices: Float32Array, request_id: int) -> ExactVerdict:
        start = time.thread_time()
        found = self.model.detector.detect(vertices)
        self._checks.append(time.thread_time() - start)
        return ExactVerdict.of(found, request_id)

    def normals(self, vertices: Float32Array) -> Float32Array:
        """Return the (V, 3) float32 normals of (V, 3) float32 vertices."""
        from lcollision_core.meshes.normals import vertex_normals

        return vertex_normals(vertices, self.model.faces)


def keep_torch_to_one_thread(model: PosableBody) -> None:
    """Let torch use one core in the calling thread: a single pose is too small to parallelise.

    On a busy machine torch's threads wait for each other: one prediction took 32 ms instead of
    0.4. Does nothing for a model whose predictions of a pose need no torch.
    """
    if model.prediction_needs_torch:
        import torch

        torch.set_num_threads(1)


def _frozen(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    array.flags.writeable = False
    return array
