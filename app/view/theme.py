"""How the window looks: two palettes, one scale of distances, and the style made of them.

Fusion with an explicit palette looks alike everywhere, and can be dark where the desktop's own
style cannot. What means "free" and "colliding" differs in hue for colour-blind eyes too, and never
goes without a word or a sign.
"""

from __future__ import annotations

from dataclasses import dataclass

from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QGuiApplication, QPalette
from PySide6.QtWidgets import QApplication

TIGHT, CLOSE, NORMAL, WIDE = 4, 8, 12, 16
"""All distances in the window, in device-independent pixels."""

ROW_HEIGHT = 26
"""Of one slider and of one domain."""

RADIUS = 6
"""Of the corners of cards and buttons."""


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
)

_SEEN = 1.7
"""Contrast of a bar with its groove: shape and place say the rest, and hues are to stay apart."""

_LIGHTENING = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)

_current = LIGHT


def current_theme() -> Theme:
    """Return the theme that was applied last."""
    return _current


def wanted_theme(choice: str) -> Theme:
    """Return the theme for a choice.

    Parameters
    ----------
    choice : "light", "dark", or "system" for what the desktop asks for; light where it asks for
        nothing
    """
    if choice == "system":
        is_dark = QGuiApplication.styleHints().colorScheme() is Qt.ColorScheme.Dark
        return DARK if is_dark else LIGHT
    return {"light": LIGHT, "dark": DARK}[choice]


def apply_theme(application: QApplication, theme: Theme) -> None:
    """Give the whole application a theme; widgets learn of it by ``changeEvent``."""
    global _current
    _current = theme
    # By name: a style made here, which Qt deletes, would leave its address to be taken for it.
    application.setStyle("Fusion")
    application.setPalette(_palette(theme))
    application.setStyleSheet(_style_sheet(theme))


def _palette(theme: Theme) -> QPalette:
    palette = QPalette()
    role = QPalette.ColorRole
    colours = {
        role.Window: theme.window,
        role.WindowText: theme.text,
        role.Base: theme.field,
        role.AlternateBase: theme.window,
        role.Text: theme.text,
        role.Button: theme.card,
        role.ButtonText: theme.text,
        role.BrightText: theme.colliding,
        role.ToolTipBase: theme.card,
        role.ToolTipText: theme.text,
        role.PlaceholderText: theme.muted,
        role.Highlight: theme.accent,
        role.HighlightedText: theme.on_accent,
        role.Link: theme.accent,
        role.LinkVisited: theme.accent,
        role.Light: theme.card,
        role.Midlight: theme.border,
        role.Mid: theme.border,
        role.Dark: theme.border,
        role.Shadow: "#000000",
        role.Accent: theme.accent,
    }
    for which, colour in colours.items():
        palette.setColor(which, QColor(colour))
    faded = mixed(theme.text, theme.window, 0.55)
    for which in (role.WindowText, role.Text, role.ButtonText):
        palette.setColor(QPalette.ColorGroup.Disabled, which, faded)
    disabled = QPalette.ColorGroup.Disabled
    palette.setColor(disabled, role.Highlight, QColor(theme.track))
    palette.setColor(disabled, role.HighlightedText, faded)
    return palette


def mixed(colour: str, other: str, share: float) -> QColor:
    """Return a colour that is another one by a share between 0 and 1."""
    one, two = QColor(colour), QColor(other)
    parts = ((one.red(), two.red()), (one.green(), two.green()), (one.blue(), two.blue()))
    return QColor(*(round((1.0 - share) * a + share * b) for a, b in parts))


