"""Files that ship with the program: models, icons and sample poses."""
