"""Acquisition: the line, the session, and the files it writes."""
