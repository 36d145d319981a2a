"""The engine as a server process for other programs: framed messages, sessions and a client."""
