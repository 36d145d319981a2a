"""Scenes in any format: nodes, parts, clips and appearance."""
