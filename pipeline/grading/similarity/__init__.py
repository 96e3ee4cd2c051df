"""Recordings and people that stand twice in a class."""
