"""Files of latent poses: round trips and refusals."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lcollision_core.bodies import (
    LearnedBody,
    ListedModel,
    NamedPose,
    OtherModelError,
    RigBody,
    name_of_file,
    open_body,
    read_pose_file,
    read_poses,
    remember_file,
    unique_names,
    user_models_folder,
    write_poses,
)
from lcollision_core.bodies.learned_body import find_latent_space
from lcollision_core.bodies.poses import MAX_PINS, POSES_VERSION
from lcollision_core.errors import ModelFileError
from lcollision_core.meshes import RigidTransform
from lcollision_core.posing import Pin
from tests.core.shapes import random_rotation
from tests.rigged_shapes import rigged_body, rigged_tube, write_gltf


@pytest.fixture
def model(tube_model: LearnedBody) -> LearnedBody:
    return tube_model


PINS = (
    Pin(3, 0.03, (0.1, 1.0 / 3.0, -2e5)),
    Pin(0, 0.25, (0.0, -1e-9, 7.0), ((4, (1.0, 0.1, 0.0)), (5, (0.0, 1.0, 1.0 / 7.0)))),
)


def _poses(model: LearnedBody) -> list[NamedPose]:
    rng = np.random.default_rng(6)
    placement = RigidTransform(random_rotation(rng), rng.normal(0, 100, 3))
    return [
        NamedPose("à la „plage“", rng.normal(size=model.latent_size)),
        NamedPose("mesh 2", rng.normal(size=model.latent_size), placement, 0.001, 0.02),
        NamedPose("1/3", np.full(model.latent_size, 1.0 / 3.0), placement, pins=PINS),
    ]


@pytest.fixture
def path(model: LearnedBody, tmp_path: Path) -> Path:
    path = tmp_path / "poses.json"
    write_poses(path, model, _poses(model))
    return path


def _same(a: NamedPose, b: NamedPose) -> bool:
    if (a.placement is None) != (b.placement is None):
        return False
    placed = a.placement is None or (
        b.placement is not None
        and np.array_equal(a.placement.rotation, b.placement.rotation)
        and np.array_equal(a.placement.translation, b.placement.translation)
    )
    errors = (a.fit_error_mean, a.fit_error_max) == (b.fit_error_mean, b.fit_error_max)
    same = errors and a.pins == b.pins
    return placed and same and a.name == b.name and np.array_equal(a.latent, b.latent)


def test_poses_come_back_to_the_last_bit(model: LearnedBody, path: Path) -> None:
    poses = read_poses(path, model)
    assert len(poses) == 3
    assert all(map(_same, poses, _poses(model)))


def test_no_poses_are_a_file_too(model: LearnedBody, tmp_path: Path) -> None:
    path = tmp_path / "none.JSON"
    write_poses(path, model, [])
    assert read_poses(path, model) == ()


def test_poses_of_a_renamed_model_are_still_its_own(model: LearnedBody, path: Path) -> None:
    assert len(read_poses(path, model.edit_domains({0: "tail"}))) == 3


def test_poses_of_another_model_are_refused(model: LearnedBody, path: Path) -> None:
    document = json.loads(path.read_text())
    owner = {"name": "tube", "fingerprint": model.fingerprint, "vertices": model.n_vertices}
    assert document["model"] == owner | {"codes": model.latent_size}
    document["model"] = {"name": "dancer", "fingerprint": "0123456789abcdef"}
    path.write_text(json.dumps(document))
    with pytest.raises(
        OtherModelError, match=rf"{path} contains poses of the model 'dancer'.*'tube'"
    ):
        read_poses(path, model)


def test_poses_of_another_model_name_it_and_never_its_fingerprint(
    model: LearnedBody, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Recognised by the latent space, under any name; damaged models nearby do not matter."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    folder = user_models_folder()
    folder.mkdir(parents=True)
    (folder / "aaa.safetensors").write_bytes(b"garbage")
    model.save(folder / "snake.safetensors")
    assert find_latent_space(model.fingerprint) == ListedModel(
        "snake", folder / "snake.safetensors", False
    )
    body = LearnedBody.load("body")
    assert find_latent_space(body.fingerprint, "body").bundled
    assert find_latent_space("0123456789abcdef") is None
    with pytest.raises(OtherModelError) as caught:
        read_poses(path, body)
    assert str(caught.value) == (
        f"{path} contains poses of the model 'snake', not of 'body'; use them with 'snake'"
    )
    assert caught.value.model == ListedModel("snake", folder / "snake.safetensors", False)
    (folder / "snake.safetensors").unlink()
    scene = "of the scene 'hero [+] villain', not of 'body'; name the scene's file, or its other"
    missing = "not among your models"
    for name, why in (("tube", missing), ("body", missing), ("hero + villain", scene)):
        document = json.loads(path.read_text())
        document["model"]["name"] = name
        path.write_text(json.dumps(document))
        with pytest.raises(OtherModelError, match=why) as caught:
            read_poses(path, body)
        assert caught.value.model is None
        assert f"{name!r}" in str(caught.value)
        assert model.fingerprint not in str(caught.value)


def test_the_working_pose_is_apart_from_the_poses_and_lost_to_no_command(
    model: LearnedBody, tmp_path: Path
) -> None:
    path, (first, *others) = tmp_path / "poses.json", _poses(model)
    tagged = replace(others[0], tags=("kick", "left leg"))
    changed = replace(first, latent=2.0 * first.latent)
    write_poses(path, model, [first, tagged], changed)
    assert json.loads(path.read_text())["format_version"] == POSES_VERSION
    held = read_pose_file(path, model)
    assert held.working is not None
    assert _same(held.working, changed)
    assert all(map(_same, held.poses, [first, tagged]))
    assert held.poses[1].tags == ("kick", "left leg")
    names = [first.name, tagged.name, f"{first.name} 2"]
    assert [pose.name for pose in read_poses(path, model)] == names
    assert _same(replace(read_poses(path, model)[2], name=first.name), changed)
    # A working pose identical to one of the poses is not a further pose.
    write_poses(path, model, [first], replace(first, name="other"))
    assert [pose.name for pose in read_poses(path, model)] == [first.name]


def test_what_commands_write_stays_of_the_first_version(path: Path) -> None:
    document = json.loads(path.read_text())
    assert document["format_version"] == 1
    assert document.keys() == {"format", "format_version", "model", "poses"}
    assert document["poses"][0].keys() == {"name", "latent"}


def test_pins_are_of_a_pose_whatever_its_latent(model: LearnedBody, path: Path) -> None:
    *_, pinned = read_poses(path, model)
    assert pinned.pins == PINS
    assert not pinned.same_as(replace(pinned, pins=PINS[:1]))
    record = json.loads(path.read_text())["poses"][2]["pins"][0]
    assert record == {"vertex": 3, "radius": 0.03, "position": [0.1, 1.0 / 3.0, -2e5]}


def test_pins_that_no_file_holds_are_not_written(model: LearnedBody, path: Path) -> None:
    for pins in (PINS[:1] * (MAX_PINS + 1), (replace(PINS[0], vertex=model.n_vertices),)):
        pose = NamedPose("pinned", _poses(model)[0].latent, pins=pins)
        with pytest.raises(ModelFileError, match=r"'pinned'.*pin"):
            write_poses(path, model, [pose])


def _broken(document: Any, n_vertices: int) -> list[tuple[str, Any]]:
    """Return documents that must be refused, each with text from the sentence."""
    first, second = document["poses"][:2]
    turned = second["placement"]["rotation"]

    def with_first(**change: Any) -> dict[str, Any]:
        return {**document, "poses": [{**first, **change}, second]}

    def with_rotation(rotation: Any) -> dict[str, Any]:
        return with_first(placement={"rotation": rotation, "translation": [0, 0, 0]})

    def with_pin(**change: Any) -> dict[str, Any]:
        return with_first(pins=[{**document["poses"][2]["pins"][0], **change}])

    return [
        ("pose 0.*pins", with_first(pins={})),
        ("pose 0.*pins", with_first(pins=[3] * (MAX_PINS + 1))),
        ("pose 0.*pin", with_first(pins=[3])),
        ("pose 0.*vertex", with_first(pins=[{}])),
        ("pose 0.*vertex", with_pin(vertex=n_vertices)),
        ("pose 0.*vertex", with_pin(vertex=-1)),
        ("pose 0.*vertex", with_pin(vertex=True)),
        ("pose 0.*vertex", with_pin(vertex=1.0)),
        ("pose 0.*radius", with_pin(radius=0.0)),
        ("pose 0.*radius", with_pin(radius=0.3)),
        ("pose 0.*radius", with_pin(radius=-0.03)),
        ("pose 0.*radius", with_pin(radius="0.03")),
        ("pose 0.*position", with_pin(position=[0.0, 0.0])),
        ("pose 0.*position", with_pin(position=[0.0, 0.0, 1e31])),
        ("pose 0.*position", with_pin(position=None)),
        ("pose 0.*frame", with_pin(frame={})),
        ("pose 0.*frame", with_pin(frame=[[1, [0.0, 0.0, 0.0]]] * 3)),
        ("pose 0.*frame", with_pin(frame=[[1]])),
        ("pose 0.*vertex", with_pin(frame=[[n_vertices, [0.0, 0.0, 0.0]]])),
        ("pose 0.*frame.*of length 3", with_pin(frame=[[1, [0.0, 0.0]]])),
        ("not an LCollision pose file", []),
        ("not an LCollision pose file", {"poses": []}),
        ("not an LCollision pose file", {**document, "format": "other"}),
        ("update the program", {**document, "format_version": POSES_VERSION + 1}),
        ("damaged", {**document, "format_version": 0}),
        ("damaged", {**document, "format_version": "1"}),
        ("damaged", {**document, "model": None}),
        ("damaged", {**document, "poses": {}}),
        ("pose 0", {**document, "poses": [3]}),
        ("pose 0.*name", with_first(name="")),
        ("pose 0.*name", with_first(name=5)),
        ("pose 0.*name", with_first(name="x" * 201)),
        ("pose 0.*invalid Unicode", with_first(name="\ud800")),
        ("pose 0.*latent", with_first(latent=first["latent"][:-1])),
        ("pose 0.*latent", with_first(latent=["1"] * len(first["latent"]))),
        ("pose 0.*latent", with_first(latent=[True] * len(first["latent"]))),
        ("pose 0.*latent", with_first(latent=[[0]] * len(first["latent"]))),
        ("pose 0.*latent", with_first(latent=[[0], *first["latent"][1:]])),
        ("pose 0.*latent", with_first(latent=None)),
        ("pose 0", with_first(placement=None)),
        ("pose 0", with_first(placement={"rotation": turned})),
        ("pose 0.*rotation", with_rotation([[2, 0, 0], [0, 1, 0], [0, 0, 1]])),
        ("pose 0.*rotation", with_rotation([[-1, 0, 0], [0, 1, 0], [0, 0, 1]])),
        ("pose 0.*rotation", with_rotation([[1, 0], [0, 1]])),
        ("pose 0", with_first(fit_error={"mean": 0.1})),
        ("pose 0", with_first(fit_error={"mean": "small", "max": 0.1})),
        ("share a name", with_first(name=second["name"])),
        ("pose 0.*tags", with_first(tags="kick")),
        ("pose 0.*tag", with_first(tags=["kick", ""])),
        ("pose 0.*tag", with_first(tags=[1])),
        ("pose 0.*tags", with_first(tags=["x"] * 51)),
        ("working pose.*name", {**document, "format_version": 2, "working": {**first, "name": ""}}),
        (r"latent\[0\] must be a number nearer to 0", with_first(latent=[10**400])),
        ("working pose", {**document, "format_version": 2, "working": 3}),
        ("damaged: it lacks .*; save the poses again", {**document, "format_version": True}),
        ("damaged", {**document, "format_version": 1.0}),
    ]


def test_documents_that_do_not_fit_are_refused(model: LearnedBody, path: Path) -> None:
    for sentence, document in _broken(json.loads(path.read_text()), model.n_vertices):
        path.write_text(json.dumps(document))
        with pytest.raises(ModelFileError, match=rf"{path}.*{sentence}"):
            read_poses(path, model)


@pytest.mark.parametrize("word", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_numbers_that_are_not_finite_are_refused(model: LearnedBody, path: Path, word: str) -> None:
    first = repr(float(_poses(model)[0].latent[0]))
    text = path.read_text()
    assert first in text
    path.write_text(text.replace(first, word))
    with pytest.raises(ModelFileError, match=r"JSON number|not finite"):
        read_poses(path, model)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damage_is_refused_or_leaves_usable_poses(
    model: LearnedBody, path: Path, data: st.DataObject
) -> None:
    write_poses(path, model, _poses(model))
    content = bytearray(path.read_bytes())
    start = data.draw(st.integers(0, len(content) - 1))
    replacement = data.draw(st.binary(max_size=4))
    content[start : start + data.draw(st.integers(0, 40))] = replacement
    path.write_bytes(content)
    try:
        poses = read_poses(path, model)
    except ModelFileError:
        return
    assert all(np.isfinite(model.decode(pose.latent)).all() for pose in poses)
    assert len({pose.name for pose in poses}) == len(poses)


def test_other_files_are_refused(model: LearnedBody, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "empty.json").write_bytes(b"")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    for name, sentence in (
        ("none.json", "no such file"),
        (".", "not a plain file"),
        ("pipe.json", "not a plain file"),
        ("empty.json", "not JSON"),
        ("binary.json", "not JSON"),
        ("deep.json", "not JSON"),
    ):
        with pytest.raises(ModelFileError, match=sentence):
            read_poses(tmp_path / name, model)


def test_refused_poses_leave_the_old_file(model: LearnedBody, path: Path) -> None:
    before = path.read_bytes()
    pose = _poses(model)[0]
    with pytest.raises(ModelFileError, match="2 poses are called"):
        write_poses(path, model, [pose, pose])
    with pytest.raises(ModelFileError, match=r"\.json"):
        write_poses(path.with_suffix(".obj"), model, [pose])
    with pytest.raises(ModelFileError, match="no folder"):
        write_poses(path.parent / "none" / "poses.json", model, [pose])
    for change, sentence in (
        ({"name": ""}, "1 to 200 characters"),
        ({"name": "x" * 201}, "1 to 200 characters"),
        ({"name": "\udcff"}, "invalid Unicode"),
        ({"latent": np.full(model.latent_size, np.nan)}, "not finite"),
        ({"latent": pose.latent[1:]}, "latent must be"),
    ):
        with pytest.raises(ModelFileError, match=rf"cannot be written: .*{sentence}"):
            write_poses(path, model, [replace(pose, **change)])
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_names_are_numbered_until_they_differ_by_more_than_case() -> None:
    assert unique_names(["a", "b", "A", "a", "a 2"]) == ["a", "b", "A 2", "a 3", "a 2 2"]
    long = "x" * 200
    assert unique_names([long, f"{long} 1"]) == [long, "x" * 198 + " 2"]


def test_any_files_name_makes_a_poses_name(model: LearnedBody, tmp_path: Path) -> None:
    files = [Path("\udcff bend.obj"), Path("y" * 250 + ".obj")]
    poses = [NamedPose(name_of_file(file), np.zeros(model.latent_size)) for file in files]
    write_poses(tmp_path / "poses.json", model, poses)
    names = [pose.name for pose in read_poses(tmp_path / "poses.json", model)]
    assert names == ["? bend", "y" * 200]


def test_of_two_characters_of_one_name_it_is_said_what_differs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For example two exports of one character, whose poses do not fit each other."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    body, poses = rigged_body(), tmp_path / "poses.json"
    model = RigBody.of(replace(body, name="ely"))
    write_poses(poses, model, [NamedPose("rest", np.zeros(model.latent_size))])
    shorter = RigBody.of(replace(rigged_tube(), name="ely"))
    with pytest.raises(OtherModelError, match="another model 'ely'") as caught:
        read_poses(poses, shorter)
    n_joints, n_vertices = model.space.n_joints, model.n_vertices
    assert f"it has {n_joints} joints instead of 3, {n_vertices} vertices" in str(caught.value)
    assert body.rig is not None
    rest = body.rig.rest.copy()
    rest[5, 0, 3] += 0.01
    moved = RigBody.of(replace(body, name="ely", rig=replace(body.rig, rest=rest)))
    with pytest.raises(
        OtherModelError, match="has as many vertices, but its joints differ in rest"
    ):
        read_poses(poses, moved)
    # If the other's file is known, it is named.
    file = write_gltf(body, tmp_path / "ely.glb")
    known = open_body(file)
    assert isinstance(known, RigBody)
    remember_file(known, file)
    write_poses(poses, known, [NamedPose("rest", known.known_poses[0])])
    with pytest.raises(
        OtherModelError, match=r"contains poses of another 'ely', .*ely\.glb: it has"
    ):
        read_poses(poses, shorter)
