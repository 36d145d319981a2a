"""Names of codes from their effects, and body parts edited by the user."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from lcollision_core.bodies import LearnedBody, change_model
from lcollision_core.bodies.names import CodeEffect, code_effects, code_names
from lcollision_core.errors import ModelFileError
from lcollision_core.model_file import read_model_file, write_model_file

FloatArray = npt.NDArray[np.float64]
UP, FRONT = 2, np.array([0.0, -1.0, 0.0])

# An arm along x at the body's left, a column from the ground up, and the other arm.
ARM = np.stack(np.meshgrid(np.linspace(1, 3, 9), [-0.1, 0.1], [1.9, 2.1]), -1).reshape(-1, 3)
TRUNK = np.stack(np.meshgrid([-0.3, 0.3], [-0.2, 0.2], np.linspace(0, 2, 9)), -1).reshape(-1, 3)
OTHER = ARM * [-1.0, 1.0, 1.0]
BODY = np.concatenate([ARM, TRUNK, OTHER])
MASK = np.repeat(np.eye(3), [len(ARM), len(TRUNK), len(OTHER)], axis=1).astype(np.float32)


def turned(points: FloatArray, axis: int, angle: float, about: FloatArray) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    rotation[a, a] = rotation[b, b] = c
    rotation[a, b], rotation[b, a] = -s, s
    return (points - about) @ rotation.T + about


def effect_of(domain: int, move: Callable[[FloatArray, float], FloatArray]) -> CodeEffect:
    """Return the effect of a domain's whole-body code that moves the body by `move`."""

    def decode(latent: FloatArray) -> FloatArray:
        return np.stack([move(BODY, float(row[domain])) for row in latent])

    return code_effects(decode, np.ones(3), MASK, (3, 0, 0, 0), UP, FRONT)[domain]


def moving(domain: int, change: Callable[[FloatArray, float], FloatArray]) -> CodeEffect:
    part = slice(0, len(ARM)) if domain == 0 else slice(len(ARM), -len(OTHER))

    def move(body: FloatArray, share: float) -> FloatArray:
        posed = body.copy()
        posed[part] = change(body[part], share)
        return posed

    return effect_of(domain, move)


@pytest.mark.parametrize(
    ("way", "motion"),
    [
        ([0, 0, 1], "up"),
        ([0, 0, -1], "down"),
        ([0, -1, 0], "forward"),
        ([0, 1, 0.3], "back"),
        ([1, 0, 0], "left"),
        ([-1, 0.2, 0.5], "right"),
    ],
)
@pytest.mark.parametrize("domain", [0, 1])
def test_a_shift_is_named_after_its_direction(domain: int, way: list[float], motion: str) -> None:
    found = moving(domain, lambda part, share: part + 0.2 * share * np.array(way))
    # The arm is on the left.
    aside = {"left": "out", "right": "in"} if domain == 0 else {}
    assert found == CodeEffect(domain, aside.get(motion, motion))


def test_out_is_away_from_the_middle_on_either_side() -> None:
    def mirrored(points: FloatArray) -> FloatArray:
        return points * [-1.0, 1.0, 1.0]

    for sign, motion in ((1.0, "out"), (-1.0, "in")):

        def decode(latent: FloatArray, sign: float = sign) -> FloatArray:
            poses = np.stack([BODY] * len(latent))
            poses[:, : len(ARM), 0] += sign * 0.2 * latent[:, :1]
            return mirrored(poses)

        effects = code_effects(decode, np.ones(3), MASK, (3, 0, 0, 0), UP, FRONT)
        assert effects[0] == CodeEffect(0, motion)


def test_a_turn_about_the_long_axis_is_a_twist_and_another_a_bend() -> None:
    arm, trunk = ARM.mean(axis=0), TRUNK.mean(axis=0)
    assert moving(0, lambda p, s: turned(p, 0, 0.4 * s, arm)) == CodeEffect(0, "twist")
    assert moving(1, lambda p, s: turned(p, 2, 0.4 * s, trunk)) == CodeEffect(1, "twist")
    # About x, the top of the trunk moves back, about y to its left; the arm's end moves down.
    assert moving(1, lambda p, s: turned(p, 0, -0.4 * s, trunk)).motion == "bend back"
    assert moving(1, lambda p, s: turned(p, 0, 0.4 * s, trunk)).motion == "bend forward"
    assert moving(1, lambda p, s: turned(p, 1, 0.4 * s, trunk)).motion == "bend left"
    assert moving(0, lambda p, s: turned(p, 1, 0.4 * s, arm)).motion == "bend down"
    assert moving(0, lambda p, s: turned(p, 2, -0.4 * s, arm)).motion == "bend forward"
    # An upper arm that hangs down at the left.
    hanging = ARM[:, [2, 1, 0]] + [0.0, 0.0, -2.5]
    body = np.concatenate([hanging, TRUNK, OTHER])

    def decode(latent: FloatArray) -> FloatArray:
        lifted = [turned(hanging, 1, -0.4 * row[0], hanging.mean(axis=0)) for row in latent]
        return np.stack([np.concatenate([arm, TRUNK, OTHER]) for arm in lifted])

    assert np.array_equal(decode(np.zeros((1, 3)))[0], body)
    effects = code_effects(decode, np.ones(3), MASK, (3, 0, 0, 0), UP, FRONT)
    assert effects[0] == CodeEffect(0, "bend out")


def test_what_does_nothing_is_still() -> None:
    assert effect_of(0, lambda body, _: body).motion == "still"


