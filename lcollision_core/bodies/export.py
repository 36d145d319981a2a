"""A body's poses as files: meshes, sequences and the character's own form."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
    write_character_clip,
    write_mesh,
    written_frame,
)
from lcollision_core.files.mesh.obj import ObjDetail, rewrite_obj
from lcollision_core.files.motion.caches import point_cache, read_frame
from lcollision_core.files.table import (
    POINT_CACHE_SUFFIXES,
    SCENE_SUFFIXES,
    SKELETON_SUFFIXES,
)
from lcollision_core.files.written import NewClip, write_character_clips
from lcollision_core.meshes import FaceGroup, RigidTransform, body_size
from lcollision_core.meshes.face_groups import GROUP_KINDS
from lcollision_core.meshes.normals import corner_normals
from lcollision_core.meshes.topology import FloatArray
from lcollision_core.motion import Motion
from lcollision_core.options import MODELS_OWN, ExportAxes, ExportRequest

_AXES = np.eye(3)
_X, _Y, _Z = _AXES


_UNITS_IN_A_METRE = {
    ExportAxes.BLENDER: 1.0,
    ExportAxes.MAYA: 100.0,
    ExportAxes.UNREAL: 100.0,
}

_ALREADY_FIXED = (".glb", ".vrm")
"""glTF's own axes and unit are y up, z forward and the metre."""


def export_scale(model: Body, axes: str) -> float:
    """Return the units that a program counts in one of a model's, 1 for the model's own."""
    units = _UNITS_IN_A_METRE.get(ExportAxes(axes))
    return 1.0 if units is None else units * model.card.metres


def export_frame(
    model: Body,
    axes: str,
    path: str | os.PathLike[str],
    scale: float | None = None,
    placement: RigidTransform | None = None,
) -> RigidTransform:
    """Return what brings a mesh into the axes, by right angles, and the unit that its file gets.

    Parameters
    ----------
    model : of the poses
    axes : one of `ExportAxes`
    path : its extension says the format: a GLB file is in metres, and turned by `write_mesh`
    scale : the file's units in one of the model's; `export_scale` if None
    placement : of an imported mesh, which has brought its unit along
    """
    chosen = ExportAxes(axes)
    suffix = Path(path).suffix.lower()
    if suffix in _ALREADY_FIXED:
        return RigidTransform(
            np.eye(3), np.zeros(3), model.card.metres if placement is None else 1.0
        )
    factor = export_scale(model, axes) if scale is None else scale
    if chosen is ExportAxes.MODEL:
        return RigidTransform(np.eye(3), np.zeros(3), factor)
    up, front = _Y, _Z
    if chosen is ExportAxes.UNREAL:
        up, front = _Z, _X
    elif chosen is ExportAxes.BLENDER and suffix != ".obj":
        up, front = _Z, -_Y
    own_up, own_front = _AXES[model.up_axis], model.front
    own = np.stack([own_up, own_front, np.cross(own_up, own_front)])
    turn = np.stack([up, front, np.cross(up, front)]).T @ own
    # Adding 0 leaves no -0 behind.
    return RigidTransform(turn + 0.0, np.zeros(3), factor)


def export_mesh(
    path: str | os.PathLike[str],
    model: Body,
    vertices: npt.NDArray[Any],
    placement: RigidTransform | None = None,
    frame: RigidTransform | None = None,
) -> npt.NDArray[Any]:
    """Write a pose's mesh, upright where the format says which way is up, unless it has a place.

    Parameters
    ----------
    path : see `write_mesh`
    model : of the pose
    vertices : (V, 3) array, in the data's unit, placed for export
    placement : that was applied to them, for an imported mesh; else None
    frame : the file's axes and unit, by `export_frame`; the model's if None. A mesh that has a
        place is turned like all others.

    Returns
    -------
    written : (V, 3) array as the file holds it, except the rotation of a GLB file, which is exact

    Raises
    ------
    MeshFileError, ShapeError : as for `write_mesh`.
    """
    written = vertices if frame is None else frame.apply(vertices)
    written = as_stored(path, written, model.topology)
    up = np.eye(3)[model.up_axis] if placement is None else None
    is_obj = Path(path).suffix.lower() == ".obj"
    detail = _detail(model, written) if is_obj else None
    write_mesh(path, written, model.faces, up=up, detail=detail)
    return written


