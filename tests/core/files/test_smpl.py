"""SMPL body models against the paper's equations, and derivatives against differences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array, csc_array, csr_array, csr_matrix

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.errors import MeshFileError
from lcollision_core.files import read_character
from lcollision_core.files.character_reading import character_of_smpl
from lcollision_core.files.motion.smpl import JOINT_NAMES, SmplModel, read_smpl
from lcollision_core.meshes.joint_kinds import Role
from tests.rigged_shapes import FloatArray
from tests.smpl_files import (
    Arrays,
    linear_blend_skinning,
    smpl_arrays,
    tiny_arrays,
    write_model,
)

SAME = 1e-7
"""Tolerance in metres: pose blend shapes are stored in single precision."""


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> SmplModel:
    return read_smpl(write_model(tmp_path_factory.mktemp("models") / "SMPLX_NEUTRAL.npz"))


@pytest.fixture(scope="module")
def space(model: SmplModel) -> RigPoseSpace:
    return RigPoseSpace(character_of_smpl(model, np.array([1.0, -2.0, 0.5])))


def random_turns(n_joints: int, n: int = 3) -> tuple[FloatArray, FloatArray]:
    generator = np.random.default_rng(n_joints)
    return 0.5 * generator.normal(size=(n, n_joints, 3)), generator.normal(size=(n, 3))


@pytest.mark.parametrize("n_joints", JOINT_NAMES)
def test_poses_are_those_of_the_papers_equations(tmp_path: Path, n_joints: int) -> None:
    arrays, betas = smpl_arrays(n_joints), np.zeros(10)
    betas[:4] = [1.5, -1.0, 0.5, 2.0]
    path = tmp_path / "model.npz"
    np.savez(path, **arrays)
    space = RigPoseSpace(character_of_smpl(read_smpl(path), betas))
    turns, shifts = random_turns(n_joints)
    codes = space.codes_of_rotations(turns, shifts)
    found = space.decode(codes) * space.body_size
    pelvis = space.rig.rest[0, :3, 3]
    for own, pose, turned, shift in zip(found, codes, turns, shifts, strict=True):
        expected = linear_blend_skinning(arrays, betas, turned, shift)
        assert np.abs(own - expected).max() < SAME
        assert np.abs(space.skinned(space.transforms(pose)) * space.body_size - own).max() < SAME
        assert np.abs(space.transforms(pose)[0, :3, 3] - pelvis - shift).max() < SAME
        back = space.rotations_of(pose)
        np.testing.assert_allclose(back[0], turned, atol=1e-12)
        np.testing.assert_allclose(back[1], shift, atol=1e-12)
    # Pose blend shapes matter: without them the skin is off by millimetres.
    plain = arrays | {"posedirs": 0.0 * arrays["posedirs"]}
    assert np.abs(found[0] - linear_blend_skinning(plain, betas, turns[0], shifts[0])).max() > 1e-3


def test_some_vertices_are_to_the_bit_those_of_all(space: RigPoseSpace) -> None:
    codes = space.codes_of_rotations(*random_turns(space.n_joints, 2))
    chosen = np.arange(5, space.topology.n_vertices, 11)
    np.testing.assert_array_equal(space.decode_some(codes, chosen), space.decode(codes)[:, chosen])


def test_derivatives_are_those_of_differences(space: RigPoseSpace) -> None:
    (codes,) = space.codes_of_rotations(*random_turns(space.n_joints, 1))
    chosen = np.arange(3, space.topology.n_vertices, 10)
    step = 1e-6 * np.eye(len(codes))
    forth, back = (space.decode_some(codes + move, chosen) for move in (step, -step))
    by_codes = (forth - back) / 2e-6
    # Except the ends of fingers, which have no skin in such a coarse mesh.
    assert (np.abs(by_codes).max(axis=(1, 2)) > 1e-4).mean() > 0.8
    np.testing.assert_allclose(space.tangents(codes, chosen), by_codes, atol=1e-8)
    generator = np.random.default_rng(5)
    by_vertices = np.zeros((4, space.topology.n_vertices, 3))
    by_vertices[:, chosen] = generator.normal(size=(4, len(chosen), 3))
    expected = np.einsum("mnx,dnx->md", by_vertices[:, chosen], by_codes)
    np.testing.assert_allclose(space.pull_back(codes, by_vertices), expected, atol=1e-6)
    # Bend elbows and knees beyond the least bend that slopes are computed at.
    codes[space._hinges] = np.abs(codes[space._hinges]) + 0.5
    mean = csr_matrix(
        (np.full(3, 1.0 / 3.0), ([0] * 3, chosen[:3])), shape=(1, len(by_vertices[0]))
    )
    slopes = space.mean_slopes(mean)(codes, by_vertices[:1])
    np.testing.assert_allclose(slopes[3:], space.pull_back(codes, by_vertices[:1]), atol=1e-12)
    moved = space.tangents(codes, chosen[:3]).mean(axis=1)
    np.testing.assert_allclose(slopes[:3], moved.T, atol=1e-12)


def test_every_joint_turns_about_any_axis_and_is_known(model: SmplModel) -> None:
    body = RigBody.of(character_of_smpl(model))
    space = body.space
    assert body.latent_size == 6 + 3 * 54
    assert np.bincount(space.joint_of_code, minlength=55).tolist() == [6] + [3] * 54
    assert (space.low < space.high).all()
    kinds = dict(
        zip(space.rig.joint_names, zip(space.roles, space.sides, strict=True), strict=True)
    )
    for name, role in (
        ("hip", Role.THIGH),
        ("knee", Role.SHIN),
        ("ankle", Role.FOOT),
        ("shoulder", Role.UPPER_ARM),
        ("elbow", Role.FOREARM),
        ("wrist", Role.HAND),
        ("index1", Role.FINGER),
        ("thumb2", Role.THUMB),
    ):
        for side in ("left", "right"):
            own, where = kinds[f"{side}_{name}"]
            assert (own, where.value) == (role, side)
    np.testing.assert_allclose(space.front, [0.0, 0.0, 1.0], atol=1e-7)
    assert body.exact_check().is_free(np.zeros(body.latent_size))
    still = RigBody.of(character_of_smpl(model, moving=model.names[:22]))
    assert still.latent_size == 6 + 3 * 21
    assert still.fingerprint != body.fingerprint
    turns, shifts = random_turns(55)
    turns[:, 22:] = 0.0
    found, of_all = (
        own.decode(own.space.codes_of_rotations(turns, shifts)) for own in (still, body)
    )
    np.testing.assert_array_equal(found, of_all)


def test_a_pose_is_found_again_from_its_mesh(tmp_path: Path) -> None:
    np.savez(tmp_path / "model.npz", **tiny_arrays())
    body = RigBody.of(read_character(tmp_path / "model.npz"))
    turns = 0.3 * np.random.default_rng(1).normal(size=(1, 24, 3))
    mesh = body.decode(body.space.codes_of_rotations(turns, np.zeros((1, 3))))[0]
    found = body.encode(mesh)
    assert found.fit_error_max < 1e-3
    assert np.abs(body.exported_vertices(found.latent, found.placement) - mesh).max() < 2e-3


def test_a_body_model_is_opened_as_a_character(tmp_path: Path) -> None:
    path = write_model(tmp_path / "SMPL_MALE.npz", 24)
    body = open_body(path)
    assert isinstance(body, RigBody)
    assert (body.name, body.up_axis, body.known_metres) == ("SMPL_MALE", 1, 1.0)
    assert read_character(path, up="z").up.tolist() == [0.0, 0.0, 1.0]


def sparse_forms(regressor: FloatArray) -> dict[str, Arrays]:
    rows, columns, pairs = csr_array(regressor), csc_array(regressor), coo_array(regressor)
    compressed = {
        name: {
            "J_regressor_data": held.data,
            "J_regressor_indices": held.indices,
            "J_regressor_indptr": held.indptr,
        }
        for name, held in (("rows", rows), ("columns", columns))
    }
    row, col = pairs.coords
    return compressed | {
        "pairs": {"J_regressor_data": pairs.data, "J_regressor_row": row, "J_regressor_col": col}
    }


def test_the_regressor_may_be_sparse(tmp_path: Path) -> None:
    arrays, path = tiny_arrays(), tmp_path / "model.npz"
    whole = arrays.pop("J_regressor")
    for form in sparse_forms(whole).values():
        np.savez(path, **arrays, **form)
        np.testing.assert_array_equal(read_smpl(path).regressor.toarray(), whole)
    for name, wrong in (("row", [-1]), ("col", [96])):
        form = sparse_forms(whole)["pairs"]
        form[f"J_regressor_{name}"] = np.resize(wrong, len(form["J_regressor_data"]))
        np.savez(path, **arrays, **form)
        with pytest.raises(MeshFileError, match="regressor"):
            read_smpl(path)


def test_smplx_has_expressions_after_its_shapes(tmp_path: Path) -> None:
    arrays, path = smpl_arrays(55, n_shapes=12), tmp_path / "model.npz"
    np.savez(path, **arrays)
    assert read_smpl(path).shape_directions.shape[2] == 10
    arrays["shapedirs"] = np.zeros((*arrays["shapedirs"].shape[:2], 400))
    np.savez(path, **arrays)
    assert read_smpl(path).shape_directions.shape[2] == 300


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"v_template": None}, "has no array 'v_template'"),
        ({"posedirs": np.zeros((96, 3, 459))}, r"numbers of shape \(96, 3, 207\)"),
        ({"kintree_table": np.zeros((2, 16), np.uint32)}, "has 16 joints, expected 24, 52 or 55"),
        ({"kintree_table": np.full((2, 24), 30, np.uint32)}, "comes before its parent"),
        ({"weights": np.full((96, 24), 0.5)}, "do not sum to 1"),
        ({"f": np.full((4, 3), 96, np.uint32)}, r"names vertices \[96, 96, 96\], expected 0 to 95"),
        ({"shapedirs": np.full((96, 3, 4), np.nan)}, "'shapedirs' has a number that is not finite"),
        ({"poses": np.zeros((2, 72)), "trans": np.zeros((2, 3)), "v_template": None}, "a motion"),
        ({"J_regressor": np.array({}, dtype=object)}, "numpy.savez"),
    ],
)
def test_a_wrong_model_is_refused_in_a_sentence(
    tmp_path: Path, changes: dict[str, np.ndarray | None], said: str
) -> None:
    path = tmp_path / "model.npz"
    arrays = {name: one for name, one in (tiny_arrays() | changes).items() if one is not None}
    np.savez(path, **arrays)
    with pytest.raises(MeshFileError, match=said) as refused:
        open_body(path)
    assert str(path) in str(refused.value)


def test_a_pickle_is_refused_unopened(tmp_path: Path) -> None:
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    path.write_bytes(b"cos\nsystem\n(S'touch ran'\ntR.")
    with pytest.raises(MeshFileError, match=r"is a pickle.*numpy\.savez"):
        open_body(path)