def test_a_domains_own_code_moves_it_unless_it_carries_another_along() -> None:
    def decode(latent: FloatArray) -> FloatArray:
        bodies = np.repeat(BODY[None], len(latent), axis=0)
        for body, (*_, own, carrying) in zip(bodies, latent, strict=True):
            body[len(ARM) : -len(OTHER)] += [0, 0, 0.6 * own + 0.1 * carrying]
            body[: len(ARM)] += [0, own + carrying, 0]
        return bodies

    found = code_effects(decode, np.ones(5), MASK, (3, 0, 2, 0), UP, FRONT)
    assert found[3:] == (CodeEffect(1, "up"), CodeEffect(0, "back"))


def test_a_domains_code_of_the_whole_body_is_named_after_it_however_it_swings_others() -> None:
    def decode(latent: FloatArray) -> FloatArray:
        bodies = np.repeat(BODY[None], len(latent), axis=0)
        for body, (of_arm, of_trunk, _) in zip(bodies, latent, strict=True):
            body[len(ARM) : -len(OTHER)] += [0, 0, 0.1 * of_trunk]
            body[: len(ARM)] += [0, 0.2 * of_arm + 2.0 * of_trunk, 0]
        return bodies

    found = code_effects(decode, np.ones(3), MASK, (3, 0, 0, 0), UP, FRONT)
    assert found[:2] == (CodeEffect(0, "back"), CodeEffect(1, "up"))


def test_names_within_a_group_differ() -> None:
    up, arm_up, twist = CodeEffect(0, "up"), CodeEffect(1, "up"), CodeEffect(0, "twist")
    effects = [up, arm_up, up, up, arm_up, twist, twist, arm_up]
    names = code_names(effects, ("trunk", "arm"), (3, 4, 1))
    assert names == ("trunk up", "arm up", "trunk up 2", "up", "arm up", "twist", "twist 2", "up")
    # A domain may have the name of a numbered motion.
    names = code_names([up, CodeEffect(1, "up"), up], ("a", "a up 2"), (3, 0, 0))
    assert len(set(names)) == 3


def test_a_models_names_are_measured_once_and_follow_its_parts(
    tube_model: LearnedBody, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = tube_model.code_names
    assert len(names) == tube_model.latent_size
    for group in tube_model.latent_space.groups:
        assert len(set(names[group.codes])) == group.codes.stop - group.codes.start
    monkeypatch.setattr(LearnedBody, "decode", lambda *_: pytest.fail("measured again"))
    first, second = tube_model.domain_names
    renamed = tube_model.edit_domains({0: "knee", 1: "hip"})
    expected = [name.replace(first, "knee").replace(second, "hip") for name in names]
    assert list(renamed.code_names) == expected


def test_edited_parts_come_back_and_what_is_learnt_stays(
    tube_model: LearnedBody, tmp_path: Path
) -> None:
    edited = tube_model.edit_domains({0: "knee"}, {1: "#ABCDEF"}, [1, 0])
    assert edited.domain_names == ("knee", tube_model.domain_names[1])
    assert edited.card.domain_colours == (tube_model.card.domain_colours[0], "#abcdef")
    assert edited.domain_order == (1, 0)
    assert tube_model.domain_order == (0, 1)
    assert edited.fingerprint == tube_model.fingerprint
    edited.save(tmp_path / "edited.safetensors")
    again = LearnedBody.load(tmp_path / "edited.safetensors")
    assert again.card == edited.card
    pose = tube_model.known_poses[3]
    assert np.array_equal(again.decode(pose), tube_model.decode(pose))
    groups = again.latent_space.groups
    assert [group.name for group in groups[1:]] == list(again.domain_names)
    # In the original order, the file is as before any reordering.
    plain = edited.edit_domains(order=[0, 1])
    assert plain.domain_order == (0, 1)


def test_a_file_from_before_the_order_opens(tube_model: LearnedBody, tmp_path: Path) -> None:
    path = tmp_path / "tube.safetensors"
    tube_model.save(path)
    sections = read_model_file(path)
    assert "domain_order" not in sections["model"].metadata
    write_model_file(path, sections)
    assert LearnedBody.load(path).domain_order == (0, 1)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"names": {2: "knee"}}, "has no domain 3"),
        ({"colours": {-1: "#000000"}}, "has no domain 0"),
        ({"names": {0: " "}}, "cannot name a domain"),
        ({"names": {0: "a", 1: "a"}}, "two domains would be called 'a'"),
        ({"colours": {0: "red"}}, "'red' is not a colour"),
        ({"order": [0, 0]}, "is not an order of the 2 domains"),
        ({"order": [1]}, "name each once"),
        ({"order": [1, 2]}, "name each once"),
    ],
)
def test_parts_that_cannot_be_are_refused(
    tube_model: LearnedBody, changes: dict[str, object], sentence: str
) -> None:
    with pytest.raises(ModelFileError, match=sentence):
        tube_model.edit_domains(**changes)  # type: ignore[arg-type]


def test_edits_of_two_commands_are_both_kept(tube_model: LearnedBody, tmp_path: Path) -> None:
    path = tmp_path / "tube.safetensors"
    tube_model.save(path)
    change_model(path, lambda model: model.edit_domains({0: "knee"}))
    change_model(path, lambda model: model.edit_domains(colours={1: "#123456"}, order=[1, 0]))
    held = LearnedBody.load(path)
    assert held.domain_names[0] == "knee"
    assert held.card.domain_colours[1] == "#123456"
    assert held.domain_order == (1, 0)
