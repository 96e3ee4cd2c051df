"""The checks of one submission, their points, and the grade."""
