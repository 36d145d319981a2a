"""Colours of the view and the themes: palettes, and shading by body part, overlap or movement."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lcollision_core.bundled import bundled_table

ColourArray = npt.NDArray[np.uint8]
FloatArray = npt.NDArray[np.float64]

FULL_PREDICTED = 0.02
"""Square root of a domain's energy, in normalised length, at the end of the colour scale; it is
exceeded in one of 40 sampled collisions of a body."""

FULL_EXACT = 0.006
"""Square root of a vertex's energy, in normalised length, at the end of the scale; likewise."""

COLLIDING_FACE = "#e0191f"
"""Colour of the faces of colliding pairs, in both themes."""

UNCOUNTED_FACE = "#8a3fd1"
"""Colour of the faces of pairs that the contact rules do not count, in both themes."""

NAMED_FACE = "#00a3b4"
"""Colour of the faces selected in a list, in both themes."""

CONTACT = "#ffb000"
"""Colour of the marks where contact holds the body, in both themes."""

_RAMP_STEPS = 256
_PATH_STEPS = 16
"""Steps between two stops of a scale, for measuring their perceived difference."""

UNIT = "in % of the body size"


class Shading(Enum):
    """Shading modes of the mesh; the value is the title of the legend."""

    TEXTURED = "Textured"
    PLAIN = "Plain"
    DOMAINS = "Body parts"
    PREDICTED = "Estimated overlap"
    EXACT = "Exact overlap"
    MOVEMENT = "Movement"


_RAMPS = {
    # Use separate hues, so that an estimate is not mistaken for the exact check.
    Shading.PREDICTED: ("#f2a93b", "#cf3f6f", "#5b1a78"),
    Shading.EXACT: ("#7fc4d6", "#2f7fb8", "#1d2c6b"),
    Shading.MOVEMENT: ("#afcb60", "#2f8f5c", "#0d3f3c"),
}


class Known(NamedTuple):
    """Results for a pose to colour by; None where unknown, or not known yet.

    Attributes
    ----------
    domain_energy : (K,) array, the estimate, in normalised length squared
    vertex_energy : (V,) array, the exact energy, in normalised length squared
    movement : (V,) array, each vertex's displacement by Resolve, in normalised length
    """

    domain_energy: FloatArray | None = None
    vertex_energy: FloatArray | None = None
    movement: FloatArray | None = None


@dataclass(frozen=True)
class Legend:
    """The content of the legend.

    Attributes
    ----------
    title : one line; "" if there is nothing to explain
    note : one line beneath it, or ""
    crossing : meaning of the colour `COLLIDING_FACE`, "" if it is not used
    uncounted : likewise for `UNCOUNTED_FACE`
    ramp : "#rrggbb" from least to most, evenly spaced; empty without a scale
    ticks : (position from 0 to 1 along the ramp, text)
    """

    title: str = ""
    note: str = ""
    crossing: str = ""
    uncounted: str = ""
    ramp: tuple[str, ...] = ()
    ticks: tuple[tuple[float, str], ...] = ()


class Shader:
    """Colour the vertices of one model.

    Parameters
    ----------
    attention_mask : (K, V) array, each column sums to 1
    domain_colours : K strings "#rrggbb"
    skin : "#rrggbb", of a mesh without shading
    """

    def __init__(
        self, attention_mask: npt.NDArray[Any], domain_colours: tuple[str, ...], skin: str
    ) -> None:
        self.skin = skin
        self._mask = np.ascontiguousarray(attention_mask, dtype=np.float32)
        self._domains = mask_colours(attention_mask, domain_colours)

    def colours(self, shading: Shading, known: Known) -> ColourArray:
        """Colour each vertex by the shading alone, so that a scale has one meaning.

        If its values are not known, the mesh has the lowest colour of the scale, the skin's.

        Returns
        -------
        colours : (V, 3) uint8 array, red, green, blue
        """
        if shading is Shading.DOMAINS:
            return self._domains
        fraction = None
        if shading is Shading.PREDICTED and known.domain_energy is not None:
            fraction = np.sqrt(known.domain_energy.astype(np.float32) @ self._mask) / FULL_PREDICTED
        elif shading is Shading.EXACT and known.vertex_energy is not None:
            fraction = np.sqrt(known.vertex_energy) / FULL_EXACT
        elif shading is Shading.MOVEMENT and known.movement is not None and known.movement.any():
            fraction = known.movement / known.movement.max()
        if fraction is None:
            return np.broadcast_to(rgb(self.skin), self._domains.shape)
        step = np.minimum(fraction, 1.0) * (_RAMP_STEPS - 1)
        picked: ColourArray = ramp((self.skin, *_RAMPS[shading]))[step.astype(np.intp)]
        return picked

    def legend(
        self,
        shading: Shading,
        known: Known,
        has_predictor: bool = True,
        excludes: bool = False,
    ) -> Legend:
        """Return the legend of `colours` for the same arguments.

        The scale is kept while values are unknown, so that the layout does not jump.

        Parameters
        ----------
        has_predictor : False if there is never an estimate
        excludes : whether contact rules exclude pairs
        """
        if shading in (Shading.TEXTURED, Shading.PLAIN):
            return Legend()
        if shading is Shading.DOMAINS:
            # The colours are named in the panels and by a tag at the pointer.
            greys, ends = ("#ffffff", "#565b63"), ((0.0, "shared"), (1.0, "alone"))
            note = "stronger colour = only this part"
            return Legend(shading.value, note, ramp=greys, ticks=ends)
        if shading is Shading.PREDICTED and not has_predictor:
            return Legend(shading.value, "this model has no predictor")
        is_free = known.vertex_energy is not None and not known.vertex_energy.any()
        crossing = uncounted = ""
        if shading is Shading.PREDICTED:
            note = "computing…" if known.domain_energy is None else UNIT
            note = "no collisions (checked)" if is_free else note
            ticks = _ticks(FULL_PREDICTED, " or more")
        elif shading is Shading.EXACT:
            note = "checking…" if known.vertex_energy is None else UNIT
            note = "no collisions" if is_free else note
            ticks = _ticks(FULL_EXACT, " or more")
            crossing = "crossing triangles"
            uncounted = "not counted" if excludes else ""
        else:
            most = 0.0 if known.movement is None else float(known.movement.max())
            note = UNIT if most else "nothing moved"
            note = "shown after Resolve" if known.movement is None else note
            ticks = _ticks(most) if most else ((0.0, "none"), (1.0, "most"))
        scale = ramp_texts((self.skin, *_RAMPS[shading]))
        return Legend(shading.value, note, crossing, uncounted, scale, ticks)


