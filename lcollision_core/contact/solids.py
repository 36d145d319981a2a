"""Make one closed solid for a 3D printer from a mesh of many layers.

Manifold3d joins closed meshes that do not cross themselves. A layer that does, as skin in the
crease of a joint, becomes a thin skin first: a prism for each face that crosses another, and one
sheet for all others. Their union has the surface seen from outside; its inside is filled.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy

from lcollision_core.contact.detector import CollisionDetector
from lcollision_core.errors import LCollisionError
from lcollision_core.jobs import Job
from lcollision_core.meshes.topology import FloatArray, Topology, name_twice

if TYPE_CHECKING:
    from manifold3d import Manifold

IndexArray = npt.NDArray[np.int64]
Where = Callable[[FloatArray], str]
"""Describe the position of a (3,) point, for a message."""

_SKIN = 1e-5
"""Thickness of a skin, in heights of the figure."""
_WIDE = 0.25
"""A layer is open, rather than a hull with holes, if its caps exceed this share of its area."""
_FLAT = 0.1
"""A closed layer is flat if its mean thickness is below this share of the least wall."""
_BACK = -0.999999
"""Cosine between normals from which neighbours count as folded onto each other."""
_SOUND = 0.8
"""Least volume of the solid of a skin, as a share of the volume that the layer encloses."""
_MITRE = 0.5
"""Least cosine by which offsets at sharp edges are lengthened."""
_SLIVER, _WELD = 1e-6, 1e-4
"""Length of edges too short to store, and size of grains over rounding errors, in heights."""
_TRIES = 12
_RAYS = 4000
"""Number of points at which the wall is measured."""


@dataclass(frozen=True, eq=False)
class Layer:
    """Faces joined along edges of two faces, with their holes closed.

    Attributes
    ----------
    vertices : (n, 3) array
    faces : (m, 3) array, with those that close the holes
    kind : "closed", "capped" or "thickened"; the faces of a thickened layer are its mid-surface
    """

    vertices: FloatArray
    faces: IndexArray
    kind: str


def split_layers(
    vertices: FloatArray,
    faces: npt.NDArray[np.integer],
    wall: float,
    open_layers: str,
    where: Where,
) -> list[Layer]:
    """Return the layers of a mesh, each closed.

    Parameters
    ----------
    vertices : (V, 3) array
    faces : (F, 3) array
    wall : > 0, thickness of thickened layers
    open_layers : "close" or "thicken"; "auto" closes the holes of hulls and thickens the rest
    where : describes positions in messages

    Raises
    ------
    LCollisionError : a layer to be closed encloses nothing, or there are no faces.
    """
    corners, vertex_of, layer_of = _separated(np.asarray(faces, dtype=np.int64))
    layers: list[Layer] = []
    for own in np.split(np.argsort(layer_of, kind="stable"), _ends(layer_of)):
        used, local = np.unique(corners[own], return_inverse=True)
        points, local = vertices[vertex_of[used]], local.reshape(-1, 3)
        if not _areas(points, local).any():
            continue
        closed, caps = _capped(points, local)
        all_faces = np.concatenate([local, caps])
        volume = _volume(closed, all_faces)
        share = _areas(closed, caps).sum() / _areas(points, local).sum()
        is_flat = 2.0 * abs(volume) < _FLAT * wall * _areas(closed, all_faces).sum()
        if is_flat and open_layers == "close":
            raise LCollisionError(
                "has no volume even with its holes closed",
                "thicken open layers instead",
                where=f"a layer {where(points.mean(axis=0))}",
            )
        thickens = len(caps) and (open_layers == "thicken" or share > _WIDE)
        if is_flat or (thickens and open_layers != "close"):
            layers.append(Layer(points, local, "thickened"))
            continue
        if volume < 0.0:
            all_faces = all_faces[:, ::-1]
        kind = "capped" if len(caps) else "closed"
        layers.append(Layer(closed, all_faces, kind))
    if not layers:
        raise LCollisionError("has no faces to print", where="the figure")
    return layers


def join_layers(
    layers: Sequence[Layer], height: float, wall: float, where: Where, job: Job
) -> tuple[Manifold, float]:
    """Join closed layers to a solid and fill its cavities.

    Parameters
    ----------
    height : of the figure
    wall : thickness of thickened layers
    where : describes positions in messages

    Returns
    -------
    solid
    filled : the volume of the cavities

    Raises
    ------
    LCollisionError : a layer cannot be made solid.
    """
    crossing = _crossing_faces([layer for layer in layers if layer.kind != "thickened"])
    solids = []
    for done, layer in enumerate(layers):
        job.check()
        if layer.kind == "thickened":
            solids.append(_union(_prisms(layer.vertices, layer.faces, wall / 2.0, wall / 2.0)))
        else:
            solids.append(_outside(layer, next(crossing), _SKIN * height, where))
        job.report(done + 1, len(layers) + 1)
    joined = _union(solids)
    filled = _filled(joined)
    return filled, float(filled.volume() - joined.volume())


def pinned(
    solid: Manifold, reach: float, radius: float, where: Where
) -> tuple[Manifold, list[FloatArray]]:
    """Join the loose pieces of a solid, each by a pin where it is nearest to the others.

    Parameters
    ----------
    reach : largest gap that is bridged
    radius : of a pin

    Returns
    -------
    solid
    pins : (2, 3) ends of each

    Raises
    ------
    LCollisionError : the gap between a piece and all others exceeds `reach`.
    """
    from manifold3d import Manifold

    pieces = sorted(solid.decompose(), key=lambda piece: -float(piece.volume()))
    if len(pieces) == 1:
        return solid, []
    clouds = [_mesh_of(piece.refine_to_length(max(reach, radius)))[0] for piece in pieces]
    joined, loose, pins = clouds[0], clouds[1:], list[FloatArray]()
    balls = []
    while loose:
        neighbours = [scipy.spatial.cKDTree(joined).query(cloud) for cloud in loose]
        nearest = min(range(len(loose)), key=lambda n: float(neighbours[n][0].min()))
        gaps, at = neighbours[nearest]
        end = int(gaps.argmin())
        pin = np.stack([loose[nearest][end], joined[at[end]]])
        if gaps[end] > reach:
            raise LCollisionError(
                f"is loose: {gaps[end]:.1f} mm from the rest of the figure",
                "join farther parts, stand it on a base, or leave the part out",
                where=f"a part {where(pin[0])}",
            )
        ball = Manifold.sphere(radius, 12)
        balls.append(Manifold.batch_hull([ball.translate(point) for point in pin]))
        pins.append(pin)
        joined = np.concatenate([joined, loose.pop(nearest)])
    return _filled(_union([solid, *balls])), pins


def with_plate(solid: Manifold, thickness: float, sink: float, margin: float) -> Manifold:
    """Put a solid that stands on z = 0 on a round plate, whose underside is at z = 0.

    The plate covers the parts near the ground and the point below the figure's centre of mass.

    Parameters
    ----------
    thickness : of the plate
    sink : how deep the figure stands in it
    margin : of the plate around the figure
    """
    from manifold3d import Manifold

    points, faces = _mesh_of(solid)
    low = points[points[:, 2] < 0.05 * points[:, 2].max(), :2]
    corners = points[faces]
    volumes = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    weight = (volumes @ corners.sum(axis=1))[:2] / (4.0 * volumes.sum())
    low = np.vstack([low, weight])
    middle = (low.min(axis=0) + low.max(axis=0)) / 2.0
    radius = float(np.linalg.norm(low - middle, axis=1).max()) + margin
    plate = Manifold.cylinder(thickness, radius, circular_segments=96)
    raised = solid.translate([0.0, 0.0, thickness - sink])
    return _filled(_union([raised, plate.translate([*middle, 0.0])]))


def measured_walls(solid: Manifold, wall: float) -> tuple[FloatArray, FloatArray]:
    """Measure the wall at points spread evenly over the surface, along the inward normal.

    Returns
    -------
    places : (n, 3) array
    thickness : (n,) array, at most `wall`
    """
    points, faces = _mesh_of(solid)
    middles, normals = _middles(points, faces)
    reached = np.cumsum(_areas(points, faces))
    spread = (np.arange(_RAYS) + 0.5) / _RAYS * reached[-1]
    picked = np.unique(np.searchsorted(reached, spread))
    return middles[picked], _thickness(solid, middles[picked], normals[picked], wall)


def stored(
    solid: Manifold, height: float, dtype: npt.DTypeLike, where: Where
) -> tuple[npt.NDArray[np.floating], IndexArray]:
    """Return the mesh of a solid as a file stores it: closed, with no crossing faces.

    Where rounding makes faces cross, as slivers do, a grain of about one ten-thousandth of the
    height covers them.

    Parameters
    ----------
    dtype : of the file's coordinates

    Returns
    -------
    vertices : (V, 3) array of that type, no two equal
    faces : (F, 3) array

    Raises
    ------
    LCollisionError : faces still cross, or the mesh stays open, after the last attempt.
    """
    from manifold3d import Manifold

    generator = np.random.default_rng(0)
    for trial in range(_TRIES):
        points, faces = _mesh_of(solid.simplify(_SLIVER * height))
        vertices, of = np.unique(points.astype(dtype), axis=0, return_inverse=True)
        named = of.reshape(-1)[faces]
        named = named[~name_twice(named)]
        topology = Topology(named, len(vertices))
        pairs = CollisionDetector(topology, vertices).detect(vertices).pairs
        if topology.is_watertight and not len(pairs):
            # Drop crumbs that rounding has made of slivers.
            layer_of = _separated(named)[2]
            named = named[layer_of == np.bincount(layer_of).argmax()]
            used, named = np.unique(named, return_inverse=True)
            return vertices[used], named.reshape(-1, 3)
        exact = vertices.astype(np.float64)
        areas = _areas(exact, named)
        smaller = np.unique(pairs[np.arange(len(pairs)), areas[pairs].argmin(axis=1)])
        edges = np.concatenate([topology.non_manifold_edges, topology.boundary_edges])
        grain = _WELD * height * (1 + trial)
        welds = [
            (exact[ends][:, None] + generator.normal(0.0, grain, (9, 3))).reshape(-1, 3)
            for ends in (*named[smaller], *edges)
        ]
        solid = _filled(_union([solid, *map(Manifold.hull_points, welds)]))
    raise LCollisionError(
        "cannot be stored as one closed surface",
        "change the height a little, or write .3mf",
        where=f"the figure {where(welds[0].mean(axis=0))}",
    )


def _mesh_of(solid: Manifold) -> tuple[FloatArray, IndexArray]:
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int64)


def _manifold(vertices: FloatArray, faces: IndexArray) -> Manifold:
    from manifold3d import Manifold, Mesh64

    return Manifold(Mesh64(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.uint64)))


def _union(solids: Sequence[Manifold]) -> Manifold:
    from manifold3d import Manifold, OpType

    return Manifold.batch_boolean(list(solids), OpType.Add)


def _filled(solid: Manifold) -> Manifold:
    """Return a solid without its cavities."""
    # The surface of a cavity has a negative volume.
    return _union([piece for piece in solid.decompose() if piece.volume() > 0.0])


def _outside(layer: Layer, crossing: npt.NDArray[np.bool_], skin: float, where: Where) -> Manifold:
    """Return the solid that a closed layer encloses, from its surface seen from outside."""
    vertices, faces = layer.vertices, layer.faces
    if not crossing.any():
        solid = _manifold(vertices, faces)
        if solid.status().name == "NoError" and not solid.is_empty():
            return solid
        crossing = np.ones_like(crossing)
    # The sheet ends one face away from crossing faces.
    near = np.zeros(len(vertices), dtype=np.bool_)
    near[faces[crossing]] = True
    single = np.asarray(near[faces].any(axis=1))
    every = np.ones_like(single)
    for thickness, chosen in itertools.product((skin, 10.0 * skin), (single, every)):
        solid = _filled(_union(_skin(vertices, faces, chosen, thickness)))
        # A skin that leaks encloses nothing.
        if solid.volume() > _SOUND * _volume(vertices, faces):
            return solid
    raise LCollisionError(
        "intersects itself too much to form one solid",
        "resolve or change the pose there",
        where=f"a layer {where(vertices[faces[crossing]].mean(axis=(0, 1)))}",
    )


def _skin(
    vertices: FloatArray, faces: IndexArray, single: npt.NDArray[np.bool_], thickness: float
) -> list[Manifold]:
    """Return the skin inside a closed layer: prisms of single faces, a sheet of the others."""
    inside = vertices - _normals(vertices, faces) * thickness
    pieces = _prisms(vertices, faces, thickness, 0.0, single)
    if not single.all():
        sheet, vertex_of, _ = _separated(faces[~single])
        n = len(vertex_of)
        start, end = _rim(sheet)
        walls = [np.stack([end, start, start + n], 1), np.stack([end, start + n, end + n], 1)]
        both = np.concatenate([vertices[vertex_of], inside[vertex_of]])
        pieces.append(_manifold(both, np.concatenate([sheet, sheet[:, ::-1] + n, *walls])))
    return pieces


def prism_corners(vertices: FloatArray, faces: IndexArray, back: float, front: float) -> FloatArray:
    """Return the points of which each face's prism is the convex hull, (F, n, 3).

    Prisms of neighbours share the hull of their common side, however bent.

    Parameters
    ----------
    back, front : how far a prism reaches behind and in front of its face
    """
    corners, bent = vertices[faces], _normals(vertices, faces)[faces]
    middles, flat = _middles(vertices, faces)
    straight = _unit(flat)[:, None]
    ends = [corners + way * to for way in (bent, straight) for to in (front, -back)]
    # A face without area still seals the gap between its neighbours.
    is_thin = np.linalg.norm(flat, axis=1) < (back + front) ** 2
    grain = (0.25 * (back + front) * is_thin)[:, None, None]
    around = middles[:, None] + grain * np.vstack([np.eye(3), -np.eye(3)])
    return np.concatenate([*ends, around], axis=1)


def _prisms(
    vertices: FloatArray,
    faces: IndexArray,
    back: float,
    front: float,
    chosen: npt.NDArray[np.bool_] | slice = slice(None),
) -> list[Manifold]:
    """Return the convex prisms of the chosen faces: see `prism_corners`."""
    from manifold3d import Manifold

    corners = prism_corners(vertices, faces, back, front)[chosen]
    return [Manifold.hull_points(ends) for ends in corners]


def _separated(faces: IndexArray) -> tuple[IndexArray, IndexArray, IndexArray]:
    """Cut faces apart at edges with more than two faces, or two of opposite orientation.

    Returns
    -------
    corners : (F, 3) array, the faces by new vertices
    vertex_of : the old vertex of each new one
    layer_of : (F,) array
    """
    start, end = _edges(faces)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    _, first, count = np.unique(
        np.stack([low, high])[:, order], axis=1, return_index=True, return_counts=True
    )
    one, two = order[first[count == 2]], order[first[count == 2] + 1]
    is_joined = start[one] != start[two]
    one, two = one[is_joined], two[is_joined]
    after_one, after_two = (3 * (edge // 3) + (edge % 3 + 1) % 3 for edge in (one, two))
    same = np.concatenate([one, after_one]), np.concatenate([after_two, two])
    n_vertices, corner = _components(*same, faces.size)
    vertex_of = np.empty(n_vertices, dtype=np.int64)
    vertex_of[corner] = faces.ravel()
    return corner.reshape(-1, 3), vertex_of, _components(one // 3, two // 3, len(faces))[1]


def _components(one: IndexArray, two: IndexArray, size: int) -> tuple[int, IndexArray]:
    graph = scipy.sparse.coo_matrix((np.ones(len(one)), (one, two)), (size, size))
    count, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return int(count), label.astype(np.int64)


def _ends(labels: IndexArray) -> IndexArray:
    return np.cumsum(np.bincount(labels))[:-1]


def _edges(faces: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Return where the edge from each corner to the next begins and ends, (3 F,) each."""
    return faces.ravel(), np.roll(faces, -1, axis=1).ravel()


