"""Meshes to as-consistent-as-possible deformation features (ACAP, Gao et al. 2019) and back."""
