"""Figures in one style, and their conversion to SVG."""
