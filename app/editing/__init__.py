"""The pose that is edited: document, history, commands, recovery, settings. Signals, no widget."""
