"""The File menu: open, learn, save, import, export and render pictures."""

from __future__ import annotations

from pathlib import Path

from app.window.command import EditorWindow, Menu, unless, without_body

FILE = Menu("&File")

_NO_CHARACTER = "Only a single character can be learned; open its own file"


@FILE.command("new", "&New pose", "Ctrl+N", "Start again from the first pose of the body", "new")
def _new(window: EditorWindow) -> None:
    window.files.new_pose()


@FILE.command("open", "&Open…", "Ctrl+O", "Open poses, a character, a mesh or a model", "open")
def _open(window: EditorWindow) -> None:
    window.files.ask_and_open("Open", "poses", "characters", "meshes", "models")


@FILE.command("open_model", "Open &model…", "Ctrl+Shift+O", "Open a character or a model")
@without_body
def _open_model(window: EditorWindow) -> None:
    window.files.ask_and_open("Open a character or a model", "characters", "models")


FILE.add(lambda window: window.files.models_menu)


FILE.add(lambda window: window.files.recent_menu)


FILE.line()


@FILE.command(
    "new_model",
    "New mo&del…",
    "Ctrl+Shift+N",
    "Learn a model from a character or a body in many poses",
)
@without_body
def _new_model(window: EditorWindow) -> None:
    window.learning.new_model()


@FILE.command(
    "learn_character",
    "Learn t&his character…",
    "Ctrl+Alt+N",
    "Give this character body parts of its own and an instant estimate",
)
@unless(lambda window: window.document.model.character, _NO_CHARACTER)
def _learn_character(window: EditorWindow) -> None:
    window.learning.new_model((Path(window.document.history.model_file),))


@FILE.command("learning", "Learnin&g…", "Ctrl+Alt+P", "Show the progress of models being trained")
@unless(lambda window: window.learning.runs.runs, "No model is being learned")
@without_body
def _learning(window: EditorWindow) -> None:
    window.learning.show_runs()


FILE.line()


@FILE.command(
    "save", "&Save", "Ctrl+S", "Save the pose to its file; an edited motion is exported", "save"
)
def _save(window: EditorWindow) -> None:
    window.files.save()


@FILE.command(
    "save_as", "Save &as…", "Ctrl+Shift+S", "Save the pose or current frame to another file"
)
def _save_as(window: EditorWindow) -> None:
    window.files.save_as()


FILE.line()


@FILE.command("import", "&Import mesh…", "Ctrl+I", "Turn a mesh into a pose", "import")
def _import(window: EditorWindow) -> None:
    window.files.import_mesh()


@FILE.command(
    "export", "&Export mesh…", "Ctrl+E", "Save the pose as a mesh or in your own file", "export"
)
def _export(window: EditorWindow) -> None:
    window.files.export()


@FILE.command(
    "print",
    "Export for &3D printing…",
    "Ctrl+Alt+Shift+P",
    "Save the pose as one closed solid for a printer",
)
def _print(window: EditorWindow) -> None:
    window.files.export_print()


FILE.line()


@FILE.command("screenshot", "S&creenshot…", "Ctrl+P", "Save a picture of the view", "screenshot")
def _screenshot(window: EditorWindow) -> None:
    window.files.screenshot()


@FILE.command("turntable", "&Turntable…", "Ctrl+T", "Save a video of one full turn", "turntable")
def _turntable(window: EditorWindow) -> None:
    window.files.turntable()


FILE.line()


@FILE.command("quit", "&Quit", "Ctrl+Q", "Close the editor")
@without_body
def _quit(window: EditorWindow) -> None:
    window.close()
