"""glTF 2.0: its schema, and reading and writing by it."""
