"""Engine processes, and a character as a client sends it."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from lcollision_core.files import Character
from lcollision_core.serve.client import Engine, Reply

ROOT = Path(__file__).parents[3]


def start(**options: Any) -> Engine:
    """Start the engine of this checkout as a separate process."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return Engine.start([sys.executable, "-m", "app"], env=environment, **options)


def as_arrays(character: Character) -> Reply:
    """Return the `open_mesh` fields of a synthetic character."""
    rig = character.rig
    assert rig is not None
    part = {
        "name": "Body",
        "vertices": np.array(character.rest_vertices),
        "faces": np.ascontiguousarray(character.topology.faces, dtype=np.int32),
        "joint_of": np.array(rig.joint_of, dtype=np.int32),
        "weights": np.array(rig.weights),
    }
    return {
        "name": character.name,
        "parts": [part],
        "joints": list(rig.joint_names),
        "parents": np.array(rig.parents, dtype=np.int32),
        "rest": np.array(rig.rest),
        "up": "z",
    }


def array(values: Reply) -> Any:
    """Return an array from a reply."""
    return np.frombuffer(values["data"], values["dtype"]).reshape(values["shape"])
