"""The command line, ``lcollision``; its entry point is `app.cli.main.main`."""
