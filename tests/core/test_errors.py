"""Every error's sentence is built from its fields, which reach other processes unchanged."""

import pickle

import pytest

from lcollision_core.bodies.poses import DamagedPosesError, OtherModelError
from lcollision_core.errors import (
    CancelledError,
    FileLockedError,
    LabelStoreError,
    LCollisionError,
    MeshFileError,
    MissingExtraError,
    ModelFileError,
    PoseSetError,
    ShapeError,
    UnwritablePoseError,
    WrongScaleError,
    listed,
)
from lcollision_core.files.scene.scene import NoMeshError
from lcollision_core.serve.messages import RefusedMessageError
from lcollision_core.tasks.learning import MostlyCollidingError


@pytest.mark.parametrize(
    ("n", "text"), [(0, ""), (1, "hat 0"), (2, "hat 0, hat 1"), (5, "hat 0, hat 1 and 3 more")]
)
def test_a_list_of_names_says_how_many_more_there_are(n: int, text: str) -> None:
    assert listed((f"hat {number}" for number in range(n)), 2) == text


SENTENCES = [
    (
        PoseSetError(
            "has other vertices than the set",
            where="pose 12 (mesh012.obj)",
            expected=2161,
            got=12500,
            next_step="remove it or export it with the set's topology",
        ),
        "pose 12 (mesh012.obj) has other vertices than the set, expected 2161, got 12500; "
        "remove it or export it with the set's topology",
    ),
    (
        ShapeError.must_be("vertices", "a (V, 3) array with V > 0", (0, 3)),
        "vertices must be a (V, 3) array with V > 0, got (0, 3)",
    ),
    (
        LCollisionError.must_be("margin", "0 or more", 0, "raise it"),
        "margin must be 0 or more, got 0; raise it",
    ),
    (MeshFileError("is empty", where="a; b.obj"), "a; b.obj is empty"),
    (NoMeshError("contains no mesh", where="walk.glb"), "walk.glb contains no mesh"),
    (
        ModelFileError("is damaged", where="m.lcm", next_step="train the model again"),
        "m.lcm is damaged; train the model again",
    ),
    (
        WrongScaleError(
            "the mesh is 100 times too large", factor=0.01, next_step="scale it by 0.01"
        ),
        "the mesh is 100 times too large; scale it by 0.01",
    ),
    (
        MissingExtraError("work on a cluster needs Dask", next_step="install it"),
        "work on a cluster needs Dask; install it",
    ),
    (CancelledError("cancelled on request"), "cancelled on request"),
    (LabelStoreError("has no rows", where="store", got=0), "store has no rows, got 0"),
    (FileLockedError("is being written", "wait", where="m"), "m is being written; wait"),
    (DamagedPosesError("is not JSON", where="p.json"), "p.json is not JSON"),
    (
        UnwritablePoseError("cannot hold this pose", where="hero.glb"),
        "hero.glb cannot hold this pose",
    ),
    (
        OtherModelError("contains poses of another model", where="p.json", model=None),
        "p.json contains poses of another model",
    ),
    (RefusedMessageError("a message is no map", "send one"), "a message is no map; send one"),
    (
        MostlyCollidingError("97 % of the samples collide", "leave parts out"),
        "97 % of the samples collide; leave parts out",
    ),
]


def _all_of(kind: type[LCollisionError]) -> set[type[LCollisionError]]:
    return {kind}.union(*map(_all_of, kind.__subclasses__()))


def test_the_sentences_are_of_every_error() -> None:
    assert {type(error) for error, _ in SENTENCES} == _all_of(LCollisionError)


@pytest.mark.parametrize(("error", "sentence"), SENTENCES)
def test_the_sentence_is_composed_from_the_fields(error: LCollisionError, sentence: str) -> None:
    assert str(error) == sentence
    assert error.headline == sentence.removesuffix(f"; {error.next_step}")


@pytest.mark.parametrize(("error", "sentence"), SENTENCES)
def test_an_error_comes_unchanged_from_another_process(
    error: LCollisionError, sentence: str
) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert vars(copy) == vars(error)
    assert copy.args == error.args
    assert str(copy) == sentence


@pytest.mark.parametrize(
    ("reason", "sentence"),
    [
        (ValueError("no number"), "a.obj cannot be read: no number; check it"),
        (
            FileNotFoundError(2, "No such file", "b.obj"),
            "a.obj cannot be read: No such file; check it",
        ),
        (OSError("gone"), "a.obj cannot be read: gone; check it"),
        (
            MeshFileError(
                "has two corners", where="face 3", expected=3, got=2, next_step="repair it"
            ),
            "a.obj cannot be read: face 3 has two corners, expected 3, got 2; repair it",
        ),
    ],
)
def test_an_error_says_the_reason_that_another_gives(reason: Exception, sentence: str) -> None:
    error = PoseSetError.unreadable("a.obj", reason, "check it")
    assert type(error) is PoseSetError
    assert str(error) == sentence


def test_fields_are_copied_into_another_class_and_about_another_place() -> None:
    error = MeshFileError("is wrong", "repair it", where="a", expected=1, got=2)
    assert vars(ModelFileError.from_error(error)) == vars(error)
    assert str(ModelFileError.from_error(error, "b")) == "b is wrong, expected 1, got 2; repair it"


def test_a_file_of_a_later_format_is_refused_with_both_versions() -> None:
    assert str(MeshFileError.too_new("a.npz", 3, 2)) == (
        "a.npz has format version 3, this program reads up to 2; update the program"
    )
