"""Damaged, inconsistent and hostile files: one sentence that names them, or a valid result.

None may use much memory, none executes code, and no pipe or device is opened.
"""

from __future__ import annotations

import itertools
import json
import os
import pickle
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from app.cli.models import describe
from lcollision_core.bodies import LearnedBody, NamedPose, open_body, read_poses, write_poses
from lcollision_core.bodies.motions import body_of_motion, read_motions
from lcollision_core.embedding.bilevel import EmbeddingMetrics
from lcollision_core.errors import LCollisionError, MeshFileError
from lcollision_core.files import (
    PoseSet,
    read_character,
    read_mesh,
    read_pose_set,
    write_mesh,
    write_pose_set,
)
from lcollision_core.files.formats import READABLE_SUFFIXES
from lcollision_core.files.motion.bvh import read_bvh
from lcollision_core.files.motion.caches import read_point_cache, write_point_cache
from lcollision_core.files.safe import open_regular
from lcollision_core.labels import StoreIdentity
from lcollision_core.meshes import RigidTransform, Topology
from lcollision_core.model_file import FORMAT_VERSION, Section, digest_of, read_model_file
from lcollision_core.predictor import PRESETS, CollisionPredictor, TrainingFacts, score_rows
from lcollision_core.predictor.geometric_network import GeometricNetwork
from lcollision_core.predictor.paper_network import PaperNetwork
from tests.app.support import Lcollision
from tests.core.background import peak_memory
from tests.core.fbx_builder import arm_fbx
from tests.core.gltf_builder import GltfBuilder, arm, tube
from tests.core.predictor_rows import made_up_rows
from tests.hostile_values import (
    UNPLAIN_FILES,
    VALUES,
    as_json,
    changed_arrays,
    places,
    with_value,
    without_file,
)
from tests.small_models import stored
from tests.smpl_files import Arrays, motion_arrays, tiny_arrays

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1.5, 0], [0, 0, -2.25]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
MOST_MEMORY = 100 << 20
"""Peak memory in bytes allowed for a damaged file of some kilobytes."""


def refused(path: Path, read: Callable[[Path], object], is_traced: bool = True) -> bool:
    """Return whether a file is refused, which must be in one short sentence that names it.

    Tracing the memory makes reading several times slower.
    """
    sentences = []

    def attempt() -> None:
        try:
            read(path)
        except LCollisionError as error:
            sentences.append(str(error))

    if is_traced:
        assert peak_memory(attempt) < MOST_MEMORY
    else:
        attempt()
    for sentence in sentences:
        assert path.stem in sentence
        assert "\n" not in sentence
        assert len(sentence) < len(str(path)) + 600, sentence
        sentence.encode()
    return bool(sentences)


# Bytes.


def _require_valid(vertices: np.ndarray, faces: np.ndarray) -> None:
    assert np.isfinite(vertices).all()
    assert 0 <= faces.min() <= faces.max() < vertices.shape[-2]


def _mesh(path: Path) -> None:
    mesh = read_mesh(path, topology=Topology(FACES, 4))
    assert mesh.vertices.shape == (mesh.topology.n_vertices, 3)
    _require_valid(mesh.vertices, mesh.faces)


def _set(path: Path) -> None:
    poses = read_pose_set(path, fps=2.0 if path.suffix == ".fbx" else None)
    assert poses.vertices.shape == (len(poses.names), poses.topology.n_vertices, 3)
    _require_valid(poses.vertices, poses.topology.faces)


def _character(path: Path) -> None:
    """Read a character with all its frames, and the file as a mesh."""
    character = read_character(path)
    _require_valid(character.rest_vertices, character.topology.faces)
    assert character.joined.max() < character.topology.n_vertices
    for clip in character.clips:
        frames = character.sample(clip, None)
        assert np.isfinite(frames.vertices).all()
        assert frames.vertices.shape == (len(frames.times), character.topology.n_vertices, 3)
    mesh = read_mesh(path)
    _require_valid(mesh.vertices, mesh.faces)


def _smpl(path: Path) -> None:
    body = open_body(path)
    assert np.isfinite(body.decode(np.zeros(body.latent_size))).all()


