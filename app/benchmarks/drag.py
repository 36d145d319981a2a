"""Scripted drags of a model's hands, feet, head and elbows, plain and solid.

Each drag starts at the first free training pose, takes 45 events to the target and rests there for
15. Of every four targets, one is the patch's position in a training pose, one is on the body, one
lies beyond the torso and one is out of reach. In every second group of four a foot is pinned: the
left one, or the right one while the left is dragged.

The fields of a row:

mode : "plain" or "solid"
vertices, drags, events : how many
median_ms, p95_ms, max_ms : per event, decoding and exact check included, on one core
exactly_free_rate : of the poses after each event, by the exact check
confirmed : free poses that were also checked by all pairs of faces, without a tree; a random
    hundredth of the solid ones
confirmed_free_rate : of those
miss_mean, miss_reachable : mean remaining distance to the target, over all targets and over those
    that a training pose reaches; normalised
rest_motion : mean displacement of the vertices farther than 0.25 from the patch; normalised
others_motion : median, over the other limbs of all drags, of the mean displacement of their
    vertices; normalised
others_bent : largest deformation of another limb, the root mean square distance of its vertices
    after the best rigid motion; normalised
largest_stretch : largest ratio of an edge's length to its longest in a training pose
pin_drift, pin_drift_reachable : the most that a pin moved, over all drags and over those whose
    target a training pose reaches; normalised; None without such a drag
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import csgraph

from app.benchmarks.measures import Row, is_free_by_brute_force
from lcollision_core.bodies import Body
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.alignment import fit_rigid
from lcollision_core.meshes.limbs import Limbs
from lcollision_core.posing import DragOptions, Grip, Pin, far_end, make_grip
from lcollision_core.posing.dragger import largest_stretch

FloatArray = npt.NDArray[np.float64]

TARGETS = 40
MOVING_EVENTS, EVENTS = 45, 60

_ELBOW, _REST = 0.22, 0.25
"""Normalised length along the surface from a hand to its elbow, and least distance from the patch,
on the reference, of the vertices of `rest_motion`."""

_KINDS = ("reachable", "body", "beyond", "far")
_FAR = 0.8
_CONFIRMED = 0.01


class _Drag(NamedTuple):
    """One scripted drag; lengths in the data's unit."""

    grip: Grip
    pins: tuple[Pin, ...]
    target: FloatArray
    kind: str


def time_drags(
    model: Body,
    n_targets: int = TARGETS,
    job: Job = UNWATCHED,
) -> list[Row]:
    """Run all drags, plain and solid, on the calling thread.

    Parameters
    ----------
    n_targets : of each grip
    job : reports drags, and is polled before each

    Raises
    ------
    LCollisionError : no training pose is free.
    CancelledError : the job was cancelled.
    """
    training = model.decode(model.known_poses.astype(np.float64), n_threads=1)
    free = ~model.detector.are_colliding(training.astype(np.float32))
    if not free.any():
        raise LCollisionError("no training pose is free", "use another model", where=model.name)
    first = int(free.argmax())
    start = model.known_poses[first].astype(np.float64)
    drags = _scripted(model, training[first], training, n_targets, np.random.default_rng(0))
    return [
        _time_mode(model, start, drags, solid, np.random.default_rng(0), done, job)
        for done, solid in ((0, False), (len(drags), True))
    ]


def _scripted(
    model: Body,
    vertices: FloatArray,
    training: FloatArray,
    n_targets: int,
    generator: np.random.Generator,
) -> list[_Drag]:
    places = _places(model, vertices)
    grips = {name: make_grip(model.space, vertex) for name, vertex in places.items()}
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    drags = []
    for name, grip in grips.items():
        start = grip.position(vertices)
        foot = grips["left foot" if name != "left foot" else "right foot"]
        for number in range(n_targets):
            kind = _KINDS[number % len(_KINDS)]
            if kind == "reachable":
                target = grip.position(training[generator.integers(len(training))])
            elif kind == "body":
                target = vertices[generator.choice(model.topology.used_vertices)]
            elif kind == "beyond":
                target = start + generator.uniform(1.2, 2.0) * (middle - start)
            else:
                way = generator.normal(size=3)
                target = start + _FAR * model.body_size * way / np.linalg.norm(way)
            pins = (Pin.of(foot, vertices),) if number // len(_KINDS) % 2 else ()
            drags.append(_Drag(grip, pins, np.asarray(target, dtype=np.float64), kind))
    return drags


def _places(model: Body, vertices: FloatArray) -> dict[str, int]:
    """Return a vertex of the head and of each hand, foot and elbow.

    The five ends are farthest from each other along the surface; for a rig, whose surface may
    have many pieces, they follow from its joints.
    """
    if model.joints is not None:
        return _places_on_rig(model, model.joints)
    up = np.eye(3)[model.up_axis]
    graph = model.space.surface_graph

    def along(vertex: int) -> FloatArray:
        distances = csgraph.dijkstra(graph, directed=False, indices=vertex)
        return np.where(np.isfinite(distances), distances, -1.0)

    ends = [int((vertices @ up).argmax())]
    nearest = along(ends[0])
    for _ in range(4):
        ends.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, along(ends[-1]))
    left = np.cross(up, model.front)
    low = sorted(ends[1:], key=lambda end: float(vertices[end] @ up))[:2]
    places = {"head": ends[0]}
    for pair, name in ((low, "foot"), ([end for end in ends[1:] if end not in low], "hand")):
        right_end, left_end = sorted(pair, key=lambda end: float(vertices[end] @ left))
        places |= {f"left {name}": left_end, f"right {name}": right_end}
    for side in ("left", "right"):
        away = along(places[f"{side} hand"])
        places[f"{side} elbow"] = int(np.abs(away - _ELBOW).argmin())
    return places


