"""The editor's settings of a user: one table of key, default and limits."""

from __future__ import annotations

import logging
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PySide6.QtCore import QByteArray, QSettings, QStandardPaths

from lcollision_core.files.safe import require_regular

_log = logging.getLogger(__name__)

ORGANISATION = "lcollision"
APPLICATION = "editor"

_RECENT_FILES = 8


@dataclass(frozen=True)
class Setting:
    """One remembered value.

    Attributes
    ----------
    default : its type is the setting's type
    low, high : limits of a number
    choices : all allowed texts; if empty, any
    """

    default: Any
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()


SETTINGS: dict[str, Setting] = {
    "theme": Setting("system", choices=("system", "light", "dark")),
    "shading": Setting("domains", choices=("plain", "domains", "predicted", "exact", "movement")),
    "character_shading": Setting(
        "textured", choices=("textured", "plain", "domains", "exact", "movement")
    ),
    "show_ghost": Setting(True),
    "camera_follows": Setting(True),
    "solid": Setting(True),
    "standing": Setting(True),
    "drag_strength": Setting(1.0, 0.0, 100.0),
    "clearance": Setting(0.001, 0.0, 0.1),
    "model": Setting("body"),
    "recent_files": Setting(()),
    "last_folder": Setting(""),
    "closed_learning": Setting(()),
    "hidden_meshes": Setting(()),
    "window_geometry": Setting(QByteArray()),
    "window_layout": Setting(QByteArray()),
    "sliders_width": Setting(0, 0, 10_000),
    "collision_width": Setting(0, 0, 10_000),
    "randomise_amount": Setting(0.5, 0.0, 1.0),
    "resolve_threshold": Setting(0.5, 0.01, 0.99),
    "resolve_metric": Setting("vertices", choices=("vertices", "latent")),
    "resolve_largest_change": Setting(25.0, 0.0, 99.0),
    "resolve_time_budget": Setting(20.0, 0.1, 3600.0),
    "export_form": Setting("joints", choices=("joints", "mesh", "morph", "obj", "mesh-alone")),
    "export_keep_clips": Setting(False),
    "scene_form": Setting("own", choices=("own", "obj", "ply", "stl", "glb")),
    "motion_form": Setting("clip", choices=("clip", "bvh", "vrma", "pc2", "mdd")),
    "export_rate": Setting(30.0, 0.001, 240.0),
    "export_axes": Setting("model", choices=("model", "y-up", "blender", "maya", "unreal")),
    "export_rescale": Setting(1.0, 1e-6, 1e6),
    "print_height": Setting(100.0, 1.0, 10_000.0),
    "print_wall": Setting(1.0, 0.01, 100.0),
    "print_open_layers": Setting("auto", choices=("auto", "close", "thicken")),
    "print_join": Setting(2.0, 0.0, 1000.0),
    "print_base": Setting(0.0, 0.0, 1000.0),
    "print_resolve": Setting(True),
    "screenshot_width": Setting(1920, 16, 8192),
    "screenshot_height": Setting(1080, 16, 8192),
    "screenshot_transparent": Setting(True),
    "turntable_format": Setting("gif", choices=("gif", "webp", "png")),
    "turntable_seconds": Setting(4.0, 0.5, 20.0),
    "turntable_rate": Setting(25, 1, 60),
    "turntable_width": Setting(640, 16, 4096),
    "turntable_height": Setting(640, 16, 4096),
    "turntable_background": Setting("shown", choices=("shown", "plain", "transparent")),
    "turntable_colour": Setting("#ffffff"),
}
"""All settings by key; `Settings` refuses any other key."""


class Settings:
    """The settings of this user, each always of its type and within its limits.

    A stored value of another type or beyond its limits, as after an update or an edit by hand,
    reads as the default.

    Parameters
    ----------
    store : where the values are kept; the user's own by default
    """

    def __init__(self, store: QSettings | None = None) -> None:
        self._store = _own_store() if store is None else store

    def __getitem__(self, key: str) -> Any:
        setting = SETTINGS[key]
        return _accepted(setting, self._store.value(key, setting.default))

    def __setitem__(self, key: str, value: Any) -> None:
        """Store a value, clipped to its limits."""
        setting = SETTINGS[key]
        if setting.low is not None and setting.high is not None:
            value = type(setting.default)(min(max(value, setting.low), setting.high))
        self._store.setValue(key, list(value) if isinstance(value, tuple) else value)

    def remember_file(self, path: str) -> None:
        """Move a file to the top of the recent ones."""
        others = [recent for recent in self["recent_files"] if recent != path]
        self["recent_files"] = (path, *others)[:_RECENT_FILES]

    def forget_file(self, path: str) -> None:
        """Remove a missing file from the recent ones."""
        self["recent_files"] = tuple(name for name in self["recent_files"] if name != path)


def _own_store() -> QSettings:
    """Return the user's own store, or an empty one if Qt would wait for a pipe for ever."""
    folder = Path(
        QStandardPaths.writableLocation(QStandardPaths.StandardLocation.GenericConfigLocation)
    )
    for name in (f"{ORGANISATION}/{APPLICATION}.conf", f"{ORGANISATION}.conf"):
        try:
            require_regular(folder / name)
        except FileNotFoundError:
            continue
        except OSError as error:
            _log.warning("%s is not used, settings are not kept: %s", folder / name, error)
            unused = Path(tempfile.mkdtemp(prefix="lcollision-")) / f"{APPLICATION}.ini"
            return QSettings(str(unused), QSettings.Format.IniFormat)
    return QSettings(ORGANISATION, APPLICATION)


def _accepted(setting: Setting, value: Any) -> Any:
    """Return a stored value in the setting's type, or the default if it is not accepted."""
    default = setting.default
    try:
        if isinstance(default, bool):
            # An ini file stores words.
            words = {"true": True, "false": False}
            accepted: Any = value if isinstance(value, bool) else words[value]
        elif isinstance(default, tuple):
            # QSettings returns a list of one item as the item.
            items = [value] if isinstance(value, str) else list(value or ())
            accepted = tuple(str(item) for item in items)
        else:
            accepted = type(default)(value)
    except (KeyError, TypeError, ValueError):
        return default
    low, high = setting.low, setting.high
    in_range = low is None or high is None or low <= accepted <= high
    return accepted if in_range and accepted in (setting.choices or (accepted,)) else default
