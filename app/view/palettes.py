"""The colours of the window and of the scene, in a light theme and a dark one."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Theme:
    """The colours of the window, each "#rrggbb".

    Attributes
    ----------
    name : "light" or "dark"
    window : behind everything
    card : of cards and lists, that lie on the window
    field : of inputs
    border, track : of hairlines; of empty bars and grooves
    text, muted : of what is read, and of what stands beside it
    accent, on_accent : of what invites, and of text on it
    free, colliding, waiting : of the three verdicts
    sky_bottom, sky_top : behind the mesh
    floor, shadow : beneath it
    skin, ghost : of a mesh without shading, and of the one before Resolve
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
        """Whether text is lighter than what is behind it."""
        return self.name == "dark"


LIGHT = Theme(
    name="light",
    window="#eef0f3",
    card="#ffffff",
    field="#ffffff",
    border="#d3d8df",
    track="#dfe3e9",
    text="#1b2027",
    muted="#57616d",
    accent="#2563c9",
    on_accent="#ffffff",
    free="#00735c",
    colliding="#b93a0b",
    waiting="#57616d",
    sky_bottom="#e4e8ed",
    sky_top="#fafbfc",
    floor="#d3d9e1",
    shadow="#c2c9d3",
    skin="#e9e5df",
    ghost="#6b7c93",
)

DARK = Theme(
    name="dark",
    window="#1d2025",
    card="#262a31",
    field="#1f2329",
    border="#3a4049",
    track="#3b424c",
    text="#e6e9ee",
    muted="#a0a9b5",
    accent="#6ba4ff",
    on_accent="#0b1526",
    free="#4fd1ae",
    colliding="#ff9468",
    waiting="#a0a9b5",
    sky_bottom="#191c21",
    sky_top="#343a44",
    floor="#2a2f37",
    shadow="#1d2127",
    skin="#d3d1ce",
    ghost="#c3d2e6",
)
