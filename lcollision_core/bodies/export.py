"""Export poses as meshes, sequences, or in the form of a character's file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.bodies.body import Body
from lcollision_core.bodies.retargeting import write_skeleton
from lcollision_core.bodies.rig_space import RigPoseSpace
from lcollision_core.bundled import bundled_table
from lcollision_core.contact import SelfCollisions
from lcollision_core.errors import MeshFileError
from lcollision_core.files import (
    Character,
    GltfCharacter,
    as_gltf,
    as_stored,
    atomic_files,
    file_stems,
    mesh_files,
    read_character,
    read_mesh,
    write_character,
    write_mesh,
    written_frame,
)
from lcollision_core.files.character_writing import NewClip, write_character_clips
from lcollision_core.files.formats import (
    POINT_CACHE_SUFFIXES,
    SCENE_SUFFIXES,
    SKELETON_SUFFIXES,
)
from lcollision_core.files.mesh.obj import ObjDetail, rewrite_obj
from lcollision_core.files.motion.caches import point_cache, read_frame
from lcollision_core.meshes import FaceGroup, RigidTransform, body_size
from lcollision_core.meshes.face_groups import GROUP_KINDS
from lcollision_core.meshes.normals import corner_normals
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion import Motion
from lcollision_core.options import MODELS_OWN, ExportAxes, ExportRequest

_AXES = np.eye(3)
_X, _Y, _Z = _AXES


_UNITS_IN_A_METRE = {ExportAxes.BLENDER: 1.0, ExportAxes.MAYA: 100.0, ExportAxes.UNREAL: 100.0}

_ALREADY_FIXED = (".glb", ".vrm")
"""glTF is always y up, z forward, in metres."""


def export_scale(model: Body, axes: str) -> float:
    """Return a program's units per model unit, 1 for the model's own axes."""
    units = _UNITS_IN_A_METRE.get(ExportAxes(axes))
    return 1.0 if units is None else units * model.card.metres


def export_frame(
    model: Body,
    axes: str,
    path: str | os.PathLike[str],
    scale: float | None = None,
    placement: RigidTransform | None = None,
) -> RigidTransform:
    """Return the rotation, by right angles, and scale into a file's axes and unit.

    Parameters
    ----------
    model : of the poses
    axes : one of `ExportAxes`
    path : its extension sets the format: a GLB file is in metres, and turned by `write_mesh`
    scale : file units per model unit; by default `export_scale`
    placement : of an imported mesh; it already applies the mesh's unit
    """
    preset = ExportAxes(axes)
    suffix = Path(path).suffix.lower()
    if suffix in _ALREADY_FIXED:
        return RigidTransform(
            np.eye(3), np.zeros(3), model.card.metres if placement is None else 1.0
        )
    factor = export_scale(model, axes) if scale is None else scale
    if preset is ExportAxes.MODEL:
        return RigidTransform(np.eye(3), np.zeros(3), factor)
    up, front = _Y, _Z
    if preset is ExportAxes.UNREAL:
        up, front = _Z, _X
    elif preset is ExportAxes.BLENDER and suffix != ".obj":
        up, front = _Z, -_Y
    own_up, own_front = np.array(model.up), model.front
    model_axes = np.stack([own_up, own_front, np.cross(own_up, own_front)])
    turn = np.stack([up, front, np.cross(up, front)]).T @ model_axes
    # Adding 0 turns -0 into 0.
    return RigidTransform(turn + 0.0, np.zeros(3), factor)


def export_mesh(
    path: str | os.PathLike[str],
    model: Body,
    vertices: npt.NDArray[Any],
    placement: RigidTransform | None = None,
    frame: RigidTransform | None = None,
) -> npt.NDArray[Any]:
    """Write a pose's mesh; unless placed, it is turned upright if the format has an up axis.

    Parameters
    ----------
    path : see `write_mesh`
    model : of the pose
    vertices : (V, 3) array, in the data's unit, placed for export
    placement : that was applied to them, for an imported mesh; else None
    frame : the file's axes and unit, by `export_frame`; by default the model's. It applies to
        placed meshes too.

    Returns
    -------
    written : (V, 3) array as in the file, without the rotation of a GLB file, which is exact

    Raises
    ------
    MeshFileError, ShapeError : as in `write_mesh`.
    """
    written = vertices if frame is None else frame.apply(vertices)
    written = as_stored(path, written, model.topology)
    up = np.array(model.up) if placement is None else None
    is_obj = Path(path).suffix.lower() == ".obj"
    detail = _detail(model, written) if is_obj else None
    write_mesh(path, written, model.faces, up=up, detail=detail)
    return written


def _detail(model: Body, vertices: npt.NDArray[Any]) -> ObjDetail | None:
    """Return further contents of a body's OBJ file; None if there are none.

    The groups are the body's meshes, else its body parts.
    """
    file_groups, parts = (model.groups_by_kind[kind] for kind in GROUP_KINDS[:2])
    uv, uv_faces = _texture_coordinates(model)
    if not file_groups and not len(uv):
        return None
    materials = [group for group in file_groups if group.is_material]
    meshes = [group for group in file_groups if not group.is_material] or list(parts)
    normals, normal_faces = corner_normals(vertices, model.faces, model.reference)
    return ObjDetail(
        normals,
        normal_faces,
        uv,
        uv_faces,
        tuple(group.name for group in meshes),
        _first_group(meshes, len(model.faces)),
        tuple(group.name for group in materials),
        _first_group(materials, len(model.faces)),
    )


def _first_group(groups: Sequence[FaceGroup], n_faces: int) -> npt.NDArray[np.int64]:
    """Return the index of each face's first group, -1 for none."""
    numbers = np.full(n_faces, -1)
    for number, group in reversed(list(enumerate(groups))):
        numbers[group.faces] = number
    return numbers


