"""The rig as a pose space: skinning, derivatives, transforms, metrics and drags."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.contact import CollisionDetector
from lcollision_core.errors import LCollisionError, ShapeError
from lcollision_core.files import Character, Rig
from lcollision_core.posing import DragOptions, ExactCheck, PoseDragger, PoseSpace, make_grip
from tests.rigged_shapes import rigged_body, rigged_tube, skinned, turned

FloatArray = npt.NDArray[np.float64]

STEP = 1e-6


def rig_of(character: Character) -> Rig:
    assert character.rig is not None
    return character.rig


def random_codes(space: RigPoseSpace, seed: int = 0, share: float = 0.8) -> FloatArray:
    codes = np.random.default_rng(seed).uniform(space.low, space.high) * share
    codes[:3] *= 0.2
    return codes


def a_few(character: Character, n: int, seed: int) -> FloatArray:
    """Return (n, V, 3) derivatives that are zero at most vertices, like those of patches."""
    generator = np.random.default_rng(seed)
    by_vertices = generator.normal(size=(n, len(character.rest_vertices), 3))
    by_vertices[generator.random(by_vertices.shape[:2]) < 0.8] = 0.0
    return by_vertices


def unevenly_scaled() -> Character:
    """Return the body with non-uniform scales above each joint at rest."""
    body = rigged_body()
    halves = 0.2 * np.random.default_rng(5).normal(size=(len(rig_of(body).parents), 3, 3))
    stretch = np.eye(3) + halves @ np.swapaxes(halves, 1, 2)
    return replace(body, rig=replace(rig_of(body), stretch=stretch))


CHARACTERS = {
    "tube": rigged_tube(),
    "uneven": unevenly_scaled(),
    "long chain": rigged_tube(n_joints=6, scale=170.0, differs=True),
    "one joint": rigged_tube(n_joints=1),
    "body": rigged_body(scale=100.0),
}


@pytest.fixture(params=CHARACTERS.values(), ids=CHARACTERS)
def character(request: pytest.FixtureRequest) -> Character:
    return request.param


def test_zeros_are_the_rest_pose(character: Character) -> None:
    space = RigPoseSpace(character)
    decoded = space.decode(np.zeros((2, len(space.low))))
    expected = character.rest_vertices / space.body_size
    np.testing.assert_allclose(decoded, np.stack([expected, expected]), atol=1e-12)
    transforms = space.transforms(np.zeros(len(space.low)))
    np.testing.assert_allclose(transforms, rig_of(character).rest, atol=1e-12)
    assert sum(space.group_sizes) == len(space.low) == len(space.high)
    assert (space.low < space.high).all()
    assert (space.low <= 0.0).all()
    assert (space.high >= 0.0).all()


def test_decoding_is_the_skinning_of_its_transforms(character: Character) -> None:
    space = RigPoseSpace(character)
    for seed in range(3):
        codes = random_codes(space, seed)
        expected = skinned(rig_of(character), space.transforms(codes)) / space.body_size
        np.testing.assert_allclose(space.decode(codes[None])[0], expected, atol=1e-12)
        np.testing.assert_allclose(space.skinned(space.transforms(codes)), expected, atol=1e-12)


def test_chosen_vertices_are_decoded_alone_to_the_bit(character: Character) -> None:
    space = RigPoseSpace(character)
    codes = np.stack([random_codes(space, seed) for seed in range(3)])
    n_vertices = character.topology.n_vertices
    for chosen in ([n_vertices - 1], [5, 0, 7, 7]):
        some = space.decode_some(codes, np.array(chosen))
        assert some.tobytes() == space.decode(codes)[:, chosen].tobytes()


def test_no_pose_is_decoded_to_none() -> None:
    character = rigged_tube()
    space, none = RigPoseSpace(character), np.empty((0, len(RigPoseSpace(character).low)))
    assert space.decode(none).shape == (0, len(character.rest_vertices), 3)
    assert space.decode_some(none, np.array([4, 1])).shape == (0, 2, 3)
    detector = CollisionDetector(character.topology, character.rest_vertices)
    assert ExactCheck(space, detector, space.body_size).are_free(none).shape == (0,)


def test_joints_stay_together(character: Character) -> None:
    """A joint stays attached to its parent, whatever the codes."""
    space, rig = RigPoseSpace(character), rig_of(character)
    transforms = space.transforms(random_codes(space))
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            carried = transforms[parent] @ np.linalg.inv(rig.rest[parent]) @ rig.rest[joint]
            np.testing.assert_allclose(transforms[joint, :3, 3], carried[:3, 3], atol=1e-10)


def test_derivatives_are_those_of_differences(character: Character) -> None:
    space = RigPoseSpace(character)
    for seed, share in enumerate((0.8, 1.0, 1e-3, 0.0)):
        codes = random_codes(space, seed, share)
        by_vertices = a_few(character, 4, seed)
        slopes = space.pull_back(codes, by_vertices)
        ends = np.concatenate(
            [codes + STEP * np.eye(len(codes)), codes - STEP * np.eye(len(codes))]
        )
        above, below = np.split(space.decode(ends), 2)
        moved = (above - below) / (2.0 * STEP)
        differences = np.einsum("nvx,dvx->nd", by_vertices, moved)
        assert np.abs(slopes).max() > 0.1
        np.testing.assert_allclose(slopes, differences, atol=1e-7 * np.abs(slopes).max())
        chosen = np.arange(0, space.topology.n_vertices, 3)
        np.testing.assert_allclose(space.tangents(codes, chosen), moved[:, chosen], atol=1e-8)


def test_means_of_patches_are_differentiated_with_the_rest() -> None:
    character = CHARACTERS["body"]
    space = RigPoseSpace(character)
    codes, by_vertices = np.maximum(random_codes(space), np.radians(10.0)), a_few(character, 2, 3)
    weights = np.random.default_rng(1).random((2, space.topology.n_vertices))
    slopes = space.mean_slopes(csr_matrix(weights))(codes, by_vertices)
    assert slopes.shape == (3 * 2 + 2, len(codes))
    moved = space.tangents(codes, np.arange(space.topology.n_vertices))
    means = np.einsum("mv,dvx->mxd", weights, moved).reshape(6, -1)
    np.testing.assert_allclose(slopes[:6], means, atol=1e-10 * np.abs(means).max())
    np.testing.assert_array_equal(slopes[6:], space.pull_back(codes, by_vertices))
    none = np.empty((0, space.topology.n_vertices, 3))
    np.testing.assert_array_equal(space.mean_slopes(csr_matrix(weights))(codes, none), slopes[:6])


def test_a_straight_arm_is_known_to_bend_when_its_hand_is_pulled_to_the_shoulder() -> None:
    character = CHARACTERS["body"]
    space, rig = RigPoseSpace(character), rig_of(character)
    hand, elbow = (rig.joint_names.index(name) for name in ("LeftHand", "LeftForeArm"))
    weights = np.zeros((1, space.topology.n_vertices))
    led = rig.joint_of[np.arange(len(rig.joint_of)), rig.weights.argmax(axis=1)] == hand
    weights[0, led] = 1.0 / led.sum()
    bend = (space.joint_of_code == elbow) & (space.axis_of_code == 0)
    straight, none = np.zeros(len(space.low)), np.empty((0, space.topology.n_vertices, 3))
    (along,) = space.mean_slopes(csr_matrix(weights))(straight, none)[0, bend]
    assert along < -0.02
    exact = np.zeros((1, space.topology.n_vertices, 3))
    exact[0, :, 0] = weights[0]
    assert abs(space.pull_back(straight, exact)[0, bend][0]) < 1e-3


def test_codes_come_back_from_their_transforms(character: Character) -> None:
    space = RigPoseSpace(character)
    codes = np.stack([random_codes(space, seed, 0.9) for seed in range(4)])
    transforms = np.stack([space.transforms(one) for one in codes])
    # Rotation vectors are unique only up to half a turn.
    back = space.codes_of_transforms(transforms)
    again = np.stack([space.transforms(one) for one in back])
    np.testing.assert_allclose(again, transforms, atol=1e-9 * space.body_size)
    short = 0.3 * codes
    transforms = np.stack([space.transforms(one) for one in short])
    np.testing.assert_allclose(space.codes_of_transforms(transforms), short, atol=1e-9)
    np.testing.assert_allclose(space.codes_of_transforms(transforms[0]), short[0], atol=1e-9)


def test_turns_of_any_origin_are_expressed_and_scales_left_out() -> None:
    character = CHARACTERS["tube"]
    space, rig = RigPoseSpace(character), rig_of(character)
    turns = Rotation.random(3, rng=np.random.default_rng(2)).as_matrix()
    transforms = turned(rig, turns)
    codes = space.codes_of_transforms(transforms)
    np.testing.assert_allclose(space.transforms(codes), transforms, atol=1e-12)
    scaled = transforms.copy()
    scaled[1, :3, :3] *= 1.3
    np.testing.assert_allclose(space.codes_of_transforms(scaled), codes, atol=1e-12)
    assert np.abs(space.decode(codes[None])[0] - space.skinned(scaled)).max() > 0.01


@pytest.mark.parametrize(
    "scale", [(-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, -1), (-1.1, 0.9, 1), (0.2, -0.2, 0.2)]
)
def test_turns_of_a_mirrored_joint_do_not_jump(scale: tuple[float, float, float]) -> None:
    character = rigged_body()
    rig, space = rig_of(character), RigPoseSpace(character)
    joint = rig.joint_names.index("RightForeArm")
    turns = np.tile(np.eye(3), (41, len(rig.parents), 1, 1))
    angles = np.outer(np.linspace(0.0, 0.8, 41), [0.3, 0.2, 1.0])
    turns[:, joint] = Rotation.from_rotvec(angles).as_matrix() @ np.diag(scale)
    # As rounded to single precision in a file.
    codes = space.unwound(space.codes_of_transforms(turned(rig, turns).astype(np.float32)))
    assert np.abs(np.diff(codes, axis=0)).max() < 0.1
    if max(scale) > 0.0:
        assert np.abs(codes[0]).max() < 1e-3


def test_roots_that_share_nothing_move_as_one_body() -> None:
    tube = CHARACTERS["tube"]
    rig = replace(rig_of(tube), parents=np.array([-1, 0, -1]))
    space = RigPoseSpace(replace(tube, rig=rig))
    assert len(space.low) == 6 + 9
    codes = np.zeros(15)
    codes[:6] = 0.1, 0.2, -0.1, 0.3, 0.2, 0.1
    moved = space.decode(codes[None])[0]
    np.testing.assert_allclose(
        space.topology.edge_lengths(moved), space.topology.edge_lengths(space.rest_vertices)
    )
    assert np.abs(moved - space.rest_vertices).max() > 0.2
    codes = random_codes(space, 3)
    by_vertices = a_few(tube, 2, 1)
    steps = STEP * np.eye(15)
    differences = (space.decode(codes + steps) - space.decode(codes - steps)) / (2.0 * STEP)
    np.testing.assert_allclose(
        space.pull_back(codes, by_vertices),
        np.einsum("nvx,dvx->nd", by_vertices, differences),
        atol=1e-6,
    )


def test_joints_that_carry_nothing_have_no_codes() -> None:
    space, rig = RigPoseSpace(CHARACTERS["body"]), rig_of(CHARACTERS["body"])
    with_codes = {rig.joint_names[joint] for joint in space.joint_of_code}
    assert with_codes == {name for name in rig.joint_names if not name.endswith("End")}
    assert space.group_sizes[:2] == (6, 0)
    assert set(space.joint_of_code[:6]) == {0}


def test_body_parts_own_the_codes_of_their_joints() -> None:
    character = rigged_body()
    rig = rig_of(character)
    parts = [name.removesuffix("End").replace("Hand", "ForeArm") for name in rig.joint_names]
    assert "Left forearm" in RigPoseSpace(character).part_names
    space = RigPoseSpace(character, parts)
    assert "LeftHand" not in space.part_names
    # The neck has no vertices of its own.
    assert "Neck" not in space.part_names
    forearm = space.part_names.index("LeftForeArm")
    own = space.codes_of([forearm])
    assert {rig.joint_names[joint] for joint in space.joint_of_code[own]} == {
        "LeftForeArm",
        "LeftHand",
    }
    assert own.sum() == space.group_sizes[1 + forearm] == 6
    assert not space.codes_of([]).any()
    np.testing.assert_allclose(space.attention_mask.sum(axis=0), 1.0, atol=1e-6)
    led = space.attention_mask.argmax(axis=0) == space.vertex_domain
    assert led.mean() > 0.99


def test_the_root_goes_with_its_own_part_and_stays_while_others_are_dragged() -> None:
    space = RigPoseSpace(CHARACTERS["body"])
    whole = np.arange(len(space.low)) < 6
    hips = space.part_names.index("Hips")
    np.testing.assert_array_equal(space.codes_of([hips]), whole)
    of_hips, of_hand = (
        int(np.flatnonzero(space.vertex_domain == space.part_names.index(part))[0])
        for part in ("Hips", "Left hand")
    )
    limbs = space.limbs
    for vertex in (of_hips, of_hand):
        reaches = limbs.drag_stages(limbs.held_segment(np.array([vertex]), np.ones(1)))
        moved = limbs.codes_of(set().union(*reaches))
        assert moved[whole].all() == (vertex == of_hips)
        assert moved[~whole].any() == (vertex == of_hand)


def test_a_root_that_leads_no_vertex_goes_with_what_does() -> None:
    tube = CHARACTERS["tube"]
    rig = rig_of(tube)
    below = replace(
        rig,
        joint_names=("root", *rig.joint_names),
        parents=np.array([-1, 0, 1, 0]),
        rest=np.concatenate([np.eye(4)[None], rig.rest]),
        joint_of=rig.joint_of + 1,
    )
    space = RigPoseSpace(replace(tube, rig=below), ["root", "one", "two", "three"])
    assert space.part_names == ("one", "two", "three")
    assert set(space.joint_of_code[:6]) == {0}
    assert space.codes_of([0]).sum() == 6 + 3
    first = space.limbs.held_segment(np.array([0]), np.ones(1))
    assert space.limbs.codes_of([first])[:6].all()


def test_hinges_bend_one_way_and_forward_is_where_the_toes_point() -> None:
    character = rigged_body()
    space, rig = RigPoseSpace(character), rig_of(character)
    np.testing.assert_allclose(space.front, [0.0, -1.0, 0.0], atol=1e-12)

    def bent(joint: str, axis: int, degrees: float) -> FloatArray:
        number = rig.joint_names.index(joint)
        code = np.flatnonzero((space.joint_of_code == number) & (space.axis_of_code == axis))
        codes = np.zeros(len(space.low))
        codes[code] = np.radians(degrees)
        assert (codes <= space.high + 1e-12).all()
        assert (codes >= space.low - 1e-12).all()
        return space.transforms(codes)

    place = rig.joint_names.index
    for side in ("Left", "Right"):
        assert bent(f"{side}ForeArm", 0, 90)[place(f"{side}Hand"), 1, 3] < -0.2
        assert bent(f"{side}Leg", 0, 90)[place(f"{side}Foot"), 1, 3] > 0.3
        assert bent(f"{side}UpLeg", 0, 90)[place(f"{side}Leg"), 1, 3] < -0.3
        for joint in ("ForeArm", "Leg"):
            hinge = space.joint_of_code == place(side + joint)
            bend, _, aside = np.degrees(np.stack([space.low[hinge], space.high[hinge]], axis=1))
            np.testing.assert_allclose(bend, [-5.0, 150.0])
            np.testing.assert_allclose(aside, [-5.0, 5.0])
    upright = bent("Spine", 1, 30)
    np.testing.assert_allclose(upright[place("Head"), :3, 3], rig.rest[place("Head"), :3, 3])


def test_an_animal_faces_where_its_head_is() -> None:
    tube = rigged_tube()
    rig = replace(rig_of(tube), joint_names=("spine", "head", "hoof"))
    lying = replace(tube, rig=rig, up=np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(RigPoseSpace(lying).front, [0.0, 1.0, 0.0], atol=1e-12)
    # If the body stands, its head is above it, and the front is still perpendicular to up.
    assert abs(RigPoseSpace(replace(lying, up=tube.up)).front @ tube.up) < 1e-12


def test_clips_widen_limits_and_say_what_is_plausible() -> None:
    character = rigged_body(n_frames=20)
    frames = character.sample("moves", None)
    assert frames.transforms is not None
    plain, measured = RigPoseSpace(character), RigPoseSpace(character, frames=frames.transforms)
    codes = measured.codes_of_transforms(frames.transforms)
    assert ((codes < plain.low) | (codes > plain.high)).any()
    assert ((codes >= measured.low) & (codes <= measured.high)).all()
    assert (measured.low <= plain.low).all()
    assert (measured.high >= plain.high).all()
    np.testing.assert_allclose(
        measured.decode(codes), frames.vertices / measured.body_size, atol=1e-9
    )
    # The clip's motion is more plausible than an equally large one in another direction.
    turn = np.zeros(len(codes[0]))
    turn[6:] = np.random.default_rng(0).permutation(codes[10, 6:])
    cost = [float(move @ measured.precision @ move) for move in (codes[10], turn)]
    assert cost[0] < 0.7 * cost[1]
    assert (np.linalg.eigvalsh(measured.precision) > 0.0).all()
    assert (measured.topology.edge_lengths(measured.rest_vertices) < measured.longest_edges).all()


@pytest.mark.parametrize("name", ["tube", "body"])
def test_the_metric_measures_vertices(name: str) -> None:
    space = RigPoseSpace(CHARACTERS[name])
    generator = np.random.default_rng(2)
    ratios = []
    for seed in range(40):
        codes = random_codes(space, seed, 0.4)
        step = 1e-3 * generator.normal(size=len(codes))
        moved = space.decode((codes + step)[None]) - space.decode(codes[None])
        squared = (moved**2).sum(axis=2).mean()
        ratios.append(np.sqrt(step @ space.metric @ step / squared))
    assert 0.8 < np.median(ratios) < 1.25
    assert (np.linalg.eigvalsh(space.metric) > 0.0).all()
    # The metrics of the parts and of the whole body, from the full Jacobian.
    everything = np.arange(space.topology.n_vertices)
    parts = np.zeros((space.n_domains, len(codes), len(codes)))
    for pose in space._plausible:
        moved = space.tangents(pose, everything)
        for domain in range(space.n_domains):
            by_code = moved[:, space.vertex_domain == domain].reshape(len(codes), -1)
            parts[domain] += by_code @ by_code.T / len(everything) / len(space._plausible)
    metrics, weights = space.domain_metrics, generator.uniform(size=space.n_domains)
    np.testing.assert_allclose(metrics.squared(step), parts @ step @ step, rtol=1e-9)
    np.testing.assert_allclose(
        metrics.weighted(weights), np.tensordot(weights, parts, 1), atol=1e-12
    )
    whole = parts.sum(axis=0)
    stiffening = 1e-3 * np.trace(whole) / len(codes) * np.eye(len(codes))
    np.testing.assert_allclose(space.metric, whole + stiffening, atol=1e-12)


def test_a_hand_is_dragged_to_the_hip_and_stays_out_of_it() -> None:
    character = rigged_body()
    space: PoseSpace = RigPoseSpace(character)
    rig = rig_of(character)
    detector = CollisionDetector(character.topology, character.rest_vertices)
    size = float(np.ptp(character.rest_vertices, axis=0).max())
    hand = int(
        np.flatnonzero(
            rig.weights[:, 0] * (rig.joint_of[:, 0] == rig.joint_names.index("LeftHand")) > 0.9
        )[4]
    )
    grip = make_grip(space, hand)
    # Along the surface, only its own component is near.
    assert len(grip.vertices) > 3
    begin = grip.position(character.rest_vertices)
    target = np.array([0.1, -0.02, 1.1])
    ends = {}
    for solid in (False, True):
        dragger = PoseDragger(ExactCheck(space, detector, size), space.up)
        dragger.begin(np.zeros(len(space.low)), grip, (), DragOptions(solid=solid))
        for event in range(1, 61):
            step = dragger.move(begin + min(1.0, event / 45) * (target - begin))
            if solid:
                assert not detector.detect(step.vertices).colliding
        ends[solid] = step
    assert ends[False].miss < 0.02
    assert detector.detect(ends[False].vertices).colliding
    assert ends[True].miss < 0.2
    assert len(ends[True].contacts)


def test_a_character_without_a_rig_is_refused_in_a_sentence() -> None:
    with pytest.raises(LCollisionError, match=r"tube\.glb has no joints to pose it by"):
        RigPoseSpace(replace(CHARACTERS["tube"], rig=None))
    with pytest.raises(ShapeError, match="must be 3 names, got 1"):
        RigPoseSpace(CHARACTERS["tube"], ["arm"])
    space = RigPoseSpace(CHARACTERS["tube"])
    with pytest.raises(ShapeError, match=r"must be \(3, 4, 4\) a pose"):
        space.codes_of_transforms(np.eye(4))
    broken = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    broken[1, 0, 0] = np.nan
    with pytest.raises(ShapeError, match="not finite"):
        space.codes_of_transforms(broken)


def test_joints_are_on_the_side_of_the_body_on_which_their_limb_leaves_the_trunk() -> None:
    body = rigged_body(scale=100.0)
    names = rig_of(body).joint_names
    expected = ["left" * name.startswith("Left") + "right" * name.startswith("Right")
                for name in names]  # fmt: skip
    assert [side.value for side in RigPoseSpace(body).sides] == expected
    # A hand that rests on the other side is still the same hand.
    crossed = rig_of(body).rest.copy()
    hand = names.index("LeftHandEnd")
    crossed[hand, 0, 3] *= -1.0
    space = RigPoseSpace(replace(body, rig=replace(rig_of(body), rest=crossed)))
    assert space.sides[hand].value == "left"


def test_what_is_shown_besides_a_pose_goes_along_with_the_joints() -> None:
    space = RigPoseSpace(rigged_body())
    rng = np.random.default_rng(8)
    codes = rng.uniform(-0.3, 0.3, size=len(space.low))
    bumps = 0.01 * rng.normal(size=space.rest_vertices.shape)
    shown = space.decode(codes[None])[0] + bumps
    shaped = space.shaped_as(codes, shown)
    assert np.allclose(shaped.decode(codes[None])[0], shown, atol=1e-12)
    assert np.array_equal(
        shaped.decode_some(codes[None], np.arange(9))[0], shaped.decode(codes[None])[0, :9]
    )
    # If the whole body turns, so do the bumps.
    turned_codes = codes.copy()
    turned_codes[3:6] += [0.0, 0.4, 0.0]
    moved = shaped.decode(turned_codes[None])[0] - space.decode(turned_codes[None])[0]
    assert np.allclose(np.linalg.norm(moved, axis=1), np.linalg.norm(bumps, axis=1), atol=1e-3)
    assert np.abs(moved - bumps).max() > 1e-3
    assert np.array_equal(space.decode(codes[None])[0] + bumps, shown)
