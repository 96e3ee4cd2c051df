"""Recordings and people that occur in several submissions of a class."""
