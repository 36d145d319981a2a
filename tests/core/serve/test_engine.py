"""The engine as a separate process, used by the client."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Thread
from typing import Any
from unittest.mock import create_autospec

import msgspec
import numpy as np
import pytest

from lcollision_core.serve import client, session, work
from lcollision_core.serve.characters import open_arrays, open_file
from lcollision_core.serve.client import Engine, EngineCancelled, EngineError, Reply
from lcollision_core.serve.messages import Array, Check, OpenMesh
from tests.core.motion.swings import CLIP, swinging_body
from tests.core.serve.engines import ROOT, array, as_arrays, start
from tests.independent_check import crossing_pairs
from tests.rigged_shapes import FloatArray, skinned, write_gltf

BODY = swinging_body(begin=0.3)
RIG = BODY.rig
assert RIG is not None
_FRAMES = BODY.sample(CLIP, None)
assert _FRAMES.transforms is not None
TRANSFORMS, TIMES = _FRAMES.transforms, _FRAMES.times
FACES = BODY.topology.faces.astype(np.int64)
(ARM_FACES,) = (group.faces for group in BODY.groups if group.name == "LeftArm")


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    with start() as one:
        yield one


@pytest.fixture
def opened(engine: Engine) -> Reply:
    reply = engine.ask("open_mesh", **as_arrays(BODY))
    engine.ask("set_rules", character=reply["character"], rules=reply["rules"])
    return reply


def test_poses_of_a_client_s_joints_are_skinned() -> None:
    """As for `dataset make` and rule proposals."""
    fields = as_arrays(BODY) | {"poses": np.array(TRANSFORMS[:3])}
    plain = msgspec.msgpack.encode({"type": "open_mesh", "id": 0, **fields}, enc_hook=Array.of)
    message = msgspec.msgpack.decode(plain, type=OpenMesh)
    character = open_arrays(message).body.character
    frames = character.sample("poses", None)
    assert RIG is not None
    expected = [skinned(RIG, one) for one in TRANSFORMS[:3]]
    np.testing.assert_allclose(frames.vertices, expected, atol=1e-12)


def moved(transforms: FloatArray, reply: Reply) -> FloatArray:
    """Turn the joints of a (J, 4, 4) pose by a reply's turns, and return the vertices."""
    assert RIG is not None
    turns = dict(zip(array(reply["joints"]).tolist(), array(reply["turns"]), strict=True))
    placed = np.empty_like(transforms)
    for joint, parent in enumerate(RIG.parents.tolist()):
        above = (np.eye(4), np.eye(4)) if parent < 0 else (transforms[parent], placed[parent])
        own = np.linalg.inv(above[0]) @ transforms[joint]
        placed[joint] = above[1] @ own @ turns.get(joint, np.eye(4))
    return skinned(RIG, placed)


def crossing_the_arm(vertices: FloatArray) -> list[tuple[int, int]]:
    """Return the crossing pairs between the left arm and the rest.

    At rest, the arm is far from everything else, and its parent joint moves no mesh, so no rule
    excludes these pairs.
    """
    arm = set(ARM_FACES.tolist())
    return [pair for pair in crossing_pairs(vertices, FACES) if len(arm & set(pair)) == 1]


def test_a_character_is_known_by_the_hash_of_what_it_is_made_of(
    engine: Engine, opened: Reply
) -> None:
    assert opened["joints"] == list(RIG.joint_names)
    assert opened["vertices"] == len(BODY.rest_vertices)
    again = engine.ask("open_mesh", **as_arrays(BODY))
    assert again["character"] == opened["character"]
    other = as_arrays(BODY)
    other["parts"][0]["vertices"][0, 0] += 0.001
    assert engine.ask("open_mesh", **other)["character"] != opened["character"]


def in_a_thread() -> Engine:
    """Return an engine that runs in a thread of this process, and ends with the connection."""
    asked, ask = (os.fdopen(end, mode) for end, mode in zip(os.pipe(), ("rb", "wb"), strict=True))
    told, tell = (os.fdopen(end, mode) for end, mode in zip(os.pipe(), ("rb", "wb"), strict=True))

    def answer() -> None:
        with asked, tell:
            session.Session(asked, tell).run()

    answering = Thread(target=answer)
    answering.start()
    return Engine(told, ask, lambda _: answering.join())


