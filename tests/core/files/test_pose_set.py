from __future__ import annotations

import io
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcollision_core.errors import (
    CancelledError,
    LCollisionError,
    MeshFileError,
    PoseSetError,
    ShapeError,
)
from lcollision_core.files import (
    PoseSet,
    audit_mesh,
    inspect_pose_set,
    read_pose_set,
    write_mesh,
    write_pose_set,
)
from lcollision_core.files.pose_set_reading import natural_key
from lcollision_core.jobs import Job
from lcollision_core.meshes import ContactRules, FaceGroup, Topology, degenerate_faces
from tests.bending_tube import bending_tube

FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)
VERTICES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 1]])


def _poses(n: int) -> np.ndarray:
    return VERTICES + np.arange(n)[:, None, None]


def _write_folder(folder: Path, n: int = 12, suffix: str = ".obj") -> Path:
    folder.mkdir(exist_ok=True)
    for pose, vertices in enumerate(_poses(n)):
        write_mesh(folder / f"mesh{pose}{suffix}", vertices, FACES)
    return folder


@pytest.mark.parametrize("suffix", [".obj", ".PLY", ".off", ".stl", ".glb"])
def test_folder_is_read_in_natural_order(tmp_path: Path, suffix: str) -> None:
    seen: list[tuple[int, int]] = []
    job = Job().part(lambda done, total: seen.append((done, total)))
    pose_set = read_pose_set(_write_folder(tmp_path, suffix=suffix), job)
    assert pose_set.names == tuple(f"mesh{pose}{suffix}" for pose in range(12))
    assert pose_set.vertices.dtype == np.float64
    if suffix == ".stl":  # vertices are numbered by first appearance: 0, 2, 1, 3
        assert np.array_equal(pose_set.vertices, _poses(12)[:, [0, 2, 1, 3]])
        assert "in 11 of 12 files" in " ".join(pose_set.notes)
    else:
        assert np.array_equal(pose_set.vertices, _poses(12))
        assert np.array_equal(pose_set.faces, FACES)
        assert pose_set.notes == ()
    assert seen == [(done, 12) for done in range(1, 13)]
    assert not pose_set.vertices.flags.writeable


@given(st.lists(st.integers(0, 10**30), min_size=2, unique=True))
def test_numbers_in_names_sort_by_value(numbers: list[int]) -> None:
    files = [Path(f"Mesh_{number}.obj") for number in numbers]
    assert sorted(files, key=natural_key) == [Path(f"Mesh_{n}.obj") for n in sorted(numbers)]


def test_natural_order_of_mixed_names() -> None:
    ordered = ["1", "2b", "10a", "a", "A02", "a2", "a10b", "a10b1", "a10b9", "b", "é"]
    files = [Path(f"{name}.obj") for name in reversed(ordered)]
    files.sort(key=natural_key)
    assert [file.stem for file in files] == ordered


def test_other_entries_are_ignored_and_named(tmp_path: Path) -> None:
    folder = _write_folder(tmp_path, 2)
    (folder / "readme.txt").write_text("x")
    (folder / "textures").mkdir()
    (folder / "._mesh0.obj").write_text("x")
    pose_set = read_pose_set(folder)
    assert len(pose_set) == 2
    assert pose_set.notes == ("entries that are no meshes were ignored: readme.txt, textures",)


def test_quads_are_noted_once_for_the_set(tmp_path: Path) -> None:
    for name in ("a.obj", "b.obj"):
        (tmp_path / name).write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 1\nf 1 2 3 4\n")
    assert read_pose_set(tmp_path).notes == ("1 quad was triangulated",)


