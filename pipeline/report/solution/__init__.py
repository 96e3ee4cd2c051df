"""The instructor's reference."""
