"""Motions of every kind through the command: all frames free, everything else kept."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import open_body, read_poses
from lcollision_core.bodies.motions import read_motions
from lcollision_core.errors import CancelledError
from lcollision_core.files import write_mesh
from lcollision_core.files.character_reading import character_of_gltf
from lcollision_core.files.gltf.clips import ClipTracks
from lcollision_core.files.gltf.schema import GltfDocument
from lcollision_core.files.motion.caches import read_point_cache, write_point_cache
from lcollision_core.jobs import Job
from lcollision_core.options import MotionChoice, MotionOptions
from lcollision_core.tasks.exporting import output_named
from lcollision_core.tasks.resolving import ResolveMotionsRequest, resolve_motions
from tests.app.support import Lcollision, refusal
from tests.core.character_file import described
from tests.core.gltf_builder import GltfBuilder, arm, tube
from tests.core.motion.swings import CLIP, N_FRAMES, OTHER, swinging_body
from tests.core.motion.test_kept_contacts import with_hand_on_hip
from tests.core.vtk_gltf import vtk_corners
from tests.rigged_shapes import rigged_body, write_gltf
from tests.small_models import SHAPED

KINDS = {
    "stepped": ({}, "STEP"),
    "cubic": ({}, "CUBICSPLINE"),
    "24 a second": ({"fps": 24.0}, "LINEAR"),
    "120 a second": ({"fps": 120.0, "n_frames": 120}, "LINEAR"),
    "25 metres": ({"travel": 25.0}, "LINEAR"),
    "2 frames": ({"n_frames": 2, "begin": 0.4}, "LINEAR"),
    "150 frames": ({"n_frames": 150, "n_swings": 3}, "LINEAR"),
    "a cycle": ({"begin": 0.5}, "LINEAR"),
}
"""Arguments of `swinging_body`, and the interpolation of the keys."""


def key_times(path: Path, clip: str) -> np.ndarray:
    document = GltfDocument(path.read_bytes(), path)
    tracks = ClipTracks.of(document, clip)
    return np.unique(np.concatenate([tracks.track(*one).times for one in tracks.driven]))


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=() if kind == "2 frames" else pytest.mark.slow) for kind in KINDS],
)
def test_a_clip_of_any_kind_comes_back_free_and_whole(
    lcollision: Lcollision, tmp_path: Path, kind: str
) -> None:
    shape, interpolation = KINDS[kind]
    character = swinging_body(**shape)  # type: ignore[arg-type]
    source = write_gltf(character, tmp_path / "source.glb", interpolation)
    free = tmp_path / "free.glb"
    result = lcollision("resolve", source, "--motion", "--clip", CLIP, "-o", free, "--json")
    assert result.exit_code == 0, result.output
    (row,) = json.loads(result.stdout)
    n = len(character.sample(CLIP, None).times)
    assert row["free_before"] < row["free_after"] == row["frames"] == n
    assert row["in_between_after"] == 0
    before, after = open_body(source), open_body(free)
    (old,), (new,) = (
        read_motions(body, path, CLIP) for body, path in ((before, source), (after, free))
    )
    assert after.exact_check().are_free(new.codes).all()
    # The rate and every old key are unchanged; new keys are only at frames.
    assert new.rate == pytest.approx(shape.get("fps", 30.0), rel=1e-4)
    np.testing.assert_array_equal(new.times, old.times)
    kept, keys = key_times(source, CLIP), key_times(free, CLIP)
    assert np.isin(kept, keys).all()
    steps = np.abs(keys[:, None] - kept).min(axis=1)
    assert steps.max() < 1e-4
    changed = np.abs(new.codes - old.codes).max(axis=1) > 1e-5
    assert changed.any()
    outside = ~changed
    outside[1:] &= ~changed[:-1]
    for share in (0.0, 0.4):
        times = old.times[outside] + share / 1000.0
        pairs = (
            character_of_gltf(path.read_bytes(), path).sample(CLIP, times).vertices
            for path in (source, free)
        )
        for one, other in zip(*pairs, strict=True):
            assert np.abs(one - other).max() < 1e-5 * before.body_size
    (same,), (nod,) = (
        read_motions(body, path, OTHER) for body, path in ((after, free), (before, source))
    )
    assert same.codes.tobytes() == nod.codes.tobytes()
    # Resolving does not change the body's path.
    assert np.abs(new.codes - old.codes)[:, :3].max() < 0.03
    if kind == "25 metres":
        assert np.ptp(new.codes[:, :3], axis=0).max() * before.body_size > 20.0
    if kind == "a cycle":
        assert changed[[0, -1]].all()
    if np.array_equal(old.codes[0], old.codes[-1]):
        assert new.codes[0].tobytes() == new.codes[-1].tobytes()


def _file_of(source: Path) -> tuple[GltfBuilder, int, int]:
    """Return a file to modify, and the nodes of its body and of its left forearm."""
    builder = GltfBuilder()
    builder.description, builder.blob = described(source)
    names = [node["name"] for node in builder.description["nodes"]]
    return builder, names.index("Body"), names.index("LeftForeArm")


def _colliding(lcollision: Lcollision, path: Path, *options: str) -> dict[str, list[int]]:
    result = lcollision("check", path, "--clips", "--json", *options)
    return {
        row["clip"]: [one["frame"] for one in row["colliding_frames"]] + row["in_between"]
        for row in json.loads(result.stdout)
    }


def _of_file(path: Path, clip: str) -> list[int]:
    """Return the frames that collide in the file."""
    body = open_body(path)
    frames = body.character.sample(clip, None).skin()  # type: ignore[attr-defined]
    return np.flatnonzero(body.detector.are_colliding(frames.astype(np.float32))).tolist()


def test_the_frames_of_a_clip_are_checked_with_their_morph_targets(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    character = swinging_body(24.0, 24)
    builder, body, _ = _file_of(write_gltf(character, tmp_path / "plain.glb"))
    # One leg across the other.
    rest = character.rest_vertices
    across = np.where((rest[:, :1] < 0.0) & (rest[:, 2:] < 0.8), [[0.2, 0.0, 0.0]], 0.0)
    primitive = builder.description["meshes"][0]["primitives"][0]
    primitive["targets"] = [{"POSITION": builder.array(across)}]
    times, weights = np.arange(24) / 24.0, np.linspace(0.0, 1.0, 24)
    channel = {"node": body, "path": "weights", "times": times, "values": weights}
    builder.animation("morph", channel)
    source, out = builder.write(tmp_path / "morph.glb"), tmp_path / "out.glb"
    found = _colliding(lcollision, source, "--substeps", "0")
    assert found["morph"] == _of_file(source, "morph")
    assert 0 < len(found["morph"]) < 24
    assert found[OTHER] == []
    result = lcollision("resolve", source, "--motion", "--clip", "morph", "-o", out, "--json")
    (row,) = json.loads(result.stdout)
    assert row["free_before"] == 24 - len(found["morph"])
    left = _colliding(lcollision, out, "--clip", "morph", "--substeps", "0")
    assert left["morph"] == row["colliding_frames"]


@pytest.mark.parametrize("clearance", ["0", pytest.param("0.002", marks=pytest.mark.slow)])
def test_a_prop_that_a_clip_hides_by_its_scale_collides_in_none_of_its_frames(
    lcollision: Lcollision, tmp_path: Path, clearance: str
) -> None:
    plain = write_gltf(swinging_body(24.0, 20), tmp_path / "plain.glb")
    builder, _, forearm = _file_of(plain)
    vertices, faces = tube()
    primitive = {
        "attributes": {"POSITION": builder.array(vertices * 0.12)},
        "indices": builder.array(faces.reshape(-1), "u2"),
    }
    mesh = builder.add("meshes", name="Prop", primitives=[primitive])
    place = {"translation": [0.1, -0.18, -0.15], "scale": [0.0, 0.0, 0.0]}
    node = builder.add("nodes", name="Prop", mesh=mesh, **place)
    builder.description["nodes"][forearm]["children"].append(node)
    swing = builder.description["animations"][0]
    scale = {"node": node, "path": "scale", "times": [0.0, 0.5]}
    builder.animation("shown", scale | {"values": np.ones((2, 3))})
    builder.animation("hidden", scale | {"values": np.zeros((2, 3))})
    for animation in builder.description["animations"][2:]:
        offset = len(animation["samplers"])
        animation["samplers"] += swing["samplers"]
        animation["channels"] += [
            one | {"sampler": one["sampler"] + offset} for one in swing["channels"]
        ]
    source, out = builder.write(tmp_path / "prop.glb"), tmp_path / "out.glb"
    given = ("--clearance", clearance, "--substeps", "0")
    found = _colliding(lcollision, source, *given)
    bare = _colliding(lcollision, plain, *given)[CLIP]
    assert found["hidden"] == bare
    assert len(found["shown"]) > len(bare) > 0
    options = ("--motion", "--clip", "hidden", "-o", out, "--json", *given)
    (row,) = json.loads(lcollision("resolve", source, *options).stdout)
    assert row["free_before"] == 20 - len(bare)
    assert row["free_after"] == 20
    assert _colliding(lcollision, out, "--substeps", "0")["hidden"] == []


def test_no_frame_is_lost_to_single_precision(tmp_path: Path) -> None:
    for fps, n_frames in ((24.0, 83), (25.0, 2999), (30.0, 89), (30.0, 2998), (120.0, 1451)):
        source = write_gltf(swinging_body(fps, n_frames), tmp_path / "long.glb")
        character = open_body(source).character  # type: ignore[attr-defined]
        rate = character.rate(CLIP)
        assert rate == fps
        times = character.sample(CLIP, rate).times
        np.testing.assert_array_equal(times, (np.arange(n_frames) / fps).astype(np.float32))


def test_a_frame_that_is_no_number_is_said_in_one_sentence(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    character = swinging_body(n_frames=90)
    sound = write_gltf(character, tmp_path / "sound.glb")
    source = write_gltf(character, tmp_path / "source.glb")
    document = GltfDocument(source.read_bytes(), source)
    sampler, _ = next(iter(ClipTracks.of(document, CLIP).driven.values()))
    accessor = document.description["accessors"][sampler["output"]]
    start = document.description["bufferViews"][accessor["bufferView"]]["byteOffset"]
    keys = 20 + int.from_bytes(source.read_bytes()[12:16], "little") + 8 + start
    body = open_body(source)
    write_mesh(tmp_path / "cache.obj", body.reference, body.topology.faces)
    cache = tmp_path / "cache.pc2"
    write_point_cache(cache, character.sample(CLIP, None).vertices)
    header, a_frame = 32, 12 * body.topology.n_vertices
    for path, place in ((source, keys + 77 * 16), (cache, header + 77 * a_frame)):
        data = bytearray(path.read_bytes())
        data[place : place + 4] = np.float32(np.nan).tobytes()
        path.write_bytes(data)
    for path in (source, cache):
        result = lcollision("resolve", sound, path, "--motion", "-o", tmp_path / "free.json")
        assert result.exit_code == 2
        assert result.stderr.count("\n") == 1
        assert ("key 77" if path == source else "frame 77") in result.stderr
    assert not (tmp_path / "free.json").exists()


_STOP_IN_THE_MIDDLE = """
import os, signal, sys
from app.cli import main
from lcollision_core.tasks import progress
progress._SECONDS_BETWEEN_WRITES, progress._LARGEST_FRACTION = 0.0, 1.0
keep, at = progress.Run.keep, int(sys.argv.pop(1))
def keep_some(self, *arguments):
    keep(self, *arguments)
    if len(self.done) >= at:
        os.kill(os.getpid(), signal.SIGKILL)
