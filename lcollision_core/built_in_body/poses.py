"""The 71 authored poses, read from ``resources/body_poses.json``.

Each pose holds the attributes of `Figure` that are not at their default. A limb that hangs free is
under "left_leg" or "right_leg", one that stands under "left_foot" or "right_foot".
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any

from lcollision_core.built_in_body.figure import Arm, Figure, Foot, Leg
from lcollision_core.bundled import bundled_file

_LIMBS = {"arm": Arm, "leg": Leg, "foot": Foot}


@cache
def authored_poses() -> dict[str, Figure]:
    """Return figures by name; the first is the rest pose, free of contact."""
    poses = json.loads(bundled_file("body_poses.json").read_text(encoding="utf-8"))
    return {name: _figure(attributes) for name, attributes in poses.items()}


def _figure(attributes: dict[str, Any]) -> Figure:
    given: dict[str, Any] = {}
    for key, value in attributes.items():
        limb = _LIMBS.get(key.partition("_")[2])
        if limb is not None:
            given[key.replace("foot", "leg")] = limb(**value)
        else:
            given[key] = tuple(value) if isinstance(value, list) else value
    return Figure(**given)
