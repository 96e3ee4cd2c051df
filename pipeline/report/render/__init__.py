"""Render a document as HTML and as PDF."""
