"""Prepare a pose for 3D printing: one closed solid in millimetres, as STL or 3MF."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies import Body, NamedPose
from lcollision_core.contact import solids
from lcollision_core.errors import LCollisionError
from lcollision_core.files.formats import FILES, PRINT_SUFFIXES, function_of
from lcollision_core.files.safe import write_bytes
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.meshes import named_group
from lcollision_core.options import PrintOptions, ResolveOptions
from lcollision_core.posing import PoseSpace
from lcollision_core.tasks.exporting import require_output
from lcollision_core.tasks.verdicts import PrintedFigure
from lcollision_core.tasks.words import printed_text

_STEPS = 100
"""Progress steps in all; the first half is Resolve's."""
_THINNEST = 1.0
"""Percentile of the surface's wall thickness that is reported as the thinnest wall."""


def print_pose(
    body: Body,
    pose: NamedPose,
    path: Path,
    options: PrintOptions,
    job: Job = UNWATCHED,
    *,
    resolve: ResolveOptions | None = None,
    own: Callable[[], PoseSpace] | None = None,
) -> PrintedFigure:
    """Resolve a pose, merge it into one solid standing on z = 0, and write it.

    Parameters
    ----------
    path : a file of `PRINT_SUFFIXES`
    resolve : options of Resolve
    own : makes the pose space of the body in a frame of a motion

    Raises
    ------
    LCollisionError : the pose cannot become one solid (the place is named), or the file cannot be
        written.
    CancelledError : the job was cancelled.
    """
    require_output(path, *PRINT_SUFFIXES)
    check = body.exact_check(pose.placement, own and own())
    before = check.collisions(pose.latent)
    latent = pose.latent
    if options.resolve and body.can_resolve and before.colliding:
        resolver = body.resolver if own is None else body.resolver.with_check(check)
        part = job.part(lambda done, total: job.report(50 * done // max(total, 1), _STEPS))
        latent = resolver.resolve(latent, resolve, part, pose.placement).latent
    posed = np.asarray(check.exported(check.decode(latent)[0]), dtype=np.float64)
    after = check.find(posed)
    job.report(50, _STEPS)

    faces = body.faces[~_left_out(body, options.without)]
    if not len(faces):
        raise LCollisionError("leaves nothing to print", "name fewer parts", where="--without")
    vertices = _upright(body, posed, faces, options.height)
    places = _Places(body, vertices, faces)
    part = job.part(lambda done, total: job.report(50 + 40 * done // total, _STEPS))
    wall = options.wall
    layers = solids.split_layers(vertices, faces, wall, options.open_layers, places.where)
    solid, filled = solids.join_layers(layers, options.height, wall, places.where, part)
    # Thickened layers reach below the ground.
    places.raised = -solid.bounding_box()[2]
    solid = solid.translate([0.0, 0.0, places.raised])
    if options.base is not None:
        sink = min(options.base, wall) / 2.0
        solid = solids.with_plate(solid, options.base, sink, options.height / 30.0)
        places.raised += options.base - sink
    job.check()
    solid, pins = solids.pinned(solid, options.reach, wall / 2.0, places.where)
    job.report(95, _STEPS)
    at, walls = solids.measured_walls(solid, wall)
    is_thin = walls < 0.999 * wall
    low = np.array(solid.bounding_box()[:3])
    form = FILES[path.suffix.lower()]
    dtype = np.float32 if form.is_single else np.float64
    written, triangles = solids.stored(
        *(solid.translate(-low), options.height, dtype), lambda point: places.where(point + low)
    )
    job.check()
    write_bytes(path, function_of(form.writer)(written, triangles))
    job.report(_STEPS, _STEPS)
    kinds = [layer.kind for layer in layers]
    x, y, z = np.ptp(written, axis=0).tolist()
    return PrintedFigure(
        pose=pose.name,
        output=str(path),
        height=options.height,
        size=(x, y, z),
        volume=float(solid.volume()),
        filled=filled,
        n_vertices=len(written),
        n_faces=len(triangles),
        closed=kinds.count("closed"),
        capped=kinds.count("capped"),
        thickened=kinds.count("thickened"),
        pins=[(pin.mean(axis=0) - low).tolist() for pin in pins],
        pairs_before=len(before.pairs),
        pairs_after=len(after.pairs),
        wall=wall,
        thinnest=float(np.percentile(walls, _THINNEST)),
        thin_share=float(is_thin.mean()),
        thin_places=places.most(at[is_thin]),
        layers=layers,
    )


def export_print(
    body: Body, pose: NamedPose, path: Path, options: PrintOptions, job: Job, **known: Any
) -> str:
    """Print a pose as `print_pose` does; return a sentence for the status bar."""
    figure = print_pose(body, pose, path, options, job, **known)
    return printed_text(replace(figure, output=f"Exported {path.name}"))


def _left_out(body: Body, names: tuple[str, ...]) -> npt.NDArray[np.bool_]:
    groups = {group.name: group for kind in body.groups_by_kind.values() for group in kind}
    left_out = np.zeros(len(body.faces), dtype=np.bool_)
    for name in names:
        left_out[groups[named_group(name, groups)].faces] = True
    return left_out


def _upright(
    body: Body,
    posed: npt.NDArray[np.float64],
    faces: npt.NDArray[np.integer],
    height: float,
) -> npt.NDArray[np.float64]:
    """Return (V, 3) vertices in millimetres: z up from 0, front towards -y."""
    up = np.asarray(body.up)
    back = -body.front + up * (body.front @ up)
    back /= np.linalg.norm(back)
    turned = posed @ np.stack([np.cross(back, up), back, up], axis=1)
    used = turned[np.unique(faces)]
    extent = float(np.ptp(used[:, 2]))
    if extent <= 0.0:
        raise LCollisionError("has no height", "choose its up axis", where="the figure")
    middle = (used.min(axis=0) + used.max(axis=0)) / 2.0
    middle[2] = used[:, 2].min()
    upright: npt.NDArray[np.float64] = (turned - middle) * (height / extent)
    return upright


class _Places:
    """Describes places of a figure by the body part and mesh of the nearest vertex.

    Attributes
    ----------
    raised : shift along z since the vertices were given
    """

    def __init__(
        self,
        body: Body,
        vertices: npt.NDArray[np.float64],
        faces: npt.NDArray[np.integer],
    ) -> None:
        from scipy.spatial import cKDTree

        self.raised = 0.0
        self._used = np.unique(faces)
        self._tree = cKDTree(vertices[self._used])
        self._part = body.space.vertex_domain
        self._parts = body.domain_names
        self._mesh = np.full(len(vertices), "", dtype=object)
        for group in body.groups:
            if not group.about_joint and not group.is_material:
                self._mesh[body.faces[group.faces]] = group.name

    def where(self, point: npt.NDArray[np.float64]) -> str:
        """Describe a point, as in "of Hat, near Head, at x, y, z = 12, 3, 96 mm"."""
        vertex = int(self._nearest(point))
        at = ", ".join(f"{value:.0f}" for value in point)
        mesh, part = self._mesh[vertex], self._parts[self._part[vertex]]
        of = f"of {mesh}, " if mesh and mesh != part else ""
        return f"{of}near {part}, at x, y, z = {at} mm"

    def most(self, points: npt.NDArray[np.float64]) -> list[str]:
        """Return the parts with most of the points, at most three."""
        if not len(points):
            return []
        parts, counts = np.unique(self._part[self._nearest(points)], return_counts=True)
        return [self._parts[parts[n]] for n in np.argsort(-counts, kind="stable")[:3]]

    def _nearest(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.integer]:
        vertices: npt.NDArray[np.integer] = self._used[
            self._tree.query(points - [0.0, 0.0, self.raised])[1]
        ]
        return vertices
