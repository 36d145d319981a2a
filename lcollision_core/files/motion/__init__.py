"""Motions without faces: skeletons and point caches."""
