"""What ``lcollision benchmark`` measures; nothing here is needed to run the program."""
