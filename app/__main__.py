"""``python -m app`` is ``lcollision``."""

from app.cli.main import main

if __name__ == "__main__":
    main()
