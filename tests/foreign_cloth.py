"""Third-party checks of the frames of a motion that should be fit for cloth.

``python -m tests.foreign_cloth CHARACTER.glb FRAMES.npz [PPF]`` counts intersections in the file
written by the task `prepare` of `tests/app/blender/inside_cloth.py`, with ipctk and with
ppf-contact-solver's mesh check in Python. PPF is a folder with a package `ppf` that contains
`_bvh_.py`, `_intersection_.py` and `_proximity_.py` of its `frontend` (of December 2025; later ones
are in Rust), which need tqdm.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

import ipctk
import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import RigBody, open_body
from lcollision_core.meshes import Topology

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]


def by_ipctk(frames: FloatArray, faces: IntArray) -> tuple[list[int], list[int]]:
    """Return the frames that intersect, and those with a hit on the linear path to the next."""
    topology = Topology(faces, frames.shape[1])
    mesh = ipctk.CollisionMesh(
        np.asfortranarray(frames[0]), np.asfortranarray(topology.edges), np.asfortranarray(faces)
    )
    ccd = ipctk.TightInclusionCCD(conservative_rescaling=1.0)
    poses = [np.asfortranarray(one) for one in frames]
    crossing = [at for at, one in enumerate(poses) if ipctk.has_intersections(mesh, one)]
    hit = [
        at
        for at in range(len(poses) - 1)
        if not {at, at + 1} & set(crossing)
        and not ipctk.is_step_collision_free(mesh, poses[at], poses[at + 1], narrow_phase_ccd=ccd)
    ]
    return crossing, hit


def faces_with(parts: npt.NDArray[Any], faces: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return, for each of (n, k) groups of vertices, the faces that contain all; -1 pads rows."""
    around: list[set[int]] = [set() for _ in range(faces.max() + 1)]
    for face, corners in enumerate(faces.tolist()):
        for corner in corners:
            around[corner].add(face)
    rows = [sorted(set.intersection(*(around[vertex] for vertex in part))) for part in parts]
    longest = max(map(len, rows))
    return np.array([row + [-1] * (longest - len(row)) for row in rows])


Balls = tuple[FloatArray, FloatArray, FloatArray]


def moving_balls(cells: npt.NDArray[Any], before: FloatArray, after: FloatArray) -> Balls:
    """Return the middles of (n, k) cells before and after, and the radius around them all the way.

    The farthest corner's distance from the middle is convex on a linear path.
    """
    middles = [pose[cells].mean(axis=1) for pose in (before, after)]
    away = [
        np.linalg.norm(pose[cells] - middle[:, None], axis=2).max(axis=1)
        for pose, middle in zip((before, after), middles, strict=True)
    ]
    return middles[0], middles[1], np.maximum(*away)


def meet(one: Sequence[FloatArray], other: Sequence[FloatArray]) -> npt.NDArray[np.bool_]:
    """Return whether n pairs of moving balls touch at some time."""
    begin, end = one[0] - other[0], one[1] - other[1]
    way = end - begin
    length = np.maximum((way * way).sum(axis=1), np.finfo(np.float64).tiny)
    share = np.clip(-(begin * way).sum(axis=1) / length, 0.0, 1.0)
    nearest = np.linalg.norm(begin + share[:, None] * way, axis=1)
    touch: npt.NDArray[np.bool_] = nearest <= (1.0 + 1e-9) * (one[2] + other[2])
    return touch


