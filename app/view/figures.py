"""Pictures of a model, drawn without a window."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from app.view.shading import mask_colours

if TYPE_CHECKING:
    from PIL.Image import Image

    from lcollision_core.model import PoseModel

_VIEW_WIDTH, _VIEW_HEIGHT = 900, 1300
_LEGEND_COLUMN, _LEGEND_ROW = 425, 52
_MARGIN = 50
_INK = (40, 44, 52)


def draw_masks(model: PoseModel, path: str | os.PathLike[str]) -> None:
    """Draw the reference from two sides, each domain in its colour, darker where it owns more.

    Parameters
    ----------
    model : whose attention masks
    path : the .png file to write, whole or not at all

    Raises
    ------
    MeshFileError : the file cannot be written.

    Notes
    -----
    After figure 2 of Tan et al. 2021.
    """
    from PIL import Image

    from lcollision_core.meshes import atomic_write

    colours = mask_colours(model.attention_mask, model.domain_colours)
    views = _two_sides(model, colours)
    legend = _legend(model, 2 * _VIEW_WIDTH)
    picture = Image.new("RGB", (2 * _VIEW_WIDTH, _VIEW_HEIGHT + legend.height), "white")
    for place, view in enumerate(views):
        picture.paste(Image.fromarray(view), (place * _VIEW_WIDTH, 0))
    picture.paste(legend, (0, _VIEW_HEIGHT))
    with atomic_write(path) as file:
        picture.save(file, format="PNG", optimize=True)


def _two_sides(
    model: PoseModel, colours: npt.NDArray[np.uint8]
) -> tuple[npt.NDArray[np.uint8], ...]:
    """Render the reference from the front and from behind, as far as its shape tells."""
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkLogger

    # Without a display VTK warns of that, then draws all the same.
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    surface = pv.PolyData.from_regular_faces(model.reference.astype(np.float32), model.faces)
    surface.point_data["colours"] = colours
    up = np.eye(3)[model.up_axis]
    front = model.front
    centre = 0.5 * (model.reference.min(axis=0) + model.reference.max(axis=0))
    views = []
    for direction in (front, -front):
        plotter = pv.Plotter(off_screen=True, window_size=(_VIEW_WIDTH, _VIEW_HEIGHT))
        plotter.set_background("white")
        plotter.enable_anti_aliasing("ssaa")
        plotter.add_mesh(
            surface,
            scalars="colours",
            rgb=True,
            smooth_shading=True,
            ambient=0.45,
            diffuse=0.65,
            specular=0.08,
            specular_power=15,
        )
        plotter.camera_position = [centre + 3.0 * model.height * direction, centre, up]
        plotter.enable_parallel_projection()
        width = float(np.ptp(model.reference @ np.cross(up, direction)))
        plotter.camera.parallel_scale = 0.54 * max(model.height, width * _VIEW_HEIGHT / _VIEW_WIDTH)
        views.append(np.asarray(plotter.screenshot(return_img=True))[:, :, :3])
        plotter.close()
    return tuple(views)


def _legend(model: PoseModel, width: int) -> Image:
    """Draw each domain's name beside its colour, from pale to full."""
    from PIL import Image, ImageDraw, ImageFont

    n_columns = max(1, (width - 2 * _MARGIN) // _LEGEND_COLUMN)
    n_domains = len(model.domain_names)
    n_columns = min(n_columns, n_domains)
    n_rows = -(-n_domains // n_columns)
    legend = Image.new("RGB", (width, n_rows * _LEGEND_ROW + 2 * _MARGIN), "white")
    draw = ImageDraw.Draw(legend)
    font = ImageFont.load_default(size=26)
    left = (width - n_columns * _LEGEND_COLUMN) // 2
    for domain, (name, colour) in enumerate(
        zip(model.domain_names, model.domain_colours, strict=True)
    ):
        column, row = divmod(domain, n_rows)
        x, y = left + column * _LEGEND_COLUMN, _MARGIN + row * _LEGEND_ROW
        for step, weight in enumerate(np.linspace(0.0, 1.0, 60)):
            shade = mask_colours(np.array([[weight]]), (colour,))[0]
            draw.line((x + step, y, x + step, y + 30), fill=tuple(shade.tolist()))
        draw.rectangle((x, y, x + 60, y + 30), outline=(200, 200, 205))
        draw.text((x + 76, y + 15), name, fill=_INK, font=font, anchor="lm")
    return legend
