"""One colour per domain, distinct for colour-blind readers too."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

PALETTE = (
    "#0077bb",
    "#e69f00",
    "#882255",
    "#66ccee",
    "#ee6677",
    "#228833",
    "#ddcc77",
    "#332288",
    "#cc79a7",
    "#cc3311",
    "#762a83",
    "#999933",
    "#009e73",
    "#a6d854",
    "#aa4499",
    "#56b4e9",
)
"""From the palettes of Okabe and Ito 2008, Tol 2021 and ColorBrewer, each chosen in turn to be
furthest in CIELAB from those before it, at its worst of full, red-, green- and blue-blind sight
(Machado et al. 2009)."""

_MOST_ARRANGED = 3 * len(PALETTE)
"""Domains whose colours are exchanged; among more, each has neighbours of its own colour anyhow."""

_XYZ_OF_RGB = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)
_D65 = np.array([0.9505, 1.0, 1.089])


def domain_colours(attention_mask: npt.NDArray[Any]) -> tuple[str, ...]:
    """Choose a colour for each domain, unlike in hue where domains meet.

    Parameters
    ----------
    attention_mask : (K, V) array

    Returns
    -------
    colours : K strings "#rrggbb", all different up to the palette's 16

    Notes
    -----
    A weight's darkness is drawn as a tint, so that a pale colour must not pass for a neighbour's
    full one: only the hue and chroma of CIELAB count here. Colours swap domains as long as that
    reduces the sum of overlaps over squared distances, which takes minutes for hundreds of domains:
    above `_MOST_ARRANGED` they are taken in turn.
    """
    from scipy.optimize import quadratic_assignment

    n_domains = len(attention_mask)
    chosen = [PALETTE[domain % len(PALETTE)] for domain in range(n_domains)]
    if n_domains > _MOST_ARRANGED:
        return tuple(chosen)
    chroma = np.array([cielab(colour)[1:] for colour in chosen])
    squared_distance = ((chroma[:, None] - chroma) ** 2).sum(axis=2)
    likeness = 1.0 / (squared_distance + 25.0)
    mask = np.asarray(attention_mask, dtype=np.float64)
    overlap = mask @ mask.T
    np.fill_diagonal(overlap, 0.0)
    in_order = np.arange(n_domains)
    found = quadratic_assignment(
        overlap,
        likeness,
        method="2opt",
        # The guess is whole, so that nothing is drawn; without `rng` SciPy warns that it might be.
        options={
            "partial_guess": np.stack([in_order, in_order], axis=1),
            "rng": np.random.default_rng(0),
        },
    )
    return tuple(chosen[colour] for colour in found.col_ind)


def cielab(colour: str, sight: npt.NDArray[np.float64] | None = None) -> npt.NDArray[np.float64]:
    """Return the CIELAB lightness, a and b of "#rrggbb" under daylight (D65).

    Parameters
    ----------
    colour : sRGB
    sight : (3, 3) matrix on linear RGB, such as one that simulates colour blindness
    """
    rgb = np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    if sight is not None:
        linear = np.clip(sight @ linear, 0.0, 1.0)
    xyz = _XYZ_OF_RGB @ linear / _D65
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])