_opened = lru_cache(maxsize=1)(open_body)
"""Opens a sound body once for all damaged motions of a test."""


def _walk(path: Path) -> None:
    body, _ = body_of_motion(_opened(path.with_name("sound.npz")), path)
    (motion,) = read_motions(body, path)
    assert np.isfinite(motion.codes).all()


def _cache(path: Path) -> None:
    vertices, faces = tube()
    write_mesh(path.with_suffix(".obj"), vertices, faces)
    write_point_cache(path, np.stack([vertices, vertices * [1.0, 1.1, 1.0]]))


def _walking(path: Path) -> None:
    np.savez(path.with_name("sound.npz"), **tiny_arrays())
    np.savez(path, **(motion_arrays(24, 3) | {"betas": np.zeros(4)}))


PLY = (
    "ply\nformat {} 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\nelement face {}\nproperty list uchar {} vertex_indices\nend_header\n"
)
RAGGED_PLY = PLY.format("binary_little_endian", 2, "short").encode()
RAGGED_PLY += np.arange(12, dtype="<f4").tobytes() + b"\4\0\0\1\0\2\0\3\0\3\0\0\1\0\2\0"
TEXTS = {
    "text.ply": PLY.format("ascii", 3, "int")
    + "0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n4 0 1 2 3\n3 0 2 3\n",
    "text.stl": "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n"
    "vertex 0 1 0\nendloop\nendfacet\nendsolid a\n",
    "slashed.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nf 1/1 2/1 3/1\n"
    "f -4//1 -3//1 -2//1 -1//1\n",
}


@dataclass(frozen=True)
class Kind:
    """A kind of file: how an intact one is written, read and judged."""

    write: Callable[[Path], object]
    read: Callable[[Path], None]
    n_damaged: int = 150


KINDS = {
    **{
        f"plain{suffix}": Kind(lambda path: write_mesh(path, VERTICES, FACES), _mesh, 250)
        for suffix in (".obj", ".ply", ".off", ".stl", ".glb")
    },
    **{
        name: Kind(lambda path, text=text: path.write_text(text), _mesh, 250)  # type: ignore[misc]
        for name, text in TEXTS.items()
    },
    "ragged.ply": Kind(lambda path: path.write_bytes(RAGGED_PLY), _mesh, 250),
    "set.npz": Kind(
        lambda path: write_pose_set(
            path, PoseSet(np.stack([VERTICES, VERTICES + 1]), Topology(FACES, 4), ("a", "b"))
        ),
        _set,
        400,
    ),
    "arm.glb": Kind(lambda path: arm().write(path), _character),
    "arm.fbx": Kind(arm_fbx, _set, 60),
    "tube.pc2": Kind(_cache, _set, 60),
    "tube.mdd": Kind(_cache, _set, 60),
    "body.npz": Kind(lambda path: np.savez(path, **tiny_arrays()), _smpl),
    "walk.npz": Kind(_walking, _walk),
}


def _damaged(data: bytes, seed: int) -> bytes:
    """Truncate a file, overwrite some of its bytes, or repeat a part of it."""
    generator = np.random.default_rng(seed)
    result, kind = bytearray(data), seed % 4
    if kind == 0:
        del result[int(generator.integers(len(result))) :]
    # Names, sizes and headers are the most sensitive parts.
    end = len(result) if seed % 8 < 4 else min(200, len(result))
    for _ in range(int(generator.integers(1, 9)) if kind else 0):
        result[int(generator.integers(end))] = int(generator.integers(256))
    if kind == 3:
        first, last = np.sort(generator.integers(len(result), size=2)).tolist()
        result[first:first] = result[first:last]
    return bytes(result)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_files_of_damaged_bytes(name: str, tmp_path: Path) -> None:
    if name.endswith("fbx"):
        pytest.importorskip("ufbx")
    kind, path = KINDS[name], tmp_path / name
    kind.write(path)
    whole, n_refused = path.read_bytes(), 0
    for seed in range(kind.n_damaged):
        without_file(path).write_bytes(_damaged(whole, seed))
        n_refused += refused(path, kind.read)
    assert n_refused > kind.n_damaged // 10
    path.write_bytes(whole)
    if name not in TEXTS and name != "ragged.ply":
        assert not refused(path, kind.read)
    elif name.endswith((".ply", ".obj", ".stl")):
        assert len(read_mesh(path).faces) > 0


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off", ".stl", ".glb", ".gltf", ".npz"])
def test_garbage_is_refused(tmp_path: Path, suffix: str) -> None:
    path, generator = tmp_path / f"garbage{suffix}", np.random.default_rng(0)
    for size in (0, 1, *generator.integers(2, 300, 60).tolist()):
        without_file(path).write_bytes(generator.bytes(size))
        assert refused(path, read_pose_set if suffix == ".npz" else read_mesh)


