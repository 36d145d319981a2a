"""Computations for a client: check poses, drag, and resolve poses and motions."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from lcollision_core.bodies import propose_rules
from lcollision_core.bodies.motions import motion_of_transforms
from lcollision_core.compiled import working_seconds
from lcollision_core.contact import SelfCollisions
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import Job
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion import (
    Motion,
    MotionReport,
    ResolvedMotion,
    colliding_domains,
    is_worse,
    resolve_motion,
    screen_motion,
    worse_spans,
)
from lcollision_core.motion.motion import parts_on_ground
from lcollision_core.options import MotionOptions, ResolveOptions
from lcollision_core.posing import DragOptions, ExactCheck, PoseDragger, make_grip
from lcollision_core.serve import messages as m
from lcollision_core.serve.characters import OpenedCharacter

Reply = dict[str, Any]

MOST_PAIRS = 20_000
"""Most pairs that a reply lists; the others are dropped."""


def describe(opened: OpenedCharacter) -> Reply:
    """Return the reply that describes a character."""
    body = opened.body
    return {
        "name": body.name,
        "joints": list(opened.joint_names),
        "parts": list(body.domain_names),
        "vertices": opened.n_vertices,
        "joined_vertices": body.n_vertices,
        "faces": len(opened.faces),
        "body_size": body.body_size,
        "rules": body.rules.to_json(),
        "in_words": body.rules.summary(),
        "notes": list(body.notes),
    }


def check_pose(opened: OpenedCharacter, request: m.Check) -> Reply:
    """Check a pose exactly, by its vertices if they are given."""
    start = working_seconds()
    body, space = opened.body, opened.body.space
    transforms = vertices = None
    if request.transforms is not None:
        transforms = opened.transforms(request.transforms)
    if request.vertices is not None:
        vertices = opened.joined_vertices(request.vertices)
    off = 0.0
    if transforms is not None:
        by_rig = space.skinned(transforms)
        if vertices is None:
            vertices = by_rig * body.body_size
        off = float(np.linalg.norm(by_rig - vertices / body.body_size, axis=1).max())
    if vertices is None:
        raise LCollisionError.must_be("check", "given transforms or vertices", "neither")
    exact = body.exact_check(clearance=request.clearance)
    has_distance = request.clearance > 0.0 and not request.counted_only
    nearest = exact.least_distance(vertices) if has_distance else None
    collisions, touches = exact.find(vertices, counted_only=request.counted_only), False
    if request.before is not None and not collisions.colliding:
        touches = exact.collide_between(opened.joined_vertices(request.before), vertices)
    return {
        **_verdict(opened, collisions),
        "touches_between": touches,
        "least_distance": nearest and nearest.distance,
        "off_rig": off,
        "seconds": working_seconds() - start,
    }


def _verdict(opened: OpenedCharacter, collisions: SelfCollisions) -> Reply:
    body = opened.body
    pairs, depths = collisions.pairs[:MOST_PAIRS], collisions.penetration_depth[:MOST_PAIRS]
    names = body.domain_names
    domains = colliding_domains(collisions, body.space.vertex_domain, body.faces)
    return {
        "colliding": bool(collisions.colliding),
        "pairs": len(collisions.pairs),
        "deepest": collisions.deepest,
        "parts": [[names[a], names[b]] for a, b in domains],
        "excluded_pairs": collisions.excluded.to_json(),
        "excluded_deepest": float(collisions.excluded_depth.max(initial=0.0)),
        "not_counted": body.rules.sentence(collisions.excluded),
        "faces": opened.faces[pairs].reshape(-1, 2),
        "depths": depths,
    }


@dataclass(frozen=True, eq=False)
class Dragging:
    """A drag in progress."""

    opened: OpenedCharacter
    dragger: PoseDragger
    start: FloatArray

    @classmethod
    def begin(cls, opened: OpenedCharacter, request: m.Drag) -> Dragging:
        """Begin to drag a vertex of a pose."""
        assert request.transforms is not None
        space = opened.body.space
        start = space.codes_of_transforms(opened.transforms(request.transforms))
        if request.vertex >= opened.n_vertices:
            raise LCollisionError.must_be(
                "the vertex", f"below {opened.n_vertices}", request.vertex
            )
        grip = make_grip(space, int(opened.joined[request.vertex]))
        options = DragOptions(solid=request.solid, locked_domains=opened.parts_of(request.locked))
        dragger = opened.body.dragger()
        dragger.begin(start, grip, options=options)
        return cls(opened, dragger, start)

    def move(self, request: m.Drag) -> Reply:
        """Move towards the target of one pointer event."""
        step = self.dragger.move(request.target.numbers("target", (3,)))
        joints, turns = self.opened.turns(self.start[None], step.latent[None])
        return {
            "joints": joints,
            "turns": turns[0],
            "miss": step.miss,
            "free": step.exactly_free,
            "settled": step.settled,
        }


def resolve_pose(opened: OpenedCharacter, request: m.ResolvePose, job: Job) -> Reply:
    """Resolve a pose, keeping the offsets of its vertices from the rig's."""
    start = working_seconds()
    motion = _motion(opened, request.transforms, None, request.vertices)
    check = motion.check(0, opened.body.exact_check(clearance=request.clearance))
    options = _options(opened, request)
    if request.keep_feet:
        standing = parts_on_ground(motion, check, opened.body.space.up)
        options = replace(options, still_domains=standing)
    resolver = opened.body.resolver
    if motion.space_at is not None:
        resolver = resolver.with_check(check)
    resolved = resolver.resolve(motion.codes[0], options, job)
    before, after = motion.codes[0], resolved.latent
    fewer = opened.without_small_turns(before[None], after[None], request.least_change)[0]
    if (fewer != after).any():
        whole, part = (check.exported(check.decode(codes)[0]) for codes in (after, fewer))
        after = after if is_worse(check, whole, part, None) else fewer
    if request.beyond:
        further = after + request.beyond * (after - before)
        old, new = (check.exported(check.decode(codes)[0]) for codes in (before, further))
        if check.is_free(further) and not is_worse(check, old, new, request.largest_change):
            after = further
    joints, turns = opened.turns(before[None], after[None])
    return {
        "free": bool(resolved.exactly_free),
        "step": str(resolved.step),
        "note": resolved.note or "",
        "pairs_before": resolved.pairs_before,
        "pairs_after": resolved.pairs_after,
        "least_distance": resolved.least_distance,
        "mean_change": resolved.vertex_distance_mean,
        "largest_change": resolved.vertex_distance_max,
        "joints": joints,
        "turns": turns[0],
        "seconds": working_seconds() - start,
    }


