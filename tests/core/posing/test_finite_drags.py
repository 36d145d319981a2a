"""Drags stay finite for any rig: coincident joints, joints without vertices, flat parts."""

from __future__ import annotations

import numpy as np
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from lcollision_core.bodies import RigBody
from lcollision_core.files import Character, Rig
from lcollision_core.posing import DragOptions, Grip, Twist, make_grip
from tests.rigged_shapes import character_of, rigged_tube

N_EVENTS = 3


def random_tube(seed: int) -> Character:
    """Rig the tube with a random tree; joints may coincide and have no vertices."""
    random, tube = np.random.default_rng(seed), rigged_tube()
    points = tube.rest_vertices
    n_joints = int(random.integers(2, 7))
    parents = np.array([random.integers(-1, joint) if joint else -1 for joint in range(n_joints)])
    rest = np.tile(np.eye(4), (n_joints, 1, 1))
    rest[:, 1, 3] = random.integers(0, 4, n_joints) / 3.0
    leading = random.choice(n_joints, int(random.integers(1, n_joints + 1)), replace=False)
    joint_of = np.stack(
        [
            leading[(np.arange(len(points)) * len(leading)) // len(points)],
            random.integers(0, n_joints, len(points)),
            np.zeros(len(points), dtype=np.int64),
        ],
        axis=1,
    ).astype(np.int32)
    rig = Rig(
        joint_names=tuple(f"joint {joint}" for joint in range(n_joints)),
        parents=parents,
        rest=rest,
        nodes=np.arange(n_joints),
        joint_of=joint_of,
        weights=np.tile([0.7, 0.3, 0.0], (len(points), 1)),
        points=np.repeat(points[:, None], 3, axis=1),
    )
    return character_of("tube", tube.topology, points, rig, [0.0, 1.0, 0.0], 0)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 10_000),
    options=st.builds(
        DragOptions, solid=st.booleans(), standing=st.booleans(), whole_body=st.booleans()
    ),
)
@example(seed=2, options=DragOptions(solid=False, whole_body=True))
def test_a_drag_of_any_rig_stays_finite(seed: int, options: DragOptions) -> None:
    random, model = np.random.default_rng(seed), RigBody.of(random_tube(seed))
    space, dragger = model.space, model.dragger()
    assert np.isfinite(space.limbs.shares).all()
    grip: Grip | Twist = Twist(int(random.integers(space.n_domains)))
    if seed % 3:
        grip = make_grip(space, int(random.integers(model.n_vertices)), 0.01)
    step = dragger.begin(np.zeros(model.latent_size), grip, options=options)
    for _ in range(N_EVENTS):
        target = random.normal(size=1)
        if isinstance(grip, Grip):
            target = grip.position(step.vertices) + 0.2 * random.normal(size=3)
        step = dragger.move(target)
        assert np.isfinite(step.latent).all()
        assert np.isfinite(step.vertices).all()