def test_a_character_that_is_open_is_not_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    made = create_autospec(session.open_arrays, side_effect=session.open_arrays)
    monkeypatch.setattr(session, "open_arrays", made)
    with in_a_thread() as one:
        first, second = (one.ask("open_mesh", **as_arrays(BODY)) for _ in range(2))
        assert made.call_count == 1
        one.ask("close", character=first["character"])
        third = one.ask("open_mesh", **as_arrays(BODY))
        assert {**third, "id": 0} == {**second, "id": 0}
        assert made.call_count == 2


def test_seams_are_joined_and_faces_keep_the_numbers_of_the_client(
    engine: Engine, opened: Reply
) -> None:
    fields = as_arrays(BODY)
    (part,) = fields["parts"]
    corners = part["faces"].ravel()
    for name in ("vertices", "joint_of", "weights"):
        part[name] = np.ascontiguousarray(part[name][corners])
    part["faces"] = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    split = engine.ask("open_mesh", **fields)
    assert (split["vertices"], split["joined_vertices"]) == (len(corners), opened["vertices"])
    whole, apart = (
        engine.ask("check", character=one["character"], transforms=TRANSFORMS[20])
        for one in (opened, split)
    )
    assert whole["pairs"] > 0
    assert {tuple(sorted(pair)) for pair in array(whole["faces"]).tolist()} == {
        tuple(sorted(pair)) for pair in array(apart["faces"]).tolist()
    }


def test_a_pose_is_checked_by_its_joints_or_as_it_is_shown(engine: Engine, opened: Reply) -> None:
    colliding = {"character": opened["character"], "transforms": TRANSFORMS[20]}
    by_joints = engine.ask("check", **colliding)
    assert by_joints["colliding"]
    assert by_joints["parts"][0][1] == "Left upper arm" or "Left" in str(by_joints["parts"])
    assert 0.0 < by_joints["deepest"] < 0.1
    shown = skinned(RIG, TRANSFORMS[20])
    pairs = {tuple(sorted(pair)) for pair in array(by_joints["faces"]).tolist()}
    assert pairs <= crossing_pairs(shown, FACES)
    by_vertices = engine.ask("check", vertices=shown, **colliding)
    assert by_vertices["pairs"] == by_joints["pairs"]
    assert by_vertices["off_rig"] < 1e-12
    free = engine.ask("check", vertices=np.array(BODY.rest_vertices), **colliding)
    assert (free["colliding"], free["pairs"]) == (False, 0)
    assert free["off_rig"] > 0.1


def test_the_way_to_a_pose_is_checked_as_well(engine: Engine, opened: Reply) -> None:
    def touches(before: FloatArray) -> bool:
        asked = {"character": opened["character"], "vertices": rest, "before": before}
        reply = engine.ask("check", **asked)
        assert not reply["colliding"]
        found: bool = reply["touches_between"]
        return found

    rest = np.array(BODY.rest_vertices)
    # An arm passes through the trunk from far on the other side.
    across, arm = rest.copy(), np.unique(FACES[ARM_FACES])
    across[arm] += np.array([-3.0, 0.0, 0.0]) * np.ptp(rest, axis=0).max()
    assert touches(across)
    assert not touches(rest + [0.1, 0.2, 0.3])


def test_a_quick_check_leaves_out_what_does_not_count(engine: Engine, opened: Reply) -> None:
    character, left = opened["character"], ["Left upper arm", "Left forearm", "Left hand"]
    asked = {"character": character, "transforms": TRANSFORMS[20], "clearance": 0.01}
    whole, quick = (engine.ask("check", counted_only=only, **asked) for only in (False, True))
    assert whole["pairs"] > 0
    assert whole["least_distance"] is not None
    assert quick["least_distance"] is None
    for told in ("pairs", "deepest", "parts"):
        assert quick[told] == whole[told]
    rules = {**opened["rules"], "left_out": [name for name in opened["parts"] if name in left]}
    engine.ask("set_rules", character=character, rules=rules)
    whole, quick = (engine.ask("check", counted_only=only, **asked) for only in (False, True))
    assert sum(whole["excluded_pairs"].values()) > 0
    assert sum(quick["excluded_pairs"].values()) == 0
    engine.ask("set_rules", character=character, rules=opened["rules"])


def test_the_deepest_pair_may_be_one_that_is_not_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    character = open_file(str(write_gltf(swinging_body(), tmp_path / "body.glb")))
    request = Check(id=0, character="", transforms=Array.of(TRANSFORMS[20]))
    whole = work.check_pose(character, request)
    monkeypatch.setattr(work, "MOST_PAIRS", int(whole["depths"].argmax()))
    part = work.check_pose(character, request)
    assert len(part["depths"]) < len(whole["depths"]) == part["pairs"]
    for told in ("deepest", "parts"):
        assert part[told] == whole[told]


