"""Skeletons without a standing rest pose: their motion is still transferred."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcollision_core.bodies import RigBody
from lcollision_core.bodies.retargeting import Retargeting
from lcollision_core.bodies.standing_pose import in_world, with_standing_rest
from lcollision_core.files.motion.skeleton import SkeletonMotion
from tests.core.bodies.test_retargeting import FOREIGN, TO_Y_UP
from tests.rigged_shapes import FloatArray, rigged_body

NAMES = tuple(FOREIGN)
PARENTS = np.array([NAMES.index(parent) if parent else -1 for parent, _ in FOREIGN.values()])
OFFSETS = np.array([offset for _, offset in FOREIGN.values()])
LIMBS = [
    (side + own[0], side + own[1], side + other[0], side + other[1])
    for side in ("Left", "Right")
    for own, other in (
        (("Arm", "ForeArm"), ("UpArm", "LowArm")),
        (("ForeArm", "Hand"), ("LowArm", "Hand")),
        (("UpLeg", "Leg"), ("UpLeg", "LowLeg")),
        (("Leg", "Foot"), ("LowLeg", "Foot")),
    )
]


def stored_in(
    axes: FloatArray, world: FloatArray, roots: FloatArray, names: tuple[str, ...]
) -> SkeletonMotion:
    """Return a motion whose joints are stored in their own axes, (J, 3, 3) at rest."""
    above = np.where((PARENTS < 0)[:, None, None], np.eye(3), axes[PARENTS])
    offsets = np.einsum("jyx,jy->jx", above, OFFSETS)
    turned = world @ axes
    turns = np.swapaxes(turned[:, PARENTS], -2, -1) @ turned
    turns[:, 0] = turned[:, 0]
    places = np.broadcast_to(offsets, (len(world), *offsets.shape)).copy()
    places[:, 0] = roots
    times, ends = np.arange(len(world)) / 30.0, np.full(offsets.shape, np.nan)
    return SkeletonMotion("", names, PARENTS, offsets, ends, None, times, None, turns, places)


def moving(
    rng: np.random.Generator,
    axes: FloatArray,
    names: tuple[str, ...] = NAMES,
    trunk: float = 0.08,
) -> SkeletonMotion:
    """Return a person who turns around while all joints move."""
    n_frames = 6
    vectors = rng.normal(0.0, trunk, (n_frames, len(NAMES), 3))
    for joint, name in enumerate(NAMES):
        if name.endswith(("UpArm", "UpLeg")):
            vectors[:, joint] *= 4.0
        if name.endswith(("LowArm", "LowLeg")):
            # Elbows bend forward, knees backward.
            bent = rng.uniform(0.2, 1.2, n_frames)
            vectors[:, joint, 0] = bent if name.endswith("Leg") else -bent
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    local = local.reshape(n_frames, len(NAMES), 3, 3)
    world = local.copy()
    headings = np.radians(np.linspace(20.0, 140.0, n_frames))
    world[:, 0] = Rotation.from_rotvec(np.outer(headings, [0.0, 1.0, 0.0])).as_matrix()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ local[:, joint]
    roots = np.array([0.0, 38.7, 0.0]) + np.outer(np.arange(n_frames), [3.0, 0.0, 2.0])
    return stored_in(axes, world, roots, names)


def turned_by(turn: FloatArray, motion: SkeletonMotion) -> SkeletonMotion:
    """Return a motion in other axes, with the rest pose as it was."""
    turns, places = motion.turns.copy(), motion.places.copy()
    turns[:, 0], places[:, 0] = turn @ turns[:, 0], places[:, 0] @ turn.T
    return replace(motion, turns=turns, places=places)


def limbs_of(stored: SkeletonMotion) -> FloatArray:
    """Return the (T, 8, 3) unit directions of eight bones in the world."""
    _, places = in_world(stored)
    ways = [places[:, NAMES.index(end)] - places[:, NAMES.index(start)] for *_, start, end in LIMBS]
    units = np.stack(ways, axis=1)
    return units / np.linalg.norm(units, axis=2, keepdims=True)


TURNED = {
    "y down": np.diag([1.0, -1.0, -1.0]),
    "x up": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "z down": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
"""Rotations from y up to the axes of a whole file; y is down in pictures."""


def axes_of(kind: str, rng: np.random.Generator) -> FloatArray:
    if kind in ("standing", "z up in its frames"):
        return np.broadcast_to(np.eye(3), (len(NAMES), 3, 3))
    if kind in TURNED:
        return np.broadcast_to(TURNED[kind].T, (len(NAMES), 3, 3))
    if kind == "lying":
        lying = Rotation.from_euler("x", 90.0, degrees=True).as_matrix()
        return np.broadcast_to(lying, (len(NAMES), 3, 3))
    return Rotation.random(len(NAMES), rng).as_matrix()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "kind", ["any", "lying", "standing", "without names", "z up in its frames", *TURNED]
)
def test_limbs_point_as_they_are_shown_whatever_the_rest_pose(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = RigBody.of(rigged_body())
    names = NAMES
    if kind == "without names":
        names = tuple(f"b{number}" for number in range(len(NAMES)))
    stored = moving(rng, axes_of(kind, rng), names)
    shown = limbs_of(stored)
    if kind == "z up in its frames":
        z_up = Rotation.from_euler("x", 90.0, degrees=True).as_matrix()
        stored = turned_by(z_up, stored)
    if kind in TURNED:
        stored = turned_by(TURNED[kind], stored)
    retargeting = Retargeting.of(stored, body.space, Path("capture.bvh"))
    as_stored = ("standing", "z up in its frames", *TURNED)
    assert (retargeting.motion.frame is None) == (kind in as_stored)
    transforms = retargeting.transforms()
    places = transforms[..., :3, 3] @ TO_Y_UP.T
    ours = list(body.space.rig.joint_names)
    ways = [places[:, ours.index(end)] - places[:, ours.index(start)] for start, end, *_ in LIMBS]
    own = np.stack(ways, axis=1)
    own /= np.linalg.norm(own, axis=2, keepdims=True)
    # Up to quarter turns about the up axis: the facing direction at rest is unknown.
    quarters = (Rotation.from_euler("y", 90 * n, True).as_matrix() for n in range(4))
    off = min(np.abs(own @ quarter - shown).max() for quarter in quarters)
    assert off < 1e-6
    # It turns like the source, and the hips follow its path.
    way = transforms[1:, ours.index("Hips"), :3, 3] - transforms[:-1, ours.index("Hips"), :3, 3]
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), np.linalg.norm(way[0]), rtol=1e-6)


def test_names_tell_the_limbs_where_the_tree_does_not() -> None:
    unnamed = tuple(f"b{number}" for number in range(len(NAMES)))
    frames = []
    for names in (NAMES, unnamed):
        rng = np.random.default_rng(2)
        bent = moving(rng, axes_of("any", rng), names, trunk=0.2)
        frames.append(with_standing_rest(bent).frame)
    assert frames[0] is not None
    assert frames[1] is None


def test_another_rest_pose_shows_the_same_and_goes_back() -> None:
    rng = np.random.default_rng(4)
    stored = moving(rng, axes_of("any", rng))
    rested = with_standing_rest(stored)
    assert rested.frame is not None
    for ours, theirs in zip(in_world(rested), in_world(stored), strict=True):
        if ours.ndim == 3:  # places
            np.testing.assert_allclose(ours, theirs, atol=1e-12)
    np.testing.assert_allclose(rested.turns_as_stored(rested.turns), stored.turns, atol=1e-12)
