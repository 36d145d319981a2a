"""Memory for writing a changed motion: codes and joints of its frames, not their vertices."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lcollision_core.bodies import RigBody, open_body, write_sequence
from lcollision_core.bodies.motions import MotionChange, body_of_motion, read_motions, write_clips
from lcollision_core.meshes import Topology
from lcollision_core.motion import Motion
from tests.core.motion.swings import OTHER, swinging_body
from tests.rigged_shapes import write_gltf
from tests.smpl_files import motion_arrays, write_model

SHORT, LONG = 40, 200


_ROW = 6
"""Number of bodies that move alike, so that vertices need far more memory than joints."""


def glb_of(n_frames: int, folder: Path) -> tuple[RigBody, Path]:
    alone = swinging_body(n_frames=n_frames)
    rig, n = alone.rig, len(alone.rest_vertices)
    assert rig is not None
    places = np.repeat(np.arange(_ROW), n)[:, None] * [0.0, 3.0, 0.0]
    faces = alone.topology.faces + n * np.arange(_ROW)[:, None, None]
    row = replace(
        alone,
        topology=Topology(faces.reshape(-1, 3), _ROW * n),
        rest_vertices=np.tile(alone.rest_vertices, (_ROW, 1)) + places,
        groups=(),
        rig=replace(
            rig,
            joint_of=np.tile(rig.joint_of, (_ROW, 1)),
            weights=np.tile(rig.weights, (_ROW, 1)),
            points=np.tile(rig.points, (_ROW, 1, 1)) + places[:, None],
        ),
    )
    path = write_gltf(row, folder / f"{n_frames}.glb")
    body = open_body(path)
    assert isinstance(body, RigBody)
    return body, path


def smpl_of(n_frames: int, folder: Path) -> tuple[RigBody, Path]:
    path = folder / f"walk{n_frames}.npz"
    np.savez(path, **motion_arrays(24, n_frames))
    body, _ = body_of_motion(open_body(write_model(folder / "body.npz", 24)), path)
    assert isinstance(body, RigBody)
    return body, path


def in_its_own_file(body: RigBody, path: Path, out: Path, motion: Motion) -> None:
    codes = motion.codes.copy()
    codes[10:20, 6:] += 0.01
    change = MotionChange(motion, replace(motion, codes=codes), [range(10, 20)])
    written = write_clips(out, body, path, [change])
    assert len(written.free[0]) == len(motion)


def in_a_skeletons_file(body: RigBody, _: Path, out: Path, motion: Motion) -> None:
    check = body.exact_check()
    vertices = (motion.vertices(frame, check) for frame in range(len(motion)))
    _, frames = write_sequence(out.with_suffix(".bvh"), body, list(motion.codes), vertices)
    assert sum(frame.vertices is not None for frame in frames) == len(motion)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "write"),
    [(glb_of, in_its_own_file), (smpl_of, in_its_own_file), (glb_of, in_a_skeletons_file)],
)
def test_a_longer_motion_takes_no_memory_for_its_vertices(
    source: Callable[[int, Path], tuple[RigBody, Path]],
    write: Callable[[RigBody, Path, Path, Motion], None],
    tmp_path: Path,
) -> None:
    def peak(n_frames: int) -> tuple[int, int]:
        body, path = source(n_frames, tmp_path)
        tracemalloc.start()
        try:
            (motion,) = read_motions(body, path, OTHER if path.suffix == ".glb" else None)
            write(body, path, tmp_path / f"out{n_frames}{path.suffix}", motion)
            return tracemalloc.get_traced_memory()[1], body.n_vertices
        finally:
            tracemalloc.stop()

    # Compile and read everything that is kept first.
    peak(SHORT)
    (short, n_vertices), (long, _) = peak(SHORT), peak(LONG)
    assert long - short < 0.3 * (LONG - SHORT) * n_vertices * 24