def _texture_coordinates(
    model: Body,
) -> tuple[npt.NDArray[np.floating[Any]], npt.NDArray[np.int64]]:
    """Return (T, 2) texture coordinates and their (F, 3) indices at corners; empty for none."""
    look = model.appearance
    none = np.empty((0, 2)), np.empty((0, 3), dtype=np.int64)
    if look is None or not look.uv.any():
        return none
    # The body may lack some of the file's faces.
    numbered = enumerate(map(tuple, look.vertices[look.faces].tolist()))
    rows = [
        next((row for row, corners in numbered if corners == wanted), -1)
        for wanted in map(tuple, model.faces.tolist())
    ]
    if -1 in rows:
        return none
    of_corner = look.uv[look.faces[rows]].reshape(-1, 2)
    uv, uv_faces = np.unique(of_corner, axis=0, return_inverse=True)
    # glTF images begin at the top.
    return uv * [1.0, -1.0] + [0.0, 1.0], uv_faces.reshape(-1, 3)


_LARGEST_SIZE_RATIO = 1.01
"""Largest size ratio of a character's file to the model; beyond it, their units differ."""


CLIP = "clip"
"""Key of the form that stores poses as frames of a character's file."""


@dataclass(frozen=True)
class ExportForm:
    """A way to write poses in the form of the user's file.

    Attributes
    ----------
    key : used in settings and options; for a character's file one of `CharacterForm`
    label, explanation : displayed texts
    suffix : of the written files
    of_sources : extensions of source files that offer it; empty for any or no source
    needs_rig : whether the poses must come from the joints of that file
    is_sequence : whether one file holds all poses, as frames
    has_axes : whether axes and unit can be chosen; else they are the source's
    """

    key: str
    label: str
    explanation: str
    suffix: str
    of_sources: tuple[str, ...] = ()
    needs_rig: bool = False
    is_sequence: bool = False
    has_axes: bool = False


