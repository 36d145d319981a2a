"""Panels round the viewport, made by `MainWindow`: bodies, sliders, collisions, poses, timeline."""
