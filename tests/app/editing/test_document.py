"""The document: undo restores every change exactly, and files contain the pose on the screen."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from app.editing.document import PoseDocument
from app.work.frames import FrameEvaluator, keep_torch_to_one_thread
from app.work.threads import Failure
from lcollision_core.bodies import (
    Body,
    LearnedBody,
    NamedPose,
    read_poses,
    write_poses,
)
from lcollision_core.errors import ModelFileError
from lcollision_core.files import read_mesh, write_mesh
from lcollision_core.meshes import RigidTransform
from lcollision_core.tasks.words import counted
from tests.app.support import export_pose
from tests.bending_tube import LENGTH_IN_FILES, RADIUS, SIDES

QUARTER_TURN = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5.0, -3.0, 2.0])
)


def settle(qtbot: QtBot, document: PoseDocument) -> None:
    """Wait until the frame and the verdict belong to the pose."""
    qtbot.waitUntil(lambda: document.motion.exact is not None and not document.tasks.busy)
    assert document.motion.frame is not None
    assert document.motion.frame.latent.tobytes() == document.history.latent.tobytes()


def resolve(qtbot: QtBot, document: PoseDocument) -> None:
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=20_000):
        document.tasks.resolve()


def test_the_frame_is_what_the_model_decodes_and_predicts(
    qtbot: QtBot, document: PoseDocument, colliding: np.ndarray
) -> None:
    document.motion.blend_towards(colliding, 1.0)
    settle(qtbot, document)
    frame, exact, model = document.motion.frame, document.motion.exact, document.model
    assert frame is not None
    assert exact is not None
    assert frame.prediction is not None
    assert (frame.vertices == model.decode(colliding).astype(np.float32)).all()
    # In a thread like the live one: torch's sums depend on the number of threads.
    with ThreadPoolExecutor(1, "one", keep_torch_to_one_thread, (model,)) as pool:
        predicted = pool.submit(model.predict, colliding).result()
    assert frame.prediction.collision_probability == predicted.collision_probability[0]
    assert (frame.prediction.domain_energy == predicted.domain_energy[0]).all()
    found = model.detector.detect(frame.vertices)
    assert exact.colliding
    assert (exact.pairs == found.pairs).all()
    assert exact.energy == found.energy > 0.0
    resting = document.motion.resting
    assert resting is None or resting.is_checked


def test_normals_of_a_straight_tube_point_away_from_it(editor_model: LearnedBody) -> None:
    straight = editor_model.reference.astype(np.float32)
    normals = FrameEvaluator(editor_model).normals(straight)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(normals[-2:], [[0, -1, 0], [0, 1, 0]], atol=1e-5)
    inner = slice(SIDES, -2 - SIDES)
    walls = straight[inner] - straight[-2] * [1, 0, 1]
    outward = walls * [1, 0, 1] / (RADIUS * LENGTH_IN_FILES)
    np.testing.assert_allclose(normals[inner], outward, atol=1e-4)


def test_a_drag_is_one_step_and_undo_is_exact(document: PoseDocument) -> None:
    before = document.history.latent.tobytes()
    document.motion.begin_gesture("Drag")
    for value in np.linspace(0.1, 1.0, 20):
        document.motion.set_code(2, value)
        assert document.history.latent[2] == value
    assert document.history.modified
    document.motion.end_gesture()
    after = document.history.latent.tobytes()
    assert document.history.undo_stack.count() == 1
    document.history.undo()
    assert document.history.latent.tobytes() == before
    assert not document.history.modified
    document.history.redo()
    assert document.history.latent.tobytes() == after


def test_a_drag_that_ends_where_it_began_is_no_step(document: PoseDocument) -> None:
    document.motion.begin_gesture("Drag")
    document.motion.set_code(0, 1.0)
    document.motion.set_code(0, 0.0)
    document.motion.end_gesture()
    assert document.history.undo_stack.count() == 0
    assert not document.history.modified


def test_escape_takes_a_drag_back(document: PoseDocument) -> None:
    document.motion.begin_gesture("Drag")
    document.motion.set_code(0, 1.0)
    document.motion.cancel_gesture()
    assert document.history.latent[0] == 0.0
    assert document.history.undo_stack.count() == 0
    assert not document.history.modified


def test_undo_within_a_drag_takes_the_drag_back(document: PoseDocument) -> None:
    document.motion.set_code(0, 1.0)
    document.motion.begin_gesture("Drag")
    document.motion.set_code(1, 1.0)
    document.history.undo()
    assert document.history.latent[:2].tolist() == [1.0, 0.0]
    document.history.undo()
    assert document.history.latent[:2].tolist() == [0.0, 0.0]
    document.history.redo()
    document.history.redo()
    assert document.history.latent[:2].tolist() == [1.0, 1.0]


def test_a_new_pose_is_the_reference(document: PoseDocument) -> None:
    document.new_pose()
    assert document.history.latent.any()
    assert np.array_equal(document.history.latent, document.model.known_poses[0])
    assert document.history.undo_stack.count() == 0


def test_steps_on_one_slider_merge_and_vanish_at_their_start(document: PoseDocument) -> None:
    for value in (0.1, 0.2, 0.3):
        document.motion.set_code(0, value)
    assert document.history.undo_stack.count() == 1
    document.motion.set_code(1, 0.1)
    assert document.history.undo_stack.count() == 2
    document.motion.set_code(1, 0.0)
    assert document.history.undo_stack.count() == 1
    document.history.undo()
    assert not document.history.latent.any()


def test_steps_a_while_apart_do_not_merge(
    document: PoseDocument, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr("app.editing.history.time.monotonic", lambda: now[0])
    document.motion.set_code(0, 0.1)
    now[0] += 1.5
    document.motion.set_code(0, 0.2)
    assert document.history.undo_stack.count() == 2


def test_what_arrives_in_mid_drag_is_a_step_after_the_drag(
    qtbot: QtBot, document: PoseDocument, colliding: np.ndarray, tmp_path: Path
) -> None:
    model = document.model
    write_mesh(tmp_path / "bent.ply", model.decode(model.known_poses[1]), model.faces)
    with qtbot.waitSignal(document.message, timeout=20_000):
        document.tasks.import_mesh(tmp_path / "bent.ply")
        document.motion.begin_gesture("Drag")
        document.motion.set_code(0, 0.5)
    document.motion.end_gesture()
    document.history.undo()
    assert document.history.latent.tolist() == [0.5, *[0.0] * (model.latent_size - 1)]
    document.motion.blend_towards(colliding, 1.0)
    with qtbot.waitSignal(document.tasks.solve_finished, timeout=20_000):
        document.tasks.resolve()
        document.motion.begin_gesture("Drag")
    solved = document.history.latent
    document.motion.set_code(0, 1.25)
    document.motion.end_gesture()
    document.history.undo()
    assert document.history.latent.tobytes() == solved.tobytes()
    document.history.undo()
    assert document.history.latent.tobytes() == colliding.tobytes()


def test_a_number_that_is_not_finite_is_ignored(document: PoseDocument) -> None:
    document.motion.set_code(0, float("nan"))
    assert document.history.undo_stack.count() == 0
    assert not document.history.latent.any()


def test_randomise_repeats_itself_and_spares_what_is_locked(document: PoseDocument) -> None:
    space = document.model.latent_space
    document.motion.set_locked(1, True)
    document.motion.randomise(1.0, 7)
    drawn = space.sample(1, np.random.default_rng(7))[0]
    locked = np.zeros(len(drawn), dtype=bool)
    locked[space.groups[2].codes] = True
    locked[1] = True
    assert (document.history.latent[~locked] == drawn[~locked]).all()
    assert not document.history.latent[locked].any()
    document.history.undo()
    document.motion.randomise(0.0, 7)
    assert not document.history.latent.any()


def test_blending_starts_from_where_the_hand_took_hold(document: PoseDocument) -> None:
    target = document.model.known_poses[3]
    document.motion.set_code(0, 0.5)
    start = document.history.latent.copy()
    document.motion.begin_gesture("Blend")
    for share in (0.2, 0.9, 0.5):
        document.motion.blend_towards(target, share)
    np.testing.assert_allclose(
        document.history.latent, 0.5 * (start + target), rtol=1e-12, atol=1e-12
    )
    document.motion.blend_towards(target, 1.0)
    assert (document.history.latent == target).all()
    document.motion.end_gesture()
    document.history.undo()
    assert (document.history.latent == start).all()


def test_resolve_is_one_step_that_is_never_solved_again(
    qtbot: QtBot, document: PoseDocument, colliding: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    document.motion.blend_towards(colliding, 1.0)
    settle(qtbot, document)
    old_mesh = document.motion.frame.vertices if document.motion.frame else None
    assert old_mesh is not None
    resolve(qtbot, document)
    outcome = document.history.state.outcome
    assert outcome is not None
    assert outcome.exactly_free
    solved = document.history.latent.tobytes()
    settle(qtbot, document)
    assert document.motion.exact is not None
    assert not document.motion.exact.colliding
    assert document.history.ghost is not None
    assert (document.history.ghost == old_mesh).all()
    document.history.show_ghost(False)
    assert document.history.ghost is None
    monkeypatch.delattr(Body, "resolve")
    document.history.undo()
    assert document.history.latent.tobytes() == colliding.tobytes()
    assert document.history.state.outcome is None
    settle(qtbot, document)
    assert document.motion.frame is not None
    assert document.motion.frame.vertices.tobytes() == old_mesh.tobytes()
    document.history.redo()
    assert document.history.latent.tobytes() == solved
    assert document.history.state.outcome is outcome


def test_resolve_leaves_locked_domains(
    qtbot: QtBot, document: PoseDocument, colliding: np.ndarray
) -> None:
    document.motion.blend_towards(colliding, 1.0)
    document.motion.set_locked(1, True)
    resolve(qtbot, document)
    codes = document.model.latent_space.groups[2].codes
    assert (document.history.latent[codes] == colliding[codes]).all()
    assert document.history.latent[1] == colliding[1]
    assert document.history.latent[0] != colliding[0]


def test_saving_clears_the_mark_and_undo_brings_it_back(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    path = tmp_path / "poses.json"
    with pytest.raises(ModelFileError, match="save it under a name"):
        document.tasks.save()
    document.motion.set_code(0, 0.25)
    with qtbot.waitSignal(document.history.modified_changed, check_params_cb=lambda on: not on):
        document.tasks.save(path)
    assert document.history.file == path
    document.history.undo()
    assert document.history.modified
    document.history.redo()
    assert not document.history.modified
    (saved,) = read_poses(path, document.model)
    assert saved.latent.tobytes() == document.history.latent.tobytes()
    assert saved.name == document.history.pose.name == "poses"


@pytest.mark.parametrize("may", [False, True])
def test_edits_made_while_a_file_is_read_are_not_replaced_unasked(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, may: bool
) -> None:
    path = tmp_path / "pose.json"
    write_poses(path, document.model, [NamedPose("a", document.model.known_poses[1])])
    asked = []

    def answer() -> bool:
        asked.append(document.history.latent[0])
        return may

    document.tasks.may_replace = answer
    document.tasks.open_poses(path)
    document.motion.set_code(0, 0.5)
    qtbot.waitUntil(lambda: not document.tasks.busy)
    assert asked == [0.5]
    assert (document.history.pose.name == "a") == may
    document.history.undo()
    assert document.history.latent.any() == may
    document.tasks.open_poses(path)
    qtbot.waitUntil(lambda: not document.tasks.busy)
    assert len(asked) == 1
    assert document.history.pose.name == "a"


def test_open_replaces_the_pose_the_library_and_the_history(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    path = tmp_path / "two.json"
    latent = document.model.known_poses
    poses = [NamedPose("a", latent[1], QUARTER_TURN), NamedPose("b", latent[2])]
    write_poses(path, document.model, poses)
    document.motion.set_code(0, 0.5)
    with qtbot.waitSignal(document.message):
        document.tasks.open_poses(path)
    assert [pose.name for pose in document.history.file_poses] == ["a", "b"]
    assert (document.history.latent == latent[1]).all()
    assert document.history.pose.name == "a"
    assert document.history.pose.placement is not None
    assert not document.history.modified
    assert document.history.undo_stack.count() == 0


def test_garbage_is_refused_in_a_sentence_and_changes_nothing(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    garbage = tmp_path / "garbage.json"
    garbage.write_bytes(b"\x00\xff not a pose")
    mesh = tmp_path / "garbage.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    state = document.history.latent
    for act in (
        lambda: document.tasks.open_poses(garbage),
        lambda: document.tasks.import_mesh(mesh),
        lambda: document.tasks.open_model(tmp_path / "none.safetensors"),
        lambda: export_pose(document, tmp_path / "mesh.xyz"),
    ):
        failure = failure_of(qtbot, document, act)
        assert "\n" not in failure.headline + failure.next_step
        assert "Traceback" in failure.details
    assert document.history.latent is state
    assert not document.history.modified


def failure_of(qtbot: QtBot, document: PoseDocument, act: Callable[[], None]) -> Failure:
    with qtbot.waitSignal(document.failed) as caught:
        act()
    assert caught.args is not None
    (failure,) = caught.args
    assert isinstance(failure, Failure)
    return failure


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".glb"])
def test_an_exported_mesh_is_the_one_on_the_screen_in_its_place(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path, suffix: str
) -> None:
    pose = NamedPose("placed", document.model.known_poses[4], QUARTER_TURN)
    document.motion.load_pose(pose)
    settle(qtbot, document)
    path = tmp_path / f"placed{suffix}"
    with qtbot.waitSignal(document.message):
        export_pose(document, path)
    assert document.motion.frame is not None
    placed = QUARTER_TURN.apply(document.motion.frame.vertices).astype(np.float32)
    mesh = read_mesh(path)
    assert (mesh.vertices.astype(np.float32)[mesh.faces] == placed[document.model.faces]).all()


def test_an_export_says_whether_the_mesh_collides(
    qtbot: QtBot, document: PoseDocument, colliding: np.ndarray, tmp_path: Path
) -> None:
    with qtbot.waitSignal(document.message) as free:
        export_pose(document, tmp_path / "free.obj")
    assert free.args == ["Exported free.obj: no collisions (checked)"]
    document.motion.blend_towards(colliding, 1.0)
    with qtbot.waitSignal(document.message) as told:
        export_pose(document, tmp_path / "bad.obj")
    mesh = read_mesh(tmp_path / "bad.obj")
    n_pairs = len(document.model.detector.detect(mesh.vertices.astype(np.float32)).pairs)
    pairs = counted(n_pairs, "pair", "pairs")
    assert told.args == [f"Exported bad.obj: {pairs} of its triangles collide"]
    assert n_pairs > 0


def test_resolve_checks_the_mesh_that_would_be_exported(
    qtbot: QtBot, document: PoseDocument, colliding: np.ndarray
) -> None:
    model = document.model
    # So far away that rounding moves every vertex noticeably.
    far = RigidTransform(QUARTER_TURN.rotation, np.full(3, 1e8 * model.body_size))
    document.motion.load_pose(NamedPose("far", colliding, far))
    for domain in range(len(model.domain_names)):
        document.motion.set_locked(domain, True)
    resolve(qtbot, document)
    assert document.history.state.outcome is not None
    drawn = model.decode(colliding, n_threads=1).astype(np.float32)
    placed = model.detector.detect(far.apply(drawn))
    assert document.history.state.outcome.energy_before == placed.energy
    assert document.history.state.outcome.energy_before != model.detector.detect(drawn).energy


def test_what_resolve_checked_is_what_is_exported(
    qtbot: QtBot,
    document: PoseDocument,
    colliding: np.ndarray,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(Body, "exported_vertices")
    document.motion.blend_towards(colliding, 1.0)
    resolve(qtbot, document)
    with qtbot.waitSignal(document.message):
        export_pose(document, tmp_path / "resolved.ply")
    assert document.history.state.outcome is not None
    assert np.array_equal(
        read_mesh(tmp_path / "resolved.ply").vertices, document.history.state.outcome.vertices
    )


def test_another_model_stops_no_export(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    model = document.model
    with qtbot.waitSignal(document.message):
        export_pose(document, tmp_path / "pose.obj")
        document.set_model(LearnedBody("bare", model.embedding, model.card))
    assert (tmp_path / "pose.obj").is_file()


def test_an_exported_mesh_comes_back_as_the_same_mesh(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    document.motion.load_pose(NamedPose("placed", document.model.known_poses[4], QUARTER_TURN))
    with qtbot.waitSignal(document.message):
        export_pose(document, tmp_path / "placed.obj")
    document.new_pose()
    with qtbot.waitSignal(document.message, timeout=20_000) as told:
        document.tasks.import_mesh(tmp_path / "placed.obj")
    assert told.args is not None
    assert "of the body size" in told.args[0]
    assert document.history.pose.name == "placed"
    with qtbot.waitSignal(document.message):
        export_pose(document, tmp_path / "again.obj")
    first, again = (read_mesh(tmp_path / name) for name in ("placed.obj", "again.obj"))
    off = np.abs(first.vertices - again.vertices).max() / document.model.body_size
    assert off < 1e-3
    document.history.undo()
    assert np.array_equal(document.history.latent, document.model.known_poses[0])
    assert document.history.pose.placement is None


def test_a_mesh_at_rest_imports_in_its_own_place(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    model = document.model
    placed = QUARTER_TURN.apply(model.reference)
    write_mesh(tmp_path / "rest.ply", placed, model.faces)
    with qtbot.waitSignal(document.message, timeout=20_000):
        document.tasks.import_mesh(tmp_path / "rest.ply")
    assert document.history.pose.placement is not None
    back = document.history.pose.placement.apply(model.decode(document.history.latent))
    assert np.abs(back - placed).max() / model.body_size < 0.05


def test_an_import_says_how_far_off_it_is_and_doubts_another_body(
    qtbot: QtBot, document: PoseDocument, tmp_path: Path
) -> None:
    model = document.model
    for name, vertices in (
        ("own", model.decode(model.known_poses[1])),
        ("flat", model.reference * [1.0, 1.0, 0.02]),
    ):
        write_mesh(tmp_path / f"{name}.ply", vertices, model.faces)
        with qtbot.waitSignal(document.message, timeout=20_000) as told:
            document.tasks.import_mesh(tmp_path / f"{name}.ply")
        (sentence,) = told.args
        assert sentence.startswith(f"Imported {name}: fit error of ")
        assert ("is it this body" in sentence) == (name == "flat")


def test_a_model_without_predictor_shows_poses_but_does_not_resolve(
    qtbot: QtBot, document: PoseDocument
) -> None:
    model = document.model
    document.motion.set_code(0, 0.5)
    document.motion.set_locked(1, True)
    document.set_model(LearnedBody("bare", model.embedding, model.card))
    assert document.history.undo_stack.count() == 0
    assert document.motion.locked_domains == frozenset()
    assert np.array_equal(document.history.latent, model.known_poses[0])
    settle(qtbot, document)
    assert document.motion.frame is not None
    assert document.motion.frame.prediction is None
    assert not document.model.can_resolve
    with pytest.raises(ModelFileError, match="no predictor"):
        document.tasks.resolve()
