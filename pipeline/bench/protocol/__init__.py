"""The messages between host and bench, and the clock of the bench."""
