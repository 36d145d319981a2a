# SPDX-License-Identifier: GPL-3.0-or-later
"""Motions fit for cloth solvers: parts keep a gap in frames and between them."""

import struct
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import bpy
import numpy as np

from .actions import Frames, Resolved, list_frames, read_frames, resolving, told_of, with_uncounted
from .link import Steps
from .operators import counted
from .results import clear
from .scene import Caution, Rigged, SceneError
from .steps import ModalOperator

CACHE = "LCollision Cache"
"""Name of the modifiers that show caches."""

REPORT = "Cloth Report"
"""Name of the text with the report."""

_SHOWN_OTHERWISE = "Blender shows it differently from its bones"


class LCOLLISION_OT_prepare_cloth(ModalOperator, bpy.types.Operator):
    """Copy the action so that parts keep the contact gap, also between frames, for cloth solvers"""

    bl_idname = "lcollision.prepare_cloth"
    bl_label = "Prepare for Cloth"

    def steps(self, context, settings) -> Steps:
        """Resolve, write, check what Blender shows, and report what could not be done."""
        rigged, scene = Rigged.of(context), context.scene
        folder = cache_folder(settings, rigged) if settings.cloth_output == "CACHE" else None
        with _without_caches(rigged):
            resolved = yield from resolving(
                context, rigged, settings, settings.cloth_gap, settings.cloth_subframes
            )
            written, now, shown = resolved.written, resolved.now, resolved.shown
            caches: dict[bpy.types.Object, Path] = {}
            if folder is not None:
                with resolved.taken_back_on_failure():
                    caches = yield from _write_caches(scene, shown, resolved, folder)
        if caches:
            _show_caches(caches, now.numbers[now.within.start], settings.cloth_subframes)
            now = yield from read_frames(
                context,
                shown,
                resolved.character,
                resolved.wanted,
                [now.numbers[at] for at in now.within],
            )
        with resolved.taken_back_on_failure():
            now = yield from with_uncounted(context, shown, resolved.character, now)
        why = _reasons(resolved, now)
        list_frames(scene, now)
        for item in settings.frames:
            item.why = why[item.frame]
        clear()
        settings.of = shown.armature.name
        settings.verdict, settings.details = _verdict(now, settings), now.not_counted
        lines = [settings.verdict]
        if written is not None:
            written.finish()
            lines.append(told_of(written, resolved.frames))
        lines += [f"{path.name}: {item.name}" for item, path in caches.items()]
        lines += _lines(now, why)
        _write_report(lines)
        told = ". ".join(lines[: 1 + (written is not None)])
        return Caution(f"{told}; see the text {REPORT}") if now.colliding else told


def _verdict(frames: Frames, settings: bpy.types.PropertyGroup) -> str:
    """Return a sentence on how many frames are fit for cloth."""
    n, bad = len(frames.within), len(frames.colliding)
    between = counted(settings.cloth_subframes, "pose") + " between two"
    if bad:
        return f"{bad} of {n} frames are not fit for cloth"
    return f"Fit for cloth: {n} frames, {between}, and the paths of the vertices (checked)"


def _reasons(resolved: Resolved, now: Frames) -> dict[int, str]:
    """Return why each unfit frame is not fit, by its number."""
    numbers = resolved.frames.numbers
    told = {}
    for span in resolved.kept:
        first, last = span["frames"]
        told |= {numbers[at]: span["reason"] for at in range(first, last + 1)}
    rest = "; ".join(f"{name} can't be keyed ({why})" for name, why in resolved.unkeyable.items())
    return {
        now.numbers[at]: told.get(now.numbers[at], rest or _SHOWN_OTHERWISE) for at in now.colliding
    }


def _lines(frames: Frames, why: dict[int, str]) -> list[str]:
    """List unfit frames, and pairs that do not count but that a solver may see."""
    lines = []
    for at in frames.within:
        number, found = frames.numbers[at], frames.found[at]
        if number in why:
            where = "on the way to the next" if found["is_between"] else "here"
            parts = " and ".join(dict.fromkeys(found["parts"][0])) if found["parts"] else ""
            depth = f"{parts}, {100.0 * found['deepest']:.2f} % of the body size" if parts else ""
            lines.append(f"Frame {number}, {where}: {depth or 'something touches'}; {why[number]}")
        if found["not_counted"]:
            lines.append(f"Frame {number}: {found['not_counted']}")
    return lines


