"""Use cases shared by all front ends, each with typed requests and results."""
