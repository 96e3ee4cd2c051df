"""The check for students: which of their numbers are wrong, and then where to look."""
