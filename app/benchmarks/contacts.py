"""Motions moved onto other bodies, with and without keeping their contacts.

The fields of a row:

source, motion, body : the motion's body, its name, and the body that it was moved onto
method : "copied", only rotations; "free", resolved without its contacts; "kept", with them
contacts, kept : the number of contacts, and of those that touch in nearly all of their frames
share : share of contact frames in which the patches are within 0.5 % of the body size
frames, free : all frames, and those free by the exact check
mean_change, largest_change, acceleration_ratio : relative to copied rotations, see `MotionReport`
slide : the farthest that a standing patch moves along the ground in one frame
seconds : wall time on this machine, with all cores
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from app.benchmarks.measures import Row
from lcollision_core.bodies import RigBody
from lcollision_core.bodies.kept_contacts import contacts_of
from lcollision_core.bodies.motions import read_motions
from lcollision_core.bodies.remembered import open_character
from lcollision_core.bodies.retargeting import Retargeting, bvh_of
from lcollision_core.built_in_body.body_set import Template, build_template, joint_angles
from lcollision_core.built_in_body.figure import Arm, Figure, Foot
from lcollision_core.built_in_body.motions import JUMP_FRAME_RATE, jump_motion, swing_motion
from lcollision_core.built_in_body.skeleton import BONES, PARENTS
from lcollision_core.files import Character, Rig
from lcollision_core.files.motion.bvh import read_bvh
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.topology import Topology
from lcollision_core.motion import (
    Motion,
    MotionOptions,
    MotionReport,
    contact_report,
    resolve_motion,
)

BUILDS = {"slim": 0.15, "average": 0.5, "heavy": 0.9}
"""Weight parameter of anny's phenotype."""

_VERTICES, _INFLUENCES, _RATE, _FRAMES = 2161, 4, 30.0, 45

_HELD = Arm(lift=36.0, plane=0.0, turn=45.0, elbow=110.0, pronation=20.0, wrist=20.0)
"""An arm with its hand on the belly."""


