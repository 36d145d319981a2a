"""Pictures of a model, drawn without a window."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from app.view.camera import preset_view
from app.view.offscreen import PoseRenderer, save_png
from app.view.palettes import LIGHT
from app.view.shading import mask_colours

if TYPE_CHECKING:
    from lcollision_core.bodies import PosableBody

_VIEW_WIDTH, _VIEW_HEIGHT = 900, 1300
_LEGEND_COLUMN, _LEGEND_ROW = 425, 52
_MARGIN = 50


def parts_image(model: PosableBody, width: int, height: int) -> Image.Image:
    """Draw the same two sides as `draw_masks`, without names, on nothing.

    Parameters
    ----------
    width, height : of both together, in pixels
    """
    picture = Image.new("RGBA", (width, height))
    renderer = PoseRenderer(model, width // 2, height, LIGHT, transparent=True)
    _paste_sides(picture, renderer, model, width // 2, height)
    return picture


def draw_masks(model: PosableBody, path: str | os.PathLike[str]) -> None:
    """Draw the reference from two sides, each domain in its colour, stronger where it owns more.

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
    names, colours = model.domain_names, model.card.domain_colours
    n_columns = min((2 * _VIEW_WIDTH - 2 * _MARGIN) // _LEGEND_COLUMN, len(names))
    n_rows = -(-len(names) // n_columns)
    height = _VIEW_HEIGHT + n_rows * _LEGEND_ROW + 2 * _MARGIN
    picture = Image.new("RGB", (2 * _VIEW_WIDTH, height), "white")

    renderer = PoseRenderer(model, _VIEW_WIDTH, _VIEW_HEIGHT, LIGHT)
    renderer.scene.show_floor(False)
    renderer.scene.set_plain_background("#ffffff")
    _paste_sides(picture, renderer, model, _VIEW_WIDTH, _VIEW_HEIGHT)

    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(size=26)
    left = (2 * _VIEW_WIDTH - n_columns * _LEGEND_COLUMN) // 2
    for domain, (name, colour) in enumerate(zip(names, colours, strict=True)):
        column, row = divmod(domain, n_rows)
        x = left + column * _LEGEND_COLUMN
        y = _VIEW_HEIGHT + _MARGIN + row * _LEGEND_ROW
        shades = mask_colours(np.linspace(0.0, 1.0, 60)[None], (colour,))
        picture.paste(Image.fromarray(np.tile(shades, (30, 1, 1))), (x, y))
        draw.rectangle((x, y, x + 60, y + 30), outline="#c8c8cd")
        draw.text((x + 76, y + 15), name, fill="#282c34", font=font, anchor="lm")
    save_png(picture, path)


def _paste_sides(
    picture: Image.Image, renderer: PoseRenderer, model: PosableBody, width: int, height: int
) -> None:
    """Draw the front and the back of the reference beside each other, and close the renderer."""
    from lcollision_core.meshes.normals import vertex_normals

    scene, vertices = renderer.scene, model.reference.astype(np.float32)
    normals = vertex_normals(vertices, model.faces)
    scene.show(vertices, normals, mask_colours(model.attention_mask, model.card.domain_colours))
    for index, side in enumerate(("Front", "Back")):
        scene.view = preset_view(side, vertices, model.up_axis, model.front, width / height)
        picture.paste(renderer.drawn(), (index * width, 0))
    renderer.close()