def answer_resolve_motion(opened: OpenedCharacter, request: m.ResolveMotion, job: Job) -> Reply:
    """Resolve the colliding spans of a motion."""
    start = working_seconds()
    body = opened.body
    times = request.times.numbers("times", (None,))
    motion = _motion(opened, request.transforms, times, request.vertices)
    options = MotionOptions(
        easing=request.easing,
        substeps=request.substeps,
        continuous=request.continuous,
        keep_feet=request.keep_feet,
        frame=_options(opened, request),
    )
    check = body.exact_check(clearance=request.clearance)
    first, end = request.within or (0, len(motion))
    if not first < end <= len(motion):
        raise LCollisionError.must_be("within", f"frames of the {len(motion)}", request.within)
    within = range(first, end)
    resolved = resolve_motion(
        body.resolver, motion, body.space.up, options, None, job, within=within
    )
    report = MotionReport.of(motion, resolved.motion, check, resolved.standing)
    after = _with_few_turns(opened, request, motion, resolved, check)
    if request.beyond:
        codes = after.codes + request.beyond * (after.codes - motion.codes)
        # Unchanged codes stay exactly equal.
        codes = np.where(after.codes != motion.codes, codes, motion.codes)
        further = replace(after, codes=codes)
        # Where going beyond makes a span worse, keep the resolved codes.
        for span in worse_spans(after, further, resolved.spans, check, None) + worse_spans(
            motion, further, resolved.spans, check, request.largest_change
        ):
            codes[span.start : span.stop] = after.codes[span.start : span.stop]
        after = replace(after, codes=codes)
    screened = screen_motion(after, check, 1, None, job.part(), counted_only=False)
    colliding = [frame.frame for frame in screened.colliding if frame.frame in within]
    joints, turns = opened.turns(motion.codes, after.codes)
    return {
        "frames": len(within),
        "free_before": int(resolved.before[first:end].sum()),
        "free_after": len(within) - len(colliding),
        "colliding_frames": colliding,
        "in_between": list(screened.in_between),
        "touching": list(resolved.touching or ()),
        "kept": [span.to_json(body.domain_names) for span in resolved.kept],
        "least_distance": screened.least_distance,
        **screened.left_out.to_json(),
        "not_counted": screened.left_out.sentence(body.rules),
        "spans": [[span.start, span.stop] for span in resolved.spans],
        "report": asdict(report),
        "joints": joints,
        "turns": turns[list(chain.from_iterable(resolved.spans))],
        "seconds": working_seconds() - start,
    }


