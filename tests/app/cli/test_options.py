"""Options declared once, as fields of dataclasses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from app.cli.options import Excluding, takes_options
from lcollision_core.bodies import NamedPose, open_body, write_poses
from lcollision_core.errors import LCollisionError
from lcollision_core.files import read_pose_set
from lcollision_core.options import Option, require_limits
from tests.app.support import Lcollision
from tests.rigged_shapes import rigged_body, write_gltf


@dataclass(frozen=True)
class Choices:
    """Options of the test command."""

    files: Annotated[tuple[str, ...], Option("What to read.", metavar="FILE...")]
    size: Annotated[float | None, Option("How large.", ("--big",), low=0.0, below=1.0)] = None
    kind: Annotated[str, Option("Which.", choices=("a", "b"))] = "a"
    up: Annotated[int | None, Option("The axis.", words=("x", "y", "z"))] = None
    names: Annotated[tuple[str, ...], Option("May be repeated.")] = ()
    stays: Annotated[bool, Option("Whether.", ("--stays/--goes",))] = True
    own: int = 3


taken: list[Choices] = []


@takes_options
def command(choices: Annotated[Choices, Excluding({"kind"})], loud: bool = False) -> None:
    """Keep the received values."""
    taken.append(choices)
    assert loud in (True, False)


def _run(*arguments: str) -> str:
    taken.clear()
    app = typer.Typer(rich_markup_mode=None)
    app.command()(command)
    return CliRunner().invoke(app, arguments).output


def test_each_field_is_an_option() -> None:
    _run("f", "g", "--big", "0.5", "--up", "z", "--names", "n", "--names", "m", "--goes", "--loud")
    assert taken == [Choices(("f", "g"), 0.5, "a", 2, ("n", "m"), False)]
    _run("f")
    assert taken == [Choices(("f",))]
    said = _run("--help")
    for words in ("FILE...", "How large.", "0.0<=x<=1.0", "--up", "<x|y|z>", "--stays", "--goes"):
        assert words in said
    for words in ("--kind", "--own", "--size"):
        assert words not in said
    assert "--kind" in _run("f", "--kind", "b")
    assert not taken
    for wrong in (("--big", "2"), ("--up", "q")):
        assert wrong[0] in _run("f", *wrong)
        assert not taken


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"size": 1.0}, "the size must be below 1.0, got 1"),
        ({"size": -1.0}, "the size must be at least 0.0, got -1"),
        ({"size": float("nan")}, "the size must be at least 0.0, got nan"),
        ({"kind": "c"}, "the kind must be a, b, got c"),
        ({"up": 7}, "the up must be 0, 1, 2, got 7"),
    ],
)
def test_limits_hold_wherever_the_options_come_from(change: dict, sentence: str) -> None:
    require_limits(Choices(("f",)))
    with pytest.raises(LCollisionError) as caught:
        require_limits(Choices(("f",), **change))
    assert str(caught.value) == sentence


@pytest.mark.variants(2)
@pytest.mark.parametrize("name", ["sample", "resolve", "decode", "dataset make"])
def test_what_searches_collisions_can_leave_groups_out(
    lcollision: Lcollision, tmp_path: Path, name: str
) -> None:
    file = write_gltf(rigged_body(), tmp_path / "arm.glb")
    body = open_body(file)
    group = next(group.name for kind in body.groups_by_kind.values() for group in kind)
    poses = tmp_path / "poses.json"
    write_poses(poses, body, [NamedPose("rest", np.zeros(body.latent_size))])
    given, out = {
        "sample": (("-n", "1"), "out.json"),
        "resolve": ((poses,), "out.glb"),
        "decode": ((poses,), "out.glb"),
        "dataset make": (("--by-rig", "2"), "out.npz"),
    }[name]
    words = (*name.split(), file, *given, "-o", tmp_path / out)
    done = lcollision(*words, "--leave-out", group)
    assert done.exit_code == 0, done.output
    if name == "dataset make":
        assert read_pose_set(tmp_path / out).rules.left_out == (group,)
    refused = lcollision(*words, "--leave-out", "no such group")
    assert refused.exit_code == 2
    assert "'no such group'" in refused.output
