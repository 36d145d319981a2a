"""Write the bodies of a scene, each to its own file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lcollision_core.files.safe import atomic_files
from lcollision_core.files.table import SCENE_SUFFIXES
from lcollision_core.jobs import UNWATCHED, Job
from lcollision_core.options import ExportRequest
from lcollision_core.tasks.words import counted, say

if TYPE_CHECKING:
    from lcollision_core.bodies import NamedPose, SceneBody, WrittenPose
    from lcollision_core.bodies.scene_body import SceneMember


def write_members(
    folder: Path,
    body: SceneBody,
    poses: Sequence[NamedPose],
    vertices: Sequence[npt.NDArray[np.floating]],
    request: ExportRequest,
    job: Job = UNWATCHED,
) -> list[WrittenPose]:
    """Write poses of a scene, each body to its own file; several poses go to a folder each.

    Static bodies are not written.

    Returns
    -------
    written : for each pose, with all bodies' vertices as stored in the files, in the scene's unit

    Raises
    ------
    MeshFileError : a file cannot be written.
    """
    from lcollision_core.bodies import WrittenPose, export_frame, source_for, write_pose
    from lcollision_core.files import file_stems

    stems = file_stems(pose.name for pose in poses) if len(poses) > 1 else [""]
    written, n_files = [], 0
    with atomic_files(folder) as unfinished:
        for pose, mesh, stem in zip(poses, vertices, stems, strict=True):
            target = unfinished / stem
            target.mkdir(exist_ok=True)
            stored, notes = np.array(mesh, dtype=np.float64), dict[str, None]()
            for member, file in written_members(body, request.mesh_format):
                path, member_body = target / file, member.body
                back, rows = member.place.inverse(), body.vertices_of[member.name]
                source = source_for(path.suffix, member_body)
                member_request = request
                if source is not None and member_body.latent_size <= 6:
                    member_request = replace(
                        request, form="obj" if path.suffix == ".obj" else "mesh"
                    )
                codes = (
                    body.codes_of_member(member.name, pose.latent)
                    if member.moves
                    else np.zeros(member_body.latent_size)
                )
                done = write_pose(
                    path,
                    member_body,
                    codes,
                    back.apply(mesh[rows]),
                    None,
                    member_request,
                    source=source,
                )
                frame = export_frame(member_body, member_request.axes, path, member_request.scale)
                if source is not None and source.frame is not None:
                    frame = source.frame
                assert done.vertices is not None
                stored[rows] = member.place.apply(frame.inverse().apply(done.vertices))
                notes |= dict.fromkeys(f"{member.name}: {sentence}" for sentence in done.notes)
                n_files += 1
            written.append(WrittenPose(folder / stem, stored, 1.0, tuple(notes)))
    for sentence in dict.fromkeys(sentence for pose in written for sentence in pose.notes):
        job.note(sentence)
    job.note(
        say(
            "wrote {poses} of {bodies} to {output}",
            poses=counted(len(poses), "pose"),
            bodies=counted(n_files // len(poses), "body", "bodies"),
            output=folder,
        )
    )
    return written


def written_members(
    body: SceneBody, mesh_format: str | None = None
) -> Iterator[tuple[SceneMember, str]]:
    """Iterate over the bodies that exports write, and their files' names.

    The default format is that of each body's own file.
    """
    from lcollision_core.files import file_stems

    members = [
        member
        for member in body.members
        if (member.moves or member.body.own_file is not None) and not member.is_fixed
    ]
    for member, stem in zip(members, file_stems(member.name for member in members), strict=True):
        own_file = member.body.own_file
        suffix = ".obj" if own_file is None else own_file.suffix.lower()
        if suffix in SCENE_SUFFIXES and suffix != ".vrm":
            suffix = ".glb"
        suffix = f".{mesh_format}" if mesh_format else suffix
        yield member, f"{stem}{suffix}"
