"""Grade lab submissions, one at a time or a whole class."""
