"""What can be chosen in the window: each command once, by menu."""
