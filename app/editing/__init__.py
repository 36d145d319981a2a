"""The edited pose: document, history, commands, recovery, settings; signals but no widgets."""
