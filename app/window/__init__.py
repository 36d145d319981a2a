"""The main window: actions, menus, panels, dialogs, and how the editor starts."""