# Values of descriptions.

HOSTILE = (
    -1, 0, 1, 3, 255, 65536, 2**31 - 1, 2**31, 2**40, 2**64, 0.5, -1e308, 1e-308, "", "x", None,
    True, [], {}, [0], [1e39] * 3, [10**9], {"a": 1}, "\u202e\x00", "VEC3", "../x.bin",
)  # fmt: skip


def _all_places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, held in items:
        yield (*path, key)
        if isinstance(held, dict | list):
            yield from _all_places(held, (*path, key))


def _with_hostile_value(seed: int) -> GltfBuilder:
    """Replace one or two values of a description by invalid ones."""
    generator = np.random.default_rng(seed)
    builder = arm()
    builder.description |= {"scene": 0, "scenes": [{"nodes": [0]}]}
    builder.description = json.loads(json.dumps(builder.description))
    for _ in range(1 + seed % 2):
        held = list(_all_places(builder.description))
        place = held[int(generator.integers(len(held)))]
        value = HOSTILE[int(generator.integers(len(HOSTILE)))]
        builder.description = with_value(builder.description, place, value)
    return builder


@pytest.mark.slow
def test_glb_of_hostile_values(tmp_path: Path) -> None:
    path, n = tmp_path / "hostile.glb", 200
    n_refused = sum(
        refused(_with_hostile_value(seed).write(without_file(path)), _character)
        for seed in range(n)
    )
    assert n_refused > n // 10


@pytest.mark.slow
def test_poses_with_any_value_changed(tmp_path: Path) -> None:
    model, path = stored("tube"), tmp_path / "poses.json"
    placement = RigidTransform(np.eye(3), np.zeros(3))
    first = NamedPose("a", 0.1 * model.known_poses[0])
    write_poses(path, model, [first, NamedPose("b", model.known_poses[1], placement, 0.01, 0.02)])

    def read(path: Path) -> None:
        for pose in read_poses(path, model):
            assert np.isfinite(model.decode(pose.latent)).all()

    document, n_refused, n_changes = json.loads(path.read_text()), 0, 0
    for place, value in itertools.product(places(document), VALUES):
        without_file(path).write_text(as_json(with_value(document, place, value)))
        n_changes += 1
        n_refused += refused(path, read, is_traced=False)
    assert n_changes > 300
    assert n_changes / 2 < n_refused < n_changes - 30


# Model files.

Sections = dict[str, Section]
N_POINTS, WIDTH, N_MANY = 24, 4, 20


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Keep torch from waking its threads thousands of times for a few numbers."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module", params=["default", "paper"])
def preset_sections(request: pytest.FixtureRequest) -> tuple[str, Sections]:
    """Return a preset, and the sections of a model with its predictor."""
    return request.param, _whole(request.param)