EXPORT_FORMS = tuple(bundled_table("export_forms.toml", dict[str, list[ExportForm]])["form"])
"""In display order."""


def offered_forms(
    source: str | os.PathLike[str] | None, *, has_rig: bool = False
) -> tuple[ExportForm, ...]:
    """Return the forms that a source file offers, the best first.

    Parameters
    ----------
    source : the file, None for a model's own meshes
    has_rig : whether the poses come from the joints of that file
    """
    suffix = "" if source is None else Path(source).suffix.lower()
    return tuple(
        form
        for form in EXPORT_FORMS
        if (not form.of_sources or suffix in form.of_sources) and (has_rig or not form.needs_rig)
    )


@dataclass(frozen=True, eq=False)
class WrittenPose:
    """A written pose as readers of its file get it, for checking.

    Attributes
    ----------
    path : of the file
    vertices : (V, 3) array, in the axes and unit of the file; None for a file of codes
    unit : body units per file unit
    notes : sentences about what the file lacks
    """

    path: Path
    vertices: npt.NDArray[Any] | None = None
    unit: float = 1.0
    notes: tuple[str, ...] = ()

    def checked(self, body: Body) -> SelfCollisions:
        """Return the exact check of the mesh as stored in the file, by the body's rules."""
        assert self.vertices is not None
        return body.detector.detect(self.vertices, unit=self.unit)

    def collides(self, body: Body) -> bool:
        """Return whether `checked` finds counted pairs; several times faster."""
        assert self.vertices is not None
        collisions = body.detector.detect(self.vertices, unit=self.unit, counted_only=True)
        return collisions.colliding


