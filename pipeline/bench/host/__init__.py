"""Acquisition: the line, the session, and what is kept of it."""
