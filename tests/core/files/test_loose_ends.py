"""Feet parented to the root, as IK targets, that follow their legs here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import RigBody
from lcollision_core.files import Character, CharacterForm, read_character, write_character
from lcollision_core.meshes.joint_kinds import Role
from lcollision_core.posing import DragOptions, make_grip
from tests.rigged_shapes import rigged_body, write_gltf

ENDS = ("LeftFoot", "RightFoot")


def loosened(names: tuple[str, ...] = ENDS, renamed: bool = False) -> Character:
    """Return the body with joints without parents; if `renamed`, with meaningless names."""
    body = rigged_body()
    assert body.rig is not None
    parents, joint_names = body.rig.parents.copy(), list(body.rig.joint_names)
    for name in names:
        joint = joint_names.index(name)
        parents[joint] = -1
        if renamed:
            joint_names[joint] = name.replace("Foot", "LegIK")
    rig = replace(body.rig, parents=parents, joint_names=tuple(joint_names))
    return replace(body, rig=rig)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gltf(loosened(renamed=True), tmp_path_factory.mktemp("loose") / "body.glb")


@pytest.fixture(scope="module")
def model(path: Path) -> RigBody:
    return RigBody.of(read_character(path))


def test_a_loose_foot_hangs_on_its_shin(model: RigBody) -> None:
    rig = model.space.rig
    for side in ("Left", "Right"):
        foot = rig.joint_names.index(f"{side}LegIK")
        assert rig.joint_names[rig.parents[foot]] == f"{side}Leg"
        assert rig.own_parents[foot] == -1
        assert model.space.roles[foot] is Role.FOOT
        assert model.space.anatomy.labels[foot] == f"{side} foot"
    assert (rig.parents < np.arange(len(rig.parents))).all()
    (note,) = (note for note in model.notes if "IK targets" in note)
    assert "LeftLegIK with LeftLeg" in note


@pytest.mark.parametrize(
    ("held", "way"), [("Head", (0.03, -0.1, 0.1)), ("LeftLegIK", (0.03, 0.1, 0.1))]
)
def test_a_drag_tears_no_leg(model: RigBody, held: str, way: tuple[float, float, float]) -> None:
    space = model.space
    joint = space.rig.joint_names.index(held)
    led_by = space.rig.joint_of[np.arange(model.n_vertices), space.rig.weights.argmax(axis=1)]
    grip = make_grip(space, int(np.flatnonzero(led_by == joint)[0]))
    dragger = model.dragger()
    options = DragOptions(solid=False, whole_body=held == "Head")
    step = dragger.begin(np.zeros(model.latent_size), grip, options=options)
    start = grip.position(step.vertices)
    for share in np.linspace(0.1, 1.0, 20):
        step = dragger.move(start + share * np.array(way))
    assert step.miss < 0.02
    for side in ("Left", "Right"):
        foot = space.rig.joint_names.index(f"{side}LegIK")
        shin = space.rig.joint_names.index(f"{side}Leg")
        moved = space.transforms(step.latent) @ np.linalg.inv(space.rig.rest)
        ankle = np.append(space.rig.rest[foot, :3, 3], 1.0)
        np.testing.assert_allclose(moved[foot] @ ankle, moved[shin] @ ankle, atol=1e-9)
    if held != "Head":
        knee = space.joint_of_code == space.rig.joint_names.index("LeftLeg")
        assert np.abs(step.latent[knee]).max() > 0.1


def test_a_pose_is_written_for_the_tree_of_the_file(model: RigBody, tmp_path: Path) -> None:
    codes = 0.3 * model.sample(1, np.random.default_rng(2))[0]
    vertices = model.decode(codes)
    out = tmp_path / "posed.glb"
    transforms = model.space.transforms(codes)
    write_character(
        out, model.character, vertices, form=CharacterForm.JOINTS, transforms=transforms
    )
    posed = read_character(out)
    assert posed.rig is not None
    np.testing.assert_allclose(posed.rest_vertices, vertices, atol=1e-5)


def test_limbs_as_they_should_be_stay_as_they_are(tmp_path: Path) -> None:
    # A single limb without a parent is not the end of another: it has no knee above it.
    for name, body in {"whole": rigged_body(), "leg": loosened(("LeftUpLeg",))}.items():
        character = read_character(write_gltf(body, tmp_path / f"{name}.glb"))
        assert character.rig is not None
        assert character.rig.file_parents is None
        assert not any("IK targets" in note for note in character.notes)
