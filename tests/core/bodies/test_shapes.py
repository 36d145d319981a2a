"""Morph targets as sliders of a pose: posing, storing, mirroring, resolving and writing."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import csc_matrix

from lcollision_core.bodies import NamedPose, RigBody, read_poses, write_poses
from lcollision_core.bodies.export import SourceFile
from lcollision_core.bodies.motions import MotionChange, read_motions, write_clips
from lcollision_core.files import read_character
from lcollision_core.files.character import Shapes
from lcollision_core.files.scene.scene import ScenePoses
from lcollision_core.motion.motion import corrected
from lcollision_core.options import ExportRequest
from lcollision_core.posing import DragOptions, Grip, PoseDragger
from tests.core.fbx_builder import arm_fbx
from tests.core.gltf_builder import arm, split_corners, tube
from tests.rigged_shapes import rigged_body
from tests.small_models import SHAPED

_NAMES = "smile_L", "smile_R", "fat"
_CLIP = "wave"


def face(path: Path, weights: tuple[float, ...] = (0.0, 0.0, 0.25), vrm: bool = False) -> Path:
    """Write the arm with three morph targets, animated by its clip, and with an expression."""
    builder = arm()
    points, _ = split_corners(*tube())
    targets = [np.zeros_like(points) for _ in _NAMES]
    targets[0][points[:, 0] > 0.0] = [0.1, 0.0, 0.0]
    targets[1][points[:, 0] < 0.0] = [-0.1, 0.0, 0.0]
    targets[2] = 0.5 * points * [1.0, 0.0, 1.0]
    mesh = builder.description["meshes"][0]
    mesh["primitives"][0]["targets"] = [{"POSITION": builder.array(one)} for one in targets]
    mesh |= {"extras": {"targetNames": list(_NAMES)}, "weights": list(weights)}
    (animation,) = builder.description["animations"]
    values = np.array([weights, (1.5, 0.0, weights[2]), (0.0, -0.5, 1.0)])
    sampler = {"input": builder.array([0.0, 0.4, 1.0]), "output": builder.array(values.ravel())}
    animation["samplers"].append(sampler)
    target = {"node": 4, "path": "weights"}
    animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})
    if vrm:
        binds = [{"node": 4, "index": index, "weight": 0.5} for index in (0, 1)]
        expressions = {"preset": {"happy": {"morphTargetBinds": binds}}}
        builder.description["extensions"] = {"VRMC_vrm": {"expressions": expressions}}
    return builder.write(path)


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> RigBody:
    return RigBody.of(read_character(face(tmp_path_factory.mktemp("face") / "face.glb")))


def _posed(body: RigBody, **shapes: float) -> np.ndarray:
    """Return codes of a bent arm with the given sliders."""
    codes = np.zeros(body.latent_size)
    codes[6] = 0.5
    for name, number in shapes.items():
        codes[body.code_names.index(name)] = number
    return codes


def _as_file_says(body: RigBody, codes: np.ndarray, weights: list[float]) -> np.ndarray:
    """Return the vertices according to the file's meshes, joints and weights."""
    character, rig = body.character, body.space.rig
    assert character.file is not None
    scene = character.file.scene
    transforms = scene.rest.transforms.copy()
    transforms[0, rig.nodes] = body.space.transforms(codes)
    poses = ScenePoses(transforms, tuple(np.array([weights]) for _ in scene.parts))
    return character.file.mesh.posed(poses)[0]


def test_a_pose_weighs_morph_targets(body: RigBody) -> None:
    assert body.shape_names == _NAMES
    assert body.latent_space.groups[-1].name == "Face and shapes"
    codes = _posed(body, smile_L=0.5, fat=0.25)
    expected = _as_file_says(body, codes, [0.5, 0.0, 0.5])
    np.testing.assert_allclose(body.decode(codes), expected, atol=1e-12)
    both = body.decode(np.stack([_posed(body), codes, codes, _posed(body)]))
    assert np.array_equal(both[1], both[2])
    assert np.array_equal(both[0], both[3])
    assert np.abs(both[0] - both[1]).max() > 0.05
    some = np.arange(0, body.n_vertices, 3)
    of_some = body.space.decode_some(codes[None], some) * body.body_size
    np.testing.assert_array_equal(of_some, both[1:2, some])


def test_ranges_are_those_of_weights_and_clips(body: RigBody) -> None:
    low, high = (end[-3:] for end in (body.space.low, body.space.high))
    np.testing.assert_allclose(low, [0.0, -0.5, -0.25], atol=1e-6)
    np.testing.assert_allclose(high, [1.5, 1.0, 0.75], atol=1e-6)
    np.testing.assert_allclose(body.latent_space.at_rest[-3:], [0.0, 0.0, 0.25], atol=1e-12)