def _rim(faces: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Return the start and end of each edge that has only one face."""
    start, end = _edges(faces)
    n = int(faces.max()) + 1
    is_rim = ~np.isin(start * n + end, end * n + start)
    return start[is_rim], end[is_rim]


def _capped(vertices: FloatArray, faces: IndexArray) -> tuple[FloatArray, IndexArray]:
    """Return the vertices with the middle of each hole, and the fans that close the holes."""
    start, end = _rim(faces)
    if not len(start):
        return vertices, np.empty((0, 3), dtype=np.int64)
    hole = _components(start, end, len(vertices))[1]
    used, hole = np.unique(hole[start], return_inverse=True)
    middles = np.zeros((len(used), 3))
    np.add.at(middles, hole, vertices[start])
    middles /= np.bincount(hole)[:, None]
    return np.concatenate([vertices, middles]), np.stack([end, start, len(vertices) + hole], axis=1)


def _volume(vertices: FloatArray, faces: IndexArray) -> float:
    one, two, three = (vertices[faces[:, corner]] for corner in range(3))
    return float(np.einsum("fi,fi->", one, np.cross(two, three))) / 6.0


def _middles(vertices: FloatArray, faces: IndexArray) -> tuple[FloatArray, FloatArray]:
    """Return the centroids of faces and their normals, twice their areas long; (F, 3) each."""
    corners = vertices[faces]
    sides = corners[:, 1:] - corners[:, :1]
    return corners.mean(axis=1), np.cross(sides[:, 0], sides[:, 1])


def _areas(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    areas: FloatArray = np.linalg.norm(_middles(vertices, faces)[1], axis=1) / 2.0
    return areas


def _normals(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    """Return (V, 3) angle-weighted normals, longer where faces are oblique to them."""
    flat = _unit(_middles(vertices, faces)[1])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        here, to, back = (vertices[faces[:, (corner + step) % 3]] for step in range(3))
        cosine = np.einsum("fi,fi->f", _unit(to - here), _unit(back - here))
        np.add.at(normals, faces[:, corner], flat * np.arccos(np.clip(cosine, -1, 1))[:, None])
    normals = _unit(normals)
    slope = np.ones(len(vertices))
    np.minimum.at(slope, faces, np.einsum("fi,fci->fc", flat, normals[faces]))
    return normals / np.maximum(slope, _MITRE)[:, None]


def _unit(vectors: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    units: FloatArray = np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.0)
    return units


def _thickness(
    solid: Manifold, middles: FloatArray, normals: FloatArray, most: float
) -> FloatArray:
    inwards = -_unit(normals)
    # Start below the face, so that the ray does not hit it.
    starts, ends = middles + inwards * (1e-6 * most), middles + inwards * most
    hits = (solid.ray_cast(start, end) for start, end in zip(starts, ends, strict=True))
    return np.array([most * (hit[0].distance if hit else 1.0) for hit in hits])


def _crossing_faces(layers: Sequence[Layer]) -> Iterator[npt.NDArray[np.bool_]]:
    """Yield for each layer whether each face crosses another face of that layer."""
    if not layers:
        return
    starts = np.cumsum([0, *(len(layer.vertices) for layer in layers)])
    faces = np.concatenate([layer.faces + n for layer, n in zip(layers, starts, strict=False)])
    vertices = np.concatenate([layer.vertices for layer in layers])
    ends = np.cumsum([len(layer.faces) for layer in layers])
    owner = np.searchsorted(ends, np.arange(len(faces)), side="right")
    pairs = CollisionDetector(Topology(faces, len(vertices)), vertices).detect(vertices).pairs
    crossing = np.zeros(len(faces), dtype=np.bool_)
    crossing[pairs[owner[pairs[:, 0]] == owner[pairs[:, 1]]]] = True
    crossing[_folded(vertices, faces)] = True
    yield from np.split(crossing, ends[:-1])


def _folded(vertices: FloatArray, faces: IndexArray) -> IndexArray:
    """Return the faces folded onto a neighbour, or that cross a face with one common corner."""
    start, end = _edges(faces)
    order = np.lexsort((np.maximum(start, end), np.minimum(start, end)))
    flat = _unit(_middles(vertices, faces)[1])
    one, two = order.reshape(-1, 2).T // 3  # all edges have two faces
    is_back = np.einsum("ei,ei->e", flat[one], flat[two]) < _BACK
    folds = np.concatenate([one[is_back], two[is_back]])
    order = np.argsort(faces.ravel(), kind="stable")
    counts = np.bincount(faces.ravel())
    starts = np.cumsum(counts) - counts
    pairs = [np.empty((2, 0), dtype=np.int64)]
    for size in np.unique(counts[counts > 1]):
        beside = np.stack(np.triu_indices(int(size), 1))[:, None]
        pairs.append((starts[counts == size][:, None] + beside).reshape(2, -1))
    corners = order[np.concatenate(pairs, axis=1)]
    # (2, n, 3) vertices, the shared one first.
    turned = 3 * (corners // 3)[..., None] + (corners[..., None] + np.arange(3)) % 3
    one, two = faces.ravel()[turned]
    apart = ~(one[:, 1:, None] == two[:, None, 1:]).any(axis=(1, 2))
    one, two, owners = vertices[one[apart]], vertices[two[apart]], corners[:, apart] // 3
    across = owners[:, _pierces(one, two) | _pierces(two, one)]
    return np.unique(np.concatenate([folds, across.ravel()]))


def _pierces(one: FloatArray, two: FloatArray) -> npt.NDArray[np.bool_]:
    """Return whether the side opposite the first corner of one face pierces another face."""
    begin, end = one[:, 1], one[:, 2]
    across = _signed(two[:, 0], two[:, 1], two[:, 2], begin) * _signed(
        two[:, 0], two[:, 1], two[:, 2], end
    )
    around = np.stack([_signed(begin, end, two[:, n], two[:, (n + 1) % 3]) for n in range(3)])
    pierces: npt.NDArray[np.bool_] = (across < 0.0) & (
        (around > 0.0).all(axis=0) | (around < 0.0).all(axis=0)
    )
    return pierces


def _signed(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> Any:
    return np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a)