class SourceFile:
    """A body's source file whose form exports keep: an OBJ file, or a character's.

    Parameters
    ----------
    path : of the file
    body : the body whose poses are written

    Attributes
    ----------
    path : as given
    forms : the offered forms, the best first
    frame : for a character, the transform from its coordinates to the written file's

    Raises
    ------
    MeshFileError : it cannot be read, or its format has no export forms.
    PoseSetError : it belongs to another body.
    """

    def __init__(self, path: str | os.PathLike[str], body: Body) -> None:
        self.path = Path(path)
        self._body = body
        self._character: Character | None = None
        self.frame: RigidTransform | None = None
        suffix = self.path.suffix.lower()
        character = body.character
        is_own = character is not None and _is_same_file(character.source, self.path)
        self.forms = offered_forms(path, has_rig=is_own)
        if suffix == ".obj":
            mesh = read_mesh(path, topology=body.topology)
            body.require_topology(mesh.topology, str(path))
        elif suffix in SCENE_SUFFIXES:
            self._character = (
                character
                if character is not None and is_own
                else read_character(path, topology=body.topology)
            )
            body.require_topology(self._character.topology, str(path))
            self._require_unit(self._character)
            self.frame = written_frame(self._character)
        else:
            raise MeshFileError(
                f"has a format that cannot be written ({suffix or 'no extension'})",
                f"use one of .obj, {', '.join(SCENE_SUFFIXES)}",
                where=path,
            )

    def _require_unit(self, character: Character) -> None:
        ratio = body_size(character.rest_vertices, character.topology) / self._body.body_size
        if not 1.0 / _LARGEST_SIZE_RATIO < ratio < _LARGEST_SIZE_RATIO:
            raise MeshFileError(
                f"is {ratio:.3g} times as large as the body of {self._body.name!r}",
                "name the file that the model was trained on",
                where=self.path,
            )

    def require_form(self, path: str | os.PathLike[str], key: str | None) -> ExportForm:
        """Return the form of an output file.

        Parameters
        ----------
        path : of the output
        key : of the form; None for the best one with the output's extension

        Raises
        ------
        MeshFileError : the form or extension is not offered.
        """
        suffix = Path(path).suffix.lower()
        vrm = self.path.suffix.lower() == ".vrm"
        for form in self.forms:
            fits = suffix == form.suffix or (vrm and suffix == ".vrm" and form.suffix == ".glb")
            if fits and key in (None, form.key):
                return form
        offered = ", ".join(f"{form.key} ({form.suffix})" for form in self.forms)
        extension = suffix or "a name without extension"
        raise MeshFileError.unwritable(
            path,
            f"{self.path.name} does not offer {extension}{f' with the form {key}' if key else ''}",
            f"choose one of its forms: {offered}",
        )

    def write(
        self,
        path: str | os.PathLike[str],
        form: ExportForm,
        vertices: npt.NDArray[Any],
        latent: npt.NDArray[Any],
        placement: RigidTransform | None = None,
        *,
        keep_clips: bool = False,
    ) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
        """Write one pose, atomically.

        Parameters
        ----------
        path : of the output
        form : not a sequence
        vertices : (V, 3) array, placed for export, in the axes and unit of the file
        latent : (D,) codes of the pose
        placement : that was applied to the vertices
        keep_clips : see `ExportRequest`

        Returns
        -------
        stored : (V, 3) array as readers of the file get it
        notes : sentences about what was left out

        Raises
        ------
        MeshFileError : the file cannot be written, or the form cannot hold the pose.
        """
        if self._character is None:
            rewrite_obj(path, self.path, vertices)
            return vertices, ()
        transforms = None
        if form.needs_rig and self._body.joints is not None:
            transforms = self._body.joints.transforms(latent)
            for move in (placement, self.frame):
                transforms = _placed(transforms, move)
        made = self._written
        posed = write_character(
            path,
            made.character,
            vertices[made.from_read],
            form.key,
            None if transforms is None else transforms[made.joints],
            self._body.rules,
            shapes=shapes_in_file(self._body.joints, made, latent),
            keep_clips=keep_clips,
        )
        return posed.vertices[made.to_read], (*made.notes, *posed.notes)

    def write_clip(
        self,
        path: str | os.PathLike[str],
        vertices: npt.NDArray[Any],
        latents: Sequence[npt.NDArray[Any]],
        request: ExportRequest,
    ) -> tuple[list[npt.NDArray[Any]], tuple[str, ...]]:
        """Write the poses of a rig as a clip in its file's form, atomically.

        Parameters
        ----------
        path : of the output
        vertices : (N, V, 3) array, in the axes and unit of the file
        latents : (D,) codes of N poses
        request : frame rate, and whether to keep other clips

        Returns
        -------
        stored : for each pose, the (V, 3) array as readers of the file get it
        notes : sentences about what was left out

        Raises
        ------
        MeshFileError : the file cannot be written, or the joints cannot hold a pose.
        """
        clip = self._new_clip(path, "poses", request.fps, np.stack(latents), vertices)
        made, stored = self._written, list[npt.NDArray[Any]]()
        notes = write_character_clips(
            path,
            made.character,
            [clip],
            lambda _, frame: stored.append(frame[made.to_read]),
            self._body.rules,
            keep_clips=request.keep_clips,
        )
        return stored, (*made.notes, *notes)

    def write_motions(
        self, path: str | os.PathLike[str], motions: Sequence[Motion]
    ) -> tuple[list[npt.NDArray[np.bool_]], tuple[str, ...]]:
        """Write motions of a rig as new clips in its file's form, before its own, atomically.

        Returns
        -------
        free : for each motion (T,) which frames are free as stored in the file
        notes : sentences about what was left out

        Raises
        ------
        MeshFileError : as in `write_clip`.
        """
        check = self._body.exact_check()
        frame = self.frame or RigidTransform(np.eye(3), np.zeros(3))

        def clip(motion: Motion) -> NewClip:
            wanted = (frame.apply(motion.vertices(n, check)) for n in range(len(motion)))
            return self._new_clip(path, motion.name, motion.rate, motion.codes, wanted)

        clips, made = list(map(clip, motions)), self._written
        free: list[list[bool]] = [[] for _ in motions]

        def seen(number: int, stored: npt.NDArray[Any]) -> None:
            pose = WrittenPose(self.path, stored[made.to_read], 1.0 / frame.scale)
            free[number].append(not pose.collides(self._body))

        notes = write_character_clips(
            path, made.character, clips, seen, self._body.rules, keep_clips=True
        )
        return [np.array(row, dtype=np.bool_) for row in free], (*made.notes, *notes)

    def _new_clip(
        self,
        path: str | os.PathLike[str],
        name: str,
        fps: float,
        codes: FloatArray,
        vertices: Iterable[npt.NDArray[Any]],
    ) -> NewClip:
        """Return (N, D) poses as a clip, with their vertices in the axes and unit of the file."""
        space = self._body.joints
        if self._character is None or space is None:
            raise MeshFileError.unwritable(
                path, "the poses do not come from its joints", "choose .pc2"
            )
        made = self._written
        transforms = [_placed(space.transforms(row), self.frame)[made.joints] for row in codes]
        shapes = shapes_in_file(space, made, codes)
        wanted = (pose[made.from_read] for pose in vertices)
        return NewClip(name, fps, np.stack(transforms), wanted, shapes)

    @cached_property
    def _written(self) -> GltfCharacter:
        assert self._character is not None
        return as_gltf(self._character)

    @cached_property
    def objects(self) -> list[tuple[str, npt.NDArray[np.integer]]]:
        """The meshes that a program shows for the file: name and vertices of each.

        The vertices are indices into the body's, in the file's order.
        """
        if self._character is None or self._character.file is None:
            return [("", np.arange(self._body.n_vertices))]
        scene = self._character.file.scene
        faces_of: dict[int, list[npt.NDArray[np.integer]]] = {}
        for part, rows in zip(scene.parts, scene.rows, strict=True):
            faces_of.setdefault(part.node, []).append(self._character.joined[rows])
        names = {part.node: scene.node_names[part.node] or part.mesh for part in scene.parts}
        return [(names[node], np.concatenate(faces)) for node, faces in faces_of.items()]


