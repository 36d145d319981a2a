"""Colours of a mesh's vertices, and the legends that explain them; pure NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from lcollision_core.model import PoseModel

ColourArray = npt.NDArray[np.uint8]
FloatArray = npt.NDArray[np.float64]

FULL_PREDICTED = 0.02
"""Square root of a domain's energy, in heights, that is drawn full; one in 40 sampled collisions
of a body has a domain beyond it."""

FULL_EXACT = 0.006
"""Square root of a vertex's energy, in heights, that is drawn full; likewise."""

COLLIDING_FACE = "#e0191f"
"""Faces that intersect another, in both themes."""

_SKIN = {False: "#e9e5df", True: "#d3d1ce"}
_RAMP_STEPS = 256
_UNIT = "in % of the body size"
_RAMPS = {
    # Hues of their own, so that nobody takes what is believed for what is known.
    "predicted": ("#f2a93b", "#cf3f6f", "#5b1a78"),
    "exact": ("#7fc4d6", "#2f7fb8", "#1d2c6b"),
    "movement": ("#afcb60", "#2f8f5c", "#0d3f3c"),
}

# Björn Ottosson, "A perceptual color space for image processing", 2020: Oklab.
_LMS_OF_RGB = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_OKLAB_OF_LMS = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


class Shading(Enum):
    """What the colours of the mesh say; the value is what their legend calls it."""

    PLAIN = "Plain"
    DOMAINS = "Body parts"
    PREDICTED = "Estimated overlap"
    EXACT = "Exact overlap"
    MOVEMENT = "Movement"


@dataclass(frozen=True)
class Legend:
    """What the colours mean.

    Attributes
    ----------
    title : one line; "" where there is nothing to explain
    note : one line beneath it, or ""
    swatches : (name, "#rrggbb") in the order to show
    ramp : "#rrggbb" from none to most, empty without a scale
    ticks : (place from 0 to 1 along the ramp, text)
    """

    title: str = ""
    note: str = ""
    swatches: tuple[tuple[str, str], ...] = ()
    ramp: tuple[str, ...] = ()
    ticks: tuple[tuple[float, str], ...] = ()


class Shader:
    """Colours the vertices of one model.

    Parameters
    ----------
    attention_mask : (K, V) array, each column sums to 1
    domain_colours : K strings "#rrggbb"
    dark : for a dark background
    """

    def __init__(
        self,
        attention_mask: npt.NDArray[Any],
        domain_colours: tuple[str, ...],
        dark: bool = False,
    ) -> None:
        self._mask = np.ascontiguousarray(attention_mask, dtype=np.float32)
        self._colours = domain_colours
        self._dark = dark
        self._domains = mask_colours(attention_mask, domain_colours)
        self._leading = self._mask.argmax(axis=0)

    @classmethod
    def of(cls, model: PoseModel, dark: bool) -> Shader:
        """Return the shader of a model, for a dark background or a light one."""
        return cls(model.attention_mask, model.domain_colours, dark)

    @property
    def skin(self) -> str:
        """The colour of a mesh about which nothing is said."""
        return _SKIN[self._dark]

    def leading_domain(self, vertex: int) -> int:
        """Return the domain that owns most of a vertex."""
        return int(self._leading[vertex])

    def colours(
        self,
        shading: Shading,
        domain_energy: FloatArray | None = None,
        vertex_energy: FloatArray | None = None,
        movement: FloatArray | None = None,
    ) -> ColourArray:
        """Colour each vertex: by nothing but what is shown, so that a scale means one thing.

        Parameters
        ----------
        shading : what to show; a kind whose numbers are not known is plain
        domain_energy : (K,) array, the estimate, in squared heights
        vertex_energy : (V,) array, the exact energy, in squared heights
        movement : (V,) array, how far Resolve has moved each vertex, in heights

        Returns
        -------
        colours : (V, 3) uint8 array, red, green, blue
        """
        if shading is Shading.DOMAINS:
            return self._domains
        if shading is Shading.PREDICTED and domain_energy is not None:
            spread = domain_energy.astype(np.float32) @ self._mask
            return _on_ramp(np.sqrt(spread) / FULL_PREDICTED, self._ramp("predicted"))
        if shading is Shading.EXACT and vertex_energy is not None:
            return _on_ramp(np.sqrt(vertex_energy) / FULL_EXACT, self._ramp("exact"))
        if shading is Shading.MOVEMENT and movement is not None and movement.any():
            return _on_ramp(movement / movement.max(), self._ramp("movement"))
        return np.broadcast_to(rgb(self.skin), self._domains.shape)

    def legend(
        self,
        shading: Shading,
        domain_energy: FloatArray | None = None,
        vertex_energy: FloatArray | None = None,
        movement: FloatArray | None = None,
        has_predictor: bool = True,
    ) -> Legend:
        """Explain what `colours` returns for the same arguments.

        Its scale stays while its numbers come and go, so that nothing round it moves.

        Parameters
        ----------
        has_predictor : False where no estimate will ever come
        """
        if shading is Shading.PLAIN:
            return Legend()
        if shading is Shading.DOMAINS:
            # Which colour is whose stands in the panels, and under the pointer.
            greys = ramp(("#ffffff", "#565b63"))
            return Legend(
                shading.value,
                "stronger colour = only this part",
                ramp=_ramp_text(greys),
                ticks=((0.0, "shared"), (1.0, "alone")),
            )
        if shading is Shading.PREDICTED and not has_predictor:
            return Legend(shading.value, "this model does not predict")
        if shading is Shading.PREDICTED:
            note = "computing…" if domain_energy is None else _UNIT
            if vertex_energy is not None and not vertex_energy.any():
                note = "the check found none"
            return self._scale(shading, note, "predicted", _ticks(FULL_PREDICTED, " or more"))
        if shading is Shading.EXACT:
            note = "checking …" if vertex_energy is None else _UNIT
            if vertex_energy is not None and not vertex_energy.any():
                note = "no collisions"
            return self._scale(
                shading,
                note,
                "exact",
                _ticks(FULL_EXACT, " or more"),
                (("crossing triangles", COLLIDING_FACE),),
            )
        most = 0.0 if movement is None else float(movement.max())
        note = "shown after Resolve" if movement is None else _UNIT if most else "nothing moved"
        ticks = _ticks(most) if most else ((0.0, "none"), (1.0, "most"))
        return self._scale(shading, note, "movement", ticks)

    def _scale(
        self,
        shading: Shading,
        note: str,
        kind: str,
        ticks: tuple[tuple[float, str], ...],
        swatches: tuple[tuple[str, str], ...] = (),
    ) -> Legend:
        return Legend(shading.value, note, swatches, _ramp_text(self._ramp(kind)), ticks)

    def _ramp(self, kind: str) -> ColourArray:
        return ramp((self.skin, *_RAMPS[kind]))


