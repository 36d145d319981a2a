"""The engine as a process that other programs ask: framed messages, sessions, and a client."""