def contrast(colour: QColor, other: QColor) -> float:
    """Return the contrast ratio of two colours, from 1 to 21, as WCAG 2.1 defines it."""
    light, dark = sorted((_luminance(colour), _luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def visible_colour(colour: str) -> QColor:
    """Return a domain's colour, lightened where it would not be seen on the dark theme's bars."""
    shade = QColor(colour)
    for share in _LIGHTENING:
        if not _current.is_dark or contrast(shade, QColor(_current.track)) >= _SEEN:
            break
        shade = mixed(colour, "#ffffff", share)
    return shade


def _luminance(colour: QColor) -> float:
    parts = (colour.redF(), colour.greenF(), colour.blueF())
    red, green, blue = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def _style_sheet(theme: Theme) -> str:
    hover = mixed(theme.card, theme.accent, 0.10).name()
    pressed = mixed(theme.card, theme.accent, 0.22).name()
    faded = mixed(theme.text, theme.window, 0.55).name()
    deeper = mixed(theme.accent, theme.text, 0.18).name()
    return f"""
QToolTip {{
    background: {theme.card}; color: {theme.text}; border: 1px solid {theme.border};
    padding: {TIGHT}px {CLOSE}px;
}}
QMenuBar {{ background: {theme.window}; padding: 2px {TIGHT}px; }}
QMenuBar::item {{ padding: {TIGHT}px {CLOSE}px; border-radius: 4px; background: transparent; }}
QMenuBar::item:selected {{ background: {hover}; }}
QMenu {{ background: {theme.card}; border: 1px solid {theme.border}; padding: {TIGHT}px; }}
QMenu::item {{ padding: 5px {WIDE + 8}px 5px {CLOSE}px; border-radius: 4px; }}
QMenu::icon {{ padding-left: {CLOSE}px; }}
QMenu::item:selected {{ background: {theme.accent}; color: {theme.on_accent}; }}
QMenu::item:disabled {{ color: {faded}; background: transparent; }}
QMenu::separator {{ height: 1px; background: {theme.border}; margin: {TIGHT}px {CLOSE}px; }}
QToolBar {{
    background: {theme.window}; border: none; border-bottom: 1px solid {theme.border};
    padding: {TIGHT}px {CLOSE}px; spacing: 2px;
}}
QToolBar::separator {{ width: 1px; background: {theme.border}; margin: 5px 6px; }}
QToolButton {{ border: 1px solid transparent; border-radius: {RADIUS}px; padding: 4px; }}
QToolButton:hover {{ background: {hover}; }}
QToolButton:pressed {{ background: {pressed}; }}
QToolButton:focus {{ border-color: {theme.accent}; }}
QToolButton:checked {{ background: {pressed}; }}
QToolButton::menu-indicator {{ image: none; }}
QToolButton#qt_toolbar_ext_button {{ border: none; padding: 0; }}
QToolButton#segment {{
    border: 1px solid {theme.border}; border-radius: 0; padding: 4px 10px;
    background: {theme.card}; margin-left: -1px;
}}
QToolButton#segment:hover {{ background: {hover}; }}
QToolButton#segment:checked {{
    background: {theme.accent}; color: {theme.on_accent}; border-color: {theme.accent};
}}
QToolButton#segment:focus {{ border-color: {theme.accent}; }}
QToolButton#filter {{
    border: 1px solid {theme.border}; padding: 4px 10px; background: {theme.card};
}}
QToolButton#segment[place="first"] {{
    border-top-left-radius: {RADIUS}px; border-bottom-left-radius: {RADIUS}px; margin-left: 0;
}}
QToolButton#segment[place="last"] {{
    border-top-right-radius: {RADIUS}px; border-bottom-right-radius: {RADIUS}px;
}}
QMainWindow::separator {{ background: {theme.window}; width: 5px; height: 5px; }}
QMainWindow::separator:hover {{ background: {theme.accent}; }}
QDockWidget {{ font-weight: 600; titlebar-close-icon: none; }}
QDockWidget::title {{
    background: {theme.window}; padding: {CLOSE}px {NORMAL}px {TIGHT}px {NORMAL}px;
    text-align: left;
}}
QTabBar::tab {{ padding: 5px {NORMAL}px; border: none; color: {theme.muted}; }}
QTabBar::tab:selected {{ color: {theme.text}; border-bottom: 2px solid {theme.accent}; }}
QStatusBar {{
    background: {theme.window}; color: {theme.muted}; border-top: 1px solid {theme.border};
}}
QStatusBar::item {{ border: none; }}
QScrollArea, QScrollArea > QWidget > QWidget#page {{ background: transparent; border: none; }}
QFrame#card {{
    background: {theme.card}; border: 1px solid {theme.border}; border-radius: {RADIUS + 2}px;
}}
QFrame#truth {{
    background: {theme.card}; border: 1px solid {theme.border};
    border-left: 4px solid {theme.waiting}; border-radius: {RADIUS + 2}px;
}}
QFrame#truth[verdict="free"] {{ border-left-color: {theme.free}; }}
QFrame#truth[verdict="colliding"] {{ border-left-color: {theme.colliding}; }}
QLabel#title {{ font-weight: 600; }}
QLabel#caption {{ color: {theme.muted}; }}
QLabel#refusal {{ color: {theme.colliding}; }}
QLabel#caption:disabled {{ color: {faded}; }}
QLabel#verdict {{ font-weight: 600; font-size: 14px; }}
QLabel#headline {{ font-weight: 600; font-size: 15px; }}
QLabel#aside {{ font-size: 11px; }}
QLabel[verdict="free"] {{ color: {theme.free}; }}
QLabel[verdict="colliding"] {{ color: {theme.colliding}; }}
QLabel[verdict="waiting"] {{ color: {theme.waiting}; }}
QLabel[verdict="aside"] {{ color: {theme.muted}; }}
QPushButton {{
    background: {theme.card}; border: 1px solid {theme.border}; border-radius: {RADIUS}px;
    padding: 5px {NORMAL}px; min-height: 18px;
}}
QPushButton:hover {{ background: {hover}; border-color: {theme.accent}; }}
QPushButton:pressed {{ background: {pressed}; }}
QPushButton:focus {{ border-color: {theme.accent}; }}
QPushButton:disabled {{ color: {faded}; background: {theme.window}; }}
QPushButton#primary, QPushButton:default {{
    background: {theme.accent}; color: {theme.on_accent}; border-color: {theme.accent};
    font-weight: 600;
}}
QPushButton#primary {{ min-height: 24px; }}
QPushButton#primary:hover, QPushButton:default:hover {{ background: {deeper}; }}
QPushButton#primary:focus {{ border: 2px solid {theme.text}; }}
QPushButton#primary:disabled {{
    background: {theme.track}; color: {faded}; border-color: {theme.border};
}}
QLineEdit, QPlainTextEdit {{
    background: {theme.field}; border: 1px solid {theme.border}; border-radius: {RADIUS - 2}px;
    padding: 3px 6px; selection-background-color: {theme.accent};
    selection-color: {theme.on_accent};
}}
QLineEdit:focus, QPlainTextEdit:focus {{
    border-color: {theme.accent};
}}
QAbstractSpinBox[verdict="outside"] {{ color: {theme.colliding}; font-weight: 600; }}
QAbstractSpinBox QLineEdit {{ border: none; padding: 0 2px; background: transparent; }}
QDialogButtonBox {{ dialogbuttonbox-buttons-have-icons: 0; }}
QMessageBox QLabel#qt_msgbox_label {{ font-weight: 600; }}
QProgressBar {{
    background: {theme.track}; border: none; border-radius: 3px; max-height: 6px;
}}
QProgressBar::chunk {{ background: {theme.accent}; border-radius: 3px; }}
QListView {{
    background: {theme.card}; border: 1px solid {theme.border}; border-radius: {RADIUS}px;
    outline: none;
}}
QListView::item {{ border-radius: {RADIUS}px; padding: {TIGHT}px; color: {theme.text}; }}
QListView::item:hover {{ background: {hover}; }}
QListView::item:selected {{ background: {pressed}; color: {theme.text}; }}
QScrollBar:vertical {{ background: transparent; width: 10px; margin: 0; }}
QScrollBar:horizontal {{ background: transparent; height: 10px; margin: 0; }}
QScrollBar::handle {{
    background: {theme.track}; border-radius: 4px; margin: 1px; min-height: 28px; min-width: 28px;
}}
QScrollBar::handle:hover {{ background: {theme.muted}; }}
QScrollBar::add-line, QScrollBar::sub-line {{ width: 0; height: 0; }}
QScrollBar::add-page, QScrollBar::sub-page {{ background: transparent; }}
"""