def _whole(preset: str) -> Sections:
    bare = stored("tube")
    errors = dict.fromkeys(EmbeddingMetrics.__dataclass_fields__, 0.01)
    metrics = EmbeddingMetrics(**(errors | {"pca_size": 3}))  # type: ignore[arg-type]
    embedding = replace(bare.embedding, metrics=metrics)
    rows = made_up_rows(embedding, 200)
    if preset == "paper":
        network: torch.nn.Module = PaperNetwork(embedding.group_sizes, True, 0)
    else:
        sites = np.arange(36).reshape(3, 12)
        network = GeometricNetwork(embedding, 0, sites, N_POINTS, WIDTH)
        network._fit(embedding, rows.latent)
    facts = TrainingFacts(
        rows=200,
        training_rows=140,
        colliding_share=0.3,
        seed=0,
        energy_scale=1e-4,
        margin=0.5,
        store=StoreIdentity.of(bare.labeller(), 0),
        logit_shift=0.1,
    )
    arrays = {name: array.numpy() for name, array in network.state_dict().items()}
    predictor = CollisionPredictor(embedding, arrays, PRESETS[preset], facts)
    predictor = replace(predictor, metrics=score_rows(predictor, rows).metrics())
    card = replace(bare.card, provenance={"command": ["train"], "seconds": 3.5})
    model = LearnedBody("whole", embedding, card).with_predictor(predictor)
    model = model.with_free_poses(0.1 * bare.known_poses[:3])
    arrays, metadata = embedding.to_arrays()
    return {
        **model._other_sections,
        "embedding": Section(arrays, metadata),
        "model": Section({}, card.to_metadata()),
    }


def _write(path: Path, sections: Sections) -> Path:
    """Write a model file with a correct checksum, whatever the sections contain."""
    tensors = {
        f"{section_name}/{name}": np.ascontiguousarray(array).reshape(array.shape)
        for section_name, section in sections.items()
        for name, array in section.arrays.items()
    }
    described = as_json({name: dict(section.metadata) for name, section in sections.items()})
    checksum = digest_of(f"{FORMAT_VERSION}\n{described}\n", tensors)
    document = f'{{"format_version":{FORMAT_VERSION},"sections":{described},"sha256":"{checksum}"}}'
    without_file(path).write_bytes(save(tensors, metadata={"lcollision": document}))
    return path


def _describe(model: LearnedBody) -> None:
    json.dumps(describe(model), allow_nan=False)


def _decode_and_encode(model: LearnedBody) -> None:
    space = model.latent_space
    few = np.stack([0.0 * space.low, space.low, space.high, model.known_poses[-1]])
    vertices = model.decode(few)
    assert np.isfinite(vertices).all()
    assert model.detector.detect_batch(vertices.astype(np.float32)).n_pairs.min() >= 0
    try:
        encoded = model.encode(vertices[-1])
    except LCollisionError as error:
        assert len(str(error)) < 600  # noqa: PT017 - both are right
    else:
        assert np.isfinite(encoded.latent).all()


def _predict(model: LearnedBody) -> None:
    space = model.latent_space
    few = np.stack([0.0 * space.low, space.low, space.high])
    many = space.sample(N_MANY, np.random.default_rng(0))
    predictor = model.require_predictor()
    for predicted in (predictor.predict(few), predictor.predict(many)):
        assert np.isfinite(predicted.domain_energy).all()
        assert np.isfinite(predicted.collision_logit).all()
        assert (np.abs(predicted.collision_probability - 0.5) <= 0.5).all()
    logit, gradient = predictor.logit_and_gradient(few[:2])
    assert np.isfinite(logit).all()
    assert np.isfinite(gradient).all()
    assert model.resolver is not None


Use = Callable[[LearnedBody], None]
EVERY_USE: tuple[Use, ...] = (_describe, _decode_and_encode, _predict)
COMPUTED_WITH = {
    *("height", "up_axis", "near_exclusion", "scaling", "n_vertices", "n_domains"),
    *("preset", "by_domain", "energy_scale", "margin", "logit_shift"),
}
"""Metadata on which more than a report depends."""


def _is_refused(path: Path, uses: tuple[Use, ...] = EVERY_USE) -> bool:
    """Use a model as the commands and the editor do; only loading may refuse it."""
    models: list[LearnedBody] = []
    if refused(path, lambda path: models.append(LearnedBody.load(path)), is_traced=False):
        return True
    for use in uses:
        use(models[0])
    return False


def test_the_whole_model_works(preset_sections: tuple[str, Sections], tmp_path: Path) -> None:
    path = _write(tmp_path / "m.safetensors", preset_sections[1])
    assert read_model_file(path).keys() == preset_sections[1].keys()
    assert not _is_refused(path)


