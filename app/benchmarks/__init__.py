"""Measurements of ``lcollision benchmark``; the program itself does not need them."""