def _reshape_one(folder: Path, kind: str) -> None:
    path = folder / "mesh7.obj"
    text = path.read_text()
    path.write_text(
        {
            "vertex": text.replace("f", "v 5 5 5\nf", 1),
            "face": text + "f 1 2 4\n",
            "order": text.replace("f 1 3 2\n", "f 3 2 1\n"),
            "nan": text.replace("v 7.0 9.0 7.0", "v 7.0 nan 7.0"),
            "cut": text[: len(text) // 2],
            "empty": "",
            "index": text + "f 1 2 9\n",
        }[kind]
    )


@pytest.mark.parametrize(
    ("kind", "error", "message"),
    [
        (
            "vertex",
            PoseSetError,
            r"pose 7 \(mesh7\.obj\) has another number of vertices .* expected 4, got 5; rem",
        ),
        (
            "face",
            PoseSetError,
            r"pose 7 \(mesh7\.obj\) has another number of faces .* expected 4, got 5; rem",
        ),
        (
            "order",
            PoseSetError,
            r"pose 7 \(mesh7\.obj\) has another face 0 than the set, expected .*, got \[2, 1, 0\]",
        ),
        ("nan", MeshFileError, r"mesh7\.obj cannot be read: vertex 2 .* not finite"),
        ("cut", MeshFileError, r"mesh7\.obj cannot be read: "),
        ("empty", MeshFileError, r"mesh7\.obj cannot be read: it is empty"),
        ("index", MeshFileError, r"mesh7\.obj cannot be read: face 4 names vertices \[0, 1, 8\]"),
    ],
)
def test_one_bad_pose_is_refused_by_name_and_listed_by_inspection(
    tmp_path: Path, kind: str, error: type[LCollisionError], message: str
) -> None:
    folder = _write_folder(tmp_path)
    _reshape_one(folder, kind)
    with pytest.raises(error, match=message) as caught:
        read_pose_set(folder)
    assert "\n" not in str(caught.value)
    found = inspect_pose_set(folder)
    assert found.problems == (str(caught.value),)
    assert found.n_found == 12
    assert found.same_topology is (error is MeshFileError)
    assert found.pose_set is not None
    assert np.array_equal(found.pose_set.vertices, np.delete(_poses(12), 7, axis=0))
    assert "mesh7.obj" not in found.pose_set.names


def test_inspection_lists_every_defect(tmp_path: Path) -> None:
    folder = _write_folder(tmp_path)
    (folder / "mesh0.obj").write_text("")
    (folder / "mesh3.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "mesh5.obj").write_text("nothing")
    found = inspect_pose_set(folder)
    assert len(found.problems) == 3
    assert [name in text for name, text in zip("035", found.problems, strict=True)] == [True] * 3
    assert found.n_found == 12
    assert found.pose_set is not None
    assert len(found.pose_set) == 9


@pytest.mark.parametrize("n_poses", [2, 4, 12])
def test_a_pose_in_another_unit_or_order_of_vertices_is_refused(
    tmp_path: Path, n_poses: int
) -> None:
    tube = bending_tube(n_poses=n_poses)
    others = [f"pose {pose}" for pose in range(n_poses) if pose != 1]
    shuffled = np.random.default_rng(1).permutation(tube.vertices.shape[1])
    for spoilt, defect in (
        (tube.vertices[1] * 100.0, "is 100 times as large as the other poses; scale it by 0.01"),
        (tube.vertices[1][shuffled], "connects other vertices than the other poses"),
        (tube.vertices[1] * 0.0, "has no size; remove it"),
    ):
        vertices = tube.vertices.copy()
        vertices[1] = spoilt
        path = tmp_path / "set.npz"
        np.savez(path, vertices=vertices, faces=tube.faces)
        with pytest.raises(PoseSetError, match=re.escape(f"pose 1 of {path} {defect}")) as caught:
            read_pose_set(path)
        found = inspect_pose_set(path)
        assert found.problems == (str(caught.value),)
        assert found.n_found == n_poses
        assert found.pose_set is not None
        assert list(found.pose_set.names) == others


def test_two_wrong_poses_of_four_do_not_hide_each_other(tmp_path: Path) -> None:
    """Of four poses, one is too large and one shuffled: the two valid ones decide."""
    tube = bending_tube(n_poses=4)
    vertices = tube.vertices.copy()
    vertices[0] *= 100.0
    vertices[2] = vertices[2][np.random.default_rng(1).permutation(vertices.shape[1])]
    path = tmp_path / "set.npz"
    np.savez(path, vertices=vertices, faces=tube.faces)
    found = inspect_pose_set(path)
    assert found.pose_set is not None
    assert found.pose_set.names == ("pose 1", "pose 3")


def test_triangle_without_area_is_refused_in_the_reference(tmp_path: Path) -> None:
    flat = _poses(3)
    flat[0, 2] = [2.0, 0.0, 0.0]  # on the line through vertices 0 and 1 of face 0
    write_pose_set(tmp_path / "s.npz", PoseSet(flat, Topology(FACES, 4), ("a", "b", "c")))
    with pytest.raises(PoseSetError, match=r"s\.npz .* pose 0 \(a\), .* the first is face 0"):
        read_pose_set(tmp_path / "s.npz")
    found = inspect_pose_set(tmp_path / "s.npz")
    assert found.problems == ("pose 0 (a): 1 face has no area, the first is face 0",)
    write_pose_set(tmp_path / "s.npz", PoseSet(flat[::-1], Topology(FACES, 4), ("c", "b", "a")))
    assert len(read_pose_set(tmp_path / "s.npz")) == 3


def test_folders_that_are_no_pose_set(tmp_path: Path) -> None:
    with pytest.raises(MeshFileError, match="contains no mesh"):
        read_pose_set(tmp_path)
    _write_folder(tmp_path, 3)
    _write_folder(tmp_path, 2, ".ply")
    with pytest.raises(MeshFileError, match=r"several formats \(3 \.obj, 2 \.ply\)"):
        read_pose_set(tmp_path)
    with pytest.raises(MeshFileError, match="is one mesh, not a pose set"):
        read_pose_set(tmp_path / "mesh0.obj")
    with pytest.raises(MeshFileError, match="does not exist"):
        read_pose_set(tmp_path / "none")
    with pytest.raises(MeshFileError, match="name too long"):
        read_pose_set(tmp_path / ("x" * 300))
    (tmp_path / "x.txt").write_text("x")
    with pytest.raises(MeshFileError, match="is not a pose set"):
        read_pose_set(tmp_path / "x.txt")
    assert inspect_pose_set(tmp_path / "none").problems != ()


def test_set_beyond_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lcollision_core.files.pose_set_reading.MAX_ITEMS", 12 * 4 * 3 - 1)
    folder = _write_folder(tmp_path)
    with pytest.raises(MeshFileError, match="12 poses of 4 vertices, more than 143"):
        read_pose_set(folder)
    assert len(inspect_pose_set(folder).problems) == 1
    (folder / "mesh11.obj").unlink()
    assert len(read_pose_set(folder)) == 11


def test_cancel_ends_reading(tmp_path: Path) -> None:
    token = Job()
    read: list[int] = []

    def stop_after_three(done: int, _: int) -> None:
        read.append(done)
        if done == 3:
            token.cancel()

    with pytest.raises(CancelledError):
        read_pose_set(_write_folder(tmp_path), token.part(stop_after_three))
    assert read == [1, 2, 3]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_npz_round_trip_keeps_everything(tmp_path: Path, dtype: type[np.floating]) -> None:
    pose_set = PoseSet(
        (_poses(3) / 3).astype(dtype),
        Topology(FACES, 4),
        ("a.obj", "pose 1", "größer"),
        notes=("1 quad was triangulated",),
        rules=ContactRules(0.025),
        up_axis=1,
        vertex_labels=np.array(["head", "left arm", "left arm", "leg"]),
        provenance={"by_rig": {"seed": 3, "limits_degrees": {"größer": [[-5.0, 150.0]]}}},
    )
    path = tmp_path / "set.npz"
    write_pose_set(path, pose_set)
    first = path.read_bytes()
    again = read_pose_set(path)
    assert again.vertices.dtype == dtype
    assert np.array_equal(again.vertices, pose_set.vertices)
    assert again.topology == pose_set.topology
    assert again.source == path
    for name in ("names", "notes", "near_exclusion", "up_axis", "provenance"):
        assert getattr(again, name) == getattr(pose_set, name)
    assert again.vertex_labels is not None
    assert again.vertex_labels.tolist() == ["head", "left arm", "left arm", "leg"]
    write_pose_set(path, again)
    assert path.read_bytes() == first


def test_rules_and_groups_come_back(tmp_path: Path) -> None:
    rules = ContactRules(0.01, 0.02, (("hair", "body"), ("hair", "hair")), 1e-5)
    groups = (
        FaceGroup("hair", np.array([0, 2])),
        FaceGroup("body", np.array([1, 2, 3])),
        FaceGroup("none", np.array([], dtype=np.int64)),
    )
    pose_set = PoseSet(_poses(1), Topology(FACES, 4), ("a",), rules=rules, groups=groups)
    write_pose_set(tmp_path / "s.npz", pose_set)
    again = read_pose_set(tmp_path / "s.npz")
    assert again.rules == rules
    assert [(group.name, group.faces.tolist()) for group in again.groups] == [
        ("hair", [0, 2]),
        ("body", [1, 2, 3]),
        ("none", []),
    ]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"rules": np.array("{")}, "rules are damaged"),
        ({"rules": np.array('{"tolerated_depth": -1}')}, "tolerated depth must be 0 or more"),
        ({"rules": np.array('{"ignored": [["a", "b"]]}')}, "the group 'a' is unknown"),
        ({"rules": np.array(3)}, "rules must be one string"),
        ({"provenance": np.array("{")}, "provenance is damaged"),
        ({"provenance": np.array("[1]")}, "provenance must be JSON values by name"),
        ({"provenance": np.array([1.0])}, "provenance must be one string"),
        ({"group_names": np.array(["a"])}, "group_runs must be a list of whole numbers"),
        ({"group_runs": np.array([0, 99])}, "are not runs that ascend"),
        ({"group_runs": np.array([2, 1])}, "are not runs that ascend"),
        ({"group_runs": np.array([[0, 1]])}, "group_runs must be a list"),
        ({"group_ends": np.array([3])}, "do not fit together"),
        ({"group_ends": np.array([2, 2])}, "do not fit together"),
        ({"group_names": np.array([1])}, "group_names must be at most"),
    ],
)
def test_damaged_rules_groups_and_provenance_are_refused(
    tmp_path: Path, changes: dict[str, Any], sentence: str
) -> None:
    sound = {"vertices": _poses(2), "faces": FACES}
    if "group_runs" in changes or "group_ends" in changes:
        sound |= {"group_names": np.array(["a"])}
        sound |= {"group_runs": np.array([0, 1]), "group_ends": np.array([2])}
    np.savez(tmp_path / "s.npz", **{**sound, **changes})
    with pytest.raises(LCollisionError, match=sentence):
        read_pose_set(tmp_path / "s.npz")