def _detail(model: Body, vertices: npt.NDArray[Any]) -> ObjDetail | None:
    """Return what an OBJ file holds of a body from a file; None of one that has no more to say.

    Its groups are the body's meshes, else its body parts.
    """
    own, parts = (model.groups_by_kind[kind] for kind in GROUP_KINDS[:2])
    uv, uv_faces = _texture_coordinates(model)
    if not own and not len(uv):
        return None
    materials = [group for group in own if group.is_material]
    meshes = [group for group in own if not group.is_material] or list(parts)
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
    """Return each face's first group by number, -1 for none."""
    numbers = np.full(n_faces, -1)
    for number, group in reversed(list(enumerate(groups))):
        numbers[group.faces] = number
    return numbers


def _texture_coordinates(
    model: Body,
) -> tuple[npt.NDArray[np.floating[Any]], npt.NDArray[np.int64]]:
    """Return (T, 2) texture coordinates and which the (F, 3) corners have; no rows for none."""
    look = model.appearance
    none = np.empty((0, 2)), np.empty((0, 3), dtype=np.int64)
    if look is None or not look.uv.any():
        return none
    # Without the faces that the body leaves out.
    numbered = enumerate(map(tuple, look.vertices[look.faces].tolist()))
    rows = [
        next((row for row, corners in numbered if corners == wanted), -1)
        for wanted in map(tuple, model.faces.tolist())
    ]
    if -1 in rows:
        return none
    of_corner = look.uv[look.faces[rows]].reshape(-1, 2)
    uv, uv_faces = np.unique(of_corner, axis=0, return_inverse=True)
    # Pictures of glTF begin at the top.
    return uv * [1.0, -1.0] + [0.0, 1.0], uv_faces.reshape(-1, 3)


_LARGEST_SIZE_RATIO = 1.01
"""Of a character in its file to the same in a model: beyond it, their units differ."""


CLIP = "clip"
"""The key of the form in which a character's file holds poses as frames."""


@dataclass(frozen=True)
class ExportForm:
    """One way to write poses so that they keep the form of the user's file.

    Attributes
    ----------
    key : of settings and options; of a character's file one of `CharacterForm`
    label, explanation : what people read
    suffix : of the files that are written
    of_sources : extensions of the user's files that offer it; empty for any, and for none
    needs_rig : whether the poses must come from the joints of that file
    is_sequence : whether one file holds all poses, as frames
    has_axes : whether axes and unit can be chosen; else they are those of the source
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
"""In the order in which they are offered."""


def offered_forms(
    source: str | os.PathLike[str] | None, *, has_rig: bool = False
) -> tuple[ExportForm, ...]:
    """Return the forms that a user's file offers, the best first.

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
    """Where a pose was written, and what readers of the file get of it, to be checked as that.

    Attributes
    ----------
    path : of the file
    vertices : (V, 3) array, in the axes and the unit of the file; None of a file of codes
    unit : the body's units in one of the file's
    notes : sentences on what was left out of the file
    """

    path: Path
    vertices: npt.NDArray[Any] | None = None
    unit: float = 1.0
    notes: tuple[str, ...] = ()

    def checked(self, body: Body) -> SelfCollisions:
        """Return what the exact check finds in a mesh as the file holds it, by the body's rules."""
        assert self.vertices is not None
        return body.detector.detect(self.vertices, unit=self.unit)

    def collides(self, body: Body) -> bool:
        """Return whether `checked` finds a pair that counts, several times as fast."""
        assert self.vertices is not None
        collisions = body.detector.detect(self.vertices, unit=self.unit, counted_only=True)
        return collisions.colliding