def _places_on_rig(model: Body, space: RigPoseSpace) -> dict[str, int]:
    parts = {name.casefold(): domain for domain, name in enumerate(model.domain_names)}
    sides = [f"{side} {name}" for side in ("left", "right") for name in ("foot", "hand", "forearm")]
    missing = {"head", *sides} - parts.keys()
    if missing:
        raise LCollisionError(
            f"has no {min(missing)} to drag", "use another character", where=model.name
        )
    places = {"head": far_end(space, parts["head"])}
    for side in ("left", "right"):
        for name in ("foot", "hand"):
            places[f"{side} {name}"] = far_end(space, parts[f"{side} {name}"])
        forearm = parts[f"{side} forearm"]
        first = int(np.flatnonzero(space.codes_of([forearm]))[0])
        inside = np.flatnonzero(space.vertex_domain == forearm)
        away = space.rest_vertices[inside] - space.origins[space.joint_of_code[first]]
        places[f"{side} elbow"] = int(inside[np.linalg.norm(away, axis=1).argmin()])
    return places


def _other_limbs(limbs: Limbs, grip: Grip) -> list[npt.NDArray[np.intp]]:
    """Return the vertices of each limb that neither carries a patch nor hangs on one that does."""
    held_joints = set(limbs.path(limbs.held_segment(grip.vertices, grip.weights)))
    tops = limbs.tops[limbs.leads]
    return [np.flatnonzero(tops == top) for top in np.unique(tops) if top not in held_joints]


def _time_mode(
    model: Body,
    start: FloatArray,
    drags: list[_Drag],
    solid: bool,
    generator: np.random.Generator,
    done: int,
    job: Job,
) -> Row:
    dragger, size = model.dragger(), model.body_size
    seconds: list[float] = []
    free: list[bool] = []
    confirmed: list[bool] = []
    misses, rest, stretch, others, bent = [], [], [], [], []
    drifts: list[tuple[str, float]] = []
    options = DragOptions(solid=solid)
    before = model.decode(start, n_threads=1)
    # Compiling and one-time set-up are not timed.
    dragger.begin(start, drags[0].grip, drags[0].pins, options)
    dragger.move(drags[0].target)
    for number, drag in enumerate(drags):
        job.check()
        begin = drag.grip.position(before)
        dragger.begin(start, drag.grip, drag.pins, options)
        for event in range(1, EVENTS + 1):
            aim = begin + min(1.0, event / MOVING_EVENTS) * (drag.target - begin)
            since = time.perf_counter()
            step = dragger.move(aim)
            seconds.append(time.perf_counter() - since)
            is_free = not model.detector.are_colliding(step.vertices[None], workers=1)[0]
            free.append(is_free)
            if solid and is_free and generator.random() < _CONFIRMED:
                confirmed.append(is_free_by_brute_force(model, step.vertices))
        misses.append(step.miss)
        after = model.decode(step.latent, n_threads=1)
        reach = np.linalg.norm(model.reference - model.reference[drag.grip.vertex], axis=1)
        moved = np.linalg.norm(after - before, axis=1)[reach > _REST * size]
        rest.append(float(moved.mean()) / size)
        for limb in _other_limbs(model.space.limbs, drag.grip):
            others.append(float(np.linalg.norm(after[limb] - before[limb], axis=1).mean()))
            rotation, translation = fit_rigid(before[limb], after[limb])
            left = before[limb] @ rotation.T + translation - after[limb]
            bent.append(float(np.sqrt((left**2).sum(axis=1).mean())))
        longest = model.space.longest_edges
        stretch.append(largest_stretch(after / size, model.topology.edges, longest))
        for pin in drag.pins:
            there = make_grip(model.space, pin.vertex, pin.radius).position(after)
            drifts.append((drag.kind, float(np.linalg.norm(there - pin.position)) / size))
        job.report(done + number + 1, 2 * len(drags))
    reachable = np.array([drag.kind == "reachable" for drag in drags])
    milliseconds = 1e3 * np.array(seconds)
    return {
        "mode": "solid" if solid else "plain",
        "vertices": model.n_vertices,
        "drags": len(drags),
        "events": len(seconds),
        "median_ms": float(np.median(milliseconds)),
        "p95_ms": float(np.quantile(milliseconds, 0.95)),
        "max_ms": float(milliseconds.max()),
        "exactly_free_rate": float(np.mean(free)),
        "confirmed": len(confirmed),
        "confirmed_free_rate": float(np.mean(confirmed)) if confirmed else None,
        "miss_mean": float(np.mean(misses)),
        "miss_reachable": float(np.mean(np.array(misses)[reachable])),
        "rest_motion": float(np.mean(rest)),
        "others_motion": float(np.median(others)) / size,
        "others_bent": float(np.max(bent)) / size,
        "largest_stretch": float(np.max(stretch)),
        "pin_drift": max((d for _, d in drifts), default=None),
        "pin_drift_reachable": max((d for kind, d in drifts if kind == "reachable"), default=None),
    }
