"""Explore a bench: record, identify, look for gaps, choose the next recording, and repeat."""
