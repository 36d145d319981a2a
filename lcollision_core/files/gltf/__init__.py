"""glTF 2.0: schema, reader and writer."""