def mask_colours(attention_mask: npt.NDArray[Any], domain_colours: tuple[str, ...]) -> ColourArray:
    """Colour each vertex by the domain with the largest weight, darker with larger weight.

    Parameters
    ----------
    attention_mask : (K, V) array, each column sums to 1
    domain_colours : K strings "#rrggbb"

    Returns
    -------
    colours : (V, 3) uint8 array, red, green, blue
    """
    # Mix with white: mixed hues could look like another domain.
    leading = attention_mask.argmax(axis=0)
    weight = attention_mask.max(axis=0)[:, None]
    full = np.array([rgb(colour) for colour in domain_colours], dtype=np.float64)
    colours: ColourArray = np.round(255.0 - weight * (255.0 - full[leading])).astype(np.uint8)
    return colours


@cache
def ramp(stops: tuple[str, ...]) -> ColourArray:
    """Return a perceptually uniform colour scale.

    Parameters
    ----------
    stops : two or more "#rrggbb", passed through in this order

    Returns
    -------
    colours : (256, 3) uint8 array, red, green, blue, read-only
    """
    from lcollision_core.bodies.names import cielab

    corners = np.array([rgb(stop) for stop in stops], dtype=np.float64)
    at = np.linspace(0.0, len(stops) - 1, _PATH_STEPS * (len(stops) - 1) + 1)
    path = np.stack([np.interp(at, range(len(stops)), channel) for channel in corners.T], axis=1)
    lab = np.array([cielab(bytes(colour).hex()) for colour in path.round().astype(np.uint8)])
    lengths = np.linalg.norm(np.diff(lab, axis=0), axis=1)
    position = np.concatenate([[0.0], np.cumsum(lengths)])
    steps = np.linspace(0.0, position[-1], _RAMP_STEPS)
    mixed = np.stack([np.interp(steps, position, channel) for channel in path.T], axis=1)
    colours: ColourArray = mixed.round().astype(np.uint8)
    colours.flags.writeable = False
    return colours


@cache
def ramp_texts(stops: tuple[str, ...]) -> tuple[str, ...]:
    """Return the 256 colours of a `ramp` as "#rrggbb"."""
    return tuple(f"#{bytes(colour).hex()}" for colour in ramp(stops))


def rgb(colour: str) -> ColourArray:
    """Return red, green and blue of "#rrggbb" as a (3,) uint8 array."""
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), dtype=np.uint8)


def _ticks(full: float, beyond: str = "") -> tuple[tuple[float, str], ...]:
    texts = ("0", f"{50 * full:.2g}", f"{100 * full:.2g}{beyond}")
    return tuple(zip((0.0, 0.5, 1.0), texts, strict=True))


@dataclass(frozen=True)
class Theme:
    """The colours of the window, each "#rrggbb".

    Attributes
    ----------
    name : "light" or "dark"
    window : background of the window
    card : background of cards and lists
    field : background of inputs
    border, track : of hairlines; of empty bars and grooves
    text, muted : of primary and secondary text
    accent, on_accent : of highlighted elements, and of text on them
    free, colliding, waiting : of the three verdicts
    sky_bottom, sky_top : gradient behind the mesh
    floor, shadow : beneath the mesh
    skin, ghost : of a mesh without shading, and of the ghost
    """

    name: str
    window: str
    card: str
    field: str
    border: str
    track: str
    text: str
    muted: str
    accent: str
    on_accent: str
    free: str
    colliding: str
    waiting: str
    sky_bottom: str
    sky_top: str
    floor: str
    shadow: str
    skin: str
    ghost: str

    @property
    def is_dark(self) -> bool:
        """Whether this is the dark theme."""
        return self.name == "dark"


LIGHT, DARK = bundled_table("themes.toml", dict[str, list[Theme]])["theme"]
