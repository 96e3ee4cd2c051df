"""Faults of recordings, and contradictions between them: found here, worded in one place."""
