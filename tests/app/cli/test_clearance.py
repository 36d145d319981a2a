"""``--clearance``: of ``check``, ``resolve``, ``resolve --motion`` and ``sample --free``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import NamedPose, open_body, read_poses, write_poses
from lcollision_core.files import write_mesh
from tests.app.support import Lcollision
from tests.core.contact.test_clearance import folded
from tests.core.motion.swings import N_FRAMES, OTHER, swinging_body
from tests.core.shapes import box, join
from tests.rigged_shapes import write_gltf


def test_a_mesh_whose_parts_are_too_near_is_refused(lcollision: Lcollision, apart: Path) -> None:
    """The two faces are 0.1 apart, and the mesh is 1 high."""
    free = lcollision("check", apart, "--clearance", "0.09", "--json")
    assert free.exit_code == 0
    (report,) = json.loads(free.stdout)
    assert (report["colliding"], report["clearance"]) == (False, 0.09)
    assert report["least_distance"] is None
    refused = lcollision("check", apart, "--clearance", "0.12", "--json")
    assert refused.exit_code == 1
    (report,) = json.loads(refused.stdout)
    assert (report["colliding"], report["pairs"]) == (True, 1)
    assert report["least_distance"] == pytest.approx(0.1)
    assert report["least_at"]["faces"] == [0, 1]
    assert np.ptp(report["least_at"]["points"], axis=0) == pytest.approx([0.0, 0.0, 0.1])
    (pair,) = report["deepest"]
    assert pair["depth"] == pytest.approx(0.02)
    said = lcollision("check", apart, "--clearance", "0.12").stdout
    assert "1 pair of faces nearer than 12 % of the body size, least distance 10 %" in said
    said = lcollision("check", apart, "--clearance", "0.09").stdout
    assert "no faces nearer than 9 % of the body size, least distance above 9 %" in said


def test_penetration_is_told_with_a_clearance_as_well(
    lcollision: Lcollision, stabbed: Path
) -> None:
    result = lcollision("check", stabbed, "--clearance", "0.01", "--json")
    assert result.exit_code == 1
    (report,) = json.loads(result.stdout)
    assert report["least_distance"] == pytest.approx(-0.1)
    said = lcollision("check", stabbed, "--clearance", "0.01").stdout
    assert "penetrating by up to 10 % of the body size" in said


def test_skin_is_measured_against_its_rest_pose(lcollision: Lcollision, tmp_path: Path) -> None:
    for name, mesh in (("flat", folded(0.0)), ("bent", folded(0.5 * np.pi))):
        write_mesh(tmp_path / f"{name}.obj", mesh.vertices, mesh.faces)
    bent, rest = tmp_path / "bent.obj", ("--rest", tmp_path / "flat.obj")
    for options in ((), rest):
        assert lcollision("check", bent, "--clearance", "0.05", *options).exit_code == 0
    # Blocks that are equally near at rest.
    one = box([0, 0, 0], [1, 1, 1])
    blocks = join(one, one.moved([1.02, 0, 0]))
    write_mesh(tmp_path / "blocks.obj", blocks.vertices, blocks.faces)
    path = tmp_path / "blocks.obj"
    assert lcollision("check", path, "--clearance", "0.05").exit_code == 1
    assert lcollision("check", path, "--rest", path, "--clearance", "0.05").exit_code == 0


def test_groups_that_may_touch_are_named(lcollision: Lcollision, tmp_path: Path) -> None:
    one = box([0, 0, 0], [1, 1, 1])
    blocks = join(one, one.moved([1.02, 0, 0]), one.moved([0, 1.02, 0]))
    path = tmp_path / "blocks.obj"
    write_mesh(path, blocks.vertices, blocks.faces)
    names = ("component 1:component 2", "component 1:component 3", "component 2:component 3")
    for n, status in ((0, 1), (1, 1), (2, 1), (3, 0)):
        options = [option for name in names[:n] for option in ("--touch", name)]
        result = lcollision("check", path, "--clearance", "0.05", *options)
        assert result.exit_code == status, result.output
    refused = lcollision("check", path, "--clearance", "0.05", "--touch", "component 1:leg")
    assert refused.exit_code == 2
    assert "the pair that may touch 'component 1:leg' names 'leg'" in refused.stderr
    for command in (["check", path], ["sample", "body", "-n", "1", "-o", tmp_path / "p.json"]):
        refused = lcollision(*command, "--touch", names[0])
        assert refused.exit_code == 2
        assert "--touch needs --clearance; add that, or leave it out" in refused.stderr


def test_parts_of_a_body_that_may_touch_come_nearer(lcollision: Lcollision, tmp_path: Path) -> None:
    body = open_body("body")
    near = body.exact_check(clearance=0.003)
    rows = body.sample(60, np.random.default_rng(5))
    free = rows[body.exact_check().are_free(rows) & ~near.are_free(rows)]
    owners = body.space.vertex_domain[body.faces[:, 0]]
    for latent in free:
        pairs = near.find(near.exported(near.decode(latent)[0])).pairs
        parts = np.unique(np.sort(owners[pairs], axis=1), axis=0)
        if len(parts) == 1 and parts[0, 0] != parts[0, 1]:
            break
    else:
        pytest.fail("no pose has two parts alone that are too near")
    name = ":".join(body.domain_names[part] for part in parts[0])
    poses, out = tmp_path / "poses.json", tmp_path / "out.json"
    write_poses(poses, body, [NamedPose("pose", latent)])
    command = ("resolve", "body", poses, "-o", out, "--clearance", "0.003", "--json")
    (moved,) = json.loads(lcollision(*command).stdout)
    (kept,) = json.loads(lcollision(*command, "--touch", name).stdout)
    assert (kept["step"], kept["exactly_free"]) == ("unchanged", True)
    assert moved["step"] != "unchanged"
    assert moved["exactly_free"]


def test_a_clearance_out_of_range_is_refused(lcollision: Lcollision, apart: Path) -> None:
    assert lcollision("check", apart, "--clearance", "-0.1").exit_code == 2
    refused = lcollision("check", apart, "--clearance", "1")
    assert refused.exit_code == 2
    assert "the clearance must be 0 or more and below 1 body size" in refused.stderr
    assert lcollision("resolve", "body", apart, "-o", apart, "--clearance", "2").exit_code == 2


def test_poses_are_drawn_and_resolved_with_a_clearance(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    drawn = tmp_path / "drawn.json"
    command = ("sample", "body", "-n", "12", "--free", "--seed", "2", "-o", drawn)
    assert lcollision(*command, "--clearance", "0.003").exit_code == 0
    body = open_body("body")
    codes = np.stack([pose.latent for pose in read_poses(drawn, body)])
    assert body.exact_check(clearance=0.003).are_free(codes).all()
    assert lcollision(*command).exit_code == 0
    plain = np.stack([pose.latent for pose in read_poses(drawn, body)])
    is_free = body.exact_check(clearance=0.003).are_free(plain)
    assert not is_free.all()

    chosen = plain[np.argsort(is_free, kind="stable")[[0, -1]]]
    write_poses(drawn, body, [NamedPose(f"pose {n}", row) for n, row in enumerate(chosen)])
    free = tmp_path / "free.json"
    result = lcollision("resolve", "body", drawn, "-o", free, "--clearance", "0.003", "--json")
    assert result.exit_code == 0, result.output
    moved, unchanged = json.loads(result.stdout)
    assert (moved["exactly_free"], unchanged["step"]) == (True, "unchanged")
    assert moved["least_distance"] is None or moved["least_distance"] >= 0.003 - 1e-9
    assert moved["pairs_before"] > 0 == moved["pairs_after"]
    ends = np.stack([pose.latent for pose in read_poses(free, body)])
    assert body.exact_check(clearance=0.003).are_free(ends).all()
    said = lcollision("resolve", "body", drawn, "-o", free, "--clearance", "0.001").stdout
    assert said.count("least distance") == 2
    assert "least distance" not in lcollision("resolve", "body", drawn, "-o", free).stdout


@pytest.mark.slow
def test_motions_are_checked_and_resolved_with_a_clearance(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    swing = write_gltf(swinging_body(), tmp_path / "swing.glb")
    plain = lcollision("check", swing, "--clips", "--json")
    near = lcollision("check", swing, "--clips", "--json", "--clearance", "0.005")
    (moving, still), (touching, _) = json.loads(near.stdout), json.loads(plain.stdout)
    assert near.exit_code == 1
    assert moving["least_distance"] < 0.0
    assert moving["least_frame"] in {one["frame"] for one in moving["colliding_frames"]}
    assert len(moving["colliding_frames"]) >= len(touching["colliding_frames"])
    assert (touching["least_distance"], touching["clearance"]) == (None, 0.0)
    assert (still["clip"], still["colliding"]) == (OTHER, False)

    free = tmp_path / "free.glb"
    result = lcollision("resolve", swing, "--motion", "-o", free, "--clearance", "0.005", "--json")
    assert result.exit_code == 0, result.output
    row, _ = json.loads(result.stdout)
    assert row["free_before"] < row["free_after"] == row["frames"] == N_FRAMES
    assert row["least_distance"] is None or row["least_distance"] >= 0.005 - 1e-9
    # The rounded file still keeps the clearance.
    again = lcollision("check", free, "--clips", "--json", "--clearance", "0.0049")
    assert again.exit_code == 0, again.output
    said = lcollision("check", free, "--clips", "--clearance", "0.0049").stdout
    assert "no faces nearer than 0.49 % of the body size" in said
