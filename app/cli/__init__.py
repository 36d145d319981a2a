"""The command line, ``lcollision``; `main` is its entry point."""

from app.cli.main import main

__all__ = ["main"]