@pytest.mark.slow
def test_a_model_with_any_value_changed(tmp_path: Path) -> None:
    path, sections = tmp_path / "m.safetensors", _whole("default")
    n_working = n_changes = 0
    for name, section in sections.items():
        metadata = json.loads(json.dumps(dict(section.metadata)))
        for place, value in itertools.product(places(metadata), VALUES):
            changed = Section(section.arrays, with_value(metadata, place, value))
            _write(path, {**sections, name: changed})
            n_changes += 1
            computed_with = COMPUTED_WITH.intersection(place)
            n_working += not _is_refused(path, EVERY_USE if computed_with else (_describe,))
    assert n_changes > 2000
    # Some replacements are valid values of their fields.
    assert 100 < n_working < n_changes / 3


@pytest.mark.slow
def test_a_model_with_any_array_changed(
    preset_sections: tuple[str, Sections], tmp_path: Path
) -> None:
    preset, sections = preset_sections
    path = tmp_path / "m.safetensors"
    for name in ("embedding", "free_poses", "predictor") if preset == "default" else ("predictor",):
        section = sections[name]
        uses = (_predict,) if name == "predictor" else EVERY_USE
        for array_name, array in section.arrays.items():
            n_refused = 0
            others = {key: held for key, held in section.arrays.items() if key != array_name}
            for _, changed in changed_arrays(array):
                held = others if changed is None else {**others, array_name: changed}
                _write(path, {**sections, name: Section(held, section.metadata)})
                n_refused += _is_refused(path, uses)
            assert n_refused > 12, array_name
    one_more = Section({**sections["predictor"].arrays, "x": np.ones(3)}, section.metadata)
    assert _is_refused(_write(path, {**sections, "predictor": one_more}))


def test_a_damaged_model_is_listed_and_the_others_with_it(
    tmp_path: Path, lcollision: Lcollision, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    folder, sections = tmp_path / "lcollision" / "models", _whole("default")
    folder.mkdir(parents=True)
    _write(folder / "sound.safetensors", sections)
    card = dict(sections["model"].metadata)
    for value in (2.0, None, "x" * 10**6):
        changed = Section({}, {**card, "up_axis": value})
        _write(folder / f"odd {len(str(value))}.safetensors", {**sections, "model": changed})
    (folder / "a folder.safetensors").mkdir()
    result = lcollision("models")
    assert result.exit_code == 2
    assert "sound: 210 vertices" in result.stdout
    for name in ("odd 3", "odd 4", "odd 1000000", "a folder"):
        assert f"{name}: damaged (your own)\n" in result.stdout
        assert f"{folder / name}.safetensors " in result.stderr
    assert all(len(line) < 800 for line in result.stderr.splitlines())
    result = lcollision("models", "--json")
    assert "sound" in [report["name"] for report in json.loads(result.stdout)]


# Arrays of archives, and objects that execute code when unpickled.


@pytest.mark.slow
def test_a_pose_set_with_any_array_changed(tmp_path: Path) -> None:
    path, n_refused = tmp_path / "s.npz", 0
    arrays: Arrays = {
        "vertices": np.stack([VERTICES, VERTICES + 1.0]),
        "faces": FACES,
        "names": np.array(["a", "b"]),
        "notes": np.array(["a note"]),
        "near_exclusion": np.array(0.01),
        "up_axis": np.array(1),
        "vertex_labels": np.array(["arm", "arm", "leg", "leg"]),
        "format_version": np.array(1),
    }
    for name, array in arrays.items():
        others = {key: held for key, held in arrays.items() if key != name}
        for _, changed in changed_arrays(array):
            np.savez(without_file(path), **others, **({} if changed is None else {name: changed}))
            n_refused += refused(path, _set)
    assert n_refused > 80


class Runs:
    """An object that creates a folder when it is unpickled."""

    def __init__(self, left: Path) -> None:
        self.left = str(left)

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (self.left,)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "arrays"),
    [("body.npz", tiny_arrays()), ("walk.npz", motion_arrays(24, 3) | {"betas": np.zeros(4)})],
    ids=["body", "motion"],
)
def test_a_body_or_motion_with_an_array_changed_or_pickled(
    name: str, arrays: Arrays, tmp_path: Path
) -> None:
    path, left = tmp_path / name, tmp_path / "ran"
    KINDS[name].write(path)
    changes = [
        (key, changed) for key, held in arrays.items() for _, changed in changed_arrays(held)
    ]
    chosen = np.random.default_rng(0).permutation(len(changes))[:75].tolist()
    pickles = [(key, np.array([Runs(left)], dtype=object)) for key in arrays]
    n_refused = 0
    for key, changed in [*pickles, *(changes[place] for place in chosen)]:
        others = {other: held for other, held in arrays.items() if other != key}
        np.savez(without_file(path), **others, **({} if changed is None else {key: changed}))
        n_refused += refused(path, KINDS[name].read)
    assert not left.exists()
    assert n_refused > 0.5 * (len(pickles) + len(chosen))
    pickle.loads(pickle.dumps(Runs(left)))
    assert left.exists()


