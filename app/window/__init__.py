"""The main window: actions, menus, panels, dialogs, and start-up."""