def test_a_resolved_pose_is_free_by_an_independent_check(engine: Engine, opened: Reply) -> None:
    pose = TRANSFORMS[20]
    reply = engine.ask("resolve_pose", character=opened["character"], transforms=pose)
    assert reply["free"]
    assert reply["pairs_before"] > 0
    vertices = moved(pose, reply)
    counted = engine.ask("check", character=opened["character"], vertices=vertices)
    assert not counted["colliding"]
    assert not crossing_the_arm(vertices)
    assert crossing_the_arm(skinned(RIG, pose))


def test_locked_joints_do_not_turn(engine: Engine, opened: Reply) -> None:
    reply = engine.ask(
        "resolve_pose",
        character=opened["character"],
        transforms=TRANSFORMS[20],
        locked=["Spine", "Hips"],
    )
    turned = {opened["joints"][joint] for joint in array(reply["joints"]).tolist()}
    assert reply["free"]
    assert "LeftArm" in turned
    assert "Spine" not in turned


@pytest.mark.slow
def test_joints_turn_alone_if_they_are_said_to(engine: Engine, opened: Reply) -> None:
    asked = {"character": opened["character"], "turning": ["LeftArm"]}
    reply = engine.ask("resolve_pose", transforms=TRANSFORMS[20], **asked)
    motion = engine.ask("resolve_motion", transforms=TRANSFORMS, times=TIMES, **asked)
    for one in (reply, motion):
        turned = {opened["joints"][joint] for joint in array(one["joints"]).tolist()}
        assert turned == {"LeftArm"}
    # Frames that the forearm alone cannot free stay unchanged, and are named.
    asked["turning"] = ["LeftForeArm"]
    stays = engine.ask("resolve_motion", transforms=TRANSFORMS, times=TIMES, **asked)
    assert (len(array(stays["joints"])), stays["spans"]) == (0, [])
    assert [one["unchanged"] for one in stays["kept"]] == [True]
    with pytest.raises(EngineError, match="no joint 'Tail'"):
        engine.ask("resolve_pose", **{**asked, "transforms": TRANSFORMS[20], "turning": ["Tail"]})


def test_notes_are_for_those_who_pose_bones(engine: Engine, opened: Reply) -> None:
    far = TRANSFORMS[20].copy()
    far[:, :3, 3] += 100.0
    reply = engine.ask("resolve_pose", character=opened["character"], transforms=far)
    assert "of the pose are outside their usual range" in reply["note"]
    assert not re.search(r"slider|trained|\bmodel\b", reply["note"])


def test_feet_that_stand_stay_where_they_are_in_a_pose(engine: Engine, opened: Reply) -> None:
    pose = TRANSFORMS[20]
    asked = {"character": opened["character"], "transforms": pose, "clearance": 0.05}
    before = skinned(RIG, pose)
    low = before[:, 2] < before[:, 2].min() + 0.02
    slipped = []
    for keep in (False, True):
        reply = engine.ask("resolve_pose", keep_feet=keep, **asked)
        assert reply["free"]
        after = moved(pose, reply)
        slipped.append(np.linalg.norm((after - before)[low], axis=1).max())
    assert slipped[1] < 0.1 * slipped[0]


def test_places_that_touch_in_nearly_every_pose_are_proposed_and_left_out(
    engine: Engine, opened: Reply
) -> None:
    character = opened["character"]
    # The arm is in the trunk in all of these poses, at about the same place.
    shown = np.array([skinned(RIG, TRANSFORMS[20]) for _ in range(8)])
    reply = engine.ask("propose_rules", character=character, vertices=shown)
    assert (reply["poses"], reply["colliding"], reply["colliding_then"]) == (8, 8, 0)
    assert sum(n for *_, n in reply["places"]) == len(reply["touching"]) > 0
    assert len(array(reply["faces"])) > 0
    found = {name: reply[name] for name in ("touching", "touching_radius")}
    engine.ask("set_rules", character=character, rules={**opened["rules"], **found})
    assert not engine.ask("check", character=character, vertices=shown[0])["colliding"]
    free = np.array([BODY.rest_vertices for _ in range(8)])
    engine.ask("set_rules", character=character, rules=opened["rules"])
    free_of = engine.ask("propose_rules", character=character, vertices=free)
    assert free_of["touching"] == []


