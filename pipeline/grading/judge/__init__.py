"""The checks of one submission, what each earns, and the grade."""