def test_plain_npz_gets_plain_names(tmp_path: Path) -> None:
    np.savez(tmp_path / "s.npz", V=np.asfortranarray(_poses(2).astype(">f4")), F=FACES)
    pose_set = read_pose_set(tmp_path / "s.npz")
    assert pose_set.names == ("pose 0", "pose 1")
    assert pose_set.vertices.dtype == np.dtype(np.float32)
    assert pose_set.vertices.flags.c_contiguous
    assert np.array_equal(pose_set.vertices, _poses(2))
    assert pose_set.near_exclusion == 0.0
    assert pose_set.up_axis is None


def _with_nan() -> np.ndarray:
    poses = _poses(3)
    poses[1, 2, 0] = np.nan
    return poses


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"vertices": _poses(2)}, "no array 'faces' or 'F', only vertices"),
        ({"faces": FACES}, "no array 'vertices' or 'V'"),
        ({"vertices": VERTICES, "faces": FACES}, r"must be \(N, V, 3\) .* got \(4, 3\)"),
        ({"vertices": _poses(2)[:0], "faces": FACES}, r"got \(0, 4, 3\)"),
        ({"vertices": _poses(2).astype(int), "faces": FACES}, "float32 or float64, got int"),
        ({"vertices": _poses(2).astype(np.float16), "faces": FACES}, "got float16"),
        ({"vertices": _poses(2), "faces": FACES.astype(float)}, r"integer array, got float64"),
        ({"vertices": _poses(2), "faces": FACES[:, :2]}, r"\(F, 3\) integer array"),
        ({"vertices": _poses(2), "faces": FACES[:0]}, "no faces"),
        ({"vertices": _poses(2), "faces": FACES + 1}, "face 1 names vertices"),
        ({"vertices": _poses(2), "faces": FACES - 1}, "face 0 names vertices"),
        ({"vertices": _with_nan(), "faces": FACES}, r"pose 1 of .* vertex 2 .* finite"),
        ({"vertices": _poses(2), "faces": FACES, "names": np.array(["a"])}, r"\(2,\) strings"),
        ({"vertices": _poses(2), "faces": FACES, "up_axis": np.array(3)}, "0, 1 or 2, got 3"),
        ({"vertices": _poses(2), "faces": FACES, "near_exclusion": np.array(-1.0)}, "got -1"),
        ({"vertices": _poses(2), "faces": FACES, "near_exclusion": np.ones(2)}, "one number"),
        ({"vertices": _poses(2), "faces": FACES, "format_version": np.array(3)}, "version 3"),
        (
            {"vertices": _poses(2), "faces": FACES, "vertex_labels": np.array(["a", "b", " ", ""])},
            r"printable and not blank, got ' ' for vertex 2 \(from 0\)",
        ),
        (
            {"vertices": _poses(2), "faces": FACES, "vertex_labels": np.array(["a\nb", *"bcd"])},
            r"got 'a\\nb' for vertex 0",
        ),
        ({"vertices": np.array([None, 1]), "faces": FACES}, "Python objects"),
    ],
)
def test_bad_npz_is_refused_in_one_sentence(
    tmp_path: Path, arrays: dict[str, Any], message: str
) -> None:
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays)
    with pytest.raises(LCollisionError, match=message) as caught:
        read_pose_set(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_npz_with_an_unusable_pose_keeps_the_others_for_inspection(tmp_path: Path) -> None:
    np.savez(tmp_path / "s.npz", vertices=_with_nan(), faces=FACES)
    found = inspect_pose_set(tmp_path / "s.npz")
    assert found.pose_set is not None
    assert found.pose_set.names == ("pose 0", "pose 2")
    assert np.array_equal(found.pose_set.vertices, _poses(3)[[0, 2]])
    assert found.n_found == 3
    assert len(found.problems) == 1


def test_loading_never_runs_code(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "sprung",))

    np.savez(tmp_path / "s.npz", vertices=np.array([Trap()], dtype=object), faces=FACES)
    with pytest.raises(MeshFileError, match="Python objects"):
        read_pose_set(tmp_path / "s.npz")
    assert not (tmp_path / "sprung").exists()


