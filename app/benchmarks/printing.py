"""Poses printed to files, and the files judged by independent code.

The fields of a row:

body, poses : the body, and how many random poses of it were printed
refused : poses that could not become one solid
watertight, volumes : files that trimesh finds closed, and that it finds to be oriented volumes
manifold : files that manifold3d accepts without error, as one piece
free : files without colliding pairs, all pairs counted
difference : largest relative difference between a file's volume, without filled cavities, and that
    of its closed parts by `column_volume`
filled : largest share of the volume that was enclosed between parts
layers : closed, capped and thickened ones, of the first pose
pins : largest number of pins that join loose parts
faces : of the files, on average
thin : largest share of the surface that is thinner than the wall
seconds : per pose, with Resolve; the median
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull

from app.benchmarks.measures import Row
from lcollision_core.bodies import NamedPose, open_body, sample_poses
from lcollision_core.contact import solids
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.options import NO_CHANGE, PrintOptions
from lcollision_core.tasks.checking import CheckRequest, check_mesh
from lcollision_core.tasks.printing import print_pose
from lcollision_core.tasks.verdicts import PrintedFigure

ClosedMesh = tuple[FloatArray, npt.NDArray[np.integer]]
_COLUMNS = 200
"""Number of columns in each direction."""
_ASIDE = 0.5137
"""Offset of the rays, in column widths: an irregular number that avoids edges of a mesh."""


def column_volume(parts: Sequence[ClosedMesh]) -> float:
    """Return the volume of the union of closed meshes, which may cross themselves.

    A ray along z near the middle of each of `_COLUMNS` squared columns gives the exact length
    with a non-zero winding number; the volume is the sum of the lengths times a column's area.
    """
    low = np.min([vertices.min(axis=0) for vertices, _ in parts], axis=0)
    size = np.max([vertices.max(axis=0) for vertices, _ in parts], axis=0) - low
    crossings: list[FloatArray] = []
    for vertices, faces in parts:
        corners = (vertices[faces] - low) / [*(size[:2] / _COLUMNS), 1.0]
        first = np.ceil(corners[:, :, :2].min(axis=1) - _ASIDE).astype(int)
        count = np.floor(corners[:, :, :2].max(axis=1) - _ASIDE).astype(int) + 1 - first
        cells = np.maximum(count, 0).prod(axis=1)
        face = np.repeat(np.arange(len(faces)), cells)
        number = np.arange(len(face)) - np.repeat(np.cumsum(cells) - cells, cells)
        at = first[face] + np.stack([number // count[face, 1], number % count[face, 1]], axis=1)
        a, b, c = corners[face].transpose(1, 0, 2)
        shares = np.stack(
            [_area(corner, other, at + _ASIDE) for corner, other in ((b, c), (c, a), (a, b))],
            axis=1,
        )
        area = shares.sum(axis=1)
        hit = ((shares * np.sign(area)[:, None] >= 0.0).all(axis=1)) & (area != 0.0)
        z = np.einsum("nk,nk->n", shares, corners[face][:, :, 2])[hit] / area[hit]
        column = (at @ [_COLUMNS, 1])[hit]
        order = np.lexsort((z, column))
        winding = _sums(column[order], np.sign(area[hit])[order]) != 0.0
        was = np.concatenate([[False], winding[:-1]])
        was[np.flatnonzero(np.diff(column[order])) + 1] = False
        crossings.append(np.stack([column[order], z[order], winding.astype(float) - was], axis=1))
    column, z, change = np.concatenate(crossings).T
    order = np.lexsort((z, column))
    inside = _sums(column[order], change[order])[:-1] > 0.0
    inside &= np.diff(column[order]) == 0.0
    return float(np.diff(z[order])[inside].sum() * (size[:2] / _COLUMNS).prod())


def _area(one: FloatArray, other: FloatArray, at: FloatArray) -> FloatArray:
    (x, y), (to_x, to_y) = (one[:, :2] - at).T, (other[:, :2] - at).T
    area: FloatArray = x * to_y - y * to_x
    return area


def _sums(groups: npt.NDArray[np.floating], values: FloatArray) -> FloatArray:
    """Return running sums of `values` that restart at 0 with each run of equal `groups`."""
    sums = np.cumsum(values)
    starts = np.flatnonzero(np.diff(groups, prepend=-1.0))
    before = np.concatenate([[0.0], sums])[starts]
    runs: FloatArray = sums - np.repeat(before, np.diff([*starts, len(groups)]))
    return runs


def parts_of(layers: Sequence[solids.Layer], wall: float) -> list[ClosedMesh]:
    """Return the closed meshes of layers, for thickened ones one per face."""
    parts: list[ClosedMesh] = []
    for layer in layers:
        if layer.kind != "thickened":
            parts.append((layer.vertices, layer.faces))
            continue
        for corners in solids.prism_corners(layer.vertices, layer.faces, wall / 2.0, wall / 2.0):
            hull = ConvexHull(corners)
            a, b, c = corners[hull.simplices].transpose(1, 0, 2)
            turned = np.einsum("ni,ni->n", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
            faces = np.where(turned[:, None], hull.simplices[:, ::-1], hull.simplices)
            parts.append((corners, faces))
    return parts


def printed_rows(names: Sequence[str], n_poses: int, job: Job = UNWATCHED) -> list[Row]:
    """Print random poses of each body, and check the files."""
    rows: list[Row] = []
    options = PrintOptions()
    for name in names:
        body, printed, refused = open_body(name), list[Row](), 0
        for number, codes in enumerate(sample_poses(body, n_poses, 0, None)):
            job.check()
            with TemporaryDirectory() as folder:
                path, began = Path(folder) / "figure.stl", time.perf_counter()
                try:
                    figure = print_pose(body, NamedPose(f"pose {number}", codes), path, options)
                except LCollisionError as error:
                    job.note(f"{name}: {error}")
                    refused += 1
                    continue
                seconds = time.perf_counter() - began
                printed.append(_judged(path, figure) | {"seconds": seconds})
            job.report(len(rows) * n_poses + number + 1, len(names) * n_poses)
        rows.append(
            {
                "body": Path(name).stem,
                "poses": n_poses,
                "refused": refused,
                **{field: sum(row[field] for row in printed) for field in _COUNTED},
                **{field: max(row[field] for row in printed) for field in _LARGEST},
                "layers": printed[0]["layers"],
                "faces": float(np.mean([row["faces"] for row in printed])),
                "seconds": float(np.median([row["seconds"] for row in printed])),
            }
        )
    return rows


_COUNTED = "watertight", "volumes", "manifold", "free"
_LARGEST = "difference", "filled", "pins", "thin"


def _judged(path: Path, figure: PrintedFigure) -> Row:
    """Judge a file by trimesh, manifold3d and the exact check."""
    import trimesh
    from manifold3d import Error, Manifold, Mesh64

    mesh = trimesh.load_mesh(path)
    solid = Manifold(Mesh64(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.uint64)))
    checked = check_mesh(path, CheckRequest(NO_CHANGE, None, no_rules=True))
    parts = column_volume(parts_of(figure.layers, figure.wall))
    return {
        "watertight": int(mesh.is_watertight),
        "volumes": int(mesh.is_volume),
        "manifold": int(solid.status() == Error.NoError and len(solid.decompose()) == 1),
        "free": int(not checked.pairs),
        "difference": abs(float(mesh.volume) - figure.filled - parts) / parts,
        "filled": figure.filled / figure.volume,
        "pins": len(figure.pins),
        "thin": figure.thin_share,
        "layers": f"{figure.closed}/{figure.capped}/{figure.thickened}",
        "faces": figure.n_faces,
    }
