"""The threads behind the window and their work: the live pose, long jobs, frames."""