class SourceFile:
    """A file of a body whose form exports keep: an OBJ file, or a character's.

    Parameters
    ----------
    path : of the file
    body : whose poses are written

    Attributes
    ----------
    path : as given
    forms : that it offers, the best first
    frame : of a character's file, from its coordinates to those of the file that is written

    Raises
    ------
    MeshFileError : it cannot be read, or no form is kept of files of its format.
    PoseSetError : it is of another body.
    """

    def __init__(self, path: str | os.PathLike[str], body: Body) -> None:
        self.path = Path(path)
        self._body = body
        self._character: Character | None = None
        self.frame: RigidTransform | None = None
        suffix = self.path.suffix.lower()
        own = body.character
        is_own = own is not None and _is_same_file(own.source, self.path)
        self.forms = offered_forms(path, has_rig=is_own)
        if suffix == ".obj":
            mesh = read_mesh(path, topology=body.topology)
            body.require_topology(mesh.topology, str(path))
        elif suffix in SCENE_SUFFIXES:
            self._character = (
                own if own is not None and is_own else read_character(path, topology=body.topology)
            )
            body.require_topology(self._character.topology, str(path))
            self._require_unit(self._character)
            self.frame = written_frame(self._character)
        else:
            raise MeshFileError(
                f"has a form that is not written ({suffix or 'no extension'})",
                f"name one of .obj, {', '.join(SCENE_SUFFIXES)}",
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
        """Return the form that a file of poses gets.

        Parameters
        ----------
        path : to be written
        key : of the form; None for the best of those with the file's extension

        Raises
        ------
        MeshFileError : none of the offered forms.
        """
        suffix = Path(path).suffix.lower()
        vrm = self.path.suffix.lower() == ".vrm"
        for form in self.forms:
            fits = suffix == form.suffix or (vrm and suffix == ".vrm" and form.suffix == ".glb")
            if fits and key in (None, form.key):
                return form
        offered = ", ".join(f"{form.key} ({form.suffix})" for form in self.forms)
        wanted = suffix or "a name without extension"
        raise MeshFileError.unwritable(
            path,
            f"{self.path.name} does not offer {wanted}{f' with the form {key}' if key else ''}",
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
        """Write one pose, whole or not at all.

        Parameters
        ----------
        path : to write
        form : that is no sequence
        vertices : (V, 3) array, placed for export, in the axes and the unit of the file
        latent : (D,) codes of the pose
        placement : that was applied to the vertices
        keep_clips : see `ExportRequest`

        Returns
        -------
        stored : (V, 3) array, what readers of the file get
        notes : sentences on what was left out

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
    ) -> list[tuple[npt.NDArray[Any], tuple[str, ...]]]:
        """Write the poses of a rig as a clip of its file, whole or not at all.

        Parameters
        ----------
        path : to write
        vertices : (N, V, 3) array, in the axes and the unit of the file
        latents : N poses' (D,) codes
        request : frames a second, and whether other clips stay

        Returns
        -------
        for each pose, as of `write`

        Raises
        ------
        MeshFileError : the file cannot be written, or the joints cannot hold a pose.
        """
        if self._character is None or self._body.joints is None:
            raise MeshFileError.unwritable(path, "the poses are none of its joints", "choose .pc2")
        space, made = self._body.joints, self._written
        transforms = [_placed(space.transforms(latent), self.frame) for latent in latents]
        frames = write_character_clip(
            path,
            made.character,
            vertices[:, made.from_read],
            np.stack(transforms)[:, made.joints],
            request.fps,
            self._body.rules,
            shapes=shapes_in_file(space, made, np.stack(latents)),
            keep_clips=request.keep_clips,
        )
        return [(frame.vertices[made.to_read], (*made.notes, *frame.notes)) for frame in frames]

    def write_motions(
        self, path: str | os.PathLike[str], motions: Sequence[Motion]
    ) -> tuple[list[npt.NDArray[np.bool_]], tuple[str, ...]]:
        """Write motions of a rig as new clips of its file, before its own, whole or not at all.

        Returns
        -------
        free : of each motion (T,) which frames are free as the file holds them
        notes : sentences on what was left out

        Raises
        ------
        MeshFileError : as of `write_clip`.
        """
        character, space, frame = self._character, self._body.joints, self.frame
        if character is None or space is None or frame is None:
            raise MeshFileError.unwritable(path, "the poses are none of its joints", "choose .pc2")
        made, check = self._written, self._body.exact_check()
        free: list[list[bool]] = [[] for _ in motions]

        def wanted(motion: Motion) -> Iterator[npt.NDArray[Any]]:
            for number in range(len(motion)):
                yield frame.apply(motion.vertices(number, check))[made.from_read]

        def clip(motion: Motion) -> NewClip:
            placed = [_placed(space.transforms(row), frame)[made.joints] for row in motion.codes]
            shapes = shapes_in_file(space, made, motion.codes)
            return NewClip(motion.name, motion.rate, np.stack(placed), wanted(motion), shapes)

        def seen(number: int, stored: npt.NDArray[Any]) -> None:
            pose = WrittenPose(self.path, stored[made.to_read], 1.0 / frame.scale)
            free[number].append(not pose.collides(self._body))

        _, notes = write_character_clips(
            path, made.character, list(map(clip, motions)), seen, self._body.rules, keep_clips=True
        )
        return [np.array(row, dtype=np.bool_) for row in free], (*made.notes, *notes)

    @cached_property
    def _written(self) -> GltfCharacter:
        assert self._character is not None
        return as_gltf(self._character)

    @cached_property
    def objects(self) -> list[tuple[str, npt.NDArray[np.integer]]]:
        """Each mesh that a program shows of the file: its name, and its vertices.

        Those are vertices of the body, in the file's order.
        """
        if self._character is None or self._character.file is None:
            return [("", np.arange(self._body.n_vertices))]
        scene = self._character.file.scene
        faces_of: dict[int, list[npt.NDArray[np.integer]]] = {}
        start = 0
        for part in scene.parts:
            end = start + len(part.points)
            faces_of.setdefault(part.node, []).append(self._character.joined[start:end])
            start = end
        names = {part.node: scene.node_names[part.node] or part.mesh for part in scene.parts}
        return [(names[node], np.concatenate(rows)) for node, rows in faces_of.items()]


def shapes_in_file(
    space: RigPoseSpace | None, made: GltfCharacter, codes: FloatArray
) -> FloatArray | None:
    """Return the (..., S) sliders of (..., D) codes in the order of a glTF file; None without."""
    own = None if space is None else space.rig.shapes
    held = None if made.character.rig is None else made.character.rig.shapes
    if space is None or own is None or held is None:
        return None
    numbers: FloatArray = codes[..., space.are_shapes]
    return numbers[..., [own.names.index(name) for name in held.names]]


def source_for(
    suffix: str, body: Body, like: str | os.PathLike[str] | None = None
) -> SourceFile | None:
    """Return the user's file whose form an output keeps.

    Parameters
    ----------
    suffix : of the output
    body : of the poses
    like : the file, if the user names one; else the one that the body came from, see
        `own_source`, where that offers the suffix

    Raises
    ------
    MeshFileError, PoseSetError : as of `SourceFile`.
    """
    if like is not None:
        return SourceFile(like, body)
    own = own_source(body)
    if own is not None:
        suffixes = {form.suffix for form in offered_forms(own, has_rig=body.joints is not None)}
        if suffix.lower() in suffixes or suffix.lower() == own.suffix.lower() == ".vrm":
            return SourceFile(own, body)
    return None


def own_source(body: Body) -> Path | None:
    """Return the user's file that a body came from and whose form exports can keep, if it is there.

    That is the file of a character's scene, and of a model that was learned from files in one run
    the first of them, of a folder its first mesh.
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
    kept = {suffix for form in EXPORT_FORMS for suffix in form.of_sources}
    return path if path.suffix.lower() in kept and path.is_file() else None


def requested_form(
    path: str | os.PathLike[str], request: ExportRequest, source: SourceFile | None
) -> ExportForm | None:
    """Return the form that a file of poses gets; None for a mesh of the body's own.

    Parameters
    ----------
    path : to be written
    request : which form, and whether clips are kept
    source : the user's file, by `source_for`

    Raises
    ------
    MeshFileError : the source does not offer it, or it cannot keep clips.
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
    """Write one pose as a mesh or in the user's own file, whole or not at all.

    Parameters
    ----------
    path : to write; its extension says the format
    body : of the pose
    latent : (D,) its codes
    vertices : (V, 3) array, in the body's unit, placed for export
    placement : that was applied to them
    request : axes, scale and form
    source : the user's file, by `source_for`; None for a mesh of the body's own

    Raises
    ------
    MeshFileError : the file cannot be written, or cannot hold the pose there or in that form.
    """
    target, chosen = Path(path), requested_form(path, request, source)
    frame = export_frame(body, request.axes, path, request.scale, placement)
    if source is not None and chosen is not None and source.frame is not None:
        frame = source.frame
    unit = 1.0 / frame.scale / (1.0 if placement is None else placement.scale)
    if source is None or chosen is None:
        return WrittenPose(target, export_mesh(path, body, vertices, placement, frame), unit)
    placed = as_stored(path, frame.apply(vertices), body.topology)
    stored, notes = source.write(
        path, chosen, placed, latent, placement, keep_clips=request.keep_clips
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
    """Write poses as the frames of one file, in the vertex order of the user's mesh.

    A file that shows several meshes gets a point cache for each, called after it: all of them, or
    none. But for .glb files no more than one frame is in memory at once.

    Parameters
    ----------
    path : a .pc2 or .mdd file; a .glb file gets a clip of the joints of its source, and a .bvh or
        .vrma file the joints alone
    body : of the poses
    latents : N poses' (D,) codes
    vertices : of N poses, each (V, 3), in the body's unit and coordinates
    request : axes, scale and frames a second
    source : the user's file, by `source_for`; the body's own vertex order if None

    Returns
    -------
    files : that were written
    written : what they hold of each pose; but for .glb files it is read when it is asked for

    Raises
    ------
    MeshFileError : the extension is of no form for frames, or a file cannot be written.
    """
    files = sequence_files(path, body, source)
    if Path(path).suffix.lower() in SKELETON_SUFFIXES:
        shown, notes = write_skeleton(path, body, latents, vertices, request.fps)
        return list(files), _Frames(
            len(latents), lambda frame: WrittenPose(Path(path), shown(frame), 1.0, notes)
        )
    if source is not None and source.require_form(path, None).suffix == ".glb":
        own = source.frame or export_frame(body, request.axes, path)
        frames = np.stack([as_stored(path, own.apply(pose), body.topology) for pose in vertices])
        clip = source.write_clip(path, frames, latents, request)
        unit = 1.0 / own.scale
        return list(files), [WrittenPose(Path(path), stored, unit, notes) for stored, notes in clip]
    frame = export_frame(body, request.axes, path, request.scale)
    with ExitStack() as stack:
        # Several come together.
        target = {file: file for file in files}
        if len(files) > 1:
            folder = stack.enter_context(atomic_files(Path(path).parent))
            target = {file: folder / file.name for file in files}
        writers = [
            (
                stack.enter_context(
                    point_cache(target[file], len(latents), len(rows), request.fps)
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
    """What a file holds of the frames of a motion, each read when it is asked for.

    Attributes
    ----------
    n : how many there are
    read : returns one
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
    """Return the files that `write_sequence` writes, and the vertices of the body in each.

    Parameters
    ----------
    path, body, source : see `write_sequence`

    Raises
    ------
    MeshFileError : the extension is of no form for frames.
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
    """Move (J, 4, 4) transforms to where a pose is exported to."""
    if placement is None:
        return transforms
    matrix = np.eye(4)
    matrix[:3, :3] = placement.scale * placement.rotation
    matrix[:3, 3] = placement.translation
    return np.asarray(matrix @ transforms, dtype=np.float64)


def _is_same_file(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:
        # One of them is gone; what reads it says so.
        return False
