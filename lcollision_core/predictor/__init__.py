"""Latent codes to energy per domain and collision probability: learned, smooth, fast (stage 2)."""
