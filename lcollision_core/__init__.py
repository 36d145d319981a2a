"""Collision-free human poses from learned non-penetration constraints.

An implementation of *LCollision* (Tan, Pan, Manocha, AAAI 2021). Importing this package loads
nothing heavy: each package loads what it needs when it is first used.
"""

__version__ = "0.1.0"
