"""Recordings and people found in several submissions of a class."""
