"""Fit a model to all runs at once: parameter vector, derivatives, steps and first estimate."""