def test_a_clearance_is_checked_and_kept_by_poses_and_motions(
    engine: Engine, opened: Reply
) -> None:
    asked = {"character": opened["character"], "clearance": 0.01}
    plain = {"character": opened["character"], "transforms": TRANSFORMS[20]}
    assert engine.ask("check", **plain)["least_distance"] is None
    loose, kept = (engine.ask("resolve_pose", **{**plain, **more}) for more in ({}, asked))
    assert loose["free"]
    assert kept["free"]
    assert kept["largest_change"] > loose["largest_change"]
    near, far = (
        engine.ask("check", vertices=moved(TRANSFORMS[20], one), **asked) for one in (loose, kept)
    )
    assert near["colliding"]
    assert 0.0 < near["deepest"] <= 0.01
    assert 0.0 <= near["least_distance"] < 0.01
    assert not far["colliding"]
    assert far["pairs"] == 0
    assert far["least_distance"] is None or far["least_distance"] > near["least_distance"]
    motion = {"transforms": TRANSFORMS, "times": TIMES}
    free = engine.ask("resolve_motion", **asked, **motion)
    assert (free["free_after"], free["in_between"]) == (len(TIMES), [])
    assert free["least_distance"] is None or free["least_distance"] >= 0.0
    with pytest.raises(EngineError, match="clearance"):
        engine.ask("check", **{**plain, "clearance": 1.0})


def test_a_resolved_motion_changes_its_spans_alone_and_is_free(
    engine: Engine, opened: Reply
) -> None:
    told: list[tuple[int, int]] = []
    reply = engine.ask(
        "resolve_motion",
        character=opened["character"],
        transforms=TRANSFORMS,
        times=TIMES,
        progress=lambda done, total: told.append((done, total)),
    )
    n = len(TIMES)
    assert 0 < reply["free_before"] < n
    assert (reply["free_after"], reply["in_between"]) == (n, [])
    assert told
    assert all(done <= total for done, total in told)
    frames = [frame for start, stop in reply["spans"] for frame in range(start, stop)]
    joints, turns = array(reply["joints"]), array(reply["turns"])
    assert len(turns) == len(frames)
    for frame, of_frame in zip(frames, turns, strict=True):
        one = {"joints": reply["joints"], "turns": {**reply["turns"]}}
        one["turns"] = {"dtype": "<f8", "shape": of_frame.shape, "data": of_frame.tobytes()}
        vertices = moved(TRANSFORMS[frame], one)
        assert not crossing_the_arm(vertices), frame
    assert len(joints) > 0


@pytest.mark.variants
@pytest.mark.parametrize(
    ("kind", "pose"),
    [
        ("resolve_pose", {"transforms": TRANSFORMS[20]}),
        ("resolve_motion", {"transforms": TRANSFORMS, "times": TIMES}),
    ],
    ids=["pose", "motion"],
)
def test_joints_that_hardly_turn_stay_where_that_makes_nothing_worse(
    engine: Engine, opened: Reply, kind: str, pose: dict[str, Any]
) -> None:
    asked = {"character": opened["character"], "keep_feet": False}
    least = 3e-3
    every = engine.ask(kind, **asked, **pose)
    fewer = engine.ask(kind, **asked, **pose, least_change=least)
    joints = [set(array(one["joints"]).tolist()) for one in (every, fewer)]
    assert joints[1] < joints[0]
    if kind == "resolve_pose":
        assert fewer["free"]
        frames = [(TRANSFORMS[20], every, fewer)]
    else:
        assert fewer["free_after"] == every["free_after"] == len(TIMES)
        assert fewer["spans"] == every["spans"]
        numbers = [frame for span in every["spans"] for frame in range(*span)]
        frames = [
            (
                TRANSFORMS[frame],
                *({**one, "turns": of_frame(one, row)} for one in (every, fewer)),
            )
            for row, frame in enumerate(numbers)
        ]
    for before, one, other in frames:
        off = np.linalg.norm(moved(before, one) - moved(before, other), axis=1).max()
        assert off <= 1.001 * least * opened["body_size"]


def of_frame(reply: Reply, row: int) -> Any:
    """Return the turns of one frame of a reply."""
    turns = np.ascontiguousarray(array(reply["turns"])[row])
    return {"dtype": "<f8", "shape": turns.shape, "data": turns.tobytes()}


