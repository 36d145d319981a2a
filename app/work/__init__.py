"""Threads behind the window, and what runs in them: the live pose, long jobs, frames."""
