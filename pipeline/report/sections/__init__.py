"""What sections of several reports share, and the sections on measurements and control."""