def test_npz_that_announces_terabytes_is_refused(tmp_path: Path) -> None:
    for shape, message in (((10**6, 10**6, 3), "holds 3000000000000"), ((9, 10**7, 3), "damaged")):
        entry = io.BytesIO()
        header = {"descr": "<f4", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(entry, header)
        with zipfile.ZipFile(tmp_path / "s.npz", "w") as archive:
            archive.writestr("vertices.npy", entry.getvalue() + b"\0" * 100)
        with pytest.raises(MeshFileError, match=message):
            read_pose_set(tmp_path / "s.npz")


def test_failed_write_leaves_the_old_set(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    write_pose_set(path, PoseSet(_poses(1), Topology(FACES, 4), ("a",)))
    before = path.read_bytes()
    with pytest.raises(MeshFileError, match=r"is an \.npz file"):
        write_pose_set(tmp_path / "s.npy", PoseSet(_poses(1), Topology(FACES, 4), ("a",)))
    with pytest.raises(MeshFileError, match="there is no folder"):
        write_pose_set(tmp_path / "no" / "s.npz", PoseSet(_poses(1), Topology(FACES, 4), ("a",)))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "changes",
    [
        {"vertices": np.zeros((2, 5, 3))},
        {"vertices": np.zeros((0, 4, 3)), "names": ()},
        {"vertices": np.zeros((2, 4, 3), dtype=int)},
        {"names": ("one",)},
        {"up_axis": 3},
        {"rules": ContactRules(1.0)},
        {"rules": ContactRules(ignored=(("hair", "hair"),))},
        {"groups": (FaceGroup("hair", np.array([0, 99])),)},
        {"groups": (FaceGroup("hair", np.array([1, 0])),)},
        {"groups": (FaceGroup("", np.array([0])),)},
        {"vertex_labels": np.array(["a"])},
        {"vertex_labels": np.array(["a", "b", "c", ""])},
    ],
)
def test_pose_set_that_does_not_fit_together(changes: dict[str, Any]) -> None:
    arguments = {"vertices": _poses(2), "topology": Topology(FACES, 4), "names": ("a", "b")}
    with pytest.raises(ShapeError):
        PoseSet(**{**arguments, **changes})


def test_audit_of_a_sound_mesh() -> None:
    audit = audit_mesh(Topology(FACES, 4), VERTICES)
    assert audit == ()


def test_audit_finds_every_defect_at_index_zero_too() -> None:
    # Face 0 is degenerate, vertex 1 a bow tie, 4 coincides with 0, 5 is unused, edges are open.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 0], [9, 9, 9.0]])
    audit = audit_mesh(Topology([[0, 1, 2], [4, 1, 3]], 6), vertices)
    assert audit == (
        "the mesh is open: 6 edges have one face",
        "the mesh is not manifold: 1 vertex joins parts of the surface that share no edge there, "
        "the first is vertex 1",
        "1 vertex is in no face, the first is vertex 5",
        "1 face has no area, the first is face 0",
        "1 vertex lies exactly on an earlier vertex, the first is vertex 4",
    )


@pytest.mark.parametrize("unit", [1e-200, 1.0, 1e200])
def test_area_is_judged_in_the_meshs_own_unit(unit: float) -> None:
    sliver = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]]) * unit
    assert len(degenerate_faces(Topology([[0, 1, 2]], 3), sliver)) == 0
    sliver[2, 1] = 0.0
    assert len(degenerate_faces(Topology([[0, 1, 2]], 3), sliver)) == 1


