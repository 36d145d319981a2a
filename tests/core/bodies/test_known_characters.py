"""Remembered characters: rules, body parts and place, and unreadable records."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import (
    NamedPose,
    OtherModelError,
    RigBody,
    character_of_mesh,
    open_body,
    read_poses,
    remember_choices,
    remember_file,
    remember_roles,
    remember_up,
    write_poses,
)
from lcollision_core.bodies.remembered import find_character, user_characters_folder
from lcollision_core.errors import LCollisionError, ModelFileError
from lcollision_core.files import Mesh
from lcollision_core.files.scene_files import open_rigged
from lcollision_core.meshes import ContactRules
from lcollision_core.meshes.joint_kinds import Role
from tests.core.gltf_builder import arm
from tests.rigged_shapes import rigged_body

RULES = ContactRules(0.05, None, (("Body", "component 1"),), 0.01)


@pytest.fixture(autouse=True)
def _own_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return arm().write(tmp_path / "arm.glb")


def opened(path: Path) -> RigBody:
    body = open_body(path)
    assert isinstance(body, RigBody)
    return body


def chosen(path: Path) -> RigBody:
    """Choose and remember other rules and body parts for a character."""
    body = opened(path)
    mesh = body.groups[0].name
    other = body.with_rules(ContactRules(0.05, None, ((mesh, "component 1"),), 0.01))
    other = other.edit_domains({0: "tip"}, {1: "#102030"}, tuple(reversed(body.domain_order)))
    remember_choices(other)
    return other


def test_what_is_chosen_comes_back_with_the_character_and_defaults_too(path: Path) -> None:
    content = path.read_bytes()
    other, again = chosen(path), opened(path)
    assert again.rules == other.rules != again.own_rules
    assert again.rules_are_chosen
    assert again.card.domain_names == other.card.domain_names
    assert again.card.domain_colours == other.card.domain_colours
    assert again.domain_order == other.domain_order
    assert {group.name for group in again.groups} == {group.name for group in other.groups}
    assert again.notes[-1] == "its contact rules are those that you chose for it"
    assert again.fingerprint == other.fingerprint
    remember_choices(again.with_rules(again.own_rules))
    plain = opened(path)
    assert not plain.rules_are_chosen
    assert plain.card.domain_names[0] == "tip"
    assert plain.notes == plain.character.notes
    assert path.read_bytes() == content
    (kept,) = user_characters_folder().iterdir()
    assert kept.name == f"{plain.fingerprint}.json"


def test_what_the_user_says_of_a_joint_comes_back_and_keeps_the_rules(path: Path) -> None:
    before = chosen(path)
    joint = before.space.rig.joint_names[-1]
    remember_roles(before, {joint: "knee-left"})
    again = opened(path)
    assert again.space.roles[-1] is Role.SHIN
    assert again.fingerprint != before.fingerprint
    assert again.rules == before.rules
    with pytest.raises(LCollisionError, match="no joint 'nose'"):
        remember_roles(again, {"nose": "head"})
    with pytest.raises(LCollisionError, match="role 'fin' is not known"):
        remember_roles(again, {joint: "fin"})
    remember_roles(again, {joint: None})
    assert opened(path).fingerprint == before.fingerprint


def test_a_file_is_read_once_whatever_is_chosen_for_it(path: Path) -> None:
    document = open_rigged(path)
    assert document is not None
    path.unlink()
    body = open_body(document)
    assert isinstance(body, RigBody)
    assert body.up_axis == 1
    remember_up(body, 2)
    turned = open_body(body.character)
    assert isinstance(turned, RigBody)
    assert turned.up_axis == 2
    remember_roles(turned, {turned.space.rig.joint_names[-1]: "knee-left"})
    again = open_body(turned.character)
    assert isinstance(again, RigBody)
    assert again.up_axis == 2
    assert again.space.roles[-1] is Role.SHIN
    assert open_body(again.character, 0).up_axis == 0
    assert again.character.file is body.character.file
    # A choice equal to the file's is not remembered.
    remember_up(again, 1)
    assert open_body(again.character).up_axis == 1


def test_another_rig_gets_nothing_of_it(path: Path) -> None:
    chosen(path)
    other = RigBody.of(rigged_body())
    assert find_character(other.fingerprint) is None


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"format_version": 2}, "2"),
        ({"format": "poses"}, "it contains something else"),
        ({"rules": {"near_exclusion": -1.0}}, "near exclusion"),
        ({"rules": {"ignored": [["hair", "hat"]]}}, "the group 'hair' is unknown"),
        ({"domain_names": ["one"]}, "colour for each domain"),
        ({"domain_order": [0.5]}, "whole number"),
        ({"up_axis": 7}, "up_axis"),
    ],
)
def test_what_does_not_apply_is_left_out_and_said(path: Path, change: dict, why: str) -> None:
    chosen(path)
    (kept,) = user_characters_folder().iterdir()
    kept.write_text(json.dumps(json.loads(kept.read_text()) | change))
    before = kept.read_bytes()
    body = opened(path)
    assert not body.rules_are_chosen
    assert body.card.domain_names == body.own_card.domain_names
    assert body.notes[-1].startswith("your settings for it were ignored: ")
    assert why in body.notes[-1]
    if "format_version" in change or "format" in change:
        for keep in (remember_choices, lambda held: remember_file(held, path)):
            with pytest.raises(ModelFileError):
                keep(body)
    assert kept.read_bytes() == before


def test_a_damaged_record_does_not_hide_the_others(path: Path) -> None:
    body = chosen(path)
    mesh = Mesh(body.reference, body.topology, path.with_name("pose.obj"))
    for name, content in (("0" * 16, "{"), ("1" * 16, '{"format": "other"}')):
        (user_characters_folder() / f"{name}.json").write_text(content)
    found = character_of_mesh(mesh.source, mesh)
    assert found is not None
    assert found[0].rules == body.rules


def test_poses_name_the_character_that_they_belong_to(path: Path, tmp_path: Path) -> None:
    body, other = opened(path), RigBody.of(rigged_body())
    poses = tmp_path / "poses.json"
    write_poses(poses, body, [NamedPose("rest", np.zeros(body.latent_size))])
    with pytest.raises(OtherModelError, match="poses of the character 'arm'") as caught:
        read_poses(poses, other)
    assert caught.value.model is None
    assert caught.value.next_step == "use them with that character's file"
    remember_file(body, path)
    with pytest.raises(OtherModelError, match="poses of the character 'arm'") as caught:
        read_poses(poses, other)
    assert caught.value.model is not None
    assert caught.value.model.path == path
    assert caught.value.next_step == f"use them with {path}"
    path.rename(tmp_path / "moved.glb")
    assert find_character(body.fingerprint) is None


def test_a_file_of_poses_leads_to_no_other_file() -> None:
    folder = user_characters_folder()
    folder.mkdir(parents=True)
    (folder.parent / "secret.json").write_text("{}")
    assert find_character("../secret") is None