@pytest.mark.slow
def test_commands_refuse_them_and_write_nothing(lcollision: Lcollision, tmp_path: Path) -> None:
    model, motion, out = tmp_path / "model.npz", tmp_path / "walk.npz", tmp_path / "free.npz"
    sound, wrong, left = tmp_path / "sound.npz", tmp_path / "wrong.npz", tmp_path / "ran"
    np.savez(sound, **tiny_arrays())
    walk, pickled = motion_arrays(24, 3), np.array([Runs(left)], dtype=object)
    np.savez(motion, **walk)
    np.savez(wrong, **(walk | {"poses": np.full((1, 3), 0.5)}))
    for name in list(tiny_arrays())[:7]:
        np.savez(model, **(tiny_arrays() | {name: pickled}))
        for arguments in (
            ("check", motion, "--clips", "--body", model),
            ("resolve", model, motion, "--motion", "-o", out),
            ("resolve", sound, wrong, "--motion", "-o", out),
        ):
            result = lcollision(*arguments)
            assert result.exit_code == 2
            assert result.stderr.count("\n") == 1
            assert "Traceback" not in result.output
            assert not out.exists()
    # Other arrays of the archive are copied without being read.
    np.savez(motion, **(walk | {"info": pickled}))
    result = lcollision("resolve", sound, motion, "--motion", "-o", out)
    assert result.exit_code in (0, 1), result.output
    assert out.exists()
    assert not left.exists()
    with pytest.raises(ValueError, match="allow_pickle"):
        np.load(out, allow_pickle=False)["info"]


# Paths that are not regular files, or are elsewhere.