def hits_on_counted_pairs(body: RigBody, frames: FloatArray) -> tuple[list[int], list[int]]:
    """Return the frames that intersect, and those with a hit before the next, found by ipctk.

    The project only decides which pairs of faces count.

    Parameters
    ----------
    frames : (n, V, 3) in the body's unit
    """
    faces, edges, detector = body.topology.faces, body.topology.edges, body.detector
    size = body.body_size
    of = {
        "vertex": faces_with(np.arange(body.n_vertices)[:, None], faces),
        "edge": faces_with(edges, faces),
        "face": np.arange(len(faces))[:, None],
    }

    cells = {"vertex": np.arange(body.n_vertices)[:, None], "edge": edges, "face": faces}

    def counted(candidates: list[Any], one: str, other: str, *path: FloatArray) -> list[Any]:
        """Return the candidates that lie on a pair of faces that counts, and may meet on a path."""
        kinds = [side.rstrip("01") for side in (one, other)]
        ids = [np.array([getattr(c, f"{s}_id") for c in candidates], int) for s in (one, other)]
        may_meet = np.arange(len(candidates))
        if path:
            balls = [moving_balls(cells[kind], *path) for kind in kinds]
            may_meet = np.flatnonzero(
                meet(*([each[own] for each in ball] for ball, own in zip(balls, ids, strict=True)))
            )
        left, right = (of[kind][own[may_meet]] for kind, own in zip(kinds, ids, strict=True))
        both = np.stack(np.broadcast_arrays(left[:, :, None], right[:, None, :]), axis=-1)
        are_faces = (both >= 0).all(axis=-1)
        row, pairs = np.nonzero(are_faces)[0], both[are_faces].astype(np.int32)
        share = faces[pairs[:, 0], :, None] == faces[pairs[:, 1], None, :]
        apart = ~share.any(axis=(1, 2))
        # Each pair of faces comes from several candidates.
        keys = np.sort(pairs[apart], axis=1) @ np.array([len(faces), 1], np.int64)
        keys, key_of = np.unique(keys, return_inverse=True)
        once = np.stack(np.divmod(keys, len(faces)), axis=1).astype(np.int32)
        counts = (detector.rules_of(once, np.ones(len(once))) == 0)[key_of]
        return [candidates[may_meet[at]] for at in np.unique(row[apart][counts])]

    # Skip most pairs near at rest, by single vertices; the rules decide on the rest.
    start, near = detector._exclusions.near
    first = np.repeat(np.arange(body.n_vertices), np.diff(start))
    apart_at_rest = np.linalg.norm(body.reference[first] - body.reference[near], axis=1)
    first, near = (one[apart_at_rest < 0.02 * size] for one in (first, near))
    apart = ipctk.make_sparse_filter(
        dict.fromkeys(zip(first.tolist(), near.tolist(), strict=True), False), True
    )
    columns = (np.asfortranarray(one) for one in (body.reference / size, edges, faces))
    mesh = ipctk.CollisionMesh(*columns)
    mesh.can_collide = apart
    ccd = ipctk.TightInclusionCCD(conservative_rescaling=1.0)
    poses = [np.asfortranarray(one / size, dtype=np.float64) for one in frames]
    crossing, hit = [], []
    for at, pose in enumerate(poses):
        search = ipctk.LBVH()
        search.can_vertices_collide = apart
        search.build(pose, mesh.edges, mesh.faces)
        crosses = (
            ipctk.is_edge_intersecting_triangle(*pose[edges[c.edge_id]], *pose[faces[c.face_id]])
            for c in counted(search.detect_edge_face_candidates(), "edge", "face")
        )
        if any(crosses):
            crossing.append(at)
        if at + 1 == len(poses):
            break
        candidates = ipctk.Candidates()
        candidates.build(mesh, pose, poses[at + 1])
        path = pose, poses[at + 1]
        candidates.ee_candidates = counted(candidates.ee_candidates, "edge0", "edge1", *path)
        candidates.fv_candidates = counted(candidates.fv_candidates, "face", "vertex", *path)
        if not candidates.is_step_collision_free(mesh, *path, narrow_phase_ccd=ccd):
            hit.append(at)
    return crossing, hit


def by_ppf(frames: FloatArray, faces: IntArray, folder: str) -> list[IntArray]:
    """Return the (n, 2) pairs of triangles that ppf's check finds in each frame."""
    if folder not in sys.path:
        sys.path.insert(0, folder)
    # Its modules import each other, and load only in this order.
    import ppf._bvh_  # type: ignore[import-not-found]  # noqa: F401
    from ppf._intersection_ import check_self_intersection  # type: ignore[import-not-found]

    return [
        np.array(check_self_intersection(one, faces), np.int64).reshape(-1, 2) for one in frames
    ]


def counts(body: RigBody, frames: FloatArray, ppf: str | None) -> dict[str, Any]:
    """Return in how many poses, and between how many, counting pairs cross, as JSON values."""
    crossing, hit = hits_on_counted_pairs(body, frames)
    answer = {"poses": len(frames), "ipctk_crossing": len(crossing), "ipctk_hit": len(hit)}
    if ppf is None:
        return answer
    faces, n_crossing, n_pairs, n_left_out = body.topology.faces, 0, 0, 0
    for pairs in by_ppf(frames, faces, ppf):
        # The project ignores two faces with a common vertex.
        share = (faces[pairs[:, 0], :, None] == faces[pairs[:, 1], None, :]).any(axis=(1, 2))
        rules = body.detector.rules_of(pairs[~share].astype(np.int32), np.ones((~share).sum()))
        n_crossing += int((rules == 0).any())
        n_pairs += int((rules == 0).sum())
        n_left_out += int((rules != 0).sum() + share.sum())
    return answer | {
        "ppf_crossing": n_crossing,
        "ppf_pairs": n_pairs,
        "ppf_pairs_left_out": n_left_out,
    }


def _main(character: str, path: str, ppf: str | None = None) -> None:
    from tests.app.blender.test_addon import in_file_order

    body = open_body(character)
    with np.load(path) as file:
        rows = {
            name: counts(body, in_file_order(body, file[name]), ppf) for name in ("before", "after")
        }
    sys.stdout.write(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    _main(*sys.argv[1:])
