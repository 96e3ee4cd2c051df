"""Figures, one style for all, and their way to SVG."""
