"""Scenes, whatever their format: nodes, parts, clips and looks."""
