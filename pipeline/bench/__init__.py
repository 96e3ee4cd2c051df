"""The bench: what to record, the serial line, the virtual bench, live views."""
