"""``check --clips --continuous`` and ``resolve --motion --for-cloth``: free between frames too."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import open_body
from lcollision_core.files import ClipFrames
from tests.app.support import Lcollision
from tests.core.motion.swings import through_the_trunk
from tests.rigged_shapes import skinned, write_gltf

HIT = 13
"""The frame after which the arm passes through the trunk, though all frames are free."""


@pytest.fixture(scope="module")
def through(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a character whose clip is free in all frames, but not between them."""
    body, motion = through_the_trunk()
    transforms = np.stack([body.space.transforms(codes) for codes in motion.codes])
    names = tuple(f"frame {frame}" for frame in range(len(motion)))

    def sample(clip: str, fps: float | None) -> ClipFrames:  # noqa: ARG001
        rig = body.space.rig
        return ClipFrames(
            names,
            motion.times,
            transforms,
            lambda: np.stack([skinned(rig, one) for one in transforms]),
        )

    character = replace(body.character, clips={motion.name: float(motion.times[-1])}, sample=sample)
    return write_gltf(character, tmp_path_factory.mktemp("through") / "through.glb")


def test_what_passes_through_between_frames_is_found_and_led_round(
    lcollision: Lcollision, through: Path, tmp_path: Path
) -> None:
    command = ("check", through, "--clips", "--substeps", 0)
    plain = lcollision(*command, "--json")
    assert plain.exit_code == 0, plain.output
    assert json.loads(plain.stdout)[0]["collides_between"] is None
    found = lcollision(*command, "--continuous", "--json")
    assert found.exit_code == 1
    (report,) = json.loads(found.stdout)
    assert report["colliding"]
    assert (report["colliding_frames"], report["in_between"]) == ([], [])
    assert report["collides_between"] == [HIT]
    said = lcollision(*command, "--continuous").stdout
    assert f"contact between frames {HIT} and {HIT + 1}" in said
    free = tmp_path / "free.glb"
    # The way around is longer than a quarter of the body size.
    far = ("--largest-change", 1)
    cloth = ("--motion", "--for-cloth", "--substeps", 0)
    resolved = lcollision("resolve", through, *cloth, *far, "-o", free, "--json")
    assert resolved.exit_code == 0, resolved.output
    (row,) = json.loads(resolved.stdout)
    assert row["collides_between"] == []
    assert row["clearance"] == pytest.approx(0.003 / open_body(through).body_size)
    again = lcollision("check", free, "--clips", "--substeps", 0, "--continuous")
    assert again.exit_code == 0, again.output
    assert "no collisions in 28 frames, and no contact between them" in again.stdout


@pytest.mark.slow
def test_what_stays_in_contact_is_named_and_ends_with_1(
    lcollision: Lcollision, through: Path, tmp_path: Path
) -> None:
    locks = [word for name in open_body(through).domain_names for word in ("--lock", name)]
    stuck = lcollision(
        *("resolve", through, "--motion", "--continuous", "--substeps", 0, "--easing", 0),
        *("--no-keep-feet", *locks, "-o", tmp_path / "stuck.glb"),
    )
    assert stuck.exit_code == 1, stuck.output
    assert f"contact between frames {HIT} and {HIT + 1}" in stuck.stdout


def test_what_is_missing_is_said(
    lcollision: Lcollision, through: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = ("--motion", "--for-cloth", "-o", tmp_path / "out/")
    none = lcollision("resolve", through, *out, "--clearance", 0)
    assert none.exit_code == 2
    assert none.stderr == (
        "lcollision: --clearance 0 leaves no room for cloth; leave it out for 3 mm, or --for-cloth "
        "out\n"
    )
    unknown = lcollision("resolve", "body", through, *out)
    assert unknown.exit_code == 2
    assert "has no known unit, so 3 mm cannot be converted; give" in unknown.stderr
    monkeypatch.setitem(sys.modules, "ipctk", None)
    missing = lcollision("check", through, "--clips", "--continuous")
    assert missing.exit_code == 2
    assert "needs ipctk; run: pip install 'lcollision[ccd]'" in missing.stderr
    assert lcollision("resolve", through, *out).exit_code == 2
    assert not list(tmp_path.glob("out/*"))
