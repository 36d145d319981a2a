"""Motions without a mesh of their own: skeletons and point caches."""