progress.Run.keep = keep_some
main.main()
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
def test_a_long_motion_killed_twice_goes_on_from_its_last_span(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    source = write_gltf(swinging_body(n_frames=150, n_swings=3), tmp_path / "source.glb")
    whole, free = tmp_path / "whole.glb", tmp_path / "free.glb"
    chosen = ("--motion", "--clip", CLIP, "--easing", "4", "--workers", "1")
    result = lcollision("resolve", source, *chosen, "-o", whole)
    assert result.exit_code == 0, result.output
    command = ("resolve", source, *chosen, "-o", free)
    kept = tmp_path / "free.glb.partial.json"
    n_kept = 0
    # Break the first span, and the last.
    for at in (20, 80):
        process = subprocess.run(
            [sys.executable, "-c", _STOP_IN_THE_MIDDLE, str(at), *map(str, command)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert process.returncode == -signal.SIGKILL, process.stderr
        assert not free.exists()
        done = json.loads(kept.read_bytes())["unfinished"]["done"]
        assert n_kept < len(done) <= at
        n_kept = len(done)
    result = lcollision(*command)
    assert result.exit_code == 0, result.output
    assert f"continuing from {kept}, which has {n_kept} of 150 poses" in result.stderr
    assert free.read_bytes() == whole.read_bytes()
    assert not kept.exists()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bvh", "vrma"])
def test_a_clip_comes_back_free_as_the_motion_of_a_skeleton(
    lcollision: Lcollision, tmp_path: Path, kind: str
) -> None:
    source = write_gltf(swinging_body(fps=24.0), tmp_path / "source.glb")
    path = tmp_path / f"free.{kind}"
    said = refusal(lcollision, "resolve", source, "--motion", "-o", path)
    assert "holds one motion, but there are 2" in said
    assert not path.exists()
    result = lcollision("resolve", source, "--motion", "--clip", CLIP, "-o", path, "--json")
    assert result.exit_code == 0, result.output
    (row,) = json.loads(result.stdout)
    assert row["free_before"] < row["free_after"] == row["frames"] == N_FRAMES
    assert row["output"] == str(path)
    body = open_body(source)
    (motion,) = read_motions(body, path)
    assert len(motion) == N_FRAMES
    assert motion.rate == pytest.approx(24.0, rel=1e-5)
    assert body.exact_check().are_free(motion.codes).all()
    # And from one format to the other, by the body that plays it.
    other = tmp_path / ("other.vrma" if kind == "bvh" else "other.bvh")
    again = lcollision("resolve", source, path, "--motion", "-o", other, "--json")
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout)[0]["free_before"] == N_FRAMES
    assert len(read_motions(body, other)[0]) == N_FRAMES


@pytest.mark.slow
def test_the_check_of_what_a_skeletons_file_holds_is_cancelled(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(), tmp_path / "source.glb")
    target = output_named(str(tmp_path / "free.bvh"), of_motions=True)
    choice = MotionChoice(clip=CLIP)
    request = ResolveMotionsRequest(open_body(source), [], target, MotionOptions(), choice)

    def note(sentence: str) -> None:
        if sentence.startswith("wrote"):
            job.cancel()

    job = Job(note=note)
    with pytest.raises(CancelledError):
        resolve_motions(request, job)


def test_a_body_without_bones_of_vrm_is_refused_before_its_motion_is_resolved(
    lcollision: Lcollision, tmp_path: Path
) -> None:
    source, path = arm().write(tmp_path / "arm.glb"), tmp_path / "arm.vrma"
    result = lcollision("resolve", source, "--motion", "-o", path)
    assert result.exit_code == 2
    said = result.stderr.splitlines()[-1]
    assert "has no joint for bones that a VRM animation needs: hips, spine, head, left" in said
    assert not path.exists()


@pytest.mark.parametrize(
    "file",
    [
        pytest.param(file, id=file.stem, marks=[pytest.mark.slow] * (file.stem == "arm_morph"))
        for file in SHAPED
    ],
)
def test_what_shapes_a_frame_turns_with_its_joints_in_every_form(
    lcollision: Lcollision, tmp_path: Path, file: Path
) -> None:
    glb, cache, poses = (tmp_path / name for name in ("out.glb", "out.pc2", "out.json"))
    rows = []
    for out in (glb, cache):
        result = lcollision("resolve", file, "--motion", "-o", out, "--json")
        assert result.exit_code == 0, result.output
        rows += json.loads(result.stdout)
    assert rows[0]["free_before"] == rows[1]["free_before"] < rows[0]["frames"]
    body = open_body(file)
    (motion,) = read_motions(body, file)
    frames = read_point_cache(cache)
    for vertices, moment in zip(frames, motion.times, strict=True):
        shown = vtk_corners(glb, 0, float(moment))
        held = vertices[body.topology.faces].reshape(-1, 3)
        np.testing.assert_allclose(shown, held, atol=1e-6 * body.body_size)
    result = lcollision("resolve", file, "--motion", "-o", poses, "--json")
    # Poses contain the weights of morph targets.
    is_held = motion.space_at is None
    assert is_held == (file.stem == "arm_morph")
    left_out = f"other deformation in {motion.name} is left out"
    assert (left_out not in result.stderr) == is_held
    (row,) = json.loads(result.stdout)
    decoded = body.decode(np.array([pose.latent for pose in read_poses(poses, body)]))
    stuck = [n for n, frame in enumerate(decoded) if body.detector.detect(frame).colliding]
    assert row["colliding_frames"] == stuck
    of_form = [one["frames"] for one in row["kept_spans"] if "file format" in one["reason"]]
    assert [at for first, last in of_form for at in range(first, last + 1)] == stuck
    assert result.exit_code == (1 if stuck else 0)


@pytest.mark.slow
def test_contacts_of_another_body_are_kept_and_told(lcollision: Lcollision, tmp_path: Path) -> None:
    moves = write_gltf(with_hand_on_hip(0.13), tmp_path / "moves.glb")
    slim = write_gltf(rigged_body(girth=0.10), tmp_path / "slim.glb")
    on_slim = ("check", "--clips", moves, "--body", slim)
    (checked,) = json.loads(lcollision(*on_slim, "--json").stdout)
    assert checked["contacts"]["lost"] == [["Hips", "Left hand"]]
    assert "2 of 3 contacts kept" in lcollision(*on_slim).output
    for flag, kept in (("--keep-contacts", 3), ("--no-keep-contacts", 2)):
        path = tmp_path / f"{kept}.glb"
        output = lcollision("resolve", slim, moves, "--motion", flag, "-o", path, "--json")
        (resolved,) = json.loads(output.stdout)
        assert (len(resolved["contacts"]["kept"]), resolved["free_after"]) == (kept, 32)
        body = open_body(path)
        (back,) = read_motions(body, path, "hip")
        assert body.exact_check().are_free(back.codes).all()
