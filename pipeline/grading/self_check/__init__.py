"""The check that students ask: which of their numbers are off, then where to look."""
