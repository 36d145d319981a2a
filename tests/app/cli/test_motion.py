"""``check --clips`` and ``resolve --motion``: whole motions from file to file."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import (
    LearnedBody,
    NamedPose,
    open_body,
    read_poses,
    sample_poses,
    write_poses,
)
from lcollision_core.bodies.motions import read_motions
from lcollision_core.errors import CancelledError, LCollisionError
from lcollision_core.files import read_character, write_mesh
from lcollision_core.files.motion.caches import (
    cache_rate,
    read_point_cache,
    write_point_cache,
)
from lcollision_core.jobs import Job
from lcollision_core.meshes import STRICT
from lcollision_core.predictor.metrics import SureRange
from lcollision_core.tasks.resolving import FolderStatus, ResolveMotionsRequest, resolve_folder
from lcollision_core.tasks.verdicts import ResolvedClip
from tests.app.support import Lcollision
from tests.core.bodies.test_retargeting import of_rig
from tests.core.fbx_builder import character_fbx
from tests.core.gltf_builder import GltfBuilder, arm
from tests.core.motion.swings import CLIP, N_FRAMES, OTHER, swinging_body
from tests.rigged_shapes import write_gltf


def test_clips_are_screened_frame_by_frame(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    table = tmp_path / "frames.csv"
    result = lcollision("check", swing, "--clips", "--json", "--csv", table)
    assert result.exit_code == 1, result.output
    moving, still = json.loads(result.stdout)
    assert (moving["file"], moving["clip"], moving["frames"]) == (str(swing), CLIP, N_FRAMES)
    assert moving["fps"] == pytest.approx(30.0)
    assert (still["clip"], still["colliding_frames"], still["colliding"]) == (OTHER, [], False)
    body = open_body(swing)
    (motion,) = read_motions(body, swing, CLIP)
    colliding = np.flatnonzero(~body.exact_check().are_free(motion.codes))
    frames = moving["colliding_frames"]
    assert [one["frame"] for one in frames] == colliding.tolist()
    assert frames[0]["seconds"] == pytest.approx(colliding[0] / 30.0, abs=1e-5)
    assert all(one["pairs"] > 0 and 0.0 < one["deepest"] < 0.1 for one in frames)
    assert {name for one in frames for pair in one["parts"] for name in pair} <= set(
        body.domain_names
    )
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [int(row["frame"]) for row in rows] == colliding.tolist()
    assert lcollision("check", swing, "--clips", "--clip", OTHER).exit_code == 0
    missing = lcollision("check", swing, "--clips", "--clip", "run")
    assert missing.exit_code == 2
    assert "it has no clip 'run'" in missing.stderr


def test_frames_that_a_predictor_is_sure_of_are_not_checked(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    body = LearnedBody.load("body")
    predictor = body.require_predictor()
    assert predictor.metrics is not None
    metrics = replace(predictor.metrics, sure=(SureRange(1e-2, -2.0, 9.0, 0.5),))
    sure, poses = tmp_path / "sure.safetensors", tmp_path / "poses.json"
    body = body.with_predictor(replace(predictor, metrics=metrics))
    body.save(sure)
    way = np.linspace(0.0, 1.0, 12)[:, None]
    start, end = body.known_poses[0], sample_poses(body, 1, 0, colliding=True)[0]
    codes = (1.0 - way) * start + way * end
    write_poses(poses, body, [NamedPose(f"{at}", row) for at, row in enumerate(codes)])

    def frames(*options: object) -> tuple[list[int], int]:
        order = ("check", poses, "--clips", "--body", sure, "--json", *options)
        (report,) = json.loads(lcollision(*order).stdout)
        return [one["frame"] for one in report["colliding_frames"]], report["estimated_frames"]

    exact, none = frames()
    assert (exact[-1], none) == (11, 0)
    is_estimated = body.predict(codes).collision_logit < -2.0
    colliding, n_estimated = frames("--error-bound", 0.02)
    assert n_estimated == is_estimated.sum() > 0
    assert colliding == [at for at in exact if not is_estimated[at]]
    assert frames("--error-bound", 0.02, "--clearance", 0.001)[1] == 0
    said = lcollision("check", poses, "--clips", "--body", sure, "--error-bound", 0.02).stdout
    assert f"; {n_estimated} frames free by the estimate\n" in said
    refused = lcollision("check", tmp_path / "a.obj", "--error-bound", 0.02)
    assert refused.exit_code == 2
    assert "--error-bound is for motions" in refused.stderr


def test_a_point_cache_is_screened_with_its_mesh(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    body = open_body(swing)
    (motion,) = read_motions(body, swing, CLIP)
    write_mesh(tmp_path / "walk.obj", body.reference, body.topology.faces)
    write_point_cache(tmp_path / "walk.mdd", body.decode(motion.codes[::6]), fps=24.0)
    result = lcollision("check", tmp_path / "walk.obj", tmp_path / "walk.mdd", "--json")
    assert result.exit_code == 1, result.output
    mesh, report = json.loads(result.stdout)
    assert (mesh["file"], mesh["pairs"]) == (str(tmp_path / "walk.obj"), 0)
    assert report["fps"] == pytest.approx(24.0)
    colliding = np.flatnonzero(~body.exact_check().are_free(motion.codes[::6]))
    assert [one["frame"] for one in report["colliding_frames"]] == colliding.tolist()
    assert "component" in report["colliding_frames"][0]["parts"][0][0]
    write_point_cache(tmp_path / "walk.mdd", body.decode(motion.codes[::6][colliding[:1]]))
    alone = lcollision("check", tmp_path / "walk.obj", tmp_path / "walk.mdd")
    assert ": 1 of 1 frame collides, deepest frame 0 by " in alone.stdout


@pytest.mark.parametrize("kind", ["frames", "poses"])
def test_a_resolved_point_cache_starts_when_it_did(
    lcollision: Lcollision, swing: Path, tmp_path: Path, kind: str
) -> None:
    body = open_body(swing)
    (motion,) = read_motions(body, swing, CLIP)
    walk, out = tmp_path / "walk.pc2", tmp_path / ("free.pc2" if kind == "frames" else "free.json")
    write_point_cache(walk, body.decode(motion.codes[:3]))
    data = bytearray(walk.read_bytes())
    data[20:28] = np.array([101.0, 0.5], "<f4").tobytes()
    walk.write_bytes(data)
    assert lcollision("resolve", swing, walk, "--motion", "-o", out).exit_code == 0
    assert kind == "poses" or out.read_bytes()[:32] == bytes(data[:32])


def test_a_clip_without_a_rig_has_its_own_rate(lcollision: Lcollision, tmp_path: Path) -> None:
    body, builder = open_body("body"), GltfBuilder()
    primitive = {
        "attributes": {"POSITION": builder.array(body.reference)},
        "indices": builder.array(body.topology.faces.reshape(-1), "u4"),
    }
    mesh = builder.add("meshes", primitives=[primitive])
    node = builder.add("nodes", mesh=mesh)
    times = np.arange(4) / 24.0
    keys = {"times": times, "values": np.outer(times, [1.0, 0.0, 0.0])}
    builder.animation("walk", {"node": node, "path": "translation", **keys})
    path = builder.write(tmp_path / "walk.glb")
    (report,) = json.loads(lcollision("check", path, "--clips", "--json").stdout)
    assert (report["frames"], report["fps"]) == (4, 24.0)
    (motion,) = read_motions(body, path)
    np.testing.assert_allclose(motion.times, times, atol=1e-6)


def test_a_cache_that_is_missing_or_truncated_is_said_and_the_next_file_checked(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    (tmp_path / "cut.mdd").write_bytes(bytes(11))
    files = tmp_path / "none.mdd", tmp_path / "cut.mdd", swing
    result = lcollision("check", *files, "--clips", "--clip", OTHER)
    assert result.exit_code == 2
    assert [f"{file} cannot be read: " in result.stderr for file in files] == [True, True, False]
    assert f"{swing}: {OTHER}" in result.stdout


def test_a_character_gets_its_own_file_back_with_its_clip_free(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    free = tmp_path / "free.glb"
    result = lcollision("resolve", swing, "--motion", "-o", free, "--json")
    assert result.exit_code == 0, result.output
    moving, still = json.loads(result.stdout)
    assert moving["free_before"] < moving["free_after"] == moving["frames"] == N_FRAMES
    assert moving["in_between_after"] == 0
    assert moving["acceleration_ratio"] < 1.1
    assert (still["clip"], still["mean_change"], still["acceleration_ratio"]) == (OTHER, 0.0, 1.0)
    assert {row["output"] for row in (moving, still)} == {str(free)}
    assert lcollision("check", free, "--clips").exit_code == 0
    before, after = open_body(swing), open_body(free)
    assert after.fingerprint == before.fingerprint
    (old,), (new,) = (
        read_motions(body, path, OTHER) for body, path in ((before, swing), (after, free))
    )
    assert new.codes.tobytes() == old.codes.tobytes()
    # No intermediate files are left.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["free.glb"]


@pytest.mark.slow
def test_a_motion_is_also_written_as_poses_and_as_frames(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    refused = lcollision("resolve", swing, "--motion", "-o", tmp_path / "all.pc2")
    assert refused.exit_code == 2
    assert "choose one with --clip" in refused.stderr
    chosen = ("--motion", "--clip", CLIP, "--fps", "15", "--no-keep-feet")
    poses, cache = tmp_path / "free.json", tmp_path / "free.pc2"
    for out in (poses, cache):
        result = lcollision("resolve", swing, *chosen, "-o", out)
        assert result.exit_code == 0, result.output
        assert "all after" in result.stdout
    body = open_body(swing)
    held = read_poses(poses, body)
    assert [pose.name for pose in held][:2] == [f"{CLIP} 0", f"{CLIP} 1"]
    assert len(held) == N_FRAMES // 2
    assert body.exact_check().are_free(np.array([pose.latent for pose in held])).all()
    # Poses form a motion again, and a free motion does not change.
    again = lcollision("resolve", swing, poses, "--motion", "-o", tmp_path / "again.json", "--json")
    assert again.exit_code == 0, again.output
    (row,) = json.loads(again.stdout)
    assert row["free_before"] == row["frames"] == len(held)
    assert row["largest_change"] == 0.0


def test_a_clip_of_any_name_is_checked_and_written(lcollision: Lcollision, tmp_path: Path) -> None:
    for name in ("\ud800 wave", "w" * 300):
        builder = arm()
        builder.description["animations"][0]["name"] = name
        file = builder.write(tmp_path / "arm.glb")
        poses, frames, table = tmp_path / "free.json", tmp_path / "free", tmp_path / "frames.csv"
        assert lcollision("check", file, "--clips", "--csv", table).exit_code == 0
        for out in (poses, f"{frames}/"):
            again = ("--motion", "--fps", 5, "--in-place", "-o", out)
            assert lcollision("resolve", file, *again).exit_code == 0
        n_frames = len(read_poses(poses, open_body(file)))
        assert len(list(frames.iterdir())) == n_frames > 3
        for out in (poses, *frames.iterdir()):
            out.unlink()


@pytest.mark.slow
def test_a_pinned_domain_stays_where_the_motion_has_it(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    body = open_body(swing)
    (motion,) = read_motions(body, swing, CLIP)
    head = body.space.vertex_domain == body.domain_names.index("Head")
    moved = []
    for number, pins in enumerate(((), ("--pin", "head"))):
        out = tmp_path / f"{number}.json"
        result = lcollision("resolve", swing, "--motion", "--clip", CLIP, *pins, "-o", out)
        assert result.exit_code == 0, result.output
        codes = np.array([pose.latent for pose in read_poses(out, body)])
        change = (body.decode(codes) - body.decode(motion.codes))[:, head] / body.body_size
        moved.append(float(np.abs(change).max()))
    assert moved[0] > 4e-3
    assert moved[1] < 2e-3


@pytest.mark.parametrize("kind", ["folder", pytest.param("npz", marks=pytest.mark.slow)])
def test_a_folder_of_meshes_and_a_pose_set_are_motions_in_natural_order(
    lcollision: Lcollision, swing: Path, tmp_path: Path, kind: str
) -> None:
    body = open_body(swing)
    (motion,) = read_motions(body, swing, CLIP)
    frames = body.decode(motion.codes[::4])
    source, out = tmp_path / "swings", tmp_path / "free.mdd"
    if kind == "folder":
        source.mkdir()
        for number, frame in enumerate(frames):
            write_mesh(source / f"frame {number}.obj", frame, body.faces)
    else:
        source = source.with_suffix(".npz")
        np.savez(source, vertices=frames, faces=body.faces)
    options = ("--motion", "--fps", "7.5", "--easing", "4", "-o", out, "--json")
    result = lcollision("resolve", swing, source, *options)
    assert result.exit_code == 0, result.output
    (row,) = json.loads(result.stdout)
    assert (row["frames"], row["source"]) == (len(frames), source.name)
    colliding = ~body.exact_check().are_free(motion.codes[::4])
    assert row["free_before"] == len(frames) - np.count_nonzero(colliding) < len(frames)
    assert row["free_after"] == len(frames)
    assert cache_rate(out) == pytest.approx(7.5)
    free = read_point_cache(out)
    change = np.abs(free - frames).max(axis=(1, 2)) / body.body_size
    # Before the easing, frames are unchanged.
    assert change[0] < 1e-6
    assert change[colliding].min() > 1e-3


@pytest.mark.slow
def test_a_rigged_fbx_comes_back_as_a_rigged_glb_with_its_clip_free(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    pytest.importorskip("ufbx")
    source = character_fbx(swinging_body(), tmp_path / "hero.fbx")
    free = tmp_path / "hero-free.glb"
    result = lcollision("resolve", source, "--motion", "-o", free, "--json")
    assert result.exit_code == 0, result.output
    assert "FBX can't be written, so hero.fbx comes back as GLB" in result.stderr
    moving, still = json.loads(result.stdout)
    assert moving["free_before"] < moving["free_after"] == moving["frames"] == N_FRAMES
    assert (still["clip"], still["largest_change"]) == (OTHER, 0.0)
    assert lcollision("check", source, "--clips").exit_code == 1
    assert lcollision("check", free, "--clips").exit_code == 0
    before, after = read_character(source), read_character(free)
    assert before.rig is not None
    assert after.rig is not None
    assert after.rig.joint_names == before.rig.joint_names
    np.testing.assert_array_equal(after.topology.faces, before.topology.faces)
    # From z up, in centimetres: the other clip is unchanged.
    for clip in (CLIP, OTHER):
        old, new = (one.sample(clip, 30.0) for one in (before, after))
        moved = 0.01 * old.vertices[..., [0, 2, 1]] * [1.0, 1.0, -1.0] - new.vertices
        size = float(np.ptp(new.vertices[0], axis=0).max())
        assert (np.abs(moved).max() < 1e-6 * size) == (clip == OTHER)


def test_what_is_no_motion_is_said(lcollision: Lcollision, swing: Path, tmp_path: Path) -> None:
    none = lcollision("resolve", "body", "--motion", "-o", tmp_path / "out.json")
    assert none.exit_code == 2
    assert "has no clips" in none.stderr
    empty = lcollision("resolve", swing, "-o", tmp_path / "out.json")
    assert empty.exit_code == 2
    assert "names no pose to resolve" in empty.stderr
    for command in (
        ("check", "x.obj", "--clips"),
        ("resolve", swing, "x.txt", "--motion", "-o", tmp_path / "o"),
    ):
        result = lcollision(*command)
        assert result.exit_code == 2
        assert result.stderr.count("\n") == 1


def test_a_skeletons_motion_comes_back_in_its_own_file(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    body = open_body(swing)
    (motion,) = read_motions(body, swing, CLIP)
    source, free = tmp_path / "walk.bvh", tmp_path / "free.bvh"
    source.write_text(of_rig(body, motion.codes))
    alone = lcollision("check", source)
    assert alone.exit_code == 2
    assert "is the motion of a skeleton, without a body; name one with --body" in alone.stderr
    colliding = lcollision("check", source, "--body", swing, "--json")
    assert colliding.exit_code == 1
    (row,) = json.loads(colliding.stdout)
    expected = np.flatnonzero(~body.exact_check().are_free(motion.codes))
    assert [one["frame"] for one in row["colliding_frames"]] == expected.tolist()
    result = lcollision("resolve", swing, source, "-o", free)
    assert result.exit_code == 0, result.output
    assert lcollision("check", free, "--body", swing).exit_code == 0
    other = lcollision("resolve", swing, "--motion", "-o", tmp_path / "other.bvh")
    assert other.exit_code == 2
    assert "other.bvh holds one motion, but there are 2: 'swing', 'nod'" in other.stderr


def captured(swing: Path, folder: Path, frames: Mapping[str, slice | list[int]]) -> Path:
    """Make a folder of BVH files by name, each with some frames of the swing."""
    body = open_body(swing)
    (motion,) = read_motions(body, swing, CLIP)
    folder.mkdir()
    for name, chosen in frames.items():
        (folder / f"{name}.bvh").write_text(of_rig(body, motion.codes[chosen]))
    return folder


def test_a_folder_of_motions_comes_to_a_folder_and_goes_on(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    frames = {"walk 10": slice(6, 16), "walk 9": slice(6)}
    folder, out = captured(swing, tmp_path / "captured", frames), tmp_path / "free"
    (folder / "broken.bvh").write_text("HIERARCHY\nMOTION\n")
    write_gltf(swinging_body(24.0, 20), folder / "hero.glb")
    (folder / "notes.txt").write_text("not a motion")
    refused = lcollision("resolve", swing, folder, "--motion", "-o", tmp_path / "all.pc2")
    assert refused.exit_code == 2
    assert "cannot contain 4 motions; name a folder" in refused.stderr
    result = lcollision("resolve", swing, folder, "--motion", "-o", out, "--json")
    assert result.exit_code == 2
    rows = json.loads(result.stdout)
    names = ["broken.bvh", "hero.glb", "hero.glb", "walk 9.bvh", "walk 10.bvh"]
    assert [row["source"] for row in rows] == names
    assert "broken.bvh cannot be read: " in rows[0]["error"]
    assert all(row["free_after"] == row["frames"] for row in rows[1:])
    assert rows[-1]["deepest_before"] > rows[-1]["deepest_after"] == 0.0
    table = list(csv.DictReader((out / "motions.csv").read_text().splitlines()))
    assert [row["source"] for row in table] == names
    assert [row["error"] for row in table[1:]] == [""] * 4
    assert float(table[-1]["deepest_before"]) == rows[-1]["deepest_before"]
    held = ["hero.glb", "motions.csv", "walk 10.bvh", "walk 9.bvh"]
    assert sorted(path.name for path in out.iterdir()) == held
    assert lcollision("check", out / "hero.glb", "--clips").exit_code == 0
    for file in ("hero.glb: swing", "walk 9.bvh", "walk 10.bvh"):
        assert f"lcollision: {file}: " in result.stderr
    assert "Resolving motions: 0 of 4\n" in result.stderr
    assert re.search(r"Resolving motions: [123] of 4, .* left\n", result.stderr)
    assert "Resolving motions: 4 of 4\n" in result.stderr


def test_a_folder_is_only_checked_for_a_table(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    frames, body = {"still": [0, 0, 0], "swing": slice(8, 20)}, open_body(swing)
    folder, out = captured(swing, tmp_path / "captured", frames), tmp_path / "out"
    options = ("--motion", "-o", out, "--only-check")
    result = lcollision("resolve", swing, folder, *options)
    assert result.exit_code == 1, result.output
    assert [path.name for path in out.iterdir()] == ["motions.csv"]
    still, moved = csv.DictReader((out / "motions.csv").read_text().splitlines())
    assert still["free_before"] == still["frames"] == "3"
    assert moved["free_before"] == moved["free_after"]
    assert int(moved["free_after"]) < int(moved["frames"])
    assert moved["output"] == ""
    checked = lcollision("check", folder, "--clips", "--body", swing)
    assert checked.exit_code == 1
    head, *rows = checked.stdout.splitlines()[-3:]
    assert head.split() == ["deepest", "frames", "that", "collide", "clip"]
    assert [Path(row.rpartition("  ")[2].rpartition(": ")[0]).name for row in rows] == [
        "swing.bvh",
        "still.bvh",
    ]
    depth = 100.0 * float(moved["deepest_before"])
    assert float(rows[0].split()[0]) == pytest.approx(depth, abs=0.006)
    statuses: list[FolderStatus] = []
    request = ResolveMotionsRequest.of_folder(body, folder, tmp_path / "free")
    rows = resolve_folder(request, Job(statuses.append))
    assert [status.n_done for status in statuses] == [0, 1, 2]
    assert {row.source for status in statuses for row in status.rows} == {"still.bvh", "swing.bvh"}
    assert [isinstance(row, ResolvedClip) and row.is_free for row in rows] == [True, True]
    with pytest.raises(LCollisionError, match=r"still\.bvh is an input"):
        ResolveMotionsRequest.of_folder(body, folder, folder)
    with pytest.raises(LCollisionError, match="nowhere is not a folder"):
        ResolveMotionsRequest.of_folder(body, tmp_path / "nowhere", tmp_path / "free")
    within = ResolveMotionsRequest.of_folder(body, tmp_path, folder / "free")
    assert {path.parent for path in within.files} == {folder, tmp_path / "free"}
    inside = ResolveMotionsRequest.of_folder(body, tmp_path, tmp_path / "free")
    assert {path.parent for path in inside.files} == {folder}
    alone = lcollision("resolve", swing, folder / "still.bvh", *options)
    assert alone.exit_code == 2
    assert "--only-check needs a folder of motions" in alone.stderr


def test_what_a_budget_leaves_undone_stays_as_it_was_and_is_named(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.glb"
    options = ("--motion", "--clip", CLIP, "-o", out, "--json")
    result = lcollision("resolve", swing, *options, "--budget", 0.001)
    assert result.exit_code == 1, result.output
    (row,) = json.loads(result.stdout)
    assert row["free_after"] == row["free_before"] < row["frames"]
    assert row["deepest_after"] == pytest.approx(row["deepest_before"], rel=1e-5)
    (span,) = row["kept_spans"]
    assert span["unchanged"]
    assert span["reason"] == "resolving was stopped before they were free"
    assert row["rough_spans"] == []
    out.unlink()
    result = lcollision("resolve", swing, *options, "--budget", 1000)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)[0]["rough_spans"] == []


_STOP_AFTER_THE_FIRST = """
import os
from contextlib import contextmanager
from app.cli import main
from lcollision_core.files import safe
write = safe.atomic_write
@contextmanager
def write_and_stop(path, *arguments, **options):
    with write(path, *arguments, **options) as file:
        yield file
    if path.name == "motions.partial.json":
        os._exit(9)
