"""Acquisition on a bench: the serial line, sessions, and the files that they write."""
