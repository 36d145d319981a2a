"""One colour per domain, told apart by colour-blind eyes too."""

from __future__ import annotations

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


def domain_colours(n_domains: int) -> tuple[str, ...]:
    """Return `n_domains` colours as "#rrggbb"; past the palette's 16 they repeat."""
    return tuple(PALETTE[domain % len(PALETTE)] for domain in range(n_domains))
