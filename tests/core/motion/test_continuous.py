"""Motions that are free between frames as well, on the linear path of the vertices."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import ipctk
import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.motions import read_motions
from lcollision_core.contact import CollisionDetector
from lcollision_core.motion import (
    Motion,
    MotionOptions,
    ScreenedMotion,
    resolve_motion,
    screen_frames,
    screen_motion,
)
from lcollision_core.resolve import ResolveOptions
from tests.core.motion.swings import through_the_trunk
from tests.core.shapes import box, join

UP = (0.0, 0.0, 1.0)
# An arm goes farther round a trunk than it may unless that is asked for.
OPTIONS = MotionOptions(
    easing=6, substeps=0, continuous=True, frame=ResolveOptions(largest_change=None)
)


def hits_of_ipctk(body: RigBody, motion: Motion) -> list[int]:
    """Return after which frames ipctk, with a search of its own, finds that two tubes meet.

    The body consists of tubes that do not touch at rest. They are told apart by ipctk's filter.
    """
    topology, check = body.topology, body.exact_check()
    mesh = ipctk.CollisionMesh(
        np.asfortranarray(body.reference, dtype=np.float64),
        np.asfortranarray(topology.edges),
        np.asfortranarray(topology.faces),
    )
    mesh.can_collide = ipctk.make_vertex_patches_filter(topology.vertex_components[1])
    ccd = ipctk.TightInclusionCCD(conservative_rescaling=1.0)
    frames = [
        np.asfortranarray(motion.vertices(frame, check), dtype=np.float64)
        for frame in range(len(motion))
    ]
    return [
        at
        for at in range(len(frames) - 1)
        if ipctk.has_intersections(mesh, frames[at])
        or not ipctk.is_step_collision_free(mesh, frames[at], frames[at + 1], narrow_phase_ccd=ccd)
    ]


def test_boxes_that_pass_through_each_other_between_free_frames_are_found() -> None:
    mesh = join(box([0, 0, 0], [1, 1, 1]), box([3, 0.1, 0.2], [4, 1.1, 1.2]))
    detector = CollisionDetector(mesh.topology, mesh.vertices)
    places = [0.0, -1.0, -4.6, -6.0, -6.0]
    frames = np.tile(mesh.vertices, (len(places), 1, 1))
    frames[:, 8:, 0] += np.array(places)[:, None]

    def screened(substeps: int, continuous: bool) -> ScreenedMotion:
        return screen_frames(
            lambda at, share: (1.0 - share) * frames[at] + share * frames[min(at + 1, 4)],
            np.arange(5) / 30.0,
            detector.detect,
            np.zeros(len(mesh.vertices), dtype=np.intp),
            mesh.topology.faces,
            substeps,
            touches=detector.collide_between if continuous else None,
        )

    assert screened(0, continuous=True).collides_between == (1,)
    assert screened(0, continuous=True).in_between == ()
    assert screened(1, continuous=False).in_between == (1,)
    assert screened(1, continuous=False).collides_between is None


def test_what_passes_through_between_two_free_frames_goes_round_on_all_of_the_way() -> None:
    body, motion = through_the_trunk()
    check = body.exact_check()
    before = screen_motion(motion, check, substeps=0, continuous=True)
    assert (before.colliding, before.in_between, before.collides_between) == ((), (), (13,))
    assert hits_of_ipctk(body, motion) == [13]
    found = resolve_motion(body.resolver, motion, UP, OPTIONS)
    assert found.touching == ()
    assert found.after.all()
    assert hits_of_ipctk(body, found.motion) == []
    screened = screen_motion(found.motion, check, substeps=0, continuous=True)
    assert (screened.colliding, screened.collides_between) == ((), ())
    # Where it is not asked for, nothing is said of it.
    assert (
        resolve_motion(body.resolver, motion, UP, replace(OPTIONS, continuous=False)).touching
        is None
    )


def test_with_a_clearance_parts_keep_it_in_frames_and_touch_nowhere_between() -> None:
    with_joints, motion = through_the_trunk()
    # All that crosses between tubes counts, also about a joint.
    body = with_joints.with_rules(replace(with_joints.rules, joint_exclusion=False))
    options = replace(OPTIONS, frame=ResolveOptions(clearance=0.003, largest_change=None))
    found = resolve_motion(body.resolver, motion, UP, options)
    assert found.after.all()
    assert found.touching == ()
    assert hits_of_ipctk(body, found.motion) == []
    check = body.exact_check(clearance=0.003)
    assert screen_motion(found.motion, check).colliding == ()


def test_what_cannot_be_led_round_is_named() -> None:
    """With all of the arm locked, nothing but the whole body could move."""
    body, whole = through_the_trunk()
    motion = whole.part(range(13, 15))
    locked = frozenset(range(len(body.domain_names)))
    options = replace(OPTIONS, keep_feet=False, frame=ResolveOptions(locked_domains=locked))
    found = resolve_motion(body.resolver, motion, UP, options)
    assert found.after.all()
    assert found.touching == (0,)


def faces_with(parts: npt.NDArray[Any], faces: npt.NDArray[Any]) -> list[list[int]]:
    """Return of (n, k) groups of vertices the faces that have all of each."""
    found: list[set[int]] = [set() for _ in range(faces.max() + 1)]
    for face, corners in enumerate(faces.tolist()):
        for corner in corners:
            found[corner].add(face)
    return [
        sorted(set.intersection(*(found[vertex] for vertex in part))) for part in parts.tolist()
    ]


def hits_on_counted_pairs(body: RigBody, motion: Motion) -> tuple[list[int], list[int]]:
    """Return the frames that intersect, and after which something is hit, all searched by ipctk.

    The project only says of pairs of faces whether they count.
    """
    faces, edges, detector = body.topology.faces, body.topology.edges, body.detector
    size, check = body.body_size, body.exact_check()
    of = {
        "vertex": faces_with(np.arange(body.n_vertices)[:, None], faces),
        "edge": faces_with(edges, faces),
        "face": [[face] for face in range(len(faces))],
    }

    def counted(candidates: list[Any], one: str, other: str) -> list[Any]:
        sides = [(side, of[side.rstrip("01")]) for side in (one, other)]
        both = [[known[getattr(c, f"{side}_id")] for c in candidates] for side, known in sides]
        rows = [
            (row, a, b)
            for row, (left, right) in enumerate(zip(*both, strict=True))
            for a in left
            for b in right
        ]
        table = np.array(rows, dtype=np.int32).reshape(-1, 3)
        share = faces[table[:, 1], :, None] == faces[table[:, 2], None, :]
        table = table[~share.any(axis=(1, 2))]
        counts = detector.rules_of(table[:, 1:], np.ones(len(table))) == 0
        return [candidates[row] for row in np.unique(table[counts, 0])]

    # Most of what is near at rest, as far as single vertices tell: the rest is left to the rules.
    start, near = detector._exclusions.near_start, detector._exclusions.near
    first = np.repeat(np.arange(body.n_vertices), np.diff(start))
    apart_at_rest = np.linalg.norm(body.reference[first] - body.reference[near], axis=1)
    first, near = (one[apart_at_rest < 0.02 * size] for one in (first, near))
    apart = ipctk.make_sparse_filter(
        dict.fromkeys(zip(first.tolist(), near.tolist(), strict=True), False), True
    )
    columns = (np.asfortranarray(one) for one in (body.reference / size, edges, faces))
    mesh = ipctk.CollisionMesh(*columns)
    mesh.can_collide = apart
    ccd = ipctk.TightInclusionCCD(conservative_rescaling=1.0)
    poses = [
        np.asfortranarray(motion.vertices(frame, check) / size, dtype=np.float64)
        for frame in range(len(motion))
    ]
    crossing, hit = [], []
    for at, pose in enumerate(poses):
        search = ipctk.LBVH()
        search.can_vertices_collide = apart
        search.build(pose, mesh.edges, mesh.faces)
        crosses = (
            ipctk.is_edge_intersecting_triangle(*pose[edges[c.edge_id]], *pose[faces[c.face_id]])
            for c in counted(search.detect_edge_face_candidates(), "edge", "face")
        )
        if any(crosses):
            crossing.append(at)
        if at + 1 == len(poses):
            break
        candidates = ipctk.Candidates()
        candidates.build(mesh, pose, poses[at + 1])
        candidates.ee_candidates = counted(candidates.ee_candidates, "edge0", "edge1")
        candidates.fv_candidates = counted(candidates.fv_candidates, "face", "vertex")
        if not candidates.is_step_collision_free(mesh, pose, poses[at + 1], narrow_phase_ccd=ccd):
            hit.append(at)
    return crossing, hit


def test_some_of_a_real_clip_is_free_in_and_between_frames_as_ipctk_finds(
    characters: Path,
) -> None:
    source = characters / "mannequin-moves.glb"
    body = open_body(source)
    (clip,) = read_motions(body, source)
    motion = clip.part(range(46, 52))
    options = MotionOptions(continuous=True, frame=ResolveOptions(clearance=0.003 / body.body_size))
    found = resolve_motion(body.resolver, motion, body.space.up, options)
    assert found.after.all()
    assert found.touching == ()
    # And then two frames as they were.
    collides = np.flatnonzero(~body.exact_check().are_free(motion.codes))[-2:]
    codes = np.concatenate([found.motion.codes, motion.codes[collides]])
    crossing, hit = hits_on_counted_pairs(body, Motion("both", np.arange(8.0), codes))
    assert crossing == [6, 7]
    assert not set(hit) & set(range(5))