def build_figure(build: str) -> tuple[RigBody, Template]:
    """Return the built-in figure in one of the `BUILDS`, as a rigged body.

    Raises
    ------
    MissingExtraError : see `build_template`.
    """
    template = build_template(_VERTICES, BUILDS[build])
    order = np.argsort(-template.weights, axis=1, kind="stable")[:, :_INFLUENCES]
    weights = np.take_along_axis(template.weights, order, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    rest = np.tile(np.eye(4), (len(BONES), 1, 1))
    rest[:, :3, 3] = template.skeleton.positions
    rig = Rig(
        joint_names=tuple(BONES),
        parents=np.array(PARENTS),
        rest=rest,
        nodes=np.arange(len(BONES)),
        joint_of=order.astype(np.int32),
        weights=weights,
        points=np.repeat(template.vertices[:, None], _INFLUENCES, axis=1),
    )

    topology = Topology(template.faces, len(template.vertices))
    up = np.array([0.0, 0.0, 1.0])
    character = Character.without_clips(Path(f"{build}.glb"), topology, template.vertices, up, rig)
    return RigBody.of(character), template


def sample_motions(body: RigBody, template: Template) -> list[Motion]:
    """Return three motions of a built body: a dance, a jump, and hands put on the belly."""
    skeleton = template.skeleton
    figures = {
        "dance": swing_motion()[:_FRAMES],
        "jump": jump_motion(skeleton)[:: round(JUMP_FRAME_RATE / _RATE)][15:],
        "hands on belly": _hands_on_belly(),
    }
    motions = []
    for name, poses in figures.items():
        transforms = np.tile(np.eye(4), (len(poses), len(BONES), 1, 1))
        for frame, figure in enumerate(poses):
            angles = joint_angles(figure, skeleton)
            rotations, places = skeleton.pose(angles, *figure.pelvis(skeleton))
            transforms[frame, :, :3, :3], transforms[frame, :, :3, 3] = rotations, places
        codes = body.space.unwound(body.space.codes_of_transforms(transforms))
        motions.append(Motion(name, np.arange(len(poses)) / _RATE, codes))
    return motions


def _hands_on_belly() -> list[Figure]:
    """Put both hands on the belly, sway, and let them hang again."""
    figures = []
    for frame in range(_FRAMES):
        share = np.clip(1.6 * np.sin(np.pi * frame / (_FRAMES - 1)), 0.0, 1.0) ** 2
        sway = 0.04 * np.sin(2.0 * np.pi * frame / _FRAMES)
        arm = Arm(
            lift=14.0 + share * (_HELD.lift - 14.0),
            plane=20.0 + share * (_HELD.plane - 20.0),
            turn=share * _HELD.turn,
            elbow=15.0 + share * (_HELD.elbow - 15.0),
            pronation=20.0 + share * (_HELD.pronation - 20.0),
            wrist=5.0 + share * (_HELD.wrist - 5.0),
        )
        foot = Foot(0.13, heading=9)
        figures.append(Figure(arm, arm, foot, foot, drop=0.02, shift=float(sway)))
    return figures


def score_contacts(
    source: RigBody,
    motion: Motion,
    bodies: Sequence[RigBody],
    workers: int | None = None,
    job: Job = UNWATCHED,
) -> list[Row]:
    """Score one motion moved onto other bodies, with and without keeping its contacts."""
    rows: list[Row] = []
    for body in bodies:
        copied = moved_onto(body, source, motion)
        check, up = body.exact_check(), body.space.up
        standing = np.zeros((len(copied), body.space.n_domains), dtype=np.bool_)
        versions = {"copied": (copied, 0.0)}
        for method, keeps in (("free", False), ("kept", True)):
            start = time.perf_counter()
            options = MotionOptions(keep_contacts=keeps)
            resolution = resolve_motion(body.resolver, copied, up, options, workers, job)
            seconds = time.perf_counter() - start
            versions[method] = replace(resolution.motion, contacts=copied.contacts), seconds
        for method, (moved, seconds) in versions.items():
            report = MotionReport.of(copied, moved, check, standing)
            contacts = contact_report(moved, check)
            assert contacts is not None
            n = len(contacts.kept) + len(contacts.lost)
            free = sum(check.is_free(codes) for codes in moved.codes)
            row: Row = {"source": source.name, "motion": motion.name, "body": body.name}
            row |= {"method": method, "contacts": n, "kept": len(contacts.kept)}
            row |= {"share": contacts.n_together / max(contacts.n_frames, 1)}
            row |= {"frames": len(moved), "free": int(free), "mean_change": report.mean_change}
            row |= {"largest_change": report.largest_change}
            row |= {"acceleration_ratio": report.acceleration_ratio}
            rows.append(row | {"slide": contacts.slide, "seconds": seconds})
    return rows


def moved_onto(body: RigBody, source: RigBody, motion: Motion) -> Motion:
    """Return a motion of `source` on another body: copied rotations, with its contacts."""
    transforms = np.array([source.space.transforms(codes) for codes in motion.codes])
    with TemporaryDirectory() as folder:
        path = Path(folder) / "motion.bvh"
        path.write_bytes(bvh_of(source.space, transforms, 1.0 / motion.rate))
        retargeting = Retargeting.of(read_bvh(path).motion, body.space, path)
    codes = body.space.unwound(body.space.codes_of_transforms(retargeting.transforms()))
    copied = Motion(motion.name, motion.times, codes)
    return replace(
        copied,
        contacts=cache(lambda: contacts_of(copied, source, motion, retargeting)),
    )


def contact_rows(
    files: Sequence[Path], workers: int | None = None, job: Job = UNWATCHED
) -> list[Row]:
    """Move motions between the average build, the other builds and characters.

    The average build's motions go onto all other bodies; clips of characters go onto the average
    build and the other characters.

    Parameters
    ----------
    files : of characters with clips
    """
    builds = {build: build_figure(build) for build in BUILDS}
    average, template = builds["average"]
    others = [body for name, (body, _) in builds.items() if name != "average"]
    characters = [(path, open_character(path)) for path in files]
    rigged = [body for _, body in characters]
    rows: list[Row] = []
    for motion in sample_motions(average, template):
        rows += score_contacts(average, motion, [*others, *rigged], workers, job)
    for path, body in characters:
        others = [one for one in (average, *rigged) if one is not body]
        for motion in read_motions(body, path):
            rows += score_contacts(body, motion, others, workers, job)
    return rows