@pytest.mark.parametrize("kind", UNPLAIN_FILES)
def test_what_is_no_plain_file_is_never_opened(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pipe would wait for its writer for ever, and a device never ends."""
    monkeypatch.chdir(tmp_path)  # Socket names must be short.
    readers: dict[str, Callable[[Path], Any]] = {
        **dict.fromkeys(READABLE_SUFFIXES, read_mesh),
        ".npz": read_pose_set,
        ".safetensors": read_model_file,
        ".json": lambda path: read_poses(path, stored("tube")),
        "": open_regular,
    }
    for suffix, read in readers.items():
        path = Path(f"f{suffix}")
        if kind == "a folder" and suffix == ".npz":
            continue  # A folder is another form of pose set.
        UNPLAIN_FILES[kind](path)
        with pytest.raises((LCollisionError, OSError)) as caught:
            read(path)
        assert f"it is {kind}, not a plain file" in str(caught.value)
        assert "\n" not in str(caught.value)
    UNPLAIN_FILES[kind](Path("b.bin"))
    Path("m.gltf").write_bytes(_scene("b.bin"))
    with pytest.raises(MeshFileError, match=r"m\.gltf .*its buffer 'b\.bin' cannot be read"):
        read_mesh("m.gltf")


def test_a_pointer_of_git_lfs_is_named(tmp_path: Path) -> None:
    readers: dict[str, Callable[[Path], Any]] = {
        **dict.fromkeys(READABLE_SUFFIXES, read_mesh),
        ".npz": read_pose_set,
        ".bvh": read_bvh,
        ".pc2": read_point_cache,
        ".json": lambda path: read_poses(path, stored("tube")),
    }
    for suffix, read in readers.items():
        path = tmp_path / f"f{suffix}"
        path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
        with pytest.raises(LCollisionError, match=r"pointer of Git LFS; `git lfs pull`"):
            read(path)


def _scene(uri: str) -> bytes:
    accessor = {"componentType": 5126, "count": 3, "type": "VEC3", "bufferView": 0}
    scene = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 36, "uri": uri}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [accessor],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    return json.dumps(scene).encode()


ELSEWHERE = ("%2e%2e/b.bin", "//host/b.bin", "\\\\host\\b.bin", "http://host/b.bin", "C:b.bin")
UNREADABLE = ("/etc/hostname", "../m.bin", "none.bin", "x" * 5000, "a\0b")


@pytest.mark.parametrize("uri", [*ELSEWHERE, "link.bin", *UNREADABLE, "a%20part/b.bin"])
def test_a_gltf_buffer_is_read_only_beside_its_file(tmp_path: Path, uri: str) -> None:
    points = VERTICES[:3].astype("<f4").tobytes()
    (tmp_path / "b.bin").write_bytes(points)
    folder = tmp_path / "scene"
    (folder / "a part").mkdir(parents=True)
    (folder / "a part" / "b.bin").write_bytes(points)
    (folder / "link.bin").symlink_to(tmp_path / "b.bin")
    (folder / "m.gltf").write_bytes(_scene(uri))
    if uri == "a%20part/b.bin":
        assert np.array_equal(read_mesh(folder / "m.gltf").vertices, VERTICES[:3])
        return
    reason = "" if uri in UNREADABLE else ": it is not beside the file"
    with pytest.raises(MeshFileError, match=rf"its buffer .* cannot be read{reason}") as caught:
        read_mesh(folder / "m.gltf")
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("expected", [None, Topology(FACES, 4)])
def test_a_glb_face_out_of_range_is_named(tmp_path: Path, expected: Topology | None) -> None:
    path = tmp_path / "m.glb"
    write_mesh(path, VERTICES, FACES)
    data = path.read_bytes()
    # In so small a file, these corners occur only at the face.
    for dtype in (np.uint8, np.uint16, np.uint32):
        row, changed = FACES[2].astype(dtype), FACES[2].astype(dtype)
        if data.count(row.tobytes()) == 1:
            changed[1] = 200
            without_file(path).write_bytes(data.replace(row.tobytes(), changed.tobytes()))
            break
    with pytest.raises(MeshFileError, match=r"m\.glb .* face 2 names vertices \[1, 200, 3\]"):
        read_mesh(path, topology=expected)


# False sizes.


def _entry(header: bytes, data: bytes) -> bytes:
    return b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + data


HEADER = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1, 4, 3), }\n"
HEADERS = [
    *(HEADER.replace(b"(1,", b"(" + size + b",") for size in (b"True", b"1.0", b"-1", b"None")),
    *(HEADER.replace(b"(1,", b"(" + b"9" * n + b",") for n in (5000, 400)),
    *(HEADER.replace(b"(1, 4, 3)", shape) for shape in (b"[1, 4, 3]", b"12")),
    *(
        HEADER.replace(b"'<f8'", dtype)
        for dtype in (b"'<f3'", b"'<U0'", b"'<c16'", b"'<M8[ns]'", b"[('x', '<f8')]", b"8")
    ),
    HEADER.replace(b"False", b"None"),
    HEADER.replace(b"'shape'", b"'shapes'"),
    *(HEADER[:30], b"{" * 3000, b"\xff" * 60, b""),
]


def test_a_damaged_npz_header_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    whole = BytesIO()
    np.savez(whole, vertices=VERTICES[None], faces=FACES)
    for header, name in itertools.product(HEADERS, ("vertices", "faces", "names", "up_axis")):
        with zipfile.ZipFile(whole) as held, zipfile.ZipFile(path, "w") as archive:
            for info in held.infolist():
                if info.filename != f"{name}.npy":
                    archive.writestr(info, held.read(info))
            archive.writestr(f"{name}.npy", _entry(header, VERTICES.tobytes()))
        assert refused(path, read_pose_set), header


@pytest.mark.slow
def test_of_an_npz_only_what_is_wanted_is_read(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    unused = {f"unused{i}": np.zeros(5_000_000) for i in range(2)}
    np.savez_compressed(path, vertices=VERTICES[None], faces=FACES, V=unused["unused0"], **unused)
    assert path.stat().st_size < 10**6
    read_pose_set(path)  # What is compiled is compiled.
    assert peak_memory(lambda: read_pose_set(path)) < 10**7


@pytest.mark.slow
def test_an_npz_size_that_the_file_cannot_hold_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    header = HEADER.replace(b"(1,", b"(10000000,")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("vertices.npy", _entry(header, VERTICES.tobytes()))

    def read() -> None:
        with pytest.raises(MeshFileError, match="damaged"):
            read_pose_set(path)

    assert peak_memory(read) < 2 * 10**6


@pytest.mark.slow
@pytest.mark.parametrize(
    "content",
    [
        b"[" + b"{}," * 4_000_000 + b"{}]",
        b"[" + b"[]," * 7_000_000 + b"[]]",
        b"[" + b'"ab",' * 6_000_000 + b"0]",
        b"[" * 100_000,
    ],
    ids=["objects", "lists", "words", "nested"],
)
def test_json_that_would_fill_the_memory_is_refused(content: bytes, tmp_path: Path) -> None:
    path, model = tmp_path / "poses.json", stored("tube")
    path.write_bytes(content)

    def read() -> None:
        with pytest.raises(LCollisionError, match=r"poses\.json is not JSON \(") as caught:
            read_poses(path, model)
        assert len(str(caught.value)) < 400

    assert peak_memory(read) < 4 * len(content) + 10**6


N_ROWS = 20_000
POINTS = np.random.default_rng(0).normal(size=(N_ROWS, 3)).astype(np.float32)
CORNERS = np.stack([np.arange(N_ROWS - 2) + i for i in range(3)], axis=1)


def _text_of(suffix: str) -> str:
    """Return an unusual mesh text, so that no fast path is taken."""
    points = [f"{x:.7g} {y:.7g} {z:.7g}" for x, y, z in POINTS.tolist()]
    odd = ["1_0 0 0", *points[1:]]
    rows = [" ".join(map(str, row)) for row in CORNERS.tolist()]
    elements = "\n".join([*odd, "4 0 1 2 3", *(f"3 {row}" for row in rows)]) + "\n"
    if suffix == ".ply":
        head = PLY.format("ascii", len(rows) + 1, "int")
        return head.replace("vertex 4", f"vertex {N_ROWS}") + elements
    if suffix == ".off":
        return f"OFF\n{N_ROWS} {len(rows) + 1} 0\n" + elements
    if suffix == ".obj":
        corners = ["f " + " ".join(map(str, row)) for row in (CORNERS + 1).tolist()]
        places = [f"v {odd[0]} # first", *(f"v {point}" for point in odd[1:])]
        return "\n".join([*places, "f -3 -2 -1", "f 1/1 2/2 3/3", *corners])
    facets = [
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {odd[i]}\n" for i in row)
        + "endloop\nendfacet\n"
        for row in CORNERS[: N_ROWS // 6].tolist()
    ]
    return "solid a\n" + "".join(facets) + "endsolid a\n"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl"])
def test_text_takes_memory_by_its_size(suffix: str, tmp_path: Path) -> None:
    """Words and lines as Python objects took thirty times the file's size."""
    path = tmp_path / f"m{suffix}"
    path.write_text(_text_of(suffix))
    meshes = []
    read_mesh(path)  # What is compiled is compiled.
    peak = peak_memory(lambda: meshes.append(read_mesh(path)))
    assert len(meshes[0].faces) >= N_ROWS // 6
    assert meshes[0].vertices[0].tolist() == [10.0, 0.0, 0.0]
    assert np.allclose(meshes[0].vertices[1:50], POINTS[1:50])
    assert peak < 14 * path.stat().st_size