def shapes_in_file(
    space: RigPoseSpace | None, made: GltfCharacter, codes: FloatArray
) -> FloatArray | None:
    """Return (..., S) shape codes of (..., D) codes, in a glTF file's order; None without."""
    body_shapes = None if space is None else space.rig.shapes
    file_shapes = None if made.character.rig is None else made.character.rig.shapes
    if space is None or body_shapes is None or file_shapes is None:
        return None
    numbers: FloatArray = codes[..., space.are_shapes]
    return numbers[..., [body_shapes.names.index(name) for name in file_shapes.names]]


def source_for(
    suffix: str, body: Body, like: str | os.PathLike[str] | None = None
) -> SourceFile | None:
    """Return the source file whose form an output keeps.

    Parameters
    ----------
    suffix : of the output
    body : of the poses
    like : the file, if the user names one; else the file that the body came from, if it
        offers the suffix: see `own_source`

    Raises
    ------
    MeshFileError, PoseSetError : as in `SourceFile`.
    """
    if like is not None:
        return SourceFile(like, body)
    own_file = own_source(body)
    if own_file is not None:
        suffixes = {
            form.suffix for form in offered_forms(own_file, has_rig=body.joints is not None)
        }
        if suffix.lower() in suffixes or suffix.lower() == own_file.suffix.lower() == ".vrm":
            return SourceFile(own_file, body)
    return None


def own_source(body: Body) -> Path | None:
    """Return the existing file that a body came from, if exports can keep its form.

    For a character it is the file of its scene; for a model learned from files in one run, the
    first of them, or the first mesh of the first folder.
    """
    if body.character is not None:
        return body.character.source if body.character.smpl is None else None
    request = body.card.provenance.get("request")
    if not isinstance(request, Mapping) or request.get("scale", 1.0) != 1.0:
        return None
    sources = request.get("sources")
    first = sources[0] if isinstance(sources, Sequence) and sources else None
    if not isinstance(first, str):
        return None
    path = Path(first)
    if path.is_dir():
        path = next(iter(mesh_files(path)[0]), path)
    suffixes = {suffix for form in EXPORT_FORMS for suffix in form.of_sources}
    return path if path.suffix.lower() in suffixes and path.is_file() else None


