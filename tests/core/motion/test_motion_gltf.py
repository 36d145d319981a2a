"""Clips of a character's file with changed frames, as read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import RigBody
from lcollision_core.bodies.motions import read_motions
from lcollision_core.files import read_character
from lcollision_core.files.changed_clips import ChangedClip, changed_gltf
from lcollision_core.files.character_reading import character_of_gltf
from lcollision_core.files.gltf import schema
from lcollision_core.files.gltf.clips import driven_property
from lcollision_core.files.gltf.schema import GltfDocument
from tests.core.character_file import described
from tests.core.motion.swings import CLIP, N_FRAMES, OTHER, swinging_body
from tests.rigged_shapes import FloatArray, write_gltf

SPAN = range(10, 31)


def change(body: RigBody, spans: list[range]) -> tuple[ChangedClip, FloatArray]:
    """Bend the elbow and shift the body in spans of the swing; return the clip and the codes."""
    (motion,) = read_motions(body, Path(body.character.source), CLIP)
    codes, space = motion.codes.copy(), body.space
    joint = space.rig.joint_names.index("LeftForeArm")
    elbow = int(np.flatnonzero(space.joint_of_code == joint)[0])
    for span in spans:
        inside = slice(span.start, span.stop)
        codes[inside, elbow] += 0.4 * np.sin(np.linspace(0.0, np.pi, len(span)))
        codes[inside, 0] += 0.02
    changed = [frame for span in spans for frame in span]
    before, after = (
        np.array([space.transforms(row) for row in rows[changed]]) for rows in (motion.codes, codes)
    )
    return ChangedClip(CLIP, motion.times, spans, before, after), codes


@pytest.mark.parametrize("interpolation", ["LINEAR", "STEP", "CUBICSPLINE"])
@pytest.mark.parametrize("spans", [[SPAN], [range(0, 8), range(40, N_FRAMES)]])
def test_readers_get_the_new_frames_and_elsewhere_the_old_motion(
    tmp_path: Path, interpolation: str, spans: list[range]
) -> None:
    source = write_gltf(swinging_body(), tmp_path / "body.glb", interpolation)
    body = RigBody.of(read_character(source))
    changed, codes = change(body, spans)
    data = changed_gltf(body.character, [changed])
    frames = list(character_of_gltf(data, source).sample(CLIP, changed.times).vertices)
    size = body.body_size
    inside = np.concatenate([np.asarray(span) for span in spans])
    for frame in inside:
        assert np.abs(frames[frame] - body.decode(codes[frame])).max() < 1e-5 * size
    # Also between frames, except the step from the last old frame to the first new one.
    free = np.ones(N_FRAMES - 1, dtype=np.bool_)
    for span in spans:
        free[max(span.start - 1, 0) : span.stop] = False
    for share in (0.0, 0.3, 0.8):
        times = changed.times[:-1][free] + share / 30.0
        old = character_of_gltf(source.read_bytes(), source).sample(CLIP, times).vertices
        new = character_of_gltf(data, source).sample(CLIP, times).vertices
        for one, other in zip(old, new, strict=True):
            assert np.abs(one - other).max() < 1e-5 * size


def test_a_clip_that_begins_late_stays_as_long_as_it_was(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(), tmp_path / "body.glb")
    document = GltfDocument(source.read_bytes(), source).editable()
    swing = document.description["animations"][0]
    late = document.add_array(np.arange(N_FRAMES)[:, None] / 30.0 + 10.0, has_bounds=True)
    swing["samplers"] = [{**sampler, "input": late} for sampler in swing["samplers"]]
    # The change gives the elbow its first keys.
    elbow = [node.get("name") for node in document.objects("nodes")].index("LeftForeArm")
    swing["channels"] = [one for one in swing["channels"] if one["target"]["node"] != elbow]
    source.write_bytes(document.encoded())
    body = RigBody.of(read_character(source))
    changed, _ = change(body, [SPAN])
    source.write_bytes(changed_gltf(body.character, [changed]))
    times = read_character(source).sample(CLIP, 30.0).times
    np.testing.assert_array_equal(times, changed.times)
    assert times[0] == 10.0


def test_rotations_of_any_length_are_read_back_as_they_were_read(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(), tmp_path / "body.glb")
    document = GltfDocument(source.read_bytes(), source).editable()
    swing = document.description["animations"][0]
    for channel in swing["channels"]:
        if channel["target"]["path"] == "rotation":
            sampler = swing["samplers"][channel["sampler"]]
            values = document.array(sampler["output"], "a rotation", ("VEC4",)).copy()
            values[::2] *= 3.0
            values[SPAN[5]] = 0.0  # the identity
            sampler["output"] = document.add_array(values)
    source.write_bytes(document.encoded())
    body = RigBody.of(read_character(source))
    changed, codes = change(body, [SPAN])
    data = changed_gltf(body.character, [changed])
    frames = list(character_of_gltf(data, source).sample(CLIP, changed.times).vertices)
    for frame in SPAN:
        assert np.abs(frames[frame] - body.decode(codes[frame])).max() < 1e-5 * body.body_size


def test_a_joint_that_some_frames_scale_to_nothing_stays_there_and_turns_elsewhere(
    tmp_path: Path,
) -> None:
    source = write_gltf(swinging_body(), tmp_path / "body.glb")
    document = GltfDocument(source.read_bytes(), source).editable()
    elbow = [node.get("name") for node in document.objects("nodes")].index("LeftForeArm")
    scales = np.ones((N_FRAMES, 3))
    hidden = [SPAN[4], SPAN[5]]
    scales[hidden] = 0.0
    swing = document.description["animations"][0]
    times = swing["samplers"][0]["input"]
    swing["samplers"].append({"input": times, "output": document.add_array(scales)})
    target = {"node": elbow, "path": "scale"}
    swing["channels"].append({"sampler": len(swing["samplers"]) - 1, "target": target})
    source.write_bytes(document.encoded())
    body = RigBody.of(read_character(source))
    changed, codes = change(body, [SPAN])
    below = [name.startswith(("LeftForeArm", "LeftHand")) for name in body.space.rig.joint_names]
    for transforms in (changed.before, changed.after):
        transforms[np.ix_([4, 5], np.flatnonzero(below), range(3), range(3))] = 0.0
    data = changed_gltf(body.character, [changed])
    frames = list(character_of_gltf(data, source).sample(CLIP, changed.times).vertices)
    for frame in set(SPAN) - set(hidden):
        assert np.abs(frames[frame] - body.decode(codes[frame])).max() < 1e-5 * body.body_size
    assert all(np.isfinite(frames[frame]).all() for frame in hidden)


def test_what_is_changed_has_one_channel_and_no_matrix(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(), tmp_path / "body.glb")
    document = GltfDocument(source.read_bytes(), source).editable()
    swing, nodes = document.description["animations"][0], document.objects("nodes")
    elbow, root = (
        [one.get("name") for one in nodes].index(name) for name in ("LeftForeArm", "Hips")
    )
    for number in (elbow, root):
        matrix = np.eye(4)
        matrix[3, :3] = nodes[number].pop("translation")
        nodes[number]["matrix"] = matrix.ravel().tolist()
    (bent,) = (
        one for one in swing["channels"] if one["target"] == {"node": elbow, "path": "rotation"}
    )
    pointer = {"KHR_animation_pointer": {"pointer": f"/nodes/{elbow}/rotation"}}
    swing["channels"] += [bent, bent | {"target": {"path": "pointer", "extensions": pointer}}]
    source.write_bytes(document.encoded())
    body = RigBody.of(read_character(source))
    changed, codes = change(body, [SPAN])
    source.write_bytes(changed_gltf(body.character, [changed]))
    described_now = described(source)[0]
    channels, nodes = described_now["animations"][0]["channels"], described_now["nodes"]
    assert [driven_property(one) for one in channels].count((elbow, "rotation")) == 1
    assert not any("matrix" in nodes[number] for number in (elbow, root))
    again = RigBody.of(read_character(source))
    (motion,) = read_motions(again, source, CLIP)
    np.testing.assert_allclose(motion.codes, codes, atol=2e-6)


def test_a_clip_is_written_as_often_as_one_likes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = write_gltf(swinging_body(), tmp_path / "body.glb")
    counted = sum(one["count"] for one in described(source)[0]["accessors"])
    # A bound for the whole file: no element is wider than a matrix.
    monkeypatch.setattr(schema, "MAX_NUMBERS", 16 * counted)
    body = RigBody.of(read_character(source))
    changed, _ = change(body, [SPAN])
    first = changed_gltf(body.character, [changed])
    assert all(changed_gltf(body.character, [changed]) == first for _ in range(39))


def test_all_else_of_the_file_stays(tmp_path: Path) -> None:
    source = write_gltf(swinging_body(), tmp_path / "body.glb")
    body = RigBody.of(read_character(source))
    changed, codes = change(body, [SPAN])
    written = tmp_path / "changed.glb"
    written.write_bytes(changed_gltf(body.character, [changed]))
    (old, _), (new, _) = described(source), described(written)
    assert [clip["name"] for clip in new["animations"]] == [CLIP, OTHER]  # type: ignore[attr-defined,index]
    assert new["animations"][1] == old["animations"][1]  # type: ignore[index]
    for kind in ("nodes", "meshes", "skins", "scenes"):
        assert new[kind] == old[kind]
    again = RigBody.of(read_character(written))
    assert again.fingerprint == body.fingerprint
    assert dict(again.character.clips) == dict(body.character.clips)
    (motion,) = read_motions(again, written, CLIP)
    np.testing.assert_allclose(motion.codes, codes, atol=2e-6)