safe.atomic_write = write_and_stop
main.main()
"""


def test_a_folder_that_is_interrupted_says_how_to_continue(swing: Path, tmp_path: Path) -> None:
    body, notes = open_body(swing), list[str]()
    folder = captured(swing, tmp_path / "captured", {"walk 0": slice(9), "walk 1": slice(None)})
    request = ResolveMotionsRequest.of_folder(body, folder, tmp_path / "free")
    request = replace(request, workers=1)
    job = Job(note=notes.append)

    def stop_after_the_first(status: FolderStatus) -> None:
        if status.n_done:
            job.cancel()

    with pytest.raises(CancelledError):
        resolve_folder(request, job.part(stop_after_the_first))
    partial = tmp_path / "free" / "motions.partial.json"
    assert f"stopped; {partial} has 1 of 2 files, run the same command again to continue" in notes


@pytest.mark.slow
def test_a_stopped_folder_is_continued_with_what_is_left(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    frames = {"walk 0": slice(None), "walk 1": slice(None)}
    folder, out = captured(swing, tmp_path / "captured", frames), tmp_path / "free"
    command = ("resolve", swing, folder, "--motion", "-o", out, "--workers", 1)
    code = [sys.executable, "-c", _STOP_AFTER_THE_FIRST, *map(str, command)]
    assert subprocess.run(code, check=False).returncode == 9
    partial = out / "motions.partial.json"
    (done,) = json.loads(partial.read_bytes())["done"]
    stamp = (out / done).stat().st_mtime_ns
    again = lcollision(*command)
    assert again.exit_code == 0, again.output
    assert f"continuing from {partial}, which has 1 of 2 files" in again.stderr
    assert (out / done).stat().st_mtime_ns == stamp
    assert sorted(path.name for path in out.iterdir()) == [
        "motions.csv",
        "walk 0.bvh",
        "walk 1.bvh",
    ]


def test_the_frames_of_motions_are_checked_as_single_meshes_are(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    """With --no-rules, with a given rest pose, and for every file of a folder."""
    body = open_body(swing)
    (motion,) = read_motions(body, swing, CLIP)
    walk = tmp_path / "walk.mdd"
    frames = body.decode(motion.codes[::6])
    write_mesh(tmp_path / "walk.obj", frames[0], body.topology.faces)
    write_point_cache(walk, frames, fps=24.0)
    rest = tmp_path / "rest.obj"
    write_mesh(rest, frames[4], body.topology.faces)

    def pairs(*command: object) -> list[int]:
        (report,) = json.loads(lcollision("check", *command, "--json").stdout)
        return [one["pairs"] for one in report["colliding_frames"]]

    assert lcollision("contacts", swing, "--tolerated-depth", 0.5).exit_code == 0
    assert pairs(swing, "--clips", "--clip", CLIP) == []
    every = pairs(swing, "--clips", "--clip", CLIP, "--no-rules")
    strict = body.with_rules(STRICT).exact_check()
    assert len(every) == (~strict.are_free(motion.codes)).sum() > 0
    assert sum(pairs(walk, "--clips", "--rest", rest)) < sum(pairs(walk, "--clips"))
    refused = lcollision("check", swing, "--clips", "--rest", rest)
    assert refused.exit_code == 2
    assert "has a rest pose of its own; leave it out" in refused.stderr
    of_meshes = lcollision("check", tmp_path, "--no-rules")
    assert f"{tmp_path}: skipped walk.mdd: no mesh in it" in of_meshes.stderr
    folder = tmp_path / "clips"
    folder.mkdir()
    nothing = lcollision("check", folder, "--clips")
    assert nothing.exit_code == 2
    assert "clips contains no motion" in nothing.stderr
    nothing = lcollision("resolve", swing, folder, "--motion", "-o", tmp_path / "free")
    assert nothing.exit_code == 2
    assert "clips contains neither a motion nor a mesh; name a folder of clips" in nothing.stderr
    for name in ("a.glb", "b.glb"):
        (folder / name).write_bytes(swing.read_bytes())
    result = lcollision("check", folder, "--clips", "--clip", CLIP, "--no-rules", "--json")
    assert result.exit_code == 1
    files = [row["file"] for row in json.loads(result.stdout)]
    assert files == [str(folder / "a.glb"), str(folder / "b.glb")]


def test_a_motions_verdict_says_what_it_leaves_out(
    lcollision: Lcollision, swing: Path, tmp_path: Path
) -> None:
    options = ("--clip", CLIP, "--tolerated-depth", 0.5)
    body = open_body(swing)
    body = body.with_rules(replace(body.rules, tolerated_depth=0.5))
    (motion,) = read_motions(body, swing, CLIP)
    frames = [body.detector.detect(body.decode(codes)) for codes in motion.codes]
    excluded = [frame.excluded.total for frame in frames]
    (report,) = json.loads(lcollision("check", swing, "--clips", *options, "--json").stdout)
    assert not report["colliding"]
    assert sum(report["excluded_pairs"].values()) == sum(excluded) > 0
    assert report["excluded_frames"] == sum(n > 0 for n in excluded)
    deepest = max(float(frame.excluded_depth.max(initial=0.0)) for frame in frames)
    assert report["excluded_deepest"] == pytest.approx(deepest, rel=1e-3)
    said = lcollision("check", swing, "--clips", *options).stdout
    assert "no collisions in" in said
    assert f"in {report['excluded_frames']} frames " in said
    assert f"{report['excluded_pairs']['tolerated']} pairs not deeper than 0.5 are not" in said
    assert f"up to {100.0 * deepest:.3g} % of the body size deep in frame" in said
    table = tmp_path / "motions.csv"
    lcollision("check", swing, "--clips", *options, "--csv", table)
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [int(row["frame"]) for row in rows] == np.flatnonzero(excluded).tolist()
    assert {(row["pairs"], row["deepest"], row["parts"]) for row in rows} == {("0", "0.0", "")}
    assert [int(row["excluded_pairs"]) for row in rows] == [n for n in excluded if n]
    assert all("tolerated:" in row["excluded_rules"] for row in rows)
    assert max(float(row["excluded_deepest"]) for row in rows) == report["excluded_deepest"]
    out = tmp_path / "same.glb"
    result = lcollision("resolve", swing, "--motion", "-o", out, *options)
    assert result.exit_code == 0, result.output
    assert "pairs not deeper than 0.5 are not counted, up to" in result.stdout


@pytest.mark.parametrize(
    ("command", "option"),
    [
        *(("check", option) for option in ("--continuous", "--clip=a", "--body=b", "--csv=t.csv")),
        *(("check", option) for option in ("--fps=30", "--substeps=1", "--error-bound=0")),
        *(("resolve", option) for option in ("--for-cloth", "--continuous", "--foot=a")),
        *(("resolve", option) for option in ("--clip=a", "--substeps=1", "--easing=12")),
        *(("resolve", option) for option in ("--budget=9", "--only-check")),
        *(("resolve --motion", option) for option in ("--keep-detail", "--scale=1")),
        *(("resolve --motion", option) for option in ("--like=a.glb", "--keep-clips")),
        *(("resolve --motion", option) for option in ("--format=obj", "--form=clip")),
    ],
)
def test_options_that_would_do_nothing_are_refused(
    lcollision: Lcollision, tmp_path: Path, command: str, option: str
) -> None:
    """Even if given with their default values; nothing is read or written."""
    name, *motion = command.split()
    out = () if name == "check" else ("-o", tmp_path / "out.json")
    result = lcollision(name, tmp_path / "none.glb", *motion, *out, option)
    assert result.exit_code == 2
    said = {
        "check": "is for motions; add --clips, or leave it out",
        "resolve": "needs --motion; add that, or leave it out",
        "resolve --motion": "is for poses, not for motions; leave it or --motion out",
    }
    assert result.stderr == f"lcollision: {option.partition('=')[0]} {said[command]}\n"
    assert not list(tmp_path.iterdir())
