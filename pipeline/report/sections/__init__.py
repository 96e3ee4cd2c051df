"""Sections on measurements and control, and parts that several reports share."""
