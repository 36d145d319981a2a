"""The nearest collision-free pose, proved exactly."""