def requested_form(
    path: str | os.PathLike[str], request: ExportRequest, source: SourceFile | None
) -> ExportForm | None:
    """Return the form of an output; None for a plain mesh of the body.

    Parameters
    ----------
    path : of the output
    request : the form, and whether to keep clips
    source : the source file, by `source_for`

    Raises
    ------
    MeshFileError : the source does not offer the form, or the form cannot keep clips.
    """
    form = None if source is None else source.require_form(path, request.form)
    if form is None and request.form is not None:
        raise MeshFileError.unwritable(
            path,
            f"the form {request.form} applies only to a character's file",
            "name one with --like",
        )
    if request.keep_clips and (form is None or not form.needs_rig):
        raise MeshFileError.unwritable(
            path,
            "clips are kept only where joints hold the pose",
            "name a .glb file of a character, with the form joints or clip",
        )
    return form


def write_pose(
    path: str | os.PathLike[str],
    body: Body,
    latent: npt.NDArray[Any],
    vertices: npt.NDArray[Any],
    placement: RigidTransform | None = None,
    request: ExportRequest = MODELS_OWN,
    *,
    source: SourceFile | None = None,
) -> WrittenPose:
    """Write one pose as a mesh or in the form of the source file, atomically.

    Parameters
    ----------
    path : of the output; its extension sets the format
    body : of the pose
    latent : (D,) its codes
    vertices : (V, 3) array, in the body's unit, placed for export
    placement : that was applied to them
    request : axes, scale and form
    source : the source file, by `source_for`; None for a plain mesh of the body

    Raises
    ------
    MeshFileError : the file cannot be written, or cannot hold the pose in that form.
    """
    target, form = Path(path), requested_form(path, request, source)
    frame = export_frame(body, request.axes, path, request.scale, placement)
    if source is not None and form is not None and source.frame is not None:
        frame = source.frame
    unit = 1.0 / frame.scale / (1.0 if placement is None else placement.scale)
    if source is None or form is None:
        return WrittenPose(target, export_mesh(path, body, vertices, placement, frame), unit)
    placed = as_stored(path, frame.apply(vertices), body.topology)
    stored, notes = source.write(
        path, form, placed, latent, placement, keep_clips=request.keep_clips
    )
    return WrittenPose(target, stored, unit, notes)