def mask_colours(attention_mask: npt.NDArray[Any], domain_colours: tuple[str, ...]) -> ColourArray:
    """Colour each vertex by the domain that owns most of it, darker the more that is.

    Parameters
    ----------
    attention_mask : (K, V) array, each column sums to 1
    domain_colours : K strings "#rrggbb"

    Returns
    -------
    colours : (V, 3) uint8 array, red, green, blue
    """
    # Mixed hues would look like a domain that is not there; white cannot be mistaken for one.
    leading = attention_mask.argmax(axis=0)
    share = attention_mask.max(axis=0)[:, None]
    full = np.array([rgb(colour) for colour in domain_colours], dtype=np.float64)
    colours: ColourArray = np.round(255.0 - share * (255.0 - full[leading])).astype(np.uint8)
    return colours


@cache
def ramp(stops: tuple[str, ...]) -> ColourArray:
    """Make a scale of colours whose every step looks equally large.

    Parameters
    ----------
    stops : two or more "#rrggbb", passed through in this order

    Returns
    -------
    colours : (256, 3) uint8 array, red, green, blue, read-only
    """
    corners = _oklab(np.array([rgb(stop) for stop in stops]))
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    place = np.concatenate([[0.0], np.cumsum(lengths)])
    steps = np.linspace(0.0, place[-1], _RAMP_STEPS)
    lab = np.stack([np.interp(steps, place, axis) for axis in corners.T], axis=1)
    colours = _rgb_of_oklab(lab)
    colours.flags.writeable = False
    return colours


def rgb(colour: str) -> ColourArray:
    """Return red, green and blue of "#rrggbb" as a (3,) uint8 array."""
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), dtype=np.uint8)


def _on_ramp(share: npt.NDArray[Any], colours: ColourArray) -> ColourArray:
    step = np.minimum(share * (_RAMP_STEPS - 1), _RAMP_STEPS - 1)
    picked: ColourArray = colours[step.astype(np.intp)]
    return picked


def _ramp_text(colours: ColourArray) -> tuple[str, ...]:
    return tuple(f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in colours.tolist())


def _ticks(full: float, beyond: str = "") -> tuple[tuple[float, str], ...]:
    texts = ("0", f"{50 * full:.2g}", f"{100 * full:.2g}{beyond}")
    return tuple(zip((0.0, 0.5, 1.0), texts, strict=True))


def _oklab(colours: ColourArray) -> FloatArray:
    share = colours / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    lab: FloatArray = np.cbrt(linear @ _LMS_OF_RGB.T) @ _OKLAB_OF_LMS.T
    return lab


def _rgb_of_oklab(lab: FloatArray) -> ColourArray:
    lms = (lab @ np.linalg.inv(_OKLAB_OF_LMS).T) ** 3
    linear = np.clip(lms @ np.linalg.inv(_LMS_OF_RGB).T, 0.0, 1.0)
    share = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    colours: ColourArray = np.round(255.0 * share).astype(np.uint8)
    return colours
