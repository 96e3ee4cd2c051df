"""The bench: the serial line, sessions, live views."""