def test_what_the_joints_do_not_hold_of_a_mesh_is_carried_along(
    engine: Engine, opened: Reply
) -> None:
    pose = TRANSFORMS[20]
    thicker = skinned(RIG, pose)
    arm = np.unique(FACES[ARM_FACES])
    thicker[arm] = thicker[arm].mean(axis=0) + 1.02 * (thicker[arm] - thicker[arm].mean(axis=0))
    asked = {"character": opened["character"], "transforms": pose, "vertices": thicker}
    assert engine.ask("check", **asked)["off_rig"] > 1e-3
    reply = engine.ask("resolve_pose", **asked)
    assert reply["free"]
    assert reply["pairs_before"] == engine.ask("check", **asked)["pairs"]


def test_rules_are_set_and_hold_for_what_follows(engine: Engine, opened: Reply) -> None:
    character = opened["character"]
    groups = engine.ask("rules", character=character)["groups"]["body parts"]
    assert {"Torso", "Left upper arm"} <= set(groups)
    asked = {"character": character, "transforms": TRANSFORMS[20]}
    left_out = [name for name in groups if name.startswith("Left")]
    rules = {**opened["rules"], "left_out": left_out}
    # Sent together, each check has the rules set before it.
    before = engine.send("check", **asked)
    reply = engine.send("set_rules", character=character, rules=rules)
    after = engine.send("check", **asked)
    assert before.result()["colliding"]
    assert reply.result()["in_words"].startswith("with")
    assert not after.result()["colliding"]
    with pytest.raises(EngineError, match="nowhere"):
        engine.ask("set_rules", character=character, rules={"left_out": ["nowhere"]})


def test_a_drag_pulls_a_vertex_to_a_place_and_stays_free(engine: Engine, opened: Reply) -> None:
    # Other poses collide unless a test before this one has changed the rules.
    pose, character = RIG.rest, opened["character"]
    vertices = skinned(RIG, pose)
    hand = int(vertices[:, 0].argmax())
    target = vertices[hand] + [-0.1, -0.1, 0.0]
    reply = engine.ask("drag", character=character, transforms=pose, vertex=hand, target=target)
    misses = [reply["miss"]]
    # An event ends after a few milliseconds: on a busy machine, more of them are needed.
    while not reply["settled"] and len(misses) < 200:
        reply = engine.ask("drag", character=character, target=target)
        misses.append(reply["miss"])
    assert misses[-1] < 0.25 * np.linalg.norm([0.1, 0.1])
    assert reply["free"]
    after = moved(pose, reply)
    assert np.linalg.norm(after[hand] - target) < np.linalg.norm(vertices[hand] - target)


def test_a_file_is_opened_as_well(engine: Engine, tmp_path: Path) -> None:
    path = write_gltf(swinging_body(), tmp_path / "body.glb")
    opened = engine.ask("open", file=str(path))
    assert len(opened["joints"]) == len(RIG.joint_names)
    assert not engine.ask("check", character=opened["character"], vertices=rest_of(path))["pairs"]
    engine.ask("close", character=opened["character"])
    with pytest.raises(EngineError, match=r"no character '\w+' is open; open it"):
        engine.ask("rules", character=opened["character"])
    with pytest.raises(EngineError, match=r"nowhere\.glb cannot be read"):
        engine.ask("open", file="nowhere.glb")


def rest_of(path: Path) -> FloatArray:
    from lcollision_core.files.scene.joined import join_parts
    from lcollision_core.files.scene_files import read_scene

    scene = read_scene(path)
    mesh = join_parts(scene)
    return mesh.posed(scene.rest)[0][mesh.joined]


def test_a_request_is_cancelled_and_the_engine_goes_on(engine: Engine, opened: Reply) -> None:
    n = 10
    request, waiting = (
        engine.send(
            "resolve_motion",
            character=opened["character"],
            transforms=np.tile(TRANSFORMS, (n, 1, 1, 1)),
            times=np.arange(n * len(TIMES)) / 30.0,
        )
        for _ in range(2)
    )
    # Checks do not queue behind it.
    assert engine.ask("check", character=opened["character"], transforms=TRANSFORMS[0])
    assert not request.is_done
    engine.cancel(waiting)
    engine.cancel(request)
    for one in (request, waiting):
        with pytest.raises(EngineCancelled):
            one.result(60.0)
    assert engine.ask("check", character=opened["character"], transforms=TRANSFORMS[0])


def test_the_end_of_the_input_ends_the_process() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "app", "serve"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    )
    out, errors = process.communicate(b"", timeout=60.0)
    assert (process.returncode, out, errors) == (0, b"", b"")


