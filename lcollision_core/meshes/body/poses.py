"""The 71 authored poses."""

from __future__ import annotations

from lcollision_core.meshes.body.figure import Figure
from lcollision_core.meshes.body.poses_athletic import ATHLETIC
from lcollision_core.meshes.body.poses_everyday import EVERYDAY

POSES: dict[str, Figure] = EVERYDAY | ATHLETIC
"""Figures by name; the first is the rest pose, free of contact."""