def test_an_expression_is_a_slider(tmp_path: Path) -> None:
    avatar = RigBody.of(read_character(face(tmp_path / "a.vrm", vrm=True)))
    assert avatar.shape_names == ("happy", *_NAMES)
    one, other = _posed(avatar, happy=1.0), _posed(avatar, smile_L=0.5, smile_R=0.5)
    np.testing.assert_allclose(avatar.decode(one), avatar.decode(other), atol=1e-12)


def test_files_of_poses_name_the_weights(body: RigBody, tmp_path: Path) -> None:
    path, codes = tmp_path / "poses.json", _posed(body, smile_R=0.75)
    write_poses(path, body, [NamedPose("at rest", _posed(body)), NamedPose("smile", codes)])
    document = json.loads(path.read_text())
    assert [pose.get("shapes") for pose in document["poses"]] == [None, {"smile_R": 0.75}]
    n_codes = body.latent_size - len(_NAMES)
    assert [len(pose["latent"]) for pose in document["poses"]] == [n_codes] * 2
    assert document["model"]["codes"] == n_codes
    np.testing.assert_array_equal(read_poses(path, body)[1].latent, codes)
    document["poses"][1]["shapes"] |= {"of another export": 1.0}
    path.write_text(json.dumps(document))
    np.testing.assert_array_equal(read_poses(path, body)[1].latent, codes)


def test_what_is_known_of_a_rig_does_not_depend_on_its_shapes(body: RigBody) -> None:
    character = replace(body.character, rig=replace(body.space.rig, shapes=None), clips={})
    plain = RigBody.of(character)
    assert plain.fingerprint == body.fingerprint
    codes = _posed(body)
    np.testing.assert_array_equal(plain.decode(codes[:-3]), body.decode(codes))


def _moved_by_a_shape(is_moved: npt.NDArray[np.bool_], move: Sequence[float]) -> RigBody:
    """Return the body with one morph target, which shifts some vertices."""
    character = rigged_body()
    assert character.rig is not None
    used = character.rig.weights > 0.0
    deltas = np.repeat(np.where(is_moved[:, None], move, 0.0), used.sum(axis=1), axis=0)
    nothing = np.full((1, 2), -1)
    offsets = csc_matrix(deltas.reshape(-1, 1))
    shapes = Shapes(("moved",), np.zeros(1), np.ones(1), np.zeros(1), (), nothing, offsets)
    return RigBody.of(replace(character, rig=replace(character.rig, shapes=shapes)))


def test_contact_within_a_part_that_a_shape_alone_makes_does_not_count() -> None:
    """The shape moves the top of the head through its side."""
    height = rigged_body().rest_vertices[:, 2]
    body = _moved_by_a_shape(height > 1.75, [0.15, 0.0, -0.12])
    plain = replace(body.rules, shape_touching=())
    weighed = body.decode(np.eye(body.latent_size)[-1])
    without = body.with_rules(plain).detector.detect(weighed)
    assert without.n_pairs > 0
    excused = body.detector.detect(weighed)
    assert excused.n_pairs == 0
    assert excused.excluded == replace(without.excluded, shape=without.n_pairs)


def test_contact_of_two_parts_counts_though_a_shape_makes_it() -> None:
    """The shape moves one thigh into the other."""
    x, _, height = rigged_body().rest_vertices.T
    body = _moved_by_a_shape((x > 0.0) & (height > 0.6) & (height < 0.8), [-0.12, 0.0, 0.0])
    assert body.rules.shape_touching == ()
    assert body.detector.detect(body.decode(np.eye(body.latent_size)[-1])).n_pairs > 0


def test_mirroring_exchanges_shapes_by_their_names() -> None:
    character = rigged_body()
    assert character.rig is not None
    still = csc_matrix((3 * int((character.rig.weights > 0.0).sum()), len(_NAMES)))
    alone = np.full((len(_NAMES), 2), -1)
    shapes = Shapes(_NAMES, np.zeros(3), np.ones(3), np.zeros(3), (), alone, still)
    body = RigBody.of(replace(character, rig=replace(character.rig, shapes=shapes)))
    codes = np.append(0.1 * body.sample(1, np.random.default_rng(0))[0, :-3], [0.5, 0.0, 0.25])
    mirrored = body.pose_mirror.mirror(codes).latent
    np.testing.assert_array_equal(mirrored[-3:], [0.0, 0.5, 0.25])
    assert not np.array_equal(mirrored[:-3], codes[:-3])


def test_clips_play_with_their_weights(body: RigBody) -> None:
    (motion,) = read_motions(body, body.character.source, fps=10.0)
    assert motion.space_at is None
    frames = body.character.sample(_CLIP, 10.0)
    np.testing.assert_allclose(body.decode(motion.codes), frames.vertices, atol=1e-6)
    assert np.ptp(motion.codes[:, -3:], axis=0).min() > 0.4


