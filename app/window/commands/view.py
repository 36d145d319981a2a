"""The View menu: shading, camera, panels and theme."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.view.camera import CAMERAS
from app.view.shading import Shading
from app.window.command import EditorWindow, Menu, greyed, ticked, without_body

if TYPE_CHECKING:
    from app.editing.document import PoseDocument
    from app.editing.history import PoseHistory
    from app.editing.settings import Settings

VIEW = Menu("&View")


def set_up_ghost(history: PoseHistory, settings: Settings) -> None:
    """Restore whether the ghost is shown, and store later changes."""
    history.show_ghost(settings["show_ghost"])

    def remember() -> None:
        settings["show_ghost"] = history.ghost_shown

    history.ghost_changed.connect(remember)


def remembered_shading(window: EditorWindow) -> Shading:
    """Return the shading last chosen for a body of this kind."""
    return Shading[window.settings[_setting_of_shading(window.document)].upper()]


def _setting_of_shading(document: PoseDocument) -> str:
    """Return the key of the shading setting; characters with colours or textures have their own."""
    look = document.model.appearance if document.has_model else None
    return "shading" if look is None or look.is_plain else "character_shading"


_SHADINGS = VIEW.choices()


def _shading(digit: int, shading: Shading, text: str, tip: str) -> None:
    def why_not(window: EditorWindow) -> str:
        if shading is Shading.PREDICTED and not window.document.model.has_predictor:
            return "Only a learned model with a predictor has an estimate"
        if shading is Shading.TEXTURED and window.document.model.appearance is None:
            return "Only a character from a file has colours and textures of its own"
        return ""

    @_SHADINGS.command(shading.name.lower(), text, f"Ctrl+{digit}", tip)
    @greyed(why_not)
    @ticked(lambda window: window.viewport.shading is shading)
    def choose(window: EditorWindow) -> None:
        textured = shading is Shading.TEXTURED
        key = "character_shading" if textured else _setting_of_shading(window.document)
        window.settings[key] = shading.name.lower()
        window.viewport.set_shading(shading)


_shading(0, Shading.TEXTURED, "&Textured", "The character as it looks: its colours and textures")
_shading(1, Shading.PLAIN, "&Plain", "The body in one colour")
_shading(
    2,
    Shading.DOMAINS,
    "&Body parts",
    "Body parts in colour; stronger colour = only this part controls it",
)
_shading(3, Shading.PREDICTED, "&Estimate", "Where the model estimates collisions, and how deep")
_shading(4, Shading.EXACT, "E&xact", "Where the check finds collisions; crossing triangles in red")
_shading(5, Shading.MOVEMENT, "Mo&vement", "How far Resolve has moved each point of the body")
VIEW.line()


@VIEW.command(
    "ghost", "&Ghost", "Ctrl+G", "Show the pose before Resolve as a transparent body", "ghost"
)
@ticked(lambda window: window.document.history.ghost_shown)
def _toggle_ghost(window: EditorWindow) -> None:
    window.document.history.show_ghost(not window.document.history.ghost_shown)


VIEW.add(lambda window: window.meshes.menu)


VIEW.line()


_CAMERAS = VIEW.choices("&Camera view")


def _camera(digit: int, name: str) -> None:
    icon = f"camera-{name.lower()}"

    @_CAMERAS.command(icon, name, f"Alt+{digit}", f"Camera view: {name.lower()}", icon)
    def look(window: EditorWindow) -> None:
        window.viewport.set_camera(name)


for _digit, _name in enumerate(CAMERAS, start=1):
    _camera(_digit, _name)


@VIEW.command(
    "reset_camera",
    "Show the &whole body",
    "Ctrl+Home",
    "Fit the whole body into the view, from the same side",
)
def _reset_camera(window: EditorWindow) -> None:
    window.viewport.show_whole()


@VIEW.command(
    "upright", "Turn &upright", "", "Make the next axis point up (changes a learned model's file)"
)
@greyed(lambda window: window.files.why_not_upright())
def _upright(window: EditorWindow) -> None:
    window.files.turn_upright()


VIEW.line()


VIEW.add(lambda window: [dock.toggleViewAction() for dock in window.docks.values()])


@VIEW.command(
    "reset_layout", "Reset la&yout", "Ctrl+Alt+0", "Put all panels back in their default places"
)
@without_body
def _reset_layout(window: EditorWindow) -> None:
    window.reset_layout()


VIEW.line()


_THEMES = VIEW.choices("&Theme")


def _theme(theme: str, text: str, key: str, tip: str) -> None:
    @_THEMES.command(theme, text, key, tip)
    @ticked(lambda window: window.settings["theme"] == theme)
    @without_body
    def choose(window: EditorWindow) -> None:
        window.set_theme(theme)


_theme("system", "Match &system", "F6", "Match the desktop's theme")
_theme("light", "&Light", "F7", "Dark text on light")
_theme("dark", "&Dark", "F8", "Light text on dark")


@VIEW.command("full_screen", "&Full screen", "F11", "Use the whole screen")
@ticked(lambda window: window.isFullScreen())
@without_body
def _toggle_full_screen(window: EditorWindow) -> None:
    if window.isFullScreen():
        window.showNormal()
    else:
        window.showFullScreen()
