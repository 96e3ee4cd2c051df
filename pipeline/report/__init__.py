"""Figures, tables and words; HTML and PDF."""
