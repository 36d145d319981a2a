"""How the window looks: two palettes, one scale of distances, and the style made of them.

Fusion with an explicit palette looks alike everywhere, and can be dark where the desktop's own
style cannot. What means "free" and "colliding" differs in hue for colour-blind readers too, and is
never shown by colour alone.
"""

from __future__ import annotations

from dataclasses import asdict
from string import Template

import numpy as np
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QGuiApplication, QPalette
from PySide6.QtWidgets import QApplication

from app.view.palettes import DARK, LIGHT, Theme
from app.view.shading import rgb
from lcollision_core.bundled import bundled_file

TIGHT, CLOSE, NORMAL, WIDE = 4, 8, 12, 16
"""The spacings of the window, in device-independent pixels."""

ROW_HEIGHT = 26
"""Of the row of a slider or a domain."""


_DARKEST = 42.0
"""CIELAB lightness of a bar that is seen in the dark theme's groove."""

_current = LIGHT


def current_theme() -> Theme:
    """Return the theme that was applied last."""
    return _current


def wanted_theme(choice: str) -> Theme:
    """Return the theme for a choice.

    Parameters
    ----------
    choice : "light", "dark", or "system" for what the desktop asks for; light if it has no
        preference
    """
    if choice == "system":
        is_dark = QGuiApplication.styleHints().colorScheme() is Qt.ColorScheme.Dark
        return DARK if is_dark else LIGHT
    return {"light": LIGHT, "dark": DARK}[choice]


def apply_theme(application: QApplication, theme: Theme) -> None:
    """Apply a theme to the whole application; widgets get a ``changeEvent``."""
    global _current
    _current = theme
    # By name: a style made here, which Qt deletes, would leave its address to be taken for it.
    application.setStyle("Fusion")
    application.setPalette(_palette(theme))
    application.setStyleSheet(_style_sheet(theme))


def _palette(theme: Theme) -> QPalette:
    # Qt derives the colours that are not set here from these two.
    palette = QPalette(QColor(theme.card), QColor(theme.window))
    role, disabled = QPalette.ColorRole, QPalette.ColorGroup.Disabled
    for colour, roles in {
        theme.text: (role.WindowText, role.Text, role.ButtonText, role.ToolTipText),
        theme.field: (role.Base,),
        theme.card: (role.ToolTipBase, role.Light),
        theme.window: (role.AlternateBase,),
        theme.border: (role.Midlight, role.Mid, role.Dark),
        theme.muted: (role.PlaceholderText,),
        theme.accent: (role.Highlight, role.Accent, role.Link, role.LinkVisited),
        theme.on_accent: (role.HighlightedText,),
    }.items():
        for which in roles:
            palette.setColor(which, QColor(colour))
    faded = mixed(theme.text, theme.window, 0.55)
    for which in (role.WindowText, role.Text, role.ButtonText, role.HighlightedText):
        palette.setColor(disabled, which, faded)
    palette.setColor(disabled, role.Highlight, QColor(theme.track))
    return palette


def mixed(colour: str, other: str, fraction: float) -> QColor:
    """Return a colour, mixed with a fraction of another one."""
    one, two = rgb(colour).astype(float), rgb(other).astype(float)
    return QColor(*np.round(one + fraction * (two - one)).astype(int).tolist())


def visible_colour(colour: str) -> QColor:
    """Return a domain's colour, lightened where it would not be seen on the dark theme's bars."""
    from lcollision_core.bodies.colours import cielab

    shade = QColor(colour)
    for fraction in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6):
        if not _current.is_dark or cielab(shade.name())[0] >= _DARKEST:
            break
        shade = mixed(colour, "#ffffff", fraction)
    return shade


def _style_sheet(theme: Theme) -> str:
    text = bundled_file("editor.qss").read_text(encoding="utf-8")
    return Template(text).substitute(
        asdict(theme),
        tick=bundled_file("icons", f"tick-{theme.name}.svg").as_posix(),
        hover=mixed(theme.card, theme.accent, 0.10).name(),
        pressed=mixed(theme.card, theme.accent, 0.22).name(),
        faded=mixed(theme.text, theme.window, 0.55).name(),
        deeper=mixed(theme.accent, theme.text, 0.18).name(),
    )
