"""The default network on the CPU: compiled loops in single precision, without torch."""