def test_audit_names_what_is_wrong_with_the_surface() -> None:
    fin = Topology(np.vstack([FACES, [[0, 1, 4]]]), 5)
    problems = audit_mesh(fin, np.vstack([VERTICES, [[3, 3, 3]]]))
    assert problems[1] == (
        "the mesh is not manifold: 1 edge has more than two faces, "
        "the first between vertices 0 and 1"
    )
    assert any("the mesh is open" in problem for problem in problems)
    flipped = Topology(np.vstack([FACES[:3], [FACES[3, ::-1]]]), 4)
    assert "opposite senses" in audit_mesh(flipped, VERTICES)[0]
    bow_tie = Topology([[0, 1, 2], [0, 3, 4]], 5)
    problems = audit_mesh(bow_tie, np.vstack([VERTICES, [[3, 3, 3]]]))
    assert "not manifold: 1 vertex joins" in problems[1]
    assert "vertex 0" in problems[1]
    with pytest.raises(ShapeError, match=r"\(4, 3\)"):
        audit_mesh(flipped, VERTICES[:3])


def test_a_pose_set_is_read_only_but_its_makers_array_is_not() -> None:
    poses = _poses(2)
    pose_set = PoseSet(poses, Topology(FACES, 4), ("a", "b"))
    assert not pose_set.vertices.flags.writeable
    poses[0, 0] = 1.0


def test_published_sets_are_sound(scape: PoseSet, jumping: PoseSet) -> None:
    assert (len(scape), scape.topology.n_vertices) == (71, 2161)
    assert (len(jumping), jumping.topology.n_vertices) == (150, 10002)
    for pose_set in (scape, jumping):
        assert audit_mesh(pose_set.topology, pose_set.vertices[0]) == ()