def _with_few_turns(
    opened: OpenedCharacter,
    request: m.ResolveMotion,
    motion: Motion,
    resolved: ResolvedMotion,
    check: ExactCheck,
) -> Motion:
    """Return a resolved motion without the turns of joints that hardly turn in a span."""
    codes, after = resolved.motion.codes.copy(), resolved.motion
    if not request.least_change:
        return after
    for span in resolved.spans:
        at = slice(span.start, span.stop)
        codes[at] = opened.without_small_turns(
            motion.codes[at], after.codes[at], request.least_change
        )
    for span in worse_spans(after, replace(after, codes=codes), resolved.spans, check, None):
        codes[span.start : span.stop] = after.codes[span.start : span.stop]
    return replace(after, codes=codes)


def _options(opened: OpenedCharacter, request: m.ResolvePose | m.ResolveMotion) -> ResolveOptions:
    locked: list[int] = []
    if request.turning is not None:
        joints = opened.joint_indices(request.turning)
        locked = np.flatnonzero(~opened.body.space.codes_of_joints(joints)).tolist()
    return ResolveOptions(
        locked_domains=opened.parts_of(request.locked),
        locked_codes=frozenset(locked),
        clearance=request.clearance,
        largest_change=request.largest_change,
    )


def propose(opened: OpenedCharacter, request: m.ProposeRules, job: Job) -> Reply:
    """Propose places to leave out of the check because they touch in nearly every pose."""
    shown_vertices = (
        None if request.vertices is None else opened.joined_vertices(request.vertices, None)
    )
    proposed = propose_rules(opened.body, job, shown_vertices)
    if proposed is None:
        return {"touching": []}
    return {
        "touching": [list(pair) for pair in proposed.new],
        "touching_radius": proposed.rules.touching_radius,
        "faces": opened.faces[proposed.faces],
        "places": [[*names, n] for names, n in proposed.places.items()],
        "poses": proposed.n_poses,
        "colliding": proposed.n_colliding,
        "colliding_then": proposed.n_colliding_then,
    }


def _motion(
    opened: OpenedCharacter, given: m.Array, times: FloatArray | None, shown: m.Array | None
) -> Motion:
    n = None if times is None else len(times)
    transforms = opened.transforms(given, *(() if n is None else (n,)))
    vertices = None
    if shown is not None:
        vertices = opened.joined_vertices(shown, *(() if n is None else (n,)))
    if times is None:
        times, transforms = np.zeros(1), transforms[None]
        vertices = None if vertices is None else vertices[None]
    space, name = opened.body.space, opened.body.name
    vertices_of_frame = (
        {} if vertices is None else {n: partial(vertices.__getitem__, n) for n in range(len(times))}
    )
    return motion_of_transforms(space, name, times, transforms, shown=vertices_of_frame)