def test_an_engine_that_is_gone_is_said(tmp_path: Path) -> None:
    engine = start()
    engine.close()
    with pytest.raises(EngineError, match="gone"):
        engine.ask("rules", character="")
    with pytest.raises(EngineError, match="cannot start"):
        Engine.start([str(tmp_path / "python")])


def test_what_waits_for_an_engine_that_is_ended_is_told_so() -> None:
    one = in_a_thread()
    opened = one.ask("open_mesh", **as_arrays(BODY))
    n = 10
    request = one.send(
        "resolve_motion",
        character=opened["character"],
        transforms=np.tile(TRANSFORMS, (n, 1, 1, 1)),
        times=np.arange(n * len(TIMES)) / 30.0,
    )
    # The engine cancels its work when its input ends, without a cancel request.
    one.close(0.0)
    with pytest.raises(EngineError, match=r"^the engine is gone$"):
        request.result(60.0)


def test_a_message_that_is_too_long_is_refused_and_the_conversation_goes_on(
    engine: Engine, opened: Reply, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = {"character": opened["character"], "transforms": TRANSFORMS, "times": TIMES}
    with monkeypatch.context() as patch:
        patch.setattr(client, "_MAX_LENGTH", 1 << 12)
        with pytest.raises(EngineError, match="fewer frames at once, or subdivide"):
            engine.send("resolve_motion", **asked)
    assert engine.ask("rules", character=opened["character"])


_TALKS = """
import os, struct, sys, time, msgpack
from pathlib import Path
def read():
    head = sys.stdin.buffer.read(8)
    if head:
        return msgpack.unpackb(sys.stdin.buffer.read(struct.unpack("<I", head[4:])[0]))
def say(**values):
    data = msgpack.packb(values)
    sys.stdout.buffer.write(b"LCM1" + struct.pack("<I", len(data)) + data)
    sys.stdout.buffer.flush()
hello = read()
"""
_ODDLY = """
say(type="hello", id=hello["id"])
if read():
    say(type="error", id=None, message="a message must be shorter")
    read()
time.sleep(20.0)
Path(sys.argv[1]).touch()
"""
_DEAFLY = """
os.close(0)
say(type="hello", id=hello["id"])
time.sleep(20.0)
"""


@pytest.mark.slow
def test_an_engine_that_reads_no_more_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "_PATIENCE", 0.2)
    with (
        Engine.start([sys.executable, "-c", _TALKS + _DEAFLY]) as engine,
        pytest.raises(EngineError, match=r"^the engine is gone$"),
    ):
        engine.ask("rules", character="")


@pytest.mark.slow
def test_an_error_of_nobody_knows_which_request_is_told_to_all_and_a_hung_engine_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "_PATIENCE", 0.2)
    ended = tmp_path / "ended"
    engine = Engine.start([sys.executable, "-c", _TALKS + _ODDLY, str(ended)])
    request = engine.send("rules", character="")
    with pytest.raises(EngineError, match="a message must be shorter"):
        request.result(60.0)
    assert engine.is_alive
    engine.close()
    assert not ended.exists()


@pytest.mark.slow
def test_a_stopped_engine_is_ended_though_more_is_sent_than_its_pipe_holds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    processes: list[subprocess.Popen[bytes]] = []
    popen = subprocess.Popen

    def started(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        processes.append(popen(*arguments, **options))
        return processes[-1]

    monkeypatch.setattr(client.subprocess, "Popen", started)
    monkeypatch.setattr(client, "_SILENCE", 1.0)
    with start() as engine:
        # It answers other requests meanwhile, so a long request does not count as hung.
        opened = engine.ask("open_mesh", **as_arrays(BODY))
        asked = {"character": opened["character"], "times": np.arange(10 * len(TIMES)) / 30.0}
        moving = np.tile(TRANSFORMS, (10, 1, 1, 1))
        request = engine.send("resolve_motion", transforms=moving, **asked)
        assert engine.ask("check", character=opened["character"], transforms=TRANSFORMS[0])
        processes[0].send_signal(signal.SIGSTOP)
        requests = [engine.send("resolve_motion", transforms=moving, **asked) for _ in range(3)]
        for one in (request, *requests):
            with pytest.raises(EngineError, match="did not answer and was ended; try again"):
                one.result(60.0)
        assert not engine.is_alive
    assert processes[0].returncode == -signal.SIGKILL
