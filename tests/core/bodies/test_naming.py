"""Names and colours of domains, and finding models by name."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import (
    checkpoint_path,
    find_model,
    list_models,
    model_destination,
    user_models_folder,
)
from lcollision_core.bodies.names import (
    PALETTE,
    cielab,
    domain_colours,
    join_names,
    names_from_labels,
)
from lcollision_core.errors import LCollisionError, ModelFileError
from lcollision_core.files import require_writable


def _names(shares: list[dict[str, float]], levels: list[float] | None = None) -> tuple[str, ...]:
    """Name domains with the given squared weights on parts of one vertex each."""
    parts = sorted({part for share in shares for part in share})
    mask = np.sqrt([[share.get(part, 0.0) for part in parts] for share in shares])
    heights = np.arange(len(parts), dtype=float) if levels is None else np.array(levels)
    return names_from_labels(mask, np.array(parts), heights)


def test_the_part_with_most_weight_names_the_domain() -> None:
    names = _names([{"left hand": 0.1, "left forearm": 0.9}, {"right forearm": 1.0}])
    assert names == ("left forearm", "right forearm")


def test_two_parts_of_like_weight_are_joined() -> None:
    names = _names([{"left forearm": 0.55, "left hand": 0.45}, {"head": 0.5, "neck": 0.4}])
    assert names == ("left forearm & hand", "head & neck")


def test_both_sides_of_the_body_are_named_alike() -> None:
    names = _names(
        [
            {"left hand": 0.58, "left forearm": 0.42},
            {"right hand": 0.62, "right forearm": 0.38},
            {"left shin": 0.9, "left foot": 0.1},
        ]
    )
    assert names == ("left hand & forearm", "right hand & forearm", "left shin")


def test_a_part_of_little_weight_is_not_named() -> None:
    shares = {"chest": 0.55, "waist": 0.18, "left shoulder": 0.17, "right shoulder": 0.02}
    assert _names([shares]) == ("chest",)


def test_domains_of_one_part_take_their_second_part_too() -> None:
    names = _names(
        [
            {"left thigh": 0.7, "hips": 0.3},
            {"left thigh": 0.7, "left shin": 0.3},
            {"left thigh": 0.95, "left shin": 0.05},
        ]
    )
    assert names == ("left thigh & hips", "left thigh & shin", "left thigh")


def test_domains_that_share_all_are_told_apart_by_their_height() -> None:
    mask = np.eye(4)
    labels = np.array(["tail", "tail", "tail", "leg"])
    assert names_from_labels(mask, labels, np.array([0.0, 2.0, 1.0, 5.0])) == (
        "lower tail",
        "upper tail",
        "middle tail",
        "leg",
    )
    assert names_from_labels(np.eye(4), np.array(["tail"] * 4), np.arange(4.0)) == (
        "tail 4",
        "tail 3",
        "tail 2",
        "tail 1",
    )


@pytest.mark.parametrize(
    ("first", "second", "joined"),
    [
        ("left forearm", "left hand", "left forearm & hand"),
        ("left upper arm", "left shoulder", "left upper arm & shoulder"),
        ("left thigh", "right shin", "left thigh & right shin"),
        ("chest", "left shoulder", "chest & left shoulder"),
        ("left", "left hand", "left & hand"),
    ],
)
def test_joined_names_do_not_repeat_themselves(first: str, second: str, joined: str) -> None:
    assert join_names(first, second) == joined


def test_both_sides_of_a_part_are_named_as_one() -> None:
    names = _names(
        [
            {"belly": 0.45, "left thigh": 0.3, "right thigh": 0.25},
            {"left foot": 0.7, "right foot": 0.7},
            {"left toes": 0.7, "right toes": 0.6},
            {"left upper arm": 0.9, "right upper arm": 0.1},
        ]
    )
    assert names == ("thighs & belly", "feet", "toes", "left upper arm")


def test_names_are_short_and_different_whatever_the_labels() -> None:
    """Long names are truncated, and then equal ones are numbered."""
    long = "the skin over the third of the thoracic vertebrae, seen from behind "
    labels = np.array([long + "left", long + "right", "upper tail", "tail", " tail "])
    names = names_from_labels(np.eye(5), labels, np.arange(5.0))
    first, *_ = names
    assert names == (first, f"{long[:58].rstrip()} 2", "upper tail", "lower tail", "upper tail 2")
    assert first == long[:60].rstrip()
    both = names_from_labels(np.ones((1, 2)), labels[:2], np.arange(2.0))
    assert len(both[0]) <= 60


def test_no_weight_at_all_still_gives_names() -> None:
    assert len(set(names_from_labels(np.zeros((2, 3)), np.array(["a", "b", "c"]), np.ones(3)))) == 2


# Machado et al. 2009, severity 1, on linear RGB: normal, protanopic and deuteranopic vision.
_SIGHTS = [
    np.eye(3),
    np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
]


def test_cielab_of_known_colours() -> None:
    assert cielab("#ffffff") == pytest.approx([100.0, 0.0, 0.0], abs=0.02)
    assert cielab("#000000") == pytest.approx([0.0, 0.0, 0.0], abs=0.02)
    assert cielab("#ff0000") == pytest.approx([53.24, 80.09, 67.20], abs=0.05)


def test_colours_are_told_apart_by_colour_blind_eyes() -> None:
    for sight in _SIGHTS:
        seen = [cielab(colour, sight) for colour in PALETTE[:12]]
        assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > 10.0
    assert len(set(PALETTE)) == len(PALETTE) == 16


@pytest.mark.parametrize("n_domains", [1, 2, 12, 16])
def test_each_domain_has_a_colour_of_its_own(n_domains: int) -> None:
    mask = np.random.default_rng(n_domains).dirichlet(np.ones(n_domains), 50).T
    assert sorted(domain_colours(mask)) == sorted(PALETTE[:n_domains])


def test_domains_that_meet_differ_in_hue() -> None:
    # A chain whose neighbours share a vertex, in the palette's own order.
    n_domains = 12
    mask = np.eye(n_domains) + np.eye(n_domains, k=1) + np.eye(n_domains, k=-1)
    colours = domain_colours(mask)
    chroma = np.array([cielab(colour)[1:] for colour in colours])
    apart = np.linalg.norm(np.diff(chroma, axis=0), axis=1)
    plain = np.array([cielab(colour)[1:] for colour in PALETTE[:n_domains]])
    assert apart.min() > 45.0
    assert apart.min() > np.linalg.norm(np.diff(plain, axis=0), axis=1).min()
    assert domain_colours(mask) == colours


def test_more_domains_than_colours_repeat_them() -> None:
    colours = domain_colours(np.eye(40))
    assert len(colours) == 40
    assert set(colours) == set(PALETTE)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    return tmp_path / "lcollision" / "models"


def test_users_models_are_found_by_name(folder: Path) -> None:
    assert user_models_folder() == folder
    assert model_destination("tail") == folder / "tail.safetensors"
    assert model_destination("tail_v0.9") == folder / "tail_v0.9.safetensors"
    (folder / "tail.safetensors").write_bytes(b"anything")
    (folder / ".tail.safetensors.1.part").write_bytes(b"")
    (folder / "notes.txt").write_bytes(b"")
    (folder / "tail.v2.safetensors").write_bytes(b"")
    assert find_model("tail") == folder / "tail.safetensors"
    assert find_model("tail.v2") == folder / "tail.v2.safetensors"
    mine = [model for model in list_models() if not model.bundled]
    assert [model.name for model in mine] == ["tail", "tail.v2"]
    assert mine[0].path == folder / "tail.safetensors"


def test_an_unknown_name_lists_those_that_there_are(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "tail.safetensors").write_bytes(b"")
    with pytest.raises(ModelFileError, match=r"'tial' \(did you mean tail\?\); the models are: "):
        find_model("tial")
    with pytest.raises(ModelFileError, match=r"no model or file 'trunk'; .*\btail\b"):
        find_model("trunk")


def test_an_unfinished_training_says_how_to_go_on(folder: Path, tmp_path: Path) -> None:
    for named in ("dancer", "dancer_v0.9", tmp_path / "dancer.safetensors"):
        checkpoint = checkpoint_path(model_destination(named))
        checkpoint.touch()
        with pytest.raises(
            ModelFileError, match=rf"is not finished; .* from {re.escape(str(checkpoint))}$"
        ):
            find_model(named)
    # A model can be used while it is trained further.
    (folder / "dancer.safetensors").touch()
    assert find_model("dancer") == folder / "dancer.safetensors"


@pytest.mark.parametrize("path", ["", "."])
def test_what_cannot_be_a_file_is_left_to_the_reader(path: str) -> None:
    assert find_model(path) == Path(path)


def test_a_file_needs_no_folder_of_models(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "some.safetensors"
    assert find_model(path) == path
    assert not folder.exists()


def test_a_file_without_extension_is_found_where_no_model_has_its_name(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plain").write_bytes(b"")
    assert find_model("plain") == Path("plain")
    assert not folder.exists()


def test_destinations_that_cannot_be_are_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "taken.safetensors").mkdir()
    for destination, reason in (
        (tmp_path / "model.obj", "a model is a .safetensors file"),
        ("model.ply", "a model is a .safetensors file"),
        (tmp_path / "none" / "m.safetensors", "no folder"),
        (tmp_path / "taken.safetensors", "it is a folder"),
    ):
        with pytest.raises(LCollisionError, match=reason):
            require_writable(model_destination(destination))
    folder.parent.write_bytes(b"a file where the folder should be")
    with pytest.raises(LCollisionError, match="cannot be made"):
        model_destination("tail")


def test_hundreds_of_domains_get_the_colours_in_turn() -> None:
    # Exchanging them takes minutes.
    mask = np.random.default_rng(0).dirichlet(np.full(300, 0.1), 500).T
    assert domain_colours(mask) == tuple(PALETTE[domain % 16] for domain in range(300))