def _write_report(lines: list[str]) -> None:
    text = bpy.data.texts.get(REPORT) or bpy.data.texts.new(REPORT)
    text.clear()
    text.write("\n".join(lines) + "\n")


def cache_folder(settings: bpy.types.PropertyGroup, rigged: Rigged) -> Path:
    """Return the folder for caches.

    Raises
    ------
    SceneError : there is no such folder, or a mesh takes no modifier.
    """
    if settings.cloth_folder.startswith("//") and not bpy.data.filepath:
        raise SceneError("Save the file first, or choose a folder for the mesh caches")
    for item in rigged.meshes:
        if item.library is not None:
            raise SceneError(f"{item.name} is linked and takes no cache; choose Action")
    folder = Path(bpy.path.abspath(settings.cloth_folder))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(f"{folder}: {error.strerror}; choose another folder") from error
    return folder


@contextmanager
def _without_caches(rigged: Rigged) -> Iterator[None]:
    """Hide earlier caches, so that bones move the meshes; show them again only on failure."""
    caches = [item.modifiers[CACHE] for item in rigged.meshes if CACHE in item.modifiers]
    shown = [one for one in caches if one.show_viewport]
    for one in shown:
        one.show_viewport = one.show_render = False
    try:
        yield
    except BaseException:
        with suppress(ReferenceError):
            for one in shown:
                one.show_viewport = one.show_render = True
        raise


def _write_caches(
    scene: bpy.types.Scene, rigged: Rigged, resolved: Resolved, folder: Path
) -> Generator[str, None, dict[bpy.types.Object, Path]]:
    """Write each mesh, as shown in all frames and between them, to a PC2 file.

    Returns
    -------
    caches : the file of each mesh
    """
    now, wanted, before = resolved.now, resolved.wanted, scene.frame_current
    numbers = [now.numbers[at] for at in now.within]
    names = {item: f"{rigged.armature.name}-{item.name}" for item in rigged.meshes}
    caches = {item: folder / f"{bpy.path.clean_name(name)}.pc2" for item, name in names.items()}
    parts = {item: path.with_suffix(".pc2.part") for item, path in caches.items()}
    try:
        for number in numbers:
            yield f"Writing frame {number} of {numbers[-1]}"
            for share in (0.0, *wanted.shares_after(number)[:-1]):
                scene.frame_set(number, subframe=share)
                graph = bpy.context.evaluated_depsgraph_get()
                for item, path in parts.items():
                    mesh = item.evaluated_get(graph).to_mesh()
                    points = np.empty(3 * len(mesh.vertices), "<f4")
                    mesh.vertices.foreach_get("co", points)
                    item.evaluated_get(graph).to_mesh_clear()
                    is_first = number == numbers[0] and share == 0.0
                    with path.open("wb" if is_first else "ab") as file:
                        if is_first:
                            n_samples = 1 + (len(numbers) - 1) * (wanted.subframes + 1)
                            rate = 1.0 / (wanted.subframes + 1)
                            size = len(points) // 3
                            header = (b"POINTCACHE2\0", 1, size, number, rate, n_samples)
                            file.write(struct.pack("<12siiffi", *header))
                        file.write(points.tobytes())
        for item, path in parts.items():
            path.replace(caches[item])
    except OSError as error:
        raise SceneError(f"{folder}: {error.strerror}; choose another folder") from error
    finally:
        scene.frame_set(before)
        for path in parts.values():
            path.unlink(missing_ok=True)
    return caches


def _show_caches(caches: dict[bpy.types.Object, Path], first: int, subframes: int) -> None:
    """Show the meshes by their caches."""
    for item, path in caches.items():
        cache = item.modifiers.get(CACHE) or item.modifiers.new(CACHE, "MESH_CACHE")
        cache.cache_format, cache.interpolation = "PC2", "LINEAR"
        cache.filepath = str(path)
        cache.frame_scale = subframes + 1
        cache.frame_start = first * (subframes + 1)
        cache.show_viewport = cache.show_render = True
    bpy.context.view_layer.update()


def register() -> None:
    """Add the operator."""
    bpy.utils.register_class(LCOLLISION_OT_prepare_cloth)


def unregister() -> None:
    """Remove the operator."""
    bpy.utils.unregister_class(LCOLLISION_OT_prepare_cloth)
