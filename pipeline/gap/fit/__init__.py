"""A model fitted to all runs at once: its vector, derivatives, steps and first estimate."""
