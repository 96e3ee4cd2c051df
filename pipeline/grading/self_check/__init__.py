"""The students' check: which of their numbers are wrong, then where to look."""
