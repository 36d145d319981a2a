"""A new latent space looked at again, by the first samples of its box, before they are labelled."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import LearnedBody
from lcollision_core.bodies.judging import places_of, propose_rules
from lcollision_core.embedding import ROWS_PER_BLOCK, LatentBox
from lcollision_core.embedding.bilevel import BOX_SCALE
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.options import LearningRequest

_N_SAMPLES, _MOST_COORDINATES = 1024, 40_000_000
"""Samples that are looked at, of large meshes fewer: 320 MB of coordinates."""

_BOX_SCALES = (1.2, 1.1, 1.0)
"""Multiples of the range of the poses' codes that the box may be; a smaller one would leave some of
these poses outside."""

_MANY = 0.8
"""Share of the samples up to which a box is not made smaller."""

NEARLY_ALL = 0.95
"""Share of the samples that collide from which a predictor has next to nothing to learn."""

_NAMED_SAMPLES = 64
"""Samples that tell which parts collide most often."""

_LEAST_BOUND = 1e-5
"""What is nearer to 0 is the bound of a code that no pose uses, and stays."""


@dataclass(frozen=True)
class FirstSamples:
    """What the first samples of a latent box say.

    Attributes
    ----------
    n_samples : that were looked at
    colliding_share : of them
    box_scale : the box, as a multiple of the range of the poses' codes
    n_places : pairs of patches that the rules leave out since
    parts : two that collide most often, by their names; none where few samples collide
    row_seconds : that one sample takes to decode and check, on all cores
    """

    n_samples: int
    colliding_share: float
    box_scale: float
    n_places: int
    parts: tuple[str, ...]
    row_seconds: float


class MostlyCollidingError(LCollisionError):
    """Nearly all samples collide, so that a predictor would learn next to nothing."""

    @classmethod
    def of(cls, first: FirstSamples, rig: str, seconds: float) -> MostlyCollidingError:
        """Make the error of what the first samples say.

        Parameters
        ----------
        first : the samples
        rig : the file of a character that can be posed by its joints instead; "" for none
        seconds : that it would take to go on
        """
        where = f", most often {' and '.join(first.parts)}" if first.parts else ""
        instead = f"pose {rig} by its joints, or " if rig else ""
        return cls(
            f"{100.0 * first.colliding_share:.0f} % of the first {first.n_samples} samples of the "
            f"latent space collide{where}: a predictor would call nearly every pose "
            "colliding",
            f"{instead}leave parts out of the check; training it anyway takes about "
            f"{max(1, round(seconds / 60.0))} more minutes",
        )


def look_again(
    model: LearnedBody,
    request: LearningRequest,
    job: Job = UNWATCHED,
) -> tuple[LearnedBody, FirstSamples]:
    """Give a new latent space the box and the contact rules that its own samples ask for.

    Layers that hold their distance in the poses may touch in nearly every sample: patches that do
    are not counted, unless the request ignores nothing. Where most samples collide all the same,
    the box is made smaller, down to the range of the poses' codes.

    Parameters
    ----------
    model : trained, without predictor
    request : by which rules and from which seed
    job : reports (boxes looked at, boxes that there may be); polled between samples

    Raises
    ------
    CancelledError : the job was cancelled.
    """
    given = model
    for tried, scale in enumerate(_BOX_SCALES):
        model = _with_box(given, scale / BOX_SCALE)
        latent = first_samples(model, request.seed)
        began = time.monotonic()
        vertices = model.decode(latent)
        colliding = model.detector.are_colliding(vertices, job=job.part())
        row_seconds = (time.monotonic() - began) / len(latent)
        proposed = None
        if request.ignored != ():
            proposed = propose_rules(model, job=job.part(), poses=vertices, unasked=True)
        share = float(np.mean(colliding))
        if proposed is not None:
            model = model.with_rules(proposed.rules)
            share = proposed.n_colliding_then / len(latent)
        job.report(tried + 1, len(_BOX_SCALES))
        if share <= _MANY:
            break
    n_places = 0 if proposed is None else len(proposed.new)
    parts = _parts(model, vertices[:_NAMED_SAMPLES]) if share > _MANY else ()
    return model, FirstSamples(len(latent), share, scale, n_places, parts, row_seconds)


def first_samples(model: LearnedBody, seed: int) -> npt.NDArray[np.float32]:
    """Return the first (n, D) samples of a model's box."""
    n_samples = min(_N_SAMPLES, _MOST_COORDINATES // (3 * model.n_vertices))
    blocks = range(max(1, n_samples // ROWS_PER_BLOCK))
    return np.concatenate([model.embedding.box.draw(seed, block) for block in blocks])


def notes_of(first: FirstSamples) -> list[str]:
    """Say what was changed because of the first samples."""
    notes = []
    if first.n_places:
        notes.append(
            f"{first.n_places} places that touch in nearly every one of the first "
            f"{first.n_samples} samples are not counted"
        )
    if first.box_scale != BOX_SCALE:
        notes.append(
            f"the latent box is {first.box_scale:g} times the range of the poses, and not "
            f"{BOX_SCALE:g}, as most samples of a larger one collide"
        )
    return notes


def _with_box(model: LearnedBody, share: float) -> LearnedBody:
    """Return a model with its box scaled."""
    box = model.embedding.box
    scaled = LatentBox(
        np.minimum(share * box.low, np.maximum(box.low, -_LEAST_BOUND)),
        np.maximum(share * box.high, np.minimum(box.high, _LEAST_BOUND)),
    )
    return LearnedBody(model.name, replace(model.embedding, box=scaled), model.card)


def _parts(model: LearnedBody, vertices: npt.NDArray[Any]) -> tuple[str, ...]:
    """Return the names of the two parts that collide most often."""
    found = [model.detector.detect(pose, counted_only=True) for pose in vertices]
    pairs = np.concatenate([one.pairs for one in found])
    return next(iter(places_of(model, map(tuple, pairs.tolist()))), ())