def write_sequence(
    path: str | os.PathLike[str],
    body: Body,
    latents: Sequence[npt.NDArray[Any]],
    vertices: Iterable[npt.NDArray[Any]],
    request: ExportRequest = MODELS_OWN,
    *,
    source: SourceFile | None = None,
) -> tuple[list[Path], Sequence[WrittenPose]]:
    """Write poses as the frames of one file, in the vertex order of the source file.

    A source with several meshes gets a point cache for each, named after it, atomically. Except
    for .glb files, only one frame is in memory at a time.

    Parameters
    ----------
    path : a .pc2 or .mdd file; a .glb file for a clip of its source's joints; or a .bvh or .vrma
        file for the joints alone
    body : of the poses
    latents : (D,) codes of N poses
    vertices : of N poses, each (V, 3), in the body's unit and coordinates
    request : axes, scale and frame rate
    source : the source file, by `source_for`; None for the body's own vertex order

    Returns
    -------
    files : the written files
    written : the poses as stored; except for .glb files, they are read on access

    Raises
    ------
    MeshFileError : the extension is not one of a sequence, or a file cannot be written.
    """
    files = sequence_files(path, body, source)
    if Path(path).suffix.lower() in SKELETON_SUFFIXES:
        stored_vertices, notes = write_skeleton(path, body, latents, vertices, request.fps)
        return list(files), _Frames(
            len(latents), lambda frame: WrittenPose(Path(path), stored_vertices(frame), 1.0, notes)
        )
    if source is not None and source.require_form(path, None).suffix == ".glb":
        file_frame = source.frame or export_frame(body, request.axes, path)
        frames = np.stack(
            [as_stored(path, file_frame.apply(pose), body.topology) for pose in vertices]
        )
        clip, notes = source.write_clip(path, frames, latents, request)
        unit = 1.0 / file_frame.scale
        return list(files), [WrittenPose(Path(path), stored, unit, notes) for stored in clip]
    frame = export_frame(body, request.axes, path, request.scale)
    with ExitStack() as stack:
        # Several files are written together.
        target = {file: file for file in files}
        if len(files) > 1:
            folder = stack.enter_context(atomic_files(Path(path).parent))
            target = {file: folder / file.name for file in files}
        writers = [
            (
                stack.enter_context(
                    point_cache(
                        target[file], len(latents), len(rows), request.fps, request.times_of
                    )
                ),
                rows,
            )
            for file, rows in files.items()
        ]
        for _, pose in zip(latents, vertices, strict=True):
            stored = as_stored(path, frame.apply(pose), body.topology)
            for write, rows in writers:
                write(stored[rows])
    unit = 1.0 / frame.scale

    def read(number: int) -> WrittenPose:
        stored = np.empty((body.n_vertices, 3), dtype=np.float32)
        for file, rows in files.items():
            stored[rows] = read_frame(file, number, len(latents), len(rows))
        return WrittenPose(next(iter(files)), stored, unit)

    return list(files), _Frames(len(latents), read)


@dataclass(frozen=True, eq=False)
class _Frames(Sequence[WrittenPose]):
    """The frames of a motion as stored in a file, read on access.

    Attributes
    ----------
    n : number of frames
    read : reads a frame
    """

    n: int
    read: Callable[[int], WrittenPose]

    def __len__(self) -> int:
        return self.n

    def __getitem__(self, frame: Any) -> Any:
        if isinstance(frame, slice):
            return [self[at] for at in range(self.n)[frame]]
        return self.read(range(self.n)[frame])


def sequence_files(
    path: str | os.PathLike[str], body: Body, source: SourceFile | None = None
) -> dict[Path, npt.NDArray[np.integer]]:
    """Return the files that `write_sequence` writes, and the body's vertices in each.

    Parameters
    ----------
    path, body, source : see `write_sequence`

    Raises
    ------
    MeshFileError : the extension is not one of a sequence.
    """
    target = Path(path)
    if target.suffix.lower() in SKELETON_SUFFIXES:
        return {target: np.arange(body.n_vertices)}
    if source is not None and source.require_form(path, None).suffix == ".glb":
        source.require_form(path, CLIP)
        return {target: np.arange(body.n_vertices)}
    if target.suffix.lower() not in POINT_CACHE_SUFFIXES:
        raise MeshFileError.unwritable(
            path, "it is not a point cache", f"use one of {', '.join(POINT_CACHE_SUFFIXES)}"
        )
    objects = [("", np.arange(body.n_vertices))] if source is None else source.objects
    if len(objects) == 1:
        return {target: objects[0][1]}
    stems = file_stems(f"{target.stem} {name}" for name, _ in objects)
    names = [f"{stem}{target.suffix}" for stem in stems]
    return {target.with_name(name): rows for name, (_, rows) in zip(names, objects, strict=True)}


def _placed(transforms: FloatArray, placement: RigidTransform | None) -> FloatArray:
    """Apply a placement to (J, 4, 4) transforms."""
    return transforms if placement is None else placement.matrix @ transforms


def _is_same_file(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:
        # One of them is missing; reading it reports that.
        return False