def test_a_clip_of_another_character_brings_its_weights(tmp_path: Path) -> None:
    source = RigBody.of(read_character(SHAPED[1]))
    rig = source.space.rig
    names = tuple(f"{name}2" if name == "Head" else name for name in rig.joint_names)
    assert names != rig.joint_names
    body = RigBody.of(replace(source.character, rig=replace(rig, joint_names=names)))
    clip = Path(shutil.copy(SHAPED[1], tmp_path / "other.glb"))
    for own, carried in zip(read_motions(source, SHAPED[1]), read_motions(body, clip), strict=True):
        np.testing.assert_allclose(
            carried.codes[:, body.shape_codes], own.codes[:, source.shape_codes], atol=1e-6
        )
        assert carried.codes[:, body.shape_codes].min() > 0.9


def test_solvers_leave_shapes_as_they_are_posed(body: RigBody) -> None:
    codes = _posed(body, smile_L=0.5)
    dragger = PoseDragger(body.exact_check())
    start = body.decode(codes)
    top = int(start[:, 1].argmax())
    dragger.begin(codes, Grip.at(top), options=DragOptions())
    moved = dragger.move(start[top] + [0.3, 0.0, 0.0]).latent
    assert np.abs(moved[:-3] - codes[:-3]).max() > 1e-3
    np.testing.assert_array_equal(moved[-3:], codes[-3:])
    resolved = body.resolve(codes)
    np.testing.assert_array_equal(resolved.latent[-3:], codes[-3:])


@pytest.mark.parametrize("keep_clips", [False, True])
def test_a_glb_keeps_the_weights(body: RigBody, tmp_path: Path, keep_clips: bool) -> None:
    codes, out = _posed(body, smile_L=0.5, fat=0.25), tmp_path / "posed.glb"
    source = SourceFile(body.character.source, body)
    vertices = body.exported_vertices(codes, None)
    source.write(out, source.require_form(out, "joints"), vertices, codes, keep_clips=keep_clips)
    again = read_character(out)
    np.testing.assert_allclose(again.rest_vertices, vertices, atol=1e-6)
    assert again.file is not None
    assert again.file.document.objects("nodes")[4]["weights"] == [0.5, 0.0, 0.5]
    if keep_clips:
        before, after = (one.sample(_CLIP, 10.0).vertices for one in (body.character, again))
        np.testing.assert_allclose(after, before, atol=1e-6)


def test_a_clip_of_poses_keeps_the_weights(body: RigBody, tmp_path: Path) -> None:
    poses, out = (
        [_posed(body), _posed(body, smile_L=1.0), _posed(body, fat=-0.2)],
        tmp_path / "c.glb",
    )
    vertices = np.stack([body.exported_vertices(codes, None) for codes in poses])
    source = SourceFile(body.character.source, body)
    source.write_clip(out, vertices, poses, ExportRequest(fps=30.0))
    np.testing.assert_allclose(
        read_character(out).sample("poses", None).vertices, vertices, atol=1e-6
    )


def test_a_corrected_frame_keeps_its_weights(body: RigBody, tmp_path: Path) -> None:
    file, out = body.character.source, tmp_path / "corrected.glb"
    (motion,) = read_motions(body, file, fps=10.0)
    aim = motion.codes[6].copy()
    aim[-3:] += [0.0, 0.5, -0.1]
    after = corrected(motion, 6, aim, 1)
    write_clips(out, body, file, [MotionChange(motion, after, [range(5, 8)])])
    frames = read_character(out).sample(_CLIP, motion.times)
    assert frames.shapes is not None
    np.testing.assert_allclose(frames.shapes, after.codes[:, -3:], atol=1e-6)
    np.testing.assert_allclose(frames.vertices, body.decode(after.codes), atol=1e-5)


def test_blend_shapes_of_an_fbx_are_sliders_and_weights_of_its_glb(tmp_path: Path) -> None:
    body = RigBody.of(read_character(arm_fbx(tmp_path / "arm.fbx", is_long=True)))
    assert body.shape_names == ("Longer",)
    codes, out = np.zeros(body.latent_size), tmp_path / "arm.glb"
    codes[-1] = 0.25  # Half of it is already applied at rest.
    vertices = body.exported_vertices(codes, None)
    assert np.abs(vertices - body.reference).max() > 0.01 * body.body_size
    source = SourceFile(body.character.source, body)
    assert source.frame is not None
    placed = source.frame.apply(vertices)
    source.write(out, source.require_form(out, "joints"), placed, codes)
    again = read_character(out)
    assert again.rig is not None
    assert again.rig.shapes is not None
    assert again.rig.shapes.names == ("Longer",)
    assert again.file is not None
    assert [weights[0].tolist() for weights in again.file.scene.rest.weights] == [[0.75]]
