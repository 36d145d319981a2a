"""Panels round the viewport: bodies, sliders, collisions, poses and timeline."""
