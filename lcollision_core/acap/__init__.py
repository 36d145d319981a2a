"""Convert meshes to as-consistent-as-possible features (ACAP, Gao et al. 2019) and back."""
