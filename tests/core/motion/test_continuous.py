"""Motions that are also free between frames, on the linear path of the vertices."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import ipctk
import numpy as np
import pytest

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.motions import read_motions
from lcollision_core.contact import CollisionDetector
from lcollision_core.motion import (
    FrameChecks,
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
from tests.foreign_cloth import hits_on_counted_pairs

UP = (0.0, 0.0, 1.0)
# An arm must move around a trunk by more than the default largest change.
OPTIONS = MotionOptions(
    easing=6, substeps=0, continuous=True, frame=ResolveOptions(largest_change=None)
)


def hits_of_ipctk(body: RigBody, motion: Motion) -> list[int]:
    """Return the frames after which ipctk, with its own search, finds that two tubes intersect.

    The body consists of tubes that do not touch at rest. ipctk's filter distinguishes them.
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
        checks = FrameChecks(
            lambda at, share: (1.0 - share) * frames[at] + share * frames[min(at + 1, 4)],
            detector.detect,
            touches=detector.collide_between if continuous else None,
        )
        owner = np.zeros(len(mesh.vertices), dtype=np.intp)
        return screen_frames(checks, np.arange(5) / 30.0, owner, mesh.topology.faces, substeps)

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
    # Without the option, the report does not mention it.
    assert (
        resolve_motion(body.resolver, motion, UP, replace(OPTIONS, continuous=False)).touching
        is None
    )


@pytest.mark.slow
def test_with_a_clearance_parts_keep_it_in_frames_and_touch_nowhere_between() -> None:
    with_joints, motion = through_the_trunk()
    # Every crossing between tubes counts, also around a joint.
    body = with_joints.with_rules(replace(with_joints.rules, joint_exclusion=False))
    options = replace(OPTIONS, frame=ResolveOptions(clearance=0.003, largest_change=None))
    found = resolve_motion(body.resolver, motion, UP, options)
    assert found.after.all()
    assert found.touching == ()
    assert hits_of_ipctk(body, found.motion) == []
    check = body.exact_check(clearance=0.003)
    assert screen_motion(found.motion, check).colliding == ()


@pytest.mark.slow
def test_what_cannot_be_led_round_is_named() -> None:
    """With the whole arm locked, only the whole body could move."""
    body, whole = through_the_trunk()
    motion = whole.part(range(13, 15))
    locked = frozenset(range(len(body.domain_names)))
    options = replace(OPTIONS, keep_feet=False, frame=ResolveOptions(locked_domains=locked))
    found = resolve_motion(body.resolver, motion, UP, options)
    assert found.after.all()
    assert found.touching == (0,)


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
    # Next, two unchanged frames.
    collides = np.flatnonzero(~body.exact_check().are_free(motion.codes))[-2:]
    codes = np.concatenate([found.motion.codes, motion.codes[collides]])
    both, check = Motion("both", np.arange(8.0), codes), body.exact_check()
    crossing, hit = hits_on_counted_pairs(
        body, np.array([both.vertices(frame, check) for frame in range(8)])
    )
    assert crossing == [6, 7]
    assert not set(hit) & set(range(5))
