"""Contact rule options, and how commands report them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import LearnedBody, open_body, remember_choices
from lcollision_core.files import PoseSet, read_mesh, write_pose_set
from lcollision_core.meshes import ContactRules, FaceGroup, Topology
from tests.app.support import Lcollision
from tests.core.gltf_builder import arm, rotation, tube
from tests.rigged_shapes import head_in_torso, rigged_body, write_gltf

NONE = {"near": 0, "rest": 0, "ignored": 0, "tolerated": 0, "joint": 0, "touching": 0, "shape": 0}


@pytest.fixture
def touching_set(stabbed: Path, tmp_path: Path) -> Path:
    """Return a set whose faces 0 and 1 pierce each other at rest, and deeper in pose 1."""
    mesh = read_mesh(stabbed)
    deeper = mesh.vertices - np.repeat([[0.0, 0, 0], [0, 0, 0.2]], 3, axis=0)
    poses = PoseSet(
        np.stack([mesh.vertices, deeper]),
        Topology(mesh.faces, 6),
        ("rest", "deeper"),
        groups=(FaceGroup("skin", np.array([0])), FaceGroup("belt: front", np.array([1]))),
        vertex_labels=np.array(["trunk"] * 3 + ["hand"] * 3),
    )
    write_pose_set(tmp_path / "touching.npz", poses)
    return tmp_path / "touching.npz"


def test_pairs_that_touch_in_the_rest_pose_are_not_counted(
    lcollision: Lcollision, stabbed: Path, apart: Path
) -> None:
    result = lcollision("check", stabbed, "--rest", stabbed)
    assert result.exit_code == 0, result.stderr
    assert "no collisions; 1 pair that touches at rest is not counted (6 vert" in result.stdout
    exact = json.loads(lcollision("check", "--json", stabbed, "--rest", stabbed).stdout)[0]
    assert exact["excluded_pairs"] == {**NONE, "rest": 1}
    assert exact["rules"]["rest_exclusion"] == 0.02
    counted = lcollision("check", "--json", stabbed, "--rest", apart, "--rest-exclusion", 0)
    assert counted.exit_code == 1
    assert json.loads(counted.stdout)[0]["excluded_pairs"] == NONE


def test_components_and_depths_are_left_out_by_check(lcollision: Lcollision, stabbed: Path) -> None:
    ignored = lcollision("check", stabbed, "--ignore", "component 2:component 1")
    assert ignored.exit_code == 0
    assert "no collisions; 1 pair of component 2 and component 1 is not" in ignored.stdout
    tolerated = lcollision("check", stabbed, "--tolerated-depth", 0.11)
    assert tolerated.exit_code == 0
    assert "; 1 pair not deeper than 0.11 is not counted" in tolerated.stdout
    assert lcollision("check", stabbed, "--tolerated-depth", 0.09).exit_code == 1


def test_a_pair_of_groups_is_tolerated_up_to_its_own_depth(
    lcollision: Lcollision, stabbed: Path
) -> None:
    pair = "component 2:component 1"
    free = lcollision("check", stabbed, "--tolerate", f"{pair}=0.11")
    assert free.exit_code == 0, free.stderr
    said = "; 1 pair not deeper than 0.11 between component 2 and component 1 is not counted"
    assert said in free.stdout
    assert lcollision("check", stabbed, "--tolerate", f"{pair}=0.09").exit_code == 1
    # A pair's own tolerated depth overrides the general one.
    strict = ("--tolerated-depth", 0.11, "--tolerate", f"{pair}=0", "--json")
    refused = lcollision("check", stabbed, *strict)
    assert refused.exit_code == 1
    (report,) = json.loads(refused.stdout)
    assert report["rules"]["tolerated_pairs"] == [["component 2", "component 1", 0.0]]
    again = ("--tolerate", f"{pair}=0", "--tolerate", "component 1:component 2=0.2")
    assert lcollision("check", stabbed, *again).exit_code == 0


def test_what_a_character_tolerates_is_kept(lcollision: Lcollision, tmp_path: Path) -> None:
    path = write_gltf(rigged_body(), tmp_path / "hero.glb")
    kept = lcollision("contacts", path, "--tolerate", "Left forearm:Hips=0.02")
    assert kept.exit_code == 0, kept.stderr
    assert "pairs not deeper than 0.02 between Left forearm and Hips" in kept.stdout
    body = open_body(path)
    assert body.rules.tolerated_pairs == (("Left forearm", "Hips", 0.02),)
    faces = [next(g.faces[0] for g in body.groups if g.name == n) for n in ("Hips", "Left forearm")]
    assert body.detector.tolerated_depths(np.array([faces])).tolist() == [0.02]
    assert lcollision("contacts", path, "--tolerate", "Hips:Left forearm=0").exit_code == 0
    assert open_body(path).rules.tolerated_pairs == (("Hips", "Left forearm", 0.0),)


def test_a_part_is_left_out_whole_and_stays_so(lcollision: Lcollision, tmp_path: Path) -> None:
    builder = arm(split=False)
    vertices, faces = tube()
    primitive = {
        "attributes": {"POSITION": builder.array(vertices)},
        "indices": builder.array(faces.reshape(-1), "u2"),
    }
    axe = builder.add("meshes", name="Cube.160", primitives=[primitive])
    turn, place = rotation(2, 1.5), [1.0, -1.5, 0.0]
    builder.add("nodes", name="2H_Axe", mesh=axe, rotation=turn, translation=place)
    builder.description["nodes"][3]["children"] = [5]
    path = builder.write(tmp_path / "hero.glb")
    strict = lcollision("check", path)
    assert strict.exit_code == 1, strict.stderr
    without = lcollision("check", path, "--leave-out", "2H_Axe")
    assert without.exit_code == 0, without.stderr
    assert "no collisions; without 2H_Axe, " in without.stdout
    assert "pairs of parts left out are not counted" in without.stdout
    unknown = lcollision("check", path, "--leave-out", "2h axe")
    assert unknown.exit_code == 2
    assert "'2h axe' is not a group of faces of this mesh; name one of 2H_Axe" in unknown.stderr
    kept = lcollision("contacts", path, "--leave-out", "2H_Axe")
    assert kept.exit_code == 0, kept.stderr
    assert "pairs of parts left out (2H_Axe)" in kept.stdout
    body = open_body(path)
    assert body.rules.left_out == ("2H_Axe",)
    # It is still there, and later commands know the rule.
    assert body.n_vertices == 2 * len(vertices)
    assert "without 2H_Axe" in lcollision("check", path).stdout


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            ("--rest-exclusion", 0.1),
            "--rest-exclusion needs a rest pose; give one with --rest MESH",
        ),
        (("--ignore", "hair"), "the ignored pair 'hair' is not A:B with the names of two groups"),
        (
            ("--ignore", "component 1:hair"),
            "names 'hair', which is not a group of faces of this mesh",
        ),
        (("--tolerated-depth", -1), "--tolerated-depth"),
        (
            ("--tolerate", "component 1:component 2"),
            "the tolerated pair 'component 1:component 2' is not A:B=DEPTH with a depth of 0",
        ),
        (("--tolerate", "component 1:component 2=1"), "and below 1 body size; name two groups"),
        (("--tolerate", "component 1:hair=0.1"), "the tolerated pair 'component 1:hair' names"),
    ],
)
def test_options_that_mean_nothing_are_refused(
    lcollision: Lcollision, stabbed: Path, options: tuple[object, ...], sentence: str
) -> None:
    result = lcollision("check", stabbed, *options)
    assert result.exit_code == 2
    assert sentence in result.stderr


def test_a_rest_pose_of_another_mesh_is_refused(
    lcollision: Lcollision, stabbed: Path, tmp_path: Path
) -> None:
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    result = lcollision("check", stabbed, "--rest", tmp_path / "one.obj")
    assert result.exit_code == 2
    assert (
        "does not have the faces of the rest pose; name a rest pose of this mesh" in result.stderr
    )


@pytest.mark.parametrize(
    ("options", "excluded"),
    [
        ((), None),
        (("--rest-exclusion", 0), "rest"),
        (("--ignore", "skin:belt: front"), "ignored"),
        (("--ignore", "hand:trunk"), "ignored"),
        (("--ignore", "component 1:skin"), None),
        (("--tolerated-depth", 0.5), "tolerated"),
    ],
)
def test_dataset_check_names_the_rules(
    lcollision: Lcollision, touching_set: Path, options: tuple[object, ...], excluded: str | None
) -> None:
    report = json.loads(lcollision("dataset", "check", touching_set, "--json", *options).stdout)
    assert report["colliding_poses"] == (2 if excluded is None else 0)
    assert report["excluded_at_rest"] == (NONE if excluded is None else {**NONE, excluded: 1})
    always = [["skin", "belt: front"], ["hand", "trunk"], ["component 1", "component 2"]]
    assert report["proposed_ignored"] == [{"groups": pair, "share": 1.0} for pair in always]
    said = lcollision("dataset", "check", touching_set, *options).stdout
    offer = '--ignore "skin:belt: front" leaves them out'
    assert (offer in said) == ("skin:belt: front" not in options)
    assert ("not counted:" in said) == bool(options)
    if excluded == "rest":
        assert "not counted: pairs that touch at rest; at rest: 1 touching" in said


def test_joints_of_a_character_count_or_not_and_what_has_none_is_refused(
    lcollision: Lcollision, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    path = write_gltf(rigged_body(), tmp_path / "body.glb")
    said = lcollision("contacts", path).stdout
    assert "pairs at a joint that links their parts" in said
    off = json.loads(lcollision("contacts", path, "--json", "--no-joint-exclusion").stdout)
    assert off["rules"]["joint_exclusion"] is False
    # The rule is remembered; so are rules stored by an older program that lacks it.
    assert "at a joint" not in lcollision("contacts", path).stdout
    (known,) = (tmp_path / "data" / "lcollision" / "characters").iterdir()
    document = json.loads(known.read_text())
    del document["rules"]["joint_exclusion"]
    known.write_text(json.dumps(document))
    assert "at a joint" not in lcollision("contacts", path).stdout
    on = json.loads(lcollision("contacts", path, "--json", "--joint-exclusion").stdout)
    assert on["rules"]["joint_exclusion"] is True
    bundled = lcollision("contacts", "body", "--joint-exclusion")
    assert bundled.exit_code == 2
    assert "body has no joints, which --joint-exclusion needs" in bundled.stderr


def test_places_that_always_touch_are_listed_and_ignored_on_request(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    path = write_gltf(head_in_torso(12), tmp_path / "body.glb")
    # By default, pairs that touch at rest do not count.
    assert json.loads(lcollision("contacts", path, "--json").stdout)["proposed"] is None
    body = open_body(path)
    remember_choices(body.with_rules(ContactRules()))
    proposed = json.loads(lcollision("contacts", path, "--json").stdout)["proposed"]
    assert proposed["rules"]["ignored"] == []
    n_places = len(proposed["rules"]["touching"])
    assert sum(place["n"] for place in proposed["places"]) == n_places > 0
    said = lcollision("contacts", path).stdout
    assert f"without {n_places} places where parts touch in nearly all of them" in said
    assert f"Head and Torso: {n_places} places" in said
    done = json.loads(lcollision("contacts", path, "--json", "--ignore-proposed").stdout)
    assert done["rules"] == proposed["rules"]
    assert done["excluded_at_rest"]["touching"] > 0
    assert open_body(path).rules.touching == tuple(map(tuple, proposed["rules"]["touching"]))


def test_a_trained_model_keeps_the_rules_and_says_them(
    lcollision: Lcollision, editor_model: LearnedBody, tmp_path: Path
) -> None:
    path = tmp_path / "m.safetensors"
    rules = ContactRules(0.02, 0.0, (("a", "a"),), 0.001)
    card = replace(editor_model.card, rules=rules, groups=(FaceGroup("a", np.array([0, 1])),))
    editor_model.with_card(card).save(path)
    report = json.loads(lcollision("info", path, "--json").stdout)
    assert report["rules"] == rules.to_json()
    assert report["excluded_at_rest"] == NONE
    said = lcollision("info", path).stdout
    assert (
        "not counted: pairs within 0.02 along the surface, pairs that touch at rest, pairs of "
        "a with itself, pairs not deeper than 0.001; at rest: no pair"
    ) in said
